"""Recorded episodes as .npz files, as LeRobot datasets (version 3), and as replays of this project."""
