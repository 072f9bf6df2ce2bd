"""FetchPush: starts, goals, relabelled goals, and contacts of boxes. Its physics: tests/physics/test_physics_parity.py."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from benchmarks.tasks import environments
from jaxrl_vis_envs.physics import box_contacts, mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx

COUNT = 2000


@functools.cache
def places(met_goals: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the box at the start and at the goal of COUNT episodes, [N, 3] each, m."""
    env = environments.make("FetchPush", met_goals=met_goals)

    def both(key):
        return env.achieved(env.sample_start(key)), env.achieved(env.sample_goal(key))

    start, goal = jaxrl_vis_envs.jit(jax.vmap(both))(jax.random.split(jax.random.key(0), COUNT))
    return np.asarray(start), np.asarray(goal)


def test_starts_and_goals_are_the_originals():
    start, goal = places(True)
    middle = np.array([1.34554, 0.74902])  # of the original's gripper
    offset = start[:, :2] - middle
    assert np.abs(offset).max() < 0.1502 and np.linalg.norm(offset, axis=1).min() > 0.0998
    # A square without a disk: its corners are kept.
    assert (np.abs(offset).min(axis=1) > 0.1).mean() == pytest.approx(0.1**2 / (0.3**2 - np.pi * 0.1**2), abs=0.03)
    np.testing.assert_allclose((goal[:, :2] - middle).std(axis=0), 0.15 / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(np.stack([start, goal])[:, :, 2], 0.4247, atol=1e-4)


def test_goals_that_are_met_where_the_box_starts():
    start, goal = places(True)
    assert 0.05 < (np.linalg.norm(start - goal, axis=1) <= 0.05).mean() < 0.09
    start, goal = places(False)
    distance = np.linalg.norm(start - goal, axis=1)
    assert distance.min() > 0.05 and (distance < 0.06).any()


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        ({"object_distance": 0.2}, "object_distance must be at most"),
        ({"met_goals": False, "goal_range": 0.01}, "needs a goal_range of at least the threshold"),
        ({"met_goals": 1}, "met_goals"),
    ],
)
def test_places_that_cannot_be_drawn(overrides, complaint):
    with pytest.raises(ValueError, match=complaint):
        jaxrl_vis_envs.make("FetchPush", **overrides)


def test_a_goal_tells_of_the_box_alone():
    """A relabelled goal has the form of sampled goals, and depends on the box's position alone, however arm and box moved."""
    env = environments.make("FetchPush")
    desired = jaxrl_vis_envs.jit(lambda key: env.observe_state(env.sample_goal(key)))(jax.random.key(3))
    np.testing.assert_allclose(env.as_goal(desired), desired, atol=2e-6)
    moving = desired + jnp.linspace(0.1, 0.2, 25)
    moving = moving.at[3:6].set(desired[3:6])
    np.testing.assert_allclose(env.as_goal(moving), desired, atol=2e-6)
    assert env.converts_goals
    assert np.abs(env.as_goal(moving.at[3].add(0.1)) - desired).max() > 0.09


TWO_BOXES = """
<mujoco>
  <worldbody>
    <geom name="table" type="box" size=".25 .35 .2" pos="0 0 -.2" contype="0" conaffinity="0"/>
    <body name="box"><freejoint/><geom name="box" type="box" size=".03 .02 .025" contype="0" conaffinity="0" mass="1"/></body>
  </worldbody>
  <contact><pair geom1="table" geom2="box" margin=".004" gap="0"/></contact>
</mujoco>
"""
POSES = {
    "flat": ((0.0, 0.0, 0.0249), (0.0, 0.0, 0.0)),
    "turned": ((0.1, -0.05, 0.0249), (0.0, 0.0, 0.7)),
    "near": ((0.0, 0.0, 0.027), (0.0, 0.0, 0.3)),
    "on an edge": ((0.0, 0.0, 0.0249), (0.1, 0.0, 0.3)),
    "on a side": ((0.0, 0.1, 0.0299), (0.0, np.pi / 2, 0.2)),
    "over the edge": ((0.24, 0.0, 0.0249), (0.0, 0.0, 0.0)),
    "off": ((0.3, 0.0, 0.0249), (0.0, 0.0, 0.0)),
}


@functools.cache
def contacts_of_boxes() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return contacts [K, 7] in each pose, MuJoCo's and ours, sorted by position: position (m), normal, distance (m)."""
    mj_model = mujoco.MjModel.from_xml_string(TWO_BOXES)
    mj_data, model = mujoco.MjData(mj_model), mjx.put_model(mj_model)
    still = mjx_model.rest_data(mj_model)

    def ours(qpos):
        contact = box_contacts.collide(model, mjx_model.kinematics(model, still.replace(qpos=qpos)))._impl.contact
        return jnp.concatenate([contact.pos, contact.frame[:, 0], contact.dist[:, None]], axis=1)

    both, program = {}, jax.jit(ours)
    for name, (position, angles) in POSES.items():
        mujoco.mju_euler2Quat(mj_data.qpos[3:], np.array(angles), "XYZ")
        mj_data.qpos[:3] = position
        mujoco.mj_forward(mj_model, mj_data)
        true = [[*contact.pos, *contact.frame[:3], contact.dist] for contact in mj_data.contact]
        found = np.asarray(program(jnp.asarray(mj_data.qpos, jnp.float32)))
        both[name] = tuple(in_order(np.reshape(rows, (-1, 7))) for rows in (true, found[found[:, 6] < 0.004]))
    return both


def in_order(contacts: np.ndarray) -> np.ndarray:
    return contacts[np.lexsort(np.round(contacts[:, :2].T, 4))]


@pytest.mark.parametrize("name", POSES)
def test_contacts_of_boxes_are_those_of_mujoco(name):
    true, found = contacts_of_boxes()[name]
    assert true.shape == found.shape
    np.testing.assert_allclose(found, true, atol=2e-6)


def test_which_models_have_these_contacts():
    spec = mujoco.MjSpec.from_string(TWO_BOXES)
    assert box_contacts.supports(mjx.put_model(spec.compile()))
    spec.geom("box").type = mujoco.mjtGeom.mjGEOM_SPHERE
    assert not box_contacts.supports(mjx.put_model(spec.compile()))
    assert not box_contacts.supports(mjx.put_model(mjx_model.load_model("fetch_reach.xml")))
