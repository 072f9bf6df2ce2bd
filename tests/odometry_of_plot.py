"""Odometry of a single plot."""

from jaxrl_vis.stalks.phenotyping.io.folders import PlotFolder
from jaxrl_vis.stalks.phenotyping.io.tables.odometry import read_odometries


def read_odometry(plot: PlotFolder, speed: float | None = None) -> dict[str, float] | None:
    """Read the distance driven at each pair of a plot, by the pair's name, m; see `read_odometries`."""
    return read_odometries([plot], speed)[plot.name]
