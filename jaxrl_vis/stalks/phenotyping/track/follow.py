"""Tracks: sightings in several pairs that are one stalk, and its position along the row.

The robot says how far it has driven, to a few per cent; stereo says where a stalk stands beside it, to millimetres. A stalk's
place along the row is their sum and stays the same from pair to pair, so a sighting belongs to the stalk that stands where it
is. What most stalks moved by between two pairs corrects the robot's odometry.
"""

import dataclasses
import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxrl_vis.stalks.phenotyping.track.sightings import Sighting
from jaxrl_vis_envs.plants import Calibration

_USUAL_DEPTH = 0.8  # m, where no pair says
_SOLID = 0.6  # of the distance at which two stalks touch
_MAX_LEAN = 25.0  # degrees: what leans further was measured wrongly
_FORBIDDEN_COST = 1e3  # cost of what does not belong together


@dataclasses.dataclass(frozen=True)
class Gates:
    """Limits of what belongs together, lengths in m.

    Attributes:
        along: Greatest distance along the row between a stalk and a sighting of it.
        depth: The same away from the cameras.
        merge: Along the row, between two pieces of one stalk's track.
        behind: The same, of pieces of which one has another depth, if it had not.
        astray: Share of the pairs of the shorter piece that may show both.
        row: Away from the cameras, between a stalk of the row and most others.
        share: Share of the pairs that should show a stalk which must show it.
        least: Least number of pairs that must show it, if so many can.
        ends: Distance beyond the ends of the path within which a stalk's foot still counts.
    """

    along: float = 0.018
    depth: float = 0.05
    merge: float = 0.015
    behind: float = 0.005
    astray: float = 0.34
    row: float = 0.2
    share: float = 0.3
    least: int = 2
    ends: float = 0.01


@dataclasses.dataclass(frozen=True)
class Track:
    """One stalk.

    Attributes:
        sightings: Pair and place in its list of each sighting.
        position_m: Along the row, from where the robot was at the first pair.
        depth_m: From the cameras; not a number where no pair says.
        counted: It counts: enough pairs show it, and it stands beside the path.
        reason: Why it does not count; empty where it does.
    """

    sightings: tuple[tuple[int, int], ...]
    position_m: float
    depth_m: float
    counted: bool
    reason: str


@dataclasses.dataclass(frozen=True)
class Path:
    """The robot's path.

    Attributes:
        places: [F] float64, of each pair along the row, m: odometry, corrected by what stereo saw.
        length: Length of the row that it passed, m: half a step more at each end.
        seen: Share of that length which any pair shows.
    """

    places: np.ndarray
    length: float
    seen: float = 1.0


@dataclasses.dataclass
class _Open:
    """A track in the making."""

    sightings: list[tuple[int, int]] = dataclasses.field(default_factory=list)
    along: list[float] = dataclasses.field(default_factory=list)
    depth: list[float] = dataclasses.field(default_factory=list)
    rays: list[tuple[float, float]] = dataclasses.field(default_factory=list)
    feet: list[float] = dataclasses.field(default_factory=list)

    def depths(self) -> np.ndarray:
        """Return its depth as the last pairs measured it, m."""
        return np.array(self.depth)[np.isfinite(self.depth)]

    def at(self, depth: float) -> float:
        """Return its position along the row if it were at a depth in m, m."""
        return float(np.median([offset + ray * depth for offset, ray in self.rays]))

    def place(self) -> tuple[float, float]:
        depths = [depth for depth in self.depth[-9:] if math.isfinite(depth)]
        return float(np.median(self.along[-9:])), float(np.median(depths)) if depths else math.nan


