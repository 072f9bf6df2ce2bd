"""Grasping stalks of sorghum with an arm that sees them with two cameras: chapter 4 of the thesis, simulated.

arm      which way the arm goes, and whether it can      reach    many arms at once, among stalks, in wind
metric   what came of it                                 video    the arm at work
"""
