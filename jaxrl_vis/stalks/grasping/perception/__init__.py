"""Grasp points from stereo pairs and masks: point clouds, their stitching, and the stalks in them."""
