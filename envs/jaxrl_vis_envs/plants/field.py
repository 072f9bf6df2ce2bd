"""Plots sampled from a family: positions and shapes of stalks and leaves in metres. NumPy only.

World frame: x along the row, 0 to the plot's length; y away from the cameras, 0 at the near row's centre line; z up, 0 at the
ground. The field is at rest; to bend stalks (wind, an arm), replace their `Stalk.points`, and everything else follows.
"""

import dataclasses
import math
import numbers

import numpy as np

from jaxrl_vis_envs.plants.family import INCH, Family, Layout, Range, Stalks
from jaxrl_vis_envs.plants.settling import settle

KNOT_SPACING = 0.04
"""Maximum distance of knots along a stalk of the near row, m."""
_NODE_HALF_LENGTH = 0.009


@dataclasses.dataclass(frozen=True)
class Stalk:
    """One stalk, as a chain of tapered elliptic cones.

    Attributes:
        row: 0 for the near row, which is measured; higher for the rows behind; -1 for round objects (`clutter`).
        points: [K, 3] float64, centre of the stalk at each knot, m, from the ground upwards.
        radius: [K] float64, mean radius at each knot, including sheath and node, m.
        bare_radius: [K] float64, mean radius without sheaths and nodes, m.
        arc: [K] float64, arc length along the stalk at each knot, m.
        sheath: [K] float64, 1 where a sheath covers the stalk, else 0.
        nodes: [N] float64, arc length of each node, m.
        ovality: Ratio of maximum to minimum diameter.
        oval_angle: Direction of the maximum diameter from the x axis, rad.
    """

    row: int
    points: np.ndarray
    radius: np.ndarray
    bare_radius: np.ndarray
    arc: np.ndarray
    sheath: np.ndarray
    nodes: np.ndarray
    ovality: float
    oval_angle: float

    def at_height(self, height: float) -> tuple[np.ndarray, float]:
        """Return the centre [3] (m) of the stalk at a height above the ground (m), and the arc length there (m)."""
        arc = float(np.interp(height, self.points[:, 2], self.arc))
        return np.array([np.interp(arc, self.arc, self.points[:, axis]) for axis in range(3)]), arc

    def diameter(self, height: float, bare: bool = False) -> float:
        """Return the extent (m) of the cross section along the row, as seen by the cameras.

        Args:
            height: Height above the ground, m.
            bare: True to exclude sheaths and nodes.
        """
        _, arc = self.at_height(height)
        mean = 2.0 * float(np.interp(arc, self.arc, self.bare_radius if bare else self.radius))
        along, across = self.semi_axes
        return mean * math.hypot(along * math.cos(self.oval_angle), across * math.sin(self.oval_angle))

    @property
    def semi_axes(self) -> tuple[float, float]:
        """Half the maximum and half the minimum diameter, relative to the mean radius."""
        root = math.sqrt(self.ovality)
        return root, 1.0 / root

    def node_distance(self, height: float) -> float:
        """Return the distance (m) along the stalk from a height (m) to the nearest node; infinite without nodes."""
        _, arc = self.at_height(height)
        return float(np.abs(self.nodes - arc).min(initial=math.inf))


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One leaf, as a bent ribbon.

    Attributes:
        stalk: Index of its stalk; -1 for litter and flat objects (`clutter`).
        middle: [K, 3] float64, knots of the midrib, m.
        across: [K, 3] float64, unit vectors from the midrib to the edge.
        half_width: [K] float64, m.
        dry: True if it is dry.
    """

    stalk: int
    middle: np.ndarray
    across: np.ndarray
    half_width: np.ndarray
    dry: bool


@dataclasses.dataclass(frozen=True)
class Plot:
    """Contents of a plot, and of the rows behind it.

    Attributes:
        family: Family that it was sampled from, after `settle`: for daytime plots, with the values sampled for this plot.
        seed: Seed of the sample.
        stalks: Stalks, those of the near row first, sorted by position.
        leaves: All leaves and the litter.
    """

    family: Family
    seed: int
    stalks: tuple[Stalk, ...]
    leaves: tuple[Leaf, ...]

    @property
    def measured(self) -> tuple[Stalk, ...]:
        """Stalks of the near row, which are counted and measured."""
        return tuple(stalk for stalk in self.stalks if stalk.row == 0)


def generator(family: Family, seed: int, purpose: str) -> np.random.Generator:
    """Return the random generator for one purpose in one plot, independent of those for other families, seeds and purposes.

    Raises:
        ValueError: The seed is not an integer of at least 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or seed < 0:
        raise ValueError(f"the seed of a plot must be a whole number of at least 0, got {seed!r}")
    return np.random.default_rng(np.random.SeedSequence([family.stream, seed, *purpose.encode()]))


