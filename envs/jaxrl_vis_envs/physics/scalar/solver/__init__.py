"""Solver of constraint forces: friction cones, line search, Newton's method."""
