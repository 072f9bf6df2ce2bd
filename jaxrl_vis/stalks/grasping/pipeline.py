"""Batch processing from folders of pairs to grasp points: `run` reads, perceives and writes, and resumes if interrupted.

    OUT/run.json                 the request: a folder holds the results of one request
        runs/RUN.json            result of one run and state of its input files; computed again only if these change, or if
                                 pairs were skipped
        overlays/RUN.png         last left image with its stalks in red and the grasp points
        points.csv  runs.csv  skipped.csv

Tables are always built from the files under runs/. Only one run is in memory at a time.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import jaxrl_vis
from jaxrl_vis.stalks.grasping.perception.cloud import Mount
from jaxrl_vis.stalks.grasping.perception.perceive import Perception, Variant, View, perceive
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
from jaxrl_vis.stalks.phenotyping.io.images import write_image
from jaxrl_vis.stalks.phenotyping.io.names import file_name
from jaxrl_vis.stalks.phenotyping.io.pair_reading import UnusablePairError, read_pair
from jaxrl_vis.stalks.phenotyping.io.tables.odometry import odometry_file, read_odometries
from jaxrl_vis.stalks.phenotyping.report.tables import Row, write_rows
from jaxrl_vis.stalks.results_folder import claim_folder, file_state, is_current, pair_state, write_record
from jaxrl_vis_envs.documents import read_json
from jaxrl_vis_envs.plants import Calibration

Find = Callable[[np.ndarray, PlotFolder, PairFiles], np.ndarray]
"""Function from a left image [H, W, 3] uint8 and its files to the mask of the near row's stalks, [H, W] bool."""
Reachable = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function from points [B, 3] and stops [S, 3], m in the robot frame of the last stop, to [B] bool, True within reach."""

RUN_COLUMNS = (
    "run",
    "pairs",
    "pairs_skipped",
    "driven_m",
    "stitches",
    "stitches_refused",
    "stitch_residual_mm",
    "grasp_points",
    "reachable",
    "seconds_per_pair",
    "flag",
    "method",
    "version",
)
POINT_COLUMNS = (
    "run",
    "point",
    "x_m",
    "y_m",
    "z_m",
    "lean_deg",
    "diameter_mm",
    "pairs",
    "spread_mm",
    "reachable",
    "method",
    "version",
)
SKIPPED_COLUMNS = ("run", "pair", "why")


@dataclasses.dataclass(frozen=True)
class Request:
    """Request for the results of runs.

    Attributes:
        out: Folder of the results.
        variant: Steps that follow the thesis.
        finder: Name of the mask network; part of the request, so that results of different networks are not mixed.
        calibrations: Calibration of each run, by the run's name.
        mount: Mount of the pair.
        speed: Speed of the robot, m/s, for runs whose odometry holds times but no distances; None if there are none.
        reachable: Function that returns True for points within the arm's reach; None without an arm.
    """

    out: Path
    variant: Variant
    finder: str
    calibrations: dict[str, Calibration]
    mount: Mount
    speed: float | None = None
    reachable: Reachable | None = None

    @property
    def method(self) -> str:
        """Name of the variant, as written to the tables."""
        return str(self.variant)


def run(runs: list[PlotFolder], find: Find, request: Request, done: Callable[[Row], None] = lambda row: None) -> list[Row]:
    """Perceive runs and write their results; runs that are already up to date are not computed again.

    Args:
        runs: Folders of pairs.
        find: Function that returns the mask of a pair.
        request: Request, with the folder of the results.
        done: Called after each run with its row of runs.csv, also if the run was up to date.

    Returns:
        A row for each pair that was skipped: run, pair, and reason.

    Raises:
        RequestError: The folder holds other results, or a run's odometry cannot be read.
        OSError: A file cannot be written.
    """
    driven = read_odometries(runs, request.speed)
    claim_folder(
        request.out,
        "runs",
        runs,
        request.calibrations,
        {
            "method": request.method,
            "finder": request.finder,
            "speed": request.speed,
            "mount": dataclasses.asdict(request.mount),
            "reachable": request.reachable is not None,
        },
        any(request.out.glob("runs/*.json")),
    )
    rows: list[Row] = []
    points: list[Row] = []
    skipped: list[Row] = []
    (request.out / "runs").mkdir(exist_ok=True)
    for plot in runs:
        path = request.out / "runs" / file_name(f"{plot.name}.json")
        sources = _sources(plot)  # before the files are read: they may be replaced meanwhile
        if not is_current(path, sources, _is_complete):
            write_record(path, _make_record(plot, driven[plot.name], find, request), sources)
        record = read_json(path)
        rows, points, skipped = [*rows, record["row"]], points + record["points"], skipped + record["skipped"]
        write_rows(request.out / "runs.csv", RUN_COLUMNS, rows)
        write_rows(request.out / "points.csv", POINT_COLUMNS, points)
        write_rows(request.out / "skipped.csv", SKIPPED_COLUMNS, skipped)
        done(record["row"])
    return skipped


def _sources(plot: PlotFolder) -> dict[str, Any]:
    """Return the state of the files that the record of a run depends on: its odometry and the files of each pair."""
    return {
        "odometry": file_state(odometry_file(plot.folder)),
        "pairs": {pair.name: pair_state(pair) for pair in plot.pairs},
    }


def _is_complete(record: dict[str, Any]) -> bool:
    """Return True for a record with all columns and no skipped pairs; others are computed again."""
    known = record["row"].keys() == set(RUN_COLUMNS) and all(row.keys() == set(POINT_COLUMNS) for row in record["points"])
    return known and record["skipped"] == []


def _make_record(plot: PlotFolder, distances: dict[str, float] | None, find: Find, request: Request) -> dict[str, Any]:
    """Compute the record of one run, and write its overlay.

    Args:
        plot: Folder of the run.
        distances: Distance driven at each pair by the pair's name, m; None if unknown.
        find: Function that returns the mask of a pair.
        request: The request.

    Returns:
        The row of the run, and the rows of its points and of skipped pairs.
    """
    calibration = request.calibrations[plot.name]
    views: list[View] = []
    skipped: list[Row] = []
    for number, pair in enumerate(plot.pairs):
        try:
            left, right = read_pair(pair, calibration)
        except UnusablePairError as problem:
            skipped.append({"run": plot.name, "pair": pair.name, "why": str(problem)})
            continue
        views.append(View(number, left, right, None if distances is None else distances.get(pair.name)))
    if not views:
        return {"row": _make_row(plot, request, len(skipped), None, views), "points": [], "skipped": skipped}
    perception = perceive(
        views, lambda image, number: find(image, plot, plot.pairs[number]), calibration, request.mount, request.variant
    )
    (request.out / "overlays").mkdir(exist_ok=True)
    overlay = draw_points(views[-1].left, perception, calibration, request.mount)
    write_image(request.out / "overlays" / file_name(f"{plot.name}.png"), overlay)
    points = _point_rows(plot, request, perception)
    return {"row": _make_row(plot, request, len(skipped), perception, views), "points": points, "skipped": skipped}


def _can_reach(request: Request, perception: Perception) -> np.ndarray | None:
    """Return [B] bool, True for grasp points within the arm's reach from any stop; None without an arm."""
    if request.reachable is None:
        return None
    points = np.array([point.point for point in perception.points]).reshape(-1, 3)
    stops = np.array([motion.shift for motion in perception.to_last])
    return np.asarray(request.reachable(points, stops), bool)


