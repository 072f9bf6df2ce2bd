"""Input tables: odometry and field plans."""
