"""Gradients of images against finite differences away from silhouettes, and their robustness."""

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrl_vis_envs
from jaxrl_vis_envs.render import Scene, render_planes

POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat")
SIZE = 24

XML = """
<mujoco>
  <statistic extent="1"/>
  <asset>
    <mesh name="wedge" scale="1.8 1.8 1.8" vertex="-.2 -.15 -.1 .2 -.15 -.1 .2 .15 -.1 -.2 .15 -.1 -.2 -.15 .15 -.2 .15 .15"/>
    <texture name="soft" type="2d" builtin="gradient" rgb1="1 0 0" rgb2="0 0 1" width="32" height="32"/>
    <material name="soft" texture="soft" specular=".3"/>
  </asset>
  <worldbody>
    <light pos=".5 -1 2" dir="-.3 .5 -1" cutoff="80" diffuse=".6 .5 .4" attenuation="1 .1 .1"/>
    <geom name="floor" type="plane" size="9 9 .1" pos="0 0 -.5"/>
    <camera name="eye" pos=".2 -1.2 .5" xyaxes="1 .1 0 -.05 .4 1" fovy="45"/>
    {things}
  </worldbody>
</mujoco>
"""
QUAT = 'quat=".8 .3 .4 -.2"'
THINGS = {
    "sphere": 'type="sphere" size=".25" rgba=".7 .5 .3 1"',
    "capsule": f'type="capsule" size=".15 .2" rgba=".7 .5 .3 1" {QUAT}',
    "ellipsoid": f'type="ellipsoid" size=".2 .15 .3" rgba=".7 .5 .3 1" {QUAT}',
    "cylinder": f'type="cylinder" size=".2 .2" rgba=".7 .5 .3 1" {QUAT}',
    "box": f'type="box" size=".2 .15 .2" rgba=".7 .5 .3 1" {QUAT}',
    "plane": f'type="plane" size=".3 .3 .1" rgba=".7 .5 .3 1" {QUAT}',
    "textured": f'type="ellipsoid" size=".2 .15 .3" material="soft" {QUAT}',
    "mesh": f'type="mesh" mesh="wedge" rgba=".7 .5 .3 1" {QUAT}',
    "transparent": f'type="ellipsoid" size=".2 .15 .3" rgba=".7 .5 .3 .4" {QUAT}',
}
# What is drawn together: a program's compilation takes far longer than its run.
SCENES = {
    "primitives": ("sphere", "capsule", "ellipsoid", "cylinder", "box", "plane", "textured"),
    "mesh": ("mesh",),
    "transparent": ("transparent",),
}
SCENE_OF = {thing: scene for scene, things in SCENES.items() for thing in things}


def no_change() -> dict:
    threes = ("turn", "shift", "camera_shift", "camera_turn", "size", "colour", "light", "light_position")
    return {name: jnp.zeros(3) for name in threes} | {"fovy": jnp.zeros(())}


def moved(scene: Scene, poses: dict, thing: jax.Array, change: dict) -> tuple[Scene, dict]:
    """Return scene and poses with small changes of position and orientation of an object, camera, sizes and colours."""
    x, y, z = change["turn"]
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned = poses["geom_xmat"].reshape(-1, 3, 3)
    turned = turned.at[thing].set(turned[thing] + jnp.sum(cross[:, :, None] * turned[thing][None], axis=1))
    poses = poses | {"geom_xpos": poses["geom_xpos"].at[thing].add(change["shift"]), "geom_xmat": turned}
    scene = scene.replace(
        camera_shift=change["camera_shift"],
        camera_turn=change["camera_turn"],
        fovy=scene.fovy + change["fovy"],
        size=scene.size.at[thing].add(change["size"]),
        rgba=scene.rgba.at[thing, :3].add(change["colour"]),
        light_diffuse=scene.light_diffuse + change["light"],
        light_position=scene.light_position + change["light_position"],
    )
    return scene, poses


class Setting(NamedTuple):
    """Scene, poses, and one compiled program.

    ``measure(poses, thing, change, mask, weights)`` returns the planes, the means over ``mask`` of depth, of all colours and of
    red, and the derivatives of the weighted sum of these three with respect to ``change``.
    """

    scene: Scene
    poses: dict
    measure: Callable[..., tuple[Any, jax.Array, dict]]


@functools.cache
def setting(name: str) -> Setting:
    things = (
        f'<body pos="{0.9 * place} 0 0"><geom name="{thing}" {THINGS[thing]}/></body>'
        for place, thing in enumerate(SCENES[name])
    )
    mj_model = mujoco.MjModel.from_xml_string(XML.format(things="".join(things)))
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    poses = {pose: jnp.asarray(getattr(mj_data, pose), jnp.float32) for pose in POSES}
    scene = Scene.from_mjmodel(mj_model, "eye", SIZE, SIZE)

    def total(change, poses, thing, mask, weights):
        # The camera goes along, so that every thing is in the middle of the image.
        place = jnp.zeros(3).at[0].set(0.9 * (thing - 1))
        changed, placed = moved(scene, poses, thing, change)
        changed = changed.replace(camera_shift=changed.camera_shift + place, light_position=changed.light_position + place)
        planes = render_planes(changed, SimpleNamespace(**placed), segmentation=True, normals=True)
        shares = jnp.where(mask, 1.0, 0.0) / jnp.maximum(mask.sum(), 1)
        means = jnp.stack([jnp.sum(shares * plane) for plane in (planes.depth, planes.rgb, planes.rgb[0])])
        return means @ weights, (planes, means)

    def measure(poses, thing, change, mask, weights):
        slopes, (planes, means) = jax.grad(total, has_aux=True)(change, poses, thing, mask, weights)
        return planes, means, slopes

    return Setting(scene, poses, jaxrl_vis_envs.jit(measure))


