"""Per-pixel mathematics of an image in plain JAX: runs on any backend, is differentiable, and is the reference for the fast
paths.

In the order of rendering: `shapes` and `lights` once per environment; `blocks` splits the image into blocks of pixels;
`raycast` and `triangles` find the nearest object of each pixel; `surface`, `charts` and `sampling` compute depth, normal and
texture there; `shade` and `transparent` compute its colour. `arithmetic` holds single operations.
"""
