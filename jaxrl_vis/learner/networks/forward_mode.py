"""Forward-mode differentiation through operations with custom reverse-mode rules.

`jax.custom_vjp` gives a function a gradient and no tangent. While traced, such functions call `are_wanted`; inside
`with_tangents` they use plain JAX, which has both modes.
"""

import contextlib
from collections.abc import Iterator

import jax

# Part of what JAX knows a traced function by, so that one which was traced outside is traced again inside.
_wanted = jax.make_user_context(default_value=False)


@contextlib.contextmanager
def with_tangents() -> Iterator[None]:
    """Trace the context so that `jax.jvp` can differentiate it."""
    with _wanted(True):
        yield


def are_wanted() -> bool:
    """Return True if the current trace needs tangents."""
    return bool(_wanted.value)
