"""Table of the environments, and gallery with one row of images per environment, for `jaxrl-vis envs`.

    start: colours, depth, geoms | a goal: colours, depth, geoms | more goals: colours

The table compiles nothing. A row of the gallery compiles two programs: one samples poses, one renders them all.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.table import Table

import jaxrl_vis_envs
from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.colours import depth_colours, label_colours
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.render import Frame, Scene, render

_COLUMNS = ("name", "actions", "observation", "goal state", "horizon", "threshold", "control period", "chance", "difficulty")
_LEGEND = (
    "chance: share of episodes that random actions end in success. difficulty: mean distance of start and goal in thresholds.\n"
    "Both are measured by benchmarks/tasks/task_difficulty.py."
)
_GAP, _TITLE, _GROUP_GAP = 3, 17, 12  # px
_SKY = (255, 255, 255)


def print_table(names: Sequence[str] | None = None) -> None:
    """Print one row per environment in ``names`` (default: all), from their definitions; nothing is compiled.

    If ``names`` is None, environments of installed packages that cannot be created are listed below the table with their
    errors.

    Raises:
        RequestError: One of ``names`` cannot be made.
    """
    table = Table(title="Environments", caption=_LEGEND, caption_justify="left")
    for column in _COLUMNS:
        table.add_column(column, no_wrap=True)
    environments, faults = _make_all(names)
    for name, env in environments.items():
        spec = env.observation_spec
        table.add_row(
            name,
            str(env.action_size),
            f"{'x'.join(map(str, spec.shape))} {spec.dtype}",
            str(env.goal_state_size),
            str(env.horizon),
            f"{env.threshold:g} {env.distance_unit}",
            f"{1000 * env.control_period:g} ms",
            "-" if env.chance is None else f"{100 * env.chance:.1f} %",
            "-" if env.difficulty is None else f"{env.difficulty:.1f}",
        )
    console = Console()
    # A pipe gets full lines, a terminal lines of its own width.
    (console if console.is_terminal else Console(width=160)).print(table)
    for name, fault in faults.items():
        print(f"{name} cannot be used: {fault}")


def _make_all(names: Sequence[str] | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Create the environments ``names``, all for None; return them, and the errors of those that cannot be created, by name.

    Raises:
        RequestError: One of ``names`` cannot be created.
    """
    environments, faults = {}, {}
    for name in jaxrl_vis_envs.list_envs() if names is None else names:
        try:
            environments[name] = jaxrl_vis_envs.make(name)
            environments[name].observation_spec  # noqa: B018 - traces third-party code, which may raise anything
        except Exception as error:
            if registry.is_built_in(name):
                raise
            if names is not None:
                fault = f"{name} cannot be used: {type(error).__name__}: {error}"
                raise RequestError(str(error) if isinstance(error, ValueError) else fault) from error
            environments.pop(name, None)
            faults[name] = " ".join(str(error).split()) or type(error).__name__
    return environments, faults


class _Poses(NamedTuple):
    """Fields of `mjx.Data` that the renderer reads, [K, ...]."""

    geom_xpos: jax.Array
    geom_xmat: jax.Array
    site_xpos: jax.Array
    site_xmat: jax.Array
    xpos: jax.Array
    xmat: jax.Array
    xipos: jax.Array


def image_environments() -> list[str]:
    """Return the names of the environments that have image observations and can be rendered."""
    return [name for name, env in _make_all(None)[0].items() if _sees_images(env) and _can_be_drawn(env)]


def _sees_images(env: Any) -> bool:
    return len(env.observation_spec.shape) == 3


def _can_be_drawn(env: Any) -> bool:
    needed = ("sample_start", "sample_goal", "mj_model", "camera", "config")
    return all(hasattr(env, name) for name in needed) and hasattr(env.config, "depth_range")


