"""Figures 4.4 to 4.6 of the thesis for simulated runs, and videos of the arm."""
