"""Reads a MuJoCo model into arrays, once for each scene. NumPy only.

`reading` (colours, lights, what cannot be drawn), `cameras` (lenses and what they are fixed to), `meshes` (triangles in small
clusters) and `textures` (one atlas of all images at all resolutions).
"""
