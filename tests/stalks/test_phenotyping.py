"""Tests of widths, disparities and image files of the phenotyping application, on images with known ground truth."""

import dataclasses
import runpy
from pathlib import Path

import cv2
import numpy as np
import pytest

from jaxrl_vis.stalks.phenotyping.io.images import read_disparity, read_image, write_image
from jaxrl_vis.stalks.phenotyping.io.masks import decode_mask, encode_mask
from jaxrl_vis.stalks.phenotyping.measure.diameter import diameter_mm, tilt_from_disparity
from jaxrl_vis.stalks.phenotyping.measure.edges import refine_edges
from jaxrl_vis.stalks.phenotyping.measure.ground import _fit_plane, find_ground
from jaxrl_vis.stalks.phenotyping.measure.stalk import measure_stalk
from jaxrl_vis.stalks.phenotyping.measure.stereo import match_rows, match_sgbm
from jaxrl_vis.stalks.phenotyping.measure.width import ellipse_width, fit_strip, fit_strip_near
from jaxrl_vis_envs.plants import Calibration

ROOT = Path(__file__).resolve().parents[2]
STRIPS = runpy.run_path(str(ROOT / "benchmarks" / "stalks" / "strip_widths.py"))
CAMERAS = Calibration(640, 480, 500.0, (319.5, 239.5), 0.1)


# --- widths ---


@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize(("ratio", "bound"), [(3.0, 0.01), (6.0, 0.005)])
@pytest.mark.parametrize("lean", [0.0, 3.0, 10.0, 20.0, -20.0])
def test_strips_are_as_wide_as_they_are(lean, ratio, bound, soft):
    # Of an upright strip, the pixels whose middle it covers say its width to a pixel only: the mean over places is right.
    widths, places = ((39.0,), 4) if lean or soft else ((39.0,), 1)
    errors = STRIPS["mean_errors"](STRIPS["width_by_strip"], ratio, lean, soft, places, widths)
    assert np.abs(errors).max() < bound


def test_ellipses_are_biased_as_their_mathematics_says():
    """The variance across a strip of width w is w^2 / 12, that across an ellipse of minor axis w is w^2 / 16."""
    mask = STRIPS["ideal_strip"](39.0, 6.0, 8.0, (0.2, 0.1), False)
    widths = {fit: STRIPS["ellipse_width"](mask, fit) for fit in STRIPS["ELLIPSE_FITS"]}
    assert widths["moments"] / 39.0 == pytest.approx(2.0 / np.sqrt(3.0), rel=0.005)
    assert widths["pixels"] / 39.0 == pytest.approx(0.963, abs=0.01) and ellipse_width(mask) == widths["pixels"]
    assert 1.03 < widths["contour"] / 39.0 < 1.10


def test_the_widest_ellipse_counts_and_specks_do_not():
    mask = np.zeros((200, 120), bool)
    mask[10:90, 20:30] = mask[110:190, 60:80] = True
    mask[0:2, 0:2] = True
    wide = np.zeros_like(mask)
    wide[110:190, 60:80] = True
    assert ellipse_width(mask) == ellipse_width(wide)
    assert ellipse_width(np.zeros((50, 50), bool)) is None
    assert ellipse_width(np.eye(50, dtype=bool)) is None  # a line has no width


