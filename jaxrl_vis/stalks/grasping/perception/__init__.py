"""Grasp points from stereo pairs and masks: point clouds, their stitching, and detection of stalks in them."""
