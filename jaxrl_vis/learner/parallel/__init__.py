"""Several devices: placement of seeds and shards, and what shards tell each other."""
