"""SIGTERM, Ctrl-C and other violence against a run."""

import errno
import signal
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from fake_program import make_fake_trainer, rows_without_time, small_config

from jaxrl_vis.errors import NonFiniteError, StorageError, Terminated
from jaxrl_vis.run.checkpoint import FULL, LIGHT, RECENT, Checkpoints
from jaxrl_vis.run.folder import read_config
from jaxrl_vis.run.recent import Recent

FAKE = Path(__file__).with_name("fake_program.py")


def start(run_dir: Path, environment: dict[str, str]) -> subprocess.Popen:
    command = [sys.executable, str(FAKE), str(run_dir), "signal"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, -signal.SIGINT)])
def test_a_signal_saves_and_loses_at_most_one_iteration(tmp_path, clean_environment, number, status):
    run_dir = tmp_path / "run"
    process = start(run_dir, clean_environment)
    seen = 0
    for line in process.stdout:
        if line.startswith("report"):
            seen = int(line.split()[1])
        if seen == 7:
            process.send_signal(number)
            break
    rest, errors = process.communicate(timeout=60)
    assert process.returncode == status, errors
    assert "--resume" in rest
    seen = max([seen, *(int(line.split()[1]) for line in rest.splitlines() if line.startswith("report"))])
    shapes = make_fake_trainer(small_config(), None).shapes
    checkpoints = Checkpoints(run_dir / "checkpoints")
    restored = checkpoints.restore_for_resume(shapes)
    assert restored.tier == FULL and restored.iteration >= seen - 1
    assert checkpoints.iterations(LIGHT) == [restored.iteration]
    config = read_config(run_dir).replace(env_steps=10 * (restored.iteration + 2), eval_interval=1)
    reports = list(make_fake_trainer(config, run_dir, resume=True).run())
    assert [report.iteration for report in reports] == [restored.iteration + 1, restored.iteration + 2]


def test_an_evaluation_that_a_signal_prevented_is_made_up_for(straight, tmp_path):
    path = tmp_path / "run"
    reports = make_fake_trainer(small_config(), path).run()
    with pytest.raises(Terminated) as stopped:
        for report in reports:
            if report.iteration == 3:  # iteration 4, which ends with an evaluation, comes next
                signal.raise_signal(signal.SIGTERM)
    assert stopped.value.code == 143
    assert len(rows_without_time(path)) == 2
    list(make_fake_trainer(small_config(), path, resume=True).run())
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_handlers_are_put_back(tmp_path):
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    reports = make_fake_trainer(small_config(), tmp_path / "run").run()
    next(reports)
    assert signal.getsignal(signal.SIGTERM) != before[0]
    reports.close()
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before


def test_a_second_signal_does_not_wait(tmp_path):
    reports = make_fake_trainer(small_config(), tmp_path / "run").run()
    next(reports)
    signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    reports.close()


@pytest.fixture
def compilations():
    """Names of what XLA compiles from the moment on that ``watch`` is called with a trainer: at the end of its compilation."""
    found: list[str] = []
    watching = []

    def listen(event, duration, **_):
        if watching and "backend_compile" in event:
            found.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)

    def watch(trainer):
        compile_all = trainer.programs.compile

        def compile_and_watch(**options):
            compiled = compile_all(**options)
            watching.append(True)
            return compiled

        trainer.programs.compile = compile_and_watch
        return found

    yield watch
    watching.clear()


@pytest.mark.parametrize("end", ["itself", "signal", "nan"])
def test_nothing_is_compiled_once_training_has_begun(tmp_path, compilations, end):
    """Neither by evaluations, saves, curve and video, nor by what a signal or a broken number sets going."""
    jax.clear_caches()
    trainer = make_fake_trainer(small_config(seeds=3), tmp_path / "run", nan_at=5 if end == "nan" else None)
    found = compilations(trainer)
    try:
        for report in trainer.run():
            if end == "signal" and report.iteration == 5:
                signal.raise_signal(signal.SIGTERM)
    except (Terminated, NonFiniteError):
        assert end != "itself"
    assert found == []
    assert jax.numpy.ones(3).sum() == 3 and found  # and the listener hears


def test_children_that_compile_do_not_get_the_groups_signals(clean_environment):
    """As `timeout` sends them: to the whole process group."""
    code = """
import os, signal, subprocess, sys, time
from concurrent.futures import ThreadPoolExecutor
from jaxrl_vis.run.signals import Interruption, shield_this_thread, shielded_children
with shielded_children():
    first = subprocess.Popen(["sleep", "30"])
with ThreadPoolExecutor(initializer=shield_this_thread) as pool:
    second = pool.submit(subprocess.Popen, ["sleep", "30"]).result()
third = subprocess.Popen(["sleep", "30"])
with Interruption() as interruption:
    os.killpg(0, signal.SIGTERM)
    time.sleep(0.5)
    assert interruption
assert (first.poll(), second.poll(), third.poll()) == (None, None, -signal.SIGTERM)
first.kill(), second.kill()
"""
    done = subprocess.run([sys.executable, "-c", code], env=clean_environment, start_new_session=True, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


def test_a_second_signal_during_the_full_save_leaves_the_light_one_and_the_replay(tmp_path, monkeypatch):
    path = tmp_path / "run"
    trainer = make_fake_trainer(small_config(full_checkpoint_interval=0), path)
    save_full = Checkpoints.save_full

    def hurried(*arguments):
        signal.raise_signal(signal.SIGTERM)
        save_full(*arguments)

    monkeypatch.setattr(Checkpoints, "save_full", hurried)
    with pytest.raises(Terminated):
        for report in trainer.run():
            if report.iteration == 3:
                signal.raise_signal(signal.SIGTERM)
    checkpoints = Checkpoints(path / "checkpoints", read_only=True)
    assert checkpoints.iterations(FULL) == [] and checkpoints.iterations(LIGHT)[-1] >= 3
    assert checkpoints.restore_for_resume(trainer.shapes).tier == RECENT


def test_no_room_for_the_replay_leaves_the_networks(tmp_path, monkeypatch, capsys):
    path = tmp_path / "run"
    trainer = make_fake_trainer(small_config(full_checkpoint_interval=0), path)

    def no_room(*_):
        raise StorageError("cannot write a full checkpoint (no space left on the device)")

    def no_room_either(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Checkpoints, "save_full", no_room)
    monkeypatch.setattr(Recent, "_write", no_room_either)
    with pytest.raises(Terminated):
        for report in trainer.run():
            if report.iteration == 3:
                signal.raise_signal(signal.SIGTERM)
    assert "the networks are saved, the replay is not" in capsys.readouterr().out
    assert Checkpoints(path / "checkpoints", read_only=True).iterations(LIGHT)[-1] >= 3


def test_whatever_goes_wrong_a_save_is_attempted(tmp_path, monkeypatch):
    path = tmp_path / "run"
    trainer = make_fake_trainer(small_config(checkpoint_interval=100, full_checkpoint_interval=0), path)

    def broken(*_):
        raise RuntimeError("the device fell off")

    with pytest.raises(RuntimeError, match="fell off"):
        for report in trainer.run():
            if report.iteration == 5:
                monkeypatch.setattr(trainer.programs, "evaluate", broken)
    monkeypatch.undo()
    assert Checkpoints(path / "checkpoints", read_only=True).iterations(LIGHT) == [6]
    list(make_fake_trainer(small_config(full_checkpoint_interval=0), path, resume=True).run())
    assert [row["iteration"] for row in rows_without_time(path)] == [2, 2, 4, 4, 6, 6, 8, 8]
