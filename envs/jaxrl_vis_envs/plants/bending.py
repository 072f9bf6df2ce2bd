"""Flexible stalks as bodies of a MuJoCo model, and the wind on them.

Each stalk is a chain of two capsules, with two hinges with springs and dampers at the ground and two at the knee, under a mocap
body, so that its position is part of the state. A stalk is a cantilever with the stiffness EI of a full round section. The
springs are chosen such that the chain, pushed at heights of 0.5 and 1.0 m, deflects exactly as the beam does (3 EI / z^3; at
0.8 m within 6 %, at 1.2 m within 8 %).

Sources: the dry rind of maize has a modulus of 6 to 16 GPa (Al-Zube et al., Plant Methods 14, 2018); a green, pith-filled stalk
as a whole is softer, and 2 GPa over the full section is assumed. Tall crops sway at about 1 to 2 Hz with a damping ratio near
0.1; the moving mass, stalk and leaves, is chosen such that a mean stalk sways at 1.4 Hz.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics import rotations
from jaxrl_vis_envs.plants.stand import KNEE, TOP, Stands

MODULUS = 2e9
"""Bending modulus of a full section, Pa."""
DENSITY = 950.0
"""Density of a green stalk, kg/m^3."""
_LEAVES = 1.5  # ratio of the mass with leaves to that of the bare stalk
_DAMPING_RATIO = 0.1
# Rotation of the hinges at the ground and at the knee, in 1/m, for a bending stiffness of 1 N m^2 and a moment of 1 N m.
_COMPLIANCE = (0.0863, 0.504)
SWAY_HEIGHT = 0.7
"""Height at which displacement by wind is specified, m: the middle of the arm's workspace."""
_GUST_FREQUENCIES = (0.1, 0.6)  # Hz
_GUST_WAVES = 3
_GUST_SPEED = 2.0  # m/s, speed of gusts along the row
_NOMINAL_RADIUS = 0.007
GREENS = ((0.55, 0.62, 0.25, 1), (0.62, 0.6, 0.3, 1), (0.47, 0.56, 0.22, 1))


class Layout(NamedTuple):
    """Indices of the stalks in a model, [N] int unless stated otherwise.

    Attributes:
        mocap: Index of each stalk's mocap body among the mocap bodies.
        lower, upper: Bodies of the segments; the same if stalks have no knee.
        lower_geom, upper_geom: Geoms of the segments; the same if stalks have no knee.
        joints: [N, P, 2], hinges about x and y, at ground and knee (P = 2) or at the ground alone (P = 1).
    """

    mocap: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    lower_geom: np.ndarray
    upper_geom: np.ndarray
    joints: np.ndarray


def add_stalks(spec: mujoco.MjSpec, stalks: int, pushed_by: tuple[str, ...], knees: bool = True) -> None:
    """Add upright stalks of mean thickness to a model, and their contact pairs.

    Contacts are frictionless: with friction, the two Newton iterations affordable per physics step do not find the forces of
    jaws that press from both sides, and stalks jump out of them.

    Args:
        spec: Model, changed in place.
        stalks: Number of stalks.
        pushed_by: Names of geoms that push the upper segments.
        knees: If False, stalks are one straight segment that rotates about its foot: half the joints, and exact only for a push
            at `SWAY_HEIGHT`. Not supported by `set_stalk_properties`.
    """
    segments = ((0, KNEE), (1, TOP - KNEE)) if knees else ((None, TOP),)
    for index in range(stalks):
        foot = spec.worldbody.add_body(name=f"foot_{index}", mocap=True, pos=[0.2 * index, 1.0, 0.0])
        parent, length = foot, 0.0
        for segment, reach in segments:
            part = "lower" if segment == 0 else "upper"
            stiffness, damping, mass, inertia = (float(value) for value in _properties(_NOMINAL_RADIUS, segment, np))
            body = parent.add_body(name=f"{part}_{index}", pos=[0.0, 0.0, length])
            body.mass, body.ipos = mass, [0.0, 0.0, reach / 2]
            body.inertia, body.explicitinertial = [inertia, inertia, mass * _NOMINAL_RADIUS**2], True
            for axis, direction in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
                body.add_joint(
                    name=f"{part}_{index}_{axis}",
                    type=mujoco.mjtJoint.mjJNT_HINGE,
                    axis=direction,
                    stiffness=stiffness,
                    damping=damping,
                )
            body.add_geom(
                name=f"{part}_{index}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[0, 0, 0, 0, 0, reach],
                size=[_NOMINAL_RADIUS, 0, 0],
                rgba=GREENS[index % len(GREENS)],
                contype=0,
                conaffinity=0,
            )
            parent, length = body, reach
        for name in pushed_by:
            pair = spec.add_pair(geomname1=name, geomname2=f"upper_{index}", condim=1)
            pair.solref, pair.solimp = [0.008, 1], [0.9, 0.98, 0.001, 0.5, 2]


