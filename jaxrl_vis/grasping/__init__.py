"""Stalk grasping, chapter 4 of the thesis: from five stereo pairs to grasp points, and to stalks in the gripper.

masks       networks that paint stalks red, and how they learn
cloud       a pair and its mask as an organised point cloud      stitch      clouds of several pairs put together
chords      where lines of an image cross stalks                 sight       what all pairs say of a place
lines       grasp points from a line per stalk                   slices      grasp points as in the thesis
perceive    pairs to grasp points                                evaluate    against the truth of synthetic rows
pipeline    folders of pairs to tables                           figure      figure 4.4
"""
