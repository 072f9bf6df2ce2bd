"""Audit of rewards: its measures in known cases, and whole audits of correct, wrong and unusable rewards."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import point_mass
import probe_environments as probes
import pytest
from matplotlib.figure import Figure
from scipy import stats

from benchmarks.ledger.tables import audit as published
from jaxrl_vis import cli
from jaxrl_vis.config import preset
from jaxrl_vis.run.storage.folder import RunFolder
from jaxrl_vis.studies.audit import measures, report
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.pixels import PixelsConfig

OWN = """
import jax.numpy as jnp

def always(images, goals):
    return jnp.ones(len(images))

def too_large(images, goals):
    return jnp.full(len(images), 2.0)

def two_numbers(images, goals):
    return jnp.ones((len(images), 2))

def broken(images):
    return 1.0

def one_for_all(images, goals):
    return (images == goals).mean()

def two_results(images, goals):
    return always(images, goals), 1.0

def not_traceable(images, goals):
    return jnp.ones(len(images)) if (images == goals).all() else jnp.zeros(len(images))
"""


def test_rank_correlation_is_that_of_scipy_with_and_without_ties() -> None:
    draw = np.random.default_rng(0)
    for levels in (3, 10_000):
        one, other = draw.integers(0, levels, (2, 60)).astype(float)
        expected = stats.spearmanr(one, other).statistic
        assert measures.rank_correlation(one, other) == pytest.approx(expected, abs=1e-12)
    assert measures.rank_correlation(np.ones(5), np.arange(5)) == 0.0
    assert measures.rank_correlation(np.arange(5), np.exp(np.arange(5))) == pytest.approx(1.0)


def test_shares_of_false_rewards() -> None:
    reward, is_reached = np.array([1.0, 1.0, 0.2, 0.5, 0.0]), np.array([True, False, True, False, False])
    assert measures.error_shares(reward, is_reached) == (pytest.approx(2 / 3), 0.5)
    assert np.isnan(measures.error_shares(reward, np.ones(5, bool))[0])


def test_a_probability_is_calibrated_and_its_square_is_not() -> None:
    draw = np.random.default_rng(0)
    probability = draw.random(200_000)
    is_reached = draw.random(200_000) < probability
    assert measures.calibration_error(probability, is_reached) < 0.01
    assert measures.calibration_error(probability**2, is_reached) == pytest.approx(1 / 6, abs=0.01)  # mean of p - p^2


def test_few_pairs_that_reach_have_bins_of_their_own_in_the_figure() -> None:
    distance, axes = np.array([0.0, 0.05, *np.linspace(0.2, 0.9, 300)]), Figure().subplots()
    reward = np.where(distance <= 0.1, 1.0 - distance, 0.0)
    report._draw_distances(axes, distance, reward, threshold=0.1, unit="m")
    _, line = axes.lines
    places, means = line.get_data()
    assert list(zip(places[:2], means[:2], strict=True)) == [(0.0, 1.0), (0.05, 0.95)]
    assert len(means) == 17 and not np.any(means[2:])


@pytest.fixture
def point(here: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (here / "own.py").write_text(OWN)
    monkeypatch.setitem(registry._ENTRIES, "VisualTold", registry._Entry(lambda _: probes.SeenGoWhereTold(), PixelsConfig))
    with point_mass.registered():
        yield here


FEW = ["--episodes", "8", "--goals", "4", "--sequences", "8"]
SMALL = ["audit", "VisualPoint", "--image-size", "16", *FEW]


def test_an_audit_tells_what_rewards_are_worth(point: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rewards = ["--rewards", "indicator", "indicator_tolerance", "own:always", "--out", "a.png", "--json", "a.json"]
    assert cli.main([*SMALL, *rewards, "--tolerance", "20", "--tolerance-share", "0.95"]) == 0
    record = json.loads(Path("a.json").read_text())
    exact, tolerant, always = record["rewards"].values()
    assert record["pairs"] == 8 * 5 * 3 and record["audit"]["tolerance"] == 20.0
    assert exact["false_positive"] == 0.0 < exact["false_negative"]
    assert tolerant["false_negative"] < exact["false_negative"]
    assert (always["false_positive"], always["false_negative"], always["order_distance"]) == (1.0, 0.0, 0.0)
    assert always["exploited"] == 1.0 - always["solved"] > 0.0 == exact["exploited"]
    assert exact["order_time"] > 0.5  # the last image is the goal
    assert {row["solvable"] for row in record["rewards"].values()} == {exact["solvable"]}
    assert Path("a.png").stat().st_size > 5000
    head, line, *printed = capsys.readouterr().out.splitlines()
    assert [cell.strip() for cell in head.split("|")[1:-1]] == ["reward", *report.COLUMNS.values()]
    assert {len(row) for row in (line, *printed[:3])} == {len(head)} and printed[3] == ""
    assert printed[4].startswith(f"120 pairs of an image and a goal, of which {record['reached_pairs']} truly reach it")
    own_goals = 8  # each episode's last image is its own goal
    assert own_goals <= record["reached_pairs"] < 120
    assert f"| `indicator` | 0.000 | {exact['false_negative']:.3f} |" in published.rows([record])


def test_noise_breaks_equality(point: Path) -> None:
    assert (
        cli.main(
            ["audit", "VisualTold", *FEW, "--noise", "2", "--json", "a.json", "--tolerance", "12", "--tolerance-share", "0.9"]
        )
        == 0
    )
    exact, tolerant = json.loads(Path("a.json").read_text())["rewards"].values()
    assert exact["false_negative"] == 1.0 and tolerant["false_negative"] < 0.5


def test_a_model_that_a_run_has_trained_along_is_audited(point: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train = ["train", "VisualTold", "--preset", "debug", "--num-envs", "2", "--env-steps", "16", "--method", "classifier"]
    assert cli.main([*train, "--run-dir", "model"]) == 0
    Path("other").mkdir()  # of which the configuration suffices
    RunFolder(Path("other")).open(preset("debug", env="VisualPoint", image_size=16, method="indicator"), False, False, ())
    assert cli.main(["audit", "VisualTold", *FEW, "--rewards", "model", "--json", "a.json"]) == 0
    (record,) = json.loads(Path("a.json").read_text())["rewards"].values()
    assert all(0.0 <= record[name] <= 1.0 for name in ("false_positive", "false_negative", "calibration_error"))
    capsys.readouterr()
    for words, message in (
        (["--rewards", "other"], "the run in other has no model of rewards: train with --method autoencoder or classifier"),
        (["--rewards", "model", "--pixels", "rgb"], "sees images of (1, 8, 8), and these are of (3, 16, 16): give --pixels"),
    ):
        assert cli.main([*SMALL, *words]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--rewards", "own:too_large"], "reward own:too_large lies between 2 and 2: it must lie between 0 and 1"),
        (["--rewards", "own:none"], "own has no none"),
        (
            ["--rewards", "indicater"],
            "unknown reward 'indicater'; did you mean indicator or indicator_tolerance? (run",
        ),
        (["--rewards", "features"], "method features needs an encoder"),
        (["--episodes", "1"], "other episodes' goals need at least 2"),
        (["--noise", "-1"], "noise -1.0 must not be negative"),
    ],
)
def test_mistakes_get_one_line(point: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        ("two_numbers", "returns (512, 2) for 512 images: it must return (512,), one number for each"),
        ("one_for_all", "returns () for 512 images"),
        ("two_results", "returns (512,), () for 512 images"),
        ("broken", "cannot be computed: TypeError"),
        ("not_traceable", "cannot be computed: TracerBoolConversionError"),
    ],
)
def test_a_reward_that_cannot_be_used_is_refused_before_any_episode(
    point: Path, reward: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delattr(report, "play")
    assert cli.main([*SMALL, "--rewards", "indicator", f"own:{reward}"]) == 2
    line = capsys.readouterr().err
    assert f"reward own:{reward} {message}" in line
    assert line.count("\n") == 1 and len(line) < 600
