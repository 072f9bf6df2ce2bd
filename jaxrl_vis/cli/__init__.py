"""Command line: a thin layer over the Python API. One file per command: its options as a frozen dataclass, and its function.

Nothing here imports JAX until a command runs, so that help and usage errors appear at once.

Exit status: 0 done; 1 unexpected error, or files could not be written; 2 invalid request (one line on stderr); 3 finished with
skipped files; 4 stopped on a non-finite number; 128 + its number after a signal (130 Ctrl-C, 143 SIGTERM), and 141 if the
reader of the output has exited.
"""

import errno
import functools
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jaxrl_vis
from jaxrl_vis.cli import audit, bench, doctor, encoder, envs, figure, search, sweep, train
from jaxrl_vis.cli.parsing import PROGRAM, parse
from jaxrl_vis.cli.trained import dataset, eval, export, play, push, verify
from jaxrl_vis.errors import (
    NonFiniteError,
    RequestError,
    StorageError,
    Terminated,
    WorkerError,
    is_out_of_memory,
    nearest,
)
from jaxrl_vis.host import distributed
from jaxrl_vis.host.streams import SafeStream, detach_broken_streams, reserve_standard_files, safe_streams
from jaxrl_vis.run.signals import Ending, signal_name

DESCRIPTION = "Trains robots to reach goals given only as images."
COMMANDS: dict[str, tuple[type, Callable[[Any], int]]] = {  # without those of `jaxrl_vis.stalks`, see `all_commands`
    "train": (train.Train, train.run),
    "eval": (eval.Eval, eval.run),
    "play": (play.Play, play.run),
    "export": (export.Export, export.run),
    "dataset": (dataset.Dataset, dataset.run),
    "push": (push.Push, push.run),
    "verify": (verify.Verify, verify.run),
    "audit": (audit.Audit, audit.run),
    "encoder": (encoder.Encoder, encoder.run),
    "envs": (envs.Envs, envs.run),
    "doctor": (doctor.Doctor, doctor.run),
    "bench": (bench.Bench, bench.run),
    "figure": (figure.Figure, figure.run),
    "sweep": (sweep.Sweep, sweep.run),
    "search": (search.Search, search.run),
}

_OUT_OF_MEMORY = (
    "memory of the device or machine ran out ({}). End other programs that use it (nvidia-smi lists those on a GPU), or use "
    "less: fewer --seeds, --num-envs, --replay-transitions or --workers, a smaller --batch-size. Saved files are good"
)
# Exit statuses of errors reported in one line.
_STATUS: dict[type[Exception], int] = {RequestError: 2, StorageError: 1, WorkerError: 1, NonFiniteError: 4}
# Commands whose output is their result; the others write files, and print messages about them.
_PRINT_RESULTS = ("eval", "audit", "envs", "doctor", "phenotype eval", "grasp eval")
_READER_LEFT = 141


def all_commands() -> dict[str, tuple[type, Callable[[Any], int]]]:
    """Return every command by name: `COMMANDS` and those of `jaxrl_vis.stalks`, which is imported only here."""
    from jaxrl_vis.stalks.cli import COMMANDS as STALK_COMMANDS

    return {**COMMANDS, **STALK_COMMANDS}


def overview(group: str = "") -> str:
    """Return the help of the whole program, or of the commands whose names begin with ``group``."""
    lines = [f"usage: {PROGRAM} [-h] [--version] COMMAND ...", "", DESCRIPTION, "", "commands:"]
    named = {name: command for name, (command, _) in all_commands().items() if name.startswith(group)}
    width = max(map(len, named))
    for name, command in named.items():
        lines.append(f"  {name:{width}} {(inspect.getdoc(command) or '').splitlines()[0]}")
    lines += ["", "options:", "  -h, --help  show this", "  --version   show the version"]
    return "\n".join([*lines, "", f"`{PROGRAM} COMMAND --help` lists the options of a command."])


def main(argv: Sequence[str] | None = None, force_exit: Callable[[int], None] | None = None) -> int:
    """Run one command. It continues despite output errors, and shuts down gracefully on signals (see `Ending`).

    Args:
        argv: Command line without the program's name; None for that of this process.
        force_exit: See `Ending`.

    Returns:
        The exit status.

    Raises:
        SystemExit: A command's help was printed.
    """
    argv = sys.argv[1:] if argv is None else argv
    with safe_streams() as printed, Ending(force_exit) as ending:
        try:
            status = _run_with_status(argv, ending)
        except SystemExit as end:
            printed.flush()
            if end.code or printed.failure is None:
                raise
            status = 0
        printed.flush()
        return _output_status(argv, printed) if status == 0 else status


