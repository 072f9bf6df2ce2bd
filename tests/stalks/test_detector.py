"""Tests of the detection and segmentation networks: operators against torchvision's, box offsets, crops, training, weights."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_detector import TINY

from jaxrl_vis.errors import NonFiniteError, RequestError
from jaxrl_vis.host.weights_file import write_parameters
from jaxrl_vis.stalks.phenotyping.detector.anchors import decode, encode, make_anchors
from jaxrl_vis.stalks.phenotyping.detector.boxes import box_iou, non_maximum_suppression, roi_align, strip_overlap
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, select_proposals
from jaxrl_vis.stalks.phenotyping.detector.doubles import suppress_duplicates
from jaxrl_vis.stalks.phenotyping.detector.finder import Finder
from jaxrl_vis.stalks.phenotyping.detector.losses import assign_boxes
from jaxrl_vis.stalks.phenotyping.detector.sections import NOTHING, STALK, UNCLEAR
from jaxrl_vis.stalks.phenotyping.detector.stalk_crops import crop_shape, cut_crops, paste_crop
from jaxrl_vis.stalks.phenotyping.detector.weights import read_weights, write_weights
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.images import to_rgb8
from jaxrl_vis.stalks.phenotyping.io.masks import decode_counts
from jaxrl_vis.stalks.phenotyping.training.annotated import annotated_examples, fit_settings
from jaxrl_vis.stalks.phenotyping.training.augment import augment_crops, augment_geometry
from jaxrl_vis.stalks.phenotyping.training.detector_training import Plan, _Pool, train
from jaxrl_vis.stalks.phenotyping.training.examples import MAX_STALKS, Example, _instance_masks, synthetic_examples
from jaxrl_vis_envs.plants import family

# One program each, in place of one for every operation in them.
strip_overlap, box_iou = jax.jit(strip_overlap), jax.jit(box_iou)
encode, decode, augment_crops = jax.jit(encode), jax.jit(decode), jax.jit(augment_crops)
roi_align, select_proposals = jax.jit(roi_align, static_argnums=(2, 3, 4, 5)), jax.jit(select_proposals, static_argnums=(3, 4))
assign_boxes, non_maximum_suppression, augment_geometry = (
    jax.jit(assign_boxes),
    jax.jit(non_maximum_suppression),
    jax.jit(augment_geometry),
)


@jax.jit
def nms(boxes, scores, threshold, valid=None):
    """Apply non-maximum suppression to boxes [N, 4] by intersection over union, as torchvision does."""
    return non_maximum_suppression(box_iou(boxes, boxes), scores, threshold, valid)


RECORDED = np.load(Path(__file__).parent / "data" / "torchvision_boxes.npz")


# --- operators ---


@pytest.mark.parametrize("threshold", [0.3, 0.5, 0.7])
def test_suppression_is_torchvisions(threshold):
    kept = nms(jnp.asarray(RECORDED["boxes"]), jnp.asarray(RECORDED["scores"]), threshold)
    np.testing.assert_array_equal(np.asarray(kept), RECORDED[f"kept_{threshold}"])


@pytest.mark.parametrize("aligned", [False, True])
def test_roi_align_is_torchvisions(aligned):
    pooled = roi_align(jnp.asarray(RECORDED["features"]), jnp.asarray(RECORDED["regions"]), (5, 4), 1 / 8, 2, aligned)
    np.testing.assert_allclose(np.asarray(pooled), RECORDED[f"pooled_{int(aligned)}"], atol=2e-5)


def test_a_region_leans_as_its_stalk():
    """In features that hold their coordinates, each row of the grid is shifted by the lean of its box."""
    rows, columns = jnp.meshgrid(jnp.arange(40.0), jnp.arange(60.0), indexing="ij")
    features = jnp.stack([rows, columns], axis=-1)
    boxes, lean = jnp.array([[20.0, 10.0, 28.0, 30.0], [30.0, 4.0, 38.0, 24.0]]), jnp.array([10.0, -5.0])
    upright = np.asarray(roi_align(features, boxes, (5, 4), 1.0, 2, True))
    leaning = np.asarray(roi_align(features, boxes, (5, 4), 1.0, 2, True, lean))
    moved = np.asarray(lean)[:, None] * np.array([-0.4, -0.2, 0.0, 0.2, 0.4])
    np.testing.assert_allclose(leaning[..., 0], upright[..., 0], atol=1e-4)
    np.testing.assert_allclose(leaning[..., 1], upright[..., 1] + moved[..., None], atol=1e-4)


def test_what_is_not_there_suppresses_nothing():
    boxes = jnp.array([[0.0, 0, 10, 10], [1, 0, 11, 10], [40, 0, 50, 10]])
    scores = jnp.array([0.9, 0.8, 0.7])
    assert nms(boxes, scores, 0.5).tolist() == [True, False, True]
    assert nms(boxes, scores, 0.5, jnp.array([False, True, True])).tolist() == [False, True, True]


def test_parallel_stalks_that_lean_are_two():
    """Their boxes overlap by more than half, but their strips hardly do; strips of the same stalk, detected twice, do."""
    first = [0.0, 0.0, 40.0, 135.0, 35.0, 5.0]
    beside = [12.0, 2.0, 52.0, 137.0, 47.0, 17.0]
    again = [1.0, 3.0, 41.0, 138.0, 36.0, 6.0]
    stalks = jnp.array([first, beside, again])
    overlaps = np.asarray(strip_overlap(stalks, stalks))
    assert np.asarray(box_iou(stalks[:, :4], stalks[:, :4]))[0, 1] > 0.5
    assert overlaps[0, 1] < 0.01 and overlaps[0, 2] > 0.6
    assert non_maximum_suppression(jnp.asarray(overlaps), jnp.array([0.9, 0.8, 0.7]), 0.4).tolist() == [True, True, False]


def test_a_stalk_that_two_finds_outline_is_one():
    """Crops may differ; a suppressed detection suppresses no other, and crossing stalks are two."""
    image = np.zeros((120, 100), np.float32)

    def piece(top, left, mask):
        return mask, (top, left)

    upright, crossing = image.copy(), image.copy()
    upright[:, 40:60] = 0.9
    for row in range(120):
        crossing[row, row // 2 + 10 : row // 2 + 30] = 0.9
    upright[crossing > 0.5] = 0.2  # it is behind the other one
    part = crossing[20:120, 30:100]
    half = np.where(np.arange(120)[:, None] < 55, crossing, upright)  # the first of one and the rest of the other
    pieces = [piece(0, 0, upright), piece(0, 0, crossing), piece(20, 30, part), piece(0, 0, half), piece(0, 0, image[:0, :0])]
    scores = np.array([0.8, 0.9, 0.7, 0.5, 0.4])
    assert suppress_duplicates(pieces, scores).tolist() == [True, True, False, True, True]
    assert suppress_duplicates(pieces, scores[[0, 2, 1, 3, 4]]).tolist() == [True, False, True, True, True]
    assert suppress_duplicates(pieces, scores, max_shared=0.4).tolist() == [True, True, False, False, True]
    # Of three in a row that each share most of their neighbour's mask, the first and the last are two.
    chain = [piece(0, left, np.ones((50, 20), bool)) for left in (0, 7, 14)]
    assert suppress_duplicates(chain, np.array([0.9, 0.8, 0.7])).tolist() == [True, False, True]
    assert suppress_duplicates(chain, np.array([0.8, 0.9, 0.7])).tolist() == [False, True, False]
    assert suppress_duplicates([], np.zeros(0)).tolist() == []


def test_codes_are_inverted():
    rng = np.random.default_rng(0)
    corner = rng.uniform(0, 100, (50, 2))
    others = np.concatenate([corner, corner + rng.uniform(5, 50, (50, 2)), rng.uniform(0, 100, (50, 2))], axis=1)
    stalks = others + np.concatenate([rng.uniform(-2, 2, (50, 4)), rng.uniform(-50, 50, (50, 2))], axis=1)
    back = decode(encode(jnp.asarray(stalks), jnp.asarray(others)), jnp.asarray(others))
    np.testing.assert_allclose(np.asarray(back), stalks, atol=1e-3)


def test_proposals_are_the_best_anchors_and_no_copies():
    shape = (64, 64)
    anchors = jnp.asarray(make_anchors(shape, 30.0, (6.0, 12.0)))
    logits = jnp.full(len(anchors), -5.0).at[jnp.array([40, 42, 90])].set(jnp.array([3.0, 2.0, 4.0]))
    stalks, scores, valid = select_proposals(logits, jnp.zeros((len(anchors), 6)), anchors, TINY, shape)
    assert stalks.shape == (12, 6) and valid.shape == (12,)
    assert scores[0] == 4.0
    kept = np.asarray(stalks)[np.asarray(valid)]
    assert kept[:, :4].min() >= 0 and kept[:, :4].max() <= 64
    between = np.array(strip_overlap(jnp.asarray(kept), jnp.asarray(kept)))
    np.fill_diagonal(between, 0)
    assert between.max() <= TINY.proposal_threshold


def test_copies_of_a_stalk_leave_room_for_another():
    """A stalk that leans across another is among the proposals if there are enough candidates."""
    easy, hard = jnp.array([20.0, 10.0, 40.0, 40.0, 22.0, 38.0]), jnp.array([20.0, 10.0, 40.0, 40.0, 38.0, 22.0])
    anchors = jnp.concatenate([jnp.tile(easy, (99, 1)), hard[None]])
    logits = jnp.linspace(5.0, 1.0, len(anchors))
    offsets = jnp.zeros((len(anchors), 6))
    for candidates, wanted in ((99, [easy]), (100, [easy, hard])):
        settings = dataclasses.replace(TINY, candidates=candidates)
        stalks, _, valid = select_proposals(logits, offsets, anchors, settings, (60, 64))
        np.testing.assert_allclose(stalks[valid], jnp.stack(wanted), atol=1e-5)


def test_boxes_on_unclear_stalks_are_neither_right_nor_wrong():
    truth = jnp.array([[10.0, 0, 20, 60], [40, 0, 50, 60], [70, 0, 80, 60]])
    kinds = jnp.array([STALK, UNCLEAR, NOTHING])
    which, positive, negative = assign_boxes(box_iou(truth, truth), kinds, 0.5, 0.3)
    assert which[0] == 0 and positive.tolist() == [True, False, False] and negative.tolist() == [False, False, True]


# --- crops ---


def test_a_crop_is_put_back_where_it_was():
    rng = np.random.default_rng(1)
    image = rng.uniform(0.1, 1, (60, 50)).astype(np.float32)
    stalk = np.array([18.0, 5, 40, 55, 36, 20], np.float32)
    crop = np.asarray(cut_crops(jnp.asarray(image), stalk[None], (48, 16)))[0]
    back, (row, column) = paste_crop(crop, stalk, image.shape)
    there = image[row : row + back.shape[0], column : column + back.shape[1]]
    assert (back > 0).sum() == 48 * 16
    np.testing.assert_array_equal(back[back > 0], there[back > 0])
    # The stalk stands upright in the middle: its axis is the crop's middle column.
    middle = 36 + (20 - 36) * (row + 0.5 - 5) / 50
    assert np.flatnonzero(back[0])[[0, -1]].mean() + column + 0.5 == pytest.approx(middle, abs=0.6)


def test_crops_at_the_images_edge_are_black_beyond_it():
    image = np.ones((40, 30), np.float32)
    stalk = np.array([-4.0, 10, 6, 40, 1, 1], np.float32)
    crop = np.asarray(cut_crops(jnp.asarray(image), stalk[None], (32, 16)))[0]
    assert crop[:, :7].max() == 0 and crop[:31, 7:].min() == 1
    back, corner = paste_crop(crop, stalk, image.shape)
    assert corner == (9, 0) and back.min() == 1
    nowhere, _ = paste_crop(crop, stalk + 100, image.shape)
    assert nowhere.size == 0


def test_smaller_images_have_smaller_crops():
    assert crop_shape((640, 128), 1.0) == (640, 128)
    assert crop_shape((640, 128), 0.5) == (320, 64)


# --- learning ---


def drawing(seed: int) -> Example:
    """Return an example of a bright stalk on a dark image."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 40, (60, 64, 3)).astype(np.uint8)
    top, bottom = rng.uniform(20, 44, 2)
    mask = np.zeros((60, 64), bool)
    for row in range(60):
        middle = top + (bottom - top) * (row - 15) / 30
        begin, end = np.clip([round(middle - 3), round(middle + 3)], 0, 64)
        image[row, begin:end] = 200
        mask[row, begin:end] = True
    stalk = np.array([min(top, bottom) - 3, 15, max(top, bottom) + 3, 45, top, bottom], np.float32)
    stalks, kinds = np.zeros((MAX_STALKS, 6), np.float32), np.zeros(MAX_STALKS, np.int32)
    stalks[0], kinds[0] = stalk, STALK
    crops = np.asarray(cut_crops(jnp.asarray(image), stalk[None], (32, 16)))
    masks = np.asarray(cut_crops(jnp.asarray(mask), stalk[None], (32, 16)))
    return Example(image, stalks, kinds, crops, masks)


