"""Synthetic fields of late-season sorghum with exact ground truth: geometry, stereo images and labels.

    family      parameters of the fields and their variation: TRAINING
    shifts      families with shifted factors: SHIFTED, `shift`     spec    a family from a file: `read`
    scene       factors of daytime plots   settling   values of these factors sampled for one plot
    clutter     objects around the plants                   structures tripods, scaffolds, hoses, trees, jointed arms
    organs      ears, tassels, panicles, clasping leaves    rendering  from a plot to the pixels of an image
    field       one plot: stalks and leaves in metres       cameras    trajectory of a camera pair past it
    pairs       stereo pairs of a plot                      truth      boxes, visibility and edges of its stalks
    stand       the few stalks around a robot's arm         bending    these as flexible bodies, and wind

Everything is a function of a family and a seed. Importing this package does not import JAX; `pairs`, `rendering` and `bending`
do.
"""

from jaxrl_vis_envs.plants.cameras import Calibration, Drive, Pose, drive
from jaxrl_vis_envs.plants.family import TRAINING, Family
from jaxrl_vis_envs.plants.field import Leaf, Plot, Stalk, draw
from jaxrl_vis_envs.plants.shifts import FAMILIES, SHIFTED, SHIFTS, shift
from jaxrl_vis_envs.plants.spec import read

__all__ = [
    "FAMILIES",
    "SHIFTED",
    "SHIFTS",
    "TRAINING",
    "Calibration",
    "Drive",
    "Family",
    "Leaf",
    "Plot",
    "Pose",
    "Stalk",
    "draw",
    "drive",
    "read",
    "shift",
]
