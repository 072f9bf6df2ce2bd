"""Tendons: their capsules against those of MuJoCo's visualiser (no GL is needed), and their place in the images."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import jaxrl_vis_envs
from jaxrl_vis_envs import pixels
from jaxrl_vis_envs.render import Scene, cords, render

# Each tendon lies in the plane of its sites, at a place of its own.
_XML = """
<mujoco>
  <option gravity="{gravity}"/>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="ball" type="sphere" size=".2" pos="0 0 .5"/>
    <geom name="rod" type="cylinder" size=".15 .5" pos="2 0 .5" euler="90 0 20"/>
    <site name="above" pos="0 0 .8"/>
    <site name="inside" pos="0 0 .45" size=".01"/>
    <site name="over" pos="-.3 0 .85"/><site name="beside" pos="-.3 0 .38"/>
    <site name="rod_over" pos="1.7 .05 .85"/><site name="rod_beside" pos="1.7 0 .38"/>
    <site name="left" pos="-.5 0 .45"/><site name="rod_left" pos="1.5 .1 .45"/>
    <site name="hook" pos="4 0 1"/><site name="fixed" pos="5 0 1"/>
    <body name="slider">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom size=".02" pos=".5 0 .4"/>
      <site name="right" pos=".5 0 .55"/><site name="rod_right" pos="2.5 -.1 .5"/>
      <site name="end" pos="4.3 .1 .7"/><site name="low" pos="5 .2 .8"/>
    </body>
    <camera name="cam" pos="4.2 -2 .8" xyaxes="1 0 0 0 0 1"/>
  </worldbody>
  <tendon>
    {tendon}
  </tendon>
