"""Names of the objects in a segmentation, and segmentation by body. NumPy and MuJoCo only."""

import mujoco
import numpy as np

SKY = -1
"""Label of pixels that show no object."""


def geom_names(mj_model: mujoco.MjModel) -> dict[int, str]:
    """Return the name of every label of a segmentation by geoms: geoms, then sites (from ngeom on), then -1, the sky.

    Objects without a name are called by their type and index, such as ``geom 3``.
    """
    names = {index: mj_model.geom(index).name or f"geom {index}" for index in range(mj_model.ngeom)}
    names |= {mj_model.ngeom + index: mj_model.site(index).name or f"site {index}" for index in range(mj_model.nsite)}
    return names | {SKY: "sky"}


def body_names(mj_model: mujoco.MjModel) -> dict[int, str]:
    """Return the name of every label of a segmentation by bodies; bodies without a name are called ``body 3``."""
    return {index: mj_model.body(index).name or f"body {index}" for index in range(mj_model.nbody)} | {SKY: "sky"}


def object_bodies(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the body of every label of a segmentation by geoms, [ngeom + nsite + 1] int32.

    The last entry, which index -1 selects, is the sky's label.
    """
    return np.concatenate([mj_model.geom_bodyid, mj_model.site_bodyid, [SKY]]).astype(np.int32)
