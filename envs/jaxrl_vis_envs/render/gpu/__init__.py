"""Fast path on an NVIDIA GPU: the whole image in one `kernel`."""
