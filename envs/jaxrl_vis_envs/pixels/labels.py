"""Names of the objects in a segmentation, and segmentation by body. NumPy and MuJoCo only."""

import mujoco
import numpy as np

SKY = -1
"""Label of pixels that show no object."""
TENDON = -2
"""Label of tendons in a segmentation by bodies, since they belong to no body."""


def geom_names(mj_model: mujoco.MjModel) -> dict[int, str]:
    """Return the name of every label of a segmentation by geoms: geoms, sites (from ngeom on), tendons, and -1 for the sky.

    Objects without a name are named after their type and index, such as ``geom 3``.
    """
    names = {index: mj_model.geom(index).name or f"geom {index}" for index in range(mj_model.ngeom)}
    names |= {mj_model.ngeom + index: mj_model.site(index).name or f"site {index}" for index in range(mj_model.nsite)}
    first = mj_model.ngeom + mj_model.nsite
    names |= {first + index: mj_model.tendon(index).name or f"tendon {index}" for index in range(mj_model.ntendon)}
    return names | {SKY: "sky"}


def body_names(mj_model: mujoco.MjModel) -> dict[int, str]:
    """Return the name of every label of a segmentation by bodies; bodies without a name are named like ``body 3``."""
    names = {index: mj_model.body(index).name or f"body {index}" for index in range(mj_model.nbody)}
    return names | {SKY: "sky", TENDON: "tendon"}


def object_bodies(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the body of every label of a segmentation by geoms, [ngeom + nsite + ntendon + 1] int32.

    The last entry, which index -1 selects, is the sky's label.
    """
    tendons = np.full(mj_model.ntendon, TENDON)
    return np.concatenate([mj_model.geom_bodyid, mj_model.site_bodyid, tendons, [SKY]]).astype(np.int32)
