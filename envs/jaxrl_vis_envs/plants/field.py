"""One plot of a family: which stalks and leaves stand where, in metres. NumPy only.

World frame: x along the row, 0 to the plot's length; y away from the cameras, 0 at the near row's middle line; z up, 0 at the
ground. A field at rest; whoever bends its stalks (wind, an arm) replaces their `Stalk.points`, and everything else follows.
"""

import dataclasses
import math
import numbers

import numpy as np

from jaxrl_vis_envs.plants.family import INCH, Family, Layout, Range, Stalks

KNOT_SPACING = 0.04
"""Greatest distance of knots along a stalk of the near row, m."""
_NODE_HALF_LENGTH = 0.009


@dataclasses.dataclass(frozen=True)
class Stalk:
    """One stalk, as a chain of tapered oval cones.

    Attributes:
        row: 0 is the near row, which is measured; others stand behind it.
        points: [K, 3] float64, middle of the stalk at each knot, m, from the ground upwards.
        radius: [K] float64, mean radius at each knot, sheath and node included, m.
        bare_radius: [K] float64, the same without sheaths and nodes, m.
        arc: [K] float64, length along the stalk at each knot, m.
        sheath: [K] float64, 1 where a sheath covers the stalk, else 0.
        nodes: [N] float64, arc length of each node, m.
        ovality: Greatest over least diameter.
        oval_angle: Direction of the greatest diameter from the x axis, rad.
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
        """Where the stalk is at a height above the ground in m: its middle [3] in m, and its arc length there in m."""
        arc = float(np.interp(height, self.points[:, 2], self.arc))
        return np.array([np.interp(arc, self.arc, self.points[:, axis]) for axis in range(3)]), arc

    def diameter(self, height: float, bare: bool = False) -> float:
        """Extent of the cross section along the row, which is what the cameras face, at a height in m; in m.

        Args:
            height: Above the ground, m.
            bare: Without sheaths and nodes.
        """
        _, arc = self.at_height(height)
        mean = 2.0 * float(np.interp(arc, self.arc, self.bare_radius if bare else self.radius))
        along, across = self.semi_axes
        return mean * math.hypot(along * math.cos(self.oval_angle), across * math.sin(self.oval_angle))

    @property
    def semi_axes(self) -> tuple[float, float]:
        """Half the greatest and half the least diameter, of the mean radius."""
        root = math.sqrt(self.ovality)
        return root, 1.0 / root

    def node_distance(self, height: float) -> float:
        """Distance along the stalk from a height in m to the next node, m."""
        _, arc = self.at_height(height)
        return float(np.abs(self.nodes - arc).min(initial=math.inf))


@dataclasses.dataclass(frozen=True)
class Leaf:
    """One leaf, as a bent ribbon.

    Attributes:
        stalk: Index of its stalk; -1 for litter.
        middle: [K, 3] float64, knots of the midrib, m.
        across: [K, 3] float64, unit vectors from the midrib to the edge.
        half_width: [K] float64, m.
        dry: Whether it is dry.
    """

    stalk: int
    middle: np.ndarray
    across: np.ndarray
    half_width: np.ndarray
    dry: bool


@dataclasses.dataclass(frozen=True)
class Plot:
    """What stands in a plot and behind it.

    Attributes:
        family: What it was drawn from.
        seed: With which seed.
        stalks: Those of the near row first, sorted by where they stand.
        leaves: All leaves and the litter.
    """

    family: Family
    seed: int
    stalks: tuple[Stalk, ...]
    leaves: tuple[Leaf, ...]

    @property
    def measured(self) -> tuple[Stalk, ...]:
        """The stalks of the near row: what is counted and measured."""
        return tuple(stalk for stalk in self.stalks if stalk.row == 0)


def generator(family: Family, seed: int, purpose: str) -> np.random.Generator:
    """Random numbers for one purpose in one plot; those of different families, seeds and purposes are independent.

    Raises:
        ValueError: The seed is no whole number of at least 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or seed < 0:
        raise ValueError(f"the seed of a plot must be a whole number of at least 0, got {seed!r}")
    return np.random.default_rng(np.random.SeedSequence([family.stream, seed, *purpose.encode()]))


