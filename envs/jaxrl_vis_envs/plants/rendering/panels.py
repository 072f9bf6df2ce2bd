"""Panels: flat pictures in the world, such as walls, fences, ceilings and tables, in focus like the plants. NumPy only."""

import dataclasses
import math

import numpy as np

from jaxrl_vis_envs.plants.family import Family
from jaxrl_vis_envs.plants.rendering import walls
from jaxrl_vis_envs.plants.rendering.surfaces import LITTER
from jaxrl_vis_envs.plants.rendering.tables import NEAR

_MAX_SIDE = 1024  # texels
_UP = np.array([0.0, 0.0, 1.0])
_THIN = ("pickets", "wire")  # kinds that may stand before the row, as one looks through them


@dataclasses.dataclass(frozen=True)
class Panel:
    """Rectangle in the world with a picture.

    Attributes:
        corner: [3] float64, its lower left corner, m.
        right, up: [3] float64, vectors along its sides, m.
        picture: [h, w, 4] float32, reflectance (above 1: a lamp) and opacity; row 0 is at the top.
    """

    corner: np.ndarray
    right: np.ndarray
    up: np.ndarray
    picture: np.ndarray


def sample_panels(rng: np.random.Generator, family: Family) -> list[Panel]:
    """Sample the panels of a daytime plot from its settled family: walls and fences, and indoors a room with furniture."""
    scene, distance = family.scene, family.rig.distance
    middle = 0.5 * family.layout.plot_length
    detail = family.rig.focal / distance  # pixels per m at the row
    panels = []
    if scene.indoors:
        aside = distance * math.sin(math.radians(scene.yaw[0]))  # the cameras' way to the side of the plot's middle
        panels += _room(rng, middle, distance, detail, 2.0 * aside)
    # The usual kinds are as frequent as they are likely to be mistaken for stalks.
    for _ in range(rng.poisson(scene.walls[0])):
        kind = str(rng.choice(list(walls.KINDS), p=walls.SHARES))
        wide, tall = rng.uniform(1.0, 12.0), rng.uniform(0.6, 4.0)
        turn = rng.normal(0.0, 0.25)
        gap = rng.uniform(0.12, 4.0) + 0.5 * wide * abs(math.sin(turn))
        if kind in _THIN and rng.random() < 0.25:
            gap, tall, turn = -rng.uniform(0.1, 0.5) * distance, rng.uniform(0.2, 0.8), rng.normal(0.0, 0.05)
        at = np.array([middle + rng.uniform(-0.5, 0.5) * (wide + 1.0), gap, 0.0])
        panels.append(_upright(rng, kind, at, (wide, tall), turn, detail * distance / (distance + max(gap, 0.0))))
    return panels


def _upright(
    rng: np.random.Generator, kind: str, at: np.ndarray, size: tuple[float, float], turn: float, detail: float
) -> Panel:
    """Return a wall of a kind at ``at`` [3], the middle of its foot; ``detail`` is in pixels per m."""
    wide, tall = size
    right = wide * np.array([math.cos(turn), math.sin(turn), 0.0])
    return Panel(at - 0.5 * right, right, tall * _UP, walls.paint_wall(rng, kind, size, _texels(size, detail)))


def _texels(size: tuple[float, float], detail: float) -> float:
    """Return the number of texels per m of a picture of ``size`` m for ``detail`` pixels per m in the image."""
    return float(min(detail, _MAX_SIDE / max(size)))


def _plain(colour: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.array([*colour, 1.0], np.float32), (2, 2, 4))


def _box(rng: np.random.Generator, foot: np.ndarray, size: np.ndarray, colour: np.ndarray, legs: bool) -> list[Panel]:
    """Return the faces of a box towards the cameras, or of a table or chair with four ``legs``."""
    wide, deep, tall = size
    x, y, z = wide * np.array([1.0, 0, 0]), deep * np.array([0, 1.0, 0]), tall * _UP
    corner = foot - 0.5 * x
    faces = [Panel(corner + z, x, y, _plain(1.2 * colour))]
    if not legs:
        return [*faces, Panel(corner, x, z, _plain(colour)), Panel(corner, y, z, _plain(0.7 * colour))]
    edge, leg = rng.uniform(0.02, 0.06) * _UP, rng.uniform(0.02, 0.06) * np.array([1.0, 0, 0])
    paint = _plain(walls.sample_colour(rng))
    faces.append(Panel(corner + z - edge, x, edge, _plain(0.8 * colour)))
    for side in (0.0, 1.0):
        for back in (0.0, 1.0):
            faces.append(Panel(corner + side * (x - leg) + 0.95 * back * y, leg, z, paint))
    return faces


