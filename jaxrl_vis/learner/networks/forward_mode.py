"""Forward-mode differentiation through operations with custom reverse-mode rules.

`jax.custom_vjp` defines reverse-mode differentiation only. While traced, such functions call `is_active`: inside
`with_tangents` they use plain JAX, which supports both modes.
"""

import contextlib
from collections.abc import Iterator

import jax

# Part of JAX's tracing cache key, so that a function traced outside the context is traced again inside.
_wanted = jax.make_user_context(default_value=False)


@contextlib.contextmanager
def with_tangents() -> Iterator[None]:
    """Trace the code in this context so that `jax.jvp` can differentiate it."""
    with _wanted(True):
        yield


def is_active() -> bool:
    """Return True inside `with_tangents`, where the current trace must support forward mode."""
    return bool(_wanted.value)
