"""`goal_mask=object`: indicator rewards that compare the box's pixels alone. Only images are compiled, no physics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrl_vis_envs
from jaxrl_vis import preset
from jaxrl_vis.config.methods import METHODS
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import train_step
from jaxrl_vis.learner.memory.replay import Indices
from jaxrl_vis.learner.memory.rewards import make_reward
from jaxrl_vis.learner.memory.sampling import Choice, Sampler
from jaxrl_vis.types import Batch, Episodes
from jaxrl_vis_envs import goals
from jaxrl_vis_envs.goals import object_mask

# Places of the box beside the gripper's start (m), and whether the arm is lifted as in goal images or where it starts.
PLACES = {
    "goal": ((0.0, 0.12), True),
    "arm elsewhere": ((0.0, 0.12), False),
    "5 cm off": ((0.0, 0.07), True),
    "behind the gripper, goal": ((-0.05, 0.0), True),
    "behind the gripper": ((-0.05, 0.0), False),
    "hidden": ((-0.1, 0.0), False),
}


@pytest.fixture(scope="module")
def env():
    return jaxrl_vis_envs.make("VisualFetchPush", goal_mask="object")


@pytest.fixture(scope="module")
def images(env):
    """Images [4, 64, 64] uint8 of `PLACES`."""
    grip = env._start.site_xpos[env._grip, :2]

    def draw(offset, is_lifted):
        qpos = jnp.where(is_lifted, env._goal_pose, env._start.qpos)
        return env._observe(env._with_box(env._start, qpos, grip + offset), None, None)

    offsets, lifted = zip(*PLACES.values(), strict=True)
    drawn = jaxrl_vis_envs.jit(jax.vmap(draw))(jnp.asarray(offsets, jnp.float32), jnp.asarray(lifted))
    return dict(zip(PLACES, np.asarray(drawn), strict=True))


def reward(first: np.ndarray, goal: np.ndarray, method: str = "indicator", mask=object_mask) -> float:
    function = make_reward(preset("debug", method=method), METHODS[method], mask)
    nothing = jnp.zeros((1, 1))
    batch = Batch(jnp.stack([goal[None]] * 3), nothing, nothing, nothing)
    return float(function(batch, jnp.asarray(first[None]), 1.0, 0.0)[0])


def test_the_mask_is_where_the_box_is(images):
    mask = np.asarray(object_mask(images["goal"]))[0]
    red, _, blue, _ = images["goal"].astype(int)
    assert 15 < mask.sum() < 40
    is_blue = (blue > 3 * red) & (np.arange(64)[:, None] > 38)  # the arm, which has blue parts, ends above
    np.testing.assert_array_equal(mask, is_blue)


@pytest.mark.parametrize("method", ["indicator", "indicator_tolerance"])
def test_only_the_box_counts(images, method):
    goal = images["goal"]
    assert reward(images["arm elsewhere"], goal, method) == 1.0
    assert reward(images["arm elsewhere"], goal, method, mask=None) == 0.0
    assert reward(images["5 cm off"], goal, method) == 0.0


def test_a_whole_image_hardly_shows_the_box(images):
    """The box covers less of the image than the default tolerance_share, a hundredth."""
    assert reward(images["5 cm off"], images["goal"], "indicator_tolerance", mask=None) == 1.0


@pytest.mark.parametrize("method", ["indicator", "indicator_tolerance"])
def test_what_is_hidden_is_not_reached(images, method):
    """A gripper in front of the box causes a false negative, never a false positive."""
    hidden, goal = images["behind the gripper"], images["behind the gripper, goal"]
    assert 0 < object_mask(hidden).sum() < object_mask(goal).sum()
    assert reward(hidden, goal, method) == 0.0
    assert not object_mask(images["hidden"]).any()
    assert reward(images["hidden"], images["hidden"], method) == 0.0


def test_a_tolerance_counts_pixels_of_the_box(images):
    goal = images["goal"]
    mask = np.asarray(object_mask(goal))
    row, column = np.argwhere(mask[0])[0]
    off_by_one = goal.copy()
    off_by_one[2, row, column] ^= 64

    def tolerant(share):
        return float(goals.indicator_reward(off_by_one, goal, tolerance=8.0, share=share, compared=mask))

    elements = 4 * mask.sum()
    assert tolerant(1.0 - 1.5 / elements) == 1.0 and tolerant(1.0 - 0.5 / elements) == -1.0


def test_a_learner_reads_the_mask(env, images, monkeypatch):
    """With the mask, a relabelled goal is reached although the arm is elsewhere; without the mask, it is not."""
    config, built = preset("debug", env="VisualFetchPush", image_size=64, method="indicator"), []
    monkeypatch.setattr(train_step, "Sampler", lambda *parts: built.append(Sampler(*parts)) or built[-1])
    frames = [images[name] for name in ("5 cm off", "goal", "arm elsewhere", "arm elsewhere")]
    observations = np.stack([*frames, *[images["5 cm off"]] * (env.horizon + 2 - len(frames))])[None]
    rewards = []
    for task in (env, jaxrl_vis_envs.make("VisualFetchPush")):
        train_step.make_train_step(task, config.replace(num_envs=1))
        sampler = built[-1]
        states = np.zeros((1, env.horizon + 2, 3), np.float32)
        episodes = Episodes(observations, states, np.zeros((1, env.horizon, 4), np.float32))
        state = sampler.replay.of_rollout(episodes)
        choice = Choice(Indices(episode=jnp.array([0, 0]), time=jnp.array([0, 1])), goal_slot=jnp.array([2, 2]))
        rewards.append(sampler.batch(state, choice).reward.tolist())
    assert rewards == [[1.0, 1.0], [-1.0, 1.0]]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"method": "oracle"}, "goal_mask=object is for indicator rewards, and this is --method oracle"),
        ({"method": "indicator", "observation_noise": 1.0}, "observation_noise exclude each other"),
    ],
)
def test_where_no_mask_can_be_read(env, options, complaint):
    with pytest.raises(RequestError, match=complaint):
        train_step.make_train_step(env, preset("debug", env="VisualFetchPush", **options))


def test_a_mask_of_something_else():
    with pytest.raises(ValueError, match="goal_mask must be one of none, object"):
        jaxrl_vis_envs.make("VisualFetchPush", goal_mask="arm")
