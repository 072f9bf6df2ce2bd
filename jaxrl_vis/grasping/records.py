"""What `grasp eval` keeps of each run as JSON: how well it was perceived, the plan of its attempts, and what came of these.

Everything that follows is computed from what was kept, so that it is the same whether a run was evaluated now or before.
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.evaluation_pool import Record, RecordFile
from jaxrl_vis.grasping.attempts import Loop, Plan, carry_out, plan
from jaxrl_vis.grasping.evaluate import MaskScore, RunScore, draw_scene, score_scene, summary
from jaxrl_vis.grasping.masks.painter import Painter, read_weights
from jaxrl_vis.grasping.metric import Attempt, Score, Standing, score
from jaxrl_vis.grasping.perceive import Ways
from jaxrl_vis.provenance import device_name
from jaxrl_vis.run.policy import Policy
from jaxrl_vis_envs.plants import Family
from jaxrl_vis_envs.plants.stand import Stands

SCHEMA = 2
"""Of the records: those of another one cannot be gone on with."""
_DIGITS = 6  # of lengths in m


@dataclasses.dataclass(frozen=True)
class Conditions:
    """Under what conditions runs are evaluated.

    Attributes:
        family: What rows are drawn from.
        weights: Of the network that finds the pixels of stalks; None for true masks.
        ways: Which steps go as in the thesis.
        workers: How many processes share the machine; what is kept says so, as it bears on the time that a pair takes.
    """

    family: Family
    weights: Path | None = None
    ways: Ways = dataclasses.field(default_factory=Ways)
    workers: int = 1


def evaluate_run(conditions: Conditions, number: int) -> Record:
    """What is kept of one run, before an arm moves.

    Args:
        conditions: For all runs.
        number: Seed of the row.
    """
    scene = draw_scene(conditions.family, number)
    painter = None if conditions.weights is None else _painter(conditions.weights)
    found, perception = score_scene(scene, None if painter is None else lambda image, _: painter(image), conditions.ways)
    return {
        "stalks": found.true,
        "grasp_points": found.found,
        "hits": len(found.errors),
        "device": device_name(),
        "workers": conditions.workers,
        "score": _score_record(found),
        "plan": _plan_record(plan(scene, perception, number)),
        "plan_for_policy": _plan_record(plan(scene, perception, number, for_policy=True)),
    }


@functools.cache
def _painter(weights: Path) -> Painter:
    """One network for all runs of a process."""
    params, settings, _ = read_weights(weights)
    return Painter(params, settings)


def summary_of(records: Sequence[Record]) -> dict[str, Any]:
    """What the records of runs say together: the figures of `evaluate.summary`, and of all reaches that all of them have."""
    figures: dict[str, Any] = summary([score_of(record) for record in records])
    figures["devices"] = sorted({record["device"] for record in records})
    figures["workers"] = sorted({record["workers"] for record in records})
    known = [set(record.get("reaches", {})) for record in records]
    if known and (everywhere := set.intersection(*known)):
        figures["reaches"] = {name: figures_of(grasp_score(records, name)) for name in sorted(everywhere)}
    return figures


def figures_of(found: Score) -> dict[str, Any]:
    """A score as JSON."""
    shares = {each.name: {"count": each.count, "of": each.of, "interval": each.interval} for each in found.shares}
    return {"thesis_ratio": found.thesis_ratio, "shares": shares}


@dataclasses.dataclass(frozen=True)
class Reaches:
    """How all targets are gone to.

    Attributes:
        loop: Whether the arm looks again.
        wind_mm: How far stalks sway, mm.
        for_policy: Whether all loops have the scenes of the policy's task; see `attempts.plan`.
        policy: For that loop.
        policy_name: Of it.
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
        """Under what name its plan is kept."""
        return "plan_for_policy" if self.for_policy else "plan"


def reach_all(kept: RecordFile, numbers: Iterable[int], reaches: Reaches) -> None:
    """Sends the arm to all targets of the runs that were not carried out in this way yet, and keeps what came of it.

    Args:
        kept: The records of all runs.
        numbers: Which runs.
        reaches: How.
    """
    name = str(reaches)
    missing = [number for number in numbers if name not in kept.records[number].get("reaches", {})]
    plans = [plan_of(number, kept.records[number], reaches.plan) for number in missing]
    attempts = carry_out(plans, reaches.wind_mm, reaches.loop, reaches.policy)
    changed = {}
    for number in missing:
        record = kept.records[number]
        mine = {"plan": reaches.plan, "attempts": [_attempt_record(each) for each in attempts if each.run == number]}
        changed[number] = {**record, "reaches": {**record.get("reaches", {}), name: mine}}
    kept.add_all(changed)


