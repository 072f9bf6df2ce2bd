"""Spatial tendons as MuJoCo's visualiser renders them: one capsule per straight piece, a chain of capsules for a slack cord.

NumPy only; the poses of the capsules are computed in `cords`.
"""

from typing import NamedTuple

import mujoco
import numpy as np

CHAIN = 28
"""Number of capsules of a cord that may hang, as in MuJoCo's catenaries."""
ARC = 16
"""Number of capsules of the arc around a geom. In MuJoCo it depends on the arc: one for about 0.12 rad."""
WRAPPED = 1 + ARC + 1
"""Number of capsules of a piece that may wrap around a geom: to it, around it, and from it."""

# Columns of `Scene.cords`.
LENGTH = 0  # m, of the cord that hangs
GRAVITY = slice(1, 4)  # m/s^2
RANGE = slice(4, 6)  # m
MARGIN = 6  # m
SOLIMP = slice(7, 12)
LIMIT_COLOUR = slice(12, 15)
COLUMNS = 15

_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
_SITE, _PULLEY, _SPHERE, _CYLINDER = (
    int(getattr(mujoco.mjtWrap, f"mjWRAP_{name}")) for name in ("SITE", "PULLEY", "SPHERE", "CYLINDER")
)


class Piece(NamedTuple):
    """Part of a tendon between two sites.

    Attributes:
        first: Index of the site at its beginning.
        last: Index of the site at its end.
        geom: Index of the geom that it may wrap around, -1 for none.
        side: Index of the site on whose side of the geom it passes, -1 for none.
        is_ball: True if the geom is a sphere, False for a cylinder.
        divisor: Divisor of the piece's length (that of the preceding pulley; 1 without one).
    """

    first: int
    last: int
    geom: int
    side: int
    is_ball: bool
    divisor: float


class Path(NamedTuple):
    """Path of a spatial tendon, a static part of the scene.

    Attributes:
        pieces: Its pieces, in order. Empty for a fixed tendon, which is not rendered.
        hangs: True if it hangs between its two sites while it is slack.
        shows_limits: True if its colour indicates a limit that is reached.
    """

    pieces: tuple[Piece, ...] = ()
    hangs: bool = False
    shows_limits: bool = False

    @property
    def capsules(self) -> int:
        """Number of capsules that the tendon is rendered as."""
        return CHAIN if self.hangs else sum(1 if piece.geom < 0 else WRAPPED for piece in self.pieces)


def read_paths(mj_model: mujoco.MjModel) -> tuple[Path, ...]:
    """Return the paths of all tendons."""
    return tuple(_path(mj_model, tendon) for tendon in range(mj_model.ntendon))


def _path(mj_model: mujoco.MjModel, tendon: int) -> Path:
    start, count = int(mj_model.tendon_adr[tendon]), int(mj_model.tendon_num[tendon])
    pieces, divisor = [], 1.0
    site = around = None
    for number in range(start, start + count):
        kind, index = int(mj_model.wrap_type[number]), int(mj_model.wrap_objid[number])
        if kind == _PULLEY:
            site, around, divisor = None, None, float(mj_model.wrap_prm[number])
        elif kind in (_SPHERE, _CYLINDER):
            around = index, round(float(mj_model.wrap_prm[number])), kind == _SPHERE
        elif kind == _SITE:
            if site is not None:
                pieces.append(Piece(site, index, *(around or (-1, -1, False)), divisor))
            site, around = index, None
    if not pieces:
        return Path()
    limited = bool(mj_model.tendon_limited[tendon])
    low, high = mj_model.tendon_range[tendon]
    short, long = mj_model.tendon_lengthspring[tendon]
    springs = mj_model.tendon_stiffness[tendon] > 0
    # A cord between two sites hangs if either a limit or a spring acts on it, and only above some length.
    by_limit, by_spring = limited and not springs and low == 0 and high > 0, springs and short == 0 and long > 0
    falls = not mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY and np.linalg.norm(mj_model.opt.gravity) > 0
    hangs = bool(count == 2 and falls and (by_limit != by_spring))
    return Path(tuple(pieces), hangs, limited and tuple(mj_model.tendon_rgba[tendon].tolist()) == _DEFAULT_RGBA)


def capsule_counts(mj_model: mujoco.MjModel, paths: tuple[Path, ...]) -> np.ndarray:
    """Return the number of shapes [N] that each geom, site and tendon consists of."""
    others = np.ones(mj_model.ngeom + mj_model.nsite, np.int64)
    return np.concatenate([others, np.array([path.capsules for path in paths], np.int64)])


def cord_columns(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the parameters of tendons, besides poses, that their capsules depend on: [ntendon, COLUMNS]."""
    columns = np.zeros((mj_model.ntendon, COLUMNS))
    springs = mj_model.tendon_stiffness > 0
    columns[:, LENGTH] = np.where(springs, mj_model.tendon_lengthspring[:, 1], mj_model.tendon_range[:, 1])
    columns[:, GRAVITY] = mj_model.opt.gravity
    columns[:, RANGE] = mj_model.tendon_range
    columns[:, MARGIN] = mj_model.tendon_margin
    columns[:, SOLIMP] = mj_model.tendon_solimp_lim
    columns[:, LIMIT_COLOUR] = mj_model.vis.rgba.constraint[:3]
    return columns
