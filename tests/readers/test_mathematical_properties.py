"""Mathematical properties, for arbitrary numbers: each function is compiled once and called many times."""

import functools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_replay import ENVS, HORIZON, encoded_rollout

from jaxrl_vis.learner.memory.relabel import choose_goal_slots
from jaxrl_vis.learner.memory.replay import make_replay
from jaxrl_vis.weighting import MAIN, make_weighting
from jaxrl_vis_envs.physics.scalar import quaternions
from jaxrl_vis_envs.render import Scene
from jaxrl_vis_envs.render.camera import lens, pixel_rays

seeds = st.integers(0, 2**32 - 1)

# --- replay ---
CAPACITY, BATCH = 3, 64


@functools.cache
def replay_programs(mean_age: int | None):
    replay = make_replay(CAPACITY * ENVS * HORIZON, ENVS, HORIZON, mean_age=mean_age)
    empty = replay.init(jax.ShapeDtypeStruct((2, 4, 4), jnp.uint8), goal_state_size=2, action_size=2)
    sample = jax.jit(lambda state, key, iteration: replay.sample_indices(state, key, iteration, BATCH))
    return replay, empty, jax.jit(replay.insert), sample, jax.jit(replay.gather), jax.jit(replay.is_stored)


@pytest.mark.parametrize("mean_age", [None, ENVS * HORIZON])
def test_replays_give_what_was_put_in(mean_age):
    """Wherever the ring begins, sampled transitions are complete, of stored episodes, and with goals of their own episode."""
    _, empty, insert, sample, gather, is_stored = replay_programs(mean_age)

    @given(st.integers(0, 1000), st.integers(1, 5), seeds, st.data())
    def check_property(begin, count, seed, data):
        state, kept = empty, {}
        for number in range(count):
            iteration = begin + number
            first = data.draw(st.integers(0, 80))
            state = insert(state, encoded_rollout(first), jnp.int32(iteration))
            place = (iteration % CAPACITY) * ENVS
            kept.update({place + env: first + env for env in range(ENVS)})
        last = jnp.int32(begin + count - 1)
        assert set(np.flatnonzero(is_stored(state, last))) == kept.keys()
        indices = sample(state, jax.random.key(seed), last)
        slots = choose(jax.random.key(seed ^ 1), indices.time, 0.8, 0.3)
        batch = gather(state, indices, slots)
        ids = np.array([kept[int(place)] for place in indices.episode])
        time = np.asarray(indices.time)
        assert ((time >= 0) & (time < HORIZON)).all()
        np.testing.assert_array_equal(batch.action, np.stack([ids, time], axis=-1))
        np.testing.assert_array_equal(batch.state_tp1, np.stack([ids, time + 1], axis=-1))
        np.testing.assert_array_equal(batch.goal_state, np.stack([ids, slots], axis=-1))
        np.testing.assert_array_equal(batch.observation_t[:, :, 0, 0], np.stack([ids, time], axis=-1))
        np.testing.assert_array_equal(batch.goal[:, :, 3, 3], np.stack([ids, slots], axis=-1))

    check_property()


# --- relabelling ---
choose = jax.jit(lambda key, time, relabel, balance: choose_goal_slots(key, time, HORIZON, relabel, balance))


@given(seeds, st.floats(0, 1), st.floats(0, 1))
def test_goals_are_of_the_future_or_the_episodes_own(seed, relabel, balance):
    time = jnp.arange(BATCH, dtype=jnp.int32) % HORIZON
    slots = np.asarray(choose(jax.random.key(seed), time, relabel, balance))
    assert ((slots > np.asarray(time)) & (slots <= HORIZON + 1)).all()
    if relabel == 0.0:
        assert (slots == HORIZON + 1).all()
    if relabel == 1.0:
        assert (slots <= HORIZON).all()
        assert balance < 1.0 or (slots == np.asarray(time) + 1).all()
    hindsight = np.asarray(choose(jax.random.key(seed), time, 1.0, 0.0))  # the same draws, all of them from the future
    assert ((slots == hindsight) | (slots == np.asarray(time) + 1) | (slots == HORIZON + 1)).all()


# --- weightings ---
OTHERS = ("near", "far", "odd")
RULES = {
    "sum": {},
    "balance": {},
    "cosine": {},
    "fixed": {"weights": 0.7},
    "ol_aux": {"interval": 1, "learning_rate": 0.01},
}
losses = st.floats(0, 1e6, width=32)
dots = st.floats(-1e6, 1e6, width=32)


@functools.cache
def rule(name):
    weighting = make_weighting(name, **RULES[name])

    def run(values, products):
        state = weighting.init((MAIN, *OTHERS))
        for loss, dot in zip(values, products):
            weights, state, _ = weighting.update(loss, dot, state)
        return weights, weighting.coefficients(weights, loss), state.weights

    return jax.jit(run)