def follow(
    frames: list[list[Sighting]],
    distances: np.ndarray,
    calibration: Calibration,
    gates: Gates = Gates(),
    columns: tuple[float, float] | None = None,
) -> tuple[list[Track], Path]:
    """Put the sightings of a plot together.

    Args:
        frames: Sightings of each pair, in the order in which the robot passed.
        distances: [F] float64, how far it had driven by its odometry, m.
        calibration: Calibration of the cameras.
        gates: Limits of what belongs together.
        columns: First column of the images that shows anything, and one past the last; None for all.
    """
    tracks: list[_Open] = []
    places = np.zeros(len(frames))
    correction = 0.0
    driven = np.asarray(distances, float) - (distances[0] if len(distances) else 0.0)
    row = [sighting.depth_m for sightings in frames for sighting in sightings if sighting.depth_m is not None]
    usual = float(np.median(row)) if row else _USUAL_DEPTH
    for frame, sightings in enumerate(frames):
        view = _PairView.of(sightings, calibration, usual)
        places[frame] = driven[frame] + correction
        pairs = _assign(tracks, view, places[frame], gates)
        moves = [tracks[track].place()[0] - view.along[new] - places[frame] for track, new in pairs if view.known[new]]
        if len(moves) >= 3:
            correction += float(np.median(moves))
            places[frame] = driven[frame] + correction
            pairs = _assign(tracks, view, places[frame], gates)
        taken = {new: track for track, new in pairs}
        for new in map(int, np.flatnonzero(view.there)):
            depth = float(view.depth[new]) if view.known[new] else math.nan
            if new in taken:
                track = tracks[taken[new]]
                along = view.along[new] if view.known[new] else view.beside(track.place()[1])[new]
            else:
                track, along = _Open(), view.along[new]
                tracks.append(track)
            track.sightings.append((frame, new))
            track.along.append(float(along + places[frame]))
            track.depth.append(depth)
            track.rays.append((float(places[frame]) - view.half, float(view.rays[new])))
            track.feet.append(float(along + places[frame] - view.over[new]))
    step = float(np.median(np.diff(places))) if len(places) > 1 else 0.0
    field = tuple(
        (column - 0.5 - calibration.centre[0]) / calibration.focal for column in columns or (0.0, float(calibration.width))
    )
    length = abs(float(places[-1] - places[0]) + step) if len(places) else 0.0
    path = Path(places, length, _seen(places, step, [ray * usual - 0.5 * calibration.baseline for ray in field]))
    closed = [_closed(track, path, step, field, usual, gates) for track in _merged(tracks, gates)]
    return sorted(closed, key=lambda track: track.position_m * (-1.0 if step < 0 else 1.0)), path


def _seen(places: np.ndarray, step: float, field: list[float]) -> float:
    """Return the share of the row beside the path that any pair shows.

    Args:
        places: [F] float64, of each pair along the row, m.
        step: Distance between two pairs, m.
        field: Both ends of what a pair shows of the row, from the pair's place, m.
    """
    if not len(places):
        return 0.0
    points = np.linspace(places[0] - 0.5 * step, places[-1] + 0.5 * step, 201)
    beside = points[:, None] - places
    return float(((beside >= field[0]) & (beside <= field[1])).any(axis=1).mean())


@dataclasses.dataclass(frozen=True)
class _PairView:
    """Positions of the sightings of one pair, arrays [N].

    Attributes:
        rays: Tangent of the angle at which the left camera sees a stalk.
        along: Beside the middle between the cameras, m; taken to be as far away as most where the pair does not say.
        depth: Depth of the fronts, m.
        known: The pair measured its depth.
        there: It may be a stalk of the row.
        over: Distance along the row between its foot and the place of its measurement, m; 0 if its height is not known.
        half: Half the baseline, m.
        usual: Usual depth, m.
    """

    rays: np.ndarray
    along: np.ndarray
    depth: np.ndarray
    known: np.ndarray
    there: np.ndarray
    over: np.ndarray
    half: float
    usual: float

    @classmethod
    def of(cls, sightings: list[Sighting], calibration: Calibration, usual: float) -> "_PairView":
        rays = np.array([(sighting.column - calibration.centre[0]) / calibration.focal for sighting in sightings])
        along = np.array([math.nan if sighting.along_m is None else sighting.along_m for sighting in sightings])
        depth = np.array([math.nan if sighting.depth_m is None else sighting.depth_m for sighting in sightings])
        known = np.isfinite(along) & np.isfinite(depth)
        # What stands elsewhere is no stalk of the row.
        elsewhere = np.array([sighting.depth_m is not None and sighting.along_m is None for sighting in sightings], bool)
        over = np.array([_over(sighting) for sighting in sightings])
        half = 0.5 * calibration.baseline
        along = np.where(known, along, rays * usual - half)
        return cls(rays, along, depth, known, ~elsewhere & _apart_in_space(sightings), over, half, usual)

    def beside(self, depth: float) -> np.ndarray:
        """Return their positions along the row, [N], if they were at a depth in m, m."""
        return self.rays * (depth if math.isfinite(depth) else self.usual) - self.half


def _over(sighting: Sighting) -> float:
    """Return the distance along the row between a stalk's foot and the place where it was measured, m."""
    if sighting.height_m is None or sighting.lean_deg is None or abs(sighting.lean_deg) > _MAX_LEAN:
        return 0.0
    return sighting.height_m * math.tan(math.radians(sighting.lean_deg))


