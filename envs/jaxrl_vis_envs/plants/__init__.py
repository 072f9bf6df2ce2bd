"""Fields of late-season sorghum with exact truth: geometry, stereo images, and what is true in them.

    family      what is drawn, and how far it varies: TRAINING
    shifts      the same with factors moved: SHIFTED, `shift`     spec    a family from a file: `read`
    field       one plot: stalks and leaves in metres      cameras    how a pair of cameras passes it
    surfaces    the plot as cones and triangles            tables     what one camera sees of them, tile by tile
    drawing     rays to radiance, in JAX                   imaging    radiance to the numbers in a file
    pairs       pairs of images of a plot                  truth      boxes, visible shares and edges of its stalks
    stand       the few stalks around a robot's arm        bending    these as bodies that give way, and the wind

Everything is a function of a family and a seed. Importing this loads no JAX; `pairs`, `drawing`, `imaging` and `bending` do.
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
