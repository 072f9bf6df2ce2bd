"""Compiled programs of a run: compilation, caching, calls, and memory checks."""