def draw(family: Family, seed: int) -> Plot:
    """Sample a plot.

    Args:
        family: Family to sample from.
        seed: Seed of the plot, at least 0; equal families and seeds give equal plots.

    Raises:
        ValueError: The seed is not an integer of at least 0.
    """
    family = settle(family, generator(family, seed, "scene"))
    stalks: list[Stalk] = []
    layout = family.layout
    for row in range(1 + layout.rows_behind):
        rng = generator(family, seed, f"row {row}")
        lean_sd = rng.uniform(*family.stalks.lean_sd)
        # Rows behind extend beyond the plot: through the alley, the cameras see further along them.
        margin = 0.0 if row == 0 else 1.2 + 0.6 * row
        for x, y in sorted(_sample_positions(rng, layout, margin)):
            position = np.array([x, y + row * layout.row_spacing])
            stalks.append(_stalk(rng, family.stalks, row, position, lean_sd))
    rng = generator(family, seed, "leaves")
    leaves = [leaf for index, stalk in enumerate(stalks) for leaf in _leaves(rng, family, index, stalk)]
    leaves += _litter(rng, family)
    return Plot(family, seed, tuple(stalks), tuple(leaves))


def _sample_positions(rng: np.random.Generator, layout: Layout, margin: float) -> list[tuple[float, float]]:
    """Sample positions (x, y) in m of the stalks of one row."""
    length = layout.plot_length + 2 * margin
    fraction = length / layout.plot_length
    count = max(round(fraction * rng.normal(layout.stalks_mean, layout.stalks_sd)), 0)
    tillers = min(int(rng.binomial(count, layout.tillers)), max(count - 1, 0))  # tillers need a mother plant
    mothers = count - tillers
    if not mothers:
        return []
    extra = rng.gamma(layout.spacing_shape, 1.0, mothers + 1)
    free = length - layout.spacing_minimum * (mothers - 1)
    gaps = rng.random(mothers + 1) < layout.gaps
    held = min(gaps.sum() * layout.gap_length, 0.4 * max(free, 0.0))
    extra = extra / extra.sum() * max(free - held, 0.0) + gaps * (held / max(gaps.sum(), 1))
    x = np.cumsum(extra)[:-1] + layout.spacing_minimum * np.arange(mothers) * min(
        1.0, length / (layout.spacing_minimum * mothers)
    )
    positions = [(float(offset), float(rng.normal(0.0, layout.offset_sd))) for offset in x - margin]
    minimum = 0.75 * layout.spacing_minimum  # distance of a tiller, which grows out of the same root
    for _ in range(tillers):
        # Positions too near another stalk are rejected; retries use other mothers and increasing distances.
        for attempt in range(200):
            mother = positions[rng.integers(mothers)]
            distance = minimum + (layout.clump_radius - minimum) * math.sqrt(rng.random()) * (1.0 + attempt / 50.0)
            angle = rng.uniform(-math.pi, math.pi)
            position = (mother[0] + distance * math.cos(angle), mother[1] + distance * math.sin(angle))
            inside = -margin <= position[0] <= layout.plot_length + margin
            if inside and all(math.dist(position, other) >= minimum for other in positions):
                break
        positions.append(position)
    return positions


