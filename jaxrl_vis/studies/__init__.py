"""Studies: what is computed, and drawn, for one figure."""
