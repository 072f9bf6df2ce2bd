"""Operations with rules of their own for the way back, and how to differentiate forwards through them all the same.

`jax.custom_vjp` gives a function a gradient and no tangent. Such functions ask `are_wanted` as they are traced, and inside of
`with_tangents` are what they compute, in plain JAX, which has both.
"""

import contextlib
from collections.abc import Iterator

import jax

# Part of what JAX knows a traced function by, so that one which was traced outside is traced again inside.
_wanted = jax.make_user_context(default_value=False)


@contextlib.contextmanager
def with_tangents() -> Iterator[None]:
    """Trace what is inside so that `jax.jvp` can differentiate it."""
    with _wanted(True):
        yield


def are_wanted() -> bool:
    """Return True if what is being traced must have tangents."""
    return bool(_wanted.value)
