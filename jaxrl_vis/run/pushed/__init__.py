"""Publication of runs: a folder with card, curve, video, configuration and weights, local or on a hub."""
