"""Commands ``phenotype`` and ``grasp``: the only interface through which the rest of `jaxrl_vis` accesses `stalks`.

Importing this package does not import JAX. Each command has a module with its options, a frozen dataclass, and the function
that runs it.
"""

from collections.abc import Callable
from typing import Any

from jaxrl_vis.stalks.cli import (
    grasp_eval,
    grasp_figure,
    grasp_run,
    grasp_synth,
    grasp_train,
    phenotype_eval,
    phenotype_figure,
    phenotype_label,
    phenotype_run,
    phenotype_synth,
    phenotype_train,
)
from jaxrl_vis.stalks.cli.options import DetectorTraining

COMMANDS: dict[str, tuple[type, Callable[[Any], int]]] = {
    "phenotype synth": (phenotype_synth.Synth, phenotype_synth.synth),
    "phenotype train": (DetectorTraining, phenotype_train.train),
    "phenotype label": (phenotype_label.Label, phenotype_label.label),
    "phenotype run": (phenotype_run.Run, phenotype_run.run),
    "phenotype eval": (phenotype_eval.Eval, phenotype_eval.evaluate),
    "phenotype figure": (phenotype_figure.Figure, phenotype_figure.draw),
    "grasp synth": (grasp_synth.Synth, grasp_synth.synth),
    "grasp train": (grasp_train.Train, grasp_train.train),
    "grasp run": (grasp_run.Run, grasp_run.run),
    "grasp eval": (grasp_eval.Eval, grasp_eval.evaluate),
    "grasp figure 4.4": (grasp_figure.PerceptionFigure, grasp_figure.draw_perception),
    "grasp figure 4.5": (grasp_figure.PathFigure, grasp_figure.draw_path),
    "grasp figure 4.6": (grasp_figure.GraspsFigure, grasp_figure.draw_grasps),
}
"""Name -> options class, and the function that runs the command and returns the exit status."""
