"""Forward kinematics of all bodies at once.

MJX walks down a kinematic tree body by body, which is half of a step's program and of its compilation time. Here each joint is
a node with a pose relative to its parent node, and poses in the world are computed by pointer doubling: in each round a node's
pose is composed with its ancestor's, and the ancestor is replaced by the ancestor's ancestor. A chain of N nodes takes log2(N)
rounds, each over all nodes in parallel.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import smooth, support

from jaxrl_vis_envs.physics import rotations

_SUPPORTED = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE)

_rotate = jax.vmap(rotations.rotate)
_multiply = jax.vmap(rotations.quat_mul)


class _Nodes(NamedTuple):
    """Tree with one node per joint and one per body without joints; node 0 is the world. Arrays are integers.

    Attributes:
        body: [N], body whose frame the node starts from, or nbody if it follows another joint of its body.
        parent: [N], parent node.
        depth: Length of the longest chain below the world.
        joint_nodes: [njnt], node of each joint.
        body_nodes: [nbody], last node of each body.
    """

    body: np.ndarray
    parent: np.ndarray
    depth: int
    joint_nodes: np.ndarray
    body_nodes: np.ndarray


@jax.jit  # traced once for all programs that contain it
def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute poses as `mjx.kinematics` does, in a fraction of the operations, and also those of cameras on bodies.

    Descendants of a mocap body move with it, as in MuJoCo (in MJX they do not). Models with ball joints are delegated to MJX.
    """
    if not np.isin(model.jnt_type, _SUPPORTED).all():
        return _place_cameras(model, mjx.kinematics(model, data))
    nodes = _nodes(model)
    displacement = (data.qpos - model.qpos0)[model.jnt_qposadr]
    position, rotation = _relative_poses(model, data, nodes, displacement)
    ancestor = nodes.parent
    for _ in range(int(np.ceil(np.log2(max(nodes.depth, 1))))):
        position = position[ancestor] + _rotate(position, rotation[ancestor])
        rotation = _multiply(rotation[ancestor], rotation)
        ancestor = ancestor[ancestor]

    # A hinge's rotation moves neither its anchor nor its axis. A slide's anchor does not move with the slide.
    axis = _rotate(model.jnt_axis, rotation[nodes.joint_nodes])
    anchor = position[nodes.joint_nodes] + _rotate(model.jnt_pos, rotation[nodes.joint_nodes])
    is_slide = np.asarray(model.jnt_type) == mujoco.mjtJoint.mjJNT_SLIDE
    if is_slide.any():
        anchor = anchor - jnp.where(is_slide, displacement, 0.0)[:, None] * axis
    is_free = np.asarray(model.jnt_type) == mujoco.mjtJoint.mjJNT_FREE
    if is_free.any():
        axis = jnp.where(is_free[:, None], model.jnt_axis, axis)
    xpos, xquat = position[nodes.body_nodes], rotation[nodes.body_nodes]
    to_global = jax.vmap(support.local_to_global)
    xipos, ximat = to_global(xpos, xquat, model.body_ipos, model.body_iquat)
    data = data.replace(
        xanchor=anchor,
        xaxis=axis,
        xpos=xpos,
        xquat=xquat,
        xmat=jax.vmap(rotations.quat_to_mat)(xquat),
        xipos=xipos,
        ximat=ximat,
    )
    if model.ngeom:
        bodies = model.geom_bodyid
        geom_xpos, geom_xmat = to_global(xpos[bodies], xquat[bodies], model.geom_pos, model.geom_quat)
        data = data.replace(geom_xpos=geom_xpos, geom_xmat=geom_xmat)
    if model.nsite:
        bodies = model.site_bodyid
        site_xpos, site_xmat = to_global(xpos[bodies], xquat[bodies], model.site_pos, model.site_quat)
        data = data.replace(site_xpos=site_xpos, site_xmat=site_xmat)
    return _place_cameras(model, data)


def _relative_poses(model: mjx.Model, data: mjx.Data, nodes: _Nodes, displacement: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the pose of each node relative to its parent: positions [N, 3] (m) and unit quaternions [N, 4]."""
    body_pos, body_quat = model.body_pos, model.body_quat
    if model.nmocap:
        carried = np.flatnonzero(np.asarray(model.body_mocapid) >= 0)
        order = np.asarray(model.body_mocapid)[carried]
        body_pos = body_pos.at[carried].set(data.mocap_pos[order])
        body_quat = body_quat.at[carried].set(jax.vmap(rotations.normalize)(data.mocap_quat[order]))
    position = jnp.concatenate([body_pos, jnp.zeros((1, 3))])[nodes.body]
    rotation = jnp.concatenate([body_quat, jnp.array([[1.0, 0.0, 0.0, 0.0]])])[nodes.body]
    if not model.njnt:
        return position, rotation
    is_slide, is_free = (np.asarray(model.jnt_type) == kind for kind in _SUPPORTED[1:])
    turn = jax.vmap(rotations.axis_angle_to_quat)(model.jnt_axis, jnp.where(is_slide | is_free, 0.0, displacement))
    shift = jnp.where(is_slide, displacement, 0.0)[:, None] * model.jnt_axis + model.jnt_pos - _rotate(model.jnt_pos, turn)
    joints = nodes.joint_nodes
    position = position.at[joints].add(_rotate(shift, rotation[joints]))
    rotation = rotation.at[joints].set(_multiply(rotation[joints], turn))
    for joint in np.flatnonzero(is_free):  # of a child of the world, whose pose its coordinates are
        first = model.jnt_qposadr[joint]
        position = position.at[joints[joint]].set(data.qpos[first : first + 3])
        rotation = rotation.at[joints[joint]].set(rotations.normalize(data.qpos[first + 3 : first + 7]))
    return position, rotation


def _nodes(model: mjx.Model) -> _Nodes:
    """Return the tree of a model. In MuJoCo, bodies come after their parents, and joints in the order of their bodies."""
    body, parent, joint_nodes, body_nodes, depth = [0], [0], [], [0], [0]
    for index in range(1, model.nbody):
        before = body_nodes[model.body_parentid[index]]
        for joint in range(max(1, model.body_jntnum[index])):
            body.append(index if joint == 0 else model.nbody)
            parent.append(before)
            depth.append(depth[before] + 1)
            before = len(body) - 1
            if model.body_jntnum[index]:
                joint_nodes.append(before)
        body_nodes.append(before)
    return _Nodes(
        body=np.array(body, int),
        parent=np.array(parent, int),
        depth=max(depth),
        joint_nodes=np.array(joint_nodes, int),
        body_nodes=np.array(body_nodes, int),
    )


def _place_cameras(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Compute the poses of cameras if any camera can move."""
    if np.all((model.cam_bodyid == 0) & (model.cam_mode == mujoco.mjtCamLight.mjCAMLIGHT_FIXED)):
        return data
    return smooth.camlight(model, smooth.com_pos(model, data))
