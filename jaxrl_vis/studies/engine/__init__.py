"""Engine of studies: a grid of runs, its cells, schedulers and results."""
