"""Measurement of one stalk in one stereo pair: edges, disparity, ground plane, and diameter in millimetres."""
