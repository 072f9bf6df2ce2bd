"""Command ``jaxrl-vis train``: train a policy, or resume its run."""

import dataclasses
import importlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any

from jaxrl_vis.cli.checks import check_counts, check_env, may_run_code
from jaxrl_vis.cli.parsing import AlsoPositional, DefaultText, FieldsOf
from jaxrl_vis.config import OPTIONS, PRESETS, Config, preset, validate
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host import distributed, streams
from jaxrl_vis.host.devices import check_devices, claim_memory, guess_accelerator, parse_device_count, start_devices
from jaxrl_vis.host.plugins import custom_names
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.run.loggers import group
from jaxrl_vis.run.loggers.group import LoggerName
from jaxrl_vis.run.storage.folder import check_resumable, default_folder, read_config


def describe_default(name: str) -> str:
    """Describe a field's default: its value in this machine's ``auto`` preset, and the presets with other values."""
    current = _auto_preset(guess_accelerator())
    values = {preset_name: config.value(name) for preset_name, config in PRESETS.items()}
    words = {
        preset_name: " ".join(map(str, value)) or "none" if isinstance(value, tuple) else str(value)
        for preset_name, value in values.items()
    }
    others = ", ".join(f"{preset_name} {word}" for preset_name, word in words.items() if word != words[current])
    return f"default: {words[current]}" + (f"; {others}" if others else "")


def _auto_preset(on_accelerator: bool) -> str:
    """Return the preset that ``auto`` stands for."""
    return "fast" if on_accelerator else "cpu"


def describe_default_preset() -> str:
    """Describe the default of ``--preset`` for the help."""
    return (
        f"default: auto, which is {_auto_preset(guess_accelerator())} on this machine; its values are the defaults shown below"
    )


@dataclasses.dataclass(frozen=True)
class Train:
    """Train on an environment. Options that are not given come from the preset, or with --resume from the run."""

    env: Annotated[str | None, AlsoPositional()] = None
    """Environment: a name listed by `jaxrl-vis envs`, or module:Name for a custom one; VisualFetchReach if not given."""
    preset: Annotated[str, DefaultText(describe_default_preset)] = "auto"
    """paper, fast, cpu or debug, some with task-specific values (docs/configuration.md); auto is fast on an accelerator, else
    cpu."""
    changes: Annotated[Mapping[str, Any], FieldsOf(Config, describe_default)] = dataclasses.field(default_factory=dict)
    devices: str | None = None
    """Number of devices, or all (docs/scaling.md), over which seeds are distributed or, with a single seed, batches and
    environments; if not given, one, or all with several processes."""
    run_dir: Path | None = None
    """Folder for metrics, images and checkpoints; a new one under runs/ if not given."""
    show_config: bool = False
    """Print the complete configuration, with the source of each value, and train nothing."""
    resume: bool = False
    """Continue from the newest checkpoint in an existing run folder."""
    overwrite: bool = False
    """Delete the run in an existing run folder and start again."""
    coordinator: str | None = None
    """Address of the first of several processes that train together, as HOST:PORT; not needed under srun and mpirun."""
    num_processes: int | None = None
    """Number of processes that train together, with --coordinator."""
    process_id: int | None = None
    """Index of this process, from 0; the first one writes metrics and images."""
    start_timeout: int = distributed.START_S
    """Time limit for the processes to find each other at the start, s."""
    trust: bool = False
    """With --resume: execute the run's custom code (module:Name) without asking, even if it was not trained here."""
    log: tuple[LoggerName, ...] = ()
    """Also log to TensorBoard or Weights & Biases; with --resume, the run's own loggers if not given."""


