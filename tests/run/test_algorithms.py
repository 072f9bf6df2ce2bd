"""Every built-in algorithm by the command line: trained, resumed, evaluated, played, and its policy loaded."""

from pathlib import Path

import numpy as np
import probe_environments as probes
import pytest
import small_program
from fake_program import rows_without_time

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.learner.train_step import ALGORITHMS
from jaxrl_vis.run import trainer
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.pixels import PixelsConfig

TRAIN = ["train", "VisualTold", "--preset", "debug", "--num-envs", "2", "--env-steps", "32"]
TRAIN += ["--full-checkpoint-interval", "2", "--checkpoint-interval", "2", "--seeds", "2"]


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    task = registry._Entry(lambda _: probes.SeenGoWhereTold(), PixelsConfig)
    monkeypatch.setitem(registry._ENTRIES, "VisualTold", task)
    monkeypatch.setattr(trainer, "make_train_step", small_program.make_train_step)  # the three runs share their programs


@pytest.mark.parametrize("algorithm", [name for name in ALGORITHMS if name != "ddpg"])
def test_an_algorithm_resumes_exactly_and_is_played(algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    train = [*TRAIN, "--algorithm", algorithm]
    assert cli.main([*train, "--run-dir", "straight"]) == 0
    assert cli.main([*train, "--env-steps", "16", "--run-dir", "cut"]) == 0
    assert cli.main(["train", "--resume", "--env-steps", "32", "--run-dir", "cut"]) == 0
    rows = rows_without_time(tmp_path / "straight")
    assert rows == rows_without_time(tmp_path / "cut") and len(rows) == 4
    assert cli.main(["eval", "cut", "--episodes", "4"]) == 0
    assert cli.main(["play", "cut", "--out", "played.gif", "--episodes", "1"]) == 0
    assert Path("played.gif").stat().st_size > 500
    policy = jaxrl_vis.load_policy("cut", seed=1)
    image = np.zeros(policy.observation_spec.shape, np.uint8)
    assert np.abs(policy(image, image)).max() <= 1.0
