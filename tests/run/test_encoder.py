"""`jaxrl-vis encoder`: training of an encoder, and its use for rewards."""

import re
from pathlib import Path

import jax
import numpy as np
import point_mass
import pytest

from jaxrl_vis import cli
from jaxrl_vis.learner.networks import frozen_encoder
from jaxrl_vis_envs import registry


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name, task in (("VisualPoint", point_mass.PointMass), ("Point", point_mass.StatePointMass)):
        monkeypatch.setitem(registry._ENTRIES, name, registry._Entry(task, point_mass.PointMassConfig))
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_an_encoder_is_trained_and_makes_rewards(capsys: pytest.CaptureFixture[str]) -> None:
    train = ["encoder", "VisualPoint", "--image-size", "16", "--episodes", "16", "--latent-size", "8"]
    assert cli.main([*train, "--updates", "60", "--out", "e.npz"]) == 0
    first, last = map(float, re.findall(r"error ([\d.]+) at first, ([\d.]+)", capsys.readouterr().out)[0])
    assert last < 0.6 * first
    encode = frozen_encoder.load("e.npz")
    vectors = encode(jax.random.bits(jax.random.key(0), (3, 4, 16, 16), np.uint8))
    assert vectors.shape == (3, 8) and np.isfinite(vectors).all()
    # Shapes of test_audit, whose programs are found again.
    audit = ["audit", "VisualPoint", "--image-size", "16", "--episodes", "8", "--goals", "4", "--sequences", "8"]
    assert cli.main([*audit, "--rewards", "features", "--reward-encoder", "e.npz"]) == 0
    name, *numbers = [cell.strip() for cell in capsys.readouterr().out.splitlines()[2].strip("|").split("|")]
    assert name == "features" and float(numbers[3]) > 0.2  # images near the last one are more like it


def test_mistakes_get_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["encoder", "Point", "--out", "e.npz"]) == 2
    assert "shows states: name its Visual variant" in capsys.readouterr().err
    assert cli.main(["encoder", "VisualPoint", "--out", "e.txt"]) == 2
    assert "ends in .npz" in capsys.readouterr().err
