"""Printing to unreadable streams: no kind of stream ends the program that prints to it."""

import contextlib
import errno
import io
import itertools
import logging
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest
from fake_program import make_fake_trainer, rows_without_time, run_until_sigterm, small_config

from jaxrl_vis import cli
from jaxrl_vis.errors import StorageError
from jaxrl_vis.host.streams import SafeStream, safe, safe_streams
from jaxrl_vis.run.loggers.bar import format_clock
from jaxrl_vis.run.loggers.console import RunConsole
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.stalks.cli.progress import progress
from jaxrl_vis_envs.compiling import mjx_imports

FULL = Path("/dev/full")


def without_reader():
    reading, writing = os.pipe()
    os.close(reading)
    return os.fdopen(writing, "w")


def closed():
    stream = io.StringIO()
    stream.close()
    return stream


def in_ascii():
    return io.TextIOWrapper(io.BytesIO(), encoding="ascii")


class Odd(io.StringIO):
    """Stream of a notebook whose kernel has died."""

    def write(self, text):
        raise RuntimeError("no kernel")


BROKEN = {
    "no reader": without_reader,
    "closed": closed,
    "ascii": in_ascii,
    "odd": Odd,
    "none": lambda: None,
} | ({"full": lambda: FULL.open("w")} if FULL.exists() else {})


def let_go(stream) -> None:
    """Close a stream that may hold data that it cannot write."""
    with contextlib.suppress(OSError):
        if stream is not None:
            stream.close()


@pytest.mark.parametrize("kind", BROKEN)
def test_nothing_that_is_printed_raises(kind, monkeypatch):
    stream = BROKEN[kind]()
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", stream)
    with safe_streams() as out:
        print("rüns 日本 \udce9")
        print("to stderr", file=sys.stderr)
        sys.stdout.flush()
        logging.StreamHandler().handle(logging.makeLogRecord({"msg": "of another"}))
        assert out.isatty() is False and isinstance(out.encoding, str)
    assert sys.stdout is stream and (out.failure is None) == (kind in ("none", "ascii"))
    if kind == "ascii":
        assert stream.buffer.getvalue().startswith(b"r?ns ?? ?\nto stderr\n")
    let_go(stream)


def test_a_run_goes_on_whatever_becomes_of_its_streams(tmp_path, monkeypatch, straight):
    path = tmp_path / "rüns 日本"
    kinds, streams = itertools.cycle(BROKEN.values()), []
    try:
        for _ in make_fake_trainer(small_config(), path).run():
            streams.append(next(kinds)())
            monkeypatch.setattr(sys, "stdout", streams[-1])
            monkeypatch.setattr(sys, "stderr", streams[-1])
    finally:
        monkeypatch.undo()
        for stream in streams:
            let_go(stream)
    assert len(streams) == 8 and rows_without_time(path) == rows_without_time(straight[0])
    assert (path / "curve.png").exists()


def test_a_run_goes_on_when_its_terminal_is_gone(tmp_path, monkeypatch):
    keeper, terminal = pty.openpty()
    stream = os.fdopen(terminal, "w")
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setenv("TERM", "xterm")
    for report in make_fake_trainer(small_config(), tmp_path / "run").run():
        if report.iteration == 3:
            os.close(keeper)
    monkeypatch.undo()
    let_go(stream)
    assert report.iteration == 8 and len(rows_without_time(tmp_path / "run")) == 8


def shown_on_a_terminal(width, monkeypatch, show) -> list[str]:
    """Return the lines that ``show`` prints on a terminal of a given width."""
    keeper, terminal = pty.openpty()
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("LINES", "24")
    with os.fdopen(terminal, "w", encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        show()
    monkeypatch.undo()
    shown = b""
    with contextlib.suppress(OSError):  # at its end, where nobody holds it any more
        while part := os.read(keeper, 100_000):
            shown += part
    os.close(keeper)
    return re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode()))


@pytest.mark.parametrize("width", [200, 80, 60, 40])
def test_a_bar_shows_what_matters_at_any_width(width, monkeypatch):
    def train():
        with RunConsole() as console:
            console.start(total=120_000, done=40)
            console.advance(1234, 98_765.0)
            console.show_evaluation([0.93], [0.0123], "m")

    def measure():
        with progress("pairs") as done:
            done("a_plot_with_quite_a_long_name_2026-08-14", 0, 480)
            done("a_plot_with_quite_a_long_name_2026-08-14", 17, 480)

    for show, count in ((train, "1234/120000"), (measure, "17/480")):
        lines = [line for line in shown_on_a_terminal(width, monkeypatch, show) if count in line]
        assert lines and all(len(line.rstrip()) <= width for line in lines)
        assert re.search(rf"{count}.* 0:00:0\d( elapsed)?,? .*\d?:?-?[-\d]:[-\d][-\d]:?[-\d]* left", lines[-1]), lines[-1]
    assert width < 200 or "a_plot_with_quite" in lines[-1]