def draw(family: Family, seed: int) -> Plot:
    """Draws a plot.

    Args:
        family: What to draw from.
        seed: At least 0; equal families and seeds give equal plots.

    Raises:
        ValueError: The seed is no whole number of at least 0.
    """
    stalks: list[Stalk] = []
    layout = family.layout
    for row in range(1 + layout.rows_behind):
        rng = generator(family, seed, f"row {row}")
        lean_sd = rng.uniform(*family.stalks.lean_sd)
        # Rows behind go on beside the plot: through the alley's gap the cameras see further along them.
        margin = 0.0 if row == 0 else 1.2 + 0.6 * row
        for x, y in sorted(_places(rng, layout, margin)):
            place = np.array([x, y + row * layout.row_spacing])
            stalks.append(_stalk(rng, family.stalks, row, place, lean_sd))
    rng = generator(family, seed, "leaves")
    leaves = [leaf for index, stalk in enumerate(stalks) for leaf in _leaves(rng, family, index, stalk)]
    leaves += _litter(rng, family)
    return Plot(family, seed, tuple(stalks), tuple(leaves))


def _places(rng: np.random.Generator, layout: Layout, margin: float) -> list[tuple[float, float]]:
    """Where the stalks of one row stand: (x, y) in m."""
    length = layout.plot_length + 2 * margin
    share = length / layout.plot_length
    count = max(round(share * rng.normal(layout.stalks_mean, layout.stalks_sd)), 0)
    tillers = min(int(rng.binomial(count, layout.tillers)), max(count - 1, 0))  # somebody must be the mother
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
    places = [(float(each), float(rng.normal(0.0, layout.offset_sd))) for each in x - margin]
    least = 0.75 * layout.spacing_minimum  # of a tiller, which grows out of the same root
    for _ in range(tillers):
        # A place that is too near another stalk is drawn again, in time from other mothers and from further away.
        for attempt in range(200):
            mother = places[rng.integers(mothers)]
            distance = least + (layout.clump_radius - least) * math.sqrt(rng.random()) * (1.0 + attempt / 50.0)
            angle = rng.uniform(-math.pi, math.pi)
            place = (mother[0] + distance * math.cos(angle), mother[1] + distance * math.sin(angle))
            inside = -margin <= place[0] <= layout.plot_length + margin
            if inside and all(math.dist(place, other) >= least for other in places):
                break
        places.append(place)
    return places


def _stalk(rng: np.random.Generator, shape: Stalks, row: int, place: np.ndarray, lean_sd: float) -> Stalk:
    """Draws one stalk that stands at ``place`` [2], m."""
    height = rng.uniform(*shape.height)
    nodes = np.cumsum(rng.uniform(*shape.node_spacing, size=64))
    nodes = nodes[nodes < height - 0.05]
    # Sheaths reach from their node towards the next one or beyond it.
    lengths = rng.uniform(*shape.sheath_length, size=nodes.size)
    kept = rng.random(nodes.size) < shape.sheaths
    thickness = rng.uniform(*shape.sheath_thickness, size=nodes.size)
    swelling = rng.uniform(*shape.node_swelling, size=nodes.size)
    ends = (nodes + lengths)[kept]
    spacing = KNOT_SPACING if row == 0 else 2.5 * KNOT_SPACING
    even = np.linspace(0.0, height, math.ceil(height / spacing) + 1)
    around = nodes[:, None] + _NODE_HALF_LENGTH * np.array([-1.0, -0.5, 0.0, 0.5, 1.0] if row == 0 else [-1.0, 0.0, 1.0])
    steps = ends[:, None] + np.array([-1.5e-3, 1.5e-3])
    arc = np.unique(np.clip(np.concatenate([even, around.ravel(), steps.ravel()]), 0.0, height))
    arc = arc[np.concatenate([[True], np.diff(arc) > 5e-4])]

    bare = _bare_diameter(rng, shape, arc) / 2.0
    over = np.zeros_like(arc)
    sheath = np.zeros_like(arc)
    for start, end, thick in zip(nodes[kept], ends, thickness[kept]):
        inside = (arc >= start) & (arc <= end)
        over = np.maximum(over, inside * thick)
        sheath = np.maximum(sheath, inside)
    bump = np.zeros_like(arc)
    for node, share in zip(nodes, swelling):
        profile = np.clip(1.0 - np.abs(arc - node) / _NODE_HALF_LENGTH, 0.0, 1.0)
        bump = np.maximum(bump, share * np.sin(0.5 * math.pi * profile) ** 2)
    points = _middle_line(rng, shape, arc, nodes, lean_sd)
    points[:, :2] += place
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
    """Diameter [K] in m without sheaths and nodes: linear up to 26 inches, then ever slower, as it cannot reach 0."""
    at_12 = max(rng.normal(shape.diameter_mean, shape.diameter_sd), shape.diameter_least)
    taper = shape.taper * at_12 / max(shape.diameter_mean, 1e-6) * max(1.0 + shape.taper_spread * rng.normal(), 0.1)
    turn = 26 * INCH
    at_turn = at_12 - taper * (turn - 12 * INCH)
    # The rest shrinks towards 0.55 of what it is there.
    rest = 0.45 * max(at_turn, 0.3 * at_12)
    above = rest * -np.expm1(-taper * np.maximum(arc - turn, 0.0) / rest)
    return np.maximum(at_12 - taper * (np.minimum(arc, turn) - 12 * INCH) - above, 0.3 * at_12)


