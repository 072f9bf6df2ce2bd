"""Recordings of the original environments, played through ours.

tests/data/fetch_reach.npz: six sequences of 50 actions and grip positions of Gymnasium-Robotics' FetchReach.
tests/data/reacher.npz: six sequences of 50 actions and joint angles of Gymnasium's Reacher (torque control).
"""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis_envs.compilation import world_jit

DATA = pathlib.Path(__file__).parent / "data"


def test_fetch_reach_follows_the_recording():
    recording = np.load(DATA / "fetch_reach.npz")
    env = jaxrl_vis_envs.make("FetchReach")

    def play(actions):
        def step(state, action):
            state = env.advance(state, action)
            return state, state.achieved_state

        start = env.reset(jax.random.key(0))
        return start.achieved_state, jax.lax.scan(step, start, actions)[1]

    start, positions = world_jit(jax.vmap(play))(jnp.asarray(recording["actions"]))
    positions = np.concatenate([np.asarray(start)[:, None], positions], axis=1)
    recorded = recording["grip_pos_m"]
    # Only while the grip has not yet left the box around its start (goals lie within .15 m): farther out the arm stretches,
    # swings through the table's edge or its own base, and tells little about the task.
    is_outside = (np.abs(recorded - recorded[:, :1]) > 0.25).any(axis=-1)
    is_inside = np.cumsum(is_outside, axis=1) == 0
    error = np.linalg.norm(positions - recorded, axis=-1)[is_inside]
    assert is_inside.sum() > 150
    assert np.median(error) < 0.005
    assert np.percentile(error, 99) < 0.015


def test_reacher_torque_follows_the_recording():
    recording = np.load(DATA / "reacher.npz")
    env = jaxrl_vis_envs.make("Reacher", control="torque")

    def play(qpos, qvel, actions):
        start = env.reset(jax.random.key(0))
        start = start.replace(data=env.configuration(qpos).replace(qvel=qvel))

        def step(state, action):
            state = env.advance(state, action)
            return state, (state.data.qpos, state.achieved_state)

        return jax.lax.scan(step, start, actions)[1]

    start = (jnp.asarray(recording["qpos_rad"][:, 0]), jnp.asarray(recording["qvel_rad_s"][:, 0]))
    qpos, fingertip = world_jit(jax.vmap(play))(*start, jnp.asarray(recording["actions"]))
    error = np.abs(np.asarray(qpos) - recording["qpos_rad"][:, 1:])
    print("median, 99th percentile and greatest error in rad:", np.median(error), np.percentile(error, 99), error.max())
    assert np.median(error) < 0.01
    tip_error = np.linalg.norm(np.asarray(fingertip) - recording["fingertip_pos_m"][:, 1:, :2], axis=-1)
    assert np.median(tip_error) < 0.001