def test_leaves_and_nodes_do_not_change_a_strip():
    mask = STRIPS["ideal_strip"](30.0, 10.0, 7.0, (0.0, 0.0), False)
    clean = fit_strip(mask)
    disturbed = mask.copy()
    half = mask.shape[0] // 2
    for row in range(half - 60, half - 20):  # a leaf before its right half
        columns = np.flatnonzero(mask[row])
        disturbed[row, columns[len(columns) // 2 :]] = False
    for row in range(half + 30, half + 45):  # a node, 10 % thicker
        columns = np.flatnonzero(mask[row])
        disturbed[row, columns[0] - 2 : columns[0]] = disturbed[row, columns[-1] + 1 : columns[-1] + 3] = True
    found = fit_strip(disturbed)
    assert found.width() == pytest.approx(30.0, abs=0.2)
    assert found.lean == pytest.approx(np.radians(7.0), abs=0.003)
    assert found.used < clean.used - 0.1
    assert found.confidence < clean.confidence


def test_a_sheath_elsewhere_does_not_matter_where_a_width_is_taken():
    """A sheath adds 1.5 pixels on either side in rows 120 to 240; from row 330 on, a leaf occludes one edge."""
    row = np.arange(400)[:, None]
    half = np.where((row >= 120) & (row < 240), 21.5, 20.0)
    mask = np.abs(np.arange(120)[None, :] - 60.3 - 0.05 * row) < half
    mask[330:] &= np.arange(120) < 75
    strip = fit_strip(mask)
    across = np.cos(strip.lean)
    for place, true in ((180.0, 43.0), (60.0, 40.0), (270.0, 40.0)):
        assert fit_strip_near(strip, place, 45.0, 400).width(place) == pytest.approx(true * across, abs=0.3)
    assert abs(strip.width(180.0) - 43.0) > 1.0  # as a whole, it is bare
    assert fit_strip_near(strip, 390.0, 50.0, 400) is None  # one edge is that of what hides the other
    assert fit_strip_near(strip, 600.0, 50.0, 400) is None  # beyond the mask


def blurred_stalk(left: float, right: float, texture: float = 0.0) -> np.ndarray:
    """Return a grey image [200, 120] float32 of a bright upright strip between two columns, with noise, blurred."""
    column = np.arange(120)[None] + np.zeros((200, 1))
    image = np.where((column > left) & (column < right), 150.0, 30.0)
    image += texture * np.random.default_rng(0).normal(size=image.shape)
    return cv2.GaussianBlur(image, (0, 0), 1.2).astype(np.float32)


@pytest.mark.parametrize("wrong", [-1.6, -0.7, 0.0, 1.3])
def test_edges_settle_where_the_image_changes(wrong):
    """Edges of a mask that is too narrow or too wide on both sides, in a part of the image, move to the true edges."""
    image = blurred_stalk(40.5, 79.5, 20.0)
    mask = np.zeros((160, 80), bool)
    strip = fit_strip(mask | ((np.arange(80) > 20.5) & (np.arange(80) < 59.5)))
    assert strip is not None
    off = dataclasses.replace(strip, left=(strip.left[0] - wrong, 0.0), right=(strip.right[0] + wrong, 0.0))
    settled = refine_edges(off, image, (20, 20), 80.0, 60.0)
    assert abs(settled.edges(80.0)[0] + 20 - 40.0) < 0.6 and abs(settled.width() - 39.0) < 0.3
    assert abs(off.width() - 39.0) == pytest.approx(2 * abs(wrong), abs=0.01)


def test_edges_stay_where_the_image_shows_none():
    """Uniform images, noise, and an edge that is too far away do not move edges."""
    mask = np.zeros((160, 80), bool)
    strip = fit_strip(mask | ((np.arange(80) > 20.5) & (np.arange(80) < 59.5)))
    assert strip is not None
    noise = np.random.default_rng(1).normal(100.0, 10.0, (200, 120)).astype(np.float32)
    for image in (np.full((200, 120), 60.0, np.float32), blurred_stalk(28.5, 91.5)):
        assert refine_edges(strip, image, (20, 20), 80.0, 60.0) == strip
    assert abs(refine_edges(strip, noise, (20, 20), 80.0, 60.0).width() - strip.width()) < 5.1
    assert refine_edges(strip, noise[:24], (20, 20), 2.0, 3.0) == strip


def test_a_width_that_was_not_seen_where_it_is_asked_for_is_a_lower_bound():
    """At a height where a stalk is partially occluded, its width is that of the rest, and marked as such."""
    cameras = Calibration(240, 400, 1000.0, (120.0, 200.0), 0.1)
    mask = np.zeros((360, 80), bool)
    mask[:, 20:60] = True
    mask[:130, 38:60] = False
    image, known = np.full((400, 240), 90.0, np.float32), np.full((400, 240), 125.0, np.float32)

    def measured(row: float):
        return measure_stalk(mask, (20, 80), image, image, cameras, row=row, disparity=known)

    seen, hidden = measured(300.0), measured(90.0)
    assert seen.both_edges_visible and seen.width == pytest.approx(40.0, abs=0.1)
    assert hidden.diameter_mm is not None and not hidden.both_edges_visible


def test_taper_is_followed():
    row = np.arange(300)[:, None]
    half = 20.0 - 0.02 * row
    mask = np.abs(np.arange(120)[None, :] - 60.3 - 0.05 * row) < half
    strip = fit_strip(mask)
    for where in (50, 150, 250):
        expected = 2 * (20.0 - 0.02 * where) * np.cos(strip.lean)
        assert strip.width(where) == pytest.approx(expected, rel=0.005)
    assert strip.lean == pytest.approx(-np.arctan(0.05), abs=1e-3)


@pytest.mark.parametrize("mask", [np.zeros((60, 40), bool), np.ones((60, 40), bool), np.eye(5, dtype=bool)])
def test_what_is_not_a_strip_has_no_width(mask):
    assert fit_strip(mask) is None


# --- millimetres ---


@pytest.mark.parametrize("lean", [0.0, 0.3])
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.25, -0.1)])
def test_diameters_are_those_of_the_cylinder_that_was_seen(lean, place):
    """Rays tangent to a cylinder, and the depth of its front, yield its diameter."""
    radius, foot = 0.00718, np.array([*place, 0.8])
    axis = np.array([np.sin(lean), -np.cos(lean), 0.0])
    away = foot - (foot @ axis) * axis
    distance = np.linalg.norm(away)
    sideways, towards = np.cross(axis, away / distance), -away / distance
    sine = radius / distance
    edges = []
    for sign in (-1.0, 1.0):
        point = foot + radius * (sign * np.sqrt(1 - sine**2) * sideways + sine * towards)
        edges.append(tuple(point[:2] / point[2] * CAMERAS.focal + np.array(CAMERAS.centre)))
    edges.sort()
    # The front is where the ray between the edges meets the cylinder.
    ray = np.array([*((np.mean(edges, axis=0) - np.array(CAMERAS.centre)) / CAMERAS.focal), 1.0])
    flat = ray - (ray @ axis) * axis
    a, b, c = flat @ flat, flat @ away, away @ away - radius**2
    depth = (b - np.sqrt(b * b - a * c)) / a
    assert diameter_mm(CAMERAS, *edges, depth, lean) == pytest.approx(2e3 * radius, rel=2e-4)


