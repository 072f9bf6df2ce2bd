"""Tests of the gate: the images that it flags, its file, and the flag of a plot."""

import numpy as np
import pytest

from benchmarks.stalks.gate_fit import fit_gate, write_gate
from jaxrl_vis.stalks.phenotyping.detector.gate import gate_path, read_gate
from jaxrl_vis.stalks.phenotyping.pipeline import _unfamiliar_note

SURE, UNSURE = np.array([0.97, 0.95, 0.02]), np.array([0.6, 0.45, 0.3])


@pytest.fixture(scope="module")
def images() -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Return features [260, 16], scores, and True for misread images: 200 read correctly, 30 novel and 30 uncertain ones."""
    rng = np.random.default_rng(0)
    basis = rng.normal(size=(3, 16))
    right = rng.normal(size=(200, 3)) @ basis + 0.1 * rng.normal(size=(200, 16))
    elsewhere = right[:30] + 2.0 * rng.normal(size=(30, 16))
    alike = rng.normal(size=(30, 3)) @ basis + 0.1 * rng.normal(size=(30, 16))
    wrong = np.repeat([False, True], [200, 60])
    return np.concatenate([right, elsewhere, alike]), [SURE] * 230 + [UNSURE] * 30, wrong


@pytest.fixture(scope="module")
def gate(images):
    pooled, scores, wrong = images
    return fit_gate(pooled, scores, wrong, np.arange(260), axes=3, max_flagged=0.05)


def test_a_gate_flags_what_lies_elsewhere_and_what_is_unsure(images, gate):
    pooled, scores, wrong = images
    doubts = np.array([gate.doubt(*each) for each in zip(pooled, scores)])
    flagged = doubts > gate.threshold
    assert flagged[~wrong].mean() <= 0.05
    assert flagged[200:230].mean() > 0.9 and flagged[230:].mean() > 0.9
    rng = np.random.default_rng(7)
    fresh = np.array([gate.doubt(row, SURE) for row in pooled[:100] + 0.02 * rng.normal(size=(100, 16))])
    assert (fresh > gate.threshold).mean() < 0.15
    assert 0.0 <= doubts.min() and doubts.max() <= 1.0


def test_a_gate_needs_images_of_both_kinds(images):
    pooled, scores, wrong = images
    with pytest.raises(ValueError, match="needs 9 images that are read rightly, and one that is not"):
        fit_gate(pooled[:200], scores[:200], wrong[:200], np.arange(200), axes=3, max_flagged=0.05)


def test_a_gate_is_for_its_weights_alone(gate, images, tmp_path):
    weights = tmp_path / "some.safetensors"
    weights.write_bytes(b"some weights")
    assert read_gate(weights) is None
    write_gate(weights, gate, {"origin": "a test"})
    read = read_gate(weights)
    assert read is not None and read.threshold == pytest.approx(gate.threshold)
    assert read.doubt(images[0][0], SURE) == pytest.approx(gate.doubt(images[0][0], SURE), rel=1e-3)
    assert gate_path(weights).stat().st_size < 30_000
    weights.write_bytes(b"other weights")
    assert read_gate(weights) is None


def test_a_plot_is_flagged_where_most_of_its_pairs_are():
    def note(*doubts: float | None, max_doubt: float | None = 0.5) -> str:
        return _unfamiliar_note([{"doubt": doubt, "max_doubt": max_doubt} for doubt in doubts])

    told = note(0.9, 0.7, 0.1)
    assert told.startswith("2 of 3 pairs are unlike") and "0.70, the limit 0.50" in told
    assert not note(0.9, 0.1)
    assert not _unfamiliar_note([{}])
    assert not note(None, None, max_doubt=None)
