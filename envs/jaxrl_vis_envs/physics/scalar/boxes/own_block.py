"""Parts of a kernel in blocks of their own, so that it compiles faster."""

from collections.abc import Callable
from typing import Any

import jax


def in_own_block(compute: Callable[[Any], Any], inputs: Any, nothing: Any) -> Any:
    """Call a function in a loop of one turn, which is no longer there in machine code.

    For each selection, Triton visits all operations that the selection depends on, up to the arguments of its block. Without
    blocks in between, the hundreds of selections in a step had it visit the whole step as often, which was two thirds of the
    time to compile the kernel.

    Args:
        compute: The function.
        inputs: Its argument, a tree of arrays and of constants, which it has to get from nowhere else.
        nothing: Tree of zeros with the structure of its result.
    """
    leaves, structure = jax.tree.flatten(inputs)
    is_array = [hasattr(leaf, "shape") for leaf in leaves]
    arrays = [leaf for leaf, varies in zip(leaves, is_array, strict=True) if varies]
    # What a loop does not change would not remain an argument of its block.
    zeros = [0.0 * array for array in arrays]

    def turn(state: tuple[Any, list[Any], Any]) -> tuple[Any, list[Any], Any]:
        number, arrays, _ = state
        rest = iter(arrays)
        values = [next(rest) if varies else leaf for leaf, varies in zip(leaves, is_array, strict=True)]
        return number + 1, zeros, compute(jax.tree.unflatten(structure, values))

    return jax.lax.while_loop(lambda state: state[0] < 1, turn, (0, arrays, nothing))[2]
