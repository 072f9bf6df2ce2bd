"""Two designs of a GPU kernel for triangle meshes, beside MuJoCo Warp, for one decision: see docs/lab/meshes.md. Thrown away afterwards."""
