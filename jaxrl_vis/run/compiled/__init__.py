"""Compiled programs of a run: how they are made, kept, called, and checked against the memory there is."""
