"""SIGTERM, Ctrl-C and other interruptions of a run."""

import contextlib
import errno
import faulthandler
import queue
import signal
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from fake_program import make_fake_trainer, rows_without_time, small_config

from jaxrl_vis import cli
from jaxrl_vis.errors import NonFiniteError, StorageError, Terminated
from jaxrl_vis.run import signals
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT, RECENT, Checkpoints
from jaxrl_vis.run.storage.folder import read_config
from jaxrl_vis.run.storage.recent import Recent

FAKE = Path(__file__).parents[1] / "fake_program.py"


def start(run_dir: Path, environment: dict[str, str]) -> subprocess.Popen:
    command = [sys.executable, str(FAKE), str(run_dir), "signal"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, -signal.SIGINT)])
def test_a_signal_saves_and_loses_at_most_one_iteration(tmp_path, clean_environment, number, status):
    run_dir = tmp_path / "run"
    process = start(run_dir, clean_environment)
    latest = 0
    for line in process.stdout:
        if line.startswith("report"):
            latest = int(line.split()[1])
        if latest == 7:
            process.send_signal(number)
            break
    rest, errors = process.communicate(timeout=60)
    assert process.returncode == status, errors
    assert "--resume" in rest
    latest = max([latest, *(int(line.split()[1]) for line in rest.splitlines() if line.startswith("report"))])
    shapes = make_fake_trainer(small_config(), None).shapes
    checkpoints = Checkpoints(run_dir / "checkpoints")
    restored = checkpoints.restore_for_resume(shapes)
    assert restored.tier == FULL and restored.iteration >= latest - 1
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
    """Function that returns a list of a trainer's later compilations by XLA, which begins when its own compilation ends."""
    results: list[str] = []
    watching = []

    def listen(event, duration, **_):
        if watching and "backend_compile" in event:
            results.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)

    def watch(trainer):
        compile_all = trainer.programs.compile

        def compile_and_watch(*names, **options):
            compiled = compile_all(*names, **options)
            watching.append(True)
            return compiled

        trainer.programs.compile = compile_and_watch
        return results

    yield watch
    watching.clear()


@pytest.mark.parametrize("end", ["itself", "signal", "nan"])
def test_nothing_is_compiled_once_training_has_begun(tmp_path, compilations, end):
    """Evaluations, saves, curve and video, a signal, and a number that is not finite start no compilation."""
    jax.clear_caches()
    trainer = make_fake_trainer(small_config(seeds=3), tmp_path / "run", nan_at=5 if end == "nan" else None)
    results = compilations(trainer)
    try:
        for report in trainer.run():
            if end == "signal" and report.iteration == 5:
                signal.raise_signal(signal.SIGTERM)
    except (Terminated, NonFiniteError):
        assert end != "itself"
    assert results == []
    assert jax.numpy.ones(3).sum() == 3 and results  # and the listener hears


def test_children_that_compile_do_not_get_the_groups_signals(clean_environment):
    """Signals are sent to the whole process group, as by `timeout`."""
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


def test_whatever_goes_wrong_a_save_is_attempted(straight, tmp_path, monkeypatch):
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
    assert rows_without_time(path) == rows_without_time(straight[0])


ENDS = tuple(getattr(signal, f"SIG{name}") for name in ("HUP", "INT", "QUIT", "TERM", "USR1", "USR2", "ALRM", "XCPU"))
# Signals that leave a process as it was, that stop it, that no handler gets, and faults.
HARMLESS = ("CHLD", "CONT", "URG", "WINCH", "PIPE", "XFSZ", "TSTP", "TTIN", "TTOU", "STOP", "KILL")
FAULTS = ("SEGV", "BUS", "ABRT", "FPE", "ILL", "SYS", "TRAP")


