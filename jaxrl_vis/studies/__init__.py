"""Studies: the runs and drawings behind the figures."""
