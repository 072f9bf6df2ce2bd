"""README table of figures compared with alternative software, written from the records."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.claims import ol_aux
from benchmarks.ledger import evidence
from benchmarks.ledger.records import RESULTS, read_all
from benchmarks.ledger.tables.lab_results import MISSING, find_record, format_short
from benchmarks.ledger.tables.lab_rows import DEVICES, Figure
from jaxrl_vis.report.learning import curve, steps_to
from jaxrl_vis.studies.figures.authors import released_curves

_LEARNT = 0.9  # success rate at which environment steps are compared


@dataclasses.dataclass(frozen=True)
class Rate:
    """Row of the table: our rate and a peer's, measured in one call.

    Attributes:
        label: Text of the first column.
        ours: Name of our record.
        peer: Name of the peer's record; among several variants, the one least favourable to us counts.
        config: Required entries of both configurations.
        device: Column of the speed table.
        unit: Unit of the rate, without "per second".
        peer_name: Name of the peer.
    """

    label: str
    ours: str
    peer: str
    config: dict[str, Any]
    device: str
    unit: str
    peer_name: str


_IMAGE = {"image_size": 64, "pixels": "rgbd"}
_LABELLED = {"image_size": 64, "pixels": "rgbds"}

RATES = (
    Rate(
        "Images of VisualFetchReach, 64x64 RGB-D, on an H200",
        *("render/scene", "render/peer_warp", {"scene": "fetch_reach", **_IMAGE}, "H200", "images", "MuJoCo Warp"),
    ),
    Rate(
        "Images of MuJoCo Warp's own scene of 127 geoms, likewise",
        *("render/scene", "render/peer_warp", {"scene": "primitives", **_IMAGE}, "H200", "images", "MuJoCo Warp"),
    ),
    Rate(
        "Images of 500 meshes with shadows and labels, likewise",
        *("render/scene", "render/peer_warp", {"scene": "clutter", "shadows": True, **_LABELLED}, "H200", "images"),
        "MuJoCo Warp",
    ),
    Rate(
        "Images of a Fetch arm with its own meshes, 64x64 RGB-D and labels, on an H100",
        *("render/scene", "render/peer_warp", {"scene": "fetch_mesh", **_LABELLED}, "H100", "images", "MuJoCo Warp"),
    ),
    Rate(
        "Images of VisualFetchReach on two CPU cores",
        *("render/scene", "render/peer_mujoco", {"scene": "fetch_reach", **_IMAGE}, "2 CPU cores", "images"),
        "`mujoco.Renderer`",
    ),
    Rate(
        "DDPG on batches of 512 such images, `paper`, on an H100",
        *("update/gradient_steps", "update/peer_torch", {"preset": "paper", **_IMAGE}, "H100", "updates"),
        "PyTorch, compiled",
    ),
)


def _rate_cells(row: Rate, records: list[dict[str, Any]]) -> tuple[str, str, str] | None:
    """Format our rate, the peer's and their ratio; None without records."""
    device = DEVICES[row.device]
    theirs = find_record(Figure(row.peer, row.config, "", minimum_of="ours_over_peer"), device, records)
    if theirs is None:
        return None
    same = {name: value for name, value in theirs["config"].items() if name != "images"}  # batch sizes may differ
    ours = find_record(Figure(row.ours, same, ""), device, records)
    if ours is None:
        return None
    rates = [f"{format_short(record['value'])} {row.unit}/s" for record in (ours, theirs)]
    return rates[0], f"{row.peer_name}: {rates[1]}", f"{theirs['details']['ours_over_peer']:.3g} times"


def _learning_cells(results: Path) -> tuple[str, str, str] | None:
    """Format environment steps to a success rate: ours, the authors' release's, and their ratio; None without records."""
    run = evidence.load("fetch_reach_oracle", results)
    if run is None:
        return None
    ours = steps_to(curve(run.rows, "eval/success"), _LEARNT)
    repetition = ol_aux.run(ol_aux.FETCH, "ol_aux_5")
    repeated = repetition.steps_to(_LEARNT)
    theirs = steps_to(released_curves()[ol_aux.FETCH, "ol_aux_5"], _LEARNT)
    if ours is None or repeated is None or theirs is None:
        return None
    fast, paper = (_steps_per_update(rows) for rows in (run.rows, repetition.rows))
    here = (
        f"{format_short(ours)} steps with `fast`, {fast} an update; "
        f"{format_short(repeated)} with the authors' settings, {paper} an update"
    )
    return here, f"the authors' release, OL-AUX-5: {format_short(theirs)} steps", f"{theirs / ours:.3g} times fewer"


def _steps_per_update(rows: Sequence[dict[str, Any]]) -> int:
    last = max(rows, key=lambda row: row["env_steps"])
    return round(last["env_steps"] / last["updates"])


def comparison_table(results: Path = RESULTS) -> str:
    """Return the table of README.md and docs/index.md as Markdown."""
    return "\n".join(_lines(results))


def _lines(results: Path) -> Iterator[str]:
    records = [record for _, record in read_all(results) if record["name"] != evidence.NAME]
    rows = {row.label: _rate_cells(row, records) for row in RATES}
    label = f"VisualFetchReach learnt from images to {100 * _LEARNT:.0f} % success"
    rows[label] = _learning_cells(results)
    yield "| measurement | jaxrl-vis | alternative | ratio |"
    yield "|---|---|---|---|"
    for label, cells in rows.items():
        yield f"| {label} | {' | '.join(cells or (MISSING, '', ''))} |"
