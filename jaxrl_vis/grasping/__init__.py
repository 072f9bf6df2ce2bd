"""Stalk grasping, chapter 4 of the thesis: from five stereo pairs to grasp points, and to stalks in the gripper.

masks       networks that paint stalks red, and how they learn
cloud       a pair and its mask as an organised point cloud      stitch      clouds of several pairs put together
slices      grasp points as in the thesis                        lines       grasp points from a straight line per stalk
perceive    pairs to grasp points                                evaluate    against the truth of synthetic rows
"""