def grasp_score(records: Iterable[Record], name: str) -> Score:
    """The score of what came of all reaches of one kind, named as `Reaches` are."""
    attempts, standing = [], []
    for record in records:
        number, found = int(record["number"]), record["reaches"][name]
        attempts += attempts_in(record, name)
        standing += plan_of(number, record, found["plan"]).standing
    return score(attempts, standing)


def _score_record(found: RunScore) -> Record:
    values = dataclasses.asdict(found)
    return {name: each.round(4).tolist() if isinstance(each, np.ndarray) else each for name, each in values.items()}


def score_of(record: Record) -> RunScore:
    """How well a run was perceived."""
    values, mask = record["score"], record["score"]["mask"]
    return RunScore(
        seed=values["seed"],
        true=values["true"],
        found=values["found"],
        errors=np.array(values["errors"], float),
        stitches=np.array(values["stitches"], float),
        refused=values["refused"],
        seconds=values["seconds"],
        mask=None if mask is None else MaskScore(**{**mask, "boundary": _number(mask["boundary"])}),
        notes=tuple(values["notes"]),
    )


def _stands_record(stands: Stands) -> Record:
    arrays = {field.name: getattr(stands, field.name) for field in dataclasses.fields(Stands)}
    return {name: each.astype(float).round(_DIGITS).tolist() for name, each in arrays.items()}


def _plan_record(made: Plan) -> Record:
    return {
        "targets": made.targets.round(_DIGITS).tolist(),
        "stalks": made.stalks.tolist(),
        "errors": made.errors.round(_DIGITS).tolist(),
        "sides": made.sides.tolist(),
        "refused": made.refused.tolist(),
        "again": made.again.round(_DIGITS).tolist(),
        "stands": _stands_record(made.stands),
        "seen": None if made.seen is None else _stands_record(made.seen),
        "standing": [
            [each.stalk, each.reachable, round(each.room, _DIGITS), round(each.neighbour, _DIGITS)] for each in made.standing
        ],
    }


def plan_of(number: int, record: Record, name: str = "plan") -> Plan:
    """A plan of a run.

    Args:
        number: Of the run.
        record: What was kept of it.
        name: Which plan.
    """
    values = record[name]
    return Plan(
        run=number,
        targets=np.array(values["targets"], float).reshape(-1, 3),
        stalks=np.array(values["stalks"], int),
        errors=np.array(values["errors"], float),  # not a number where there is None
        sides=np.array(values["sides"], float),
        refused=np.array(values["refused"], bool),
        again=np.array(values["again"], float).reshape(-1, 2),
        stands=_stands_of(values["stands"]),
        standing=tuple(
            Standing(number, stalk, reachable, *(np.inf if each is None else each for each in (room, neighbour)))
            for stalk, reachable, room, neighbour in values["standing"]
        ),
        seen=None if values["seen"] is None else _stands_of(values["seen"]),
    )


def _stands_of(values: Record) -> Stands:
    shapes = {"foot": (3,), "knee": (3,), "top": (3,), "radius": (2,), "bending_radius": (2,)}
    stalk = np.array(values["stalk"], np.int32)
    stalk = stalk.reshape(len(stalk), -1 if len(stalk) else 0)
    arrays = {name: np.array(values[name], np.float32).reshape(*stalk.shape, *shape) for name, shape in shapes.items()}
    return Stands(stalk=stalk, **arrays, origin=np.array(values["origin"], np.float32).reshape(-1, 3))


def _attempt_record(each: Attempt) -> Record:
    values = dataclasses.asdict(each)
    del values["run"]
    return {**values, "held": sorted(each.held)}


def attempts_in(record: Record, name: str) -> list[Attempt]:
    """What came of the reaches of one kind in a run."""
    return [_attempt_of(int(record["number"]), each) for each in record["reaches"][name]["attempts"]]


def _attempt_of(number: int, values: Record) -> Attempt:
    return Attempt(**{**values, "held": frozenset(values["held"]), "aim_error": _number(values["aim_error"])}, run=number)


def _number(value: float | None) -> float:
    return np.nan if value is None else value
