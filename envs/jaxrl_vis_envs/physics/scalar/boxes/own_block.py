"""Control-flow blocks around parts of a kernel, which make it compile faster."""

from collections.abc import Callable
from typing import Any

import jax


def in_own_block(compute: Callable[[Any], Any], inputs: Any, initial: Any) -> Any:
    """Call a function inside a loop of one iteration, which does not remain in the machine code.

    For each selection, Triton visits all operations that the selection depends on, up to the arguments of its block. Without
    blocks in between, it would visit the whole step for each of the hundreds of selections in it, which took two thirds of the
    time to compile the kernel.

    Args:
        compute: The function; it must not capture traced arrays.
        inputs: Its argument, a tree of arrays and of constants.
        initial: Tree of zeros with the structure, shapes and dtypes of its result.

    Returns:
        The result of ``compute``.
    """
    leaves, structure = jax.tree.flatten(inputs)
    is_array = [hasattr(leaf, "shape") for leaf in leaves]
    arrays = [leaf for leaf, varies in zip(leaves, is_array, strict=True) if varies]
    # Values that a loop does not change would not remain arguments of its block.
    zeros = [0.0 * array for array in arrays]

    def iterate(state: tuple[Any, list[Any], Any]) -> tuple[Any, list[Any], Any]:
        number, arrays, _ = state
        rest = iter(arrays)
        values = [next(rest) if varies else leaf for leaf, varies in zip(leaves, is_array, strict=True)]
        return number + 1, zeros, compute(jax.tree.unflatten(structure, values))

    return jax.lax.while_loop(lambda state: state[0] < 1, iterate, (0, arrays, initial))[2]
