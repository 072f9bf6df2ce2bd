"""The command line: a thin layer over the Python API.

Nothing here imports JAX until a command runs, so that help and mistakes are answered at once.

Exit status: 0 done; 1 unexpected; 2 the request was wrong (one line on stderr); 4 stopped on a non-finite number; 130 Ctrl-C
and 143 SIGTERM, both after saving.
"""

import contextlib
import dataclasses
import importlib
import io
import json
import re
import sys
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

import jaxrl_vis
from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError, nearest

PROGRAM = "jaxrl-vis"
DESCRIPTION = "Trains robots to reach goals that are given as images."
Benchmark = Literal["render", "physics", "env", "update", "train"]


@dataclasses.dataclass(frozen=True)
class Train(Config):
    """Train on a task. Options that are not given come from the preset, or with --resume from the run."""

    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")] = "VisualFetchReach"
    """The task; `jaxrl-vis envs` lists them."""
    preset: str = "auto"
    """paper, fast, cpu or debug; auto is fast on an accelerator, else cpu."""
    run_dir: Path | None = None
    """Folder for metrics, images and checkpoints; a new one under runs/ if not given."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Go on from the newest full checkpoint in the run folder."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Start afresh in a run folder that exists."""


@dataclasses.dataclass(frozen=True)
class Eval:
    """Measure a trained run: success and distance at the last step, without exploration."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run folder."""
    episodes: int | None = None
    """Episodes; the run's own number if not given."""
    json: Path | None = None
    """Also write the figures here."""


@dataclasses.dataclass(frozen=True)
class Play:
    """Make a video of a trained run, observation beside goal."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run folder."""
    out: Path | None = None
    """A .gif, .mp4 or .html file; play.gif (play.html with --html) in the run folder if not given."""
    html: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show the robot and its goal in three dimensions: a page with brax's viewer (needs brax, and the network when opened)."""
    episodes: int = 6
    """Episodes to show."""


@dataclasses.dataclass(frozen=True)
class Envs:
    """List the tasks.

    chance is the share of episodes that random actions end in success, difficulty the mean distance from start to goal in
    thresholds.
    """

    env: tuple[str, ...] = ()
    """Only these tasks; all if not given."""
    gallery: Path | None = None
    """Also draw the image tasks here: start and goals as colours, depth and geoms."""
    image_size: int = 128
    """Height and width of an image of the gallery, in pixels."""
    goals: int = 4
    """Goals that the gallery shows of each task."""


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Say whether this installation works: versions, devices, one physics step, one image."""


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure this machine, keep a record, and print the change against the last record of the same device."""

    benchmark: tyro.conf.Positional[Benchmark | None] = None
    """What to measure: images, physics, both with resets, gradient steps, or whole training iterations."""
    check: tyro.conf.FlagCreatePairsOff[bool] = False
    """Measure nothing: list records whose code has changed since, and rows of the README that have no record."""
    tables: tyro.conf.FlagCreatePairsOff[bool] = False
    """Measure nothing: write the tables of the README from the records."""
    env: str = "VisualFetchReach"
    """The task."""
    envs: tuple[int, ...] = ()
    """Environments (or images) side by side, one measurement each; sizes that suit the device if not given."""
    image_size: int | None = None
    """Height and width of images; 64 on accelerators and 32 on a CPU if not given."""
    pixels: Literal["rgbd", "rgb", "depth"] | None = None
    """Channels; rgbd on accelerators and depth on a CPU if not given."""
    batch_size: int | None = None
    """Transitions in a gradient step (update)."""
    repeats: int = 5
    """Timed repeats; the median counts."""
    peer: Literal["mujoco", "warp", "playground"] | None = None
    """Measure another side by side: a renderer on the same poses (render), or MuJoCo Playground's FingerTurn (physics)."""
    scene: str | None = None
    """finger, fetch_reach, primitives or the path of an MJCF file: draw this, without a task; all three for a peer (render)."""
    json: Path | None = None
    """Also write this run's records here."""
    results: Path | None = None
    """Folder of kept records; benchmarks/results of the checkout (or here) if not given."""


COMMANDS: dict[str, type] = {"train": Train, "eval": Eval, "play": Play, "envs": Envs, "doctor": Doctor, "bench": Bench}