def test_a_clock_is_not_ambiguous():
    assert [format_clock(seconds) for seconds in (None, 0, 65, 3725.9, 100_000)] == [
        "-:--:--",
        "0:00:00",
        "0:01:05",
        "1:02:05",
        "27:46:40",
    ]


@pytest.mark.parametrize("kind", ["no reader", *(["full"] if FULL.exists() else []), "none"])
def test_a_command_whose_result_is_printed_says_that_nobody_got_it(kind, monkeypatch, capsys):
    for name in ("doctor", "train"):
        monkeypatch.setitem(cli.COMMANDS, name, (cli.COMMANDS[name][0], lambda _: print("a result") or 0))
    statuses = {"no reader": 141, "full": 1, "none": 0}
    for name, expected in (("doctor", statuses[kind]), ("train", 0)):
        stream = BROKEN[kind]()
        monkeypatch.setattr(sys, "stdout", stream)
        assert cli.main([name]) == expected
        let_go(stream)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (kind == "full") and all("No space left on device" in line for line in lines)


def test_files_do_not_take_the_place_of_closed_streams(tmp_path, clean_environment):
    """Otherwise, output of C libraries would be written into a run's files."""
    code = f"""
import os
for number in range(3):
    os.close(number)
from jaxrl_vis.host.streams import reserve_standard_files
reserve_standard_files()
with open({str(tmp_path / "metrics.jsonl")!r}, "w") as file:
    os.write(1, b"printed"), os.write(2, b"printed")
    raise SystemExit(0 if file.fileno() > 2 and os.get_inheritable(2) else 1)
"""
    assert subprocess.run([sys.executable, "-c", code], env=clean_environment).returncode == 0
    assert (tmp_path / "metrics.jsonl").read_text() == ""


@pytest.mark.parametrize("kind", ["none", "no reader", "closed"])
def test_environments_are_made_without_a_stdout(kind, monkeypatch):
    stream = BROKEN[kind]()
    monkeypatch.setattr(sys, "stdout", stream)
    with mjx_imports._hide_notice():
        print("of somebody else")
    let_go(stream)


def test_other_faults_are_not_reported_as_faults_of_the_disk(tmp_path, monkeypatch):
    trainer = make_fake_trainer(small_config(), tmp_path / "run")

    def broken(*_):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(trainer.programs, "evaluate", broken)
    with pytest.raises(BrokenPipeError):
        list(trainer.run())


@pytest.mark.parametrize(
    ("number", "hint", "is_moved"),
    [(errno.ENOSPC, "make room", False), (errno.EACCES, "fix that", False), (errno.ENOENT, "", True)],
)
def test_advice_after_a_fault_of_the_disk_can_be_followed(tmp_path, monkeypatch, number, hint, is_moved):
    if is_moved and not Path("/proc/self/fd").exists():
        pytest.skip("other systems do not say where a folder went")
    path = there = tmp_path / "my run"
    if is_moved:
        there = tmp_path / "my moved run"

    def no_room(*_):
        path.rename(there)
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(metrics, "append_rows", no_room)
    with pytest.raises(StorageError) as stopped:
        list(make_fake_trainer(small_config(checkpoint_interval=1), path).run())
    text = str(stopped.value)
    assert (f"{path} was moved to {there}" if is_moved else os.strerror(number)) in text and "\n" not in text
    assert text.endswith(f"{': ' if is_moved else f'{hint}, then '}go on with --run-dir '{there}' --resume")
    monkeypatch.undo()
    assert list(make_fake_trainer(small_config(), there, resume=True).run())[-1].iteration == 8


def test_a_resumed_run_that_owes_an_evaluation_promises_no_speed(tmp_path, capsys):
    path = tmp_path / "run"
    run_until_sigterm(make_fake_trainer(small_config(), path), 3)
    capsys.readouterr()
    list(make_fake_trainer(small_config(), path, resume=True).run())
    first, second, *_ = [line for line in capsys.readouterr().out.splitlines() if line.startswith("iteration ")]
    assert "iteration 4/8" in first and "success" in first and "steps/s" not in first and "left" not in first
    assert "steps/s" in second and "left" in second


def test_a_safe_stream_is_as_the_one_below():
    stream = io.StringIO()
    made = safe(stream)
    assert safe(made) is made and isinstance(made, SafeStream)
    made.writelines(["a", "b"])
    assert made.getvalue() == "ab" and made.write("cde") == 3 and made.failure is None
    with pytest.raises(OSError):
        safe(None).fileno()
