"""The page that ``play --html`` writes: episodes in three dimensions, for brax's viewer."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.learner.rollout import NO_EXPLORATION, choose_actions, encode
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.types import TrainState
from jaxrl_vis_envs.compilation import env_jit

_HOLD = 0.6  # s, how long the last step of an episode stays


def check_page(path: Path) -> None:
    """Checks that a page can be written to ``path``. Call it before playing the episodes.

    Raises:
        RequestError: The suffix is not .html, brax is not installed, or the file cannot be written there.
    """
    if path.suffix.lower() != ".html":
        raise RequestError(f"cannot write {path}: the name of a 3-D page must end in .html")
    try:
        import jaxrl_vis_envs.adapters.brax_viewer  # noqa: F401
    except ImportError as error:
        raise RequestError(f"--html: {error}") from error
    check_writable(path)


def play_poses(env: Any, networks: Networks, train: TrainState, key: jax.Array, num_envs: int) -> dict[str, jax.Array]:
    """Plays an episode in each of E environments without exploration: the episodes that `rollout.play` plays with that key.

    Args:
        env: A MuJoCo environment.
        networks: The networks that the parameters belong to.
        train: The learner of one seed.
        key: [] a typed key.
        num_envs: E.

    Returns:
        ``positions`` and ``rotations`` of the bodies, [E, T + 1, B, 3] (m) and [E, T + 1, B, 4], and the same of the goals,
        ``goal_positions`` and ``goal_rotations``, [E, B, 3] and [E, B, 4].
    """
    reset_key, _ = jax.random.split(key)
    reset_keys = jax.random.split(reset_key, num_envs)
    first = jax.vmap(env.reset)(reset_keys)
    goal = jax.vmap(env.sample_goal)(reset_keys)
    goal_latents = encode(networks, train, first.obs["desired_goal"])

    def step(carry: Any, _: None) -> Any:
        state, frame = carry
        state = jax.vmap(env.advance)(state, choose_actions(networks, train, goal_latents, NO_EXPLORATION, key, frame))
        return (state, jax.vmap(env.observe)(state)), (state.data.xpos, state.data.xquat)

    _, poses = jax.lax.scan(step, (first.replace(obs=None), first.obs["observation"]), length=env.horizon)
    start = (first.data.xpos, first.data.xquat)
    positions, rotations = (jnp.moveaxis(jnp.concatenate([a[None], b]), 0, 1) for a, b in zip(start, poses))
    return {"positions": positions, "rotations": rotations, "goal_positions": goal.xpos, "goal_rotations": goal.xquat}


def write_page(program: Any, train: TrainState, key: jax.Array, episodes: int, out: Path) -> None:
    """Plays ``episodes`` episodes with the first seed of a learner, and writes the page.

    Args:
        program: `train_step.TrainStep`.
        train: The learner, [S, ...].
        key: Draws the episodes.
        episodes: How many; the page shows one after the other.
        out: The file.
    """
    from jaxrl_vis_envs.adapters.brax_viewer import Poses, viewer_page

    env = program.env
    play = env_jit(lambda train, key: play_poses(env, program.networks, train, key, episodes))
    played = {name: np.asarray(values) for name, values in play(jax.tree.map(lambda leaf: leaf[0], train), key).items()}
    # The last step of each episode is repeated, so that one sees where it ended.
    hold = max(1, round(_HOLD / env.control_period))
    steps = np.append(np.arange(env.horizon + 1), np.full(hold, env.horizon))

    def joined(values: np.ndarray) -> np.ndarray:
        return values[:, steps].reshape(-1, *values.shape[2:])

    poses = Poses(joined(played["positions"]), joined(played["rotations"]))
    goals = Poses(*(np.repeat(played[name], len(steps), axis=0) for name in ("goal_positions", "goal_rotations")))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(viewer_page(env.mj_model, poses, goals, env.control_period), encoding="utf-8")
