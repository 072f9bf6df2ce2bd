"""Compilation: `jit` with the options that physics needs, dispatch by platform, GPU kernels, and the import of MJX.

compilation   compiler options, `jit`, target platforms, and the choice between GPU kernels and plain JAX
gpu_kernels   launching Pallas kernels on NVIDIA GPUs
mjx_imports   import hook that makes MJX import faster
"""
