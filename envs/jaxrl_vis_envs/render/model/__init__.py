"""Reads a MuJoCo model into arrays, once for each scene. NumPy only.

`reading` (colours, lights, lens, what cannot be drawn), `meshes` (triangles in small clusters) and `textures` (one atlas of all
images at all resolutions).
"""
