"""Indicator rewards of relabelled goals of VisualFetchPush, on whole images and on the box's pixels (``goal_mask=object``).

    python -m benchmarks.tasks.box_rewards [--episodes 32]

Episodes are those of the scripted pusher. Prints the share of images in which the gripper hides the box and, by the distance
of the box from where it is in the goal, the share of positive rewards.
"""

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrl_vis_envs
from benchmarks.tasks import controllers, environments
from jaxrl_vis_envs import goals
from jaxrl_vis_envs.goals import object_mask
from jaxrl_vis_envs.physics import mjx_model

_PAIRS = 20_000
_EDGES = (0.0, 1e-4, 1e-3, 5e-3, 0.02, np.inf)  # m
_TOLERANT = {"tolerance": 8.0, "share": 0.99}  # the defaults of indicator_tolerance


def record_pushes(env: Any, episodes: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roll out the scripted pusher for N episodes.

    Args:
        env: VisualFetchPush, with RGB-D images.
        episodes: N.
        seed: Seed of the starts and goals.

    Returns:
        Images [N, T+1, 4, H, W] uint8; images of the same boxes with the arm in the pose of a goal, clear of the box; and
        positions of the box [N, T+1, 3], m.
    """
    state, aims = environments.reset(env, jax.random.split(jax.random.key(seed), episodes))
    policy, memory = controllers.fetch_push(env)
    act = jaxrl_vis_envs.jit(jax.vmap(policy))
    first = env.mj_model.joint("box").qposadr[0]
    lifted = env.sample_goal(jax.random.key(0))

    def render_both(qpos: jax.Array) -> jax.Array:
        alone = jax.lax.dynamic_update_slice(lifted.qpos, jax.lax.dynamic_slice(qpos, (first,), (7,)), (first,))
        poses = jax.vmap(lambda qpos: mjx_model.kinematics(env._model, lifted.replace(qpos=qpos)))(jnp.stack([qpos, alone]))
        return jax.vmap(lambda data: env.observe(env.state_at(data, jnp.zeros(3))))(poses)

    draw = jaxrl_vis_envs.jit(jax.vmap(render_both))
    images, places = [], []
    for step in range(env.horizon + 1):
        images.append(np.asarray(draw(state.data.qpos)))
        places.append(np.asarray(state.achieved_state))
        if step < env.horizon:
            action, memory = act(state, aims, memory)
            state = environments.advance(env, state, action)
    drawn = np.stack(images, axis=1)
    return drawn[:, :, 0], drawn[:, :, 1], np.stack(places, axis=1)


def main() -> None:
    """Print the shares of occluded boxes, and the shares of positive rewards by the distance of the box from its goal."""
    parser = argparse.ArgumentParser(
        description="Indicator rewards of VisualFetchPush, on whole images and on the box's pixels."
    )
    parser.add_argument("--episodes", type=int, default=32)
    options = parser.parse_args()
    env = environments.make("VisualFetchPush", goal_mask="object", met_goals=False)
    seen, alone, places = record_pushes(env, options.episodes)
    mask, whole = np.asarray(object_mask(seen)), np.asarray(object_mask(alone))
    hidden, gone = (mask != whole).any((-3, -2, -1)), ~mask.any((-3, -2, -1))
    sizes = whole.sum((-3, -2, -1))
    print(f"{hidden.mean():.3f} of {hidden.size} images hide part of the box, {gone.mean():.3f} all of it")
    print(f"the box covers {sizes.min()} to {sizes.max()} of {seen.shape[-1] ** 2} pixels")

    generator = np.random.default_rng(0)
    episode, time = generator.integers(0, options.episodes, _PAIRS), generator.integers(0, env.horizon, _PAIRS)
    later = generator.integers(time + 1, env.horizon + 1)
    reached, goal = seen[episode, time], seen[episode, later]
    distance = np.linalg.norm(places[episode, time] - places[episode, later], axis=1)
    compared = mask[episode, time] | mask[episode, later]
    rewards = {
        "whole": goals.indicator_reward(reached, goal),
        "box": goals.indicator_reward(reached, goal, compared=compared),
        "whole, tolerance": goals.indicator_reward(reached, goal, **_TOLERANT),
        "box, tolerance": goals.indicator_reward(reached, goal, compared=compared, **_TOLERANT),
    }
    for low, high in zip(_EDGES, _EDGES[1:], strict=False):
        chosen = (distance >= low) & (distance < high)
        shares = ", ".join(f"{name} {np.mean(np.asarray(reward)[chosen] > 0):.3f}" for name, reward in rewards.items())
        print(f"{1e3 * low:g} to {1e3 * high:g} mm: {chosen.sum()} pairs; {shares}")


if __name__ == "__main__":
    main()
