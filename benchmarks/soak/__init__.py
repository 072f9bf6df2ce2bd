"""Random faults over small real runs; see `__main__`."""
