"""Comparison of our images with MuJoCo's own, in the measures that the project has set bounds for.

A pixel within one pixel of a segmentation edge, in either image, is excluded from colour, depth and segmentation measures:
there, OpenGL and a ray caster may legitimately differ. All other pixels count, whether or not the two agree on the object. So
that thin objects are not lost with the edges, each object is also matched with all its pixels: those in one image must be
within one pixel of the same object's in the other, in both directions. Where two surfaces coincide, with the same depth and
colour, either object is accepted.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

VISIBLE_PIXELS = 30  # a geom with fewer in an image (edges counted) has no IoU there
MATCHED_PIXELS = 10  # an object with fewer, in the image where it has more of them, may be hidden in the other
DEPTH_METRES, DEPTH_FRACTION = 1e-3, 1e-3  # whichever is more
COINCIDENT_METRES, COINCIDENT_GREY_LEVELS = 1e-4, 4  # of two surfaces of which either may be drawn

PLANE, SKY, BARE, TEXTURED = "plane", "sky", "bare", "textured"


@dataclasses.dataclass(frozen=True)
class Bound:
    """Bound of a measure: a lower one if ``at_least`` is true, else an upper one."""

    limit: float
    at_least: bool

    def holds(self, value: float) -> bool:
        """Return True if the value is within the bound, or NaN (nothing to measure)."""
        return bool(np.isnan(value) or (value >= self.limit if self.at_least else value <= self.limit))


# Shares of pixels, and differences of colours in 1/255.
BOUNDS = {
    "segmentation": Bound(0.997, True),
    "iou": Bound(0.95, True),
    "matched": Bound(0.8, True),
    "depth": Bound(0.999, True),
    "bare_mean": Bound(4.0, False),
    "bare_p99": Bound(12.0, False),
    "textured_mean": Bound(8.0, False),
}


def surface_kinds(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return [ngeom + nsite + ntendon] of PLANE, BARE or TEXTURED, indexed like the segmentation."""
    kinds = []
    capsules = np.full(mj_model.ntendon, mujoco.mjtGeom.mjGEOM_CAPSULE)
    for types, materials in (
        (mj_model.geom_type, mj_model.geom_matid),
        (mj_model.site_type, mj_model.site_matid),
        (capsules, mj_model.tendon_matid),
    ):
        for kind, material in zip(types, materials, strict=True):
            textured = material >= 0 and mj_model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB] >= 0
            is_plane = kind == mujoco.mjtGeom.mjGEOM_PLANE
            kinds.append(PLANE if is_plane else TEXTURED if textured else BARE)
    return np.array(kinds, dtype="<U8")


def near_edges(labels: np.ndarray) -> np.ndarray:
    """Return a mask of pixels with a neighbour (of eight) that shows something else. [..., H, W] -> bool."""
    *batch, height, width = labels.shape
    padded = np.pad(labels, [(0, 0)] * len(batch) + [(1, 1), (1, 1)], mode="edge")
    shifted = (padded[..., row : row + height, column : column + width] for row in range(3) for column in range(3))
    return np.any([neighbour != labels for neighbour in shifted], axis=0)


def dilated(mask: np.ndarray) -> np.ndarray:
    """Dilate a mask by one pixel in all eight directions. [H, W] -> bool."""
    height, width = mask.shape
    padded = np.pad(mask, 1)
    return np.any([padded[row : row + height, column : column + width] for row in range(3) for column in range(3)], axis=0)


def coincident(ours: Any, theirs: Any) -> np.ndarray:
    """Return a mask [H, W] of pixels where two images have the same depth and colour, whatever their objects."""
    same_depth = np.abs(ours.depth - theirs.depth) <= COINCIDENT_METRES
    same_colour = np.max(np.abs(ours.rgb.astype(np.int16) - theirs.rgb), axis=-1) <= COINCIDENT_GREY_LEVELS
    return same_depth & same_colour


def matched_shares(ours: Any, theirs: Any) -> dict[int, float]:
    """Return, for each object with enough pixels, the fraction within a pixel of its own in the other image; the smaller of
    both directions.

    Pixels where the two surfaces are `coincident` count as the object's own.

    Args:
        ours: A `Frame` of NumPy arrays.
        theirs: The reference, likewise.
    """
    found = {}
    either_will_do = coincident(ours, theirs)
    for label in set(np.unique(ours.segmentation)) | set(np.unique(theirs.segmentation)):
        one, other = ours.segmentation == label, theirs.segmentation == label
        if label >= 0 and max(one.sum(), other.sum()) >= MATCHED_PIXELS:
            pairs = ((one, other), (other, one))
            shares = [_share((a & (dilated(b) | either_will_do)).sum(), a.sum()) for a, b in pairs if a.any()]
            found[int(label)] = float(min(shares))
    return found


