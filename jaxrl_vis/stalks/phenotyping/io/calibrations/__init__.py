"""Calibration readers, one module per program: they return projection matrices or unrectified camera parameters."""