def test_tilt_is_read_from_the_slope_of_disparity():
    """The stalk leans away by 10 degrees, and is seen at two heights."""
    depth = 0.8
    higher = np.array([0.0, -0.1, depth + 0.1 * np.tan(np.radians(10.0))])
    rows = 0.0, higher[1] / higher[2] * CAMERAS.focal
    disparities = CAMERAS.disparity(np.array([depth, higher[2]]))
    slope = (disparities[1] - disparities[0]) / (rows[1] - rows[0])
    assert tilt_from_disparity(slope, disparities.mean(), CAMERAS) == pytest.approx(np.radians(10.0), rel=0.03)


# --- the ground ---


def over_ground(height: float | None, pitch: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a grey pair [480, 640] of ground ``height`` m below the cameras, pitched by ``pitch`` rad, before a wall 1 m away.

    Only the wall is visible if the height is None.
    """
    rng = np.random.default_rng(2)
    left = cv2.GaussianBlur(rng.uniform(0, 255, (480, 640)).astype(np.float32), (0, 0), 1.0)
    right = np.empty_like(left)
    columns = np.arange(640)
    for row in range(480):
        wall = CAMERAS.focal * CAMERAS.baseline / 1.0
        down = (row - CAMERAS.centre[1]) / CAMERAS.focal
        # A ray (0, down, 1) meets the ground where its height, height - Z (down cos + sin), is 0.
        inverse = 0.0 if height is None else (down * np.cos(pitch) + np.sin(pitch)) / height
        disparity = max(wall, CAMERAS.focal * CAMERAS.baseline * inverse)
        right[row] = np.interp(columns + disparity, columns, left[row])
    return left, right


@pytest.mark.parametrize(("height", "pitch"), [(0.3, 0.0), (0.35, 0.05), (0.25, -0.05)])
def test_the_ground_is_found_and_heights_count_from_it(height, pitch):
    ground = find_ground(*over_ground(height, pitch), CAMERAS)
    assert ground is not None and ground.camera_height == pytest.approx(height, rel=0.02)
    # A point 0.1 m above the ground, 0.7 m ahead of the camera's foot.
    drop = height - 0.1
    y, z = drop * np.cos(pitch) - 0.7 * np.sin(pitch), drop * np.sin(pitch) + 0.7 * np.cos(pitch)
    row = y / z * CAMERAS.focal + CAMERAS.centre[1]
    assert ground.height(400.0, row, z, CAMERAS) == pytest.approx(0.1, abs=0.01)


def test_no_ground_is_invented():
    assert find_ground(*over_ground(None), CAMERAS) is None
    black = np.zeros((480, 640), np.float32)
    assert find_ground(black, black, CAMERAS) is None
    rng = np.random.default_rng(3)
    noise = [rng.uniform(0, 255, (480, 640)).astype(np.float32) for _ in range(2)]
    assert find_ground(noise[0], noise[1], CAMERAS) is None


def test_a_ground_that_is_mostly_hidden_is_found():
    """A tenth of all windows show the ground; the others show leaves and stalks at any distance."""
    true = np.array([0.02, 2.3, 0.05])
    for seed in range(8):
        rng = np.random.default_rng(seed)
        rays = np.stack([rng.uniform(-0.7, 0.7, 700), rng.uniform(-0.6, 0.6, 700), np.ones(700)], axis=1)
        inverse = rng.uniform(0.4, 2.0, 700)
        seen = np.flatnonzero(rays[:, 1] > 0.25)[:70]
        inverse[seen] = rays[seen] @ true + rng.normal(0.0, 1e-3, len(seen))
        found = _fit_plane(rays, inverse, 6e-3)
        assert found is not None
        np.testing.assert_allclose(found, true, atol=0.03)


# --- disparity ---


@pytest.fixture(scope="module")
def shifted_pair() -> tuple[np.ndarray, np.ndarray, float]:
    """Return a grey pair [240, 300] float32 of a textured stalk 30 pixels wide, and its disparity.

    In the right image, the stalk is 57.4 pixels further left and one row lower.
    """
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (240, 300)).astype(np.float32), (0, 0), 1.2)
    stalk = np.zeros_like(texture)
    stalk[:, 200:230] = texture[:, 200:230] + 30.0
    right = cv2.warpAffine(stalk, np.float32([[1, 0, -57.4], [0, 1, 1]]), (300, 240), flags=cv2.INTER_CUBIC)
    noise = rng.normal(0.0, 2.0, (2, 240, 300)).astype(np.float32)
    return stalk + noise[0], right + noise[1], 57.4


def test_disparities_are_found_to_a_fraction_of_a_pixel(shifted_pair):
    left, right, true = shifted_pair
    rows = np.arange(20, 220, 10)
    edges = np.full(rows.size, 200.0), np.full(rows.size, 229.0)
    found = match_rows(left, right, rows, edges, (40.0, 80.0))
    assert found.values.size > 15
    value, error = found.at(120.0)
    assert value == pytest.approx(true, abs=0.1) and error < 0.1
    # Nothing is made up where there is nothing to match.
    assert match_rows(left, right, rows, (edges[0] - 120, edges[1] - 120), (10.0, 40.0)).at(120.0) is None
    assert match_rows(left, np.zeros_like(right), rows, edges, (40.0, 80.0)).values.size == 0


def test_semi_global_matching_agrees(shifted_pair):
    left, right, true = (np.clip(image, 0, 255).astype(np.uint8) for image in shifted_pair[:2]), None, shifted_pair[2]
    left, right = left
    found = match_sgbm(left, np.roll(right, -1, axis=0), (200, 20, 230, 220), (40.0, 80.0))
    assert found.shape == (200, 30)
    assert np.nanmedian(found) == pytest.approx(true, abs=0.3)


# --- files ---


def test_masks_survive_coco():
    rng = np.random.default_rng(0)
    whole = np.zeros((40, 30), bool)
    whole[7:20, 3:12] = rng.random((13, 9)) < 0.6
    runs = encode_mask(whole[7:20, 3:12], (7, 3), whole.shape)
    assert sum(runs["counts"]) == whole.size
    assert (decode_mask(runs) == whole).all()
    for mask in (np.zeros((4, 5), bool), np.ones((4, 5), bool)):
        assert (decode_mask(encode_mask(mask, (0, 0), mask.shape)) == mask).all()
    with pytest.raises(ValueError, match="do not cover"):
        decode_mask({"size": [4, 5], "counts": [3]})


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".jpg"])
def test_images_survive_files(tmp_path, suffix):
    image = np.full((20, 30, 3), (200, 100, 30), np.uint8)
    write_image(tmp_path / f"a{suffix}", image)
    found = read_image(tmp_path / f"a{suffix}")
    assert found.shape == image.shape and np.abs(found.astype(int) - image).max() <= (3 if suffix == ".jpg" else 0)
    (tmp_path / f"b{suffix}").write_bytes(b"no image")
    with pytest.raises(OSError, match=f"b{suffix} is not an image"):
        read_image(tmp_path / f"b{suffix}")


@pytest.mark.parametrize("kind", ["int8", "int16", "int32", "float32", "float64"])
@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 3)])
def test_images_of_other_numbers_are_reported(tmp_path, kind, shape):
    """The error is one line, both as text and as ``strerror``, which is printed after the name of the file elsewhere."""
    path = tmp_path / "a.tiff"
    assert cv2.imwrite(str(path), np.ones(shape, kind))
    with pytest.raises(OSError, match=f"a.tiff holds {kind} pixels: save it with 8 or 16 bits") as error:
        read_image(path)
    assert error.value.strerror == f"it holds {kind} pixels: save it with 8 or 16 bits"


def test_what_opencv_cannot_read_is_not_an_image(tmp_path, monkeypatch):
    write_image(tmp_path / "a.png", np.zeros((2, 3), np.uint8))

    def fail(*_):
        raise cv2.error("of its own")

    monkeypatch.setattr(cv2, "imdecode", fail)
    with pytest.raises(OSError, match="a.png is not an image"):
        read_image(tmp_path / "a.png")
    with pytest.raises(OSError, match="a.png holds no disparities"):
        read_disparity(tmp_path / "a.png")


def test_disparities_are_read_in_every_convention(tmp_path):
    expected = np.array([[1.5, np.nan, 200.25], [3.0, 4.0, np.nan]], np.float32)
    header = b"Pf\n3 2\n-1.0\n"  # little-endian, last row first
    (tmp_path / "a.pfm").write_bytes(header + np.nan_to_num(expected, nan=np.inf)[::-1].astype("<f4").tobytes())
    write_image(tmp_path / "b.png", (np.nan_to_num(expected) * 256).astype(np.uint16))
    write_image(tmp_path / "c.tiff", (np.nan_to_num(expected) * 64).astype(np.uint16))
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.pfm"), expected)
    np.testing.assert_array_equal(read_disparity(tmp_path / "b.png"), expected)
    np.testing.assert_array_equal(read_disparity(tmp_path / "c.tiff", 64.0), expected)
    write_image(tmp_path / "d.png", np.zeros((2, 3), np.uint8))
    with pytest.raises(OSError, match="d.png holds no disparities"):
        read_disparity(tmp_path / "d.png")