def _apart_in_space(sightings: list[Sighting]) -> np.ndarray:
    """Return True for the sightings of a pair that may be stalks of their own, [N] bool: two cannot stand in one place.

    Of two that do, one was found twice, and the less certain one goes. Their measured diameters are taken to be too large by up
    to 40 % together with the error of their places.
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


def _assign(tracks: list[_Open], view: _PairView, place: float, gates: Gates) -> list[tuple[int, int]]:
    """Assign sightings to tracks: pairs of indices, every index at most once."""
    if not tracks or not view.rays.size:
        return []
    there = np.array([track.place() for track in tracks])
    # A sighting that does not say how far away it is, is looked for where the camera would see the track's stalk.
    along = np.where(view.known, view.along, [view.beside(depth) for _, depth in there]) + place
    aside = np.abs(there[:, :1] - along) / gates.along
    away = np.nan_to_num(np.abs(there[:, 1:] - view.depth[None]) / gates.depth, nan=0.4)
    cost = np.where((aside < 1.0) & (away < 1.0) & view.there, aside + 0.5 * away, _FORBIDDEN_COST)
    rows, columns = linear_sum_assignment(cost)
    return [(int(row), int(column)) for row, column in zip(rows, columns) if cost[row, column] < _FORBIDDEN_COST]


def _merged(tracks: list[_Open], gates: Gates) -> list[_Open]:
    """Return the tracks without those that continue where another one was lost: they stand in one place and no pair shows both.

    Or they are seen in one place, always, and one depth is wrong: of two solid stalks that stand behind each other, the cameras
    would see both as soon as they have moved on.
    """
    merged: list[_Open] = []
    for track in sorted(tracks, key=lambda track: -len(track.sightings)):
        for other in merged:
            aside, away = _apart(track, other)
            shared = {frame for frame, _ in track.sightings} & {frame for frame, _ in other.sightings}
            # A sighting that went astray may make one pair show both.
            near = aside < gates.merge and away < gates.depth
            if (near or _one_behind(track, other) < gates.behind) and len(shared) <= gates.astray * len(track.sightings):
                other.sightings += track.sightings
                other.along += track.along
                other.depth += track.depth
                other.rays += track.rays
                other.feet += track.feet
                break
        else:
            merged.append(track)
    return merged


def _one_behind(track: _Open, other: _Open) -> float:
    """Return the distance along the row, m, between two tracks if both were as far away as the other one."""
    depths = other.depths()
    if len(track.sightings) < 2 or not len(depths):
        return math.inf
    depth = float(np.median(depths))
    beside = np.array([offset + ray * depth for offset, ray in track.rays]) - float(np.median(other.along))
    return float(np.median(np.abs(beside)))


def _apart(track: _Open, other: _Open) -> tuple[float, float]:
    """Return the distances of two tracks along the row and away from the cameras, m."""
    depths = track.depths(), other.depths()
    if all(map(len, depths)) or not any(map(len, depths)):
        aside = abs(float(np.median(track.along) - np.median(other.along)))
        return aside, abs(float(np.median(depths[0]) - np.median(depths[1]))) if len(depths[0]) else 0.0
    # One does not say how far away it is: it is taken to be as far away as the other.
    depth = float(np.median(np.concatenate(depths)))
    return abs(track.at(depth) - other.at(depth)), 0.0


def _closed(track: _Open, path: Path, step: float, field: tuple[float, ...], usual: float, gates: Gates) -> Track:
    position = float(np.median(track.along))
    depths = track.depths()
    depth = float(np.median(depths)) if depths.size else math.nan
    # What matters is how many pairs have the stalk well inside.
    middle, half = (0.5 * (field[1] + sign * field[0]) * (depth if math.isfinite(depth) else usual) for sign in (1.0, -1.0))
    expected = int((np.abs(path.places + middle - position) < 0.9 * half).sum())
    known = math.isfinite(depth)
    # What no pair says the distance of must be seen the more often.
    wanted = max(min(gates.least, expected), math.ceil((1.0 if known else 2.0) * gates.share * expected), 1)
    begin, end = sorted((path.places[0] - 0.5 * step, path.places[-1] + 0.5 * step))
    if len(track.sightings) < wanted:
        reason = f"seen in {len(track.sightings)} of {expected} pairs"
    elif known and abs(depth - usual) > gates.row:
        reason = f"it stands {abs(depth - usual):.2f} m {'behind' if depth > usual else 'before'} the row"
    elif not begin - gates.ends <= float(np.median(track.feet)) <= end + gates.ends:
        reason = "it stands beyond the ends of the path"
    else:
        reason = ""
    return Track(tuple(sorted(track.sightings)), position, depth, not reason, reason)
