"""Replay buffer, and the batches, goals and rewards made from it."""
