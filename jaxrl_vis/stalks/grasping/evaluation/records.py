"""Records of `grasp eval` as JSON: score of the perception, plans of the attempts, and their results for each run.

Summaries are computed from the stored records alone, so that they do not depend on when a run was evaluated.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxrl_vis
import jaxrl_vis.stalks.grasping
import jaxrl_vis_envs.plants
from jaxrl_vis.host.provenance import device_name
from jaxrl_vis.host.worker_pool import Record, RecordFile, code_digest, evaluate_all
from jaxrl_vis.run.trained.policy import Policy
from jaxrl_vis.stalks.digests import value_digest
from jaxrl_vis.stalks.grasping.evaluation.attempts import Loop, Plan, execute_plans, plan
from jaxrl_vis.stalks.grasping.evaluation.grasp_score import Attempt, Score, TrueStalk, score
from jaxrl_vis.stalks.grasping.evaluation.scoring import MaskScore, RunScore, draw_scene, score_scene, summarize_scores
from jaxrl_vis.stalks.grasping.masks.loading import load_painter
from jaxrl_vis.stalks.grasping.perception.perceive import Variant
from jaxrl_vis_envs.plants import Family
from jaxrl_vis_envs.plants.stand import Stands

SCHEMA = 2
"""Schema of the records; files with another one cannot be resumed."""
_DIGITS = 6  # decimal places of lengths in m
# Files and folders that train networks or draw figures and videos: changes there keep records valid.
_CHANGES_NO_RECORD = ("examples.py", "mask_training.py", "variation.py", "report")


@dataclasses.dataclass(frozen=True)
class Conditions:
    """Conditions under which runs are evaluated.

    Attributes:
        family: Family that rows are sampled from.
        weights: Weights file of the mask network; None for true masks.
        masks: Name of that network, or ``truth``.
        variant: Steps that follow the thesis.
        workers: Number of processes that share the machine; stored in the records because it affects the time per pair.
    """

    family: Family
    weights: Path | None = None
    masks: str = "truth"
    variant: Variant = dataclasses.field(default_factory=Variant)
    workers: int = 1


def evaluate_runs(
    conditions: Conditions,
    numbers: Sequence[int],
    path: Path | None,
    started: Callable[[int], None],
    done: Callable[[int, Record], None],
) -> RecordFile:
    """Evaluate the perception of runs and plan their attempts, in parallel processes; `reach_all` carries these out.

    Args:
        conditions: Conditions of all runs.
        numbers: Seeds of the rows.
        path: JSON file of the records, written after each run; None for no file. Runs that it already holds are not evaluated
            again.
        started: Called once with the number of runs that the file already holds.
        done: Called after each run with its number and record.

    Returns:
        The records of all runs.

    Raises:
        RequestError: The file holds records of another evaluation, or cannot be read.
        WorkerError: A worker process was ended from outside.
    """
    about = {
        "synthetic": True,
        "version": jaxrl_vis.__version__,
        "schema": SCHEMA,
        "code": code_digest(jaxrl_vis_envs.plants, jaxrl_vis.stalks.grasping, leave_out=_CHANGES_NO_RECORD),
        "family": conditions.family.name,
        "family_digest": value_digest(dataclasses.asdict(conditions.family)),
        "masks": conditions.masks,
        "method": str(conditions.variant),
    }
    table = RecordFile(path, about, summarize)
    missing = [number for number in numbers if number not in table]
    started(len(numbers) - len(missing))

    def keep(number: int, record: Record) -> None:
        table.add(number, record)
        done(number, table.records[number])

    evaluate_all(functools.partial(evaluate_run, conditions), missing, conditions.workers, keep)
    return table


def evaluate_run(conditions: Conditions, number: int) -> Record:
    """Evaluate the perception of one run, plan its attempts, and return its record, without reaches.

    Args:
        conditions: Conditions of all runs.
        number: Seed of the row.

    Raises:
        RequestError: The weights cannot be read.
    """
    scene = draw_scene(conditions.family, number)
    painter = None if conditions.weights is None else load_painter(conditions.weights)
    score, perception = score_scene(scene, None if painter is None else lambda image, _: painter(image), conditions.variant)
    return {
        "stalks": score.true,
        "grasp_points": score.detected,
        "hits": len(score.errors),
        "device": device_name(),
        "workers": conditions.workers,
        "score": _score_record(score),
        "plan": _plan_record(plan(scene, perception, number)),
        "plan_for_policy": _plan_record(plan(scene, perception, number, for_policy=True)),
    }


def summarize(records: Sequence[Record]) -> dict[str, Any]:
    """Summarize the records of runs, as values for JSON.

    Returns:
        The metrics of `summarize_scores`, ``devices`` and ``workers`` of the records, and under ``reaches`` the scores of those
        `Reaches` that all records hold, by name.
    """
    metrics: dict[str, Any] = summarize_scores([read_score(record) for record in records])
    metrics["devices"] = sorted({record["device"] for record in records})
    metrics["workers"] = sorted({record["workers"] for record in records})
    known = [set(record.get("reaches", {})) for record in records]
    if known and (everywhere := set.intersection(*known)):
        metrics["reaches"] = {name: score_metrics(grasp_score(records, name)) for name in sorted(everywhere)}
    return metrics


def score_metrics(score: Score) -> dict[str, Any]:
    """Return the thesis's ratio and all proportions of a score, with counts and intervals, as values for JSON."""
    proportions = {
        proportion.name: {"count": proportion.count, "of": proportion.total, "interval": proportion.interval}
        for proportion in score.proportions
    }
    return {"thesis_ratio": score.thesis_ratio, "shares": proportions}


