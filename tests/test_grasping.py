"""Grasping: clouds and their stitches, grasp points, the networks that paint stalks, and the command on good and bad input."""

import csv
import dataclasses
import json
import math
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxrl_vis import cli
from jaxrl_vis.cli.families import family_of
from jaxrl_vis.cli.grasp_train import _Drawn as Drawn
from jaxrl_vis.errors import NonFiniteError, RequestError
from jaxrl_vis.evaluation_pool import finite
from jaxrl_vis.grasping.chords import chords_of, joined
from jaxrl_vis.grasping.cloud import Cloud, Mount, match, organised, redness, thinned
from jaxrl_vis.grasping.evaluate import RunScore, draw_scene, match_stalks, score_scene, stitch_error, summary, true_motion
from jaxrl_vis.grasping.figure import draw_figure
from jaxrl_vis.grasping.lines import grasp_points
from jaxrl_vis.grasping.masks.examples import Example
from jaxrl_vis.grasping.masks.loop import Plan, crops, train
from jaxrl_vis.grasping.masks.painter import Painter, Settings, read_weights, write_weights
from jaxrl_vis.grasping.masks.variation import vary
from jaxrl_vis.grasping.perceive import ORIGINAL, OURS, View, Ways, perceive
from jaxrl_vis.grasping.pipeline import Request, run
from jaxrl_vis.grasping.reach_figures import draw_reach
from jaxrl_vis.grasping.records import Conditions, evaluate_run
from jaxrl_vis.grasping.sight import Sight
from jaxrl_vis.grasping.slices import slice_at, slice_points
from jaxrl_vis.grasping.stitch import DEFAULT, THESIS, Motion, Thinned, rigid, stitch
from jaxrl_vis.phenotyping.calibration import read_calibration
from jaxrl_vis.phenotyping.folders import find_plots
from jaxrl_vis_envs.plants import Calibration, Pose, draw, drive, read
from jaxrl_vis_envs.plants.grasping import GRASPING, GRASPING_FAMILIES, GRASPING_SHIFTED, LEAST_RANGE

CAMERA = Calibration(320, 320, 190.0, (159.5, 159.5), 0.07)
MOUNT = Mount()
WIDTH = ["--width", "256", "--frames", "3"]
FEW = {
    "layout": {"rows_behind": 0, "stalks_mean": 7, "stalks_sd": 0, "tillers": 0, "spacing_minimum": 0.08, "plot_length": 1.0},
    "leaves": {"density": 0.4, "litter": 10},
    "stalks": {"diameter_mean": 0.024, "diameter_sd": 0.002, "lean_sd": [1, 1]},
    "imaging": {"samples": 1},
}


def turned(angles: tuple[float, float, float], shift: tuple[float, float, float]) -> Motion:
    """A motion by angles about the axes in degrees and a shift in m."""
    rotation = np.eye(3)
    for axis, angle in enumerate(np.radians(angles)):
        one = np.eye(3)
        first, second = [each for each in range(3) if each != axis]
        one[first, first] = one[second, second] = math.cos(angle)
        one[first, second], one[second, first] = -math.sin(angle), math.sin(angle)
        rotation = one @ rotation
    return Motion(rotation, np.array(shift))


