"""HTML page of ``play --html``: three-dimensional episodes in brax's viewer."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.acting.rollout import Acting, play, split_keys
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.types import TrainState

_HOLD = 0.6  # duration of the last step of an episode, s


def check_page(path: Path) -> None:
    """Check that a page can be written to ``path``. Call it before playing the episodes.

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


class PosedEpisodes(NamedTuple):
    """Poses of all bodies in E episodes and in their goals.

    Attributes:
        positions, rotations: [E, T+1, B, 3] (m) and [E, T+1, B, 4], unit quaternions, scalar first.
        goal_positions, goal_rotations: [E, B, 3] and [E, B, 4], in the same form.
    """

    positions: jax.Array
    rotations: jax.Array
    goal_positions: jax.Array
    goal_rotations: jax.Array


def record_poses(acting: Acting, train: TrainState, key: jax.Array, num_envs: int) -> PosedEpisodes:
    """Roll out an episode of the first learner in each of E environments, without exploration.

    Args:
        acting: A MuJoCo environment, and the algorithm.
        train: The learners, [S, ...].
        key: Typed key [] that determines the episodes, as in `rollout.play`.
        num_envs: E.
    """
    first = jax.tree.map(lambda leaf: leaf[:1], train)
    played = play(acting, first, key[None], num_envs, record=lambda state: (state.data.xpos, state.data.xquat))
    goal = jax.vmap(acting.env.sample_goal)(split_keys(key[None], num_envs)[0])
    positions, rotations = (poses[0] for poses in played.record)
    return PosedEpisodes(positions, rotations, goal.xpos, goal.xquat)


def write_page(program: Any, train: TrainState, key: jax.Array, episodes: int, out: Path) -> None:
    """Roll out episodes with the first seed of a learner, and write the page.

    Args:
        program: `train_step.TrainStep`.
        train: The learner, [S, ...].
        key: Typed key [] of the episodes.
        episodes: Number of episodes, shown one after the other.
        out: The file.
    """
    from jaxrl_vis_envs.adapters.brax_viewer import Poses, viewer_page

    env = program.env
    play_all = jaxrl_vis_envs.jit(lambda train, key: record_poses(program.acting, train, key, episodes))
    played = jax.tree.map(np.asarray, play_all(train, key))
    # The last step of each episode is repeated, so that its end is visible.
    hold = max(1, round(_HOLD / env.control_period))
    steps = np.append(np.arange(env.horizon + 1), np.full(hold, env.horizon))

    def flatten_episodes(values: np.ndarray) -> np.ndarray:
        return values[:, steps].reshape(-1, *values.shape[2:])

    poses = Poses(flatten_episodes(played.positions), flatten_episodes(played.rotations))
    goals = Poses(*(np.repeat(of_goals, len(steps), axis=0) for of_goals in (played.goal_positions, played.goal_rotations)))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(viewer_page(env.mj_model, poses, goals, env.control_period), encoding="utf-8")
