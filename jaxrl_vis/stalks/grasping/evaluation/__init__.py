"""Evaluation on synthetic runs with exact ground truth: grasp attempts, and scores of masks, stitches and grasps."""
