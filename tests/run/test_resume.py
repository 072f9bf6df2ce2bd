"""Resumption of runs: what is kept, what is refused, and what is reported."""

import errno
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fake_program import final_state, make_fake_trainer, rows_without_time, run_until_sigterm, small_config

from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.run import loop
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT, Checkpoints
from jaxrl_vis.run.storage.folder import read_config


@pytest.mark.parametrize("cut", [2, 4])
def test_resumed_equals_straight_bit_for_bit(straight, tmp_path, cut, capsys):
    straight_path, straight_trainer, reports = straight
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=10 * cut), path).run())
    resumed_reports = list(make_fake_trainer(small_config(), path, resume=True).run())
    assert "exactly" in capsys.readouterr().out
    assert [report.iteration for report in resumed_reports] == list(range(cut + 1, 9))
    assert all(a == b for a, b in zip(resumed_reports, reports[cut:], strict=True))
    assert rows_without_time(path) == rows_without_time(straight_path)
    wall = [row["time/wall_s"] for row in metrics.read_rows(path / "metrics.jsonl")]
    assert wall == sorted(wall)
    shapes = straight_trainer.shapes
    assert all(map(np.array_equal, final_state(path, shapes), final_state(straight_path, shapes)))


def test_resume_between_evaluations_goes_on_with_the_means(straight, tmp_path):
    """The run is abandoned after iteration 5 and resumed from 3: rows after 3 have means over iterations 3 and 4, too."""
    path = tmp_path / "run"
    config = small_config(full_checkpoint_interval=3, checkpoint_interval=3)
    for report in make_fake_trainer(config, path).run():
        if report.iteration == 5:
            break
    list(make_fake_trainer(config, path, resume=True).run())
    assert rows_without_time(path) == rows_without_time(straight[0])


def damage(checkpoint: Path) -> None:
    for file in checkpoint.rglob("d/*"):
        file.unlink()


def test_damaged_newest_checkpoint_on_resume(straight, tmp_path, capsys):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=60), path).run())
    for tier in (FULL, LIGHT):
        damage(path / "checkpoints" / tier / "6")
    list(make_fake_trainer(small_config(), path, resume=True).run())
    out = capsys.readouterr().out
    assert "full/6 is damaged" in out and "resumed at iteration 4 of 8, exactly" in out
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_killed_between_the_last_evaluation_and_the_end(straight, tmp_path, capsys):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(), path).run())
    shutil.rmtree(path / "checkpoints" / LIGHT)
    (path / "video.gif").unlink()
    assert list(make_fake_trainer(small_config(), path, resume=True).run()) == []
    assert rows_without_time(path) == rows_without_time(straight[0]) and (path / "video.gif").exists()
    assert capsys.readouterr().out.count("success at the end: seed 0") == 2


def test_resume_from_light_says_what_it_is(tmp_path, capsys):
    path = tmp_path / "run"
    config = small_config(full_checkpoint_interval=0)
    list(make_fake_trainer(config.replace(env_steps=40), path).run())
    assert not Checkpoints(path / "checkpoints").iterations(FULL)
    reports = list(make_fake_trainer(config, path, resume=True).run())
    assert "not an exact continuation" in capsys.readouterr().out
    assert [report.iteration for report in reports] == [5, 6, 7, 8] and reports[-1].updates == 24


def test_finished_run_says_so(straight, capsys):
    assert list(make_fake_trainer(small_config(), straight[0], resume=True).run()) == []
    assert "finished already" in capsys.readouterr().out


def test_resume_of_nothing_starts(tmp_path, capsys):
    with pytest.raises(RequestError, match="nothing to resume: there is no folder .*leave out --resume"):
        make_fake_trainer(small_config(env_steps=20), tmp_path / "run", resume=True)
    (tmp_path / "run").mkdir()  # as a run that was killed before its first file leaves it
    reports = make_fake_trainer(small_config(env_steps=20), tmp_path / "run", resume=True).run()
    assert [report.iteration for report in reports] == [1, 2]
    assert "nothing to resume" in capsys.readouterr().out


def test_an_existing_folder_is_refused(straight, tmp_path):
    with pytest.raises(RequestError, match="--resume continues it, --overwrite starts again"):
        make_fake_trainer(small_config(), straight[0])
    with pytest.raises(RequestError, match="contradict each other"):
        make_fake_trainer(small_config(), straight[0], resume=True, overwrite=True)
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(RequestError, match="not a run"):
        make_fake_trainer(small_config(), tmp_path, overwrite=True)
    assert (tmp_path / "thesis.txt").read_text() == "precious"
    with pytest.raises(RequestError, match="is a file"):
        make_fake_trainer(small_config(), tmp_path / "thesis.txt")


