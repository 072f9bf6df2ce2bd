"""The fast path on an NVIDIA GPU: the whole image as one `kernel`."""
