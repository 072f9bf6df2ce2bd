"""Several devices: placement of seeds and shards, and communication between shards."""