def read_layout(mj_model: mujoco.MjModel) -> Layout:
    """Return the indices of the stalks that `add_stalks` added to a model."""
    names = [mj_model.body(body).name for body in range(mj_model.nbody)]
    count = sum(name.startswith("foot_") for name in names)
    stalks, parts = range(count), ("lower", "upper") if "lower_0" in names else ("upper",)
    return Layout(
        mocap=np.array([mj_model.body_mocapid[mj_model.body(f"foot_{index}").id] for index in stalks], int),
        lower=np.array([mj_model.body(f"{parts[0]}_{index}").id for index in stalks], int),
        upper=np.array([mj_model.body(f"upper_{index}").id for index in stalks], int),
        lower_geom=np.array([mj_model.geom(f"{parts[0]}_{index}").id for index in stalks], int),
        upper_geom=np.array([mj_model.geom(f"upper_{index}").id for index in stalks], int),
        joints=np.array(
            [[[mj_model.joint(f"{part}_{i}_{axis}").id for axis in "xy"] for part in parts] for i in stalks], int
        ).reshape(count, len(parts), 2),
    )


class StalkShapes(NamedTuple):
    """N stalks of one stand, as in `Stands`.

    Attributes:
        foot, knee, top: [N, 3] float32, m.
        radius, bending_radius: [N, 2] float32, m.
    """

    foot: Any
    knee: Any
    top: Any
    radius: Any
    bending_radius: Any


def shapes(stands: Stands) -> StalkShapes:
    """Return the shapes of all stands, each array with a leading axis [B]."""
    return StalkShapes(stands.foot, stands.knee, stands.top, stands.radius, stands.bending_radius)


def set_stalk_properties(model: Any, layout: Layout, stalk_shapes: StalkShapes) -> Any:
    """Return ``model`` (an `mjx.Model`) with the lengths, radii, masses, stiffness and damping of stalks of these shapes.

    `place_stands` sets the positions of the feet and the directions of the lower segments. Stalks must have knees.
    """
    lower_axis, up, upper_axis = _segments(stalk_shapes)
    lengths = jnp.stack([jnp.linalg.norm(lower_axis, axis=-1), jnp.linalg.norm(upper_axis, axis=-1)], axis=-1)
    from_lower = jax.vmap(rotations.quat_inv)(_shortest_rotation(up, lower_axis))
    rotation = _shortest_rotation(up, jax.vmap(rotations.rotate)(upper_axis, from_lower))
    bodies, geoms = (layout.lower, layout.upper), (layout.lower_geom, layout.upper_geom)
    changes = {
        name: getattr(model, name)
        for name in "body_pos body_quat body_ipos body_mass body_inertia geom_pos geom_size jnt_stiffness dof_damping".split()
    }
    changes["body_pos"] = changes["body_pos"].at[layout.upper].set(_upward(lengths[:, 0]))
    changes["body_quat"] = changes["body_quat"].at[layout.upper].set(rotation)
    for part in (0, 1):
        radius, length = stalk_shapes.radius[:, part], lengths[:, part]
        stiffness, damping, mass, inertia = _properties(stalk_shapes.bending_radius[:, part], part, jnp)
        around = jnp.stack([inertia, inertia, mass * radius**2], axis=-1)
        size = jnp.stack([radius, length / 2, jnp.zeros_like(radius)], axis=-1)
        for name, index, value in (
            ("body_ipos", bodies[part], _upward(length / 2)),
            ("body_mass", bodies[part], mass),
            ("body_inertia", bodies[part], around),
            ("geom_pos", geoms[part], _upward(length / 2)),
            ("geom_size", geoms[part], size),
            ("jnt_stiffness", layout.joints[:, part], jnp.stack([stiffness, stiffness], axis=-1)),
            ("dof_damping", layout.joints[:, part], jnp.stack([damping, damping], axis=-1)),
        ):
            changes[name] = jnp.asarray(changes[name]).at[index].set(value)
    return model.replace(**changes)


def place_stands(data: Any, layout: Layout, stalk_shapes: StalkShapes) -> Any:
    """Return ``data`` (an `mjx.Data`) with the feet of the stalks at their positions and the lower segments aligned."""
    lower_axis, up, _ = _segments(stalk_shapes)
    return data.replace(
        mocap_pos=data.mocap_pos.at[layout.mocap].set(jnp.asarray(stalk_shapes.foot, jnp.float32)),
        mocap_quat=data.mocap_quat.at[layout.mocap].set(_shortest_rotation(up, lower_axis)),
    )


class Gusts(NamedTuple):
    """Wind over one stand.

    Attributes:
        heading: [2] float32, unit vector along which stalks sway.
        strength: [] float32, displacement at `SWAY_HEIGHT`, m: the amplitude of a sine wave of the same power.
        frequency: [W] float32, Hz.
        phase: [W] float32, rad.
    """

    heading: Any
    strength: Any
    frequency: Any
    phase: Any


