"""Designs of a GPU kernel for triangle meshes, beside MuJoCo Warp, for one decision (docs/lab/meshes.md); deleted after it."""
