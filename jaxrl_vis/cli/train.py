"""``jaxrl-vis train``."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxrl_vis.cli.checks import check_env
from jaxrl_vis.cli.parsing import ChangesOf
from jaxrl_vis.config import PRESETS, Config, preset, validate
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.run import loggers
from jaxrl_vis.run.loggers import LoggerName


def _defaults(name: str) -> str:
    """What the presets say about a field: what ``fast`` says, and after it those that differ from it."""
    values = {each: getattr(config, name) for each, config in PRESETS.items()}
    words = {
        each: " ".join(map(str, value)) or "none" if isinstance(value, tuple) else str(value) for each, value in values.items()
    }
    others = ", ".join(f"{each} {word}" for each, word in words.items() if word != words["fast"])
    return f"default: {words['fast']}" + (f"; {others}" if others else "")


@dataclasses.dataclass(frozen=True)
class Train:
    """Train on an environment. Options that are not given come from the preset, or with --resume from the run."""

    env: Annotated[str | None, tyro.conf.Positional] = None
    """The environment; `jaxrl-vis envs` lists them. VisualFetchReach if not given."""
    preset: str = "auto"
    """paper, fast, cpu or debug; auto is fast on an accelerator, else cpu."""
    changes: Annotated[Mapping[str, Any], ChangesOf(Config, _defaults)] = dataclasses.field(default_factory=dict)
    run_dir: Path | None = None
    """Folder for metrics, images and checkpoints; a new one under runs/ if not given."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder."""
    overwrite: bool = False
    """Start afresh in a run folder that exists."""
    log: tuple[LoggerName, ...] = ()
    """Show the run in TensorBoard or in Weights & Biases, too; those of the run if not given with --resume."""


def training_config(options: Train) -> Config:
    """The configuration that a command asks for: what it gives, and the rest from a saved run or a preset.

    Where neither says what the rest is, the hardware does, which imports JAX.

    Raises:
        RequestError: There is no such preset, or the saved run cannot be read.
    """
    changes = dict(options.changes) | ({} if options.env is None else {"env": options.env})
    name = options.preset
    if name not in ("auto", *PRESETS):
        raise RequestError(f"unknown preset {name!r}{nearest(name, ['auto', *PRESETS])}")
    if name == "auto" and options.resume and options.run_dir is not None and (options.run_dir / "config.json").exists():
        from jaxrl_vis.run.folder import read_config

        return read_config(options.run_dir).replace(**changes)
    if name == "auto":
        import jax

        from jaxrl_vis.run.signals import shielded_children

        with shielded_children():  # threads that JAX starts with its first use of a device never see signals
            name = "cpu" if jax.default_backend() == "cpu" else "fast"
    return preset(name, **changes)


def run(options: Train) -> int:
    """Trains; every report has already been shown and saved by the trainer."""
    if options.resume and options.overwrite:
        raise RequestError("--resume and --overwrite contradict each other; give one of them")
    loggers.check(options.log)
    if options.env is not None:
        check_env(options.env)
    config = validate(training_config(options))
    check_env(config.env)
    from jaxrl_vis.run import trainer
    from jaxrl_vis.run.folder import default_folder

    check_writable(options.run_dir or default_folder(config), "--run-dir", folder=True)
    log = options.log or None
    made = trainer.make_trainer(config, options.run_dir, resume=options.resume, overwrite=options.overwrite, log=log)
    for _ in made.run():
        pass
    return 0
