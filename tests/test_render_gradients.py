"""Gradients of pictures against finite differences, away from silhouettes, and what must not spoil them."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxrl_vis_envs.compilation import world_jit
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
    <geom name="thing" {thing}/>
    <geom name="floor" type="plane" size="2 2 .1" pos="0 0 -.5"/>
    <camera name="eye" pos=".2 -1.2 .5" xyaxes="1 .1 0 -.05 .4 1" fovy="45"/>
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
    "mesh": f'type="mesh" mesh="wedge" rgba=".7 .5 .3 1" {QUAT}',
    "textured": f'type="ellipsoid" size=".2 .15 .3" material="soft" {QUAT}',
    "transparent": f'type="ellipsoid" size=".2 .15 .3" rgba=".7 .5 .3 .4" {QUAT}',
}


def setting(thing: str):
    """(scene, poses, mask of pixels well inside the thing)."""
    mj_model = mujoco.MjModel.from_xml_string(XML.format(thing=THINGS[thing]))
    mj_data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    poses = {name: jnp.asarray(getattr(mj_data, name), jnp.float32) for name in POSES}
    scene = Scene.from_mjmodel(mj_model, "eye", SIZE, SIZE)
    planes = render_planes(scene, SimpleNamespace(**poses), rgb=False, segmentation=True, normals=True)
    labels, normals = np.asarray(planes.segmentation), np.asarray(planes.normals)
    # Away from silhouettes, and from the edges between the faces of one thing.
    inside = np.zeros((SIZE, SIZE), bool)
    for row in range(2, SIZE - 2):
        for column in range(2, SIZE - 2):
            block = (slice(row - 2, row + 3), slice(column - 2, column + 3))
            facing = normals[(slice(None), *block)].reshape(3, -1)
            inside[row, column] = np.all(labels[block] == 0) and np.min(normals[:, row, column] @ facing) > 0.6
    assert inside.sum() >= 4, thing
    return scene, poses, jnp.asarray(inside)


def moved(scene: Scene, poses: dict, change: dict) -> tuple[Scene, dict]:
    """The scene and the poses with small changes: of the thing's position and orientation, the camera, sizes, looks."""
    x, y, z = change["turn"]
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned = poses["geom_xmat"].reshape(-1, 3, 3)
    turned = turned.at[0].set(turned[0] + jnp.sum(cross[:, :, None] * turned[0][None], axis=1))
    poses = poses | {"geom_xpos": poses["geom_xpos"].at[0].add(change["shift"]), "geom_xmat": turned}
    scene = scene.replace(
        camera_shift=change["camera_shift"],
        camera_turn=change["camera_turn"],
        fovy=scene.fovy + change["fovy"],
        size=scene.size.at[0].add(change["size"]),
        rgba=scene.rgba.at[0, :3].add(change["colour"]),
        light_diffuse=scene.light_diffuse + change["light"],
        light_position=scene.light_position + change["light_position"],
    )
    return scene, poses


def no_change() -> dict:
    threes = ("turn", "shift", "camera_shift", "camera_turn", "size", "colour", "light", "light_position")
    return {name: jnp.zeros(3) for name in threes} | {"fovy": jnp.zeros(())}


STEPS = {"fovy": 0.05, "turn": 2e-3, "camera_turn": 2e-3, "light_position": 1e-2, "colour": 1e-2, "light": 1e-2}


@pytest.mark.parametrize("thing", THINGS)
def test_gradients_are_those_of_finite_differences(thing):
    scene, poses, inside = setting(thing)

    def measured(change):
        changed, placed = moved(scene, poses, change)
        planes = render_planes(changed, SimpleNamespace(**placed))
        weights = jnp.where(inside, 1.0, 0.0) / inside.sum()
        return jnp.stack([jnp.sum(weights * planes.depth), jnp.sum(weights * planes.rgb), jnp.sum(weights * planes.rgb[0])])

    compiled = world_jit(measured)
    slopes = world_jit(jax.jacrev(measured))(no_change())
    for name, slope in slopes.items():
        if name == "size" and thing == "mesh":
            continue  # a mesh has none
        step = STEPS.get(name, 1e-3)
        directions = np.eye(3) if slope.ndim == 2 else np.ones(1)
        for axis, direction in enumerate(directions):
            up, down = (
                compiled(no_change() | {name: jnp.asarray(sign * step * direction, jnp.float32)}) for sign in (1.0, -1.0)
            )
            expected = (up - down) / (2.0 * step)
            found = slope[:, axis] if slope.ndim == 2 else slope
            np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.02, err_msg=f"{thing} {name} {axis}")
    assert np.abs(slopes["shift"][0]).max() > 0.1
    assert np.abs(slopes["colour"][1]).max() > 0.1


@pytest.mark.parametrize("thing", ["capsule", "mesh", "transparent"])
def test_a_nan_pose_leaves_no_nan_in_other_gradients(thing):
    scene, poses, _ = setting(thing)
    poses = poses | {"geom_xpos": poses["geom_xpos"].at[0].set(jnp.nan)}

    def brightness(shift, colour):
        shifted = poses | {"geom_xpos": poses["geom_xpos"].at[1].add(shift)}
        looks = scene.replace(rgba=scene.rgba.at[1, :3].add(colour))
        planes = render_planes(looks, SimpleNamespace(**shifted), normals=True)
        return planes.rgb.sum() + planes.depth.sum() + planes.normals.sum()

    shift, colour = world_jit(jax.grad(brightness, argnums=(0, 1)))(jnp.zeros(3), jnp.zeros(3))
    assert np.all(np.isfinite(shift)) and np.all(np.isfinite(colour))
    assert np.any(np.asarray(colour) > 0)


def test_a_pose_is_found_by_descent():
    scene, poses, _ = setting("ellipsoid")

    def depth(shift):
        return render_planes(scene, SimpleNamespace(**moved(scene, poses, no_change() | {"shift": shift})[1]), rgb=False).depth

    truth = jnp.array([0.03, -0.04, 0.02])
    target = depth(truth)

    @world_jit
    def descend(shift):
        def error(shift):
            return jnp.mean(jnp.clip(jnp.abs(depth(shift) - target), 0.0, 0.2))

        return shift - 0.05 * jax.grad(error)(shift)

    shift = jnp.zeros(3)
    for _ in range(60):
        shift = descend(shift)
    assert np.linalg.norm(shift - truth) < 0.5 * np.linalg.norm(truth)
