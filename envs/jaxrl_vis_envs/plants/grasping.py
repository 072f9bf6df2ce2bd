"""The families for grasping: the same plants, passed by the short stereo pair of a robot that stops to take hold of them.

The pair is like a MultiSense S7: 1024 x 1024 pixels, 80 degrees wide, a baseline of 70 mm, 1 m above the ground (the thesis,
section 4.1). Its vendor states a minimum range of about 0.4 m, twice what the thesis says, so the row is 0.55 m away. Where the
pair looks is not stated; here it looks down by 15 degrees, where there are more stalks and fewer leaves. Five pairs are taken
over 0.5 m. The row goes on at both ends of that stretch, as it does in a field.
"""

import dataclasses

from jaxrl_vis_envs.plants.family import TRAINING, Family, Layout, Rig
from jaxrl_vis_envs.plants.shifts import SHIFTS, shift

LEAST_RANGE = 0.4
"""Least distance at which the pair measures, m."""

_LENGTH = 1.6

GRASPING = dataclasses.replace(
    TRAINING,
    name="grasping",
    stream=3,
    # As many stalks per metre as in a plot of the thesis.
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
