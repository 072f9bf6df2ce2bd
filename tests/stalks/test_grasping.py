"""Tests of point clouds, their stitching, and grasp points."""

import dataclasses
import math

import numpy as np
import pytest

from jaxrl_vis.stalks.grasping.evaluation.scoring import RunScore, match_stalks, stitch_error, summarize_scores, true_motion
from jaxrl_vis.stalks.grasping.perception.cloud import Cloud, Mount, build_cloud, compute_disparity, redness, subsample
from jaxrl_vis.stalks.grasping.perception.lines import detect_grasp_points
from jaxrl_vis.stalks.grasping.perception.perceive import View, perceive
from jaxrl_vis.stalks.grasping.perception.slices import detect_by_slice, slice_at
from jaxrl_vis.stalks.grasping.perception.stalk_segments import extract_stalk_segments, join_segments
from jaxrl_vis.stalks.grasping.perception.stitch import DEFAULT, THESIS, DownsampledCloud, Motion, fit_rigid_motion, stitch
from jaxrl_vis.stalks.grasping.perception.visibility import Visibility
from jaxrl_vis_envs.plants import Calibration, Pose, draw, drive
from jaxrl_vis_envs.plants.grasping import GRASPING, GRASPING_FAMILIES, GRASPING_SHIFTED

CAMERA = Calibration(320, 320, 190.0, (159.5, 159.5), 0.07)
MOUNT = Mount()


def turned(angles: tuple[float, float, float], shift: tuple[float, float, float]) -> Motion:
    """Return a motion by angles about the x, y and z axes, degrees, and a shift, m."""
    rotation = np.eye(3)
    for axis, angle in enumerate(np.radians(angles)):
        one = np.eye(3)
        first, second = [each for each in range(3) if each != axis]
        one[first, first] = one[second, second] = math.cos(angle)
        one[first, second], one[second, first] = -math.sin(angle), math.sin(angle)
        rotation = one @ rotation
    return Motion(rotation, np.array(shift))


def thicket(count: int = 12000) -> np.ndarray:
    """Sample points [N, 3] on vertical stalks and a few leaves along 1.6 m of a row, m."""
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
        assert -away > 0.4  # m, below which the pair measures no depth
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
    found = compute_disparity(left, right, CAMERA, MOUNT)
    assert np.isfinite(found[:, disparity + 8 :]).mean() > 0.98
    np.testing.assert_allclose(np.nanmedian(found), disparity, atol=0.1)
    cloud = build_cloud(found, np.zeros(found.shape, bool), CAMERA, MOUNT)
    assert cloud.points.shape == (320, 320, 3) and len(cloud.stalk_points()) == 0
    depth = CAMERA.focal * CAMERA.baseline / disparity
    # The middle of the image is that far away along a ray that points down by 15 degrees.
    expected = [0.0, depth * math.cos(math.radians(15)), 1.0 - depth * math.sin(math.radians(15))]
    np.testing.assert_allclose(cloud.points[159:161, 159:161].mean(axis=(0, 1)), expected, atol=0.005)


def test_thinning_takes_the_mean_of_each_cube():
    points = np.array([[0.001, 0.001, 0.001], [0.003, 0.003, 0.003], [0.5, 0.5, 0.5]])
    np.testing.assert_allclose(subsample(points, 0.01), [[0.002] * 3, [0.5] * 3])
    assert len(subsample(np.zeros((0, 3)), 0.01)) == 0


# --- stitching ---


def test_the_rigid_motion_of_points_is_found():
    motion = turned((3.0, -5.0, 8.0), (0.1, -0.2, 0.05))
    points = np.random.default_rng(1).normal(size=(50, 3))
    found = fit_rigid_motion(points, motion(points), np.ones(50))
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
    found = stitch(DownsampledCloud(here), DownsampledCloud(there), 0.103)
    assert not found.refused and found.overlap > 0.6 and found.residual < 0.004
    assert np.linalg.norm((found.motion(place) - motion(place))[:2]) < 0.002
    blind = stitch(DownsampledCloud(here, THESIS), DownsampledCloud(there, THESIS), 0.103, THESIS)
    assert np.linalg.norm((blind.motion(place) - motion(place))[:2]) > 0.006


