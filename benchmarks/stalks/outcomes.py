"""Outcome of each case of files from elsewhere, as a table: `python -m benchmarks.stalks.outcomes FOLDER`.

FOLDER holds folders of cases: calib (a calibration each), ann (a folder of annotated images each), files (a folder of plots
each) and odo (a plot with its odometry each). A line says what was read, or the one line of the error; anything else is a
fault, and the exit status is 1.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxrl_vis.errors import RequestError
from jaxrl_vis.stalks.phenotyping.io.annotations import read_annotations
from jaxrl_vis.stalks.phenotyping.io.calibration import read_calibration
from jaxrl_vis.stalks.phenotyping.io.folders import find_plots
from jaxrl_vis.stalks.phenotyping.io.tables.odometry import read_odometry


def calibration(path: Path) -> str:
    found = read_calibration(path)
    x, y = found.centre
    size = f"{found.width} x {found.height}"
    return (
        f"{size}, focal {found.focal:.2f}, centre {x:.1f} {y:.1f}, baseline {found.baseline:.4f} m, offset {found.offset:.1f}"
    )


def annotations(path: Path, labels: Sequence[str] = ()) -> str:
    found = read_annotations(path, labels)
    boxes = "; ".join(" ".join(f"{value:g}" for value in one["bbox"]) for one in found["annotations"][:4])
    return f"{len(found['images'])} images, {len(found['annotations'])} boxes ({boxes}), {found['summary']}"


def plots(path: Path) -> str:
    parts = []
    for plot in find_plots(path):
        whole = sum(pair.left is not None and pair.right is not None for pair in plot.pairs)
        parts.append(
            f"{plot.name}: {whole} of {len(plot.pairs)} pairs whole, {', '.join(pair.name for pair in plot.pairs[:3])}"
        )
    return "; ".join(parts)


def odometry(path: Path) -> str:
    (plot,) = find_plots(path)
    driven = read_odometry(plot)
    if driven is None:
        return "times only" if any(path.glob("od*")) else "none"
    return ", ".join(f"{name} {value:.4f} m" for name, value in driven.items()) or "no row is of a pair"


KINDS: dict[str, Callable[[Path], str]] = {"calib": calibration, "ann": annotations, "files": plots, "odo": odometry}
"""Readers of the cases in each folder."""


def outcomes(folder: Path) -> list[tuple[str, str, str]]:
    """Kind, name and outcome of each case; an outcome that begins with FAULT is neither a value nor one line."""
    rows = []
    for kind, read in KINDS.items():
        for case in sorted((folder / kind).iterdir()) if (folder / kind).is_dir() else ():
            try:
                outcome = read(case)
            except RequestError as error:
                outcome = f"refused: {error}".replace(f"{case}/", "").replace(str(case), case.name)
            except Exception as error:  # what a case must not end with
                outcome = f"FAULT {type(error).__name__}: {error}"
            rows.append((kind, case.name, outcome if len(outcome.splitlines()) == 1 else f"FAULT {outcome!r}"))
    return rows


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    rows = outcomes(parser.parse_args(words).folder)
    print("| kind | case | outcome |\n|---|---|---|")
    for row in rows:
        print("| " + " | ".join(part.replace("|", "\\|") for part in row) + " |")
    return int(any(outcome.startswith("FAULT") for _, _, outcome in rows))


if __name__ == "__main__":
    raise SystemExit(main())