def test_overwrite_deletes_the_run_and_nothing_else(tmp_path):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=20), path).run())
    (path / "notes.txt").write_text("mine")
    (path / "checkpoints" / "notes.txt").write_text("mine")
    assert len(list(make_fake_trainer(small_config(seed=5, env_steps=20), path, overwrite=True).run())) == 2
    assert (
        (path / "notes.txt").exists()
        and (path / "checkpoints" / "notes.txt").exists()
        and {row["seed"] for row in rows_without_time(path)} == {5, 6}
    )


def test_a_contradicting_config_is_named(straight):
    with pytest.raises(RequestError) as refused:
        make_fake_trainer(small_config(num_envs=3, discount=0.5, eval_interval=1), straight[0], resume=True)
    text = str(refused.value)
    assert "num_envs (saved 2, asked 3)" in text and "discount (saved None, asked 0.5)" in text
    assert "eval_interval" not in text and "\n" not in text


def test_a_broken_config_file_is_one_line(straight, tmp_path):
    with pytest.raises(RequestError, match="no run in"):
        read_config(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(RequestError, match="is not JSON .*: put back what it held, or train --overwrite"):
        make_fake_trainer(small_config(), tmp_path, resume=True)
    record = json.loads((straight[0] / "config.json").read_text())
    record["config"]["old_option"] = 1
    (tmp_path / "config.json").write_text(json.dumps(record))
    with pytest.raises(RequestError, match="old_option"):
        make_fake_trainer(small_config(), tmp_path, resume=True)


def test_an_earlier_run_outlives_a_new_one_that_cannot_be(straight, tmp_path):
    shutil.copytree(straight[0], tmp_path / "run")
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    with pytest.raises(RequestError, match="GiB"):
        list(make_fake_trainer(small_config(replay_transitions=10**12, seeds=1), tmp_path / "run", overwrite=True).run())
    assert before == {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}


def interrupt_run(config, path, after: int) -> None:
    """End a run by SIGTERM after iteration ``after``, with a light and a full checkpoint."""
    run_until_sigterm(make_fake_trainer(config, path), after)


def test_a_stale_full_checkpoint_destroys_nothing(tmp_path, capsys):
    """The run gets SIGTERM, is resumed to its end, and then extended: the second part's checkpoints and rows stay."""
    path, config = tmp_path / "run", small_config(full_checkpoint_interval=0, env_steps=200)
    interrupt_run(config, path, 2)
    checkpoints = Checkpoints(path / "checkpoints")
    saved_at = checkpoints.iterations(FULL)
    assert len(saved_at) == 1 and checkpoints.iterations(LIGHT)[-1] == saved_at[0]
    list(make_fake_trainer(config, path, resume=True).run())
    assert checkpoints.iterations(FULL) == [] and checkpoints.iterations(LIGHT) == [18, 20]
    rows = rows_without_time(path)
    capsys.readouterr()
    reports = make_fake_trainer(config.replace(env_steps=240), path, resume=True).run()
    assert next(reports).iteration == 21
    assert checkpoints.iterations(LIGHT) == [18, 20] and rows_without_time(path) == rows
    assert "resumed at iteration 20 of 24 from a light checkpoint" in capsys.readouterr().out
    list(reports)
    later = rows_without_time(path)
    assert later[: len(rows)] == rows and {row["resume/replay_lost_at"] for row in later[len(rows) :]} == {20}
    assert not any("resume/replay_lost_at" in row for row in rows)


@pytest.mark.parametrize("full", [0, 2])
def test_a_run_that_was_interrupted_before_its_last_evaluation_is_finished_once(straight, tmp_path, capsys, full):
    path, config = tmp_path / "run", small_config(full_checkpoint_interval=full)
    interrupt_run(config, path, 7)
    assert metrics.read_rows(path / "metrics.jsonl")[-1]["iteration"] == 6
    list(make_fake_trainer(config, path, resume=True).run())
    assert rows_without_time(path) == rows_without_time(straight[0])
    assert Checkpoints(path / "checkpoints").iterations(FULL) == ([6, 8] if full else [])
    capsys.readouterr()
    assert list(make_fake_trainer(config, path, resume=True).run()) == []
    assert "is finished already" in capsys.readouterr().out


def test_a_run_that_is_asked_for_fewer_steps_than_it_has_is_evaluated(tmp_path, capsys):
    path, config = tmp_path / "run", small_config(eval_interval=4, full_checkpoint_interval=0)
    interrupt_run(config, path, 5)
    done = Checkpoints(path / "checkpoints").newest()
    assert done in (6, 7) and metrics.read_rows(path / "metrics.jsonl")[-1]["iteration"] == 4
    shorter = config.replace(env_steps=50)
    list(make_fake_trainer(shorter, path, resume=True).run())
    assert metrics.read_rows(path / "metrics.jsonl")[-1]["iteration"] == done
    assert "success at the end: seed 0: " in capsys.readouterr().out
    list(make_fake_trainer(shorter, path, resume=True).run())
    assert "is finished already" in capsys.readouterr().out


def test_a_loop_that_is_left_can_be_entered_again(straight, tmp_path):
    path = tmp_path / "run"
    trainer = make_fake_trainer(small_config(), path)
    for report in trainer.run():
        if report.iteration == 5:
            break
    saved = Checkpoints(path / "checkpoints").newest()
    assert saved >= 4 and next(trainer.run()).iteration == saved + 1
    assert [report.iteration for report in trainer.run()][-1] == 8
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_a_damaged_final_checkpoint_is_not_a_finished_run(straight, tmp_path, capsys):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(), path).run())
    for tier in (FULL, LIGHT):
        damage(path / "checkpoints" / tier / "8")
    capsys.readouterr()
    reports = list(make_fake_trainer(small_config(), path, resume=True).run())
    out = capsys.readouterr().out
    assert [report.iteration for report in reports] == [7, 8] and "not finished" in out
    assert out.count("light/8 is damaged") == 1 and "finished already" not in out
    assert rows_without_time(path) == rows_without_time(straight[0])
    damaged = path / "checkpoints" / "damaged"
    assert sorted(entry.name for entry in damaged.iterdir()) == ["full-8", "light-8", "metrics.jsonl"]
    assert [row["iteration"] for row in metrics.read_rows(damaged / "metrics.jsonl")] == [8, 8]