def test_stalks_move_with_their_images():
    """After augmentation, the stalk lies where the image is bright; some images are narrower than others."""
    examples = [drawing(seed) for seed in range(8)]
    images = np.zeros((8, 64, 64, 3), np.uint8)
    images[:, :60] = [each.image for each in examples]
    stalks, kinds = (np.stack([getattr(each, name) for each in examples]) for name in ("stalks", "kinds"))
    sizes = np.tile([60, 64], (len(images), 1))
    narrow = stalks[:, 0, 2] < 44
    images[narrow, :, 48:], sizes[narrow, 1] = 0, 48
    assert 0 < narrow.sum() < len(images)
    moved, places, kinds = augment_geometry(
        jnp.asarray(images), jnp.asarray(stalks), jnp.asarray(kinds), jnp.asarray(sizes), jax.random.key(0)
    )
    assert moved.dtype == jnp.uint8
    compared = 0
    for image, stalk, kind, width in zip(np.asarray(moved), np.asarray(places)[:, 0], np.asarray(kinds)[:, 0], sizes[:, 1]):
        for row in range(int(np.ceil(stalk[1])), int(stalk[3]), 5):
            bright = np.flatnonzero(image[row, :, 0] > 120)
            if kind == STALK and bright.size and bright[0] > 0 and bright[-1] < width - 1:
                middle = stalk[4] + (stalk[5] - stalk[4]) * (row + 0.5 - stalk[1]) / (stalk[3] - stalk[1])
                assert bright.mean() + 0.5 == pytest.approx(middle, abs=1.2)
                assert stalk[0] - 1.2 <= bright[0] and bright[-1] + 1 <= stalk[2] + 1.2
                compared += 1
    assert compared > 20