def _stalk(rng: np.random.Generator, shape: Stalks, row: int, position: np.ndarray, lean_sd: float) -> Stalk:
    """Sample one stalk at ``position`` [2], m."""
    height = rng.uniform(*shape.height)
    nodes = np.cumsum(rng.uniform(*shape.node_spacing, size=64))
    nodes = nodes[nodes < height - 0.05]
    # Sheaths extend from their node towards the next one or beyond it.
    lengths = rng.uniform(*shape.sheath_length, size=nodes.size)
    has_sheath = rng.random(nodes.size) < shape.sheaths
    thickness = rng.uniform(*shape.sheath_thickness, size=nodes.size)
    swelling = rng.uniform(*shape.node_swelling, size=nodes.size)
    ends = (nodes + lengths)[has_sheath]
    spacing = KNOT_SPACING if row == 0 else 2.5 * KNOT_SPACING
    even = np.linspace(0.0, height, math.ceil(height / spacing) + 1)
    around = nodes[:, None] + _NODE_HALF_LENGTH * np.array([-1.0, -0.5, 0.0, 0.5, 1.0] if row == 0 else [-1.0, 0.0, 1.0])
    steps = ends[:, None] + np.array([-1.5e-3, 1.5e-3])
    arc = np.unique(np.clip(np.concatenate([even, around.ravel(), steps.ravel()]), 0.0, height))
    arc = arc[np.concatenate([[True], np.diff(arc) > 5e-4])]

    bare = _bare_diameter(rng, shape, arc) / 2.0
    over = np.zeros_like(arc)
    sheath = np.zeros_like(arc)
    for start, end, thick in zip(nodes[has_sheath], ends, thickness[has_sheath]):
        inside = (arc >= start) & (arc <= end)
        over = np.maximum(over, inside * thick)
        sheath = np.maximum(sheath, inside)
    bump = np.zeros_like(arc)
    for node, thickening in zip(nodes, swelling):
        profile = np.clip(1.0 - np.abs(arc - node) / _NODE_HALF_LENGTH, 0.0, 1.0)
        bump = np.maximum(bump, thickening * np.sin(0.5 * math.pi * profile) ** 2)
    points = _middle_line(rng, shape, arc, nodes, lean_sd)
    points[:, :2] += position
    return Stalk(
        row=row,
        points=points,
        radius=bare * (1.0 + bump) + over,
        bare_radius=bare,
        arc=arc,
        sheath=sheath,
        nodes=nodes,
        ovality=rng.uniform(*shape.ovality),
        oval_angle=rng.uniform(0.0, math.pi),
    )


def _bare_diameter(rng: np.random.Generator, shape: Stalks, arc: np.ndarray) -> np.ndarray:
    """Sample the diameter [K] (m) at ``arc`` [K] (m) without sheaths and nodes: linear up to 26 inches, then decaying."""
    at_12 = max(rng.normal(shape.diameter_mean, shape.diameter_sd), shape.diameter_least)
    taper = shape.taper * at_12 / max(shape.diameter_mean, 1e-6) * max(1.0 + shape.taper_spread * rng.normal(), 0.1)
    turn = 26 * INCH
    at_turn = at_12 - taper * (turn - 12 * INCH)
    # Beyond, it decays towards 0.55 of its value there.
    rest = 0.45 * max(at_turn, 0.3 * at_12)
    above = rest * -np.expm1(-taper * np.maximum(arc - turn, 0.0) / rest)
    return np.maximum(at_12 - taper * (np.minimum(arc, turn) - 12 * INCH) - above, 0.3 * at_12)


def _middle_line(rng: np.random.Generator, shape: Stalks, arc: np.ndarray, nodes: np.ndarray, lean_sd: float) -> np.ndarray:
    """Sample the centre line [K, 3] (m) of a stalk that starts at the origin, at arc lengths ``arc`` [K] (m)."""
    lean = np.radians(np.clip(rng.normal(0.0, lean_sd, 2), -shape.lean_most, shape.lean_most))
    curvature = rng.normal(0.0, shape.curvature_sd, 2)
    kinks = np.radians(rng.normal(0.0, shape.zigzag, (nodes.size, 2)))
    middle = 0.5 * (arc[1:] + arc[:-1])
    # Zigzag is a change of direction that the next node partly reverses, so it does not accumulate to a lean.
    passed = (middle[:, None] > nodes[None, :]).astype(float)
    sway = passed * 0.6 ** np.maximum(np.cumsum(passed[:, ::-1], axis=1)[:, ::-1] - 1.0, 0.0)
    angle = lean + curvature * middle[:, None] + sway @ kinks
    # Stalks do not bend over: they grow towards the light.
    angle = np.clip(angle, -0.45, 0.45)
    direction = np.stack([np.tan(angle[:, 0]), np.tan(angle[:, 1]), np.ones_like(middle)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(direction * np.diff(arc)[:, None], axis=0)])


def _leaves(rng: np.random.Generator, family: Family, index: int, stalk: Stalk) -> list[Leaf]:
    """Sample the leaves of one stalk, on alternating sides."""
    shape = family.leaves
    plane = rng.uniform(0.0, math.pi)
    leaves = []
    for number, node in enumerate(stalk.nodes):
        collar = np.array([np.interp(node + rng.uniform(0.03, 0.09), stalk.arc, stalk.points[:, axis]) for axis in range(3)])
        expected = shape.lower if collar[2] < 0.3 else shape.middle if collar[2] < 0.8 else shape.upper
        count = math.floor(expected * shape.density + rng.random())
        for extra in range(count):
            azimuth = plane + math.pi * (number + extra) + rng.normal(0.0, 0.35)
            dry = rng.random() < (shape.dry if collar[2] < 0.8 else shape.dry / 3)
            leaves.append(_leaf(rng, family, index, collar, azimuth, dry, coarse=stalk.row > 0))
    return leaves