def slopes_of_each(measure: Callable, *arguments: Any) -> dict[str, np.ndarray]:
    """Return the derivatives of the three means, [3, ...], computed sequentially, which takes less time to compile."""
    rows = [measure(*arguments, row)[2] for row in np.eye(3, dtype=np.float32)]
    return {quantity: np.stack([row[quantity] for row in rows]) for quantity in rows[0]}


def well_inside(planes: Any, thing: int) -> jax.Array:
    """Return the mask [SIZE, SIZE] of pixels away from silhouettes, and from edges between faces of one object."""
    labels, normals = np.asarray(planes.segmentation), np.asarray(planes.normals)
    inside = np.zeros((SIZE, SIZE), bool)
    for row in range(2, SIZE - 2):
        for column in range(2, SIZE - 2):
            block = (slice(row - 2, row + 3), slice(column - 2, column + 3))
            facing = normals[(slice(None), *block)].reshape(3, -1)
            inside[row, column] = np.all(labels[block] == thing) and np.min(normals[:, row, column] @ facing) > 0.6
    assert inside.sum() >= 4
    return jnp.asarray(inside)


STEPS = {"fovy": 0.05, "turn": 2e-3, "camera_turn": 2e-3, "light_position": 1e-2, "colour": 1e-2, "light": 1e-2}
NOWHERE = jnp.zeros((SIZE, SIZE), bool)
NOTHING = np.zeros(3, np.float32)


@pytest.mark.parametrize("name", THINGS)
def test_gradients_match_finite_differences(name):
    scene = SCENE_OF[name]
    _, poses, measure = setting(scene)
    thing = 1 + SCENES[scene].index(name)  # after the floor
    inside = well_inside(measure(poses, thing, no_change(), NOWHERE, NOTHING)[0], thing)
    slopes = slopes_of_each(measure, poses, thing, no_change(), inside)
    for quantity, slope in slopes.items():
        if quantity == "size" and name == "mesh":
            continue  # a mesh has none
        step = STEPS.get(quantity, 1e-3)
        directions = np.eye(3) if slope.ndim == 2 else np.ones(1)
        for axis, direction in enumerate(directions):
            up, down = (
                measure(poses, thing, no_change() | {quantity: np.float32(sign * step * direction)}, inside, NOTHING)[1]
                for sign in (1.0, -1.0)
            )
            found = slope[:, axis] if slope.ndim == 2 else slope
            expected = (up - down) / (2.0 * step)
            np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.02, err_msg=f"{name} {quantity} {axis}")
    assert np.abs(slopes["shift"][0]).max() > 0.1
    assert np.abs(slopes["colour"][1]).max() > 0.1


@pytest.mark.parametrize("name", SCENES)
def test_nan_pose_does_not_corrupt_other_gradients(name):
    """The last object has a NaN pose; gradients of the whole image with respect to floor, camera and lights stay finite."""
    _, poses, measure = setting(name)
    poses = poses | {"geom_xpos": poses["geom_xpos"].at[-1].set(jnp.nan)}
    arguments = poses, 0, no_change(), ~NOWHERE
    planes, means, _ = measure(*arguments, NOTHING)
    slopes = slopes_of_each(measure, *arguments)
    assert np.all(np.isfinite(means)) and len(SCENES[name]) not in np.asarray(planes.segmentation)
    for quantity, slope in slopes.items():
        assert np.all(np.isfinite(slope)), quantity
    assert np.any(np.asarray(slopes["colour"][1]) > 0)


def test_gradient_descent_finds_a_pose():
    """The pose of a ball is found from a depth image alone."""
    scene, poses, _ = setting("primitives")
    thing = 1 + SCENES["primitives"].index("sphere")

    @jaxrl_vis_envs.jit
    def descend(shift, target):
        def error(shift):
            change = no_change() | {"shift": shift}
            planes = render_planes(scene, SimpleNamespace(**moved(scene, poses, thing, change)[1]), rgb=False)
            return jnp.mean(jnp.clip(jnp.abs(planes.depth - target), 0.0, 0.2)), planes.depth

        slope, depth = jax.grad(error, has_aux=True)(shift)
        return shift - 0.05 * slope, depth

    truth = jnp.array([0.03, -0.04, 0.02])
    target = descend(truth, jnp.zeros((SIZE, SIZE)))[1]
    shift = jnp.zeros(3)
    for _ in range(60):
        shift, _ = descend(shift, target)
    assert np.linalg.norm(shift - truth) < 0.5 * np.linalg.norm(truth)
