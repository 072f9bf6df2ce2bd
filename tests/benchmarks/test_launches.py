"""Counts of the operations of a program."""

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from benchmarks.profiling import launches


def test_operations_of_a_loop_count_once_per_iteration():
    def inner(x, _):
        return jnp.sin(x) @ x, None

    def outer(x, _):
        return jax.lax.scan(inner, x + 1.0, length=3)[0], None

    def program(x):
        once = x @ jnp.cos(x)
        return jax.lax.scan(outer, once, length=7)[0]

    text = jaxrl_vis_envs.jit(program).lower(jnp.ones((300, 300))).compile().as_text()
    outside, inside, iterations = launches.count_launches(text)
    assert iterations == 7
    assert inside["dot"] == inside["loop iteration"] == 3 and outside["dot"] == 1
    assert outside["open loop"] == inside["open loop"] == 0


def test_a_loop_whose_trip_count_depends_on_data_is_open():
    def program(x):
        return jax.lax.while_loop(lambda x: jnp.sum(x) < 1e9, lambda x: jnp.sin(x) @ x, x)

    outside, _, iterations = launches.count_launches(
        jaxrl_vis_envs.jit(program).lower(jnp.ones((300, 300))).compile().as_text()
    )
    assert iterations == 1 and outside["open loop"] == 1
