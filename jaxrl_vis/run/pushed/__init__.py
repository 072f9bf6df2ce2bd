"""Runs for others: a folder with card, curve, video, configuration and weights, here or on a hub."""