def test_images_of_several_sizes_are_batched_together():
    """A larger image that arrives late enlarges the batches; all crops of a batch have one size."""
    plan = Plan(images=26, first=24, batch=16, crops=4)
    small, large = drawing(0), drawing(1)
    large = dataclasses.replace(
        large, image=np.pad(large.image, ((0, 40), (0, 70), (0, 0))), crops=large.crops[:, :24], masks=large.masks[:, :24]
    )
    pool = _Pool([iter([small] * 24), iter([large, large])], plan)
    try:
        pool.fill(26)
        rng = np.random.default_rng(0)
        for _ in range(4):
            images, stalks, kinds, sizes = pool.sample_images(rng)
            assert images.shape == (16, 128, 160, 3) and stalks.shape[:2] == kinds.shape
            assert {tuple(size) for size in sizes} <= {(60, 64), (100, 134)}
            for image, size in zip(images, sizes):
                np.testing.assert_array_equal(image[size[0] :], 0)
            strips = pool.sample_crops(rng)
            assert strips is not None and strips[0].shape[:3] == strips[1].shape
    finally:
        pool.close()


@pytest.fixture(scope="module")
def trained():
    said = []
    sources = [iter([drawing(seed) for seed in range(24)])]
    plan = Plan(steps=160, images=24, first=24, batch=4, crops=4, rate=4e-3, ema_decay=0.9)
    params, steps = train(sources, TINY, plan, lambda step, *rest: said.append((step, rest[2])), report_interval=0.0)
    return params, steps, said


