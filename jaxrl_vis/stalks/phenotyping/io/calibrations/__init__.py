"""Readers of calibrations, one file a program: from what it writes to projection matrices or to cameras as they were built."""
