"""The box in which goals can be placed by hand is that from which goals are sampled, and the robot can reach points in it."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrl_vis_envs


@pytest.mark.parametrize(("name", "far"), [("FetchReach", 0.02), ("SawyerReach", 0.08)])
def test_goals_are_drawn_from_the_box_and_placed_in_it(name: str, far: float) -> None:
    env = jaxrl_vis_envs.make(name)
    low, high = env.goal_box
    place = jaxrl_vis_envs.jit(jax.vmap(lambda goal: env.achieved(env.goal_configuration(goal))))
    corners = 0.5 * (low + high) + 0.35 * np.array(list(itertools.product((-1, 1), repeat=3))) * (high - low)
    reached = np.asarray(place(jnp.asarray(corners, jnp.float32)))
    assert np.linalg.norm(reached - corners, axis=1).max() <= far  # the very corners are beyond the arm's reach
    drawn = np.asarray(
        jaxrl_vis_envs.jit(jax.vmap(lambda key: env.achieved(env.sample_goal(key))))(jax.random.split(jax.random.key(0), 8))
    )
    assert (drawn >= low - far).all() and (drawn <= high + far).all()
    assert np.ptp(drawn, axis=0).min() > 0.2 * (high - low).min()


def test_tasks_whose_goals_are_no_points_have_no_box() -> None:
    env = jaxrl_vis_envs.make("Reacher")
    assert env.goal_box is None
    with pytest.raises(NotImplementedError, match="goals of Reacher are not points in space"):
        env.goal_configuration(jnp.zeros(3))
