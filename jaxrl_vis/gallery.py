"""What `jaxrl-vis envs` shows: a table of the tasks, and a sheet with a start and a goal of each."""

import math
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import jaxrl_vis_envs
from jaxrl_vis_envs.compilation import world_jit


def print_table() -> None:
    """One row a task: shapes, horizon, threshold and control period."""
    table = Table(title="Tasks")
    for column in ("name", "observation", "actions", "goal state", "horizon", "threshold", "control period"):
        table.add_column(column, no_wrap=True)
    for name in jaxrl_vis_envs.list_envs():
        env = jaxrl_vis_envs.make(name)
        spec = env.observation_spec
        table.add_row(
            name,
            f"{'x'.join(map(str, spec.shape))} {spec.dtype}",
            str(env.action_size),
            str(env.goal_state_size),
            str(env.horizon),
            f"{env.threshold:g} {env.distance_unit}",
            f"{1000 * env.control_period:g} ms",
        )
    console = Console()
    # A pipe gets whole lines; a terminal gets the width that it has.
    (console if console.is_terminal else Console(width=160)).print(table)


def draw(path: Path, image_size: int = 128) -> None:
    """Writes one row of pictures a task: start and goal as colours, start and goal as depth."""
    from matplotlib.figure import Figure  # not pyplot, which would change a notebook's backend

    rows = []
    for name in jaxrl_vis_envs.list_envs():
        if len(jaxrl_vis_envs.make(name).observation_spec.shape) != 3:
            continue
        env = jaxrl_vis_envs.make(name, image_size=image_size, pixels="rgbd")
        obs = world_jit(lambda key, env=env: env.reset(key).obs)(jax.random.key(0))
        start, goal = (np.moveaxis(np.asarray(obs[part]), 0, -1) for part in ("observation", "desired_goal"))
        rows.append((name, [start[..., :3], goal[..., :3], start[..., 3], goal[..., 3]]))
    figure = Figure(figsize=(10, 2.7 * len(rows)))
    axes = figure.subplots(len(rows), 4, squeeze=False)
    for (name, pictures), line in zip(rows, axes, strict=True):
        for picture, title, axis in zip(pictures, ("start", "goal", "start, depth", "goal, depth"), line, strict=True):
            axis.imshow(picture, cmap="magma", interpolation="nearest", vmin=0, vmax=255)
            axis.set_title(f"{name}: {title}" if title == "start" else title, fontsize=9)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=max(72, math.ceil(4 * image_size / 10)))
