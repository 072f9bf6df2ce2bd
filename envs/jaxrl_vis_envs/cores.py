"""How many processor cores there are to use."""

import os


def num_cores() -> int:
    """Cores that this process may use: of the machine, or those that it is confined to."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
