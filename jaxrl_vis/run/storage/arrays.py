"""Conversion of arrays for checkpoints and back: names, checksums, placement and comparison.

With several processes, each writes its own parts, so checksums are combined from those of the parts.
"""

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import distributed
from jaxrl_vis.learner.parallel.sharding import put_array

Arrays = dict[str, np.ndarray]


def named_leaves(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by name, such as ``actor.head.output.kernel``."""
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in jax.tree.leaves_with_path(tree)}


def to_host(tree: Any, copy: bool) -> Arrays:
    """Convert the leaves of a pytree to NumPy arrays by name, and typed keys to their key data (uint32).

    Args:
        tree: Arrays on a device.
        copy: Whether to copy. If not, arrays on one CPU device with a dtype that NumPy has are views of the device's memory: a
            view is valid only until the arrays are donated, and while one exists, the next donation makes a copy.
    """

    def convert(leaf: jax.Array) -> np.ndarray:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        if copy or jax.default_backend() != "cpu":
            return np.array(leaf)
        try:
            return np.from_dlpack(leaf)  # pyright: ignore[reportArgumentType]
        except (BufferError, RuntimeError, TypeError):  # a dtype that NumPy lacks, or several devices
            return np.array(leaf)

    return {name: convert(leaf) for name, leaf in named_leaves(tree).items()}


def _checksum(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)


def describe(arrays: dict[str, Any]) -> dict[str, list]:
    """Describe arrays for a manifest, by name: [shape, dtype, checksum]; with several processes see `_describe_parts`."""
    if distributed.is_multi_process():
        return _describe_parts(arrays)
    return {name: [list(array.shape), str(array.dtype), _checksum(array)] for name, array in arrays.items()}


def saved_leaves(tree: Any, copy: bool) -> Arrays | dict[str, jax.Array]:
    """Return the leaves of a pytree by name, as saved by orbax: the arrays of `to_host`.

    With several processes, these are the arrays on devices instead, of which each process writes its own shards.
    """
    if not distributed.is_multi_process():
        return to_host(tree, copy)
    return {
        name: jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        for name, leaf in named_leaves(tree).items()
    }


def _describe_parts(arrays: dict[str, jax.Array]) -> dict[str, list]:
    """Describe arrays distributed over processes, by name: [shape, dtype, checksum, ``axes`` of `_row_checksum`].

    A collective call: each process adds up the checksums of its own shards, and the manifest has the total.
    """
    axes = {
        name: max((n + 1 for n, on in enumerate(_partition_spec(array)) if on), default=0) for name, array in arrays.items()
    }
    sums = np.zeros(len(arrays), np.uint32)
    for number, (name, array) in enumerate(arrays.items()):
        for shard in array.addressable_shards:
            if shard.replica_id == 0:
                start = [part.start or 0 for part in shard.index[: axes[name]]]
                sums[number] += np.uint32(_row_checksum(np.asarray(shard.data), axes[name], start))
    totals = multihost_utils.process_allgather(sums).astype(np.uint64).sum(axis=0) % 2**32
    return {
        name: [list(array.shape), str(array.dtype), int(total), axes[name]]
        for (name, array), total in zip(arrays.items(), totals, strict=True)
    }


def _partition_spec(array: jax.Array) -> Sequence[Any]:
    return getattr(array.sharding, "spec", ())


def _row_checksum(array: np.ndarray, axes: int, start: Sequence[int] = ()) -> int:
    """Compute a checksum that is additive over parts: the sum of the rows' checksums, each seeded with the row's position.

    Args:
        array: A part of an array.
        axes: Number of leading axes that index rows.
        start: Position of the part along these axes; empty for a whole array.
    """
    total = 0
    for index in np.ndindex(array.shape[:axes]):
        place = np.add(index, start) if len(start) else np.asarray(index)
        total += zlib.crc32(
            np.ascontiguousarray(array[index]).reshape(-1).view(np.uint8).data, zlib.crc32(place.astype("<i8").tobytes())
        )
    return total % 2**32


def is_intact(array: np.ndarray, described: list) -> bool:
    """Return True if an array has the checksum of its description in the manifest (`describe`)."""
    _, _, checksum, *axes = described
    return checksum == (_row_checksum(array, axes[0]) if axes else _checksum(array))


def _is_folded(first: Sequence[int], second: Sequence[int]) -> bool:
    """Return True for shapes [S, rollouts, E, ...] and [S, rollouts * E, ...] of the same episodes (`sharding.Layout`)."""
    (seeds, *rest), (other_seeds, *unfolded) = sorted((tuple(first), tuple(second)), key=len)
    return len(unfolded) >= 2 and seeds == other_seeds and rest == [unfolded[0] * unfolded[1], *unfolded[2:]]


def restore_target(shape: Sequence[int], expected: jax.ShapeDtypeStruct) -> Any:
    """Return orbax's restore target for an array that was saved with ``shape``.

    This is ``expected`` if it has that shape and lies on a single device, else a NumPy array of the saved shape, which is
    restored on the host and distributed later.
    """
    if tuple(shape) == expected.shape and isinstance(expected.sharding, jax.sharding.SingleDeviceSharding):
        return expected
    return np.broadcast_to(np.zeros((), expected.dtype), tuple(shape))


def host_specs(tree: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the specs of the arrays that `to_host` makes, on the first device unless the leaves define a sharding."""
    first = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])

    def convert(leaf: Any) -> jax.ShapeDtypeStruct:
        device = getattr(leaf, "sharding", None) or first
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.eval_shape(jax.random.key_data, leaf)
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=device)

    return {name: convert(leaf) for name, leaf in named_leaves(tree).items()}


def rebuild(template: Any, arrays: dict[str, jax.Array]) -> Any:
    """Invert `to_host`: build a tree like ``template``, which also defines where its arrays are placed."""

    def convert(path: Any, leaf: Any) -> jax.Array:
        array, sharding = arrays[jax.tree_util.keystr(path, simple=True, separator=".")], getattr(leaf, "sharding", None)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            # The default key type, as in `Trainer.run_keys`; another type has key data of another size, which is detected
            # earlier.
            array = jax.random.wrap_key_data(jnp.asarray(array))
        elif array.shape != leaf.shape:
            array = array.reshape(leaf.shape)
        if sharding is None:
            return jnp.asarray(array)
        return put_array(array, sharding)

    return jax.tree.map_with_path(convert, template)


def check_structure(where: Path, saved: dict[str, list], expected: dict[str, jax.ShapeDtypeStruct]) -> None:
    """Raise RequestError, naming the first differences, if a checkpoint has other arrays than this program."""
    differences = []
    for name in sorted(set(saved) | set(expected)):
        stored = f"{saved[name][1]}{saved[name][0]}" if name in saved else "nothing"
        required = f"{expected[name].dtype}{list(expected[name].shape)}" if name in expected else "nothing"
        if stored != required and name.startswith("replay.episodes.") and name in saved and name in expected:
            if saved[name][1] == str(expected[name].dtype) and _is_folded(saved[name][0], expected[name].shape):
                continue
        if stored != required:
            differences.append(f"{name} is {stored} there and {required} here")
    if differences:
        shown = "; ".join(differences[:3]) + (f"; and {len(differences) - 3} more" if len(differences) > 3 else "")
        raise RequestError(f"{where} has another structure, so another version wrote it: {shown}; use that, or --overwrite")
