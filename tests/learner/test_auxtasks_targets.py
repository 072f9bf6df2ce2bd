"""Targets of auxiliary tasks are correct: the angle by which an image was rotated, the speed of moving objects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from jaxrl_vis.learner.auxtasks import egomotion, optical_flow

SIZE = 24
rotate = jax.jit(egomotion.rotate, static_argnames="border")


def smooth_images(channels=2):
    """Return random images [1, C, SIZE, SIZE] uint8 without sharp edges."""
    noise = np.random.default_rng(0).uniform(size=(channels, SIZE, SIZE))
    smooth = scipy.ndimage.gaussian_filter(noise, (0, 2, 2))
    return np.uint8(255 * (smooth - smooth.min()) / np.ptp(smooth))[None]


def rotated(images, degrees, shift=(0.0, 0.0), border="zero"):
    angle = jnp.full(len(images), np.radians(degrees), jnp.float32)
    return np.asarray(
        rotate(jnp.asarray(images), angle, jnp.tile(jnp.array(shift, jnp.float32), (len(images), 1)), border=border)
    )


@pytest.mark.parametrize("degrees", [25.0, -10.0])
def test_images_are_rotated_as_scipy_does(degrees):
    images = smooth_images()
    expected = scipy.ndimage.rotate(images[0].astype(float), degrees, axes=(2, 1), reshape=False, order=1)
    # SciPy has nothing beyond the centres of the outermost pixels, where half of these pixels still are.
    error = np.abs(rotated(images, degrees)[0] - expected)[:, expected.min(axis=0) > 0]
    assert error.size > 0.8 * expected.size and error.max() <= 1.0


def test_positive_angles_are_counter_clockwise():
    images = smooth_images()
    np.testing.assert_array_equal(rotated(images, 90.0), np.rot90(images, axes=(2, 3)))


def test_images_are_shifted_to_the_right_and_down():
    images = smooth_images()
    expected = np.zeros_like(images)
    expected[..., 2:, 5:] = images[..., :-2, :-5]
    np.testing.assert_array_equal(rotated(images, 0.0, (5.0, 2.0)), expected)


def test_a_clipped_image_has_no_empty_corners():
    white = np.full((1, 2, SIZE, SIZE), 255, np.uint8)
    for degrees in (-30.0, 7.0, 30.0):
        assert rotated(white, degrees, border="clip").min() == 255
        assert rotated(white, degrees, border="zero").min() == 0
    images = smooth_images()
    np.testing.assert_array_equal(rotated(images, 0.0, border="clip"), images)


@pytest.mark.parametrize(("border", "max_shift"), [("clip", 0.0), ("zero", 0.1)])
def test_the_motion_says_how_an_image_was_moved(border, max_shift):
    """A spot to the right of the centre appears where the angle and the shift move it."""
    batch, offset = 16, 7.0
    rows, columns = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    spot = np.uint8(255 * np.exp(-(np.square(columns - offset) + np.square(rows)) / 4))
    make_pair = jax.jit(egomotion.egomotion_pair, static_argnames=("border", "max_shift"))
    moved, motion = make_pair(jax.random.key(0), jnp.tile(spot, (batch, 2, 1, 1)), border=border, max_shift=max_shift)
    assert moved.shape == (batch, 2, SIZE, SIZE) and moved.dtype == jnp.uint8
    assert motion.shape == (batch, 3 if max_shift else 1) and np.ptp(motion) > 1.0 and np.abs(motion).max() <= 1.0
    mass = np.asarray(moved[:, 0], np.float64)
    right, down = ((mass * axis).sum(axis=(1, 2)) / mass.sum(axis=(1, 2)) for axis in (columns, rows))
    if max_shift:
        right, down = right - max_shift * SIZE * motion[:, 1], down - max_shift * SIZE * motion[:, 2]
        np.testing.assert_allclose(np.hypot(right, down), offset, atol=0.1)
    np.testing.assert_allclose(np.degrees(np.arctan2(-down, right)), 30.0 * motion[:, 0], atol=1.0)


def test_the_strength_of_flow_is_that_of_the_newest_colours_that_move():
    """A bright disc moves by two pixels, in the newest of two RGB-D images; depth and the older image are random."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    rng = np.random.default_rng(0)

    def frame(column):
        disc = 255 * np.exp(-(np.square(columns - column) + np.square(rows - 12)) / 8)
        return np.concatenate([np.tile(disc, (3, 1, 1)), rng.uniform(0, 255, (5, SIZE, SIZE))]).astype(np.uint8)

    images = jnp.stack([frame(8), frame(10), frame(10)])
    strength = jax.jit(optical_flow.flow_strength, static_argnames=("frame_stack", "stretch"))
    pixels, stretched = (np.asarray(strength(images, frame_stack=2, stretch=stretch)) for stretch in (False, True))
    assert pixels.shape == (2, SIZE, SIZE) and pixels.dtype == np.float32
    assert 1.5 < pixels[0, 12, 8] < 2.5
    assert pixels[1].max() < 1e-3 and np.all(np.isfinite(stretched))
    assert stretched[0].min() == 0.0 and stretched[0].max() == 1.0 and stretched[0, 12, 8] > 0.5
