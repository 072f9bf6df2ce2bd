"""Counts and widths of the stalks of a plot, in millimetres, from stereo images (chapter 3 of the thesis).

io          files: images, pairs, calibrations, annotations, odometry
detector    networks that detect and segment stalks            training    training of the networks
measure     a mask and a pair to a width in millimetres        track       sightings in several pairs to stalks
report      tables, overlays, the page qc.html, figures        evaluation  synthetic plots and scores against ground truth
pipeline    folders of pairs to a report
"""