def scan_options(name: str, tokens: Sequence[str]) -> dict[str, str]:
    """The long options in ``tokens`` with their (first) values, checked against those of command ``name``.

    The parser would find the same mistakes, and say so in a box of its own; this says it in one line, with the nearest names.

    Raises:
        RequestError: An option is unknown, or its value is not one of its choices.
    """
    command = COMMANDS[name]
    hints = typing.get_type_hints(command)
    known = {"--help": bool, "--help-verbose": bool}
    for field in dataclasses.fields(command):
        option = field.name.replace("_", "-")
        known[f"--{option}"] = hints[field.name]
        if hints[field.name] is bool:
            known[f"--no-{option}"] = bool
    found = {}
    for index, token in enumerate(tokens):
        if not token.startswith("--"):
            continue
        option, equals, value = token.partition("=")
        option = option.replace("_", "-")
        if option not in known:
            near = nearest(option, list(known))
            near = near if "did you mean" in near else f"; see {PROGRAM} {name} --help"
            raise RequestError(f"unknown option {token}{near}")
        if not equals:
            value = tokens[index + 1] if index + 1 < len(tokens) else ""
        choices = _choices(known[option])
        if choices and value not in choices:
            raise RequestError(f"{option} cannot be {value!r}{nearest(value, choices)}")
        found[option] = value
    return found


def _choices(hint: Any) -> tuple[str, ...]:
    """The words that a Literal, or an optional Literal, allows; none for other types."""
    if typing.get_origin(hint) is Literal:
        return tuple(str(choice) for choice in typing.get_args(hint))
    return next((_choices(part) for part in typing.get_args(hint) if typing.get_origin(part) is Literal), ())


def parse(tokens: Sequence[str], base: Config | None = None) -> Any:
    """Reads a command line into one of the command records.

    Args:
        tokens: The arguments, without the program's name.
        base: Where training options that are not given come from; None reads the preset that the tokens name.

    Raises:
        RequestError: The request was wrong.
        SystemExit: Help was asked for and printed.
    """
    name = next((token for token in tokens if not token.startswith("-")), None)
    if tokens and not tokens[0].startswith("-"):
        if name not in COMMANDS:
            raise RequestError(f"unknown command {name!r}{nearest(str(name), list(COMMANDS))}")
        options = scan_options(name, tokens[1:])
        if name == "bench" and len(tokens) > 1 and not tokens[1].startswith("-"):
            benchmarks = typing.get_args(Benchmark)
            if tokens[1] not in benchmarks:
                raise RequestError(f"unknown benchmark {tokens[1]!r}{nearest(tokens[1], benchmarks)}")
        if name == "train" and base is None:
            base = _preset(options.get("--preset", "auto"))
    elif not tokens:
        raise RequestError(f"no command given; choose one of {', '.join(COMMANDS)} (or see {PROGRAM} --help)")
    commands = {word: tyro.conf.subcommand(word) for word in COMMANDS}
    if base is not None:
        commands["train"] = tyro.conf.subcommand("train", default=Train(**{**dataclasses.asdict(base), "preset": "auto"}))
    union: Any = typing.Union[tuple(Annotated[COMMANDS[word], settings] for word, settings in commands.items())]  # noqa: UP007
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                union, prog=PROGRAM, description=DESCRIPTION, args=list(tokens), config=(tyro.conf.OmitArgPrefixes,)
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise RequestError(flatten(complaint.getvalue())) from None


def flatten(box: str) -> str:
    """The parser's boxed complaint as one line, without the advice under the rule."""
    lines = []
    for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines():
        text = line.strip().strip("│╭╮╰╯").strip()
        if line.lstrip().startswith(("╭", "╰")):
            continue
        if text and set(text) <= {"─"}:
            break
        lines.append(text)
    return " ".join(" ".join(lines).split()) or "the command line could not be read"


def _preset(name: str) -> Config:
    """The named preset; ``auto`` stands in as ``fast`` where only names and help matter."""
    from jaxrl_vis.config import PRESETS

    if name != "auto" and name not in PRESETS:
        raise RequestError(f"unknown preset {name!r}{nearest(name, ['auto', *PRESETS])}")
    return PRESETS["fast" if name == "auto" else name]


def training_config(options: Train, tokens: Sequence[str]) -> Config:
    """The configuration that a ``train`` command asks for.

    Where neither a preset nor a saved run says what the other options are, the hardware does, which imports JAX.
    """
    name = options.preset
    if name == "auto" and options.resume and options.run_dir is not None and (options.run_dir / "config.json").exists():
        from jaxrl_vis.run.folder import read_config

        base = read_config(options.run_dir)
        name = base.preset
    else:
        if name == "auto":
            import jax

            name = "cpu" if jax.default_backend() == "cpu" else "fast"
        base = _preset(name)
    options = parse(tokens, base)
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(Config)}
    return Config(**{**values, "preset": name})


def check_env(name: str) -> None:
    """Raises a `RequestError` with the nearest names unless ``name`` is a task."""
    from jaxrl_vis_envs import list_envs

    names = tuple(list_envs())
    if name not in names:
        raise RequestError(f"unknown environment {name!r}{nearest(name, names)}")


