"""Poses of all bodies at once.

MJX walks down a kinematic tree body by body, which makes up half of the program of a step, and of the time to compile it. Here
every joint is a node with a pose relative to the one before it, and the poses relative to the world come from pointer doubling:
in each round a node's pose is composed with that of its ancestor, and the ancestor becomes that one's ancestor. A chain of N
nodes takes log2(N) rounds, each over all nodes side by side.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import math, smooth, support

_ONE_DEGREE_OF_FREEDOM = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)

_rotate = jax.vmap(math.rotate)
_multiply = jax.vmap(math.quat_mul)


class _Nodes(NamedTuple):
    """The tree with one node for each joint and one for each body without joints; node 0 is the world. Integers."""

    body: np.ndarray  # [N], the body whose frame a node starts from, or nbody where it goes on from another joint of the body
    parent: np.ndarray  # [N], the node before
    depth: int  # the most nodes below the world that follow each other
    of_joint: np.ndarray  # [njnt]
    of_body: np.ndarray  # [nbody], the last node of the body


@jax.jit  # so that it is traced once, in however many programs it is
def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.kinematics` in a fraction of the operations, and the poses of cameras that ride on bodies.

    Bodies that hang on a mocap body move with it, as in MuJoCo (in MJX they stay). Models with ball or free joints are left to
    MJX.
    """
    if not np.isin(model.jnt_type, _ONE_DEGREE_OF_FREEDOM).all():
        return _place_cameras(model, mjx.kinematics(model, data))
    nodes = _nodes(model)
    displacement = data.qpos - model.qpos0
    position, rotation = _relative_poses(model, data, nodes, displacement)
    ancestor = nodes.parent
    for _ in range(int(np.ceil(np.log2(max(nodes.depth, 1))))):
        position = position[ancestor] + _rotate(position, rotation[ancestor])
        rotation = _multiply(rotation[ancestor], rotation)
        ancestor = ancestor[ancestor]

    # Turning about its own axis moves neither a hinge's anchor nor its axis. A slide's anchor stays behind.
    axis = _rotate(model.jnt_axis, rotation[nodes.of_joint])
    anchor = position[nodes.of_joint] + _rotate(model.jnt_pos, rotation[nodes.of_joint])
    is_slide = np.asarray(model.jnt_type) == mujoco.mjtJoint.mjJNT_SLIDE
    if is_slide.any():
        anchor = anchor - jnp.where(is_slide, displacement, 0.0)[:, None] * axis
    xpos, xquat = position[nodes.of_body], rotation[nodes.of_body]
    to_global = jax.vmap(support.local_to_global)
    xipos, ximat = to_global(xpos, xquat, model.body_ipos, model.body_iquat)
    data = data.replace(
        xanchor=anchor, xaxis=axis, xpos=xpos, xquat=xquat, xmat=jax.vmap(math.quat_to_mat)(xquat), xipos=xipos, ximat=ximat
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
    """Pose of each node relative to its parent: positions [N, 3] (m) and unit quaternions [N, 4]."""
    body_pos, body_quat = model.body_pos, model.body_quat
    if model.nmocap:
        carried = np.flatnonzero(np.asarray(model.body_mocapid) >= 0)
        order = np.asarray(model.body_mocapid)[carried]
        body_pos = body_pos.at[carried].set(data.mocap_pos[order])
        body_quat = body_quat.at[carried].set(jax.vmap(math.normalize)(data.mocap_quat[order]))
    position = jnp.concatenate([body_pos, jnp.zeros((1, 3))])[nodes.body]
    rotation = jnp.concatenate([body_quat, jnp.array([[1.0, 0.0, 0.0, 0.0]])])[nodes.body]
    if not model.njnt:
        return position, rotation
    is_slide = np.asarray(model.jnt_type) == mujoco.mjtJoint.mjJNT_SLIDE
    turn = jax.vmap(math.axis_angle_to_quat)(model.jnt_axis, jnp.where(is_slide, 0.0, displacement))
    shift = jnp.where(is_slide, displacement, 0.0)[:, None] * model.jnt_axis + model.jnt_pos - _rotate(model.jnt_pos, turn)
    joints = nodes.of_joint
    position = position.at[joints].add(_rotate(shift, rotation[joints]))
    return position, rotation.at[joints].set(_multiply(rotation[joints], turn))


def _nodes(model: mjx.Model) -> _Nodes:
    """The tree of a model. Bodies come after their parents in MuJoCo, and joints in the order of their bodies."""
    body, parent, of_joint, of_body, depth = [0], [0], [], [0], [0]
    for index in range(1, model.nbody):
        before = of_body[model.body_parentid[index]]
        for joint in range(max(1, model.body_jntnum[index])):
            body.append(index if joint == 0 else model.nbody)
            parent.append(before)
            depth.append(depth[before] + 1)
            before = len(body) - 1
            if model.body_jntnum[index]:
                of_joint.append(before)
        of_body.append(before)
    return _Nodes(
        body=np.array(body, int),
        parent=np.array(parent, int),
        depth=max(depth),
        of_joint=np.array(of_joint, int),
        of_body=np.array(of_body, int),
    )


def _place_cameras(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Poses of cameras, where any can move."""
    if np.all((model.cam_bodyid == 0) & (model.cam_mode == mujoco.mjtCamLight.mjCAMLIGHT_FIXED)):
        return data
    return smooth.camlight(model, smooth.com_pos(model, data))
