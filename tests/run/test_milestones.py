"""Best checkpoint, early stopping and callbacks, which are the same in resumed as in uninterrupted runs."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_program import FakeProgram, as_plain, rows_without_time, small_config

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.config import Config, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run import trainer
from jaxrl_vis.run.storage import scores
from jaxrl_vis.run.storage.checkpoint import BEST, LIGHT, Checkpoints
from jaxrl_vis.run.storage.folder import read_config, read_record, read_run_id
from jaxrl_vis.run.trained import restored_run
from jaxrl_vis.run.trainer import Trainer
from jaxrl_vis.run.verifying.verification import Verification, verify
from jaxrl_vis.studies.engine.cells import Cell, is_finished

PEAK = 4  # iteration after which evaluations become worse


class Peak(FakeProgram):
    """Program whose success rises up to an iteration, and falls after it."""

    def __init__(self, config: Config):
        super().__init__(config)
        evaluate = self.evaluate

        def peaked(train: Any, key: jax.Array) -> Any:
            success = 0.9 - 0.1 * jnp.abs(train.agent["updates"] / 3.0 - PEAK)
            return evaluate(train, key)._replace(metrics={"eval/success": success, "eval/goal_distance": success})

        self.evaluate = jax.jit(peaked)


@pytest.fixture(scope="module")
def make() -> Callable[..., Trainer]:
    """Function that makes trainers of this program, which is compiled once."""
    first = Trainer(small_config(), Peak(small_config()))
    first.compile()

    def function(path: Path | None, resume: bool = False, overwrite: bool = False, **changes: Any) -> Trainer:
        config = small_config(**({"best_by": "success"} | changes))
        made = Trainer(config, Peak(config), path, resume=resume, overwrite=overwrite)
        made.programs._compiled = first.programs._compiled
        return made

    return function


@pytest.fixture(scope="module")
def straight(make: Callable[..., Trainer], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of eight iterations, without interruption."""
    path = tmp_path_factory.mktemp("runs") / "run"
    list(make(path).run())
    return path


def best(path: Path) -> list[int]:
    return Checkpoints(path / "checkpoints", read_only=True, run_id=read_run_id(path)).iterations(BEST)


def state(made: Trainer, path: Path, checkpoint: Any) -> list[np.ndarray]:
    return as_plain(restored_run.load(made, path, checkpoint).train)


def test_the_best_is_kept_beside_the_newest(straight: Path, make: Callable[..., Trainer]) -> None:
    made = make(None)
    success = {row["iteration"]: row["eval/success"] for row in rows_without_time(straight)}
    assert max(success, key=lambda iteration: success[iteration]) == PEAK and list(success) == [2, 4, 6, 8]
    assert best(straight) == [PEAK] and restored_run.load(made, straight).iteration == 8
    assert restored_run.load(made, straight, "best").iteration == PEAK
    loop = made.init(made.run_keys)
    for _ in range(PEAK):
        loop, _ = made.train_iteration(loop)
    assert all(map(np.array_equal, state(made, straight, "best"), as_plain(loop.train)))


def test_lower_distances_are_better(make: Callable[..., Trainer], tmp_path: Path) -> None:
    list(make(tmp_path / "run", best_by="goal_distance").run())  # which is as the success here
    assert best(tmp_path / "run") == [8]


@pytest.mark.parametrize("cut", [2, 6])
def test_a_resumed_run_keeps_the_same_best(cut: int, straight: Path, make: Callable[..., Trainer], tmp_path: Path) -> None:
    path, made = tmp_path / "run", make(None)
    list(make(path, env_steps=10 * cut).run())
    assert best(path) == [min(cut, PEAK)]
    list(make(path, resume=True).run())
    assert best(path) == [PEAK] and rows_without_time(path) == rows_without_time(straight)
    assert all(map(np.array_equal, state(made, path, "best"), state(made, straight, "best")))


