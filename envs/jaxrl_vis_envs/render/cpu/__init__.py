"""The fast path on a CPU: `passes` over the pixels, one tile after the other (`tiles`)."""
