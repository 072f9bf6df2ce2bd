"""Counts and widths of one synthetic row through lenses of other focal lengths: `python -m benchmarks.stalks.lenses FOLDER`.

The pairs of each lens are rendered into FOLDER unless they exist, which takes minutes on a GPU and much longer without. Nothing
is refused here: the limits of `phenotype run` follow from this table. With `--results benchmarks/results` the results go into
the record that docs/phenotyping.md quotes, replacing the earlier ones of the same lens.
"""

import argparse
import csv
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ledger.records import RESULTS
from benchmarks.ledger.tables.stalks import LENSES, lens_rows
from jaxrl_vis.host.devices import enable_compilation_cache
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.provenance import device_name, revision
from jaxrl_vis.stalks.phenotyping.detector.finder import Finder
from jaxrl_vis.stalks.phenotyping.detector.loading import detector_name, load_finder
from jaxrl_vis.stalks.phenotyping.detector.weights import SHIPPED
from jaxrl_vis.stalks.phenotyping.evaluation.scoring import match_detections
from jaxrl_vis.stalks.phenotyping.evaluation.synth import plot_name, write_plots
from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration
from jaxrl_vis.stalks.phenotyping.io.images import read_image
from jaxrl_vis.stalks.phenotyping.track.direction import track_either_way
from jaxrl_vis.stalks.phenotyping.track.heights import stalk_widths
from jaxrl_vis.stalks.phenotyping.track.sightings import USUAL_DISTANCE, Sighting, view_pair
from jaxrl_vis_envs.documents import read_json
from jaxrl_vis_envs.plants import Family, read
from jaxrl_vis_envs.plants.truth import StalkInView

FACTORS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.4, 1.66, 2.0)
SEED, WIDTH, PAIRS = 5, 1055, 12


def render_row(folder: Path, factor: float) -> Path:
    """Render the row through a lens of ``factor`` times the usual focal length, unless it exists; return its folder."""
    out = folder / f"{factor:g}"
    spec = folder / f"{factor:g}.toml"
    folder.mkdir(parents=True, exist_ok=True)
    spec.write_text(f'base = "training"\nname = "lens"\n[rig]\nfocal = {Family().rig.focal * factor}\n', encoding="utf-8")
    family = read(spec).at_width(WIDTH)
    family = dataclasses.replace(family, rig=dataclasses.replace(family.rig, frames=PAIRS))
    write_plots(out, family, range(SEED, SEED + 1))
    return out / plot_name(SEED)


def evaluate_row(plot: Path, finder: Finder) -> dict[str, Any]:
    """Detect, measure and count the stalks of a rendered row.

    Returns:
        Pixels per metre, and height of the view in m; numbers of true and counted stalks, visible sightings, true and false
        positives; fraction of pairs in which the ground was detected; errors of widths in mm, by index of the stalk.
    """
    truth, calibration = read_json(plot / "plot.json"), read_calibration(plot / "calibration.yaml")
    with (plot / "odometry.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = {field.name for field in dataclasses.fields(StalkInView)}
    frames: list[list[Sighting]] = []
    owners: list[list[int | None]] = []
    visible = detected = false_positives = grounds = 0
    for row in rows:
        left, right = (read_image(plot / row[side]) for side in ("left", "right"))
        seen = [stalk for stalk in truth["seen"] if stalk["pair"] == int(row["pair"])]
        stalks = [StalkInView(**{name: stalk[name] for name in names}) for stalk in seen]
        view = view_pair(finder, left, right, calibration)
        matched, scored = match_detections(view.detections, stalks)
        visible += sum(stalk.band_box is not None and stalk.band_visible >= 0.3 for stalk in stalks)
        detected += sum(hit > 0 for _, hit in scored)
        false_positives += sum(not hit for _, hit in scored)
        grounds += view.ground is not None
        frames.append(view.sightings)
        owners.append(matched)
    tracks = track_either_way(frames, np.array([float(row["distance_m"]) for row in rows]), calibration).tracks
    counted = [track for track in tracks if track.counted]
    errors = {}
    for track, widths in zip(counted, stalk_widths(frames, counted)):
        known = [name for frame, place in track.sightings if (name := owners[frame][place]) is not None]
        owner = max(sorted(set(known)), key=known.count) if known else len(truth["stalks"])
        if owner < len(truth["stalks"]) and widths.lower is not None and widths.height_known:
            errors[owner] = widths.lower.mm - truth["stalks"][owner]["12in"]["diameter_mm"]
    return {
        "pixels_per_metre": calibration.focal / USUAL_DISTANCE,
        "view_m": calibration.height * USUAL_DISTANCE / calibration.focal,
        "true": truth["count"],
        "counted": len(counted),
        "visible": visible,
        "true_positives": detected,
        "false_positives": false_positives,
        "ground_share": grounds / len(rows),
        "width_errors_mm": errors,
    }


def main(words: Sequence[str] | None = None) -> int:
    """Render, measure, print the table, and update the record if requested; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path, help="folder for the rendered pairs")
    parser.add_argument("--factors", type=float, nargs="+", default=FACTORS)
    parser.add_argument("--results", type=Path, help=f"folder of records, such as {RESULTS.name}")
    options = parser.parse_args(words)
    enable_compilation_cache()
    finder = load_finder(SHIPPED, 0.5)
    about = {"synthetic": True, "seed": SEED, "width": WIDTH, "pairs": PAIRS, "finder": detector_name(SHIPPED)}
    lenses: dict[str, Any] = {}
    target = None if options.results is None else options.results / LENSES
    if target is not None and target.exists():
        record = read_json(target)
        lenses = record["lenses"] if about.items() <= record.items() else {}
    for factor in options.factors:
        figures = evaluate_row(render_row(options.folder, factor), finder)
        lenses[f"{factor:g}"] = {**figures, "device": device_name(), "revision": revision()}
        record = json.loads(json.dumps({**about, "lenses": dict(sorted(lenses.items(), key=lambda lens: float(lens[0])))}))
        if target is not None:
            write_atomically(target, json.dumps(record, indent=1) + "\n")
        print(f"x {factor:g}: {figures['counted']} of {figures['true']} stalks", flush=True)
    print(lens_rows(record["lenses"]), end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
