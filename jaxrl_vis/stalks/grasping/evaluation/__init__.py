"""Synthetic runs with exact truth: attempts of the arm, and scores of masks, stitches and grasps."""
