"""Tracking of stalks: association of sightings in several pairs, and the position of each stalk along the row.

Odometry gives the distance driven to a few per cent; stereo gives the position of a stalk relative to the robot to millimetres.
Their sum, the position along the row, is constant from pair to pair, so sightings are associated by position. The median motion
of the stalks between two pairs corrects the odometry.
"""

import dataclasses
import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxrl_vis.stalks.phenotyping.track.near_row import near_row_depth
from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting
from jaxrl_vis_envs.plants import Calibration

_USUAL_DEPTH = 0.8  # m, if no depth was measured
_SOLID = 0.6  # minimum distance of two stalks, as a fraction of that at which they touch
_MAX_LEAN = 25.0  # degrees: a larger lean is a measurement error
_FORBIDDEN_COST = 1e3  # cost of an assignment outside the gates
# Gates of the tracker, lengths in m.
_ALONG = 0.018  # maximum distance along the row between a track and a sighting assigned to it
_DEPTH = 0.05  # maximum difference of their depths
_STALE = 3  # pairs without a depth after which a track behind the row gets no sightings that the row claims
_ROW_FIRST_COST = 2.0  # more than the cost of any assignment within the gates
_MERGE = 0.015  # maximum distance along the row between two tracks of one stalk, which are merged
_MERGE_ACROSS_DEPTHS = 0.005  # the same for tracks of different depth, with the rays of one evaluated at the depth of the other
_MAX_SHARED = 0.34  # maximum fraction of the pairs of the shorter track in which both are seen, to merge them
_MAX_ROW_OFFSET = 0.2  # maximum difference between the depth of a counted stalk and that of the row
_MIN_FRACTION = 0.3  # minimum fraction of the pairs with the stalk in view that must show it to count it
_MIN_PAIRS = 2  # minimum number of pairs that must show it, unless fewer have it in view
_END_MARGIN = 0.01  # maximum distance of a counted stalk's foot beyond the ends of the path


@dataclasses.dataclass(frozen=True)
class Track:
    """Track of one stalk.

    Attributes:
        sightings: Index of the pair, and index within its sightings, of each sighting.
        position_m: Position along the row, relative to the robot's at the first pair, m.
        depth_m: Depth from the cameras, m; NaN if never measured.
        counted: True if the stalk is counted: enough pairs show it, and it belongs to the row and to the path.
        reason: Reason why it is not counted; empty if it is.
    """

    sightings: tuple[tuple[int, int], ...]
    position_m: float
    depth_m: float
    counted: bool
    reason: str


@dataclasses.dataclass(frozen=True)
class RobotPath:
    """Path of the robot.

    Attributes:
        positions: [F] float64, position of each pair along the row, m: odometry corrected by stereo.
        length: Length of the row that was passed, m, including half a step at each end.
        seen_fraction: Fraction of that length in view of any pair.
        row_depth: Depth of the row from the cameras, m.
    """

    positions: np.ndarray
    length: float
    seen_fraction: float = 1.0
    row_depth: float = _USUAL_DEPTH

    def is_behind_row(self, track: "Track") -> bool:
        """Return True if stereo places a track further behind the row than a counted stalk may be."""
        return track.depth_m - self.row_depth > _MAX_ROW_OFFSET


@dataclasses.dataclass
class _OpenTrack:
    """Track under construction; its lists have one entry per sighting.

    Attributes:
        sightings: Index of the pair, and index within its sightings.
        along: Position along the row, m.
        depth: Depth, m; NaN if not measured.
        rays: Position of the left camera along the row, m, and tangent of the horizontal angle at which it sees the stalk.
        feet: Position of the stalk's foot along the row, m.
    """

    sightings: list[tuple[int, int]] = dataclasses.field(default_factory=list)
    along: list[float] = dataclasses.field(default_factory=list)
    depth: list[float] = dataclasses.field(default_factory=list)
    rays: list[tuple[float, float]] = dataclasses.field(default_factory=list)
    feet: list[float] = dataclasses.field(default_factory=list)

    def depths(self) -> np.ndarray:
        """Return the finite depths of the sightings, m."""
        return np.array(self.depth)[np.isfinite(self.depth)]

    def position_at(self, depth: float) -> float:
        """Return the position along the row, m, assuming a depth in m."""
        return float(np.median([offset + ray * depth for offset, ray in self.rays]))

    def is_stale(self, frame: int) -> bool:
        """Return True if no depth was measured in the last pairs before ``frame``."""
        measured = [number for (number, _), depth in zip(self.sightings, self.depth) if math.isfinite(depth)]
        return not measured or frame - measured[-1] >= _STALE

    def locate(self) -> tuple[float, float]:
        """Return the median position along the row and depth of the last nine sightings, m; NaN for an unknown depth."""
        depths = [depth for depth in self.depth[-9:] if math.isfinite(depth)]
        return float(np.median(self.along[-9:])), float(np.median(depths)) if depths else math.nan


