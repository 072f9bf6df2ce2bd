"""Constants of models whose contacts are between boxes, one of them free, and the test of which models are supported.

The contacts of all pairs, four of each, are spread over the 32 lanes of a warp. A constant of a contact is a number if it is
the same in all lanes, or else the index of a row of a table with a column per lane.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import mjx

from jaxrl_vis_envs.physics import box_contacts, newton
from jaxrl_vis_envs.physics.scalar import links, scalar_model
from jaxrl_vis_envs.physics.scalar.links import WORLD, FixedFrame
from jaxrl_vis_envs.physics.scalar.partial_arithmetic import floats
from jaxrl_vis_envs.physics.scalar.scalar_model import ScalarModel

LANES = 32
"""Threads of a warp."""
CONTACTS_PER_PAIR = 4
"""Contacts of a pair of boxes."""
CORNERS = ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0))
"""Direction in which each contact of a pair reaches farthest, in half edges of the face."""
FREE_DOFS = 6
"""Degrees of freedom of the free body, the last of a model."""
_NEVER = -1e6  # margin of lanes without a contact, m


class LaneRow(NamedTuple):
    """Row of `BoxModel.table`."""

    index: int


class Side(NamedTuple):
    """First or second box of the pairs. All numbers are per lane.

    Attributes:
        position: Position in the world of boxes that do not move, m.
        axes: Axes in the world of boxes that do not move, three vectors.
        half_size: Half lengths of the edges, m.
        moving: For each box that moves, 1 in its lanes and 0 elsewhere, and its frame relative to its link.
    """

    position: tuple[Any, ...]
    axes: tuple[tuple[Any, ...], ...]
    half_size: tuple[Any, ...]
    moving: tuple[tuple[Any, FixedFrame], ...]


class LaneContacts(NamedTuple):
    """Contacts in lanes. All numbers are per lane.

    Attributes:
        sides: First and second box.
        corner: Direction of `CORNERS`.
        number: Number of the contact within its pair.
        friction: Friction along the two tangents and about the normal.
        has_torsion: 1 for contacts with friction about the normal, 0 for others.
        margin: Distance below which a contact acts, m.
        inverse_weight: Approximate inverse inertia along an edge of the pyramid.
        spring: Stiffness (1/s^2) and damping (1/s) of the reference spring.
        impedance: Impedance without violation, its increase up to its width, and the inverse of that width, 1/m.
        midpoint: Inflection point of the impedance, as a fraction of the width; its exponent is 2.
        signs: For each degree of freedom, 1 if it moves only the second box, -1 if only the first, 0 if both or neither.
    """

    sides: tuple[Side, Side]
    corner: tuple[Any, Any]
    number: Any
    friction: tuple[Any, ...]
    has_torsion: Any
    margin: Any
    inverse_weight: Any
    spring: tuple[Any, Any]
    impedance: tuple[Any, Any, Any]
    midpoint: Any
    signs: tuple[Any, ...]


class FreeBody(NamedTuple):
    """A free body whose frame is that of its inertia.

    Attributes:
        mass: [6], mass (three times, kg) and moments of inertia (kg m^2), with armature.
        inertia: [3], moments of inertia without armature, kg m^2.
        weight: [3], force of gravity in the world, N.
        damping: [6], damping of its degrees of freedom, N s/m and N m s/rad.
    """

    mass: tuple[float, ...]
    inertia: tuple[float, ...]
    weight: tuple[float, ...]
    damping: tuple[float, ...]


class BoxModel(NamedTuple):
    """Constants of a model.

    Attributes:
        tree: Hinges and slides, without contacts.
        body: The free body.
        free_index: Mocap index that stands for its link (`links.mocap_link`): the first after those of mocap bodies.
        contacts: Contacts, with `LaneRow` for the numbers that vary.
        table: [R, 32] float64, these numbers.
        coupled: Pairs (row, column) of degrees of freedom, row >= column, that move the boxes of a common pair.
    """

    tree: ScalarModel
    body: FreeBody
    free_index: int
    contacts: LaneContacts
    table: np.ndarray
    coupled: tuple[tuple[int, int], ...]


def supports(model: mjx.Model) -> bool:
    """Return True if the engine can simulate a model with boxes.

    It supports models of `newton.supports` with Euler's method; one free body, the last, which has the frame of its inertia and
    no children, actuators or welds; up to eight explicit contact pairs of boxes with ``condim`` 3 or 4 and impedances of
    exponent 2; and otherwise the joints, actuators and welds of the scalar engine.
    """
    if not scalar_model.is_concrete(model) or not newton.supports(model) or not box_contacts.supports(model):
        return False
    is_free = np.asarray(model.jnt_type) == mujoco.mjtJoint.mjJNT_FREE
    is_euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    if is_free.sum() != 1 or not is_free[-1] or not is_euler or model.npair * CONTACTS_PER_PAIR > LANES:
        return False
    body = int(model.jnt_bodyid[-1])
    is_alone = model.body_jntnum[body] == 1 and body not in np.asarray(model.body_parentid)
    turn = np.asarray(model.body_iquat)[body]
    is_centred = np.allclose(np.asarray(model.body_ipos)[body], 0.0) and np.allclose(np.abs(turn), [1, 0, 0, 0])
    is_pyramid = np.isin(model.pair_dim, [3, 4]).all() and np.all(np.asarray(model.pair_solimp)[:, 4] == 2)
    # The free body has contacts only.
    is_pulled = np.any(np.asarray(model.actuator_trnid)[:, 0] == len(is_free) - 1) if model.nu else False
    is_tied = body in np.concatenate([model.eq_obj1id, model.eq_obj2id])
    is_simple = is_alone and is_centred and is_pyramid and not is_pulled and not is_tied
    return bool(is_simple) and _has_simple_pairs(model) and scalar_model.has_simple_tree(model)


def _has_simple_pairs(model: mjx.Model) -> bool:
    """Return True if each pair has a box that moves, no box belongs to a mocap body, and contacts are enabled."""
    _, frames = links.build_links(model)
    free = links.mocap_link(model.nmocap)
    for pair in zip(model.pair_geom1, model.pair_geom2, strict=True):
        joined = [frames[model.geom_bodyid[geom]].link for geom in pair]
        if joined == [WORLD, WORLD] or any(link < WORLD and link != free for link in joined):
            return False
    disabled = int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return not int(model.opt.disableflags) & disabled


def build_box_model(model: mjx.Model) -> BoxModel:
    """Return the constants of a model that `supports` accepts."""
    tree = scalar_model.build_scalar_model(model)
    lanes = _lane_contacts(model, tree)
    table: list[np.ndarray] = []
    joints = range(len(lanes.signs))
    coupled = [(row, column) for row in joints for column in range(row + 1)]
    coupled = [(row, column) for row, column in coupled if np.any(lanes.signs[row] * lanes.signs[column])]
    numbers = _as_rows(lanes, table)
    return BoxModel(tree, _free_body(model, tree), model.nmocap, numbers, np.array(table), tuple(coupled))


def with_rows(part: Any, rows: list[Any]) -> Any:
    """Return `LaneContacts`, or a part of them, with each `LaneRow` replaced by its row."""
    if isinstance(part, LaneRow):
        return rows[part.index]
    if not isinstance(part, tuple) or isinstance(part, FixedFrame):
        return part
    values = [with_rows(value, rows) for value in part]
    return type(part)(*values) if hasattr(part, "_fields") else tuple(values)


def _as_rows(part: Any, table: list[np.ndarray]) -> Any:
    """Replace arrays [32] by a number, if all elements are the same, or by a `LaneRow`; extend ``table`` by new rows."""
    if isinstance(part, np.ndarray):
        if np.all(part == part[0]):
            return float(part[0])
        for index, other in enumerate(table):
            if np.array_equal(part, other):
                return LaneRow(index)
        table.append(part)
        return LaneRow(len(table) - 1)
    if not isinstance(part, tuple) or isinstance(part, FixedFrame):
        return part
    values = [_as_rows(value, table) for value in part]
    return type(part)(*values) if hasattr(part, "_fields") else tuple(values)


def _free_body(model: mjx.Model, tree: ScalarModel) -> FreeBody:
    body = int(model.jnt_bodyid[-1])
    mass, inertia = float(np.asarray(model.body_mass)[body]), floats(np.asarray(model.body_inertia)[body])
    armature = np.asarray(model.dof_armature)[-FREE_DOFS:]
    return FreeBody(
        mass=floats(np.array([mass] * 3 + list(inertia)) + armature),
        inertia=inertia,
        weight=floats(mass * tree.gravity),
        damping=floats(np.asarray(model.dof_damping)[-FREE_DOFS:]),
    )


def _lane_contacts(model: mjx.Model, tree: ScalarModel) -> LaneContacts:
    """Return the contacts with arrays [32] as numbers."""
    pair = np.minimum(np.arange(LANES) // CONTACTS_PER_PAIR, model.npair - 1)
    is_used = np.arange(LANES) < model.npair * CONTACTS_PER_PAIR
    number = np.arange(LANES) % CONTACTS_PER_PAIR
    geoms = np.asarray(model.pair_geom1), np.asarray(model.pair_geom2)
    _, frames = links.build_links(model)
    weight = np.asarray(model.body_invweight0, np.float64)[:, 0]
    friction = np.maximum(np.asarray(model.pair_friction, np.float64), mujoco.mjMINVAL)
    square = friction[:, 0] ** 2
    inverse = sum(weight[np.asarray(model.geom_bodyid)[geom]] for geom in geoms)
    inverse = inverse * (1.0 + square) * 2.0 * square / float(model.opt.impratio)
    softness = [
        scalar_model.build_softness(model, np.asarray(model.pair_solref)[row], np.asarray(model.pair_solimp)[row])
        for row in range(model.npair)
    ]
    soft = np.array(softness)[pair].T
    margin = np.asarray(model.pair_margin) - np.asarray(model.pair_gap)
    return LaneContacts(
        sides=(_side(model, frames, geoms[0][pair]), _side(model, frames, geoms[1][pair])),
        corner=(np.array(CORNERS)[number, 0], np.array(CORNERS)[number, 1]),
        number=number.astype(np.float64),
        friction=tuple(friction[pair, :3].T),
        has_torsion=(np.asarray(model.pair_dim)[pair] == 4).astype(np.float64),
        margin=np.where(is_used, margin[pair], _NEVER),
        inverse_weight=inverse[pair],
        spring=(soft[0], soft[1]),
        impedance=(soft[2], soft[3] - soft[2], 1.0 / soft[4]),
        midpoint=soft[5],
        signs=_signs(model, tree, frames, (geoms[0][pair], geoms[1][pair])),
    )


def _side(model: mjx.Model, frames: list[FixedFrame], geoms: np.ndarray) -> Side:
    placed = [links.geom_frame(model, frames, int(geom)) for geom in geoms]
    still = [frame if frame.link == WORLD else FixedFrame(WORLD, np.eye(3), np.zeros(3)) for frame in placed]
    position, rotation = np.array([frame.position for frame in still]), np.array([frame.rotation for frame in still])
    numbers = {int(geom): frame for geom, frame in zip(geoms, placed, strict=True) if frame.link != WORLD}
    return Side(
        position=tuple(position.T),
        axes=tuple(tuple(rotation[:, :, axis].T) for axis in range(3)),
        half_size=tuple(np.asarray(model.geom_size, np.float64)[geoms].T),
        moving=tuple(((geoms == geom).astype(np.float64), frame) for geom, frame in numbers.items()),
    )


def _signs(model: mjx.Model, tree: ScalarModel, frames: list[FixedFrame], geoms: tuple[np.ndarray, np.ndarray]) -> tuple:
    joints, free = len(tree.links), links.mocap_link(model.nmocap)
    moves = np.zeros((2, joints + FREE_DOFS, LANES))
    for side, lane in np.ndindex(2, LANES):
        link = frames[model.geom_bodyid[geoms[side][lane]]].link
        moves[side, joints:, lane] = link == free
        moves[side, links.ancestor_joints(tree.links, link), lane] = 1.0
    return tuple(moves[1] - moves[0])
