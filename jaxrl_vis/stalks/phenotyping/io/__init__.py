"""Files of the phenotyping application: images, pairs, calibrations, annotations, odometry."""
