"""The grasping arm in simulation: choice of an approach, control, and reaches among stalks in wind."""
