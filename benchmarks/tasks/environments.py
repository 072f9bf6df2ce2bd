"""Tasks played from the host, by two compiled programs each that serve any number of episodes.

The physics of a task takes much longer to compile than to play for a few episodes. Whoever plays it for different purposes
(a controller, a recording, a test) shares these programs: they take `LANES` episodes at a time, and the last few are filled up
with copies.
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
from jaxrl_vis_envs.compilation import env_jit
from jaxrl_vis_envs.physics import mjx_model

LANES = 16


def make(name: str, **overrides: Any) -> Any:
    """`jaxrl_vis_envs.make`, but the same environment for the same settings, so that its programs are compiled once."""
    return _make(name, registry.config_class(name)(**overrides))


@functools.cache
def _make(name: str, config: Any) -> Any:
    return jaxrl_vis_envs.make(name, **{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})


def reset(env: Any, keys: jax.Array) -> tuple[State, Any]:
    """Episodes at their start, and the configurations (`mjx.Data`) that their goals show; keys [N]."""
    return _in_lanes(_reset_program(env), keys)


def advance(env: Any, state: State, actions: Any) -> State:
    """N episodes one control step later; actions [N, A]."""
    # Observations are nothing to physics, and with or without them would be two programs.
    moved = _in_lanes(_advance_program(env), state.replace(obs=None), np.asarray(actions, np.float32))
    return moved.replace(obs=state.obs)


def start_at(env: Any, qpos: Any, qvel: Any) -> State:
    """Episodes that start with joint positions [N, nq] and velocities [N, nv]; their goals are nonsense.

    Poses, and what is derived from them, are right from the first `advance` on.
    """
    still = jax.device_get(mjx_model.still_data(env.mj_model))
    still = jax.tree.map(lambda leaf: np.tile(leaf, (len(qpos), *(1,) * leaf.ndim)), still)
    data = still.replace(qpos=np.asarray(qpos, np.float32), qvel=np.asarray(qvel, np.float32))
    begin = env_jit(jax.vmap(lambda data: env.state_at(data, jnp.zeros_like(env.achieved(data)))))
    return jax.device_get(begin(data))  # as `_in_lanes` gives states: for what lies on a device, programs are compiled twice


@functools.cache
def _reset_program(env: Any) -> Callable:
    def start(key: jax.Array) -> tuple[State, Any]:
        goal = env.sample_goal(key)
        knowing = copy.copy(env)  # what takes long to trace is traced once
        knowing.sample_goal = lambda _: goal
        return knowing.reset(key), goal

    return env_jit(jax.vmap(start))


@functools.cache
def _advance_program(env: Any) -> Callable:
    return env_jit(jax.vmap(env.advance))


def _in_lanes(program: Callable, *trees: Any) -> Any:
    """``program`` on [N, ...] leaves, LANES rows at a time; the results are NumPy arrays, of which rows are taken quickly."""
    count = len(jax.tree.leaves(trees)[0])
    parts = []
    for first in range(0, count, LANES):
        rows = np.minimum(np.arange(first, first + LANES), count - 1)
        parts.append(jax.device_get(program(*jax.tree.map(lambda leaf, rows=rows: leaf[rows], trees))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