def thicket(count: int = 12000) -> np.ndarray:
    """Points [N, 3] on vertical stalks and on a few leaves of 1.6 m of row, m."""
    rng = np.random.default_rng(0)
    foot = np.stack([np.linspace(-0.8, 0.8, 25) + rng.normal(0, 0.015, 25), 0.55 + rng.normal(0, 0.03, 25)], axis=1)
    which = rng.integers(25, size=count)
    stalks = np.column_stack([foot[which], rng.uniform(0.3, 1.2, count)])
    start, along = rng.uniform([-0.8, 0.4, 0.6], [0.8, 0.7, 1.2], (30, 3)), rng.normal(0, 0.15, (30, 3))
    leaf, share = rng.integers(30, size=count // 2), rng.random((count // 2, 1))
    return np.concatenate([stalks, start[leaf] + share * along[leaf]])


# --- families ---


def test_families_are_a_pair_one_metre_up_that_takes_five_pairs_over_half_a_metre():
    for name, family in GRASPING_FAMILIES.items():
        passing = drive(family, 3)
        assert len(passing.poses) == 5 and (passing.true.width, passing.true.height) == (1024, 1024), name
        x = np.array([pose.position[0] for pose in passing.poses]) + passing.true.baseline / 2
        np.testing.assert_allclose(np.diff(x), 0.1)
        assert x.mean() == pytest.approx(family.layout.plot_length / 2)
        height, away = (np.mean([pose.position[axis] for pose in passing.poses]) for axis in (2, 1))
        assert height == pytest.approx(1.0, abs=0.06) and -away == pytest.approx(0.55, abs=0.06)
        assert -away > LEAST_RANGE
        # It looks down by 15 degrees.
        assert math.degrees(math.asin(-passing.poses[0].rotation[2, 2])) == pytest.approx(15.0, abs=3.0)
        scale = passing.odometry[-1] / 0.4
        assert 0.005 < abs(scale - 1.0) < 0.035
        per_metre = family.layout.stalks_mean / family.layout.plot_length
        assert per_metre == pytest.approx(33 / 2.134)
    assert GRASPING.stream != GRASPING_SHIFTED.stream and GRASPING_SHIFTED.imaging.noise == 2.0


# --- clouds ---


def test_red_is_red():
    pixels = np.array([[255, 0, 0], [255, 255, 255], [90, 60, 20], [0, 255, 0]], np.uint8)
    np.testing.assert_allclose(redness(pixels), [1.0, 0.0, 30 / 255, -1.0], atol=1e-6)


@pytest.mark.parametrize("depth", [0.56, 0.24])
def test_a_plane_is_matched_and_put_where_it_is(depth):
    rng = np.random.default_rng(0)
    disparity = round(CAMERA.focal * CAMERA.baseline / depth)
    texture = rng.integers(0, 255, (320, 320 + disparity)).astype(np.uint8)
    left, right = texture[:, :320], texture[:, disparity : disparity + 320]
    found = match(left, right, CAMERA, MOUNT)
    assert np.isfinite(found[:, disparity + 8 :]).mean() > 0.98
    np.testing.assert_allclose(np.nanmedian(found), disparity, atol=0.1)
    cloud = organised(found, np.zeros(found.shape, bool), CAMERA, MOUNT)
    assert cloud.points.shape == (320, 320, 3) and len(cloud.red_points()) == 0
    depth = CAMERA.focal * CAMERA.baseline / disparity
    # The middle of the image is that far away along a ray that points down by 15 degrees.
    expected = [0.0, depth * math.cos(math.radians(15)), 1.0 - depth * math.sin(math.radians(15))]
    np.testing.assert_allclose(cloud.points[159:161, 159:161].mean(axis=(0, 1)), expected, atol=0.005)


def test_thinning_takes_the_mean_of_each_cube():
    points = np.array([[0.001, 0.001, 0.001], [0.003, 0.003, 0.003], [0.5, 0.5, 0.5]])
    np.testing.assert_allclose(thinned(points, 0.01), [[0.002] * 3, [0.5] * 3])
    assert len(thinned(np.zeros((0, 3)), 0.01)) == 0


# --- stitching ---


def test_the_rigid_motion_of_points_is_found():
    motion = turned((3.0, -5.0, 8.0), (0.1, -0.2, 0.05))
    points = np.random.default_rng(1).normal(size=(50, 3))
    found = rigid(points, motion(points), np.ones(50))
    np.testing.assert_allclose(found.rotation, motion.rotation, atol=1e-9)
    np.testing.assert_allclose(found.after(motion.inverse()).shift, np.zeros(3), atol=1e-9)
    assert found.angle == pytest.approx(motion.angle)


def test_odometry_and_a_narrow_gate_find_the_motion_and_the_thesis_does_not():
    whole = thicket()
    motion = turned((0.3, -0.2, 0.4), (-0.1, 0.004, -0.003))
    rng = np.random.default_rng(2)
    here, there = (part[rng.random(len(part)) < 0.8] for part in (whole, motion(whole)))
    here, there = (part + rng.normal(0, 0.001, part.shape) for part in (here, there))
    here, there = (part[np.abs(part[:, 0]) < 0.4] for part in (here, there))  # each pair sees its own part of the row
    place = np.array([0.0, 0.55, 0.75])
    found = stitch(Thinned(here), Thinned(there), 0.103)
    assert not found.refused and found.overlap > 0.6 and found.residual < 0.004
    assert np.linalg.norm((found.motion(place) - motion(place))[:2]) < 0.002
    blind = stitch(Thinned(here, THESIS), Thinned(there, THESIS), 0.103, THESIS)
    assert np.linalg.norm((blind.motion(place) - motion(place))[:2]) > 0.006


def test_what_odometry_rules_out_is_refused():
    whole = Thinned(thicket())
    found = stitch(whole, whole, 0.2)  # odometry says that the robot moved; it did not
    assert found.refused and np.allclose(found.motion.shift, [-0.2, 0, 0])
    assert "overlap" in found.refused or "moved" in found.refused
    assert stitch(whole, Thinned(np.zeros((0, 3))), 0.1).refused == "a cloud is empty"
    assert not stitch(whole, whole, 0.2, THESIS).refused


def test_stitch_errors_are_those_of_the_row():
    poses = drive(GRASPING, 0).poses
    motion = true_motion(poses[0], poses[1], MOUNT)
    assert stitch_error(motion, poses[0], poses[1], MOUNT) < 1e-9
    off = Motion(motion.rotation, motion.shift + [0.003, 0.004, 0.5])
    assert stitch_error(off, poses[0], poses[1], MOUNT) == pytest.approx(0.005)
    # A robot that moves by 0.1 m sees the row move by as much the other way.
    still = Pose(poses[0].position + [0.1, 0, 0], poses[0].rotation)
    np.testing.assert_allclose(true_motion(poses[0], still, Mount(1.0, 15.0)).shift, [-0.1, 0, 0], atol=2e-3)


# --- grasp points ---


def seen(
    stalks: list[tuple[float, float, float]],
    driven: float,
    hidden: tuple[float, float] = (9.0, 9.0),
    bend: float = 0.0,
    taper: float = 0.0,
) -> Cloud:
    """What one pair sees of stalks: x and y of their feet, and lean along the row in m per m; 14 mm thick at 0.75 m, m.

    Args:
        stalks: In the robot frame of the last pair.
        driven: How far the robot still has to drive until then.
        hidden: Heights between which nothing is seen.
        bend: Of all stalks, along the row, per m.
        taper: By how much they are thicker for each m upwards, m.
    """
    pose = MOUNT.pose
    depth = np.full((320, 320), np.nan, np.float32)
    for x, y, lean in sorted(stalks, key=lambda stalk: -stalk[1]):
        heights = np.linspace(0.2, 1.3, 3000)
        heights = heights[(heights < hidden[0]) | (heights > hidden[1])]
        middle = np.stack([x + lean * heights + bend * heights**2 + driven, np.full_like(heights, y), heights], axis=1)
        radius = 0.007 + 0.5 * taper * (heights - 0.75)
        for angle in np.linspace(-0.5 * np.pi, 0.5 * np.pi, 61):
            front = middle + radius[:, None] * [math.sin(angle), -math.cos(angle), 0.0]
            camera = pose.to_camera(front)
            column, line = np.round(camera[:, :2] / camera[:, 2:] * CAMERA.focal + CAMERA.centre).astype(int).T
            inside = (column >= 0) & (column < 320) & (line >= 0) & (line < 320)
            depth[line[inside], column[inside]] = camera[inside, 2]
    red = np.isfinite(depth)
    background = np.where(red, depth, np.float32(0.9))
    return organised(CAMERA.disparity(background).astype(np.float32), red, CAMERA, MOUNT)


STALKS = [(-0.25, 0.55, 0.05), (-0.13, 0.6, -0.08), (-0.05, 0.52, 0.0), (0.1, 0.57, 0.1)]


def found_in(clouds: list[Cloud], motions: list[Motion]):
    parts = [chords_of(cloud, CAMERA, MOUNT, frame) for frame, cloud in enumerate(clouds)]
    parts = [dataclasses.replace(part, middle=motion(part.middle)) for motion, part in zip(motions, parts)]
    return grasp_points(joined(parts), Sight(tuple(clouds), tuple(motions), CAMERA, MOUNT))


def test_a_line_per_stalk_in_spite_of_what_hides_it():
    clouds = [seen(STALKS, 0.1, hidden=(0.6, 0.85)), seen(STALKS, 0.05), seen(STALKS, 0.0, hidden=(0.5, 0.7))]
    points = found_in(clouds, [Motion.along(-0.1), Motion.along(-0.05), Motion.along(0.0)])
    assert len(points) == len(STALKS)
    for point, (x, y, lean) in zip(points, STALKS):
        assert 0.45 <= point.point[2] <= 1.05 and point.frames == 3
        assert abs(point.point[0] - x - lean * point.point[2]) < 0.002 and abs(point.point[1] - y) < 0.003
        assert point.direction[0] / point.direction[2] == pytest.approx(lean, abs=0.02)
        assert point.thickness == pytest.approx(0.014, abs=0.004)
        assert point.at_height(0.5)[0] == pytest.approx(x + 0.5 * lean, abs=0.008)


def test_lines_bend_and_taper_as_the_stalks_do():
    """A straight line would be 19 mm beside them at 0.45 m, and 11 mm at 1.05 m."""
    bend, taper = -0.12, -0.012
    clouds = [
        seen(STALKS, far, hidden=hidden, bend=bend, taper=taper) for far, hidden in ((0.1, (0.5, 0.7)), (0.05, (9.0, 9.0)))
    ]
    points = found_in(clouds, [Motion.along(-0.1), Motion.along(-0.05)])
    assert len(points) == len(STALKS)
    for point, (x, y, lean) in zip(points, STALKS):
        for height in (0.35, 0.45, 0.75, 1.05):
            there = point.at_height(height)
            np.testing.assert_allclose(there, [x + lean * height + bend * height**2, y, height], atol=0.004)
        assert point.direction[0] / point.direction[2] == pytest.approx(lean + 2 * bend * point.point[2], abs=0.02)
        np.testing.assert_allclose(point.at_height(np.array([0.45, 1.05]))[1], point.at_height(1.05))
        assert point.taper == pytest.approx(taper, abs=0.006)
        assert point.thickness_at(0.45) - point.thickness_at(1.05) == pytest.approx(-0.6 * point.taper)
        assert point.thickness_at(9.0) == 0.5 * point.thickness


def both(one: Cloud, other: Cloud) -> Cloud:
    """What a pair sees of what is in two clouds."""
    depth = np.fmin(*(np.where(cloud.red, cloud.depth, np.float32(np.nan)) for cloud in (one, other)))
    red = np.isfinite(depth)
    return organised(CAMERA.disparity(np.where(red, depth, np.float32(0.9))).astype(np.float32), red, CAMERA, MOUNT)


def test_stalks_beside_each_other_in_one_pair_are_two():
    """Their grasp points are so far apart in height that the lines alone could be of one stalk."""
    left, right = (0.0, 0.55, 0.0), (0.021, 0.55, 0.0)
    drives = (0.1, 0.05, 0.0)
    clouds = [both(seen([left], far, hidden=(0.6, 9.0)), seen([right], far, hidden=(0.0, 0.48))) for far in drives]
    points = found_in(clouds, [Motion.along(-far) for far in drives])
    assert [round(point.point[0], 3) for point in points] == pytest.approx([0.0, 0.021], abs=0.003)
    assert abs(points[0].point[2] - points[1].point[2]) > 0.25


def test_a_stalk_that_pairs_show_beside_itself_is_one():
    drives = (0.1, 0.05, 0.0)
    clouds = [seen([(0.0, 0.55, 0.0)], far, hidden=(0.5, 0.9) if far else (9.0, 9.0)) for far in drives]
    points = found_in(clouds, [Motion.along(-far + (0.0 if far else 0.014)) for far in drives])
    assert len(points) == 1


def test_what_other_pairs_see_through_is_no_stalk():
    ghost = (0.02, 0.5, 0.0)
    clouds = [seen([*STALKS, ghost], 0.1), seen(STALKS, 0.05), seen(STALKS, 0.0)]
    motions = [Motion.along(-0.1), Motion.along(-0.05), Motion.along(0.0)]
    assert len(found_in(clouds, motions)) == len(STALKS)
    assert len(found_in([clouds[0]], [Motion.along(-0.1)])) == len(STALKS) + 1  # one pair alone must be believed


def test_nothing_is_found_in_nothing():
    clouds = [seen([], 0.0), seen([], 0.1)]
    assert found_in(clouds, [Motion.along(-0.1), Motion.along(0.0)]) == []


def test_slices_see_each_stalk_once_and_its_front():
    rng = np.random.default_rng(0)
    points = []
    for x, y, _ in STALKS:
        angle, height = rng.uniform(-math.pi, 0.0, 4000), rng.uniform(0.4, 1.1, 4000)
        points.append(np.stack([x + 0.007 * np.cos(angle), y + 0.007 * np.sin(angle), height], axis=1))
    points = np.concatenate(points)
    found = slice_points(points)
    assert len(found) == len(STALKS)
    for point, (x, y, _) in zip(found, STALKS):
        assert abs(point.point[0] - x) < 0.003 and -0.008 < point.point[1] - y < -0.002
    part = slice_at(points, 0.65)
    assert part.heat.shape == part.regions.shape and part.regions.max() == len(part.middles) == len(STALKS)
    assert slice_points(np.zeros((0, 3))) == []


def test_grasp_points_are_matched_with_stalks_one_to_one():
    plot = draw(GRASPING, 0)
    low, high = 0.55, 1.05
    middle = np.array([stalk.at_height(0.75)[0] for stalk in plot.measured])
    inside = middle[(middle[:, 0] >= low) & (middle[:, 0] <= high)]
    true, found, errors = match_stalks(inside + [0.0, 0.004, 0.0], plot)
    assert true == found == len(errors) == len(inside)
    np.testing.assert_allclose(errors, 0.004, atol=1e-9)
    twice = np.concatenate([inside, inside[:1], middle[:1]])  # the first stalk twice, and one beyond the stretch
    assert match_stalks(twice, plot)[:2] == (true, true + 1)
    assert match_stalks(np.zeros((0, 3)), plot)[1:] == (0, pytest.approx(np.zeros(0)))


def test_figures_of_runs():
    seconds = {"match": 0.2, "mask": 0.1}
    scores = [
        RunScore(0, 8, 8, np.array([1.0] * 7), np.array([0.5, 1.5]), 0, seconds, None, ()),
        RunScore(1, 2, 2, np.array([3.0, 5.0]), np.array([2.5]), 1, seconds, None, ("a note",)),
    ]
    figures = summary(scores)
    assert figures["f1"] == pytest.approx(18 / 20) and figures["precision"] == figures["recall"] == pytest.approx(0.9)
    assert figures["point_median_mm"] == 1.0 and figures["stitch_median_mm"] == 1.5 and figures["stitches_refused"] == 1
    assert figures["seconds_per_pair"] == pytest.approx(0.3)
    assert math.isnan(summary([])["f1"])


# --- masks ---


def striped(seed: int) -> Example:
    """A dark image with bright upright stripes, which are its stalks."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((64, 96), bool)
    for column in rng.integers(4, 88, 4):
        mask[:, column : column + 5] = True
    image = np.where(mask[..., None], 190, 60) + rng.integers(-15, 15, (64, 96, 3))
    return Example(image.astype(np.uint8), mask)


def test_crops_are_parts_of_images_with_their_masks():
    examples = [striped(0), Example(np.full((20, 20, 3), 7, np.uint8), np.ones((20, 20), bool))]
    images, masks = crops(examples, np.random.default_rng(0), 12, 32)
    assert images.shape == (12, 32, 32, 3) and masks.shape == (12, 32, 32)
    small = (images[:, 0, 0] == 7).all(axis=-1)
    assert 0 < small.sum() < 12
    for image, mask, is_small in zip(images, masks, small):
        assert (mask.sum() == 400 and not image[20:].any()) if is_small else ((image[..., 0] > 125) == mask).all()


def test_varied_crops_keep_their_masks():
    masks = np.zeros((16, 64, 64), bool)
    masks[:, :, 20:30] = True
    images = np.where(masks[..., None], 140, np.full(3, 40)).astype(np.uint8)
    varied, moved = (np.asarray(each) for each in vary(jnp.asarray(images), jnp.asarray(masks), jax.random.key(0)))
    assert varied.dtype == np.uint8 and varied.shape == images.shape and moved.dtype == bool
    kept = [(varied[each] == images[each]).all() or (varied[each] == images[each, :, ::-1]).all() for each in range(16)]
    assert 0 < sum(kept) < 8
    grey = varied.mean(axis=-1)
    # What was brighter still is, wherever it has gone.
    for one, mask in zip(grey, moved):
        assert 0.05 < mask.mean() < 0.3
        assert one[mask].mean() > one[~mask].mean()
    assert len({round(float(each.mean())) for each in varied}) > 5
    assert len({int(np.flatnonzero(each[32]).mean()) for each in moved}) > 2
    other, _ = vary(jnp.asarray(images), jnp.asarray(masks), jax.random.key(1))
    assert (np.asarray(other) != varied).any()


@pytest.mark.parametrize("loss", ["segmentation", "gan"])
def test_generators_learn_to_paint_stripes(loss, tmp_path):
    settings = Settings(loss, (8, 16))
    reports = []
    plan = Plan(steps=100, images=4, first=4, batch=4, crop=32, rate=2e-2, average=0.9)
    params, steps = train([map(striped, range(4))], settings, plan, lambda *parts: reports.append(parts), every=0.0)
    assert steps == 100 and reports and all(np.isfinite(list(report[3].values())).all() for report in reports)
    path = tmp_path / "w.npz"
    write_weights(path, params, settings, {"origin": "stripes"})
    back, read_settings, about = read_weights(path)
    assert read_settings == settings and about == {"origin": "stripes"}
    np.testing.assert_allclose(
        np.concatenate([np.ravel(each) for each in jax.tree.leaves(back)]),
        np.concatenate([np.ravel(each) for each in jax.tree.leaves(params)]),
        atol=2e-3,
    )
    painter, example = Painter(back, settings), striped(9)
    found = painter(example.image[:61, :90])  # no multiples of 4
    true = example.mask[:61, :90]
    assert found.shape == true.shape and found.dtype == bool
    assert 2.0 * (found & true).sum() / (found.sum() + true.sum()) > 0.85
    assert (redness(painter.paint(example.image)) > 0.5).mean() == pytest.approx(example.mask.mean(), abs=0.06)


def test_training_tells_what_goes_wrong():
    settings = Settings("segmentation", (8, 16))
    plan = Plan(steps=8, images=1, first=1, batch=4, crop=32, rate=float("nan"))
    with pytest.raises(NonFiniteError, match="not finite at step 8"):
        train([iter([striped(0)])], settings, plan, lambda *parts: None, every=0.0)
    with pytest.raises(RequestError, match="before the first update"):
        train([iter([striped(0)])], settings, dataclasses.replace(plan, minutes=1e-9), lambda *parts: None)


def test_files_that_hold_no_masks_are_told(tmp_path):
    with pytest.raises(RequestError, match="cannot read the weights"):
        read_weights(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("no weights")
    np.savez(tmp_path / "other.npz", about=np.frombuffer(b"{}", np.uint8))
    for name in ("text.npz", "other.npz"):
        with pytest.raises(RequestError, match="holds no weights"):
            read_weights(tmp_path / name)


# --- the command ---


@pytest.fixture(scope="module")
def spec(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("grasp") / "few.json"
    path.write_text(json.dumps(FEW))
    return path


@pytest.fixture(scope="module")
def runs(spec) -> Path:
    """Two runs of three small pairs."""
    folder = spec.parent / "runs"
    assert cli.main(["grasp", "synth", str(folder), "--spec", str(spec), *WIDTH, "--runs", "2"]) == 0
    return folder


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def grasp(folder: Path, out: Path, *words: str) -> int:
    return cli.main(["grasp", "run", str(folder), "--out", str(out), "--masks", "truth", *words])


def test_synth_writes_exact_truth(runs):
    truth = json.loads((runs / "plot_0000" / "plot.json").read_text())
    plot = draw(read(runs.parent / "few.json", GRASPING_FAMILIES), 0)
    assert truth["count"] == len(plot.measured) == 7
    for stalk, told in zip(plot.measured, truth["stalks"]):
        x, y, z, diameter = np.array(told["middle_line_x_y_z_diameter_mm"]).T
        middle, _ = stalk.at_height(0.75)
        assert np.interp(0.75, z, x) == pytest.approx(middle[0], abs=1e-3)
        assert np.interp(0.75, z, y) == pytest.approx(middle[1], abs=1e-3)
        assert diameter[15] == pytest.approx(1e3 * stalk.diameter(z[15]), abs=0.01)
    assert len(list((runs / "plot_0000" / "truth").glob("instance_*.png"))) == 3


def test_run_finds_the_stalks_and_goes_on_where_it_was(runs, tmp_path, capsys):
    out = tmp_path / "out"
    assert grasp(runs, out) == 0
    rows, points = table(out / "runs.csv"), table(out / "points.csv")
    assert [row["run"] for row in rows] == ["plot_0000", "plot_0001"]
    for row in rows:
        own = [each for each in points if each["run"] == row["run"]]
        assert row["flag"] == "ok" and row["pairs"] == "3" and row["stitches"] == "2"
        assert 3 <= int(row["reachable"]) <= int(row["grasp_points"])
        assert int(row["grasp_points"]) == len(own) >= 4
        assert [int(each["point"]) for each in own] == list(range(1, len(own) + 1))
        assert all(0.35 < float(each["y_m"]) < 0.8 and 0.4 < float(each["z_m"]) < 1.1 for each in own)
        assert np.median([float(each["diameter_mm"]) for each in own]) == pytest.approx(21.0, abs=6.0)
    assert (out / "overlays" / "plot_0001.png").exists()
    before = {name: (out / name).read_bytes() for name in ("runs.csv", "points.csv")}
    (out / "runs.csv").unlink()
    assert grasp(runs, out) == 0
    assert {name: (out / name).read_bytes() for name in before} == before
    assert grasp(runs, out, "--thesis") == 2
    assert "holds the results of another request" in capsys.readouterr().err


def test_missing_pairs_and_missing_odometry_are_told_and_the_run_goes_on(runs, tmp_path, capsys):
    folder = tmp_path / "runs"
    shutil.copytree(runs, folder)
    (folder / "plot_0000" / "right_001.png").unlink()
    (folder / "plot_0001" / "odometry.csv").unlink()
    assert grasp(folder, tmp_path / "out") == 3
    first, second = table(tmp_path / "out" / "runs.csv")
    assert first["pairs_skipped"] == "1" and "pairs skipped: 1" in first["flag"] and int(first["grasp_points"]) > 2
    assert second["flag"] == "no odometry: only the last pair was used" and int(second["grasp_points"]) > 2
    assert "skipped plot_0000/001: there is no right image" in capsys.readouterr().err
    for number in range(3):
        (folder / "plot_0000" / f"left_00{number}.png").write_bytes(b"")
    assert grasp(folder / "plot_0000", tmp_path / "none") == 3
    (row,) = table(tmp_path / "none" / "runs.csv")
    assert row["flag"] == "no usable pairs" and row["grasp_points"] == "0"


def test_clouds_that_do_not_stitch_and_an_arm_that_reaches_nothing_are_told(runs, tmp_path):
    folder = tmp_path / "plot_0000"
    shutil.copytree(runs / "plot_0000", folder)
    text = (folder / "odometry.csv").read_text().splitlines()
    far = [",".join([*line.split(",")[:-1], f"{0.4 * number}"]) for number, line in enumerate(text[1:])]
    (folder / "odometry.csv").write_text("\n".join([text[0], *far]) + "\n")
    calibration = read_calibration(folder / "calibration.yaml")

    def find(image, plot, pair):
        return np.zeros(image.shape[:2], bool)

    request = Request(
        tmp_path / "out", OURS, "nothing", {"plot_0000": calibration}, MOUNT, None, lambda points, stops: points[:, 0] > 9
    )
    run(find_plots(folder), find, request)
    (row,) = table(tmp_path / "out" / "runs.csv")
    assert "does not stitch to the next, odometry was used" in row["flag"] and "no stalk was found" in row["flag"]
    assert int(row["stitches_refused"]) >= 1 and row["reachable"] == "0"
    shutil.copy(runs / "plot_0000" / "odometry.csv", folder)
    truth = {
        path.name[9:12]: cli.grasp_run._truth(None, find_plots(folder)[0], pair)
        for path, pair in zip(sorted((folder / "truth").glob("instance_*")), find_plots(folder)[0].pairs)
    }
    request = dataclasses.replace(request, out=tmp_path / "far")
    run(find_plots(folder), lambda image, plot, pair: truth[pair.name], request)
    (row,) = table(tmp_path / "far" / "runs.csv")
    assert row["flag"] == "no stalk is within reach" and row["reachable"] == "0" and int(row["grasp_points"]) > 2


def test_eval_of_rows_and_of_an_empty_one(spec, tmp_path, capsys):
    out = tmp_path / "eval.json"
    words = ["grasp", "eval", "--masks", "truth", *WIDTH, "--runs", "2", "--reach"]
    assert cli.main([*words, "--json", str(out), "--spec", str(spec), "--workers", "2", "--wind", "0", "5"]) == 0
    figures = json.loads(out.read_text())
    assert figures["f1"] > 0.9 and figures["point_median_mm"] < 10.0 and figures["stitch_median_mm"] < 10.0
    assert figures["synthetic"] is True and figures["masks"] == "truth" and figures["stitches"] == 4
    for wind in ("0", "5"):
        shares = figures["reaches"][f"again, wind {wind} mm"]["shares"]
        targets = sum(len(each["plan"]["targets"]) for each in figures["each"])
        assert shares["all stalks"]["of"] == figures["stalks"] and shares["attempts: success"]["of"] == targets
        assert shares["all stalks"]["count"] >= figures["stalks"] - 2
    said = capsys.readouterr().out
    assert "simulated runs of family few" in said and "the arm, again, wind 5 mm:" in said
    # A run is the same in this process, and is not evaluated again.
    family = family_of(Drawn("training", spec, 256, (), 3), "grasping")
    here = json.loads(json.dumps(finite(evaluate_run(Conditions(family), 1))))
    there = figures["each"][1]
    assert here["plan"]["stalks"] == there["plan"]["stalks"] and here["hits"] == there["hits"]
    np.testing.assert_allclose(here["plan"]["targets"], there["plan"]["targets"], atol=2e-6)
    before = out.stat().st_mtime_ns
    assert cli.main([*words, "--json", str(out), "--spec", str(spec), "--wind", "5"]) == 0
    said = capsys.readouterr().out
    assert "evaluated before: 2 of 2 runs" in said and "run 1" not in said
    assert json.loads(out.read_text()) == figures and out.stat().st_mtime_ns >= before
    figure = ["figure", "4.6", "--evaluation", str(out), "--out", str(tmp_path / "figure.png")]
    assert cli.main([*figure, "--wind", "5"]) == 0 and (tmp_path / "figure.png").stat().st_size > 20_000
    assert cli.main([*figure, "--wind", "7"]) == 2
    assert "holds no reaches of the kind `again, wind 7 mm`" in capsys.readouterr().err
    assert cli.main([*words, "--json", str(out), "--spec", str(spec), "--thesis"]) == 2
    assert 'another evaluation (method: "default", not "thesis")' in capsys.readouterr().err
    empty = tmp_path / "empty.json"
    layout = {**FEW["layout"], "stalks_mean": 0}
    empty.write_text(json.dumps({**FEW, "layout": layout, "leaves": {"density": 0, "litter": 30}}))
    assert cli.main([*words, "--json", str(tmp_path / "none.json"), "--spec", str(empty), "--runs", "1"]) == 0
    figures = json.loads((tmp_path / "none.json").read_text())
    assert figures["stalks"] == figures["grasp_points"] == 0 and figures["f1"] is None
    assert "no stalk was found" in capsys.readouterr().out


def test_masks_are_compared_with_the_truth_and_the_figure_is_drawn(spec, tmp_path):
    family = dataclasses.replace(read(spec, GRASPING_FAMILIES))
    family = dataclasses.replace(family.at_width(256), rig=dataclasses.replace(family.at_width(256).rig, frames=3))
    scene = draw_scene(family, 0)
    score, perception = score_scene(scene, lambda image, number: np.roll(scene.masks[number], 1, axis=1))
    assert score.mask is not None and 0.3 < score.mask.boundary < 1.5
    assert 0.6 < 2.0 * score.mask.hits / (score.mask.painted + score.mask.true) < 0.97
    assert summary([score])["mask_f1"] < 1.0 and len(perception.clouds) == 3
    thesis, _ = score_scene(scene, None, ORIGINAL)
    assert thesis.mask is None and np.median(thesis.stitches) > np.median(score.stitches)
    mixed, _ = score_scene(scene, None, Ways(points=True))
    np.testing.assert_allclose(mixed.stitches, score.stitches, atol=1e-9)
    assert [str(each) for each in (OURS, ORIGINAL, Ways(True), Ways(False, True))] == [
        "default",
        "thesis",
        "stitches of the thesis",
        "grasp points of the thesis",
    ]
    out = tmp_path / "figure.png"
    draw_figure(out, family, 0, None, "truth")
    assert out.stat().st_size > 50_000
    draw_reach(tmp_path / "reach.png", family, 0, None, 5.0, tmp_path / "arm.gif", size=48)
    assert (tmp_path / "reach.png").stat().st_size > 20_000
    with Image.open(tmp_path / "arm.gif") as shown:
        assert shown.n_frames % 60 == 0 and shown.n_frames > 60


def test_a_run_without_pairs_is_a_mistake():
    with pytest.raises(ValueError, match="no pair"):
        perceive([], lambda image, number: image[..., 0] > 0, CAMERA, MOUNT)
    blank = np.full((320, 320, 3), 50, np.uint8)
    found = perceive([View(0, blank, blank, None)], lambda image, number: np.zeros((320, 320), bool), CAMERA, MOUNT)
    assert found.points == [] and found.notes == ("no stalk was found",)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["synth", "out", "--runs", "0"], "--runs must be at least 1"),
        (["synth", "out", "--shift", "lien"], "there is no shift of 'lien'; did you mean lean"),
        (["train", "weights.bin"], "ends in .npz"),
        (["train", "weights.npz", "--minutes", "0"], "--minutes must be more than 0"),
        (["train", "weights.npz", "--crop", "100"], "--crop must be a multiple of 64"),
        (["train", "weights.npz", "--loss", "dice"], "--loss cannot be 'dice'"),
        (["eval", "--seed", "-1"], "--seed must be at least 0"),
        (["eval", "--weights", "missing.npz"], "cannot read the weights"),
        (["eval", "--masks", "truth", "--weights", "w.npz"], "leave out --weights"),
        (["eval", "--wind", "5"], "--wind goes with --reach"),
        (["eval", "--reach", "--wind", "0", "-5"], "--wind must be from 0 to 100 mm, not -5"),
        (["eval", "--workers", "0"], "--workers must be at least 1"),
        (["run", "missing"], "there is no folder"),
        (["run", ".", "--pitch", "99"], "--pitch must be from -60 to 60"),
        (["run", ".", "--height", "0"], "--height must be from 0.05 to 3"),
        (["run", ".", "--speed", "0"], "--speed must be more than 0"),
    ],
)
def test_wrong_requests(tmp_path, monkeypatch, capsys, words, part):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["grasp", *words]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and part in lines[0], lines


def test_no_calibration_no_metres(runs, tmp_path, capsys):
    folder = tmp_path / "plot_0000"
    shutil.copytree(runs / "plot_0000", folder)
    (folder / "calibration.yaml").unlink()
    assert grasp(folder, tmp_path / "out") == 2
    assert "plot_0000 has no calibration" in capsys.readouterr().err
    (folder / "plot.json").unlink()
    shutil.copy(runs / "plot_0000" / "calibration.yaml", folder)
    assert grasp(folder, tmp_path / "out") == 2
    assert "holds no true masks" in capsys.readouterr().err


def test_the_default_narrows_its_gate():
    assert DEFAULT.gates == tuple(sorted(DEFAULT.gates, reverse=True)) and DEFAULT.gates[:2] == (0.15, 0.05)
    assert (THESIS.voxel, THESIS.gates, THESIS.from_odometry) == (0.03, (0.15,), False)