def _make_row(plot: PlotFolder, request: Request, skipped: int, perception: Perception | None, views: list[View]) -> Row:
    """Return the row of runs.csv for a run; ``perception`` is None if none of its pairs was usable."""
    row: Row = dict.fromkeys(RUN_COLUMNS, "")
    row |= {"run": plot.name, "pairs": len(views), "pairs_skipped": skipped, "grasp_points": 0}
    row |= {"method": request.method, "version": jaxrl_vis.__version__}
    if perception is None:
        return row | {"flag": "no usable pairs"}
    known = [view.driven for view in views if view.driven is not None]
    residuals = [step.residual for step in perception.stitches if math.isfinite(step.residual)]
    can = _can_reach(request, perception)
    notes = ([f"pairs skipped: {skipped}"] if skipped else []) + list(perception.notes)
    if can is not None and len(can) and not can.any():
        notes.append("no stalk is within reach")
    return row | {
        "driven_m": f"{max(known) - min(known):.4f}" if len(known) == len(views) else "",
        "stitches": len(perception.stitches),
        "stitches_refused": sum(bool(step.refused) for step in perception.stitches),
        "stitch_residual_mm": f"{1e3 * np.median(residuals):.2f}" if residuals else "",
        "grasp_points": len(perception.points),
        "reachable": "" if can is None else int(can.sum()),
        "seconds_per_pair": f"{sum(perception.seconds.values()) / len(views):.3f}",
        "flag": "; ".join(notes) or "ok",
    }


def _point_rows(plot: PlotFolder, request: Request, perception: Perception) -> list[Row]:
    """Return the rows of points.csv for the grasp points of a run, in the robot frame of its last pair."""
    can = _can_reach(request, perception)
    rows = []
    for index, point in enumerate(perception.points):
        x, y, z = point.point
        rows.append(
            {
                "run": plot.name,
                "point": index + 1,
                "x_m": f"{x:.4f}",
                "y_m": f"{y:.4f}",
                "z_m": f"{z:.4f}",
                "lean_deg": f"{math.degrees(math.acos(min(float(point.direction[2]), 1.0))):.1f}",
                "diameter_mm": f"{1e3 * point.thickness:.1f}" if math.isfinite(point.thickness) else "",
                "pairs": point.frames or "",
                "spread_mm": f"{1e3 * point.spread:.2f}" if math.isfinite(point.spread) else "",
                "reachable": "" if can is None else "yes" if can[index] else "no",
                "method": request.method,
                "version": jaxrl_vis.__version__,
            }
        )
    return rows


def draw_points(left: np.ndarray, perception: Perception, calibration: Calibration, mount: Mount) -> np.ndarray:
    """Draw stalks in red and grasp points, numbered as in the table, on a copy of the last left image: [H, W, 3] uint8."""
    image = left.copy()
    red = perception.clouds[-1].mask
    image[red] = (0.4 * image[red] + 0.6 * np.array([255, 0, 0])).astype(np.uint8)
    size = max(image.shape[1] // 170, 3)
    for index, point in enumerate(perception.points):
        x, y, z = mount.pose.to_camera(point.point)
        column, row = calibration.focal * x / z + calibration.centre[0], calibration.focal * y / z + calibration.centre[1]
        middle = (round(column), round(row))
        cv2.circle(image, middle, size, (255, 255, 0), -1, cv2.LINE_AA)
        cv2.circle(image, middle, size, (0, 0, 0), 1, cv2.LINE_AA)
        label_place = (middle[0] + size + 2, middle[1] + size)
        cv2.putText(image, str(index + 1), label_place, cv2.FONT_HERSHEY_SIMPLEX, size / 10, (255, 255, 0), 1, cv2.LINE_AA)
    return image
