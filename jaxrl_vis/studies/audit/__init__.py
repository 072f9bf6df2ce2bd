"""Audit of reward functions against the ground truth of a simulated task.

episodes   pairs of images and goal images with their true distances, and a random search that maximises a reward
measures   fractions of false rewards, rank correlations, calibration
report     all rewards on one task: records, table and figure
"""
