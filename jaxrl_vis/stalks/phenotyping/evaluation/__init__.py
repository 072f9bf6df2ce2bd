"""Synthetic plots with exact truth, and scores of detections, counts and widths against it."""
