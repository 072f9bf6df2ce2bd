"""Synthetic plots with exact ground truth, and scores of detections, counts and widths against it."""