@pytest.fixture
def not_ignored():
    """Handle signals as in a process started without `nohup` and not in the background of a script."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDS if number != signal.SIGINT}
    before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_every_signal_that_ends_a_process_saves_and_is_named(tmp_path, capsys, not_ignored):
    path = tmp_path / "my run"
    config = small_config(env_steps=180, eval_interval=50, checkpoint_interval=50, full_checkpoint_interval=0)
    for count, number in enumerate(ENDS):
        trainer = make_fake_trainer(config, path, resume=count > 0)
        with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else Terminated) as stopped:
            for report in trainer.run():
                if report.iteration == 2 * count + 1:
                    signal.raise_signal(number)
        if number != signal.SIGINT:
            assert stopped.value.code == 128 + number and stopped.value.signal == number
        said = capsys.readouterr().out
        assert f"{'Ctrl-C' if number == signal.SIGINT else number.name}: saving iteration {2 * count + 2}" in said
        assert f"go on with --run-dir '{path}' --resume" in said
        assert signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)
    restored = Checkpoints(path / "checkpoints", read_only=True).restore_for_resume(trainer.shapes)
    assert restored.tier == FULL and restored.iteration == 2 * len(ENDS)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other signals")
def test_no_signal_that_ends_a_process_is_left_out(not_ignored):
    left_out = {getattr(signal, f"SIG{name}") for name in (*HARMLESS, *FAULTS)}
    assert set(signals.SIGNALS) == set(signal.valid_signals()) - left_out
    with signals.Interruption() as interruption:
        signal.raise_signal(signal.SIGRTMIN + 3)
        assert interruption.signal == signal.SIGRTMIN + 3 and interruption.name == "SIGRTMIN+3"
    assert [signals.signal_name(number) for number in (signal.SIGRTMIN, signal.SIGRTMAX)] == ["SIGRTMIN", "SIGRTMAX"]


def test_what_is_ignored_or_handled_by_the_caller_stays_so(tmp_path, not_ignored):
    heard = []
    with (tmp_path / "stacks").open("w+") as stacks:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
        signal.signal(signal.SIGUSR1, lambda number, _: heard.append(number))
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        faulthandler.register(signal.SIGUSR2, stacks)  # in C, of which Python knows nothing
        theirs = {number: signal.getsignal(number) for number in (*ENDS, signal.SIGPIPE)}
        try:
            for report in make_fake_trainer(small_config(), tmp_path / "run").run():
                if report.iteration == 3:
                    for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGPIPE):
                        signal.raise_signal(number)
            assert theirs == {number: signal.getsignal(number) for number in theirs}
        finally:
            faulthandler.unregister(signal.SIGUSR2)
            signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        stacks.seek(0)
        assert report.iteration == 8 and heard == [signal.SIGUSR1] and "most recent call first" in stacks.read()


def test_a_handler_of_the_callers_that_raises_leaves_the_networks_saved(straight, tmp_path, not_ignored):
    def leave(*_):
        raise SystemExit(7)

    signal.signal(signal.SIGTERM, leave)
    path = tmp_path / "run"
    trainer = make_fake_trainer(small_config(checkpoint_interval=100, full_checkpoint_interval=0), path)
    evaluate = trainer.programs.evaluate

    def evaluate_and_be_told(train, key=None):
        signal.raise_signal(signal.SIGTERM)
        return evaluate(train, key)

    trainer.programs.evaluate = evaluate_and_be_told
    with pytest.raises(SystemExit, match="7"):
        list(trainer.run())
    assert Checkpoints(path / "checkpoints", read_only=True).iterations(LIGHT) == [2]
    list(make_fake_trainer(small_config(full_checkpoint_interval=0), path, resume=True).run())
    assert [row["train/success"] for row in rows_without_time(path)] == [
        row["train/success"] for row in rows_without_time(straight[0])
    ]


def test_signals_that_repeat_themselves_do_not_hurry_a_save(tmp_path, not_ignored):
    """SIGXCPU comes every second, a closed terminal sends SIGHUP twice, and SIGTERM follows a scheduler's warning."""
    path = tmp_path / "run"
    trainer = make_fake_trainer(small_config(full_checkpoint_interval=0), path)
    with pytest.raises(Terminated) as stopped:
        for report in trainer.run():
            if report.iteration == 3:
                for number in (signal.SIGUSR1, signal.SIGXCPU, signal.SIGXCPU, signal.SIGHUP, signal.SIGHUP, signal.SIGTERM):
                    signal.raise_signal(number)
    assert stopped.value.signal == signal.SIGUSR1
    assert Checkpoints(path / "checkpoints", read_only=True).iterations(FULL)[-1] >= 3


def test_a_signal_after_the_last_iteration_is_reported(tmp_path, capsys, monkeypatch, not_ignored):
    trainer = make_fake_trainer(small_config(), tmp_path / "run")
    finish = Checkpoints.wait

    def told(self):
        signal.raise_signal(signal.SIGHUP)
        finish(self)

    with pytest.raises(Terminated) as stopped:
        for report in trainer.run():
            if report.iteration == 8:
                monkeypatch.setattr(Checkpoints, "wait", told)
    assert stopped.value.code == 129
    assert "SIGHUP: all is trained and saved" in capsys.readouterr().out


@pytest.mark.parametrize("number", ENDS)
def test_a_signal_ends_any_other_command_in_one_line(number, monkeypatch, capsys, not_ignored):
    cleaned = []

    def work(_):
        try:
            signal.raise_signal(number)
        finally:
            cleaned.append(True)

    monkeypatch.setitem(cli.COMMANDS, "doctor", (cli.doctor.Doctor, work))
    before = [signal.getsignal(ending) for ending in ENDS]
    assert cli.main(["doctor"]) == 128 + number and cleaned
    name = "Ctrl-C" if number == signal.SIGINT else number.name
    assert capsys.readouterr().err.splitlines() == [f"jaxrl-vis: {name}: ended before it was done"]
    assert [signal.getsignal(ending) for ending in ENDS] == before


def test_a_command_that_does_not_look_up_is_ended(monkeypatch, not_ignored):
    """Code in XLA, for example, may compile for minutes; a run, however, is given the time that it takes to save."""
    monkeypatch.setattr(signals, "_PATIENCE_S", 0.1)
    given_up: queue.Queue[int] = queue.Queue()
    with signals.Ending(given_up.put):
        with signals.Interruption() as interruption:
            signal.raise_signal(signal.SIGHUP)
            with pytest.raises(queue.Empty):
                given_up.get(timeout=0.5)
        assert interruption.signal == signal.SIGHUP
        with contextlib.suppress(Terminated):
            signal.raise_signal(signal.SIGTERM)
        assert given_up.get(timeout=10) == signal.SIGTERM
    assert signal.set_wakeup_fd(-1) == -1


def test_a_second_signal_leaves_no_words_about_a_half_made_event_loop(monkeypatch):
    """If the handler raises while orbax creates a loop, Python reports an error when it collects the loop."""
    shown = []
    monkeypatch.setattr(sys, "unraisablehook", shown.append)
    with pytest.raises(Terminated), signals.Interruption():
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)

    class BaseEventLoop:
        def __del__(self):
            raise AttributeError("'NoneType' object has no attribute 'fileno'")

    BaseEventLoop.__del__.__qualname__ = "BaseEventLoop.__del__"
    BaseEventLoop()
    assert shown == []

    class Other:
        def __del__(self):
            raise ValueError("ours")

    Other()
    assert [type(problem.exc_value) for problem in shown] == [ValueError]
