"""Stalks from stereo images (chapter 3 of the thesis): how many stand in a plot, and how thick they are, in millimetres.

io          files: images, pairs, calibrations, annotations, odometry
detector    networks that find and outline stalks              training    how they learn
measure     a mask and a pair to a width in millimetres        track       sightings in several pairs to stalks
report      tables, overlays, the page qc.html, figures        evaluation  synthetic plots and scores against their truth
pipeline    folders of pairs to a report
"""
