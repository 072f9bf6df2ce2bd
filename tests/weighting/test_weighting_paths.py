"""Descent by each weighting on two losses whose Pareto front is a line, under scan and over several starts at once."""

from pathlib import Path

import numpy as np
import pytest

import jaxrl_vis.weighting as jw
from jaxrl_vis import cli
from jaxrl_vis.studies import pareto

# Of `jw.WEIGHTINGS` those without a main loss; methods that draw end near the front, not on it.
TOLERANCES = {name: 0.02 for name in jw.WEIGHTINGS if name == "sum" or not jw.make_weighting(name).main}
TOLERANCES.pop("auxinash")  # has a main loss
TOLERANCES |= {"random": 0.05, "graddrop": 0.15}


def distance_to_front(points: np.ndarray) -> np.ndarray:
    """Compute the distance of points [..., 2] from the Pareto front: [...]."""
    beyond = np.maximum(np.abs(points[..., 0]) - 1.0, 0.0)
    return np.hypot(beyond, points[..., 1])


@pytest.mark.parametrize("name", TOLERANCES)
def test_every_path_ends_on_the_front(name: str) -> None:
    paths = pareto.descend(jw.make_weighting(name))
    assert np.isfinite(paths.points).all()
    assert distance_to_front(paths.points[:, 0]).min() > 1.0
    distances = distance_to_front(paths.points)
    # On the front, where the pseudo-inverse of IMTL-G drops an eigenvalue, its step jumps.
    reached = distances.min(axis=1) if name == "imtl_g" else distances[:, -1]
    assert reached.max() < TOLERANCES[name]


@pytest.mark.parametrize("name", ["mgda", "upgrad", "dualproj"])
def test_no_loss_rises_but_by_the_length_of_a_step(name: str) -> None:
    """Steps oppose no gradient: a loss rises by at most half its greatest curvature, 4 or 16, times the squared step."""
    paths = pareto.descend(jw.make_weighting(name))
    squared = np.square(np.diff(paths.points, axis=1)).sum(axis=-1)
    assert (np.diff(paths.losses, axis=1) <= squared[..., None] * [2.0, 8.0] + 1e-5).all()


def test_equal_lengths_of_projections_end_between_the_minima_and_sums_at_the_longer_gradients() -> None:
    """Gradients are opposed on the front: GradNorm and Nash-MTL weigh them alike there, the sum follows the longer ones."""
    ends = {name: pareto.descend(jw.make_weighting(name)).points[:, -1, 0] for name in ("sum", "mgda", "nash_mtl")}
    np.testing.assert_allclose(ends["sum"], 0.6, atol=0.02)  # of (x + 1) + 4 (x - 1)
    assert np.ptp(ends["mgda"]) > 0.5  # where each path meets the front first
    assert np.abs(ends["nash_mtl"]).max() < 1.0


def test_the_paths_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pareto, "descend", lambda _: pareto.Paths(np.zeros((5, 2, 2)), np.zeros((5, 2, 2))))
    out = tmp_path / "paths.png"
    assert cli.main(["figure", "pareto", "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
