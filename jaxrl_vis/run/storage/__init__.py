"""Files of a run: folder, lock, checkpoints, metrics."""
