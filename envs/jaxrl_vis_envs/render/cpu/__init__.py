"""Fast path on a CPU: `passes` over the pixels, tile by tile (`tiles`)."""
