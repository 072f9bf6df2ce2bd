"""Figures 5.4 to 5.7 of the thesis: which runs they are made of. See `grid` for how these are trained, `figures` for the rest.

    5.4   no auxiliary losses, gradient balancing, cosine similarity, OL-AUX-5
    5.5   each auxiliary task alone, with gradient balancing, and OL-AUX-5
    5.6   weights of OL-AUX-5 over training
    5.7   OL-AUX-5, its ablation, OL-AUX-1

Every figure also has a run without auxiliary losses, which speed-ups refer to. Runs are shared between figures.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from jaxrl_vis.config import Config, preset, validate
from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.methods import AuxTaskName
from jaxrl_vis.studies.cells import Cell, split_seeds

AUX_TASKS: tuple[str, ...] = get_args(AuxTaskName)
_ALL: dict[str, Any] = {"aux_tasks": AUX_TASKS}


@dataclasses.dataclass(frozen=True)
class Variant:
    """One line of a figure.

    Attributes:
        label: What the figure calls it.
        changes: Fields of `Config` that make it.
        colour: Of its line.
    """

    label: str
    changes: Mapping[str, Any]
    colour: str


_AUX_COLOURS = dict(zip(AUX_TASKS, ("#3b5bdb", "#a61e8c", "#b4531f", "#6b7a1f", "#1f8fb0"), strict=True))

VARIANTS: dict[str, Variant] = {
    "none": Variant("no auxiliary losses", {}, "#5b626c"),
    "none_log": Variant("none, log of the main loss", {"weighting": "none_log"}, "#9aa1ab"),
    "sum": Variant("plain sum", _ALL | {"weighting": "sum"}, "#c28f00"),
    **{
        f"fixed_{weight:g}": Variant(
            f"fixed weights {weight:g}", _ALL | {"weighting": "fixed", "weighting_fixed": weight}, colour
        )
        for weight, colour in ((0.1, "#d98a8a"), (1.0, "#c25555"), (10.0, "#8f2424"))
    },
    "balance": Variant("gradient balancing", _ALL | {"weighting": "balance"}, "#3b5bdb"),
    "cosine": Variant("cosine similarity", _ALL | {"weighting": "cosine"}, "#b4531f"),
    "ol_aux_5": Variant("OL-AUX-5", _ALL | {"weighting": "ol_aux", "weighting_interval": 5}, "#0f7b6c"),
    "ol_aux_5_ablation": Variant(
        "OL-AUX-5 (ablation)", _ALL | {"weighting": "ol_aux_ablation", "weighting_interval": 5}, "#3b5bdb"
    ),
    "ol_aux_1": Variant("OL-AUX-1", _ALL | {"weighting": "ol_aux", "weighting_interval": 1}, "#a61e8c"),
    **{
        name: Variant(f"{name.replace('_', ' ')} alone", {"aux_tasks": (name,), "weighting": "balance"}, _AUX_COLOURS[name])
        for name in AUX_TASKS
    },
}
"""Everything that a figure can show, by name."""

FETCH, HAND, FINGER = "VisualFetchReach", "VisualHandReach", "VisualFingerTurn"
LEVELS: dict[str, tuple[float, ...]] = {FETCH: (0.5, 0.9), FINGER: (0.3, 0.5, 0.9), HAND: (0.2, 0.3, 0.4)}
"""Environment -> shares of success of which tables say when they are reached."""

# The authors stacked no images of the finger, and evaluated these two every 40 k steps.
_OF_TASK: dict[tuple[str, str], dict[str, Any]] = {
    ("paper", FINGER): {"frame_stack": 1, "eval_interval": 10},
    ("paper", HAND): {"eval_interval": 10},
}
# `debug` makes 4 gradient steps per iteration, which OL-AUX-5 does not divide.
_OF_PRESET: dict[str, dict[str, Any]] = {"debug": {"updates_per_iteration": 5}}
QUICK: dict[str, Any] = {
    **{"env_steps": 19_200, "updates_per_iteration": 100, "batch_size": 64},
    **{"eval_interval": 1, "eval_episodes": 64},
}
"""What `figure --quick` changes in the preset ``cpu``: six evaluations, 600 gradient steps."""


@dataclasses.dataclass(frozen=True)
class Study:
    """What a figure shows.

    Attributes:
        title: The figure's first line.
        variants: Its lines, in the order of the legend; names of `VARIANTS`.
        steps: Environment -> environment steps of each run.
        shorter: (environment, variant) -> those of runs that are shorter.
        extra: Variants that are trained for the tables, and not drawn.
    """

    title: str
    variants: tuple[str, ...]
    steps: Mapping[str, int]
    shorter: Mapping[tuple[str, str], int] = dataclasses.field(default_factory=dict)
    extra: tuple[str, ...] = ()


STUDIES: dict[str, Study] = {
    "5.4": Study(
        "Auxiliary losses, and how they are weighted",
        ("none", "balance", "cosine", "ol_aux_5"),
        {FETCH: 250_000, HAND: 2_000_000, FINGER: 2_500_000},
        {(FINGER, "balance"): 1_500_000, (FINGER, "cosine"): 1_500_000},
    ),
    "5.5": Study(
        "Single auxiliary tasks, and OL-AUX-5 with all of them",
        (*AUX_TASKS, "ol_aux_5"),
        {FETCH: 250_000, HAND: 1_000_000, FINGER: 1_000_000},
        extra=("none",),
    ),
    "5.6": Study(
        "Weights of the auxiliary losses in OL-AUX-5",
        ("ol_aux_5",),
        {FETCH: 250_000, HAND: 2_000_000, FINGER: 2_500_000},
    ),
    "5.7": Study(
        "What OL-AUX-5 owes to looking ahead",
        ("ol_aux_1", "ol_aux_5_ablation", "ol_aux_5"),
        {FETCH: 250_000, HAND: 600_000},
        extra=("none",),
    ),
}

# Presets that learn faster than the authors' release need no budget like its.
_LONGEST: dict[str, dict[str, int]] = {"fast": {FETCH: 100_000, HAND: 2_000_000, FINGER: 1_000_000}}


@dataclasses.dataclass(frozen=True)
class Scope:
    """How a study is run.

    Attributes:
        preset: The preset of every run.
        seed: First seed.
        seeds: How many.
        seeds_per_run: At most so many side by side in one program; None: all.
        env_steps: Budget of every run, in the place of the study's own.
        changes: Fields of `Config` to change in every run.
    """

    preset: str = "paper"
    seed: int = 0
    seeds: int = 5
    seeds_per_run: int | None = None
    env_steps: int | None = None
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)


Cells = dict[tuple[str, str], list[Cell]]
"""(environment, variant) -> the cells that make it, one for each group of seeds."""


def cells_of(study: Study, tasks: Sequence[str], variants: Sequence[str], scope: Scope) -> Cells:
    """The cells of a study, task after task.

    Raises:
        RequestError: There is no such task or variant, or a configuration makes no sense.
    """
    for task in tasks:
        if task not in LEVELS:
            raise RequestError(f"unknown task {task!r}{nearest(task, list(LEVELS))}")
    for variant in variants:
        if variant not in VARIANTS:
            raise RequestError(f"unknown method {variant!r}{nearest(variant, list(VARIANTS))}")
    return {(task, variant): _cells(study, task, variant, scope) for task in tasks for variant in variants}


def _cells(study: Study, task: str, variant: str, scope: Scope) -> list[Cell]:
    config = preset(scope.preset, env=task, seed=scope.seed, seeds=scope.seeds)
    config = config.replace(**_OF_PRESET.get(scope.preset, {}), **_OF_TASK.get((scope.preset, task), {}))
    config = config.replace(env_steps=_budget(study, task, variant, scope, config))
    changed = config.replace(**VARIANTS[variant].changes).replace(**scope.changes)
    family = f"{task}-{variant}-{scope.preset}"
    return split_seeds(Cell(family, validate(changed)), scope.seeds_per_run or scope.seeds)


def _budget(study: Study, task: str, variant: str, scope: Scope, config: Config) -> int:
    if scope.env_steps is not None:
        return scope.env_steps
    steps = study.shorter.get((task, variant), study.steps.get(task, 1_500_000))
    if scope.preset == "paper":
        return steps
    return min(steps, _LONGEST.get(scope.preset, {}).get(task, config.env_steps))
