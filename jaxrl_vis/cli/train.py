"""``jaxrl-vis train``."""

import dataclasses
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from jaxrl_vis import processes
from jaxrl_vis.cli.checks import check_counts, check_env, may_run_code
from jaxrl_vis.cli.parsing import ByPlaceToo, ChangesOf, SayDefault
from jaxrl_vis.config import PRESETS, Config, preset
from jaxrl_vis.devices import check_devices, claim_memory, count_devices, guess_accelerator, start_devices
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.plugins import own_names
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.run import loggers
from jaxrl_vis.run.folder import check_there, default_folder, read_config
from jaxrl_vis.run.loggers import LoggerName
from jaxrl_vis.validation import validate


def default_of(name: str) -> str:
    """What the presets say about a field: what ``auto`` takes on this machine, and after it those that differ from that."""
    here = _auto(guess_accelerator())
    values = {each: getattr(config, name) for each, config in PRESETS.items()}
    words = {
        each: " ".join(map(str, value)) or "none" if isinstance(value, tuple) else str(value) for each, value in values.items()
    }
    others = ", ".join(f"{each} {word}" for each, word in words.items() if word != words[here])
    return f"default: {words[here]}" + (f"; {others}" if others else "")


def _auto(on_accelerator: bool) -> str:
    """The preset that suits the hardware."""
    return "fast" if on_accelerator else "cpu"


def default_preset() -> str:
    """What the help says about ``--preset``."""
    return f"default: auto, which is {_auto(guess_accelerator())} on this machine; its values are the defaults shown below"


@dataclasses.dataclass(frozen=True)
class Train:
    """Train on an environment. Options that are not given come from the preset, or with --resume from the run."""

    env: Annotated[str | None, ByPlaceToo()] = None
    """The environment; `jaxrl-vis envs` lists them, and module:Name is one of your own. VisualFetchReach if not given."""
    preset: Annotated[str, SayDefault(default_preset)] = "auto"
    """paper, fast, cpu or debug, which may have settings of their own for a task (docs/configuration.md); auto is fast on an
    accelerator, else cpu."""
    changes: Annotated[Mapping[str, Any], ChangesOf(Config, default_of)] = dataclasses.field(default_factory=dict)
    devices: str | None = None
    """How many devices to use, or all (docs/scaling.md). Several seeds are divided among them; of one seed, each batch and the
    environments are. One if not given."""
    run_dir: Path | None = None
    """Folder for metrics, images and checkpoints; a new one under runs/ if not given."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder, which must be there."""
    overwrite: bool = False
    """Start afresh in a run folder that exists."""
    coordinator: str | None = None
    """Where several processes that train as one find the first of them, as HOST:PORT; not needed under srun and mpirun."""
    num_processes: int | None = None
    """How many such processes there are."""
    process_id: int | None = None
    """Which of them this is, from 0; the first writes metrics and images."""
    start_timeout: int = processes.START_S
    """How long they wait for each other at the start, s."""
    trust: bool = False
    """With --resume: run the run's own code without a question, where its task is module:Name and somebody else began it."""
    log: tuple[LoggerName, ...] = ()
    """Show the run in TensorBoard or in Weights & Biases, too; those of the run if not given with --resume."""


def training_config(options: Train) -> Config:
    """The configuration that a command asks for: what it gives, and the rest from a saved run or a preset.

    Where neither says what the rest is, the hardware does, which imports JAX.

    Raises:
        RequestError: There is no such preset, or the saved run cannot be read.
    """
    changes = dict(options.changes) | ({} if options.env is None else {"env": options.env})
    if options.devices is not None:
        from jaxrl_vis.run.signals import shielded_children

        with shielded_children():
            changes["devices"] = count_devices(options.devices)
    name = options.preset
    if name not in ("auto", *PRESETS):
        raise RequestError(f"unknown preset {name!r}{nearest(name, ['auto', *PRESETS])}")
    if name == "auto" and options.resume and options.run_dir is not None and (options.run_dir / "config.json").exists():
        return read_config(options.run_dir).replace(**changes)
    if name == "auto":
        import jax

        from jaxrl_vis.run.signals import shielded_children

        with shielded_children():  # threads that JAX starts with its first use of a device never see signals
            start_devices()
            importlib.import_module("jaxrl_vis.run.trainer")  # will be needed, and takes as long
            check_devices()
            name = _auto(jax.default_backend() != "cpu")
    return preset(name, **changes)


def _words(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def run(options: Train) -> int:
    """Trains; every report has already been shown and saved by the trainer."""
    check_counts(start_timeout=options.start_timeout)
    claim_memory()
    place = processes.find_place(options.coordinator, options.num_processes, options.process_id)
    if place is not None:
        processes.start(place, options.start_timeout)
        options = dataclasses.replace(options, devices=options.devices or "all")
    if options.resume and options.overwrite:
        raise RequestError("--resume and --overwrite contradict each other; give one of them")
    loggers.check(options.log)
    if options.run_dir is not None:
        check_there(options.run_dir, options.resume)
    if options.env is not None:
        check_env(options.env, options.changes.get("env_folder"))
    config = validate(training_config(options))
    run_dir = options.run_dir or default_folder(config)
    check_there(run_dir, options.resume)
    if options.resume and "env_folder" not in options.changes and (run_dir / "config.json").exists():
        named = {options.env, *(word for value in options.changes.values() for word in _words(value))}
        if set(own_names(config).values()) - named:
            may_run_code(run_dir, options.trust)  # its user named neither such a part nor where it lies: the run does
    check_env(config.env, config.env_folder)
    from jaxrl_vis.run import trainer

    check_writable(run_dir, "--run-dir", folder=True)
    made = trainer.make_trainer(
        config,
        options.run_dir,
        resume=options.resume,
        overwrite=options.overwrite,
        log=options.log or None,
        keep_programs=True,
    )
    for _ in made.run():
        pass
    return 0
