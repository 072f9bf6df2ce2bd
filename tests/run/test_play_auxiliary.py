"""`play --aux`: drawings of what auxiliary tasks predict."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import probe_environments as probes
import pytest
from PIL import Image

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.learner.auxtasks import NAMES
from jaxrl_vis.report import auxiliary_video, videos
from jaxrl_vis.run.storage.checkpoint import Checkpoints
from jaxrl_vis.run.storage.folder import read_run_id
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.pixels import PixelsConfig

SETTINGS = {"num_envs": 2, "hidden_sizes": (8,), "replay_transitions": 40, "batch_size": 4, "eval_episodes": 2, "env_steps": 8}
SETTINGS |= {"encoder_filters": (4, 4), "latent_size": 8, "checkpoint_interval": 1, "updates_per_iteration": 1}


class Dots(probes.GoWhereTold):
    """Probe observed as a depth image [1, 18, 16] whose brightness is the position; an encoder of two layers sees 16 rows."""

    def __init__(self, _: Any = None) -> None:
        self.pattern = jnp.asarray(np.random.default_rng(0).uniform(0, 100, (1, 18, 16)), jnp.float32)

    def see(self, position):
        return (self.pattern * (1.0 + position[0])).astype(jnp.uint8)


@pytest.fixture(scope="module", autouse=True)
def dots():
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setitem(registry._ENTRIES, "VisualDots", registry._Entry(Dots, PixelsConfig))
        yield


def save_fresh_learner(folder: Path, **changes: Any) -> Path:
    """Write a run folder with a checkpoint of a fresh learner, because gradient steps would take longest to compile."""
    config = jaxrl_vis.preset("debug", env="VisualDots", **{**SETTINGS, **changes})
    trainer = jaxrl_vis.make_trainer(config, folder)
    trainer.folder.open(config)
    checkpoints = Checkpoints(trainer.folder.checkpoints, run_id=read_run_id(folder))
    checkpoints.save_light(1, trainer.init(jax.random.key(0)).train, {})
    checkpoints.close()
    return folder


def test_a_run_shows_what_it_predicts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = save_fresh_learner(tmp_path / "run", aux_tasks=NAMES, weighting="balance", seeds=2)
    capsys.readouterr()
    drawn: list[auxiliary_video.Predictions] = []
    draw = auxiliary_video.draw_frames

    def watch(episodes: videos.EpisodeImages, predictions: auxiliary_video.Predictions, seconds: float):
        drawn.append(predictions)
        return draw(episodes, predictions, seconds)

    monkeypatch.setattr(auxiliary_video, "draw_frames", watch)
    assert cli.main(["play", str(run), "--aux", "--episodes", "3"]) == 0
    out = run / "play_aux.gif"
    assert capsys.readouterr().out.strip() == str(out)
    (predictions,) = drawn
    horizon = Dots().horizon
    assert predictions.reconstruction.shape == (3, horizon, 1, 16, 16) and predictions.reconstruction.dtype == np.uint8
    assert predictions.flow.shape == (3, horizon, 18, 16) and predictions.flow_predicted.shape == (3, horizon, 16, 16)
    assert predictions.rotated.shape == (3, horizon, 1, 18, 16) and predictions.rotated.dtype == np.uint8
    assert predictions.angle.shape == predictions.angle_predicted.shape == (3, horizon)
    assert 5 < np.abs(predictions.angle).max() <= 30 and (predictions.flow >= 0).all()
    # Every episode, and every step, has rotations of its own.
    assert len(np.unique(predictions.angle)) == predictions.angle.size
    image: Any = Image.open(out)
    assert image.n_frames == 3 * horizon and image.width > 6 * 192


@pytest.mark.parametrize(
    ("changes", "words", "parts"),
    [
        ({}, ["--aux"], ["no auxiliary tasks to show", "--aux-tasks", "leave out --aux"]),
        ({"aux_tasks": ("inverse_dynamics",), "weighting": "sum"}, ["--aux"], ["inverse_dynamics", "autoencoder"]),
        ({"aux_tasks": ("autoencoder",), "weighting": "sum"}, ["--aux", "--html"], ["--html", "give one"]),
        ({"aux_tasks": ("autoencoder",), "weighting": "sum"}, ["--aux", "--out", "x.png"], ["x.gif", "x.png"]),
        ({"aux_tasks": ("autoencoder",), "weighting": "sum"}, ["--aux", "--out", "x.avi"], ["x.avi", ".gif"]),
        ({"aux_tasks": ("autoencoder",), "weighting": "sum"}, ["--aux"], ["no usable checkpoint"]),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(
    changes: dict, words: list[str], parts: list[str], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The configuration suffices: nothing was trained here, and nothing is compiled."""
    folder = here / "run"
    config = jaxrl_vis.preset("debug", env="VisualDots", **{**SETTINGS, **changes})
    jaxrl_vis.make_trainer(config, folder).folder.open(config)
    assert cli.main(["play", str(folder), *words]) == 2
    output = capsys.readouterr()
    assert output.out == "" and len(output.err.splitlines()) == 1
    for part in parts:
        assert part in output.err
    assert [path.name for path in folder.iterdir() if path.suffix in (".gif", ".png")] == []


def make_predictions(channels: int, steps: int = 2, size: int = 16) -> tuple[videos.EpisodeImages, auxiliary_video.Predictions]:
    greys = np.random.default_rng(0).integers(0, 255, (1, steps + 1, channels, size, size), np.uint8)
    flow = np.linspace(0, 3, steps * size * size, dtype=np.float32).reshape(1, steps, size, size)
    angle = np.array([[12.0, -7.0]])
    predictions = auxiliary_video.Predictions(greys[:, :-1], flow, flow[..., :-2, :-2], greys[:, :-1], angle, -angle)
    return videos.EpisodeImages(greys, greys[:, -1], np.array([True])), predictions


@pytest.mark.parametrize(("channels", "columns", "rows"), [(1, 6, 1), (3, 6, 1), (4, 5, 2)])
def test_tiles_stand_side_by_side(channels: int, columns: int, rows: int) -> None:
    """Flow and predicted flow share a column if colour and depth are above each other."""
    episodes, predictions = make_predictions(channels)
    images, seconds = auxiliary_video.draw_frames(episodes, predictions, 0.05)
    assert len(images) == 2 and seconds == [0.05, videos.HOLD]
    tile = 192 + 2 * videos.BORDER
    assert images[0].width == columns * (tile + videos.GAP) + videos.GAP
    assert images[0].height == rows * (tile + 22) + videos.FOOTER
    # The border of the observation says how the episode ended.
    corner = (videos.GAP + 1, 23)
    assert images[0].getpixel(corner) == videos.PLAIN and images[1].getpixel(corner) == videos.REACHED


def test_what_has_no_task_has_no_tile() -> None:
    episodes, predictions = make_predictions(4)
    only = dataclasses.replace(predictions, reconstruction=None, flow=None, flow_predicted=None)
    (first, _), _ = auxiliary_video.draw_frames(episodes, only, 0.05)
    assert first.width == 3 * (192 + 2 * videos.BORDER + videos.GAP) + videos.GAP
    grey = auxiliary_video.Predictions(reconstruction=predictions.reconstruction[:, :, :1])
    (first, _), _ = auxiliary_video.draw_frames(episodes, grey, 0.05)
    pixels = np.asarray(first)[40:200, 455:640]
    assert (pixels[..., 0] == pixels[..., 1]).all() and (pixels[..., 0] == pixels[..., 2]).all()
