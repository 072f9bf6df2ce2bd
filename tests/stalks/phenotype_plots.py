"""Helpers of the tests of ``phenotype run``: two small synthetic plots, the command, and its tables."""

import csv
import json
from pathlib import Path

from jaxrl_vis import cli


def write_plots(folder: Path) -> Path:
    """Write two small plots of four pairs with true masks, and their family beside them; return the folder of the plots."""
    spec = folder / "few.json"
    spec.write_text(json.dumps({
        "layout": {"rows_behind": 0, "stalks_mean": 5, "stalks_sd": 0, "tillers": 0, "plot_length": 0.5,
                   "spacing_minimum": 0.06},
        "leaves": {"density": 0.2, "litter": 0},
        "stalks": {"diameter_mean": 0.03},
    }))  # fmt: skip
    words = ["phenotype", "synth", str(folder / "plots"), "--spec", str(spec), "--width", "422", "--frames", "4"]
    assert cli.main([*words, "--plots", "2"]) == 0
    return folder / "plots"


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def run(folder: Path, out: Path, *words: str) -> int:
    return cli.main(["phenotype", "run", str(folder), "--out", str(out), "--masks", "truth", *words])
