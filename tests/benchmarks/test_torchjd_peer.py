"""The comparison of weightings with TorchJD's, without TorchJD: its Jacobians, its measures and its tables."""

import json
from pathlib import Path

import numpy as np

from benchmarks.ledger.tables import weighting
from benchmarks.peers.torchjd import equality
from benchmarks.peers.torchjd.jacobians import COUNTS, draw


def test_jacobians_have_all_ranks() -> None:
    arrays = draw(16)
    for count in COUNTS:
        jacobians, ranks = arrays[f"{count}/jacobians"], arrays[f"{count}/ranks"]
        assert set(ranks) == set(range(1, count + 1))
        np.testing.assert_array_equal(np.linalg.matrix_rank(jacobians), ranks)
        assert (np.sort(arrays[f"{count}/orders"], axis=2) == np.arange(count)).all()


def test_a_difference_beyond_what_is_allowed_is_a_failure() -> None:
    arrays = {name: value for name, value in draw(10).items() if name.startswith("2/")}
    jacobians = arrays["2/jacobians"]
    one, other = jacobians[:, 0], jacobians[:, 1]
    share = np.clip(((other - one) * other).sum(axis=1) / ((one - other) ** 2).sum(axis=1), 0.0, 1.0)
    exact = {"2/uniform": jacobians.mean(axis=1), "2/mgda": np.stack([share, 1.0 - share], axis=1)}
    rough = {"2/uniform": 1.001 * exact["2/uniform"], "2/mgda": np.full((10, 2), 0.5)}
    rows = equality.compare(arrays, exact, dict(exact))
    assert [row["difference_max"] for row in rows] == [0.0, 0.0] and equality.failures(rows) == []
    assert rows[1]["residual_max_ours"] < 1e-12
    rows = equality.compare(arrays, exact, rough)
    np.testing.assert_allclose(rows[0]["difference_max"], 1e-3 / 1.001, rtol=1e-6)
    assert rows[1]["residual_max_theirs"] > 0.01 and equality.failures(rows) == ["uniform"]
    assert equality.failures(equality.compare(arrays, rough, exact)) == ["uniform", "mgda"]


def test_tables_are_written_from_records(tmp_path: Path) -> None:
    assert weighting.torchjd_table(tmp_path) is None and weighting.cost_table(tmp_path) is None
    row = {"method": "mgda", "cases": 7, "difference_max": 0.25, "difference_median": 1e-9}
    row |= {"residual_max_ours": 1e-15, "residual_max_theirs": 2e-3}
    versions = {"torchjd": "0.18.0", "torch": "2", "jax": "0.10"}
    (tmp_path / "weighting_parity.json").write_text(json.dumps({"rows": [row], "versions": versions}))
    assert "| `mgda` | 7 | 2e-01 | 1e-09 | 1e-15 | 2e-03 |" in (weighting.torchjd_table(tmp_path) or "")
    ours = [
        {"method": "mgda", "losses": 2, "what": what, "seconds": time}
        for what, time in (("alone", 1e-5), ("step, latents", 4e-4))
    ]
    theirs = [
        {"method": "mgda", "losses": 2, "what": what, "seconds": time} for what, time in (("alone", 2e-3), ("step", 5e-3))
    ]
    record = {"device": "a GPU", "size": {"losses": [2]}, "revisions": {"2": "0123456789"}, "ours": ours, "torchjd": theirs}
    (tmp_path / "weighting_cost-nvidia-h100.json").write_text(json.dumps(record))
    table = weighting.cost_table(tmp_path) or ""
    assert "| `mgda` | 400 / 5,000 | 10 / 2,000 |" in table and "K = 2 on 0123456:" in table
