"""The command line: a thin layer over the Python API. One file a command: its options as a frozen dataclass, and what it does.

Nothing here imports JAX until a command runs, so that help and mistakes are answered at once.

Exit status: 0 done; 1 unexpected, or files could not be written; 2 the request was wrong (one line on stderr); 3 finished, with
files skipped; 4 stopped on a number that is not finite; 128 + its number after a signal (130 Ctrl-C, 143 SIGTERM), and 141
where the reader of what a command prints has left.
"""

import errno
import functools
import inspect
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jaxrl_vis
from jaxrl_vis import processes
from jaxrl_vis.cli import (
    bench,
    doctor,
    envs,
    eval,
    figure,
    grasp,
    grasp_eval,
    grasp_run,
    grasp_train,
    phenotype,
    phenotype_eval,
    phenotype_run,
    phenotype_train,
    play,
    sweep,
    train,
    verify,
)
from jaxrl_vis.cli.parsing import PROGRAM, parse
from jaxrl_vis.errors import NonFiniteError, RequestError, StorageError, Terminated, WorkerError, nearest
from jaxrl_vis.run.signals import Ending, name_of
from jaxrl_vis.streams import SafeStream, let_go_of_broken_streams, reserve_standard_files, safe_streams

DESCRIPTION = "Trains robots to reach goals that are given as images."
COMMANDS: dict[str, tuple[type, Callable[[Any], int]]] = {
    "train": (train.Train, train.run),
    "eval": (eval.Eval, eval.run),
    "play": (play.Play, play.run),
    "verify": (verify.Verify, verify.run),
    "envs": (envs.Envs, envs.run),
    "doctor": (doctor.Doctor, doctor.run),
    "bench": (bench.Bench, bench.run),
    "figure": (figure.Figure, figure.run),
    "sweep": (sweep.Sweep, sweep.run),
    "phenotype synth": (phenotype.Synth, phenotype.synth),
    "phenotype train": (phenotype_train.Train, phenotype_train.train),
    "phenotype run": (phenotype_run.Run, phenotype_run.run),
    "phenotype eval": (phenotype_eval.Eval, phenotype_eval.evaluate),
    "grasp synth": (grasp.Synth, grasp.synth),
    "grasp train": (grasp_train.Train, grasp_train.train),
    "grasp run": (grasp_run.Run, grasp_run.run),
    "grasp eval": (grasp_eval.Eval, grasp_eval.evaluate),
}

# Of the errors that are told in one line.
_STATUS: dict[type[Exception], int] = {RequestError: 2, StorageError: 1, WorkerError: 1, NonFiniteError: 4}
# All other commands write files, and what they print is no more than a word about them.
_PRINT_RESULTS = ("eval", "envs", "doctor", "phenotype eval", "grasp eval")
_READER_LEFT = 141


def overview(group: str = "") -> str:
    """The help of the program as a whole, or of the commands of two words that begin with ``group``."""
    lines = [f"usage: {PROGRAM} [-h] [--version] COMMAND ...", "", DESCRIPTION, "", "commands:"]
    named = {name: command for name, (command, _) in COMMANDS.items() if name.startswith(group)}
    width = max(map(len, named))
    for name, command in named.items():
        lines.append(f"  {name:{width}} {(inspect.getdoc(command) or '').splitlines()[0]}")
    lines += ["", "options:", "  -h, --help  show this", "  --version   show the version"]
    return "\n".join([*lines, "", f"`{PROGRAM} COMMAND --help` lists the options of a command."])


def main(words: Sequence[str] | None = None, give_up: Callable[[int], None] | None = None) -> int:
    """Runs one command. Nothing that is printed can end it, and signals end it in order.

    Args:
        words: The command line without the program's name; None: that of this process.
        give_up: See `Ending`.

    Returns:
        The exit status.

    Raises:
        SystemExit: A command's help was asked for, and printed.
    """
    words = sys.argv[1:] if words is None else words
    with safe_streams() as printed, Ending(give_up) as ending:
        try:
            status = _status_of(words, ending)
        except SystemExit as end:
            printed.flush()
            if end.code or printed.failure is None:
                raise
            status = 0
        printed.flush()
        return _status_of_printing(words, printed) if status == 0 else status


