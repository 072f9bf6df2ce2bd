"""Table of the outcomes of third-party input files: `python -m benchmarks.stalks.outcomes FOLDER`.

FOLDER holds folders of cases: calib (a calibration each), ann (a folder of annotated images each), files (a folder of plots
each) and odo (a plot with its odometry each). A line shows what was read, or the error in one line; anything else is a fault,
and the exit status is 1.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis.stalks.phenotyping.io.tables.odometry import read_odometries


def calibration(path: Path) -> str:
    """Describe a calibration: sizes in pixels, baseline in metres."""
    cameras = read_calibration(path)
    x, y = cameras.centre
    return (
        f"{cameras.width} x {cameras.height}, focal {cameras.focal:.2f}, centre {x:.1f} {y:.1f}, "
        f"baseline {cameras.baseline:.4f} m, offset {cameras.offset:.1f}"
    )


def annotations(path: Path, labels: Sequence[str] = ()) -> str:
    """Describe annotated images: numbers of images and boxes, the first boxes, and labels."""
    data = read_annotations(path, labels)
    boxes = "; ".join(" ".join(f"{value:g}" for value in one["bbox"]) for one in data["annotations"][:4])
    return f"{len(data['images'])} images, {len(data['annotations'])} boxes ({boxes}), {data['summary']}"


def plots(path: Path) -> str:
    """Describe the plots of a folder: names and pairs."""
    parts = []
    for plot in find_plots(path):
        complete = sum(pair.left is not None and pair.right is not None for pair in plot.pairs)
        parts.append(
            f"{plot.name}: {complete} of {len(plot.pairs)} pairs whole, {', '.join(pair.name for pair in plot.pairs[:3])}"
        )
    return "; ".join(parts)


def odometry(path: Path) -> str:
    """Describe the odometry of one plot: distances in metres by pair."""
    (plot,) = find_plots(path)
    driven = read_odometries([plot], None)[plot.name]
    if driven is None:
        return "times only" if any(path.glob("od*")) else "none"
    return ", ".join(f"{name} {value:.4f} m" for name, value in driven.items()) or "no row is of a pair"


KINDS: dict[str, Callable[[Path], str]] = {"calib": calibration, "ann": annotations, "files": plots, "odo": odometry}
"""Readers of the cases in each folder."""


def outcomes(folder: Path) -> list[tuple[str, str, str]]:
    """Return kind, name and outcome of each case; FAULT marks unexpected exceptions and outcomes of more than one line."""
    rows = []
    for kind, read in KINDS.items():
        for case in sorted((folder / kind).iterdir()) if (folder / kind).is_dir() else ():
            try:
                outcome = read(case)
            except RequestError as error:
                outcome = f"refused: {error}".replace(f"{case}/", "").replace(str(case), case.name)
            except Exception as error:  # the fault that this is to detect
                outcome = f"FAULT {type(error).__name__}: {error}"
            rows.append((kind, case.name, outcome if len(outcome.splitlines()) == 1 else f"FAULT {outcome!r}"))
    return rows


def main(words: Sequence[str] | None = None) -> int:
    """Print the table of a folder of cases; return 1 if any is a fault, else 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    rows = outcomes(parser.parse_args(words).folder)
    print("| kind | case | outcome |\n|---|---|---|")
    for row in rows:
        print("| " + " | ".join(part.replace("|", "\\|") for part in row) + " |")
    return int(any(outcome.startswith("FAULT") for _, _, outcome in rows))


if __name__ == "__main__":
    raise SystemExit(main())