@dataclasses.dataclass
class Tally:
    """Sums over the images of one model. Add images with `add`; read `measures`.

    Attributes:
        kinds: `surface_kinds` of the model.
        images: Number of images added.
        kept: Number of pixels away from edges.
        agreeing: Number of these where the segmentations agree.
        solid: Number of kept pixels that show an object in either image.
        close: Number of these where the depths agree.
        worst: Minimum IoU, with the indices of its object and image.
        worst_match: Minimum of `matched_shares`, likewise.
        colours: Counts [256] of absolute differences of colour values, in 1/255, by kind of surface.
    """

    kinds: np.ndarray
    images: int = 0
    kept: int = 0
    agreeing: int = 0
    solid: int = 0
    close: int = 0
    worst: tuple[float, int, int] = (np.nan, -1, -1)
    worst_match: tuple[float, int, int] = (np.nan, -1, -1)
    colours: dict[str, np.ndarray] = dataclasses.field(
        default_factory=lambda: {kind: np.zeros(256, np.int64) for kind in (BARE, TEXTURED, PLANE, SKY)}
    )

    def add(self, ours: Any, theirs: Any) -> None:
        """Add one image: two `Frame` of NumPy arrays; ``theirs`` is the reference."""
        kept = ~(near_edges(ours.segmentation) | near_edges(theirs.segmentation))
        solid = kept & ((ours.segmentation >= 0) | (theirs.segmentation >= 0))
        self.kept += int(kept.sum())
        self.agreeing += int((kept & (ours.segmentation == theirs.segmentation)).sum())
        self.solid += int(solid.sum())
        allowed = np.maximum(DEPTH_METRES, DEPTH_FRACTION * theirs.depth)
        self.close += int((solid & (np.abs(ours.depth - theirs.depth) <= allowed)).sum())
        labels, visible = np.unique(theirs.segmentation, return_counts=True)
        for label in labels[(labels >= 0) & (visible >= VISIBLE_PIXELS)]:
            both, either = (
                int((kept & rule(ours.segmentation == label, theirs.segmentation == label)).sum())
                for rule in (np.logical_and, np.logical_or)
            )
            # Not `<`, which NaN (none yet) would never pass.
            if either and not both / either >= self.worst[0]:
                self.worst = (both / either, int(label), self.images)
        for label, share in matched_shares(ours, theirs).items():
            if not share >= self.worst_match[0]:
                self.worst_match = (share, label, self.images)
        difference = np.abs(ours.rgb.astype(np.int16) - theirs.rgb)
        surface = np.append(self.kinds, SKY)[theirs.segmentation]  # -1 finds the sky at the end
        for kind, counts in self.colours.items():
            counts += np.bincount(difference[kept & (surface == kind)].reshape(-1), minlength=256)
        self.images += 1

    def measures(self) -> dict[str, float]:
        """Measures by name: those of `BOUNDS`, and ``plane_mean``, ``plane_p99``, ``sky_mean``, ``kept`` (a fraction).

        NaN if there was nothing to measure.
        """
        found = {
            "segmentation": _share(self.agreeing, self.kept),
            "iou": self.worst[0],
            "matched": self.worst_match[0],
            "depth": _share(self.close, self.solid),
        }
        for kind, counts in self.colours.items():
            found[f"{kind}_mean"] = _share(float(counts @ np.arange(256)), int(counts.sum()))
            found[f"{kind}_p99"] = _percentile(counts, 0.99)
        return found

    def failures(self, limits: Mapping[str, float] = MappingProxyType({})) -> list[str]:
        """Return the names of violated bounds; ``limits`` are additional upper bounds of a model."""
        measures = self.measures()
        bounds = {**BOUNDS, **{name: Bound(limit, False) for name, limit in limits.items()}}
        return [name for name, bound in bounds.items() if not bound.holds(measures[name])]


def _share(part: float, whole: int) -> float:
    return part / whole if whole else float("nan")


def _percentile(counts: np.ndarray, share: float) -> float:
    """Return the minimum difference that a fraction ``share`` of the counted values does not exceed."""
    return float(np.searchsorted(np.cumsum(counts), share * counts.sum())) if counts.sum() else float("nan")
