"""Kernels for NVIDIA GPUs (Pallas, by Triton), also for cards that JAX does not know by their names.

JAX 0.11 lowers a kernel only where it finds the GPU's name in a list of some twenty, for the sake of its compute capability. A
GeForce RTX 3090 or an L40S is not there. Such a card is called by the name of one that is, of the same capability or the next
lower one: XLA compiles the kernel for the card itself in any case.
"""

import concurrent.futures
import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

# Compute capability -> a card that JAX 0.11 knows.
_CARDS = {
    8.0: "NVIDIA A100",
    8.6: "NVIDIA A10",
    8.9: "NVIDIA L4",
    9.0: "NVIDIA H100",
    10.0: "NVIDIA B200",
    10.3: "NVIDIA B300",
    12.0: "NVIDIA RTX PRO 6000",
}
# Name of the card that is here -> what it is called; None where nothing need be said, or nothing helps.
_called: dict[str, str | None] = {}


def kernel_call(kernel: Callable[..., None], *, interpret: bool = False, **options: Any) -> Callable[..., Any]:
    """`jax.experimental.pallas.pallas_call`.

    Args:
        kernel: Reads and writes references.
        interpret: Run the kernel without a GPU, slowly.
        **options: Of `pallas_call`.

    Returns:
        The function from arrays to arrays.
    """
    call = pl.pallas_call(kernel, interpret=interpret, **options)
    name = None if interpret else _stand_in()
    if name is None:
        return call

    def described(*arguments: Any) -> Any:
        with _calling_it(name):
            return call(*arguments)

    return described


def _stand_in() -> str | None:
    """What the first NVIDIA GPU is called, so that JAX knows it; None: what it is."""
    if jax.__version_info__ < (0, 11):
        return None
    try:
        gpu = jax.devices("cuda")[0]
        capability = float(gpu.compute_capability)
    except (RuntimeError, AttributeError, TypeError, ValueError):  # none there, or another maker's
        return None
    if gpu.device_kind not in _called:
        likest = max((known for known in _CARDS if known <= capability), default=None)
        name = None if likest is None else _CARDS[likest]
        needs_name = name is not None and not _lowers(gpu, None) and _lowers(gpu, name)
        _called[gpu.device_kind] = name if needs_name else None
    return _called[gpu.device_kind]


@contextlib.contextmanager
def _calling_it(name: str | None) -> Iterator[None]:
    """What is traced inside is for the card of that name; axes of devices stay what they are."""
    if name is None:
        yield
        return
    sharding: Any = jax.sharding  # JAX 0.10 has other arguments
    mesh = sharding.get_abstract_mesh()
    device = sharding.AbstractDevice(name, None, "gpu")
    with sharding.use_abstract_mesh(
        sharding.AbstractMesh(mesh.axis_sizes, mesh.axis_names, mesh.axis_types, abstract_device=device)
    ):
        yield


def _lowers(gpu: Any, name: str | None) -> bool:
    """Whether JAX lowers a kernel for a GPU that is called so."""

    def copy(source: Any, target: Any) -> None:
        target[...] = source[...]

    def lower() -> None:
        row = jax.ShapeDtypeStruct((32,), jnp.float32)
        call = pl.pallas_call(copy, out_shape=row, compiler_params=plgpu.CompilerParams(num_warps=1))
        with jax.default_device(gpu), _calling_it(name):
            jax.jit(call).trace(row).lower(lowering_platforms=("cuda",))

    try:
        # Asked while something else is traced, of which this is no part: what is being traced is a thread's own.
        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            pool.submit(lower).result()
    except Exception:  # JAX's own, which are not documented
        return False
    return True
