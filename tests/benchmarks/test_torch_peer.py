"""The part of the PyTorch peer that runs without PyTorch, which the tests do not have."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_bench import Dot

from benchmarks.peers import command
from benchmarks.peers.torch import __main__ as torch_peer
from benchmarks.peers.torch import comparison
from jaxrl_vis.bench import Settings, update
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.train_step import TrainStep, make_train_step


@pytest.fixture(scope="module")
def program() -> TrainStep:
    return make_train_step(Dot(), preset("debug"))


@pytest.fixture(scope="module")
def reference(program: TrainStep) -> comparison.Reference:
    """Reference results of our steps, from a fresh learner and a replay of noise."""
    loop = jax.tree.map(lambda leaf: leaf[0], update.init_with_full_replay(program).replace(iteration=jnp.zeros(1, jnp.int32)))
    return comparison.reference(program, loop.train, loop.replay)


def test_a_missing_pytorch_is_said_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "benchmarks.peers.torch.learner", None)  # where it is installed, too
    assert command.run("update", torch_peer.measure, None, ("env",), ["--results", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "the peer torch needs PyTorch" in line and "pip install torch" in line
    with pytest.raises(RequestError, match="pip install torch"):
        next(torch_peer.measure(Settings(env="Reacher")))


def test_states_and_other_rewards_have_no_peer(program: TrainStep) -> None:
    comparison.check_config(program)
    with pytest.raises(RequestError, match="method oracle"):
        comparison.check_config(make_train_step(Dot(), preset("debug", method="indicator")))


def test_the_reference_tells_networks_and_statistics_apart(program: TrainStep, reference: comparison.Reference) -> None:
    for network in ("actor", "critic"):
        online, target = reference.parameters[network], reference.parameters[f"target_{network}"]
        assert online.keys() == target.keys() == reference.gradients[network].keys()
        assert not np.array_equal(online["encoder/kernel_0"], target["encoder/kernel_0"])
        gradient = reference.gradients[network][comparison.COMPARED_LAYER[network]]
        assert np.linalg.norm(gradient) > 0.0
    (mean, scale), _ = reference.statistics
    assert mean.std() > 1.0 and 0.001 < scale.mean() < 0.1
    assert reference.losses.shape == (comparison.STEPS, 2) and np.isfinite(reference.losses).all()
    episode, time, slot = reference.choices.transpose(1, 0, 2)
    horizon = program.env.horizon
    assert 0 <= episode.min() <= episode.max() < program.replay.num_episodes
    assert 0 <= time.min() <= time.max() < horizon and (slot > time).all() and slot.max() <= horizon + 1


def test_only_what_agrees_is_timed(reference: comparison.Reference) -> None:
    ours = {network: reference.gradients[network][name] for network, name in comparison.COMPARED_LAYER.items()}
    found = comparison.compare(reference, reference.losses, ours)
    assert found == {"loss_difference": 0.0, "critic_gradient_difference": 0.0, "actor_gradient_difference": 0.0}
    assert comparison.compare(reference, reference.losses * (1 + 1e-4), ours)["loss_difference"] == pytest.approx(1e-4, rel=0.1)
    for losses, gradients in (
        (reference.losses * 1.01, ours),
        (reference.losses * np.nan, ours),
        (reference.losses, {**ours, "actor": -ours["actor"]}),
        (reference.losses[:, ::-1], ours),
    ):
        with pytest.raises(AssertionError, match="PyTorch does not compute what we do"):
            comparison.compare(reference, losses, gradients)
