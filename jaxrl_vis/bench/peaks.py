"""Peak performance of devices from their data sheets."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Peak:
    """Peak performance of a device: dense matrix products without sparsity, other arithmetic, and memory.

    Attributes:
        bfloat16: Floating-point operations per second in matrix products of bfloat16 inputs.
        float32: Floating-point operations per second in matrix products of float32 inputs (TF32, the default of XLA).
        vector: Single-precision operations per second outside the matrix units.
        memory: Memory bandwidth in bytes per second.
    """

    bfloat16: float
    float32: float
    vector: float
    memory: float


# A device's entry is the longest name that is a prefix of its kind.
PEAKS = {
    "NVIDIA H100 80GB HBM3": Peak(989e12, 494e12, 67e12, 3.35e12),
    "NVIDIA H100 PCIe": Peak(756e12, 378e12, 51e12, 2.0e12),
    "NVIDIA H200": Peak(989e12, 494e12, 67e12, 4.8e12),
    "NVIDIA A100-SXM4-80GB": Peak(312e12, 156e12, 19.5e12, 2.04e12),
    "NVIDIA A100-SXM4-40GB": Peak(312e12, 156e12, 19.5e12, 1.56e12),
}


def device_peak(device_kind: str) -> Peak | None:
    """Return the peak performance of a device; None if unknown."""
    names = [name for name in PEAKS if device_kind.startswith(name)]
    return PEAKS[max(names, key=len)] if names else None