def test_networks_learn_to_find_and_outline(trained, tmp_path):
    """In images of one bright stalk, the best detection and its mask overlap it, with weights read back from a file."""
    params, steps, said = trained
    assert steps == 160 and said[0][0] == 8
    assert np.mean([sum(losses.values()) for _, losses in said[-4:]]) < 0.6 * sum(said[0][1].values())
    path = tmp_path / "weights.safetensors"
    write_weights(path, params, TINY, {"origin": "drawings"})
    restored, settings, about = read_weights(path)
    assert settings == TINY and about == {"origin": "drawings"}
    finder = Finder(restored, settings, 0.0)
    overlaps, agreement = [], []
    for seed in range(100, 106):
        example = drawing(seed)
        found = finder(example.image)
        assert found == sorted(found, key=lambda each: sum(each.axis))
        best = max(found, key=lambda each: each.score)
        box = np.array(best.box)[None] + 0.5
        overlaps.append(float(box_iou(jnp.asarray(box), jnp.asarray(example.stalks[:1, :4]))[0, 0]))
        (row, column), (tall, wide) = best.corner, best.mask.shape
        bright = example.image[row : row + tall, column : column + wide, 0] > 120
        agreement.append(((best.mask > 0.5) & bright).sum() / ((best.mask > 0.5) | bright).sum())
    assert np.median(overlaps) > 0.5
    assert np.median(agreement) > 0.5


