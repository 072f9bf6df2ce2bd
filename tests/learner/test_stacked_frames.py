"""Learner with stacked images: goals are static, whether given or relabelled."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import point_mass
import pytest
from learners import rollout, train_iteration
from probe_environments import Probe

import jaxrl_vis_envs
from jaxrl_vis.config import preset
from jaxrl_vis.learner import train_step
from jaxrl_vis.learner.ddpg import ddpg
from jaxrl_vis.learner.ddpg.ddpg import make_ddpg
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.memory.replay import Indices, make_replay
from jaxrl_vis.learner.memory.sampling import Choice, Sampler
from jaxrl_vis.learner.resolved import resolve
from jaxrl_vis.run.trainer import Trainer
from jaxrl_vis.types import Episodes
from jaxrl_vis_envs.base import push_history, start_history

ENVS, SETTINGS = 2, {"batch_size": 64, "updates_per_iteration": 1, "replay_transitions": 10, "image_size": 8, "num_envs": 2}


def test_relabelled_goals_repeat_the_achieved_image():
    """VisualReacher's own rule is applied to episodes whose images encode their number and their slot, newest first."""
    env = jaxrl_vis_envs.make("VisualReacher", frame_stack=2, image_size=4, pixels="depth")
    horizon = 5
    slots = np.arange(horizon + 2)
    newest = 10 * np.arange(ENVS)[:, None] + slots
    before = 10 * np.arange(ENVS)[:, None] + np.maximum(slots - 1, 0)
    before[:, -1] = newest[:, -1]  # the goal that was given stands still
    frames = np.broadcast_to(np.stack([newest, before], axis=2)[..., None, None], (ENVS, horizon + 2, 2, 4, 4))
    replay = make_replay(ENVS * horizon, ENVS, horizon, frame_stack=2)
    collected = Episodes(
        jnp.asarray(frames, jnp.uint8), jnp.zeros((ENVS, horizon + 2, 2)), jnp.zeros((ENVS, horizon, env.action_size))
    )
    state = replay.insert(replay.init(env.observation_spec, 2, env.action_size), collected, jnp.int32(0))
    episode, time, goal_slot = (jnp.array(values) for values in ([0, 1, 0, 1], [0, 1, 2, 4], [1, 4, 6, 5]))
    config = preset("debug", method="indicator")
    sampler = Sampler(config, resolve(config, horizon), replay, env.threshold, env.as_goal)
    choice = Choice(Indices(episode, time), goal_slot)
    still = sampler.batch(state, choice)
    np.testing.assert_array_equal(still.observation_t, frames[episode, time])
    np.testing.assert_array_equal(still.observation_tp1, frames[episode, time + 1])
    np.testing.assert_array_equal(replay.stacked(state), frames)
    assert state.episodes.observations.nbytes == frames.size // 2  # each image once, a byte a pixel
    for row in range(len(time)):
        e, t, g = int(episode[row]), int(time[row]), int(goal_slot[row])
        np.testing.assert_array_equal(still.goal[row], env.as_goal(frames[e, g].astype(np.uint8)))
        assert set(np.unique(still.goal[row])) == {newest[e, g]}
        # Reached where the goal is the very next image, though what was observed there shows that it moved.
        assert (still.reward[row] > 0) == (g == t + 1)
        assert not np.array_equal(still.goal[row], still.observation_tp1[row])


def test_stacked_images_from_replay_equal_rendered_ones():
    """Episodes render the preceding images again, from joint positions; the replay uses its stored ones. They are equal."""
    with point_mass.registered():
        config = preset("debug", env="VisualPoint", frame_stack=3, pixels="rgbd", **SETTINGS | {"image_size": 16})
        made = train_step.make_train_step(make_env(config), config)
    episodes, _ = rollout(made, made.init(jax.random.key(0)[None]).train, jax.random.key(1)[None])
    episodes = jax.tree.map(lambda leaf: leaf[0], episodes)
    seen = np.asarray(episodes.observations)
    assert seen.shape == (ENVS, made.env.horizon + 2, 12, 16, 16)
    assert np.any(seen[:, 1:-1, :4] != seen[:, 1:-1, 4:8], axis=(2, 3, 4)).mean() > 0.5  # the ball moves
    np.testing.assert_array_equal(made.replay.stacked(made.replay.of_rollout(episodes)), seen)


