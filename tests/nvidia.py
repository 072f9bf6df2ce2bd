"""Tracing and lowering of programs for NVIDIA GPUs, without a GPU."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax


@contextlib.contextmanager
def described_nvidia() -> Iterator[None]:
    """Declare within the context the GPU that programs are lowered for, as JAX 0.11 requires for kernels; JAX 0.10 does not."""
    if jax.__version_info__ < (0, 11):
        yield
        return
    sharding: Any = jax.sharding
    device = sharding.AbstractDevice("NVIDIA H100 80GB HBM3", None, "gpu")
    with sharding.use_abstract_mesh(sharding.AbstractMesh((), (), abstract_device=device)):
        yield


def lowered_for_nvidia(trace: Callable[[], Any]) -> str:
    """Return the text of a program lowered for CUDA; ``trace`` returns its `jax.stages.Traced`."""
    with described_nvidia():
        return trace().lower(lowering_platforms=("cuda",)).as_text()
