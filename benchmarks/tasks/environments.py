"""Tasks stepped from the host, with two compiled programs each that serve any number of episodes.

The physics of a task takes much longer to compile than to run for a few episodes. All users in a process (controllers,
recordings, tests) share these programs: they process `LANES` episodes at a time, and the last batch is padded with copies.
"""

import copy
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.base import State
from jaxrl_vis_envs.compiling.compilation import compiler_options
from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.tasks.fetch_push import FetchPush

LANES = 16


def make(name: str, **overrides: Any) -> Any:
    """Make or reuse the environment of these settings (`jaxrl_vis_envs.make`), so that its programs are compiled once."""
    return _make(name, registry.config_class(name)(**overrides))


@functools.cache
def _make(name: str, config: Any) -> Any:
    return jaxrl_vis_envs.make(name, **{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})


def reset(env: Any, keys: jax.Array) -> tuple[State, Any]:
    """Reset N episodes with typed keys [N]; return their states, and the configurations (`mjx.Data`) of their goals."""
    return _map_over_lanes(_reset_program(env), keys)


def advance(env: Any, state: State, actions: Any) -> State:
    """Advance N episodes by one control step with actions [N, A]; observations are left unchanged (and thus stale)."""
    # Physics does not need observations; states with and without them would need separate programs.
    moved = _map_over_lanes(_advance_program(env), state.replace(obs=None), np.asarray(actions, np.float32))
    return moved.replace(obs=state.obs)


def start_at(env: Any, qpos: Any, qvel: Any) -> State:
    """Return states with joint positions [N, nq] and velocities [N, nv]; their goals are meaningless.

    Poses and derived quantities are valid only after the first `advance`.
    """
    still = jax.device_get(mjx_model.rest_data(env.mj_model))
    still = jax.tree.map(lambda leaf: np.tile(leaf, (len(qpos), *(1,) * leaf.ndim)), still)
    data = still.replace(qpos=np.asarray(qpos, np.float32), qvel=np.asarray(qvel, np.float32))
    begin = jaxrl_vis_envs.jit(jax.vmap(lambda data: env.state_at(data, jnp.zeros_like(env.achieved(data)))))
    return jax.device_get(begin(data))  # on the host, as from `_map_over_lanes`: device arrays would compile the programs again


@functools.cache
def _reset_program(env: Any) -> Callable:
    def start(key: jax.Array) -> tuple[State, Any]:
        goal = env.sample_goal(key)
        knowing = copy.copy(env)  # the goal, which takes long to trace, is traced once
        knowing.sample_goal = lambda _: goal
        return knowing.reset(key), goal

    return jaxrl_vis_envs.jit(jax.vmap(start))


@functools.cache
def _advance_program(env: Any) -> Callable:
    options = compiler_options()
    if jax.default_backend() == "cpu" and isinstance(env, FetchPush):
        # Its steps run so long that optimising the code pays even in tests, whose flags turn it off; optimising it further does
        # not make it faster.
        options["xla_backend_optimization_level"] = 1
    return jax.jit(jax.vmap(env.advance), compiler_options=options)


def _map_over_lanes(program: Callable, *trees: Any) -> Any:
    """Apply ``program`` to [N, ...] leaves, LANES rows at a time; return NumPy arrays, which are fast to index."""
    count = len(jax.tree.leaves(trees)[0])
    parts = []
    for first in range(0, count, LANES):
        rows = np.minimum(np.arange(first, first + LANES), count - 1)
        parts.append(jax.device_get(program(*jax.tree.map(lambda leaf, rows=rows: leaf[rows], trees))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
