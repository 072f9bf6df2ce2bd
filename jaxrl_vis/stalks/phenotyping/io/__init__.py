"""Input and output of the phenotyping application: images, pairs, calibrations, annotations, odometry."""