def _leaf(
    rng: np.random.Generator, family: Family, index: int, collar: np.ndarray, azimuth: float, dry: bool, coarse: bool
) -> Leaf:
    """Sample one leaf: a green one arches out and over; a dry one hangs beside its stalk, curled and broken."""
    shape = family.leaves
    length = max(rng.normal(shape.length_mean, shape.length_sd), 0.1)
    width = max(rng.normal(shape.width_mean, shape.width_sd), 0.01)
    start = max(math.radians(rng.normal(shape.angle_mean, shape.angle_sd)), 0.1)
    if dry:
        length *= rng.uniform(0.2, 0.75)
        width *= rng.uniform(0.2, 0.55)
        bend = math.pi * rng.uniform(0.72, 1.0) - start
        knots, early = 6 if coarse else 9, rng.uniform(0.08, 0.25)
    else:
        bend = math.radians(rng.uniform(*shape.droop))
        knots, early = 8 if coarse else 13, rng.uniform(0.6, 1.4)
    along = np.linspace(0.0, 1.0, knots)
    # Angle from the vertical: a dry leaf bends down just beyond its collar, a green one over its whole length.
    bend_share = np.tanh(along / early) / math.tanh(1.0 / early) if dry else along**early
    tilt = start + bend * bend_share + (rng.normal(0.0, 0.08, knots).cumsum() if dry else 0.0)
    heading = azimuth + rng.normal(0.0, 0.25 if dry else 0.06, knots).cumsum()
    step = length / (knots - 1)
    # The rig pushes aside leaves that grow towards it.
    outward = np.stack([np.cos(heading), np.sin(heading), np.zeros(knots)], axis=1)
    outward[:, 1] = np.where(outward[:, 1] < 0.0, 0.35 * outward[:, 1], outward[:, 1])
    direction = np.sin(tilt)[:, None] * outward + np.cos(tilt)[:, None] * np.array([0.0, 0.0, 1.0])
    middle = collar + np.concatenate([np.zeros((1, 3)), np.cumsum(direction[:-1] * step, axis=0)])
    middle[:, 2] = np.maximum(middle[:, 2], 0.004)
    sideways = np.stack([-np.sin(heading), np.cos(heading), np.zeros(knots)], axis=1)
    normal = np.cross(direction, sideways)
    twist = rng.normal(0.0, 0.3 if dry else 0.08, knots).cumsum() + rng.normal(0.0, 0.5 if dry else 0.15)
    across = np.cos(twist)[:, None] * sideways + np.sin(twist)[:, None] * normal
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    profile = np.minimum(1.0, 0.22 + 2.8 * along) * np.clip(1.0 - along**1.8, 0.0, 1.0) ** 0.6
    return Leaf(index, middle, across, 0.5 * width * np.maximum(profile, 0.02), dry)


def _litter(rng: np.random.Generator, family: Family) -> list[Leaf]:
    """Sample the pieces of dry leaf on the ground."""
    layout = family.layout
    length = layout.plot_length + 2.0
    pieces = []
    for _ in range(rng.poisson(family.leaves.litter * family.leaves.density * length)):
        x, y = rng.uniform(-1.0, layout.plot_length + 1.0), rng.uniform(-0.25, 1.2)
        heading = rng.uniform(-math.pi, math.pi) + rng.normal(0.0, 0.25, 5).cumsum()
        size, width = _log_uniform(rng, (0.04, 0.22)), _log_uniform(rng, (0.004, 0.02))
        steps = np.stack([np.cos(heading), np.sin(heading), rng.normal(0.0, 0.12, 5)], axis=1) * size / 4
        middle = np.array([x, y, 0.006]) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps[:-1], axis=0)])
        middle[:, 2] = np.maximum(middle[:, 2], 0.003)
        across = np.stack([-np.sin(heading), np.cos(heading), rng.normal(0.0, 0.4, 5)], axis=1)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        profile = np.sqrt(np.clip(1.0 - np.linspace(-0.9, 1.0, 5) ** 4, 0.0, 1.0))
        pieces.append(Leaf(-1, middle, across, 0.5 * width * profile, True))
    return pieces


def _log_uniform(rng: np.random.Generator, bounds: Range) -> float:
    """Sample log-uniformly, so that small values are more frequent."""
    low, high = bounds
    return low * (high / low) ** rng.random()
