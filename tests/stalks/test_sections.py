"""Tests of sections: targets in bands of the image, augmentation, chains, and cutting chains to the band of heights."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_detector import TINY

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.detector.anchors import encode, make_anchors
from jaxrl_vis.stalks.phenotyping.detector.band import cut_to_band, move_to_band
from jaxrl_vis.stalks.phenotyping.detector.boxes import roi_align, strip_half_width
from jaxrl_vis.stalks.phenotyping.detector.chains import Chain, best_rows, covered_fraction, cut_chain, link
from jaxrl_vis.stalks.phenotyping.detector.detect import GRID, Settings, detect, init_detector, pool_regions
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter
from jaxrl_vis.stalks.phenotyping.detector.finder import Finder
from jaxrl_vis.stalks.phenotyping.detector.gate import read_gate
from jaxrl_vis.stalks.phenotyping.detector.loading import load_finder
from jaxrl_vis.stalks.phenotyping.detector.sections import (
    ABSENT,
    NOTHING,
    STALK,
    UNCLEAR,
    decode_sections,
    section_anchors,
    true_sections,
)
from jaxrl_vis.stalks.phenotyping.detector.weights import PHOTOGRAPHS, SHIPPED, read_weights, write_weights
from jaxrl_vis.stalks.phenotyping.measure.ground import Ground, band_rows
from jaxrl_vis.stalks.phenotyping.training.augment import augment_geometry
from jaxrl_vis.stalks.phenotyping.training.detector_training import OUTPUTS, start_sections
from jaxrl_vis.stalks.phenotyping.training.edges import _sides, annotated_edges, stack_edges, synthetic_edges
from jaxrl_vis.stalks.phenotyping.training.examples import Example, crop_randomly, synthetic_examples
from jaxrl_vis.stalks.phenotyping.training.held_out import true_targets
from jaxrl_vis_envs.plants import Calibration, draw, family
from jaxrl_vis_envs.plants.cameras import drive
from jaxrl_vis_envs.plants.pairs import Sequence
from jaxrl_vis_envs.plants.scene import Scene

HEIGHT, WIDTH = 128, 160
true_sections, decode_sections, encode = jax.jit(true_sections, static_argnums=3), jax.jit(decode_sections), jax.jit(encode)


def straight(
    column: float, slope: float, wide: float, visible: float | np.ndarray = 1.0, rows: int = HEIGHT // 8
) -> np.ndarray:
    """Return edges [R, 3] of a straight stalk whose axis is in ``column`` at the top of the image."""
    middle = column + slope * (np.arange(HEIGHT // 8) + 0.5) * 8
    return np.stack([middle - wide / 2, middle + wide / 2, np.broadcast_to(visible, len(middle))], axis=-1).astype(np.float32)


def sections_of(
    *edges: np.ndarray, kinds: tuple[int, ...] | None = None, size=(HEIGHT, WIDTH)
) -> tuple[np.ndarray, np.ndarray]:
    kinds = kinds or (STALK,) * len(edges)
    batch, names = stack_edges([(np.stack(edges), np.array(kinds, np.int32))], HEIGHT)
    stalks, kind = true_sections(jnp.asarray(batch[0]), jnp.asarray(names[0]), jnp.asarray(size), 32)
    return np.asarray(stalks)[:, : len(edges)], np.asarray(kind)[:, : len(edges)]


# --- targets ---


def test_a_section_spans_its_band_and_follows_the_edges():
    stalks, kinds = sections_of(straight(40, 0.25, 12))
    assert (kinds == STALK).all() and stalks.shape == (4, 1, 6)
    for band in range(4):
        top, bottom = 32 * band, 32 * (band + 1)
        above, below = 40 + 0.25 * top, 40 + 0.25 * bottom
        np.testing.assert_allclose(stalks[band, 0], [above - 6, top, below + 6, bottom, above, below], atol=1e-3)


def test_bands_without_a_visible_stalk_hold_no_target():
    hidden = np.array([1.0] * 4 + [0.0] * 4 + [0.3] * 4 + [ABSENT] * 4)
    thin, outside, half_outside = straight(100, 0, 3), straight(-30, 0, 12), straight(0, 0, 12)
    _, kinds = sections_of(straight(40, 0, 12, hidden), thin, outside, half_outside, straight(80, 0, 12))
    assert kinds[:, 0].tolist() == [STALK, NOTHING, UNCLEAR, NOTHING]
    assert (kinds[:, 1] == UNCLEAR).all() and (kinds[:, 2] == NOTHING).all() and (kinds[:, 3] == UNCLEAR).all()
    # The last band is mostly below the image; a stalk of a row behind is never a target.
    _, kinds = sections_of(straight(80, 0, 12), straight(40, 0, 12), kinds=(STALK, UNCLEAR), size=(106, WIDTH))
    assert kinds[:, 0].tolist() == [STALK, STALK, STALK, UNCLEAR] and (kinds[:, 1] == UNCLEAR).all()


def test_sections_are_decoded_as_they_were_encoded():
    stalks, _ = sections_of(*(straight(20 * place, 0.1 * place, 6 + 3 * place) for place in range(1, 7)))
    anchors = section_anchors((HEIGHT, WIDTH), 32, (12.0, 24.0, 48.0))
    chosen = jnp.asarray(np.broadcast_to(anchors[:, 50:51], stalks.shape))
    decoded = np.asarray(decode_sections(encode(jnp.asarray(stalks), chosen), chosen))
    np.testing.assert_array_equal(decoded[..., [1, 3]], stalks[..., [1, 3]])
    np.testing.assert_allclose(decoded, stalks, atol=2e-4)
    moved = np.asarray(decode_sections(encode(jnp.asarray(stalks), chosen) + 3.0, chosen))
    np.testing.assert_array_equal(moved[..., [1, 3]], stalks[..., [1, 3]])  # whatever the networks say


def test_anchors_have_the_order_of_the_proposals():
    every = make_anchors((HEIGHT, WIDTH), 16, (12.0, 48.0))
    np.testing.assert_array_equal(section_anchors((HEIGHT, WIDTH), 16, (12.0, 48.0)).reshape(-1, 6), every)
    tall = section_anchors((HEIGHT, WIDTH), 32, (12.0, 48.0))
    assert tall.shape == (4, 80, 6) and (tall[2, :, 1] == 64).all() and (tall[2, :, 3] == 96).all()


def test_edges_move_with_the_image():
    """Edges of bright leaning strips stay at the strips when the image is augmented."""
    edges = np.stack([straight(60, 0.2, 14), straight(120, -0.1, 10)])
    rows, columns = np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for middle, wide in ((60 + 0.2 * rows, 14), (120 - 0.1 * rows, 10)):
        image[np.abs(columns - middle[:, None]) < wide / 2] = 200
    batch, kinds = stack_edges([(edges, np.array([STALK, STALK]))] * 12, HEIGHT)
    sizes = np.tile([HEIGHT, WIDTH], (12, 1)).astype(np.int32)
    images = np.tile(image[None], (12, 1, 1, 1))
    moved, after, _ = jax.jit(augment_geometry)(images, batch, kinds, sizes, jax.random.key(4))
    moved, after = np.asarray(moved)[..., 0], np.asarray(after)
    assert np.abs(after - batch).max() > 10.0
    checked = 0
    for picture, stalks in zip(moved, after[:, :2]):
        for row, (left, right, visible) in ((row, each) for edges in stalks for row, each in enumerate(edges)):
            values = picture[8 * row + 3 : 8 * row + 5].max(axis=0)
            if visible == 1.0 and left > 5 and right < WIDTH - 5:
                assert values[int(left + 2)] > 150 and values[int(right - 3)] > 150
                checked += 1
    assert checked > 150
    gone = after[:, :2, :, 2] < 0  # rows that come from outside the image
    assert gone.any() and (moved[:, 4::8].max(axis=-1)[gone.all(axis=1)] == 0).all()


def test_crops_begin_between_rows_of_the_edges():
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    nothing = np.zeros((0, 8, 8))
    edges = straight(60, 0.2, 14)[None], np.array([STALK])
    for row in range(HEIGHT):
        image[row, :, 0] = row
    image[:, :, 1] = np.arange(WIDTH)
    stalks = np.zeros((1, 6), np.float32)
    example = Example(image, stalks, np.array([NOTHING]), nothing, nothing, edges)
    for seed in range(5):
        part = crop_randomly(example, (64, 80), np.random.default_rng(seed))
        assert part.edges is not None
        top, left = (int(value) for value in part.image[0, 0, :2])
        assert top % 8 == 0
        np.testing.assert_allclose(part.edges[0][0, :, 0] + left, edges[0][0, top // 8 : top // 8 + 8, 0])


def test_annotations_say_nothing_about_the_rest_of_a_stalk():
    box = np.array([[60, 40, 80, 80, 65, 75]], np.float32)
    edges, kinds = annotated_edges(box, np.array([STALK]), [None], (HEIGHT, WIDTH), (1.0, 1.0))
    _, kind = sections_of(edges[0])
    assert kinds.tolist() == [STALK] and kind[:, 0].tolist() == [UNCLEAR, STALK, STALK, UNCLEAR]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[40:80, 62:71] = True
    edges, _ = annotated_edges(box, np.array([STALK]), [mask], (64, 80), (2.0, 2.0))
    np.testing.assert_allclose(edges[0, 2:5], [[31, 35.5, 1.0]] * 3)


def test_features_of_sections_are_those_of_roi_align():
    features = jax.random.normal(jax.random.key(0), (HEIGHT // 8, WIDTH // 4, 3))
    stalks, _ = sections_of(*(straight(25 * place - 10, 0.3 - 0.1 * place, 6 + 3 * place) for place in range(7)))
    stalks = jnp.asarray(stalks.reshape(-1, 6))
    made = jax.jit(pool_regions, static_argnums=2)(features, stalks, 32)
    tall, slope = 32.0, (stalks[:, 5] - stalks[:, 4]) / 32.0
    half, middle = 1.5 * strip_half_width(stalks) + 6.0, 0.5 * (stalks[:, 4] + stalks[:, 5])
    boxes = jnp.stack([middle - half, stalks[:, 1] - tall, middle + half, stalks[:, 3] + tall], axis=-1)
    wanted = roi_align(features, boxes, GRID, (1 / 8, 1 / 4), 2, True, 3.0 * tall * slope)
    np.testing.assert_allclose(made, wanted, atol=1e-5)


# --- chains ---


def chain_of(*columns: float, wide: float = 12.0, bands: tuple[int, ...] | None = None) -> np.ndarray:
    """Return sections [N, 6] of one stalk whose axis is in ``columns`` at the borders of bands; all bands if None."""
    bands = bands or tuple(range(len(columns) - 1))
    ends = np.array([columns[:-1], columns[1:]]).T[list(bands)]
    tops = 32.0 * np.array(bands)
    box = [ends.min(1) - wide / 2, tops, ends.max(1) + wide / 2, tops + 32]
    return np.stack([*box, ends[:, 0], ends[:, 1]], axis=1).astype(np.float32)


def test_sections_are_linked_to_stalks():
    one, other = chain_of(50, 56, 63, 71, 80, 90), chain_of(90, 84, 77, 69, 60, 50)  # they cross
    thick = chain_of(200, 200, 200, wide=12), chain_of(200, 200, 200, 200, wide=40)[2:]
    sections = np.concatenate([one, other, *thick])
    order = np.random.default_rng(0).permutation(len(sections))
    chains = link(sections[order], np.full(len(sections), 0.9, np.float32), 32)
    assert sorted(len(chain.scores) for chain in chains) == [1, 2, 5, 5]
    for wanted in (one, other):
        assert any(np.array_equal(chain.sections, wanted) for chain in chains)


def test_gaps_of_a_few_bands_are_bridged_and_weak_sections_are_not_linked():
    parted = chain_of(*np.linspace(50, 130, 11), bands=(0, 1, 4, 5, 6))
    (chain,) = link(parted, np.full(5, 0.8, np.float32), 32)
    assert len(chain.scores) == 5
    # 7 bands further down, and where the stalk does not lead to.
    assert len(link(chain_of(*[50.0] * 12, bands=(0, 1, 9, 10)), np.full(4, 0.8, np.float32), 32)) == 2
    beside = np.concatenate([chain_of(50, 50, 50), chain_of(50, 50, 75, 75, 75)[2:]])
    assert len(link(beside, np.full(4, 0.8, np.float32), 32)) == 2
    assert len(link(parted, np.array([0.8, 0.05, 0.8, 0.8, 0.8], np.float32), 32)[0].scores) in (1, 3, 4)
    assert not link(parted, np.full(5, 0.05, np.float32), 32)


def test_several_weak_sections_are_evidence():
    def score(*scores: float) -> float:
        return Chain(chain_of(*[50.0] * (len(scores) + 1)), np.array(scores)).score

    assert score(0.5) < score(0.5, 0.5) < score(0.5, 0.5, 0.5)
    assert score(0.5, 0.5) == pytest.approx(0.5) and score(0.9) < 0.9 < score(0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.9)
    assert score(0.1) < 0.06 and 0.0 < score(1.0, 0.2) <= 1.0


def test_a_chain_is_cut_to_rows():
    chain = Chain(chain_of(*np.linspace(50, 130, 6), wide=20), np.array([0.2, 0.3, 0.9, 0.8, 0.9]))
    axis = [50 + 16 * row / 32 for row in (40, 100)]
    np.testing.assert_allclose(cut_chain(chain, 40, 100), [axis[0] - 10, 40, axis[1] + 10, 100, *axis], atol=1e-4)
    assert best_rows(chain) == (32.0, 160.0)
    assert covered_fraction(chain, 120, 200) == pytest.approx(0.5) and covered_fraction(chain, 170, 200) == 0.0
    # Beyond its end, along its axis.
    np.testing.assert_allclose(cut_chain(chain, 128, 192)[4:], [114, 146], atol=1e-4)


def test_the_band_is_where_the_ground_says():
    camera = Calibration(844, 676, 542.0, (421.5, 337.5), 0.1)
    ground = Ground((0.1, 2.2, 0.3))
    for height, column in ((0.2, 100.0), (0.4, 700.0)):
        row = ground.row(column, height, 0.8, camera)
        assert ground.height(column, row, 0.8, camera) == pytest.approx(height)
    top, bottom, is_on_ground = band_rows(None, camera, 0.8, 300.0)
    assert (
        not is_on_ground
        and bottom - top == pytest.approx(0.2 * 542 / 0.8)
        and top == pytest.approx(337.5 + (0.42 - 0.4048) * 542 / 0.8)
    )
    chain = Chain(chain_of(*[100.0] * 12), np.full(11, 0.9))
    stalks, scores = cut_to_band(
        [chain], (2.0, 2.0), lambda column: (99.5, 199.5, True) if column == 199.5 else (0.0, 0.0, True)
    )
    np.testing.assert_allclose(stalks, [[188, 100, 212, 200, 200, 200]])
    assert scores == pytest.approx([chain.score])
    assert not len(cut_to_band([chain], (2.0, 2.0), lambda column: (800.0, 1000.0, True))[1])
    assert len(cut_to_band([chain], (2.0, 2.0), None)[0]) == 1


def test_boxes_far_from_the_band_move_there_along_their_axes():
    inside = [88.0, 100.0, 122.0, 200.0, 100.0, 110.0]
    above = [88.0, 60.0, 122.0, 160.0, 100.0, 110.0]
    stalks = np.array([inside, above], np.float32)
    moved = move_to_band(stalks, lambda column: (99.5, 199.5, True) if column == 104.5 else (0.0, 0.0, True))
    np.testing.assert_array_equal(moved[0], inside)
    np.testing.assert_allclose(moved[1], [92, 100, 126, 200, 104, 114], atol=1e-4)
    # Where no ground is visible, the band of the usual cameras says nothing.
    np.testing.assert_array_equal(move_to_band(stalks, lambda column: (99.5, 199.5, False)), stalks)


# --- synthetic stalks, networks and weights ---


LAYOUT = family.Layout(rows_behind=1, stalks_mean=12, stalks_sd=0, tillers=0.0, plot_length=0.8)
FEW = dataclasses.replace(family.TRAINING, layout=LAYOUT, stalks=family.Stalks(diameter_mean=0.03)).at_width(211)


@pytest.fixture(scope="module")
def plot() -> Example:
    (example,) = synthetic_examples(FEW, Settings().for_sections(), 3, frames=1)
    return example


def test_rows_behind_are_background_at_night_and_ignored_by_day():
    sequence = Sequence.of(draw(FEW, 3))
    instance = np.asarray(sequence.left(0)[1])
    night = sequence.plot
    day = dataclasses.replace(night, family=dataclasses.replace(night.family, scene=Scene(share=1.0)))
    kinds = []
    for plot in (night, day):
        shape = (4 * instance.shape[0], 4 * instance.shape[1])
        edges, kind = synthetic_edges(plot, sequence.drive.poses[0], sequence.drive.true, instance, shape, (0.25, 0.25))
        assert len(edges) == len(kind) and edges.shape[1:] == (-(-shape[0] // 8), 3)
        kinds.append(set(kind.tolist()))
    assert kinds == [{STALK}, {STALK, UNCLEAR}]


def test_a_stalk_that_leans_over_the_camera_keeps_its_lower_part():
    plot = draw(FEW, 3)
    camera, pose = drive(plot.family, plot.seed).true, drive(plot.family, plot.seed).poses[0]
    stalk, rows = plot.stalks[0], np.arange(4.0, camera.height, 8.0)
    points = stalk.points.copy()
    points[:, :2] += np.linspace(0.0, 1.5, len(points))[:, None] ** 2 * (pose.position - points)[:, :2]
    upright, leaning = (_sides(each, pose, camera, rows) for each in (stalk, dataclasses.replace(stalk, points=points)))
    assert upright is not None and leaning is not None
    assert pose.to_camera(points)[:, 2].min() < 0.0 and leaning[2][-3:].any()
    foot = np.flatnonzero(upright[2])[-1]
    np.testing.assert_allclose(leaning[0][foot], upright[0][foot], atol=3.0)


def test_chains_of_true_sections_cut_to_the_band_are_the_true_boxes(plot):
    settings = Settings().for_sections()
    targets, kinds = true_targets(plot, (704, 864), settings)
    clear = kinds == STALK
    chains = link(targets[clear], np.ones(clear.sum(), np.float32), settings.section)
    boxes, missed = plot.stalks[plot.kinds == STALK], 0
    for box in boxes:
        cuts = [cut_chain(chain, box[1], box[3]) for chain in chains if covered_fraction(chain, box[1], box[3]) > 0.7]
        missed += not any(np.abs(cut - box).max() < 1.5 and np.abs(cut - box).mean() < 0.6 for cut in cuts)
    assert len(boxes) > 5 and missed <= 1


def test_weights_say_whether_they_detect_sections(tmp_path):
    key = jax.random.key(0)
    band = {
        "detector": init_detector(TINY, key),
        "segmenter": Segmenter(TINY.segmenter).init(key, np.zeros((1, 32, 32, 3), np.float32)),
    }
    params, settings = start_sections(band, TINY, 1)
    write_weights(tmp_path / "sections.safetensors", params, settings, {})
    read, stored, _ = read_weights(tmp_path / "sections.safetensors")
    assert stored == settings and stored.section == 32
    for name, layer in band["detector"]["params"].items():
        leaves = zip(jax.tree.leaves(layer), jax.tree.leaves(read["detector"]["params"][name]))
        same = all(one.shape == other.shape and np.allclose(one, other, atol=1e-2) for one, other in leaves)
        assert same == (name not in OUTPUTS)
    assert read_weights(SHIPPED)[1].section == 0  # a file from before there were sections
    write_weights(tmp_path / "odd.safetensors", params, dataclasses.replace(settings, section=24), {})
    with pytest.raises(RequestError, match="section"):
        read_weights(tmp_path / "odd.safetensors")
    every = dataclasses.replace(settings, min_score=0.0)
    found = jax.device_get(detect(params["detector"], np.zeros((64, 64, 3), np.uint8), every))
    assert found.valid.any() and set(found.stalks[found.valid][:, 1].tolist()) <= {0.0, 32.0}
    assert set((found.stalks[found.valid][:, 3] - found.stalks[found.valid][:, 1]).tolist()) == {32.0}
    finder = Finder(params, every)
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    anywhere, scores, _ = finder.detect_boxes(image, None)
    inside, _, _ = finder.detect_boxes(image, every.pixels_per_metre, lambda column: (9.5, 49.5, True))
    assert len(anywhere) == len(scores) > 0 and len(inside) > 0
    assert set(anywhere[:, 1].tolist()) <= {0.0, 32.0} and (inside[:, [1, 3]] == [10.0, 50.0]).all()
    assert anywhere[:, 0].min() < 0.0 or anywhere[:, 2].max() > 64.0
    clipped = [detection.box for detection in Finder(params, every, 0.0)(image)]
    assert clipped and all(-0.5 <= left <= right <= 63.5 for left, _, right, _ in clipped)
    known = every.pixels_per_metre, lambda column: (9.5, 49.5, True)
    _, scores, _ = finder.detect_boxes(image, *known)
    of_rows = {round(detection.score, 5) for detection in Finder(params, every, 0.0)(image, *known)}
    assert of_rows and of_rows <= set(np.round(1.0 - np.sqrt(1.0 - scores.astype(np.float64)), 5).tolist())


@pytest.mark.parametrize(
    ("threshold", "camera", "is_replaced", "is_flagged"),
    [(3.0, None, True, False), (3.0, 250.0, False, False), (1.5, 250.0, True, False), (-1.0, 250.0, True, True)],
)
def test_images_of_unknown_cameras_and_doubtful_ones_are_read_by_other_networks(threshold, camera, is_replaced, is_flagged):
    by_day, gate = load_finder(PHOTOGRAPHS, 0.95), read_gate(SHIPPED)  # of a few boxes, as each takes time
    assert gate is not None and load_finder(SHIPPED, 0.95)._substitute is by_day
    judged = dataclasses.replace(gate, threshold=threshold)
    finder = Finder(*read_weights(SHIPPED)[:2], 0.6, judged, by_day)
    image = np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8)
    detections = finder(image, camera)
    boxes, others = ([detection.box for detection in found] for found in (detections, by_day(image, camera)))
    assert boxes and others and (boxes == others) == is_replaced
    if camera is not None:
        assert (detections.doubt > detections.max_doubt) == is_flagged  # although other networks have read the image