def _run_with_status(argv: Sequence[str], ending: Ending) -> int:
    try:
        return _parse_command(argv)()
    except tuple(_STATUS) as error:
        if ending.signal is not None:  # which probably went to child processes as well
            return _report_signal(ending.signal)
        print(f"{PROGRAM}: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return next(status for kind, status in _STATUS.items() if isinstance(error, kind))
    except KeyboardInterrupt:
        return 130 if ending.signal is None else _report_signal(ending.signal)
    except Terminated as stop:  # from `Interruption`, which has reported what is saved
        return 128 + stop.signal if ending.signal is None else _report_signal(ending.signal)
    except Exception as error:
        if ending.signal is not None:
            return _report_signal(ending.signal)
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:  # from wherever a path was first used
            print(f"{PROGRAM}: {str(error.filename)[:80]}... cannot be used ({error.strerror})", file=sys.stderr)
            return _STATUS[RequestError]
        if is_out_of_memory(error) and not distributed.is_multi_process():
            words = (str(error) or "MemoryError").splitlines()[0][:100]
            print(f"{PROGRAM}: {_OUT_OF_MEMORY.format(words)}", file=sys.stderr)
            return 1
        if not distributed.is_multi_process():
            raise
        traceback.print_exc()
        print(
            f"{PROGRAM}: this process stops, and the others with it, unless one of them ended before. Saved files are good: "
            "start all of them again with --resume",
            file=sys.stderr,
        )
        return 1


# Python maps and unmaps memory when calls cross the end of a chunk of frames, often while tracing. The frame of this function
# needs half of a chunk of 2 MB; calls from it share the rest.
_run_with_status.__code__ = _run_with_status.__code__.replace(co_stacksize=131_072)


def _report_signal(number: int) -> int:
    print(f"{PROGRAM}: {signal_name(number)}: ended before it was done", file=sys.stderr)
    return 128 + number


def _output_status(argv: Sequence[str], printed: SafeStream) -> int:
    """Return the exit status of a successful command, considering errors of its output."""
    prints_result = " ".join(argv).startswith(_PRINT_RESULTS) or not argv or {"-h", "--help", "--version"} & set(argv)
    if not isinstance(printed.failure, OSError) or not prints_result:
        return 0
    if isinstance(printed.failure, BrokenPipeError):  # the reader has exited: `jaxrl-vis train --help | head`
        return _READER_LEFT
    print(f"{PROGRAM}: cannot write to stdout ({printed.failure.strerror}): redirect it", file=sys.stderr)
    return 1


def entry() -> None:
    """Run `main` and end this process.

    After a signal the process ends at once: everything is saved, and threads that still write a checkpoint, abandoned by a
    second signal, are not waited for.
    """
    reserve_standard_files()
    status = main(force_exit=lambda number: os._exit(_report_signal(number)))
    detach_broken_streams()
    if status == _STATUS[RequestError]:
        distributed.shut_down_together()
    if status > 128 or (status and distributed.is_multi_process()):
        os._exit(status)  # failed processes must not wait for each other
    sys.exit(status)


def split_command(argv: Sequence[str]) -> tuple[str, Sequence[str]]:
    """Split a command line into the command, of one word or more, and its arguments.

    Args:
        argv: At least one word.

    Raises:
        RequestError: There is no such command.
    """
    names = COMMANDS if argv[0] in COMMANDS else all_commands()
    for count in range(len(argv), 0, -1):
        name = " ".join(argv[:count])
        if name in names:
            return name, argv[count:]
    group = ""
    for word in argv:
        choices = _next_words(group, names)
        if word not in choices:
            kind = "option" if word.startswith("-") and not group else "command"
            raise RequestError(f"unknown {kind} {group + word!r}{nearest(word, choices)}")
        group += f"{word} "
    name = group.strip()
    raise RequestError(f"{name} what? Choose one of {', '.join(_next_words(group, names))} (or see {PROGRAM} {name} --help)")


def _next_words(group: str, names: Iterable[str]) -> list[str]:
    """List the words that may follow ``group``, which ends in a space unless it is empty, in names of commands."""
    return list(dict.fromkeys(name.removeprefix(group).split()[0] for name in names if name.startswith(group)))


def _parse_command(argv: Sequence[str]) -> Callable[[], int]:
    """Parse a command line, and return the function that runs the command; after printing help, one that does nothing."""
    if not argv:
        first = ", ".join(_next_words("", all_commands()))
        raise RequestError(f"no command given; choose one of {first} (or see {PROGRAM} --help)")
    if argv[0] in ("-h", "--help", "--version"):
        print(jaxrl_vis.__version__ if argv[0] == "--version" else overview())
        return _do_nothing
    if argv[-1] in ("-h", "--help") and argv[0] not in COMMANDS:
        group = " ".join(argv[:-1])
        names = all_commands()
        if group not in names and any(name.startswith(f"{group} ") for name in names):
            print(overview(f"{group} "))
            return _do_nothing
    name, rest = split_command(argv)
    command, run = (COMMANDS if name in COMMANDS else all_commands())[name]
    return functools.partial(run, parse(command, rest, name))


def _do_nothing() -> int:
    return 0
