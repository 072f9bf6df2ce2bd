"""Tests of the networks that mask stalks for grasping."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis.errors import NonFiniteError, RequestError
from jaxrl_vis.host.weights_file import write_parameters
from jaxrl_vis.stalks.grasping.masks.examples import Example
from jaxrl_vis.stalks.grasping.masks.mask_training import Plan, sample_crops, train
from jaxrl_vis.stalks.grasping.masks.painter import Painter, Settings, read_weights, write_weights
from jaxrl_vis.stalks.grasping.masks.variation import augment
from jaxrl_vis.stalks.grasping.perception.cloud import redness


def striped(seed: int) -> Example:
    """Return an example of a dark image with bright upright stripes, which are its stalks."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((64, 96), bool)
    for column in rng.integers(4, 88, 4):
        mask[:, column : column + 5] = True
    image = np.where(mask[..., None], 190, 60) + rng.integers(-15, 15, (64, 96, 3))
    return Example(image.astype(np.uint8), mask)


def test_crops_are_parts_of_images_with_their_masks():
    examples = [striped(0), Example(np.full((20, 20, 3), 7, np.uint8), np.ones((20, 20), bool))]
    images, masks = sample_crops(examples, np.random.default_rng(0), 12, 32)
    assert images.shape == (12, 32, 32, 3) and masks.shape == (12, 32, 32)
    small = (images[:, 0, 0] == 7).all(axis=-1)
    assert 0 < small.sum() < 12
    for image, mask, is_small in zip(images, masks, small):
        assert (mask.sum() == 400 and not image[20:].any()) if is_small else ((image[..., 0] > 125) == mask).all()


def test_varied_crops_keep_their_masks():
    masks = np.zeros((16, 64, 64), bool)
    masks[:, :, 20:30] = True
    images = np.where(masks[..., None], 140, np.full(3, 40)).astype(np.uint8)
    varied, moved = (np.asarray(each) for each in augment(jnp.asarray(images), jnp.asarray(masks), jax.random.key(0)))
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
    other, _ = augment(jnp.asarray(images), jnp.asarray(masks), jax.random.key(1))
    assert (np.asarray(other) != varied).any()


@pytest.mark.parametrize("loss", ["segmentation", "gan"])
def test_generators_learn_to_paint_stripes(loss, tmp_path):
    settings = Settings(loss, (8, 16))
    reports = []
    plan = Plan(steps=100, images=4, first=4, batch=4, crop=32, rate=2e-2, ema_decay=0.9)
    params, steps = train([map(striped, range(4))], settings, plan, lambda *parts: reports.append(parts), report_interval=0.0)
    assert steps == 100 and reports and all(np.isfinite(list(report[3].values())).all() for report in reports)
    path = tmp_path / "w.safetensors"
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
        train([iter([striped(0)])], settings, plan, lambda *parts: None, report_interval=0.0)
    with pytest.raises(RequestError, match="before the first update"):
        train([iter([striped(0)])], settings, dataclasses.replace(plan, minutes=1e-9), lambda *parts: None)


def test_files_that_hold_no_masks_are_reported(tmp_path):
    with pytest.raises(RequestError, match="cannot read the weights"):
        read_weights(tmp_path / "missing.safetensors")
    (tmp_path / "text.safetensors").write_text("no weights")
    write_parameters(tmp_path / "other.safetensors", {"a": np.zeros(1)}, {})
    for name in ("text.safetensors", "other.safetensors"):
        with pytest.raises(RequestError, match="holds no weights"):
            read_weights(tmp_path / name)


# --- the command ---