def test_a_loss_that_is_not_finite_stops_the_training():
    plan = Plan(steps=40, images=2, first=2, batch=4, crops=4, rate=float("nan"))
    with pytest.raises(NonFiniteError, match="not finite at step"):
        train([iter([drawing(0), drawing(1)])], TINY, plan, lambda *rest: None, report_interval=0.0)


def test_a_training_without_time_for_an_update_is_reported():
    plan = Plan(minutes=1e-9, images=2, first=2, batch=4, crops=4)
    with pytest.raises(RequestError, match="before the first update: allow more with --minutes"):
        train([iter([drawing(0), drawing(1)])], TINY, plan, lambda *rest: None)


def test_masks_of_crops_are_cut_out_of_what_each_pixel_shows():
    """Masks include that of the stalk with index 0, and are False beyond the image's edge."""
    instance = jnp.asarray(np.repeat(np.arange(32) // 8 - 1, 40).reshape(32, 40).T, jnp.int32)  # [40, 32], -1 to 2
    places = np.array([[8.0, 4, 16, 36, 10, 14], [16, 4, 24, 36, 20, 20], [24, -10, 32, 30, 30, 30]])
    masks = _instance_masks(instance, np.array([0, 1, 2]), np.arange(3), places, (48, 16))
    for part, mask in enumerate(masks):
        np.testing.assert_array_equal(mask, np.asarray(cut_crops(instance == part, places[part : part + 1], (48, 16)))[0])
        assert mask.any()


def test_synthetic_examples_hold_crops_around_both_heights():
    layout = family.Layout(rows_behind=0, stalks_mean=12, stalks_sd=0, tillers=0.0, plot_length=0.8)
    stalks = family.Stalks(diameter_mean=0.03, lean_sd=(0.0, 0.0))
    few = dataclasses.replace(family.TRAINING, layout=layout, stalks=stalks).at_width(211)
    (example,) = synthetic_examples(few, Settings(), 3, frames=1)
    clear = int((example.kinds == STALK).sum())
    assert clear < len(example.crops) <= 2 * clear and example.crops.shape[1:] == (40, 16, 3)
    assert example.masks.shape == example.crops.shape[:3]
    # The stalk stands in the middle of its crop, at the upper height, too.
    middle = example.masks[:, 10:30, 7:9].mean(axis=(1, 2))
    assert np.median(middle[:clear]) > 0.6 and np.median(middle[clear:]) > 0.6


def test_crops_are_varied_and_their_masks_stay_with_them():
    """A bright strip on black stays where its mask is, and its surroundings stay dark."""
    crops, masks = np.zeros((24, 64, 48, 3), np.uint8), np.zeros((24, 64, 48), bool)
    crops[:, :, 14:30], masks[:, :, 14:30] = 150, True
    varied, moved = map(np.asarray, augment_crops(jnp.asarray(crops), jnp.asarray(masks), jax.random.key(0)))
    assert moved.shape == masks.shape and varied.dtype == np.uint8
    inside = np.array([image[mask].mean() for image, mask in zip(varied, moved)])
    outside = np.array([image[~mask].mean() for image, mask in zip(varied, moved)])
    assert (inside > 2.0 * outside).all() and inside.max() > 2.0 * inside.min()
    widths = moved[:, 32].sum(axis=-1)
    assert widths.min() < 14 and widths.max() > 18


def test_what_fails_to_make_examples_is_reported():
    def broken():
        yield drawing(0)
        raise RequestError("no such image")

    with pytest.raises(RequestError, match="no such image"):
        train([broken()], TINY, Plan(first=2, images=2), lambda *rest: None)


@pytest.mark.parametrize("text", [b"", b"no weights", b"PK\x03\x04 half of it"])
def test_files_that_hold_no_weights(tmp_path, text):
    path = tmp_path / "weights.safetensors"
    path.write_bytes(text)
    with pytest.raises(RequestError, match="holds no weights"):
        read_weights(path)
    with pytest.raises(RequestError, match="cannot read the weights"):
        read_weights(tmp_path / "missing.safetensors")


def test_weights_whose_numbers_meant_something_else(tmp_path):
    path = tmp_path / "weights.safetensors"
    write_parameters(path, {"detector": {"bias": np.zeros(3)}}, {"schema": 1, "settings": dataclasses.asdict(TINY)})
    with pytest.raises(RequestError, match="of another version: train them again with `jaxrl-vis phenotype train`"):
        read_weights(path)


def test_annotations_of_ones_own(tmp_path):
    """Boxes without masks and polygons both give stalks; anchors are as large as the boxes."""
    import json

    import cv2

    cv2.imwrite(str(tmp_path / "row.png"), np.full((60, 64, 3), 90, np.uint8))
    leaning = [[10.0, 50, 16, 50, 26, 10, 20, 10]]
    data = {
        "images": [{"id": 1, "file_name": "row.png", "width": 64, "height": 60}],
        "annotations": [
            {"image_id": 1, "bbox": [10, 10, 16, 40], "segmentation": leaning},
            {"image_id": 1, "bbox": [40, 10, 8, 40]},
        ],
    }
    (tmp_path / "annotations.json").write_text(json.dumps(data))
    settings = fit_settings(tmp_path, dataclasses.replace(TINY, band_height=40.0))  # as tall as the boxes: nothing is resized
    assert settings.band_height == 40.0 and 8.0 <= settings.anchor_widths[0] < settings.anchor_widths[-1] <= 16.0
    (example,) = annotated_examples(tmp_path, settings)
    assert (example.kinds == STALK).sum() == 2 and example.crops.shape == (2, 32, 24, 3)  # twice as wide as the boxes
    np.testing.assert_allclose(example.stalks[0], [10, 10, 26, 50, 23, 13], atol=1.5)
    np.testing.assert_allclose(example.stalks[1], [40, 10, 48, 50, 44, 44], atol=0.01)
    (tmp_path / "row.png").unlink()
    with pytest.raises(RequestError, match="cannot be read"):
        next(annotated_examples(tmp_path, settings))
    (tmp_path / "annotations.json").write_text("{}")
    with pytest.raises(RequestError, match="is not COCO"):
        fit_settings(tmp_path, TINY)


def test_annotations_of_voc_and_labelme_are_those_of_coco(tmp_path):
    """Both yield the same box in COCO format; labels other than stalk are left out."""
    import json

    (tmp_path / "voc").mkdir()
    (tmp_path / "labelme").mkdir()
    things = "".join(
        f"<object><name>{name}</name><bndbox><xmin>11</xmin><ymin>5</ymin><xmax>20</xmax><ymax>44</ymax></bndbox></object>"
        for name in ("stalk", "leaf")
    )
    size = "<size><width>64</width><height>60</height></size>"
    (tmp_path / "voc" / "row.xml").write_text(f"<annotation><filename>row.png</filename>{size}{things}</annotation>")
    shapes = [
        {"label": "Stalk", "points": [[10, 4], [20, 44]], "shape_type": "rectangle"},
        {"label": "leaf", "points": [[0, 0], [5, 0], [5, 5]], "shape_type": "polygon"},
    ]
    about = {"shapes": shapes, "imagePath": "..\\images\\row.png", "imageWidth": 64, "imageHeight": 60}
    (tmp_path / "labelme" / "row.json").write_text(json.dumps(about))
    for kind in ("voc", "labelme"):
        data = read_annotations(tmp_path / kind)
        (image,), (annotation,) = data["images"], data["annotations"]
        assert image["file_name"] == "row.png" and (image["width"], image["height"]) == (64, 60)
        assert annotation["bbox"] == [10, 4, 10, 40]
    (tmp_path / "empty").mkdir()
    with pytest.raises(RequestError, match="there are no annotations in"):
        read_annotations(tmp_path / "empty")
    (tmp_path / "voc" / "row.xml").write_text("<annotation>")
    with pytest.raises(RequestError, match="row.xml is not an annotation of Pascal VOC"):
        read_annotations(tmp_path / "voc")
    (tmp_path / "labelme" / "row.json").write_text("{}")
    (tmp_path / "labelme" / "row.png").touch()  # without it, any other file may be called so
    with pytest.raises(RequestError, match="row.json is not an annotation of LabelMe"):
        read_annotations(tmp_path / "labelme")


def test_runs_that_are_text():
    """Runs of a 2 x 3 image whose middle column is set, and longer ones, are decoded as written by pycocotools."""
    assert decode_counts("222") == [2, 2, 2]
    assert decode_counts("`1m1S3XNSO") == [48, 61, 99, 5, 70]
    with pytest.raises(ValueError, match="middle of a number"):
        decode_counts("`")


def test_images_of_any_depth_become_eight_bits():
    for bits in (10, 12, 14, 16):
        image = np.linspace(0, (1 << bits) - 1, 64).astype(np.uint16).reshape(8, 8)
        image8 = to_rgb8(image)
        assert image8.shape == (8, 8, 3) and image8.dtype == np.uint8 and (image8.min(), image8.max()) == (0, 255)
    assert to_rgb8(np.full((2, 2, 3), 7, np.uint8)).tolist() == np.full((2, 2, 3), 7).tolist()
