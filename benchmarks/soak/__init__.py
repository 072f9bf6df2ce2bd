"""Random faults injected into small real runs; see `__main__`."""