def load_simulator() -> None:
    """Imports MuJoCo's JAX half, which tells stdout whenever Warp is missing; nothing here uses Warp."""
    with contextlib.redirect_stdout(io.StringIO()):
        importlib.import_module("mujoco.mjx")


def run_train(options: Train, tokens: Sequence[str]) -> int:
    """Trains; every report has already been shown and saved by the trainer."""
    if options.resume and options.overwrite:
        raise RequestError("--resume and --overwrite contradict each other; say one of them")
    config = training_config(options, tokens)
    check_env(config.env)
    load_simulator()
    from jaxrl_vis.run import trainer

    try:
        run = trainer.make_trainer(config, run_dir=options.run_dir, resume=options.resume, overwrite=options.overwrite)
        for _ in run.run():
            pass
    except trainer.NonFiniteError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 4
    except trainer.Terminated:
        return 143
    return 0


def _check_run(folder: Path) -> None:
    if not (folder / "config.json").exists():
        raise RequestError(f"{folder} is not a run folder (it holds no config.json); {PROGRAM} train makes one")


def run_eval(options: Eval, _: Sequence[str]) -> int:
    """Evaluates a run and prints its figures."""
    _check_run(options.run)
    load_simulator()
    from jaxrl_vis.run.trainer import evaluate_run

    figures = evaluate_run(options.run, episodes=options.episodes)
    for name, per_seed in figures.items():
        print(f"{name:28}" + "".join(f" {value:9.4f}" for value in per_seed))
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def run_play(options: Play, _: Sequence[str]) -> int:
    """Draws a run's episodes."""
    _check_run(options.run)
    out = options.out or options.run / ("play.html" if options.html else "play.gif")
    if options.episodes < 1:
        raise RequestError(f"--episodes must be at least 1, not {options.episodes}")
    load_simulator()
    from jaxrl_vis.run.trainer import play_run

    play_run(options.run, out, episodes=options.episodes, three_dimensional=options.html)
    print(out)
    return 0


def run_envs(options: Envs, _: Sequence[str]) -> int:
    """Prints the table of tasks, and draws the gallery."""
    for name in options.env:
        check_env(name)
    if options.goals < 1 or options.image_size < 1:
        raise RequestError("--goals and --image-size must be at least 1")
    load_simulator()
    from jaxrl_vis.report import gallery

    names = options.env or None
    gallery.print_table(names)
    if options.gallery is not None:
        gallery.draw(options.gallery, names, options.image_size, options.goals)
        print(options.gallery)
    return 0


def run_doctor(_: Doctor, __: Sequence[str]) -> int:
    """Checks the installation; 1 where something fails."""
    from jaxrl_vis import doctor

    return doctor.main()


def run_bench(options: Bench, _: Sequence[str]) -> int:
    """Runs one benchmark, or looks after the records; 1 where one of these is stale or missing."""
    if options.check or options.tables:
        return _keep_records(options)
    if options.benchmark is None:
        raise RequestError(f"no benchmark given; choose one of {', '.join(typing.get_args(Benchmark))}, --check or --tables")
    for option, benchmark in (("scene", "render"), ("peer", "physics" if options.peer == "playground" else "render")):
        value = getattr(options, option)
        if value is not None and options.benchmark != benchmark:
            raise RequestError(f"--{option} {value} goes with `bench {benchmark}` only")
    if any(count < 1 for count in options.envs) or options.repeats < 1:
        raise RequestError("--envs and --repeats must be at least 1")
    check_env(options.env)
    load_simulator()
    from jaxrl_vis import bench

    settings = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    del settings["check"], settings["tables"]
    bench.run(**settings)
    return 0


def _keep_records(options: Bench) -> int:
    if options.benchmark is not None:
        raise RequestError(f"--check and --tables measure nothing: leave out {options.benchmark}")
    from jaxrl_vis.bench import check, record, tables

    if options.tables:
        changed = tables.write_tables(check.README, options.results or record.results_folder())
        print(f"{check.README}: {'written' if changed else 'as it was'}")
    complaints = check.check(options.results) if options.check else []
    print("\n".join(complaints) if complaints or not options.check else "every record is of today's code, every row has one")
    return 1 if complaints else 0


RUNNERS: dict[type, Callable[[Any, Sequence[str]], int]] = {
    Train: run_train,
    Eval: run_eval,
    Play: run_play,
    Envs: run_envs,
    Doctor: run_doctor,
    Bench: run_bench,
}


def main(tokens: Sequence[str] | None = None) -> int:
    """Runs one command and returns the exit status."""
    tokens = sys.argv[1:] if tokens is None else tokens
    if list(tokens) == ["--version"]:
        print(jaxrl_vis.__version__)
        return 0
    try:
        options = parse(tokens)
        return RUNNERS[type(options)](options, tokens)
    except RequestError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