def test_what_odometry_rules_out_is_refused():
    whole = DownsampledCloud(thicket())
    found = stitch(whole, whole, 0.2)  # odometry says that the robot moved; it did not
    assert found.refused and np.allclose(found.motion.shift, [-0.2, 0, 0])
    assert "overlap" in found.refused or "moved" in found.refused
    assert stitch(whole, DownsampledCloud(np.zeros((0, 3))), 0.1).refused == "a cloud is empty"
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
    """Return the cloud of one pair that shows stalks, 14 mm thick at a height of 0.75 m.

    Args:
        stalks: x and y of each foot in the robot frame of the last pair, m, and lean along the row, m per m of height.
        driven: Distance that the robot drives from this pair to the last one, m.
        hidden: Range of heights that is occluded, m.
        bend: Quadratic coefficient of x in the height of all stalks, 1/m.
        taper: Change of the diameter per m of height.
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
            column, row = np.round(camera[:, :2] / camera[:, 2:] * CAMERA.focal + CAMERA.centre).astype(int).T
            inside = (column >= 0) & (column < 320) & (row >= 0) & (row < 320)
            depth[row[inside], column[inside]] = camera[inside, 2]
    red = np.isfinite(depth)
    background = np.where(red, depth, np.float32(0.9))
    return build_cloud(CAMERA.disparity(background).astype(np.float32), red, CAMERA, MOUNT)


STALKS = [(-0.25, 0.55, 0.05), (-0.13, 0.6, -0.08), (-0.05, 0.52, 0.0), (0.1, 0.57, 0.1)]


def found_in(clouds: list[Cloud], motions: list[Motion]):
    parts = [extract_stalk_segments(cloud, CAMERA, MOUNT, frame) for frame, cloud in enumerate(clouds)]
    parts = [dataclasses.replace(part, middle=motion(part.middle)) for motion, part in zip(motions, parts)]
    return detect_grasp_points(join_segments(parts), Visibility(tuple(clouds), tuple(motions), CAMERA, MOUNT))


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
    """Straight lines would be 19 mm off the stalks at 0.45 m, and 11 mm at 1.05 m."""
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
    """Return the cloud of a pair that shows the stalks of two clouds: at each pixel, the nearer one."""
    depth = np.fmin(*(np.where(cloud.mask, cloud.depth, np.float32(np.nan)) for cloud in (one, other)))
    red = np.isfinite(depth)
    return build_cloud(CAMERA.disparity(np.where(red, depth, np.float32(0.9))).astype(np.float32), red, CAMERA, MOUNT)


def test_stalks_beside_each_other_in_one_pair_are_two():
    """Their grasp points differ so much in height that, by the lines alone, they could be one stalk."""
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


def test_what_other_pairs_see_through_is_not_a_stalk():
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
    found = detect_by_slice(points)
    assert len(found) == len(STALKS)
    for point, (x, y, _) in zip(found, STALKS):
        assert abs(point.point[0] - x) < 0.003 and -0.008 < point.point[1] - y < -0.002
    part = slice_at(points, 0.65)
    assert part.heat.shape == part.regions.shape and part.regions.max() == len(part.middles) == len(STALKS)
    assert detect_by_slice(np.zeros((0, 3))) == []


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
    figures = summarize_scores(scores)
    assert figures["f1"] == pytest.approx(18 / 20) and figures["precision"] == figures["recall"] == pytest.approx(0.9)
    assert figures["point_median_mm"] == 1.0 and figures["stitch_median_mm"] == 1.5 and figures["stitches_refused"] == 1
    assert figures["seconds_per_pair"] == pytest.approx(0.3)
    assert math.isnan(summarize_scores([])["f1"])


# --- masks ---


def test_a_run_without_pairs_is_a_mistake():
    with pytest.raises(ValueError, match="no pair"):
        perceive([], lambda image, number: image[..., 0] > 0, CAMERA, MOUNT)
    blank = np.full((320, 320, 3), 50, np.uint8)
    found = perceive([View(0, blank, blank, None)], lambda image, number: np.zeros((320, 320), bool), CAMERA, MOUNT)
    assert found.points == [] and found.notes == ("no stalk was found",)


def test_the_default_narrows_its_gate():
    assert DEFAULT.gates == tuple(sorted(DEFAULT.gates, reverse=True)) and DEFAULT.gates[:2] == (0.15, 0.05)
    assert (THESIS.voxel, THESIS.gates, THESIS.from_odometry) == (0.03, (0.15,), False)
