"""Simulation of the grasping arm: choice of an approach, control, and reaches among stalks in wind."""