def render_poses(env: Any, key: jax.Array, goals: int, size: int) -> Frame:
    """Render the start of an episode and ``goals`` goals with the environment's camera: [1 + goals, ...] NumPy arrays.

    Args:
        env: An environment with a camera (`MjxGoalEnv`).
        key: Typed key [].
        goals: Number of goals.
        size: Height and width, pixels.
    """
    keys = jax.random.split(key, goals)

    def sample(keys: jax.Array) -> _Poses:
        both = (jax.vmap(env.sample_start)(keys[:1]), jax.vmap(env.sample_goal)(keys))
        return _Poses(*(jnp.concatenate([getattr(data, name) for data in both]) for name in _Poses._fields))

    scene = Scene.from_mjmodel(env.mj_model, env.camera, size, size)
    # A loop over single images compiles faster than a batch, and a few images render quickly.
    draw = jaxrl_vis_envs.jit(lambda poses: jax.lax.map(lambda pose: render(scene, pose), poses))
    return jax.tree.map(np.asarray, draw(jaxrl_vis_envs.jit(sample)(keys)))


def check_gallery(path: Path, names: Sequence[str] | None = None) -> Sequence[str]:
    """Check that a gallery can be rendered. Call it before rendering, which takes a minute.

    Args:
        path: Output file.
        names: Names of environments; None for all of `image_environments`.

    Returns:
        Names of the environments to be rendered.

    Raises:
        RequestError: The file cannot be written, its suffix is not an image format, or an environment has no images or cannot
            be rendered.
    """
    try:  # Pillow registers suffixes of formats that it only reads, or that have no colours
        Image.new("RGB", (1, 1)).save(io.BytesIO(), Image.registered_extensions()[path.suffix.lower()])
    except (KeyError, OSError, ValueError) as error:
        raise RequestError(f"cannot write {path}: end its name in .png or .jpg") from error
    check_writable(path)
    if names is None:
        return image_environments()
    for name, env in _make_all(names)[0].items():
        if not _sees_images(env):
            visual = registry.visual_variant(name)
            raise RequestError(f"{name} shows no images" + (f"; {visual} does" if visual else ""))
        if not _can_be_drawn(env):
            raise RequestError(f"{name} cannot be drawn: the gallery shows tasks that are subclasses of MjxGoalEnv")
    return names


def write_gallery(path: Path, names: Sequence[str] | None = None, image_size: int = 128, goals: int = 4) -> None:
    """Write the gallery.

    Args:
        path: The file; its suffix determines the format.
        names: Environments with images; default: all.
        image_size: Height and width of an image, pixels.
        goals: Number of goals per environment.

    Raises:
        RequestError: See `check_gallery`.
    """
    names = check_gallery(path, names)
    rows = []
    for name in names:
        env: Any = jaxrl_vis_envs.make(name)
        rows.append(_row(env, render_poses(env, jax.random.key(1), goals, image_size)))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(path)


def _row(env: Any, frames: Frame) -> np.ndarray:
    """Draw the row of one environment: [H, W, 3] uint8."""
    geoms, groups = env.mj_model.ngeom, []
    for index, title in ((0, "start"), (1, "goal")):
        depth = depth_colours(np.asarray(frames.depth[index]), *env.config.depth_range)
        labels = label_colours(np.asarray(frames.segmentation[index]), geoms, _SKY)
        groups.append([(title, frames.rgb[index]), ("depth", depth), ("geoms", labels)])
    groups.append([("other goals" if index == 2 else "", frames.rgb[index]) for index in range(2, len(frames.rgb))])
    size, count = frames.rgb.shape[1], sum(map(len, groups))
    strip = Image.new("RGB", (count * (size + _GAP) + 3 * _GROUP_GAP, size + 2 * _TITLE + _GAP), _SKY)
    pencil, left = ImageDraw.Draw(strip), _GROUP_GAP // 2
    pencil.text((left, 2), env.name, fill=(0, 0, 0), font=ImageFont.load_default(size=13))
    font = ImageFont.load_default(size=11)
    for group in groups:
        for title, image in group:
            pencil.text((left, _TITLE + 2), title, fill=(90, 90, 90), font=font)
            strip.paste(Image.fromarray(np.asarray(image)), (left, 2 * _TITLE))
            left += size + _GAP
        left += _GROUP_GAP
    return np.asarray(strip)