class Walker(Probe):
    """A walking point; an image's brightness is the point's distance, on six grey levels, so that goals can be reached."""

    def __init__(self, frame_stack: int):
        self.frame_stack = frame_stack

    def image(self, position):
        return jnp.full((3, 8, 8), jnp.clip(jnp.round(position[0]) % 6, 0, 5), jnp.uint8)

    def reset(self, key):
        position, goal = jax.random.uniform(key, (2, 1), maxval=6.0)
        still, wanted = (jnp.tile(self.image(place), (self.frame_stack, 1, 1)) for place in (position, goal))
        obs = {"observation": still, "achieved_goal": still, "desired_goal": wanted}
        return self._measure(position, position, goal, obs, start_history(position, self.frame_stack))

    def advance(self, state, action):
        position, history = state.data + 1.5 + 0.5 * action, push_history(state.history, state.data)
        return self._measure(position, position, state.goal_state, state.obs, history)

    def observe(self, state):
        positions = [state.data] if state.history is None else [state.data, *state.history]
        return jnp.concatenate([self.image(position) for position in positions])


@functools.cache
def program(frame_stack: int = 2):
    """A training program whose gradient step only inspects its batch."""
    config = preset("debug", method="indicator_balance_filter", relabel_probability=1.0, **SETTINGS)
    env = Walker(frame_stack)

    def look(gradients, working, prepared, with_actor):
        batch = prepared.batch
        goal, after = (images.reshape(len(batch.reward), frame_stack, -1) for images in (batch.goal, batch.observation_tp1))
        arrived = jnp.all(goal[:, 0] == after[:, 0], axis=-1)
        return gradients(working, prepared, with_actor)[0], {
            "goals_that_stand_still": jnp.mean(jnp.all(goal == goal[:, :1], axis=(1, 2))),
            "observations_that_move": jnp.mean(jnp.any(after != after[:, :1], axis=(1, 2))),
            "arrived": jnp.mean(arrived),
            "rewarded": jnp.mean(batch.reward > 0),
            "rewarded_as_arrived": jnp.mean((batch.reward > 0) == arrived),
        }  # fmt: skip

    def make_looking(*arguments):
        steps = make_ddpg(*arguments)
        return steps._replace(gradients=functools.partial(look, steps.gradients))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ddpg, "make_ddpg", make_looking)
        return train_step.make_train_step(env, config)


def test_training_samples_goals_that_stand_still():
    made = program()
    _, metrics = train_iteration(made, made.init(jax.random.key(0)[None]))
    seen = {name: float(value[0]) for name, value in metrics.items()}
    assert seen["goals_that_stand_still"] == 1.0
    assert seen["observations_that_move"] > 0.5
    # Half of the goals are the next image for certain, some others by chance.
    assert 0.4 < seen["rewarded"] < 0.95
    assert seen["rewarded_as_arrived"] == 1.0
    assert seen["guard/nonfinite"] == 0.0


def test_people_are_shown_the_newest_image():
    made = program()
    trainer = Trainer(made.config, made)
    assert trainer.programs.shows_images
    _, images = jax.eval_shape(made.evaluate, trainer.shapes.train, jax.random.key(0))
    horizon = made.env.horizon
    assert images["frames"].shape == (1, 8, horizon + 1, 3, 8, 8)
    assert images["goals"].shape == (1, 8, 3, 8, 8)


def test_a_single_image_is_left_alone():
    """`as_goal` is not called if the observation is a single image, which is a goal already."""

    class Rigid(Walker):
        def as_goal(self, observation):
            raise AssertionError("a single image is a goal already")

    made = train_step.make_train_step(Rigid(1), preset("debug", method="indicator_balance_filter", **SETTINGS))
    jax.eval_shape(made.learn, jax.eval_shape(made.init, jax.random.key(0)[None]), made.parts_spec)