def sample_gusts(key: jax.Array, strength: Any) -> Gusts:
    """Sample the wind over one stand: its heading, and the frequencies and phases of its waves.

    Args:
        key: One typed key.
        strength: Displacement at `SWAY_HEIGHT`, m: the amplitude of a sine wave of the same power.
    """
    heading_key, frequency_key, phase_key = jax.random.split(key, 3)
    angle = jax.random.uniform(heading_key, (), jnp.float32, 0.0, 2 * jnp.pi)
    low, high = _GUST_FREQUENCIES
    return Gusts(
        heading=jnp.stack([jnp.cos(angle), jnp.sin(angle)]),
        strength=jnp.asarray(strength, jnp.float32),
        frequency=jax.random.uniform(frequency_key, (_GUST_WAVES,), jnp.float32, low, high),
        phase=jax.random.uniform(phase_key, (_GUST_WAVES,), jnp.float32, 0.0, 2 * jnp.pi),
    )


def displacement(wind: Gusts, foot: jax.Array, time: Any) -> jax.Array:
    """Compute the displacement at `SWAY_HEIGHT` at which wind alone would hold stalks at a time: [N, 2] float32, m.

    Args:
        wind: Wind over the stand.
        foot: [N, 3], positions of the stalks, m; gusts travel along the row.
        time: [] time since the start, s.
    """
    angle = 2 * jnp.pi * wind.frequency * (time - foot[:, :1] / _GUST_SPEED) + wind.phase
    return (wind.strength * jnp.sum(jnp.sin(angle), axis=-1) / _GUST_WAVES**0.5)[:, None] * wind.heading


def hinge_angles(layout: Layout, nv: int, offset: jax.Array) -> jax.Array:
    """Return the angles [nv] of the stalks' hinges for an ``offset`` [N, 2] (m) at `SWAY_HEIGHT`; 0 for all other joints."""
    segments = layout.joints.shape[1]
    angle = offset / (SWAY_HEIGHT + (segments - 1) * (SWAY_HEIGHT - KNEE))  # both hinges rotate by the same angle
    about = jnp.stack([-angle[:, 1], angle[:, 0]], axis=-1)  # about x and y
    return jnp.zeros(nv, jnp.float32).at[layout.joints].set(jnp.stack([about] * segments, axis=1))


def wind_torque(model: Any, layout: Layout, wind: Gusts, foot: jax.Array, time: Any) -> jax.Array:
    """Return the torques [nv] float32 (N m) that would hold the stalks at their `displacement`."""
    return model.jnt_stiffness * hinge_angles(layout, model.nv, displacement(wind, foot, time))


def at_height(data: Any, layout: Layout, height: Any) -> jax.Array:
    """Return the points [N, 3] float32 (m) of the upper segments' centre lines at a height in m."""
    start, axis = data.xpos[layout.upper], data.geom_xmat[layout.upper_geom][:, :, 2]
    return start + ((height - start[:, 2]) / axis[:, 2])[:, None] * axis


def _properties(radius: Any, segment: int | None, xp: Any) -> tuple[Any, Any, Any, Any]:
    """Return spring (N m/rad) and damper (N m s/rad) of each hinge, mass (kg) and inertia (kg m^2) of a segment of a stalk.

    ``segment`` is 0 for the lower segment, 1 for the upper one, None for a stalk in one segment.
    """
    length = TOP if segment is None else (KNEE, TOP - KNEE)[segment]
    compliance = SWAY_HEIGHT / 3 if segment is None else _COMPLIANCE[segment]
    stiffness = MODULUS * 0.25 * xp.pi * radius**4 / compliance
    mass = _LEAVES * DENSITY * xp.pi * radius**2 * length
    inertia = mass * length**2 / 12
    # The whole plant rotates about the ground, the part above the knee about the knee.
    swung = _LEAVES * DENSITY * xp.pi * radius**2 * ((TOP - KNEE) ** 3 if segment == 1 else TOP**3) / 3
    return stiffness, 2 * _DAMPING_RATIO * xp.sqrt(stiffness * swung), mass, inertia


def _segments(stalk_shapes: StalkShapes) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return lower segments (m), upward unit vectors and upper segments (m), as vectors [N, 3] from bottom to top."""
    foot, knee, top = stalk_shapes.foot, stalk_shapes.knee, stalk_shapes.top
    lower_axis, upper_axis = jnp.asarray(knee - foot), jnp.asarray(top - knee)
    return lower_axis, jnp.zeros_like(lower_axis).at[:, 2].set(1.0), upper_axis


def _upward(length: jax.Array) -> jax.Array:
    return jnp.zeros((*length.shape, 3), jnp.float32).at[..., 2].set(length)


def _shortest_rotation(start: jax.Array, end: jax.Array) -> jax.Array:
    """Return quaternions [N, 4] of the shortest rotations from directions ``start`` to ``end`` [N, 3], less than half a turn
    apart.
    """
    start = start / jnp.linalg.norm(start, axis=-1, keepdims=True)
    end = end / jnp.linalg.norm(end, axis=-1, keepdims=True)
    quaternion = jnp.concatenate([1.0 + jnp.sum(start * end, axis=-1, keepdims=True), jnp.cross(start, end)], axis=-1)
    return quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
