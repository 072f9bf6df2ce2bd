"""Sightings of stalks, followed from pair to pair along a plot."""
