"""Number of available processor cores."""

import os


def num_cores() -> int:
    """Return the number of cores this process may use, respecting its CPU affinity."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
