"""The command line: a thin layer over the Python API. One file a command: its options as a frozen dataclass, and what it does.

Nothing here imports JAX until a command runs, so that help and mistakes are answered at once.

Exit status: 0 done; 1 unexpected, or files could not be written; 2 the request was wrong (one line on stderr); 3 finished, with
files skipped; 4 stopped on a number that is not finite; 130 Ctrl-C and 143 SIGTERM, both after saving.
"""

import errno
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
)
from jaxrl_vis.cli.parsing import PROGRAM, parse
from jaxrl_vis.errors import NonFiniteError, RequestError, StorageError, Terminated, nearest

DESCRIPTION = "Trains robots to reach goals that are given as images."
COMMANDS: dict[str, tuple[type, Callable[[Any], int]]] = {
    "train": (train.Train, train.run),
    "eval": (eval.Eval, eval.run),
    "play": (play.Play, play.run),
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
_STATUS: dict[type[Exception], int] = {RequestError: 2, StorageError: 1, NonFiniteError: 4}


def overview(group: str = "") -> str:
    """The help of the program as a whole, or of the commands of two words that begin with ``group``."""
    lines = [f"usage: {PROGRAM} [-h] [--version] COMMAND ...", "", DESCRIPTION, "", "commands:"]
    named = {name: command for name, (command, _) in COMMANDS.items() if name.startswith(group)}
    width = max(map(len, named))
    for name, command in named.items():
        lines.append(f"  {name:{width}} {(inspect.getdoc(command) or '').splitlines()[0]}")
    lines += ["", "options:", "  -h, --help  show this", "  --version   show the version"]
    return "\n".join([*lines, "", f"`{PROGRAM} COMMAND --help` lists the options of a command."])


def main(words: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        words: The command line without the program's name; None: that of this process.

    Returns:
        The exit status.

    Raises:
        SystemExit: A command's help was asked for, and printed.
    """
    words = sys.argv[1:] if words is None else words
    try:
        return _run(words)
    except tuple(_STATUS) as error:
        print(f"{PROGRAM}: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return next(status for kind, status in _STATUS.items() if isinstance(error, kind))
    except KeyboardInterrupt:
        return 130
    except Terminated as stop:
        return int(stop.code or 0)
    except Exception as error:
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


def entry() -> None:
    """The program: `main`, and the end of this process.

    After a signal the process ends at once: what was to be saved is saved, and threads that still write a checkpoint, which a
    second signal has given up, are not waited for.
    """
    try:
        status = main()
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read what is printed has seen enough: `jaxrl-vis train --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python flushes at its end
        status = 141
    sys.stderr.flush()
    if status == _STATUS[RequestError]:
        processes.leave_together()
    if status in (130, 143) or (status and processes.are_several()):
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


def _run(words: Sequence[str]) -> int:
    if not words:
        first = dict.fromkeys(each.split()[0] for each in COMMANDS)
        raise RequestError(f"no command given; choose one of {', '.join(first)} (or see {PROGRAM} --help)")
    if words[0] in ("-h", "--help", "--version"):
        print(jaxrl_vis.__version__ if words[0] == "--version" else overview())
        return 0
    if len(words) > 1 and words[1] in ("-h", "--help") and any(each.startswith(f"{words[0]} ") for each in COMMANDS):
        print(overview(f"{words[0]} "))
        return 0
    name, rest = command_of(words)
    command, run = COMMANDS[name]
    return run(parse(command, rest, name))
