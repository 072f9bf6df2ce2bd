"""Stalk grasping (chapter 4 of the thesis): from five stereo pairs to grasp points and grasped stalks.

masks       networks that segment stalks, and their training
perception  pairs and masks to stitched clouds and grasp points
arm         the arm's approach, control and reach, in simulation
evaluation  synthetic runs, attempts and their scores          report      figures 4.4 to 4.6, videos
pipeline    folders of pairs to tables
"""
