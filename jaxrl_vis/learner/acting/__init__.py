"""Rollouts, whole or in parts, and evaluations."""