def _status_of(words: Sequence[str], ending: Ending) -> int:
    try:
        return _command(words)()
    except tuple(_STATUS) as error:
        if ending.signal is not None:  # which went to children as well, most likely
            return _ended_by(ending.signal)
        print(f"{PROGRAM}: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return next(status for kind, status in _STATUS.items() if isinstance(error, kind))
    except KeyboardInterrupt:
        return 130 if ending.signal is None else _ended_by(ending.signal)
    except Terminated as stop:  # from `Interruption`, where it was told what is saved
        return 128 + stop.signal if ending.signal is None else _ended_by(ending.signal)
    except Exception as error:
        if ending.signal is not None:
            return _ended_by(ending.signal)
        if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:  # wherever a path was first looked at
            print(f"{PROGRAM}: {str(error.filename)[:80]}... cannot be used ({error.strerror})", file=sys.stderr)
            return _STATUS[RequestError]
        if not processes.are_several():
            raise
        traceback.print_exc()
        print(
            f"{PROGRAM}: this process stops, and the others with it, unless one of them ended before. What was saved is good: "
            "start all of them again with --resume",
            file=sys.stderr,
        )
        return 1


def _ended_by(number: int) -> int:
    print(f"{PROGRAM}: {name_of(number)}: ended before it was done", file=sys.stderr)
    return 128 + number


def _status_of_printing(words: Sequence[str], printed: SafeStream) -> int:
    """The exit status of a command that has done its work, as to what became of what it printed."""
    prints_result = " ".join(words).startswith(_PRINT_RESULTS) or not words or {"-h", "--help", "--version"} & set(words)
    if not isinstance(printed.failure, OSError) or not prints_result:
        return 0
    if isinstance(printed.failure, BrokenPipeError):  # has seen enough: `jaxrl-vis train --help | head`
        return _READER_LEFT
    print(f"{PROGRAM}: cannot write to stdout ({printed.failure.strerror}): send it elsewhere", file=sys.stderr)
    return 1


def entry() -> None:
    """The program: `main`, and the end of this process.

    After a signal the process ends at once: what was to be saved is saved, and threads that still write a checkpoint, which a
    second signal has given up, are not waited for.
    """
    reserve_standard_files()
    status = main(give_up=lambda number: os._exit(_ended_by(number)))
    let_go_of_broken_streams()
    if status == _STATUS[RequestError]:
        processes.leave_together()
    if status > 128 or (status and processes.are_several()):
        os._exit(status)  # of several processes that failed, none must wait for the others
    sys.exit(status)


def command_of(words: Sequence[str]) -> tuple[str, Sequence[str]]:
    """Splits a command line into the command, of one word or of two, and what follows it.

    Args:
        words: At least one word.

    Raises:
        RequestError: There is no such command.
    """
    name, *rest = words
    if name in COMMANDS:
        return name, rest
    seconds = [each.partition(" ")[2] for each in COMMANDS if each.startswith(f"{name} ")]
    if not seconds:
        kind = "option" if name.startswith("-") else "command"
        raise RequestError(f"unknown {kind} {name!r}{nearest(name, dict.fromkeys(each.split()[0] for each in COMMANDS))}")
    if not rest:
        raise RequestError(f"{name} what? Choose one of {', '.join(seconds)} (or see {PROGRAM} {name} --help)")
    if rest[0] not in seconds:
        raise RequestError(f"unknown command '{name} {rest[0]}'{nearest(rest[0], seconds)}")
    return f"{name} {rest[0]}", rest[1:]


def _command(words: Sequence[str]) -> Callable[[], int]:
    """Read a command line, and return the command with its options; what is left to do after help is nothing."""
    if not words:
        first = dict.fromkeys(each.split()[0] for each in COMMANDS)
        raise RequestError(f"no command given; choose one of {', '.join(first)} (or see {PROGRAM} --help)")
    if words[0] in ("-h", "--help", "--version"):
        print(jaxrl_vis.__version__ if words[0] == "--version" else overview())
        return _nothing
    if len(words) > 1 and words[1] in ("-h", "--help") and any(each.startswith(f"{words[0]} ") for each in COMMANDS):
        print(overview(f"{words[0]} "))
        return _nothing
    name, rest = command_of(words)
    command, run = COMMANDS[name]
    return functools.partial(run, parse(command, rest, name))


def _nothing() -> int:
    return 0