@dataclasses.dataclass(frozen=True)
class Reaches:
    """Control loop, wind and planning of simulated reaches; ``str`` gives their name in the records.

    Attributes:
        loop: Control loop of the arm: open, with repeated detection, or a policy.
        wind_mm: Amplitude of the stalks' sway, mm.
        for_policy: True if attempts are planned as in the policy's task, for any loop; see `attempts.plan`.
        policy: Policy of the loop ``policy``; None for the others.
        policy_name: Name of the policy in the records; empty without one.
    """

    loop: Loop
    wind_mm: float
    for_policy: bool = False
    policy: Policy | None = None
    policy_name: str = ""

    def __str__(self) -> str:
        scenes = ", nearest stop" if self.for_policy else ""
        return f"{self.loop}{' ' + self.policy_name if self.loop == 'policy' else ''}, wind {self.wind_mm:g} mm{scenes}"

    @property
    def plan(self) -> str:
        """Key of the plan in a record."""
        return "plan_for_policy" if self.for_policy else "plan"


def reach_all(table: RecordFile, numbers: Iterable[int], reaches: Reaches) -> None:
    """Simulate reaches in the runs whose records lack them, and add the attempts to the records.

    Args:
        table: Records of all runs, changed in place and written to their file.
        numbers: Numbers of the runs.
        reaches: Control loop, wind and planning of the reaches.

    Raises:
        RequestError: The policy is not one of VisualStalkReach, or does not observe single images.
    """
    name = str(reaches)
    missing = [number for number in numbers if name not in table.records[number].get("reaches", {})]
    plans = [read_plan(number, table.records[number], reaches.plan) for number in missing]
    attempts = execute_plans(plans, reaches.wind_mm, reaches.loop, reaches.policy)
    changed = {}
    for number in missing:
        record = table.records[number]
        mine = {"plan": reaches.plan, "attempts": [_attempt_record(attempt) for attempt in attempts if attempt.run == number]}
        changed[number] = {**record, "reaches": {**record.get("reaches", {}), name: mine}}
    table.add_all(changed)


def grasp_score(records: Iterable[Record], name: str) -> Score:
    """Return the score of the reaches in all records that have a ``name``, the string of their `Reaches`.

    Raises:
        KeyError: A record lacks these reaches.
    """
    attempts, standing = [], []
    for record in records:
        number, reaches = int(record["number"]), record["reaches"][name]
        attempts += attempts_in(record, name)
        standing += read_plan(number, record, reaches["plan"]).standing
    return score(attempts, standing)


