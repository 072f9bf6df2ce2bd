"""Leave-one-out training of the stalk detector: `python -m benchmarks.stalks.factors FOLDER --check MODULE:FUNCTION`.

For each group of factors of plots by day, networks are trained with equally many updates on the family ``daylight`` without it,
starting from the shipped weights, and evaluated on photographs. FOLDER gets the weights of each training and its record,
GROUP.json; groups that have a record are skipped. Records in `RESULTS` are the table of docs/lab/real_stalks.md.

FUNCTION(find) evaluates a detector, ``find(image [H, W, 3] uint8) -> (boxes [N, 4], scores [N])``, and returns cells of the
table by column, such as ``{"plants found": "3 of 4"}``: photographs do not ship with this project.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import enable_compilation_cache
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.plugins import find_component
from jaxrl_vis.host.provenance import device_name, revision

RESULTS = Path(__file__).parents[1] / "results" / "factors"
NOTHING = "nothing"
SHARE = 0.6
"""Fraction of plots by day, as in families/daylight.toml."""
WITHOUT: dict[str, dict[str, Any]] = {
    NOTHING: {},
    "light": {"sun": [0.8, 0.8], "sky": [0.4, 0.4], "shadow": [0.0, 0.0], "glare": [0.0, 0.0], "flare": 0.0},
    "ground": {"grass": 0.0, "straw": [1.0, 1.0]},
    "maize": {"maize": 0.0},
    "pots, single plants": {"potted": 0.0, "single": 0.0, "lone": 0.0},
    "ears, hanging leaves": {"organs": [0.0, 0.0], "hanging": [0.0, 0.0]},
    "rooms": {"indoors": 0.0},
    "walls": {"walls": [0.0, 0.0]},
    "structures": {"structures": [0.0, 0.0]},
    "objects, robot": {"objects": [0.0, 0.0], "robot": 0.0},
    "cameras": {
        "distance": [0.8, 0.8],
        "camera_height": [0.6, 0.6],
        "lens": [80.0, 80.0],
        "pitch": [0.0, 0.0],
        "yaw": [0.0, 0.0],
        "roll": [0.0, 0.0],
        "portrait": 0.0,
    },
    "image quality": {"white_balance": 0.0, "jpeg": [98.0, 98.0], "motion": [0.0, 0.0], "resolution": [1.0, 1.0]},
    "borders, overlays": {"borders": 0.0, "replicated": 0.0, "overlay": 0.0},
}
"""Values of `jaxrl_vis_envs.plants.scene.Scene` with which a group of factors does not vary, by the group's name."""
Find = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Training:
    """Settings that all trainings share.

    Attributes:
        steps: Number of updates.
        minutes: Maximum duration of each training in minutes, including compilation.
        workers: Number of processes that render plots.
        images: Maximum number of training images.
        rate: Peak learning rate.
        seed: Random seed.
    """

    steps: int = 4000
    minutes: float = 30.0
    workers: int = 14
    images: int = 6000
    rate: float = 5e-4
    seed: int = 0


def spec(group: str) -> dict[str, Any]:
    """Return the specification of the family ``daylight`` without a group of factors, as `phenotype train --spec` reads it."""
    return {"base": "training", "name": f"daylight without {group}", "scene": {"share": SHARE, **WITHOUT[group]}}


def _stem(group: str) -> str:
    return group.replace(", ", "_").replace(" ", "_")


def train(group: str, folder: Path, training: Training) -> Path:
    """Train without a group of factors, and return the weights file; exit with one line if the training fails."""
    from jaxrl_vis.stalks.phenotyping.detector.weights import SHIPPED  # of rows at night: no group of factors is known yet

    family, weights = folder / f"{_stem(group)}.spec.json", folder / f"{_stem(group)}.safetensors"
    family.write_text(json.dumps(spec(group), indent=1))
    options = {**dataclasses.asdict(training), "spec": family, "start": SHIPPED}
    arguments = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    if subprocess.run([sys.executable, "-m", "jaxrl_vis", "phenotype", "train", str(weights), *arguments]).returncode:
        sys.exit(f"the training without {group} failed, see above; the same command goes on with it")
    return weights


def count_updates(weights: Path) -> int:
    """Return the number of updates with which a weights file was trained."""
    from jaxrl_vis.stalks.phenotyping.detector.weights import read_weights

    return read_weights(weights)[2]["steps"]


def evaluate(weights: Path, check: Callable[[Find], dict[str, str]]) -> dict[str, str]:
    """Return the cells that ``check`` finds for the detector in a weights file."""
    from jaxrl_vis.stalks.phenotyping.detector.loading import load_finder  # imports Flax, which tables do without

    finder = load_finder(weights, 0.5)

    def find(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        detections = finder(image, None, None)
        boxes = np.array([detection.box for detection in detections], np.float64).reshape(-1, 4)
        return boxes, np.array([detection.score for detection in detections])

    return check(find)


def main() -> None:
    """Train and evaluate each group of factors that has no record in the folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--check", required=True)
    parser.add_argument("--groups", nargs="+", choices=tuple(WITHOUT), default=tuple(WITHOUT))
    for field in dataclasses.fields(Training):
        parser.add_argument(f"--{field.name}", type=type(field.default), default=field.default)
    options = parser.parse_args()
    enable_compilation_cache()
    try:
        check = find_component("check", options.check, {})
    except RequestError as error:
        sys.exit(str(error))
    training = Training(**{field.name: getattr(options, field.name) for field in dataclasses.fields(Training)})
    options.folder.mkdir(parents=True, exist_ok=True)
    for group in options.groups:
        record = options.folder / f"{_stem(group)}.json"
        if record.exists():
            continue
        weights = train(group, options.folder, training)
        about = {
            "group": group,
            "training": dataclasses.asdict(training),
            "revision": revision(),
            "device": device_name(),
            "updates": count_updates(weights),
        }
        cells = evaluate(weights, check)
        write_atomically(record, json.dumps({**about, "cells": cells}, indent=1) + "\n")
        print(f"without {group}: {cells}", flush=True)


if __name__ == "__main__":
    main()
