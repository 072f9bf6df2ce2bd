"""Conversion of a MuJoCo model to arrays, once per scene. NumPy only.

`reading` (colours, lights, unsupported objects), `cameras` (lenses and mounts), `meshes` (triangles in small clusters) and
`textures` (one atlas of all images at all mipmap levels).
"""
