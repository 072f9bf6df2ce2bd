"""Elements of studies: variants of a configuration, tasks and seeds. The studies: `indicator`, `ol_aux`."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

from jaxrl_vis.config import Config, preset, validate
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.studies.engine.cells import Cell, split_seeds


@dataclasses.dataclass(frozen=True)
class Variant:
    """Variant of a configuration, shown as a line of a figure.

    Attributes:
        label: Label in the figure.
        changes: Fields of `Config` that define it; ``{task}`` in a word stands for the environment.
        colour: Colour of its line.
    """

    label: str
    changes: Mapping[str, Any]
    colour: str


@dataclasses.dataclass(frozen=True)
class Family:
    """Family of studies on one subject, which share their run folders.

    Attributes:
        name: Name of the subject, and of the folder of its run folders.
        variants: Variants for figures, by name.
        tasks: Environments of the subject.
        preset: Default preset of the runs.
        of_task: (preset, environment) -> fields of `Config` that differ from the preset.
        max_steps: Preset -> environment -> maximum number of environment steps, for presets that need smaller budgets than the
            thesis.
        quick_changes: Changes of the preset ``cpu`` for `figure --quick`.
    """

    name: str
    variants: Mapping[str, Variant]
    tasks: tuple[str, ...]
    preset: str
    of_task: Mapping[tuple[str, str], Mapping[str, Any]]
    max_steps: Mapping[str, Mapping[str, int]]
    quick_changes: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Study:
    """Definition of a figure.

    Attributes:
        family: Family of the study.
        title: Title of the figure.
        variants: Names of its lines in the order of the legend, from `Family.variants`.
        steps: Environment -> environment steps of each run; these are the default tasks of the figure.
        shorter_steps: (environment, variant) -> environment steps of shorter runs.
        extra_variants: Variants that are trained for the tables only.
        optional_steps: Environment -> environment steps of optional tasks.
    """

    family: Family
    title: str
    variants: tuple[str, ...]
    steps: Mapping[str, int]
    shorter_steps: Mapping[tuple[str, str], int] = dataclasses.field(default_factory=dict)
    extra_variants: tuple[str, ...] = ()
    optional_steps: Mapping[str, int] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Scope:
    """Scope of a study's runs.

    Attributes:
        preset: Preset of every run.
        seed: First seed.
        seeds: Number of seeds.
        seeds_per_run: Maximum number of seeds in one program; None for all.
        env_steps: Budget of every run in environment steps; None for that of the study.
        changes: Fields of `Config` to change in every run.
    """

    preset: str = "paper"
    seed: int = 0
    seeds: int = 5
    seeds_per_run: int | None = None
    env_steps: int | None = None
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)


Cells = dict[tuple[str, str], list[Cell]]
"""Cells by (environment, variant), one for each group of seeds."""

# `debug` takes 4 gradient steps per iteration, which is not a multiple of OL-AUX-5's 5; 5 would not be one of TD3's 2.
_OF_PRESET: dict[str, dict[str, Any]] = {"debug": {"updates_per_iteration": 10}}
_DEFAULT_BUDGET = 1_500_000  # environment steps of a task without a budget in the study


def make_cells(study: Study, tasks: Sequence[str], variants: Sequence[str], scope: Scope) -> Cells:
    """Create the cells of a study, task by task.

    Args:
        study: The study.
        tasks: Environments, from its family's tasks.
        variants: Names of variants of its family.
        scope: Scope of the runs.

    Raises:
        RequestError: A task or variant is unknown, or a configuration is invalid.
    """
    for task in tasks:
        if task not in study.family.tasks:
            raise RequestError(f"unknown task {task!r}{nearest(task, list(study.family.tasks))}")
    for variant in variants:
        if variant not in study.family.variants:
            raise RequestError(f"unknown method {variant!r}{nearest(variant, list(study.family.variants))}")
    return {(task, variant): _cells(study, task, variant, scope) for task in tasks for variant in variants}


def _cells(study: Study, task: str, variant: str, scope: Scope) -> list[Cell]:
    config = preset(scope.preset, env=task, seed=scope.seed, seeds=scope.seeds)
    config = config.replace(**_OF_PRESET.get(scope.preset, {}), **study.family.of_task.get((scope.preset, task), {}))
    config = config.replace(env_steps=_budget(study, task, variant, scope, config))
    changes = study.family.variants[variant].changes
    own = {name: value.format(task=task) if isinstance(value, str) else value for name, value in changes.items()}
    changed = config.replace(**own).replace(**scope.changes)
    options = (re.sub(r"[^\w=.-]", "_", option) for option in changed.environment.env_options)  # for a folder's name
    family = "-".join((task, variant, scope.preset, *options))
    return split_seeds(Cell(family, validate(changed)), scope.seeds_per_run or scope.seeds)


def _budget(study: Study, task: str, variant: str, scope: Scope, config: Config) -> int:
    if scope.env_steps is not None:
        return scope.env_steps
    steps = study.shorter_steps.get((task, variant), {**study.optional_steps, **study.steps}.get(task, _DEFAULT_BUDGET))
    if scope.preset == study.family.preset:
        return steps
    return min(steps, study.family.max_steps.get(scope.preset, {}).get(task, config.run.env_steps))
