"""Matrix products whose kernel gradients have the memory layout of the kernel, for the optimiser."""

import jax

from jaxrl_vis.learner.networks import forward_mode


def product(values: jax.Array, kernel: jax.Array) -> jax.Array:
    """Compute ``values @ kernel`` for [..., M, K] and [..., K, N]."""
    return values @ kernel if forward_mode.is_active() else _product_with_gradient(values, kernel)


@jax.custom_vjp
def _product_with_gradient(values: jax.Array, kernel: jax.Array) -> jax.Array:
    return values @ kernel


def _backward(residuals: tuple[jax.Array, jax.Array], gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    values, kernel = residuals
    # JAX's own rule computes the transpose of the kernel's gradient, which the optimiser then reads with strides.
    batch = tuple(range(values.ndim - 2))
    rows, columns = len(batch), len(batch) + 1
    kernel_gradient = jax.lax.dot_general(values, gradient, (((rows,), (rows,)), (batch, batch)))
    return jax.lax.dot_general(gradient, kernel, (((columns,), (columns,)), (batch, batch))), kernel_gradient


_product_with_gradient.defvjp(lambda values, kernel: (values @ kernel, (values, kernel)), _backward)