def _middle_line(rng: np.random.Generator, shape: Stalks, arc: np.ndarray, nodes: np.ndarray, lean_sd: float) -> np.ndarray:
    """Points [K, 3] in m along a stalk that starts at the origin."""
    lean = np.radians(np.clip(rng.normal(0.0, lean_sd, 2), -shape.lean_most, shape.lean_most))
    curvature = rng.normal(0.0, shape.curvature_sd, 2)
    kinks = np.radians(rng.normal(0.0, shape.zigzag, (nodes.size, 2)))
    middle = 0.5 * (arc[1:] + arc[:-1])
    # Zigzag is a change of direction that the next node takes back in part, so it does not add up to a lean.
    passed = (middle[:, None] > nodes[None, :]).astype(float)
    sway = passed * 0.6 ** np.maximum(np.cumsum(passed[:, ::-1], axis=1)[:, ::-1] - 1.0, 0.0)
    angle = lean + curvature * middle[:, None] + sway @ kinks
    # Stalks do not bend over: they right themselves towards the light.
    angle = np.clip(angle, -0.45, 0.45)
    direction = np.stack([np.tan(angle[:, 0]), np.tan(angle[:, 1]), np.ones_like(middle)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(direction * np.diff(arc)[:, None], axis=0)])


def _leaves(rng: np.random.Generator, family: Family, index: int, stalk: Stalk) -> list[Leaf]:
    """Draws the leaves of one stalk, which sit opposite each other in turn."""
    shape = family.leaves
    plane = rng.uniform(0.0, math.pi)
    found = []
    for place, node in enumerate(stalk.nodes):
        collar = np.array([np.interp(node + rng.uniform(0.03, 0.09), stalk.arc, stalk.points[:, axis]) for axis in range(3)])
        expected = shape.lower if collar[2] < 0.3 else shape.middle if collar[2] < 0.8 else shape.upper
        count = math.floor(expected * shape.density + rng.random())
        for extra in range(count):
            azimuth = plane + math.pi * (place + extra) + rng.normal(0.0, 0.35)
            dry = rng.random() < (shape.dry if collar[2] < 0.8 else shape.dry / 3)
            found.append(_leaf(rng, family, index, collar, azimuth, dry, coarse=stalk.row > 0))
    return found


def _leaf(
    rng: np.random.Generator, family: Family, index: int, collar: np.ndarray, azimuth: float, dry: bool, coarse: bool
) -> Leaf:
    """Draws one leaf: a green one arches out and over, a dry one hangs down beside its stalk, curled and broken."""
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
    # Angle from the vertical: a dry leaf turns down soon after its collar, a green one over its whole length.
    turned = np.tanh(along / early) / math.tanh(1.0 / early) if dry else along**early
    tilt = start + bend * turned + (rng.normal(0.0, 0.08, knots).cumsum() if dry else 0.0)
    heading = azimuth + rng.normal(0.0, 0.25 if dry else 0.06, knots).cumsum()
    step = length / (knots - 1)
    # The rig bends aside what grows towards it.
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
    """Draws the pieces of dry leaf that lie on the ground."""
    layout = family.layout
    length = layout.plot_length + 2.0
    found = []
    for _ in range(rng.poisson(family.leaves.litter * family.leaves.density * length)):
        x, y = rng.uniform(-1.0, layout.plot_length + 1.0), rng.uniform(-0.25, 1.2)
        heading = rng.uniform(-math.pi, math.pi) + rng.normal(0.0, 0.25, 5).cumsum()
        size, width = _between(rng, (0.04, 0.22)), _between(rng, (0.004, 0.02))
        steps = np.stack([np.cos(heading), np.sin(heading), rng.normal(0.0, 0.12, 5)], axis=1) * size / 4
        middle = np.array([x, y, 0.006]) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps[:-1], axis=0)])
        middle[:, 2] = np.maximum(middle[:, 2], 0.003)
        across = np.stack([-np.sin(heading), np.cos(heading), rng.normal(0.0, 0.4, 5)], axis=1)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        profile = np.sqrt(np.clip(1.0 - np.linspace(-0.9, 1.0, 5) ** 4, 0.0, 1.0))
        found.append(Leaf(-1, middle, across, 0.5 * width * profile, True))
    return found


def _between(rng: np.random.Generator, bounds: Range) -> float:
    """Drawn so that small values are more frequent."""
    low, high = bounds
    return low * (high / low) ** rng.random()