</mujoco>
"""
_TENDONS = {
    "straight": '<spatial width=".01"><site site="left"/><site site="above"/><site site="right"/></spatial>',
    "pulley": (
        '<spatial><site site="left"/><site site="right"/><pulley divisor="2"/><site site="hook"/><site site="end"/></spatial>'
    ),
    "ball": '<spatial><site site="left"/><geom geom="ball"/><site site="right"/></spatial>',
    "ball_above": '<spatial><site site="left"/><geom geom="ball" sidesite="above"/><site site="right"/></spatial>',
    "ball_inside": '<spatial><site site="above"/><geom geom="ball" sidesite="inside"/><site site="right"/></spatial>',
    "ball_beside": '<spatial><site site="over"/><geom geom="ball" sidesite="beside"/><site site="right"/></spatial>',
    "rod_beside": '<spatial><site site="rod_over"/><geom geom="rod" sidesite="rod_beside"/><site site="rod_right"/></spatial>',
    "rod": '<spatial><site site="rod_left"/><geom geom="rod"/><site site="rod_right"/></spatial>',
    "hanging": '<spatial limited="true" range="0 .45" width=".01"><site site="hook"/><site site="end"/></spatial>',
    "spring": '<spatial stiffness="5" springlength="0 .8"><site site="end"/><site site="fixed"/></spatial>',
    "limit": (
        '<spatial limited="true" range=".2 1.35" margin=".05"><site site="hook"/><site site="end"/><site site="low"/></spatial>'
    ),
    "coloured": '<spatial limited="true" range="0 .1" rgba=".1 .7 .2 1"><site site="hook"/><site site="end"/></spatial>',
    "fixed": '<fixed><joint joint="x" coef="1"/></fixed>',
}
_POSES = np.random.default_rng(0).uniform(-0.25, 0.25, (8, 3)) * [1.0, 0.3, 1.0]


def model_of(name: str, gravity: str = "0 0 -9.81") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(_XML.format(tendon=_TENDONS[name], gravity=gravity))


def visualized(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> list[Any]:
    """Return the geoms of tendons in MuJoCo's visualiser."""
    scene, option, camera = mujoco.MjvScene(mj_model, 200), mujoco.MjvOption(), mujoco.MjvCamera()
    mujoco.mjv_updateScene(mj_model, mj_data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    return [geom for geom in scene.geoms[: scene.ngeom] if geom.objtype == mujoco.mjtObj.mjOBJ_TENDON]


def distances(points: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return the distances [P] of points [P, 3] to the nearest of the lines [L, 2, 3] between two points."""
    along = lines[:, 1] - lines[:, 0]
    offset = points[:, None] - lines[None, :, 0]
    shares = np.clip(np.sum(offset * along, axis=-1) / np.sum(along * along, axis=-1), 0.0, 1.0)
    return np.linalg.norm(offset - shares[..., None] * along, axis=-1).min(axis=1)


@pytest.mark.parametrize("name", _TENDONS)
def test_capsules_and_colours_are_those_of_the_visualizer(name: str) -> None:
    mj_model = model_of(name)
    scene = Scene.from_mjmodel(mj_model, "cam", 8, 8)

    @jaxrl_vis_envs.jit
    @jax.vmap
    def compute(data: dict[str, jax.Array]) -> Any:
        poses = SimpleNamespace(**data)
        drawn = (0,) if mj_model.nsite + mj_model.ngeom in scene.object_ids else ()
        return cords.capsules(scene, poses, drawn) if drawn else None, cords.coloured(scene, poses).rgba[-1]

    states: list[dict[str, np.ndarray]] = []
    theirs: list[list[Any]] = []
    for qpos in _POSES:
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:] = qpos
        mujoco.mj_forward(mj_model, mj_data)
        states.append({part: np.array(getattr(mj_data, part)) for part in ("site_xpos", "geom_xpos", "geom_xmat")})
        theirs.append(visualized(mj_model, mj_data))
    capsules, colours = compute(jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows), jnp.float32), *states))
    assert (capsules is None) == (name == "fixed") == (not any(theirs))
    for index, geoms in enumerate(theirs if capsules is not None else ()):
        ours = jax.tree.map(lambda values, index=index: np.asarray(values[index]), capsules)
        ends = ours.half[:, None] * ours.rotation[:, :, 2]
        points = np.stack([ours.position - ends, ours.position + ends], axis=1)[ours.half > 1e-7]
        halves = [geom.size[2] * geom.mat[:, 2] for geom in geoms]
        shown = np.array([[geom.pos - half, geom.pos + half] for geom, half in zip(geoms, halves, strict=True)])
        # Arcs are divided differently, and a taut cord is one capsule there: the lines are the same.
        assert distances(points.reshape(-1, 3), shown).max() < 1e-3 and distances(shown.reshape(-1, 3), points).max() < 1e-3
        lengths = [np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() for lines in (points, shown)]
        np.testing.assert_allclose(*lengths, atol=1e-3)
        np.testing.assert_allclose([geom.size[0] for geom in geoms], scene.size[-1, 0], rtol=1e-6)
        np.testing.assert_allclose(colours[index], geoms[0].rgba, atol=2e-3)


def test_both_courses_occur_in_the_poses() -> None:
    """The test above compares tendons with and without contact, slack and taut, within a limit and beyond it."""
    names = ("ball", "ball_above", "ball_beside", "ball_inside", "rod", "rod_beside", "hanging")
    numbers: dict[str, set[Any]] = {name: set() for name in names}
    for name, seen in numbers.items():
        mj_model = model_of(name)
        for qpos in _POSES:
            mj_data = mujoco.MjData(mj_model)
            mj_data.qpos[:] = qpos
            mujoco.mj_forward(mj_model, mj_data)
            seen.add(len(visualized(mj_model, mj_data)))
    assert all(max(numbers[name]) > 2 for name in names[:3] + names[4:6]), numbers
    assert all(1 in numbers[name] for name in ("ball_beside", "rod", "rod_beside")), numbers
    assert {1, 2} == numbers["ball_inside"] and {1, 28} == numbers["hanging"], numbers


def test_tendons_are_in_the_image() -> None:
    mj_model = model_of("straight")
    label = mj_model.ngeom + mj_model.nsite
    mj_model.cam_pos[0] = [0.0, -2.0, 0.6]
    data = mjx.kinematics(mjx.put_model(mj_model), mjx.make_data(mj_model))
    scene = Scene.from_mjmodel(mj_model, "cam", 48, 64)
    frame = render(scene, data)
    assert np.sum(np.asarray(frame.segmentation) == label) > 10
    hidden = render(Scene.from_mjmodel(mj_model, "cam", 48, 64, tendon_groups=()), data)
    assert not np.any(np.asarray(hidden.segmentation) == label)
    views = pixels.Views(mj_model, "cam", (48, 64), ("segmentation", "bodies"))
    images = views(data)["cam"]
    assert views.geom_names[label] == "tendon 0" and views.body_names[-2] == "tendon"
    np.testing.assert_array_equal(np.asarray(images["segmentation"]) == label, np.asarray(images["bodies"]) == -2)


def test_a_cord_without_gravity_is_straight() -> None:
    assert Scene.from_mjmodel(model_of("hanging", "0 0 0"), "cam", 8, 8).tendon_paths[0].capsules == 1


def test_images_of_tendons_have_gradients() -> None:
    mj_model = model_of("ball_above")
    model, data = mjx.put_model(mj_model), mjx.make_data(mj_model)
    scene = Scene.from_mjmodel(mj_model, "cam", 8, 8)

    def total(qpos: jax.Array) -> jax.Array:
        moved = mjx.kinematics(model, data.replace(qpos=qpos))
        return jnp.sum(cords.capsules(scene, moved, (0,)).position)

    gradient = jaxrl_vis_envs.jit(jax.grad(total))(jnp.array([0.01, 0.02, -0.1]))
    assert np.all(np.isfinite(gradient)) and np.any(np.asarray(gradient) != 0)
