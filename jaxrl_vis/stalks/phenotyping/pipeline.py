"""Pipeline from folders of pairs to tables: `run` reads, detects, measures, tracks and writes, and resumes after interruption.

    OUT/run.json                 the request; a folder holds the results of one request only
        pairs/PLOT/PAIR.json     sightings, or why the pair was skipped, and the state of its source files; reused while these
                                 are unchanged, unless the pair was skipped
        overlays/PLOT/PAIR.png   rendered again if their contents change; drawn.json holds digests of the contents
        stalks.csv  plots.csv  skipped.csv
        qc.html                  the same with images, and what was rejected

Tables are derived from the files under pairs/: interruptions and the number of processes change only rounding.
A single process has two pairs in memory, several have one each, and this one up to eight images for overlays.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxrl_vis
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.worker_pool import UnorderedMap, worker_pool
from jaxrl_vis.stalks.digests import value_digest
from jaxrl_vis.stalks.phenotyping.detector.band import Band
from jaxrl_vis.stalks.phenotyping.detector.finder import Detection, Detections
from jaxrl_vis.stalks.phenotyping.io.folders import PairFiles, PlotFolder
from jaxrl_vis.stalks.phenotyping.io.images import write_image
from jaxrl_vis.stalks.phenotyping.io.names import file_name
from jaxrl_vis.stalks.phenotyping.io.pair_reading import UnusablePairError, read_known_disparity, read_pair, read_side
from jaxrl_vis.stalks.phenotyping.io.tables.odometry import odometry_fault, read_odometries
from jaxrl_vis.stalks.phenotyping.measure.lens import UNTRIED, LensRange, lens_fault
from jaxrl_vis.stalks.phenotyping.measure.stalk import Method
from jaxrl_vis.stalks.phenotyping.report.overlay import draw_overlay
from jaxrl_vis.stalks.phenotyping.report.qc import Page, PlotResult
from jaxrl_vis.stalks.phenotyping.report.tables import (
    NO_ROW,
    PARTLY_SEEN,
    PLOT_COLUMNS,
    STALK_COLUMNS,
    UNFAMILIAR,
    Origin,
    Row,
    plot_rows,
    rows_without_path,
    write_rows,
)
from jaxrl_vis.stalks.phenotyping.track.direction import track_either_way
from jaxrl_vis.stalks.phenotyping.track.follow import Track
from jaxrl_vis.stalks.phenotyping.track.pairing import pair_fault, view_pair
from jaxrl_vis.stalks.phenotyping.track.sightings import NO_CALIBRATION, USUAL_DISTANCE, Sighting, row_distance
from jaxrl_vis.stalks.results_folder import claim_folder, is_current, pair_state, write_record
from jaxrl_vis_envs.documents import read_json
from jaxrl_vis_envs.plants import Calibration

Find = Callable[[np.ndarray, float | None, Band | None, PlotFolder, PairFiles], list[Detection]]
"""Stalk detector, called with a left image [H, W, 3] uint8, its pixels per metre at the row of plants and the image rows of the
band (None if unknown), and its folder and files; returns the detections in pixels of the image."""
NO_ODOMETRY = "no odometry"
NO_FIT = "odometry does not fit the images"
SKIPPED_COLUMNS = ("plot", "pair", "why")


@dataclasses.dataclass(frozen=True)
class Request:
    """Options of a run of the pipeline.

    Attributes:
        out: Output folder.
        method: Method of measuring widths.
        finder: Name of the detector; results of different detectors are not mixed in one folder.
        calibrations: Calibration of each plot by its name; None if it has none.
        speed: Speed of the robot, m/s, for odometry with times only; None if unknown.
        disparity_scale: Divisor of disparities in integer images, such as PNG of 16 bits.
        lens_range: Range of lenses on which the detector was validated; None to accept any.
    """

    out: Path
    method: Method
    finder: str
    calibrations: Mapping[str, Calibration | None]
    speed: float | None = None
    disparity_scale: float = 256.0
    lens_range: LensRange | None = None


def run(
    plots: list[PlotFolder],
    find: Find,
    request: Request,
    done: Callable[[str, int, int], None] = lambda plot, pair, of: None,
    workers: int = 1,
    echo: Callable[[str, str], None] = lambda plot, why: None,
) -> tuple[list[Row], list[Row]]:
    """Process plots and write their results, resuming from those that are already there.

    Args:
        plots: Folders of pairs.
        find: Stalk detector, called in two threads; picklable for several workers.
        request: Options of the run.
        done: Callback for each pair, with the plot's name, and the numbers of finished and of all its pairs.
        workers: Number of processes that measure pairs, except for the first one; 1 to use the calling process.
        echo: Callback for each plot without a count, with its name and the reason.

    Returns:
        Rows of plots.csv, and rows of skipped.csv.

    Raises:
        RequestError: The folder holds other results, or a plot's odometry cannot be read.
        OSError: A file cannot be written.
    """
    distances = read_odometries(plots, request.speed)
    claim_folder(
        request.out,
        "plots",
        plots,
        request.calibrations,
        {
            "method": request.method,
            "finder": request.finder,
            "speed": request.speed,
            "disparity_scale": request.disparity_scale,
        },
        any(request.out.glob("pairs/*/*.json")),
    )
    about = [
        f"jaxrl-vis {jaxrl_vis.__version__}; detections by {request.finder}; widths by the method {request.method}.",
        "Tables: stalks.csv, plots.csv and skipped.csv; all pairs: overlays/.",
    ]
    if request.lens_range is not None:
        about.append(
            "Counting and measuring was tried on synthetic rows of sorghum in the light of a flash alone, seen from aside with "
            f"{request.lens_range.pixels_per_metre:.0f} pixels or more per metre of the row and "
            f"{request.lens_range.view:.2f} m of it from top to bottom; on no real row."
        )
    # To decode images and to draw overlays is OpenCV's work, which lets other threads run.
    threads, drawing = ThreadPoolExecutor(2), ThreadPoolExecutor(8)
    try:
        with worker_pool(workers) as run_all, Page(about, request.out / "overlays", len(plots)) as page:
            run_all = run_all if workers > 1 else threads.map
            return _run(plots, find, request, distances, page, done, echo, workers, run_all, drawing)
    finally:
        threads.shutdown(cancel_futures=True)
        drawing.shutdown(cancel_futures=True)


def _run(
    plots: list[PlotFolder],
    find: Find,
    request: Request,
    distances: dict[str, dict[str, float] | None],
    page: Page,
    done: Callable[[str, int, int], None],
    echo: Callable[[str, str], None],
    workers: int,
    run_all: UnorderedMap,
    drawing: ThreadPoolExecutor,
) -> tuple[list[Row], list[Row]]:
    """Process plots; return the rows of plots.csv and skipped.csv. See `run` for the arguments."""
    stalks: list[Row] = []
    rows: list[Row] = []
    skipped: list[Row] = []
    missing: list[tuple[PlotFolder, PairFiles]] = []
    pairs = {plot.name: len(plot.pairs) for plot in plots}
    left: dict[str, int] = {}
    for plot in plots:
        _record_path(request, plot.name, "").parent.mkdir(parents=True, exist_ok=True)
        outdated = [pair for pair in plot.pairs if not _is_current(request, plot.name, pair)]
        missing += [(plot, pair) for pair in outdated]
        left[plot.name] = len(outdated)
        if len(outdated) < pairs[plot.name]:
            done(plot.name, pairs[plot.name] - len(outdated), pairs[plot.name])
    make_record = functools.partial(_pair_record, find, request)

    def make_all() -> Iterator[tuple[str, str, dict[str, Any], Any]]:
        run_all(functools.partial(_start_worker, find), range(min(workers, len(missing) - 1)))
        # While workers start, this compiles for all of them: each has fewer cores.
        yield from map(make_record, missing[:1])
        yield from run_all(make_record, missing[1:])

    made = make_all()
    unfinished: list[Callable[[], None]] = []
    for plot in plots:
        while left[plot.name]:
            name, pair, record, sources = next(made)
            write_record(_record_path(request, name, pair), record, sources)
            left[name] -= 1
            done(name, pairs[name] - left[name], pairs[name])
        records = [read_json(_record_path(request, plot.name, pair.name)) for pair in plot.pairs]
        bad = [
            {"plot": plot.name, "pair": pair.name, "why": record["skipped"]}
            for pair, record in zip(plot.pairs, records)
            if "skipped" in record
        ]
        result = _finish_plot(plot, records, distances[plot.name], request)
        if result.row["stalks"] == "":
            echo(plot.name, result.row["flag"] + (f" ({result.count_reason})" if result.count_reason else ""))
        stalks, rows, skipped = stalks + result.stalks, [*rows, result.row], skipped + bad
        write_rows(request.out / "stalks.csv", STALK_COLUMNS, stalks)
        write_rows(request.out / "plots.csv", PLOT_COLUMNS, rows)
        write_rows(request.out / "skipped.csv", SKIPPED_COLUMNS, skipped)
        unfinished.append(_draw_overlays(plot, records, result, request, page, drawing))
        if len(unfinished) > 1:
            unfinished.pop(0)()  # the plot before, whose overlays were drawn while the pairs of this one were measured
    for finish in unfinished:
        finish()
    page.write(request.out / "qc.html", skipped)
    return rows, skipped


def _start_worker(find: Find, number: int) -> None:
    """Initialise JAX in a worker that has imported the detector to receive this call."""
    jax.devices()


def _missing_count_reason(flag: str, frames: list[list[Sighting]], plot: PlotFolder, distances: dict[str, float] | None) -> str:
    """Return an explanation beyond the flag of why a plot has no count; empty if there is none."""
    if flag == NO_ODOMETRY:
        return odometry_fault(plot, distances, plot.pairs) or ""
    if PARTLY_SEEN in flag:
        return "its pairs do not show all of the row that the robot passed: take some before its beginning and beyond its end"
    if flag == NO_FIT:
        return "its distances, or the baseline of the calibration, may be in another unit"
    if flag != NO_ROW:
        return ""
    detections = sum(map(len, frames))
    return (
        f"{detections} detections in {len(frames)} pairs, none of which counts: unless the plot is empty, its images are not "
        "such as the networks know, see its overlays"
    )


def _lens_fault(request: Request, frames: list[list[Sighting]], records: list[dict[str, Any]], name: str) -> str | None:
    """Return a message on why the lens of a plot is outside the validated range; None if it is within, or if unknown."""
    calibration = request.calibrations[name]
    if request.lens_range is None or calibration is None or not records:
        return None
    first, last = np.median([record["lines"] for record in records], axis=0)
    distance = row_distance([sighting for frame in frames for sighting in frame]) or USUAL_DISTANCE
    return lens_fault(calibration, distance, round(last - first), request.lens_range)


def _is_complete(record: dict[str, Any]) -> bool:
    """Return True if the record of a pair is complete and valid.

    Raises:
        KeyError, TypeError, ValueError: It is not, or the pair was skipped, which is then tried again.
    """
    rows, columns = record["size"]
    (top, bottom), (left, right) = record["lines"], record["columns"]
    for values in record["sightings"]:
        Sighting.read(values)
    return all(isinstance(count, int) for count in (rows, columns, top, bottom, left, right))


def _sources(pair: PairFiles, calibration: Calibration | None) -> dict[str, Any]:
    """Return the state of everything besides the request that the record of a pair depends on."""
    return {**pair_state(pair), "calibration": None if calibration is None else value_digest(dataclasses.asdict(calibration))}


def _record_path(request: Request, plot: str, pair: str) -> Path:
    return request.out / "pairs" / file_name(plot) / file_name(f"{pair}.json")


def _is_current(request: Request, plot: str, pair: PairFiles) -> bool:
    """Return True if there is a complete record of a pair as it is now."""
    return is_current(_record_path(request, plot, pair.name), _sources(pair, request.calibrations[plot]), _is_complete)


def _pair_record(find: Find, request: Request, job: tuple[PlotFolder, PairFiles]) -> tuple[str, str, dict[str, Any], Any]:
    """Return the names of a plot and of its pair, the pair's record, and the state of the record's sources."""
    plot, pair = job
    sources = _sources(pair, request.calibrations[plot.name])  # before the files are read, as they may be replaced meanwhile
    return plot.name, pair.name, _make_record(plot, find, request, pair), sources


def _make_record(plot: PlotFolder, find: Find, request: Request, pair: PairFiles) -> dict[str, Any]:
    """Compute the record of a pair: its sightings, or the reason why it was skipped."""
    calibration = request.calibrations[plot.name]
    try:
        left, right = read_pair(pair, calibration, pair.disparity is None)
        disparity = read_known_disparity(pair, left, request.disparity_scale)
    except UnusablePairError as problem:
        return {"skipped": str(problem)}
    view = view_pair(
        lambda image, pixels_per_metre, band: find(image, pixels_per_metre, band, plot, pair),
        left,
        right,
        calibration,
        request.method,
        disparity,
    )
    wrong = None
    if calibration is not None and disparity is None:
        wrong = pair_fault(view.detections, view.sightings, left, right, calibration, view.ground)
    if wrong is not None:
        return {"skipped": wrong}
    judged = view.detections if isinstance(view.detections, Detections) else Detections()
    return {
        "size": list(left.shape[:2]),
        "lines": list(view.frame.rows),
        "columns": list(view.frame.columns),
        "doubt": None if judged.doubt is None else round(judged.doubt, 4),
        "max_doubt": judged.max_doubt,
        "camera_height_m": None if view.ground is None else round(view.ground.camera_height, 4),
        "sightings": [sighting.json_values() for sighting in view.sightings],
    }


def _finish_plot(
    plot: PlotFolder, records: list[dict[str, Any]], distances: dict[str, float] | None, request: Request
) -> PlotResult:
    """Track the stalks of a plot, and compute its table rows, from the records of its pairs and the distances driven, m."""
    usable = [(pair, record) for pair, record in zip(plot.pairs, records) if "sightings" in record]
    skipped = len(records) - len(usable)
    frames = [[Sighting.read(values) for values in record["sightings"]] for _, record in usable]
    origin = Origin(plot.name, request.method, jaxrl_vis.__version__)
    calibration = request.calibrations[plot.name]
    known = distances is not None and all(pair.name in distances for pair, _ in usable)
    flag, tracks, start = _tracking_fault(len(usable), calibration), [], 0.0
    drive = None
    why = _lens_fault(request, frames, [record for _, record in usable], plot.name)
    if why is not None:
        flag = UNTRIED
    elif calibration is not None and distances is not None and known and len(usable) >= 2:
        first, last = np.median([record["columns"] for _, record in usable], axis=0)
        driven_at = np.array([distances[pair.name] for pair, _ in usable])
        drive = track_either_way(frames, driven_at, calibration, (float(first), float(last)))
        flag = NO_FIT
    if drive is None or not drive.is_consistent:
        stalks, row = rows_without_path(frames, skipped, origin, flag, metric=flag not in (NO_FIT, UNTRIED))
    else:
        tracks, path = drive.tracks, drive.path
        start = float(path.positions[0])
        stalks, row = plot_rows(frames, tracks, path, skipped, origin)
    strange = _unfamiliar_note([record for _, record in usable])
    if strange:
        row = {**row, "flag": UNFAMILIAR if row["flag"] == "ok" else f"{row['flag']}; {UNFAMILIAR}"}
    width = usable[0][1]["size"][1] if usable else 0
    why = why or (_missing_count_reason(row["flag"], frames, plot, distances) if row["stalks"] == "" else "")
    return PlotResult(row, stalks, [pair.name for pair, _ in usable], frames, tracks, start, width, why, strange)


def _unfamiliar_note(records: list[dict[str, Any]]) -> str:
    """Return a warning if more than half of the pairs of a plot are unfamiliar to the networks; else an empty string."""
    judged = [(record["doubt"], record["max_doubt"]) for record in records if record.get("max_doubt") is not None]
    unlike = sum(doubt > limit for doubt, limit in judged)
    if unlike <= len(judged) / 2:
        return ""
    doubt, limit = np.median(judged, axis=0)
    return (
        f"{unlike} of {len(judged)} pairs are unlike the images that the networks read rightly (the median of their doubts is "
        f"{doubt:.2f}, the limit {limit:.2f}): look at the overlays before you trust a number"
    )


def _draw_overlays(
    plot: PlotFolder,
    records: list[dict[str, Any]],
    result: PlotResult,
    request: Request,
    page: Page,
    threads: ThreadPoolExecutor,
) -> Callable[[], None]:
    """Begin to write the overlays of a plot that are missing or outdated, and delete those of pairs that are no longer usable.

    The function that is returned waits for them, and adds the plot to the page.
    """
    usable = [(pair, record) for pair, record in zip(plot.pairs, records) if "sightings" in record]
    labels = sighting_labels(result.frames, result.tracks)
    folder = request.out / "overlays" / file_name(plot.name)
    folder.mkdir(parents=True, exist_ok=True)
    index = folder / "drawn.json"
    shown = {pair.name: value_digest([record, names]) for (pair, record), names in zip(usable, labels)}
    try:
        drawn = dict(read_json(index))
    except (FileNotFoundError, ValueError, TypeError):
        drawn = {}
    for name in drawn.keys() - shown.keys():
        (folder / file_name(f"{name}.png")).unlink(missing_ok=True)  # of a pair that is no longer usable
    missing = [
        (folder / file_name(f"{pair.name}.png"), pair, [Sighting.read(values) for values in record["sightings"]], names)
        for (pair, record), names in zip(usable, labels)
        if drawn.get(pair.name) != shown[pair.name] or not (folder / file_name(f"{pair.name}.png")).exists()
    ]
    if drawn != shown:
        # Drop outdated digests before rendering, so that an interruption leaves no overlay with a wrong digest.
        current = {name: digest for name, digest in drawn.items() if digest == shown.get(name)}
        write_atomically(index, json.dumps(current) + "\n")
    written = threads.map(functools.partial(_draw_overlay, plot.name), missing)

    def finish() -> None:
        for _ in written:
            pass
        if drawn != shown:
            write_atomically(index, json.dumps(shown) + "\n")
        page.add(result)

    return finish


def _draw_overlay(plot: str, job: tuple[Path, PairFiles, list[Sighting], list[str | None]]) -> None:
    """Render and write the overlay of one pair."""
    target, pair, frame, names = job
    write_image(target, draw_overlay(read_side(pair, "left"), frame, names, f"{plot} {pair.name}"))


def _tracking_fault(pairs: int, calibration: Calibration | None) -> str:
    """Return a flag on why the stalks of a plot cannot be tracked: too few pairs, no calibration, or else no odometry."""
    if pairs == 0:
        return "no usable pairs"
    if calibration is None:
        return NO_CALIBRATION
    return "a single pair" if pairs == 1 else NO_ODOMETRY


def sighting_labels(frames: list[list[Sighting]], tracks: list[Track]) -> list[list[str | None]]:
    """Return the number of the stalk of each sighting, as in the table; None for stalks that are not counted."""
    labels: list[list[str | None]] = [[None] * len(frame) for frame in frames]
    for number, track in enumerate((track for track in tracks if track.counted), start=1):
        for frame, place in track.sightings:
            labels[frame][place] = str(number)
    return labels
