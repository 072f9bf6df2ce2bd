"""Families for grasping: plants of the training family, seen by the short-baseline stereo pair of a robot that stops to grasp.

The pair resembles a MultiSense S7: 1024 x 1024 pixels, a field of view of 80 degrees, a baseline of 70 mm, 1 m above the ground
(the thesis, section 4.1). Its vendor states a minimum range of about 0.4 m, twice what the thesis says, so the row is 0.55 m
away. The thesis does not state the pitch; here it is 15 degrees downwards, where there are more stalks and fewer leaves. Five
pairs are taken over 0.5 m. The row extends beyond both ends of that stretch, as in a field.
"""

import dataclasses

from jaxrl_vis_envs.plants.family import TRAINING, Family, Layout, Rig
from jaxrl_vis_envs.plants.shifts import SHIFTS, shift

_LENGTH = 1.6

GRASPING = dataclasses.replace(
    TRAINING,
    name="grasping",
    stream=3,
    # Same density of stalks as in a plot of the thesis.
    layout=dataclasses.replace(
        TRAINING.layout,
        plot_length=_LENGTH,
        stalks_mean=Layout.stalks_mean * _LENGTH / Layout.plot_length,
        stalks_sd=Layout.stalks_sd * (_LENGTH / Layout.plot_length) ** 0.5,
    ),
    rig=Rig(
        width=1024,
        height=1024,
        focal=610.0,
        baseline=0.07,
        distance=0.55,
        distance_sd=0.015,
        camera_height=1.0,
        pitch=15.0,
        frames=5,
        stretch=0.5,
    ),
)
GRASPING_SHIFTED = shift(GRASPING, *SHIFTS, name="grasping_shifted", stream=4)
GRASPING_FAMILIES: dict[str, Family] = {"training": GRASPING, "shifted": GRASPING_SHIFTED}
