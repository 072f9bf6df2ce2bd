"""Daytime plots: other families are unchanged, the ground truth fits rotated images, and effects do what they claim."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxrl_vis_envs import plants
from jaxrl_vis_envs.plants import SHIFTED, TRAINING
from jaxrl_vis_envs.plants.field import generator
from jaxrl_vis_envs.plants.pairs import Sequence, daylight, grass
from jaxrl_vis_envs.plants.rendering import backdrop
from jaxrl_vis_envs.plants.rendering.blades import Blades, render_blades
from jaxrl_vis_envs.plants.rendering.degrading import degrade
from jaxrl_vis_envs.plants.rendering.surfaces import GROUND, NOTHING, OBJECT, build_surfaces
from jaxrl_vis_envs.plants.scene import Scene
from jaxrl_vis_envs.plants.settling import settle
from jaxrl_vis_envs.plants.spec import read
from jaxrl_vis_envs.plants.truth import stalks_in_view

FAMILIES = Path(__file__).parents[2] / "benchmarks" / "stalks" / "families"


def by_day(**scene) -> plants.Family:
    return dataclasses.replace(TRAINING, name="day", stream=9, scene=Scene(share=1.0, **scene)).at_width(211)


# No surroundings and no effects on images.
PLAIN = {"robot": 0, "objects": (0, 0), "borders": 0, "walls": (0, 0), "structures": (0, 0), "organs": (0, 0),
         "hanging": (0, 0), "flare": 0, "overlay": 0, "replicated": 0, "single": 0, "portrait": 0, "glare": (0, 0)}  # fmt: skip
# Nothing but stalks, from aside and rolled.
BARE = dataclasses.replace(
    by_day(**PLAIN, maize=0, potted=0, indoors=0, yaw=(30, 30), roll=(5, 5), lens=(76, 76),
           distance=(0.8, 0.8), camera_height=(0.42, 0.42), pitch=(0, 0), resolution=(1, 1), motion=(0, 0)),
    leaves=dataclasses.replace(TRAINING.leaves, density=0.0, litter=0.0),
    layout=dataclasses.replace(TRAINING.layout, rows_behind=0),
)  # fmt: skip


@pytest.fixture(scope="module")
def bare() -> tuple[Sequence, tuple]:
    sequence = Sequence.of(plants.draw(BARE, 3))
    return sequence, tuple(np.asarray(part) for part in sequence.left(17))


@pytest.mark.parametrize(
    ("family", "sums"),
    [
        (TRAINING, (83157.20546503071, 185.75799649217166, 845602.1237913579, 5773269.5)),
        (SHIFTED, (83157.78964458316, 190.2136573962319, 1083556.244230996, 3886244.0)),
    ],
    ids=["training", "shifted"],
)
def test_families_without_days_are_as_they_were(family, sums):
    """Sums of the surfaces equal those from before daytime plots were added; images follow from them in another program."""
    plot = plants.draw(family, 3)
    assert plot.family is family and settle(family, generator(family, 3, "scene")) is family
    assert daylight(family, 3) is None
    surfaces = build_surfaces(plot)
    found = [float(np.abs(part).sum()) for part in (surfaces.start, surfaces.radii, surfaces.corners, surfaces.materials)]
    np.testing.assert_allclose(found, sums, rtol=1e-5)


def test_every_sampled_plot_keeps_the_limits_of_families():
    """`Family` refuses values outside the limits, as plots of single low plants once had."""
    family = read(FAMILIES / "daylight_all.toml")
    plots = [settle(family, np.random.default_rng(seed)) for seed in range(1500)]
    assert sum(plot.scene.share == 1 for plot in plots) > 500


def test_a_night_of_a_mixed_family_is_one_without_days():
    mixed = dataclasses.replace(TRAINING, scene=Scene(share=1e-9)).at_width(211)
    night = plants.draw(mixed, 3)
    assert night.family == TRAINING.at_width(211)
    one, other = (Sequence.of(plot).left(2) for plot in (night, plants.draw(TRAINING.at_width(211), 3)))
    for mine, wanted in zip(one, other):
        np.testing.assert_array_equal(mine, wanted)


def test_boxes_of_turned_and_rolled_cameras_hold_the_stalks(bare):
    sequence, (image, instance, depth) = bare
    pose = sequence.drive.poses[17]
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert abs(abs(np.degrees(np.arctan2(pose.rotation[2, 0], pose.rotation[2, 1]))) - 30.0) < 1e-6
    stalks = stalks_in_view(sequence.plot, pose, sequence.drive.true, instance, depth)
    clear = [stalk for stalk in stalks if stalk.band_box is not None and stalk.pixels > 30]
    assert len(clear) > 5 and np.median([stalk.visible for stalk in clear]) > 0.8
    for stalk in clear:
        left, top, right, bottom = stalk.box
        row, column = np.nonzero(instance == stalk.stalk)
        assert left - 1.5 <= column.min() and column.max() <= right + 1.5
        assert top - 1.5 <= row.min() and row.max() <= bottom + 1.5
    assert image[np.isinf(depth)].mean() > 10  # the sky is not black


def test_equal_seeds_give_equal_days(bare):
    _, (image, *_) = bare
    np.testing.assert_array_equal(np.asarray(Sequence.of(plants.draw(BARE, 3)).left(17)[0]), image)
    assert np.abs(np.asarray(Sequence.of(plants.draw(BARE, 4)).left(17)[0]).astype(int) - image).mean() > 1


def test_things_that_are_no_stalk_are_never_counted():
    plot = plants.draw(by_day(potted=1, indoors=0, robot=1, objects=(4, 4)), 5)
    surfaces = build_surfaces(plot)
    assert (surfaces.cone_stalk == OBJECT).sum() > 10
    assert set(surfaces.cone_stalk[surfaces.cone_stalk != OBJECT]) == set(range(len(plot.stalks)))
    assert len(surfaces.materials) == 1 + max(surfaces.cone_material.max(), surfaces.triangle_material.max())
    assert 1 <= len(plot.measured) <= 2 and all(stalk.row == 0 for stalk in plot.stalks)


def test_factors_stay_in_their_ranges():
    family = by_day(single=0, portrait=0)
    drawn = [plants.draw(dataclasses.replace(family, leaves=BARE.leaves), seed).family for seed in range(30)]
    views = [np.degrees(2 * np.arctan(0.5 * each.rig.width / each.rig.focal)) for each in drawn]
    assert 50 <= min(views) < 65 and 95 < max(views) <= 110
    assert {each.scene.maize for each in drawn} == {0.0, 1.0} == {each.scene.robot for each in drawn}
    thick = [each.stalks.diameter_mean for each in drawn if each.scene.maize]
    assert 0.0154 <= min(thick) and max(thick) <= 0.0264


def test_plain_cameras(bare):
    _, (image, *_) = bare
    clean = Scene(white_balance=0.0, jpeg=(100, 100), motion=(0, 0), resolution=(1, 1), borders=0, overlay=0, replicated=0)

    def taken(**changes):
        return degrade(image, dataclasses.replace(clean, **changes), np.random.default_rng(3))

    def detail(values):
        return np.abs(np.diff(values.astype(float), axis=1)).mean()

    plain, shown = taken()
    assert shown.all()
    assert detail(taken(jpeg=(10, 10))[0]) != detail(plain)
    assert detail(taken(motion=(0.02, 0.02))[0]) < 0.8 * detail(plain)
    assert detail(taken(resolution=(0.3, 0.3))[0]) < 0.8 * detail(plain)
    bordered, shown = taken(borders=1.0)
    assert 0.5 < shown.mean() < 1.0 and not bordered[~shown].any()


def test_pixels_under_a_border_show_nothing():
    sequence = Sequence.of(plants.draw(dataclasses.replace(BARE, scene=dataclasses.replace(BARE.scene, borders=1.0)), 3))
    image, instance, _ = (np.asarray(part) for part in sequence.left(17))
    black = ~image.any(axis=2)
    assert black.mean() > 0.005 and (instance[black] == NOTHING).mean() > 0.9


def test_backdrops(monkeypatch):
    rooms = [
        backdrop.sample_backdrop(np.random.default_rng(seed), indoors, False, 1.0) for seed, indoors in ((0, True), (0, False))
    ]
    assert all(room.shape == (*backdrop.SHAPE, 3) and np.isfinite(room).all() and room.min() >= 0 for room in rooms)
    monkeypatch.setattr(backdrop, "photograph_files", list)
    with pytest.raises(ValueError, match="pip install scikit-image"):
        backdrop.sample_backdrop(np.random.default_rng(0), False, True, 1.0)


def one_blade() -> Blades:
    """A blade, 20 cm tall, 2 m in front of a camera at the origin that looks along z: 100 to 50 rows below the centre."""
    points = np.array([[[0.0, 0.4, 2.0], [0.0, 0.3, 2.0], [0.0, 0.2, 2.0]]])
    return Blades(points, np.array([0.02]), np.array([[3.0, 2.0, 1.0]]))


def test_a_blade_stands_where_it_projects_in_the_colour_of_its_ground():
    radiance, depth = np.full((301, 201, 3), 0.1, np.float32), np.full((301, 201), 5.0, np.float32)
    ground = np.full((301, 201), GROUND, np.int32)
    for baseline in (0.0, 0.1):
        camera = (np.array([baseline, 0.0, 0.0]), np.eye(3), 500.0, (100.0, 150.0))
        changed = render_blades(radiance, ground, depth, one_blade(), camera) != radiance
        row, column = np.nonzero(changed.any(axis=2))
        assert (row.min(), row.max()) == (200, 250)
        assert np.median(column) == 100 - 500 * baseline / 2
        assert abs(np.ptp(column[row == 250]) - 5) <= 1 and np.ptp(column[row == 205]) <= 2
    covered = render_blades(radiance, ground, depth, one_blade(), camera)
    np.testing.assert_allclose(covered[240, 75], [0.3, 0.2, 0.1], rtol=1e-5)


def test_a_blade_is_hidden_by_what_is_nearer():
    radiance, depth = np.full((301, 201, 3), 0.1, np.float32), np.full((301, 201), 5.0, np.float32)
    depth[:230] = 1.5
    instance = np.where(depth < 2, 7, GROUND).astype(np.int32)
    covered = render_blades(radiance, instance, depth, one_blade(), (np.zeros(3), np.eye(3), 500.0, (100.0, 150.0)))
    row, _ = np.nonzero((covered != radiance).any(axis=2))
    assert (row.min(), row.max()) == (230, 250)


def test_blades_grow_on_grass_by_day_only():
    with_grass = [grass(plants.draw(by_day(grass=1.0, indoors=0, single=0), seed).family, seed) for seed in range(8)]
    grown = [blades for blades in with_grass if blades is not None]
    assert 3 <= len(grown) < 8 and all(len(blades.points) > 500 for blades in grown)
    assert all(np.ptp(blades.points[:, 0, 2]) == 0 < blades.points[:, 2, 2].min() for blades in grown)
    assert grass(plants.draw(by_day(grass=0.0), 3).family, 3) is None and grass(TRAINING, 3) is None


@pytest.mark.parametrize("path", sorted(FAMILIES.glob("*.toml")), ids=lambda path: path.stem)
def test_families_of_the_benchmarks_can_be_read(path):
    family = plants.read(path)
    assert family.name == path.stem and (family.scene.share > 0) == (path.stem not in ("thin_wet", "thick_dry", "other_rig"))


def test_values_of_a_scene_are_checked():
    with pytest.raises(ValueError, match="scene.lens must be from 20 to 130"):
        by_day(lens=(10, 50))
    with pytest.raises(ValueError, match="scene.pitch must be from -30 to 60"):
        by_day(pitch=(-40, 5))
    with pytest.raises(ValueError, match="scene.jpeg must run from low to high"):
        by_day(jpeg=(90, 50))
