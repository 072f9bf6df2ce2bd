"""Recorded episodes: as .npz, as LeRobot's dataset of version 3, and as this project's replay."""
