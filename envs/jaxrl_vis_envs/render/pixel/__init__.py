"""The mathematics of an image in plain JAX. It runs on any backend, is differentiable, and defines what the fast paths compute.

In the order in which an image is made: `shapes` and `lights` once per environment; `blocks` cuts the image into blocks of
pixels; `raycast` and `triangles` find the nearest object of each pixel; `surface`, `charts` and `sampling` find depth, normal
and texture there; `shade` and `transparent` give it its colour. `arithmetic` holds single operations.
"""
