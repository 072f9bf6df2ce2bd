"""Host code of a run: trainer, loop, folder, checkpoints, metrics, memory, signals."""