@pytest.mark.parametrize("name", sorted(RULES))
def test_weights_are_finite_not_negative_and_nobodys_by_name(name):
    """Losses and products of gradients are arbitrary; losses that exchange names exchange their weights."""

    @given(
        st.lists(st.tuples(*[losses] * 4), min_size=3, max_size=3),
        st.lists(st.tuples(*[dots] * 3), min_size=3, max_size=3),
        st.permutations(range(3)),
    )
    def check_property(values, products, order):
        def named(order):
            of_losses = [{MAIN: one[0], **{OTHERS[i]: one[1 + order[i]] for i in range(3)}} for one in values]
            return jax.tree.map(np.float32, (of_losses, [{OTHERS[i]: one[order[i]] for i in range(3)} for one in products]))

        weights, coefficients, kept = rule(name)(*named(range(3)))
        for each in (weights, kept):
            assert all(math.isfinite(value) and value >= 0.0 for value in map(float, each.values())), each
        assert all(math.isfinite(float(value)) and float(value) >= 0.0 for value in coefficients.values()), coefficients
        assert float(weights[MAIN]) == 1.0
        exchanged, _, _ = rule(name)(*named(order))
        for place in range(3):
            assert float(exchanged[OTHERS[place]]) == float(weights[OTHERS[order[place]]])

    check_property()


# --- quaternions ---
numbers = st.floats(-1, 1, width=32)
turns = st.tuples(*[numbers] * 4).filter(lambda parts: sum(part * part for part in parts) > 1e-3)
multiply = jax.jit(lambda one, other: jnp.stack(jnp.broadcast_arrays(*quaternions.multiply(tuple(one), tuple(other)))))
unit = jax.jit(lambda parts: jnp.stack(quaternions.normalize(tuple(parts))))
matrix = jax.jit(lambda turn: jnp.array(quaternions.rotation_axes(tuple(turn))).T)
back = jax.jit(lambda turn: jnp.stack(quaternions.inverse(tuple(turn))))


@given(turns, turns, turns)
def test_quaternions_turn_as_matrices_do(first, second, third):
    one, two, three = (unit(np.array(parts, np.float32)) for parts in (first, second, third))
    near = functools.partial(np.testing.assert_allclose, atol=3e-6)
    near(jnp.linalg.norm(one), 1.0)
    near(matrix(multiply(one, two)), matrix(one) @ matrix(two))
    near(multiply(multiply(one, two), three), multiply(one, multiply(two, three)))
    near(multiply(one, back(one)), np.array(quaternions.IDENTITY))
    near(matrix(one) @ matrix(one).T, np.eye(3))
    near(matrix(-one), matrix(one))
    again = np.array(quaternions.from_matrix(np.asarray(matrix(one), np.float64)))
    near(abs(float(again @ np.asarray(one))), 1.0)
    expected = np.empty(9)
    mujoco.mju_quat2Mat(expected, np.asarray(one, np.float64))
    near(np.ravel(matrix(one)), expected)


# --- cameras ---
@functools.cache
def scene_of(lens_words: str) -> Scene:
    text = f'<mujoco><worldbody><camera name="c" {lens_words}/><geom size=".1"/></worldbody></mujoco>'
    return Scene.from_mjmodel(mujoco.MjModel.from_xml_string(text), "c", 12, 20)


rays_of = jax.jit(lambda scene: (lens(scene), pixel_rays(scene, *np.indices((12, 20)))))


@given(st.floats(1, 170, width=32))
def test_lenses_of_an_angle_of_view_are_pinholes(fovy):
    """The central ray points ahead, rays of opposite pixels are opposite, and the outer edge is at half the angle."""
    scene = scene_of('fovy="50"').replace(fovy=jnp.float32(fovy))
    (across, up, half_u, half_v), (u, v) = jax.device_get(rays_of(scene))
    assert across == up == 0.0
    np.testing.assert_allclose(math.degrees(math.atan(half_v)), 0.5 * fovy, rtol=1e-4)
    np.testing.assert_allclose(half_u / half_v, 20 / 12, rtol=1e-6)
    np.testing.assert_allclose(u, -u[:, ::-1], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(v, -v[::-1], rtol=1e-5, atol=1e-6)
    assert (np.diff(u, axis=1) > 0).all() and (np.diff(v, axis=0) < 0).all()
    assert np.abs(u).max() < half_u and np.abs(v).max() < half_v


@given(*[st.floats(0.005, 0.1)] * 2, *[st.floats(-0.01, 0.01)] * 2)
def test_lenses_of_a_sensor_put_its_principal_point_ahead(focal_x, focal_y, right, down):
    """Rays are those of the camera's matrix: u = (column - c) / f, in pixels; the sensor's size converts pixels to metres."""
    scene = scene_of('focal=".02 .02" sensorsize=".03 .02" resolution="20 12"')
    scene = scene.replace(focal=jnp.float32([focal_x, focal_y]), principal=jnp.float32([right, down]))
    _, (u, v) = jax.device_get(rays_of(scene))
    sensor = np.asarray(scene.sensor)
    pixels = 20 / sensor[0], 12 / sensor[1]  # per metre
    rows, columns = np.indices((12, 20)) + 0.5
    np.testing.assert_allclose(u, ((columns - 10) / pixels[0] + right) / focal_x, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(v, -((rows - 6) / pixels[1] + down) / focal_y, rtol=1e-4, atol=1e-5)
