"""Measurement of one stalk in one pair: edges, disparity, ground, and the diameter in millimetres."""
