"""Fixtures of the tests of runs and of trained policies."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

_DRAWN: dict[Any, bytes] = {}


def _drawn(key: Any, path: Path, draw: Callable[[], Any]) -> None:
    if key in _DRAWN:
        path.write_bytes(_DRAWN[key])
    else:
        draw()
        _DRAWN[key] = path.read_bytes()


@pytest.fixture(scope="module", autouse=True)
def equal_runs_are_drawn_once() -> Iterator[None]:
    """Most runs in this folder are equal; to draw the curve and the video takes half the time of such a run."""
    from jaxrl_vis.report import plots, videos

    plot_run, write_video = plots.plot_run, videos.write_video

    def plot_run_once(rows: Sequence[Mapping[str, Any]], path: Path, **texts: Any) -> bool:
        names = ("env_steps", "seed", "eval/success", "eval/goal_distance")
        shown = repr(([[row.get(name) for name in names] for row in rows], texts))
        if rows:
            _drawn((shown, path.suffix), path, lambda: plot_run(rows, path, **texts))
        return bool(rows)

    def write_video_once(episodes: videos.EpisodeImages, path: Path, *options: Any, **named: Any) -> None:
        shown = [(part.shape, part.dtype.str, hashlib.sha256(part.tobytes()).digest()) for part in vars(episodes).values()]
        _drawn((repr((shown, options, named)), path.suffix), path, lambda: write_video(episodes, path, *options, **named))

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(plots, "plot_run", plot_run_once)
        monkeypatch.setattr(videos, "write_video", write_video_once)
        yield


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Trained runs, which tests leave as they are: two seeds on images, one seed on states."""
    from test_policy import SETTINGS, register

    import jaxrl_vis

    folder = tmp_path_factory.mktemp("policies")
    with pytest.MonkeyPatch.context() as monkeypatch:
        register(monkeypatch)
        for name, seeds in (("VisualTold", {"seed": 3, "seeds": 2}), ("Told", {})):
            # With a shared encoder, the actor alone is not all of a policy.
            config = jaxrl_vis.preset("debug", env=name, encoders="shared", **SETTINGS, **seeds)
            assert len(list(jaxrl_vis.make_trainer(config, folder / name).run())) == 3
    return {path.name: path for path in folder.iterdir()}