def track_stalks(
    frames: list[list[Sighting]],
    distances: np.ndarray,
    calibration: Calibration,
    columns: tuple[float, float] | None = None,
) -> tuple[list[Track], RobotPath]:
    """Track the stalks of a plot.

    Args:
        frames: Sightings of each pair, in driving order.
        distances: Distance driven [F] float64 by odometry, m; increasing if the cameras moved to their own right.
        calibration: Calibration of the cameras.
        columns: Half-open range of image columns without black borders; None for all.

    Returns:
        Tracks in the order in which the robot passed them, including those not counted, and the robot's path.
    """
    tracks: list[_OpenTrack] = []
    positions = np.zeros(len(frames))
    correction = 0.0
    driven = np.asarray(distances, float) - (distances[0] if len(distances) else 0.0)
    row = [sighting.depth_m for sightings in frames for sighting in sightings if sighting.depth_m is not None]
    usual = near_row_depth(row) if row else _USUAL_DEPTH
    for frame, sightings in enumerate(frames):
        view = _PairView.of(sightings, calibration, usual)
        positions[frame] = driven[frame] + correction
        pairs = _assign(tracks, view, positions[frame], frame)
        moves = [tracks[track].locate()[0] - view.along[new] - positions[frame] for track, new in pairs if view.is_in_row[new]]
        if len(moves) >= 3:
            correction += float(np.median(moves))
            positions[frame] = driven[frame] + correction
            pairs = _assign(tracks, view, positions[frame], frame)
        taken = {new: track for track, new in pairs}
        for new in map(int, np.flatnonzero(view.is_candidate)):
            depth = float(view.depth[new]) if view.is_measured[new] else math.nan
            if new in taken:
                track = tracks[taken[new]]
                along = view.along[new] if view.is_measured[new] else view.along_at(track.locate()[1])[new]
            else:
                track, along = _OpenTrack(), view.along[new]
                tracks.append(track)
            track.sightings.append((frame, new))
            track.along.append(float(along + positions[frame]))
            track.depth.append(depth)
            track.rays.append((float(positions[frame]) - view.half, float(view.rays[new])))
            track.feet.append(float(along + positions[frame] - view.foot_offset[new]))
    step = float(np.median(np.diff(positions))) if len(positions) > 1 else 0.0
    field = tuple(
        (column - 0.5 - calibration.centre[0]) / calibration.focal for column in columns or (0.0, float(calibration.width))
    )
    length = abs(float(positions[-1] - positions[0]) + step) if len(positions) else 0.0
    in_view = [ray * usual - 0.5 * calibration.baseline for ray in field]
    path = RobotPath(positions, length, _seen_fraction(positions, step, in_view), usual)
    closed = [_finish_track(track, path, step, field) for track in _merge_tracks(tracks)]
    return sorted(closed, key=lambda track: track.position_m * (-1.0 if step < 0 else 1.0)), path


def _seen_fraction(positions: np.ndarray, step: float, field: list[float]) -> float:
    """Return the fraction of the row beside the path that is in view of any pair.

    Args:
        positions: Position [F] float64 of each pair along the row, m.
        step: Distance between two pairs, m.
        field: Ends of the field of view along the row, relative to the position of the pair, m.
    """
    if not len(positions):
        return 0.0
    points = np.linspace(positions[0] - 0.5 * step, positions[-1] + 0.5 * step, 201)
    offsets = points[:, None] - positions
    return float(((offsets >= field[0]) & (offsets <= field[1])).any(axis=1).mean())


