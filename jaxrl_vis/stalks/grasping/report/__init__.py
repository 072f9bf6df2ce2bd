"""Figures 4.4 to 4.6 of the thesis, and videos of the arm."""