def training_config(options: Train) -> Config:
    """Build the requested configuration: the given options, and the rest from a saved run or a preset.

    If neither is named, the preset depends on the hardware, which requires importing JAX.

    Raises:
        RequestError: There is no such preset, or the saved run cannot be read.
    """
    changes = dict(options.changes) | ({} if options.env is None else {"env": options.env})
    if options.devices is not None:
        from jaxrl_vis.run.signals import shielded_children

        with shielded_children():
            changes["devices"] = parse_device_count(options.devices)
    name = options.preset
    if name not in ("auto", *PRESETS):
        raise RequestError(f"unknown preset {name!r}{nearest(name, ['auto', *PRESETS])}")
    if name == "auto" and options.resume and options.run_dir is not None and (options.run_dir / "config.json").exists():
        return read_config(options.run_dir).replace(**changes)
    if name == "auto":
        import jax

        from jaxrl_vis.run.signals import shielded_children

        with shielded_children():  # so that threads started by JAX never receive signals
            start_devices()
            importlib.import_module("jaxrl_vis.run.trainer")  # needed later, and takes as long
            check_devices()
            name = _auto_preset(jax.default_backend() != "cpu")
    return preset(name, **changes)


def config_lines(config: Config, set_options: Collection[str]) -> list[str]:
    """List a configuration, group by group: the value of each option, and the source of those that are not defaults.

    Args:
        config: Configuration.
        set_options: Names of the options that were given.
    """
    name, environment = config.run.preset, config.environment
    of_preset, of_task = PRESETS[name], preset(name, env=environment.env, method=config.reward.method)
    of_algorithm = preset(name, env=environment.env, method=config.reward.method, algorithm=config.run.algorithm)
    lines, group = [], ""
    for option, value in config.flat().items():
        if OPTIONS[option].group != group:
            group = OPTIONS[option].group
            lines += ["", f"[{group}]"]
        source = ""
        if option in set_options or value != of_algorithm.value(option):
            source = "given"
        elif value != of_task.value(option) and option != "algorithm":
            source = f"preset {name}, for {config.run.algorithm}"
        elif value != of_preset.value(option):
            source = f"preset {name}, for {environment.env}"
        elif value != OPTIONS[option].default and option != "preset":
            source = f"preset {name}"
        shown = " ".join(map(str, _as_tuple(value))) or "none"
        lines.append(f"{option:27} {shown:24} {source}".rstrip())
    return lines[1:]


def _as_tuple(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


def run(options: Train) -> int:
    """Train, or with ``show_config`` print the configuration; the trainer prints and saves its reports."""
    check_counts(start_timeout=options.start_timeout)
    claim_memory()
    rank = distributed.find_rank(options.coordinator, options.num_processes, options.process_id)
    if rank is not None:
        distributed.start(rank, options.start_timeout)
        options = dataclasses.replace(options, devices=options.devices or "all")
    if options.resume and options.overwrite:
        raise RequestError("--resume and --overwrite contradict each other; give one of them")
    group.check(options.log)
    if options.run_dir is not None:
        check_resumable(options.run_dir, options.resume)
    if options.env is not None:
        check_env(options.env, options.changes.get("env_folder"))
    config = validate(training_config(options))
    if options.show_config:
        streams.echo("\n".join(config_lines(config, set(options.changes))))
        return 0
    run_dir = options.run_dir or default_folder(config)
    check_resumable(run_dir, options.resume)
    if options.resume and "env_folder" not in options.changes and (run_dir / "config.json").exists():
        named = {options.env, *(word for value in options.changes.values() for word in _as_tuple(value))}
        if set(custom_names(config).values()) - named:
            may_run_code(run_dir, options.trust)  # the custom part is named by the run, not by the user
    check_env(config.environment.env, config.environment.env_folder)
    from jaxrl_vis.run import trainer

    check_writable(run_dir, "--run-dir", folder=True)
    run_trainer = trainer.make_trainer(
        config,
        options.run_dir,
        resume=options.resume,
        overwrite=options.overwrite,
        log=options.log or None,
        cache_programs=True,
    )
    for _ in run_trainer.run():
        pass
    return 0