@dataclasses.dataclass(frozen=True)
class _PairView:
    """Positions of the sightings of one pair, arrays [N].

    Attributes:
        rays: Tangent of the horizontal angle at which the left camera sees the stalk.
        along: Position along the row relative to the midpoint of the cameras, m; at the usual depth if not measured.
        depth: Depth of the front surface, m; NaN if not measured.
        is_measured: True if position and depth were measured; behind the row, positions follow from the depth.
        is_in_row: True if they were measured, and not behind the row.
        is_candidate: True if the sighting may be a stalk of the row, or of one behind.
        foot_offset: Distance along the row from the stalk's foot to its measurement, m; 0 if its height is unknown.
        half: Half the baseline (scalar), m.
        usual: Depth of the row over all pairs (scalar), m.
    """

    rays: np.ndarray
    along: np.ndarray
    depth: np.ndarray
    is_measured: np.ndarray
    is_in_row: np.ndarray
    is_candidate: np.ndarray
    foot_offset: np.ndarray
    half: float
    usual: float

    @classmethod
    def of(cls, sightings: list[Sighting], calibration: Calibration, usual: float) -> "_PairView":
        """Compute the view of a pair from its sightings and the usual depth of the row, m."""
        half = 0.5 * calibration.baseline
        rays = np.array([(sighting.column - calibration.centre[0]) / calibration.focal for sighting in sightings])
        along = np.array([math.nan if sighting.along_m is None else sighting.along_m for sighting in sightings])
        depth = np.array([math.nan if sighting.depth_m is None else sighting.depth_m for sighting in sightings])
        # Stalks behind the row are tracked, too, so that those of their sightings that have no depth are known to be theirs.
        behind = depth > usual + _MAX_ROW_OFFSET
        along = np.where(behind & np.isnan(along), rays * depth - half, along)
        known = np.isfinite(along) & np.isfinite(depth)
        elsewhere = np.isfinite(depth) & ~known  # before the row
        over = np.array([_lean_offset(sighting) for sighting in sightings])
        along = np.where(known, along, rays * usual - half)
        candidates = ~elsewhere & _are_distinct(sightings)
        return cls(rays, along, depth, known, known & ~behind, candidates, over, half, usual)

    def along_at(self, depth: float) -> np.ndarray:
        """Return the positions along the row [N], m, assuming a ``depth`` in m; the usual depth if NaN."""
        return self.rays * (depth if math.isfinite(depth) else self.usual) - self.half


def _lean_offset(sighting: Sighting) -> float:
    """Return the distance along the row from a stalk's foot to the place of its measurement, m; 0 if unknown."""
    if sighting.height_m is None or sighting.lean_deg is None or abs(sighting.lean_deg) > _MAX_LEAN:
        return 0.0
    return sighting.height_m * math.tan(math.radians(sighting.lean_deg))


def _are_distinct(sightings: list[Sighting]) -> np.ndarray:
    """Return [N] bool, True for sightings of a pair that are distinct stalks: two stalks cannot intersect in space.

    Of two that do, the less certain one is a duplicate and marked False. The minimum distance is 60 % of that at which they
    touch, to allow for errors of diameters and positions.
    """
    own = np.ones(len(sightings), bool)
    order = sorted(range(len(sightings)), key=lambda place: -sightings[place].score * (0.1 + sightings[place].confidence))
    distinct: list[tuple[float, float, float]] = []
    for place in order:
        sighting = sightings[place]
        if sighting.along_m is None or sighting.depth_m is None or sighting.diameter_mm is None:
            continue
        here = (sighting.along_m, sighting.depth_m, 1e-3 * sighting.diameter_mm)
        if any(math.hypot(here[0] - x, here[1] - z) < _SOLID * 0.5 * (here[2] + wide) for x, z, wide in distinct):
            own[place] = False
        else:
            distinct.append(here)
    return own


def _assign(tracks: list[_OpenTrack], view: _PairView, position: float, frame: int) -> list[tuple[int, int]]:
    """Assign sightings to tracks by minimum cost; return pairs (track, sighting) of indices, each used at most once.

    A sighting without depth, seen where a track behind the row would be by now, more likely shows a stalk of the row before it.
    """
    if not tracks or not view.rays.size:
        return []
    there = np.array([track.locate() for track in tracks])
    # A sighting without depth is compared at the depth of the track.
    along = np.where(view.is_measured, view.along, [view.along_at(depth) for _, depth in there]) + position
    aside = np.abs(there[:, :1] - along) / _ALONG
    away = np.nan_to_num(np.abs(there[:, 1:] - view.depth[None]) / _DEPTH, nan=0.4)
    is_stale = np.array([track.is_stale(frame) for track in tracks]) & (there[:, 1] > view.usual + _MAX_ROW_OFFSET)
    price = aside + 0.5 * away + _ROW_FIRST_COST * (is_stale[:, None] & np.isnan(view.depth))
    cost = np.where((aside < 1.0) & (away < 1.0) & view.is_candidate, price, _FORBIDDEN_COST)
    rows, columns = linear_sum_assignment(cost)
    return [(int(row), int(column)) for row, column in zip(rows, columns) if cost[row, column] < _FORBIDDEN_COST]