def test_nothing_usable_keeps_what_was_there(straight, tmp_path, capsys):
    path = shutil.copytree(straight[0], tmp_path / "run")
    for tier in (FULL, LIGHT):
        for iteration in "68":
            damage(path / "checkpoints" / tier / iteration)
    list(make_fake_trainer(small_config(), path, resume=True).run())
    assert "no usable checkpoint: starting at the beginning" in capsys.readouterr().out
    assert rows_without_time(path) == rows_without_time(straight[0])
    assert len(metrics.read_rows(path / "checkpoints" / "damaged" / "metrics.jsonl")) == 8


def refuse(*_, **__):
    raise RequestError("evaluate needs 90 GiB of scratch memory")


@pytest.mark.parametrize("how", ["overwrite", "resume", "new"])
def test_a_run_that_is_refused_after_compilation_changes_nothing(straight, tmp_path, monkeypatch, how):
    path = tmp_path / "run"
    if how != "new":
        shutil.copytree(straight[0], path)
        damage(path / "checkpoints" / LIGHT / "8")
        damage(path / "checkpoints" / FULL / "8")
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    monkeypatch.setattr(loop, "check_compiled", refuse)
    options = {} if how == "new" else {how: True}
    with pytest.raises(RequestError, match="90 GiB"):
        list(make_fake_trainer(small_config(env_steps=100), path, **options).run())
    assert before == {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    assert path.exists() == (how != "new")


def test_two_writers_in_one_folder(tmp_path):
    path, config = tmp_path / "run", small_config(env_steps=60)
    first = make_fake_trainer(config, path).run()
    next(first)
    for options in ({"resume": True}, {"overwrite": True}):
        with pytest.raises(RequestError, match=r"in use by process \d+ on \S+: ") as refused:
            list(make_fake_trainer(config, path, **options).run())
        assert "\n" not in str(refused.value)
    assert len(list(first)) == 5 and [row["iteration"] for row in rows_without_time(path)] == [2, 2, 4, 4, 6, 6]
    assert not (path / "run.lock").exists()


def test_a_dead_holders_lock_is_taken_over(tmp_path, clean_environment):
    path = tmp_path / "run"
    code = f"""
import os, signal
from pathlib import Path
from jaxrl_vis.run.storage.lock import run_lock
with run_lock(Path({str(path)!r})):
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], env=clean_environment).returncode == -signal.SIGKILL
    assert (path / "run.lock").exists()
    assert len(list(make_fake_trainer(small_config(env_steps=20), path).run())) == 2


def test_a_full_disk_is_one_line_and_loses_nothing(straight, tmp_path, monkeypatch):
    path = tmp_path / "run"
    reports = make_fake_trainer(small_config(), path).run()
    original = metrics.append_rows

    def full_disk(file, rows):
        if len(metrics.read_rows(file)) >= 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        original(file, rows)

    monkeypatch.setattr(metrics, "append_rows", full_disk)
    with pytest.raises(StorageError, match="No space left on device.*iteration 6.*--resume") as stopped:
        list(reports)
    assert "\n" not in str(stopped.value)
    monkeypatch.undo()
    list(make_fake_trainer(small_config(), path, resume=True).run())
    assert [row["iteration"] for row in rows_without_time(path)] == [2, 2, 4, 4, 6, 6, 8, 8]
