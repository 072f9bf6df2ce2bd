"""Kernels of the encoder and of decoders for NVIDIA GPUs, and the same functions in plain JAX."""
