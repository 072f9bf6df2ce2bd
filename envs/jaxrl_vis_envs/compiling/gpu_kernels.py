"""Pallas kernels (Triton) for NVIDIA GPUs, including cards that are missing from JAX's list.

JAX 0.11 lowers a kernel only if the GPU's name is in a list of some twenty, from which it reads the compute capability. A
GeForce RTX 3090 or an L40S is missing. Kernels for such a card are lowered under the name of a listed card of the same or the
next lower capability; XLA compiles them for the actual card in any case.
"""

import concurrent.futures
import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

# Compute capability -> a card in JAX 0.11's list.
_CARDS = {
    8.0: "NVIDIA A100",
    8.6: "NVIDIA A10",
    8.9: "NVIDIA L4",
    9.0: "NVIDIA H100",
    10.0: "NVIDIA B200",
    10.3: "NVIDIA B300",
    12.0: "NVIDIA RTX PRO 6000",
}
# Name of an installed card -> name under which to lower; None if none is needed or it does not help.
_substitutes: dict[str, str | None] = {}


def kernel_call(kernel: Callable[..., None], *, interpret: bool = False, **options: Any) -> Callable[..., Any]:
    """Wrap `jax.experimental.pallas.pallas_call`, with support for cards that are missing from JAX's list.

    Args:
        kernel: Function of input and output references.
        interpret: Run the kernel without a GPU, slowly.
        **options: Options of `pallas_call`.

    Returns:
        Function from input arrays to output arrays.
    """
    call = pl.pallas_call(kernel, interpret=interpret, **options)
    name = None if interpret else _substitute_name()
    if name is None:
        return call

    def describe_kernel(*arguments: Any) -> Any:
        with _lowering_as(name):
            return call(*arguments)

    return describe_kernel


def _substitute_name() -> str | None:
    """Return the card name under which to lower kernels for the first NVIDIA GPU; None for its own name."""
    if jax.__version_info__ < (0, 11):
        return None
    try:
        gpu = jax.devices("cuda")[0]
        capability = float(gpu.compute_capability)
    except (RuntimeError, AttributeError, TypeError, ValueError):  # no GPU, or not NVIDIA's
        return None
    if gpu.device_kind not in _substitutes:
        nearest = max((known for known in _CARDS if known <= capability), default=None)
        name = None if nearest is None else _CARDS[nearest]
        needs_name = name is not None and not _lowers(gpu, None) and _lowers(gpu, name)
        _substitutes[gpu.device_kind] = name if needs_name else None
    return _substitutes[gpu.device_kind]


@contextlib.contextmanager
def _lowering_as(name: str | None) -> Iterator[None]:
    """Trace for a card called ``name``, with unchanged mesh axes; None changes nothing."""
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
    """Return True if JAX lowers a kernel for a GPU under the card ``name``; None for its own."""

    def copy(source: Any, target: Any) -> None:
        target[...] = source[...]

    def lower() -> None:
        row = jax.ShapeDtypeStruct((32,), jnp.float32)
        call = pl.pallas_call(copy, out_shape=row, compiler_params=plgpu.CompilerParams(num_warps=1))
        with jax.default_device(gpu), _lowering_as(name):
            jax.jit(call).trace(row).lower(lowering_platforms=("cuda",))

    try:
        # This runs during unrelated traces; the current trace is thread-local.
        with concurrent.futures.ThreadPoolExecutor(1) as pool:
            pool.submit(lower).result()
    except Exception:  # JAX does not document the exception types
        return False
    return True