def _room(rng: np.random.Generator, middle: float, distance: float, detail: float, wider: float) -> list[Panel]:
    """Sample a room: back and side walls, a ceiling with lamps, a floor, tables, chairs, boxes and boards."""
    back, tall, wide = rng.uniform(0.6, 4.5), rng.uniform(2.3, 3.6), rng.uniform(6.0, 12.0) + wider
    wall_detail = detail * distance / (distance + back)
    at = np.array([middle + rng.uniform(-1.5, 1.5), back, 0.0])
    kind = str(rng.choice(["plaster", "bricks", "sheet", "windows", "planks", "shelves"], p=[0.4, 0.2, 0.1, 0.15, 0.05, 0.1]))
    panels = [_upright(rng, kind, at, (wide, tall), 0.0, wall_detail)]
    left, deep = at - [0.5 * wide, 0.0, 0.0], back + distance + 2.0
    near = left - [0.0, deep, 0.0]
    across, along = np.array([wide, 0.0, 0.0]), np.array([0.0, deep, 0.0])
    ceiling, floor = (walls.paint_wall(rng, kind, (wide, deep), _texels((wide, deep), detail)) for kind in ("ceiling", "tiles"))
    panels.append(Panel(near + tall * _UP, across, along, ceiling))
    if rng.random() < 0.6:
        panels.append(Panel(near + 0.002 * _UP, across, along, floor))
    side = rng.choice([0.0, 1.0])
    aside = walls.paint_wall(
        rng, str(rng.choice(["plaster", "windows", "bricks"])), (deep, tall), _texels((deep, tall), detail)
    )
    panels.append(Panel(near + side * across, along, tall * _UP, aside))
    for _ in range(rng.integers(0, 3)):
        size = (rng.uniform(0.5, 2.5), rng.uniform(0.4, 1.2))
        place = at + [rng.uniform(-0.4, 0.4) * wide, -0.02, rng.uniform(0.7, 1.3)]
        panels.append(_upright(rng, "board", place, size, 0.0, wall_detail))
    for _ in range(rng.integers(1, 7)):
        foot = np.array([middle + rng.uniform(-0.4, 0.4) * wide, rng.uniform(0.15, max(back - 0.4, 0.2)), 0.0])
        legs = bool(rng.random() < 0.65)
        size = np.array([rng.uniform(0.3, 1.8), rng.uniform(0.3, 0.8), rng.uniform(0.25, 0.95)])
        panels += _box(rng, foot, size, walls.sample_colour(rng), legs)
        if legs and rng.random() < 0.4:  # the back of a chair
            x = np.array([0.4, 0.0, 0.0])
            panels.append(Panel(foot + [-0.2, 0.4, 0.6], x, 0.35 * _UP, _plain(walls.sample_colour(rng))))
    return panels


def render_panels(
    images: tuple[np.ndarray, np.ndarray, np.ndarray],
    panels: list[Panel],
    camera: tuple[np.ndarray, np.ndarray, float, tuple[float, float]],
    light: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render panels into an image, where they occlude its surfaces.

    Args:
        images: Radiance [H, W, 3], instance [H, W] and planar depth [H, W] (m) of the other surfaces.
        panels: Panels of the plot.
        camera: Position [3] (m) and rotation [3, 3], as in a `Pose`; focal length and principal point, pixels.
        light: Direction towards the sun [3], and light of sun and sky on a white surface, [3] each.

    Returns:
        The three images with the panels, whose label is `surfaces.LITTER`.
    """
    radiance, instance, depth = (np.array(image) for image in images)
    position, rotation, focal, centre = camera
    sun, sunlight, skylight = light
    intrinsics = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    for panel in panels:
        panel_axes = np.stack([panel.right, panel.up, panel.corner - position], axis=1)
        homography = intrinsics @ rotation @ panel_axes
        if abs(np.linalg.det(homography)) < 1e-9:
            continue
        window = _window(homography, depth.shape)
        if window is None:
            continue
        rows, columns = window
        row = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None]
        column = np.arange(columns.start, columns.stop, dtype=np.float32)[None, :]
        # A pixel p at planar depth z is at (a, b) of the panel, where (a, b, 1) = z G p with the inverse G of the homography.
        first, second, third = (
            (row * np.float32(g[1]) + np.float32(g[2])) + column * np.float32(g[0]) for g in np.linalg.inv(homography)
        )
        with np.errstate(invalid="ignore"):  # nothing is infinitely far, and 0 times infinity
            inside = (third * depth[rows, columns] > 1.0) & (third < 1.0 / NEAR)
        inside &= (first >= 0) & (first < third) & (second >= 0) & (second < third)
        there = np.nonzero(inside)
        if not len(there[0]):
            continue
        z = 1.0 / third[there]
        colours = _sample(panel.picture, first[there] * z, second[there] * z)
        normal = np.cross(panel.right, panel.up)
        normal /= np.linalg.norm(normal)
        if (position - panel.corner) @ normal < 0:
            normal = -normal
        lamp = np.maximum(colours[:, :3] - 1.0, 0.0)
        lit = np.minimum(colours[:, :3], 1.0) * (sunlight * max(float(sun @ normal), 0.0) + skylight * 0.75) + lamp * skylight
        opacity = colours[:, 3:]
        place = there[0] + rows.start, there[1] + columns.start
        radiance[place] += opacity * (lit - radiance[place])
        solid = opacity[:, 0] > 0.5
        place = place[0][solid], place[1][solid]
        instance[place], depth[place] = LITTER, z[solid]
    return radiance, instance, depth


def _window(homography: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """Return the rows and columns of an image that contain a panel; None if there are none."""
    corners = homography @ np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0], [1.0] * 4])
    if (corners[2] < NEAR).all():
        return None
    if (corners[2] < NEAR).any():
        return slice(0, shape[0]), slice(0, shape[1])
    columns, rows = corners[:2] / corners[2]
    top, left = max(math.floor(rows.min()), 0), max(math.floor(columns.min()), 0)
    bottom, right = min(math.ceil(rows.max()) + 1, shape[0]), min(math.ceil(columns.max()) + 1, shape[1])
    return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None


def _sample(picture: np.ndarray, across: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Interpolate a picture at coordinates [N] of its panel from 0 to 1: [N, 4] float32."""
    height, width = picture.shape[:2]
    column = np.clip(across * width - 0.5, 0.0, width - 1.001)
    row = np.clip((1.0 - above) * height - 0.5, 0.0, height - 1.001)
    left, top = column.astype(np.int32), row.astype(np.int32)
    u, v = (column - left)[:, None], (row - top)[:, None]
    flat, at = picture.reshape(-1, 4), top * width + left
    upper = flat[at] + (flat[at + 1] - flat[at]) * u
    lower = flat[at + width] + (flat[at + width + 1] - flat[at + width]) * u
    return upper + (lower - upper) * v
