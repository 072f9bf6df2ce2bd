"""Counts of the operations of a program."""

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from benchmarks.profiling import launches


def test_operations_of_a_loop_count_as_often_as_it_turns():
    def inner(x, _):
        return jnp.sin(x) @ x, None

    def outer(x, _):
        return jax.lax.scan(inner, x + 1.0, length=3)[0], None

    def program(x):
        once = x @ jnp.cos(x)
        return jax.lax.scan(outer, once, length=7)[0]

    text = jaxrl_vis_envs.jit(program).lower(jnp.ones((300, 300))).compile().as_text()
    outside, inside, turns = launches.count_launches(text)
    assert turns == 7
    assert inside["dot"] == inside["turn of a loop"] == 3 and outside["dot"] == 1
    assert outside["open loop"] == inside["open loop"] == 0


def test_a_loop_whose_turns_depend_on_data_is_said_to_be_open():
    def program(x):
        return jax.lax.while_loop(lambda x: jnp.sum(x) < 1e9, lambda x: jnp.sin(x) @ x, x)

    outside, _, turns = launches.count_launches(jaxrl_vis_envs.jit(program).lower(jnp.ones((300, 300))).compile().as_text())
    assert turns == 1 and outside["open loop"] == 1
