"""Stalk grasping, chapter 4 of the thesis: from five stereo pairs to grasp points, and to stalks in the gripper.

masks       networks that paint stalks red, and how they learn
cloud       a pair and its mask as an organised point cloud      stitch      clouds of several pairs put together
chords      where lines of an image cross stalks                 sight       what all pairs say of a place
lines       grasp points from a line per stalk                   slices      grasp points as in the thesis
perceive    pairs to grasp points                                evaluate    against the truth of synthetic rows
pipeline    folders of pairs to tables                           figure      figure 4.4
arm         which way the arm goes, and whether it can           reach       many arms at once, among stalks, in wind
attempts    grasp points to attempts of the arm
metric      what came of it                                      way         figure 4.5
video       the arm at work
"""
