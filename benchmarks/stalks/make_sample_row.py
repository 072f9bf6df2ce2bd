"""Render the short row that ships with the package: `python -m benchmarks.stalks.make_sample_row`.

Synthetic, three pairs of 1055 x 845 pixels as JPEG, with calibration and odometry, and the true diameters in plot.json.
"""

import dataclasses
import json

import cv2

from jaxrl_vis.stalks.phenotyping.evaluation.synth import write_plot
from jaxrl_vis.stalks.phenotyping.io.folders import SAMPLE
from jaxrl_vis_envs.plants import TRAINING, draw

SEED = 41
QUALITY = 72

if __name__ == "__main__":
    layout = dataclasses.replace(TRAINING.layout, plot_length=0.5, stalks_mean=8.0, stalks_sd=0.0, gaps=0.0)
    family = dataclasses.replace(TRAINING, name="sample", layout=layout).at_width(1055)
    family = dataclasses.replace(family, rig=dataclasses.replace(family.rig, frames=3))
    write_plot(SAMPLE, draw(family, SEED), "jpeg", "none", lambda plot, pair: None)
    for path in SAMPLE.glob("*.jpg"):
        options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
        cv2.imwrite(str(path), cv2.imread(str(path)), options)
    (SAMPLE / "truth").rmdir()
    about = json.loads((SAMPLE / "plot.json").read_text())
    fields = ("schema", "synthetic", "family", "seed", "count", "plot_length", "stalks")
    (SAMPLE / "plot.json").write_text(json.dumps({name: about[name] for name in fields}) + "\n")
