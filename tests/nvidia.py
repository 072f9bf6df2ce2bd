"""Programs for NVIDIA GPUs, traced and lowered without one."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax


@contextlib.contextmanager
def described_nvidia() -> Iterator[None]:
    """Says which GPU programs are for. JAX 0.11 asks that before it lowers a kernel; 0.10 neither asks nor can be told."""
    if jax.__version_info__ < (0, 11):
        yield
        return
    sharding: Any = jax.sharding
    device = sharding.AbstractDevice("NVIDIA H100 80GB HBM3", None, "gpu")
    with sharding.use_abstract_mesh(sharding.AbstractMesh((), (), abstract_device=device)):
        yield


def lowered_for_nvidia(trace: Callable[[], Any]) -> str:
    """What a program (`jax.stages.Traced`) is lowered to; ``trace`` makes it."""
    with described_nvidia():
        return trace().lower(lowering_platforms=("cuda",)).as_text()
