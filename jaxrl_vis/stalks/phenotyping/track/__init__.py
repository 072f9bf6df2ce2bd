"""Sightings of stalks in stereo pairs, and their tracking from pair to pair along a plot."""
