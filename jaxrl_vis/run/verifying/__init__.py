"""Verification of a run's files and numbers."""