def _score_record(score: RunScore) -> Record:
    values = dataclasses.asdict(score)
    values["found"] = values.pop("detected")
    return {name: value.round(4).tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def read_score(record: Record) -> RunScore:
    """Return the score of a run's perception from its record."""
    values, mask = record["score"], record["score"]["mask"]
    return RunScore(
        seed=values["seed"],
        true=values["true"],
        detected=values["found"],
        errors=np.array(values["errors"], float),
        stitches=np.array(values["stitches"], float),
        refused=values["refused"],
        seconds=values["seconds"],
        mask=None if mask is None else MaskScore(**{**mask, "boundary": _number(mask["boundary"])}),
        notes=tuple(values["notes"]),
    )


def _stands_record(stands: Stands) -> Record:
    arrays = {field.name: getattr(stands, field.name) for field in dataclasses.fields(Stands)}
    return {name: array.astype(float).round(_DIGITS).tolist() for name, array in arrays.items()}


def _plan_record(plan: Plan) -> Record:
    return {
        "targets": plan.targets.round(_DIGITS).tolist(),
        "stalks": plan.stalks.tolist(),
        "errors": plan.errors.round(_DIGITS).tolist(),
        "sides": plan.sides.tolist(),
        "refused": plan.refused.tolist(),
        "again": plan.redetection_errors.round(_DIGITS).tolist(),
        "stands": _stands_record(plan.stands),
        "seen": None if plan.detected is None else _stands_record(plan.detected),
        "standing": [
            [stalk.stalk, stalk.reachable, round(stalk.room, _DIGITS), round(stalk.neighbour, _DIGITS)]
            for stalk in plan.standing
        ],
    }


def read_plan(number: int, record: Record, name: str = "plan") -> Plan:
    """Return a plan of a run from its record.

    Args:
        number: Number of the run.
        record: Record of the run.
        name: Key of the plan in the record.
    """
    values = record[name]
    return Plan(
        run=number,
        targets=np.array(values["targets"], float).reshape(-1, 3),
        stalks=np.array(values["stalks"], int),
        errors=np.array(values["errors"], float),  # None becomes NaN
        sides=np.array(values["sides"], float),
        refused=np.array(values["refused"], bool),
        redetection_errors=np.array(values["again"], float).reshape(-1, 2),
        stands=_read_stands(values["stands"]),
        standing=tuple(
            TrueStalk(number, stalk, reachable, *(np.inf if length is None else length for length in (room, neighbour)))
            for stalk, reachable, room, neighbour in values["standing"]
        ),
        detected=None if values["seen"] is None else _read_stands(values["seen"]),
    )


def _read_stands(values: Record) -> Stands:
    shapes = {"foot": (3,), "knee": (3,), "top": (3,), "radius": (2,), "bending_radius": (2,)}
    stalk = np.array(values["stalk"], np.int32)
    stalk = stalk.reshape(len(stalk), -1 if len(stalk) else 0)
    arrays = {name: np.array(values[name], np.float32).reshape(*stalk.shape, *shape) for name, shape in shapes.items()}
    return Stands(stalk=stalk, **arrays, origin=np.array(values["origin"], np.float32).reshape(-1, 3))


def _attempt_record(attempt: Attempt) -> Record:
    values = dataclasses.asdict(attempt)
    del values["run"]
    return {**values, "held": sorted(attempt.held)}


def attempts_in(record: Record, name: str) -> list[Attempt]:
    """Return the attempts in the record of a run whose reaches have a ``name``, the string of their `Reaches`."""
    return [_read_attempt(int(record["number"]), values) for values in record["reaches"][name]["attempts"]]


def _read_attempt(number: int, values: Record) -> Attempt:
    return Attempt(**{**values, "held": frozenset(values["held"]), "aim_error": _number(values["aim_error"])}, run=number)


def _number(value: float | None) -> float:
    return np.nan if value is None else value