def test_a_run_that_goes_back_meets_its_best_again(straight: Path, make: Callable[..., Trainer], tmp_path: Path) -> None:
    """The run is abandoned after the best evaluation, and resumed from before it."""
    path = tmp_path / "run"
    options = {"full_checkpoint_interval": 3, "checkpoint_interval": 3}
    for report in make(path, **options).run():
        if report.iteration == 5:
            break
    assert best(path) == [PEAK]
    list(make(path, resume=True, **options).run())
    assert best(path) == [PEAK] and rows_without_time(path) == rows_without_time(straight)


def test_another_metric_begins_anew_and_overwriting_deletes(make: Callable[..., Trainer], tmp_path: Path) -> None:
    path = tmp_path / "run"
    list(make(path, env_steps=60).run())
    list(make(path, resume=True, best_by="goal_distance").run())
    assert best(path) == [8]
    manifest = json.loads((path / "checkpoints" / BEST / "8" / "manifest" / "metadata").read_text())
    assert manifest["progress"]["scored"] == "goal_distance" and manifest["progress"]["score"] == pytest.approx(0.5)
    list(make(path, overwrite=True, best_by=None, env_steps=20).run())
    assert best(path) == [] and not (path / "checkpoints" / BEST).exists()


def test_a_damaged_best_is_reported_and_replaced(
    straight: Path, make: Callable[..., Trainer], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, made = tmp_path / "run", make(None)
    list(make(path, env_steps=40).run())
    (path / "checkpoints" / BEST / "4" / "manifest" / "metadata").write_text("{")
    with pytest.raises(RequestError, match="checkpoint best/4 is damaged"):
        restored_run.load(made, path, "best")
    list(make(path, resume=True).run())
    assert "checkpoint best/4 is damaged" in capsys.readouterr().out
    assert restored_run.load(made, path, "best").iteration == 6


def test_a_run_without_a_best_says_how_to_keep_one(make: Callable[..., Trainer], tmp_path: Path) -> None:
    path = tmp_path / "run"
    list(make(path, best_by=None, env_steps=20).run())
    assert not (path / "checkpoints" / BEST).exists()
    with pytest.raises(RequestError, match="has kept no best checkpoint: train with --best-by"):
        restored_run.load(make(None), path, "best")


def test_verify_reads_and_repeats_the_best(straight: Path, make: Callable[..., Trainer], tmp_path: Path) -> None:
    report = verify(make(None), straight, read_record(straight), None, Verification(), print)
    assert not report.problems and f"best/{PEAK}" in report.checkpoints
    assert not [note for note in report.notes if "not files of a run" in note]
    file = next((straight / "checkpoints" / BEST / str(PEAK)).rglob("d/*"))
    whole = file.read_bytes()
    try:
        file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        report = verify(make(None), straight, read_record(straight), None, Verification(), print)
        assert any(f"best/{PEAK}" in problem for problem in report.problems)
    finally:
        file.write_bytes(whole)


# -- The early end


def test_a_run_stops_at_a_level(
    straight: Path, make: Callable[..., Trainer], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run"
    reports = list(make(path, stop_at=0.85, best_by=None).run())
    assert [report.iteration for report in reports] == [1, 2, 3, PEAK]
    assert rows_without_time(path) == [row for row in rows_without_time(straight) if row["iteration"] <= PEAK]
    assert (path / "video.gif").exists() and (path / "checkpoints" / LIGHT / str(PEAK)).exists()
    assert f"stopped at iteration {PEAK} of 8: success 0.900 has reached --stop-at 0.85" in capsys.readouterr().out
    config = small_config(stop_at=0.85)
    path.rename(tmp_path / Cell("run", config).name)
    path = tmp_path / Cell("run", config).name
    assert is_finished(Cell("run", config), tmp_path) and not is_finished(Cell("run", small_config()), tmp_path)
    assert list(make(path, resume=True, stop_at=0.85, best_by=None).run()) == []
    assert "is finished already (4 of 8 iterations, --stop-at 0.85 is reached): ask for another" in capsys.readouterr().out
    more = list(make(path, resume=True, best_by=None).run())
    assert [report.iteration for report in more] == [5, 6, 7, 8] and rows_without_time(path) == rows_without_time(straight)


def test_a_run_killed_at_its_early_end_ends_there(straight: Path, make: Callable[..., Trainer], tmp_path: Path) -> None:
    path = tmp_path / "run"
    for report in make(path, stop_at=0.85).run():
        if report.iteration == PEAK:
            break  # before anything is drawn
    assert not (path / "video.gif").exists()
    assert list(make(path, resume=True, stop_at=0.85).run()) == [] and (path / "video.gif").exists()
    assert {row["iteration"] for row in rows_without_time(path)} == {2, PEAK} and best(path) == [PEAK]


def test_a_level_that_is_not_a_success_rate_is_refused() -> None:
    with pytest.raises(RequestError, match="stop_at 95 can never be reached: success is from 0 to 1"):
        validate(small_config(stop_at=95.0))
    with pytest.raises(RequestError, match="best_by"):
        validate(small_config(best_by="return"))
    assert scores.is_enough(validate(small_config(stop_at=2.0, best_by="goal_distance")), 1.5)


# -- Callbacks


def test_callbacks_receive_evaluations_and_may_stop(make: Callable[..., Trainer], tmp_path: Path) -> None:
    told, others, path = [], [], tmp_path / "run"

    def stop_after_six(report: Any) -> bool:
        assert (path / "checkpoints" / LIGHT / str(report.iteration)).is_dir() or report.iteration % 2
        told.append((report.iteration, report.metrics["eval/success"]))
        return report.iteration == 6

    reports = list(make(path, best_by=None).run(callbacks=[stop_after_six, others.append]))
    assert [iteration for iteration, _ in told] == [2, 4, 6] == [report.iteration for report in others]
    assert told[-1][1] == reports[-1].metrics["eval/success"] and reports[-1].iteration == 6
    assert (path / "video.gif").exists()
    assert [report.iteration for report in make(path, best_by=None, resume=True).run()] == [7, 8]


def test_a_callback_that_fails_loses_nothing(make: Callable[..., Trainer], tmp_path: Path, straight: Path) -> None:
    path = tmp_path / "run"

    def fail(report: Any) -> None:
        if report.iteration == 4:
            raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        list(make(path).run(callbacks=[fail]))
    list(make(path, resume=True).run())
    assert rows_without_time(path) == rows_without_time(straight) and best(path) == [PEAK]


# -- Commands


def test_commands_take_the_best(
    straight: Path,
    make: Callable[..., Trainer],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setattr(restored_run, "make_trainer", lambda config, **_: make(None, eval_episodes=config.run.eval_episodes))
    monkeypatch.setattr(trainer.Trainer, "evaluate", lambda self, train: {"eval/success": jnp.float32(train.agent["updates"])})
    for words, updates in (([], 24.0), (["--checkpoint", "best"], 3.0 * PEAK), (["--checkpoint", "6"], 18.0)):
        assert cli.main(["eval", str(straight), *words]) == 0
        assert capsys.readouterr().out.split()[1:] == [f"{updates:.4f}"] * 2
    assert cli.main(["play", str(straight), "--checkpoint", "best", "--out", str(tmp_path / "play.gif")]) == 0
    capsys.readouterr()
    assert cli.main(["eval", str(straight), "--checkpoint", "newest"]) == 2
    assert "--checkpoint newest: name the iteration of a checkpoint, or best" in capsys.readouterr().err
    assert cli.main(["eval", str(straight), "--checkpoint", "3"]) == 2
    assert "has no checkpoint of iteration 3, only of 6, 8" in capsys.readouterr().err
    with pytest.raises(RequestError, match="has trained no seed 7"):
        jaxrl_vis.load_policy(straight, seed=7, checkpoint="best")
    assert read_config(straight).run.best_by == "success"
