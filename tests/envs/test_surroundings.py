"""Surroundings of daytime plots: each factor changes the image, and no pixel becomes part of a stalk."""

import dataclasses
import functools

import numpy as np
import pytest

from jaxrl_vis_envs import plants
from jaxrl_vis_envs.plants import TRAINING
from jaxrl_vis_envs.plants.pairs import Sequence, panels
from jaxrl_vis_envs.plants.rendering import drawing, walls
from jaxrl_vis_envs.plants.rendering.overlays import add_flare, draw_overlay, replicate_border
from jaxrl_vis_envs.plants.rendering.panels import Panel, render_panels
from jaxrl_vis_envs.plants.rendering.surfaces import LITTER, NOTHING, build_surfaces
from jaxrl_vis_envs.plants.scene import Scene
from jaxrl_vis_envs.plants.truth import outline

WIDTH = 211
NONE = {"robot": 0, "objects": (0, 0), "borders": 0, "walls": (0, 0), "structures": (0, 0), "organs": (0, 0), "hanging": (0, 0),
        "flare": 0, "overlay": 0, "replicated": 0, "glare": (0, 0), "grass": 0, "indoors": 0, "maize": 1, "single": 1,
        "portrait": 1, "potted": 0, "yaw": (0, 0), "roll": (0, 0), "lens": (70, 70)}  # fmt: skip


@functools.cache
def rendered(seed: int = 3, **scene) -> tuple[Sequence, tuple[np.ndarray, ...]]:
    family = dataclasses.replace(TRAINING, name="around", stream=9, scene=Scene(share=1.0, **NONE | scene)).at_width(WIDTH)
    sequence = Sequence.of(plants.draw(family, seed))
    return sequence, tuple(np.asarray(part) for part in sequence.left(17))


def test_a_single_plant_fills_an_upright_image():
    sequence, (image, instance, _) = rendered()
    assert image.shape[0] > image.shape[1] == TRAINING.at_width(WIDTH).rig.height
    assert len(sequence.plot.stalks) == 1
    rows = np.flatnonzero((instance == 0).any(axis=1))
    assert np.ptp(rows) > 0.25 * len(instance)