def _merge_tracks(tracks: list[_OpenTrack]) -> list[_OpenTrack]:
    """Merge tracks of one stalk into the longer one, which is modified in place: same position, and hardly ever seen together.

    Tracks are also merged if they always lie on the same rays and one of the depths is wrong: of two stalks one behind the
    other, the cameras would see both as they move on.
    """
    merged: list[_OpenTrack] = []
    for track in sorted(tracks, key=lambda track: -len(track.sightings)):
        for other in merged:
            aside, away = _track_distance(track, other)
            shared = {frame for frame, _ in track.sightings} & {frame for frame, _ in other.sightings}
            # A wrongly assigned sighting may make both appear in one pair.
            near = aside < _MERGE and away < _DEPTH
            one_stalk = near or _one_behind(track, other) < _MERGE_ACROSS_DEPTHS
            if one_stalk and len(shared) <= _MAX_SHARED * len(track.sightings):
                other.sightings += track.sightings
                other.along += track.along
                other.depth += track.depth
                other.rays += track.rays
                other.feet += track.feet
                break
        else:
            merged.append(track)
    return merged


def _one_behind(track: _OpenTrack, other: _OpenTrack) -> float:
    """Return the distance along the row, m, between two tracks if ``track`` is placed at the depth of ``other``.

    It is infinite if ``track`` has a single sighting or ``other`` no depth.
    """
    depths = other.depths()
    if len(track.sightings) < 2 or not len(depths):
        return math.inf
    depth = float(np.median(depths))
    positions = np.array([offset + ray * depth for offset, ray in track.rays]) - float(np.median(other.along))
    return float(np.median(np.abs(positions)))


def _track_distance(track: _OpenTrack, other: _OpenTrack) -> tuple[float, float]:
    """Return the distances of two tracks along the row and in depth, m; if only one has a depth, it is assumed for both."""
    depths = track.depths(), other.depths()
    if all(map(len, depths)) or not any(map(len, depths)):
        aside = abs(float(np.median(track.along) - np.median(other.along)))
        return aside, abs(float(np.median(depths[0]) - np.median(depths[1]))) if len(depths[0]) else 0.0
    # One has no depth: assume that of the other.
    depth = float(np.median(np.concatenate(depths)))
    return abs(track.position_at(depth) - other.position_at(depth)), 0.0


def _finish_track(track: _OpenTrack, path: RobotPath, step: float, field: tuple[float, ...]) -> Track:
    position, usual = float(np.median(track.along)), path.row_depth
    depths = track.depths()
    depth = float(np.median(depths)) if depths.size else math.nan
    # Expected number of sightings: pairs with the stalk well inside the field of view.
    middle, half = (0.5 * (field[1] + sign * field[0]) * (depth if math.isfinite(depth) else usual) for sign in (1.0, -1.0))
    expected = int((np.abs(path.positions + middle - position) < 0.9 * half).sum())
    known = math.isfinite(depth)
    # A stalk without a measured depth must be seen twice as often.
    wanted = max(min(_MIN_PAIRS, expected), math.ceil((1.0 if known else 2.0) * _MIN_FRACTION * expected), 1)
    begin, end = sorted((path.positions[0] - 0.5 * step, path.positions[-1] + 0.5 * step))
    if known and abs(depth - usual) > _MAX_ROW_OFFSET:
        reason = f"it stands {abs(depth - usual):.2f} m {'behind' if depth > usual else 'before'} the row"
    elif len(track.sightings) < wanted:
        reason = f"seen in {len(track.sightings)} of {expected} pairs"
    elif not begin - _END_MARGIN <= float(np.median(track.feet)) <= end + _END_MARGIN:
        reason = "it stands beyond the ends of the path"
    else:
        reason = ""
    return Track(tuple(sorted(track.sightings)), position, depth, not reason, reason)
