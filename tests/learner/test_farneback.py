"""Optical flow agrees with OpenCV's on images of our own tasks (tests/make_flow_references.py)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from jaxrl_vis.learner.auxtasks import farneback

REFERENCES = Path(__file__).parents[1] / "data" / "optical_flow.npz"
TASKS = ("VisualFetchReach", "VisualHandReach", "VisualFingerTurn")


@jax.jit
def flow(images_t, images_tp1):
    """Return the flow [B, H, W, 2] between pairs of images [B, H, W]."""
    return jax.vmap(farneback.flow)(jnp.stack([images_t, images_tp1], axis=1))[:, 0]


def quantiles(found, expected):
    """Return median and 95th percentile of the end-point error, pixels, where the expected flow is at least 0.25 pixels."""
    is_moving = np.linalg.norm(expected, axis=-1) >= 0.25
    assert is_moving.sum() > 1000
    return np.quantile(np.linalg.norm(found - expected, axis=-1)[is_moving], [0.5, 0.95])


@pytest.mark.parametrize("size", [64, 100])
def test_flow_agrees_with_opencv_on_our_images(size):
    with np.load(REFERENCES) as file:
        grey = np.stack([file[f"{task}/{size}/grey"] for task in TASKS])
        expected = np.stack([file[f"{task}/{size}/flow"] for task in TASKS]).astype(np.float32)
    shape = (-1, size, size)
    found = np.asarray(flow(grey[:, :, :-1].reshape(shape), grey[:, :, 1:].reshape(shape))).reshape(expected.shape)
    assert np.all(np.isfinite(found))
    for ours, theirs in zip(found, expected, strict=True):
        median, most = quantiles(ours, theirs)
        assert median <= 0.05 and most <= 0.3
        median, most = quantiles(np.zeros_like(theirs), theirs)
        assert not (median <= 0.05 and most <= 0.3)


def test_flow_is_the_displacement_to_the_right_and_down():
    """Images need not be square; displacements of half the window are found, too, from the coarser image."""
    rng = np.random.default_rng(0)
    scene = scipy.ndimage.gaussian_filter(rng.uniform(size=(90, 120)), 3)
    scene = np.float32(255 * (scene - scene.min()) / np.ptp(scene))
    still = scene[10:-10, 10:-10]
    moves = [(0, 0), (2, -1), (-7, 6)]
    moved = np.stack([scene[10 - down : 80 - down, 10 - right : 110 - right] for right, down in moves])
    found = np.asarray(flow(np.stack([still] * 3), moved))
    assert found.shape == (3, 70, 100, 2) and found.dtype == np.float32
    # Not quite 0: as in OpenCV, the last row and column count as outside, and lend their neighbours a little motion.
    assert np.abs(found[0]).max() < 0.05
    for ours, move in zip(found, moves):
        assert np.abs(np.median(ours[16:-16, 16:-16], axis=(0, 1)) - move).max() < 0.1


def test_flow_is_finite_where_it_is_not_determined():
    """The flow of a flat image, straight stripes, and noise unrelated to the image before is not determined."""
    rng = np.random.default_rng(0)
    flat, stripes = np.full((16, 16), 200), np.tile(np.array([0, 0, 255, 255]), (16, 4))
    noise = rng.integers(0, 256, (2, 16, 16))
    images_t = np.stack([flat, stripes, noise[0], stripes]).astype(np.uint8)
    images_tp1 = np.stack([flat // 2, np.roll(stripes, 1, axis=1), noise[1], stripes.T]).astype(np.uint8)
    found = np.asarray(flow(images_t, images_tp1))
    assert np.abs(found[0]).max() < 1e-3
    assert np.all(np.abs(found) <= 16.0)