@pytest.mark.parametrize(
    ("factor", "minimum"),
    [
        ({"walls": (4, 4)}, 0.05),
        ({"structures": (8, 8)}, 0.003),
        ({"organs": (1, 1)}, 0.001),
        ({"hanging": (1, 1)}, 0.0005),
        ({"indoors": 1}, 0.3),
        ({"glare": (3, 3)}, 0.05),
        ({"flare": 1}, 0.2),
        ({"overlay": 1}, 0.002),
        ({"replicated": 1}, 0.003),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_each_factor_shows_and_leaves_the_stalk_where_it_is(factor, minimum):
    """Surroundings in front of a stalk may hide it, but no pixel becomes part of one."""
    shares = []
    for seed in (3, 4):
        base, (image, instance, _) = rendered(seed)
        changed, (other, seen, _) = rendered(seed, **factor)
        shares.append((np.abs(other.astype(int) - image).max(axis=2) > 12).mean())
        for one, same in zip(base.plot.stalks, changed.plot.stalks, strict=True):
            np.testing.assert_array_equal(one.points, same.points)
        assert not ((seen >= 0) & (instance < 0)).any()
    assert max(shares) > minimum


def test_all_surroundings_share_one_trace():
    rendered()
    program = drawing._program(4, drawing.tile_size(WIDTH), 1, 1)
    before = drawing._program.cache_info().currsize, program._cache_size()
    rendered(5, walls=(3, 3), structures=(3, 3), organs=(1, 1), indoors=1, robot=1, portrait=0)  # level, not upright
    assert (drawing._program.cache_info().currsize, program._cache_size()) == before


CAMERA = (np.array([0.0, -2.0, 1.0]), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), 100.0, (50.0, 40.0))
LIGHT = (np.array([0.0, -1.0, 0.0]), np.full(3, 0.5), np.full(3, 1.0))


def scene(depth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros((81, 101, 3), np.float32), np.full((81, 101), 7, np.int32), np.full((81, 101), depth, np.float32)


def test_a_panel_is_where_it_projects():
    """A board of 1 x 0.5 m, 2 m away, its foot level with the camera, covers 50 columns and the 25 rows above the middle."""
    picture = np.concatenate([np.full((4, 4, 3), 0.4, np.float32), np.ones((4, 4, 1), np.float32)], axis=2)
    board = Panel(np.array([-0.5, 0.0, 1.0]), np.array([1.0, 0, 0]), np.array([0, 0, 0.5]), picture)
    radiance, instance, depth = render_panels(scene(5.0), [board], CAMERA, LIGHT)
    row, column = np.nonzero(instance == LITTER)
    assert (row.min(), row.max()) == (16, 40) and (column.min(), column.max()) == (25, 74)
    np.testing.assert_allclose(depth[row, column], 2.0, rtol=1e-5)
    np.testing.assert_allclose(radiance[30, 50], 0.4 * (0.5 + 0.75), rtol=1e-5)
    assert (instance[50:] == 7).all() and (radiance[50:] == 0).all()
    hidden = render_panels(scene(1.5), [board], CAMERA, LIGHT)
    assert (hidden[1] == 7).all() and not hidden[0].any()
    behind = dataclasses.replace(board, corner=board.corner - [0, 4.0, 0])
    assert (render_panels(scene(np.inf), [behind], CAMERA, LIGHT)[1] == 7).all()


def test_one_looks_through_a_fence():
    picture = walls.paint_wall(np.random.default_rng(2), "pickets", (1.0, 0.5), 100.0)
    fence = Panel(np.array([-0.5, 0.0, 1.0]), np.array([1.0, 0, 0]), np.array([0, 0, 0.5]), picture)
    _, instance, depth = render_panels(scene(5.0), [fence], CAMERA, LIGHT)
    area = instance[18:40, 26:74]
    assert 0.1 < (area == LITTER).mean() < 0.9
    np.testing.assert_array_equal(instance == LITTER, depth < 5)


@pytest.mark.parametrize("kind", [*walls.KINDS, "plaster", "shelves", "ceiling"])
def test_walls_can_be_painted(kind):
    pictures = [walls.paint_wall(np.random.default_rng(seed), kind, (3.0, 2.0), 60.0) for seed in range(3)]
    for picture in pictures:
        assert picture.shape == (120, 180, 4) and picture.dtype == np.float32
        assert np.isfinite(picture).all() and picture.min() >= 0 and picture[..., 3].max() <= 1
        assert np.ptp(picture) > 0
    assert np.abs(pictures[0] - pictures[1]).max() > 0
    assert (pictures[0][..., :3].max() > 1.5) == (kind == "ceiling") or kind in ("bricks", "blinds", "tiles")


def test_an_overlay_has_pure_colours_and_little_else_changes():
    image = np.full((80, 100, 3), 90, np.uint8)
    drawn = draw_overlay(image, np.random.default_rng(1))
    changed = np.not_equal(drawn, image).any(axis=2)
    assert 0 < changed.mean() < 0.5
    assert np.isin(drawn[changed], (0, 255)).all(axis=1).mean() > 0.5


def test_a_repeated_border_is_no_longer_part_of_the_scene():
    image = np.random.default_rng(0).integers(0, 255, (80, 100, 3)).astype(np.uint8)
    masks = []
    for seed in range(6):
        values, shown = replicate_border(image, np.random.default_rng(seed))
        assert 0.9 < shown.mean() < 1.0 and (values[shown] == image[shown]).all()
        masks.append(shown)
    _, (_, instance, _) = rendered(replicated=1)
    assert len({mask.tobytes() for mask in masks}) > 1 and (instance == NOTHING).any()


def test_flare_only_adds_light():
    radiance = np.full((80, 100, 3), 0.2, np.float32)
    lit = add_flare(radiance, np.random.default_rng(0))
    assert lit.shape == radiance.shape and (lit >= radiance).all() and lit.max() > 1.5 * radiance.max()


def test_night_has_no_surroundings():
    plot = plants.draw(TRAINING, 3)
    assert panels(plot.family, 3) == []
    assert (build_surfaces(plot).cone_stalk >= 0).all()


def test_truth_of_an_upright_image_is_where_the_stalk_is():
    sequence, (_, instance, _) = rendered()
    heights = np.linspace(0.2, 0.6 * sequence.plot.stalks[0].points[-1, 2], 60)
    edges = outline(sequence.plot.stalks[0], sequence.drive.poses[17], sequence.drive.true, heights)
    column, row = np.round(edges.mean(axis=1)).astype(int).T
    inside = (row >= 0) & (row < instance.shape[0]) & (column >= 0) & (column < instance.shape[1])
    assert inside.sum() > 10 and (instance[row[inside], column[inside]] == 0).mean() > 0.3
