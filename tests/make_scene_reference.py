"""Generate tests/data/render_references.npz: images of MuJoCo's own renderer, the reference of tests/render/test_render.py.

Needs a GL library; the test does not. Run from the repository root:

    MUJOCO_GL=egl PYTHONPATH=.:envs python tests/make_scene_reference.py

The file holds the model's XML, the poses of every image and the three reference planes, so it is self-contained.
"""

import pathlib

import mujoco
import numpy as np

from benchmarks.rendering.reference import ReferenceRenderer

HEIGHT, WIDTH, IMAGES, SEED = 60, 80, 6, 0
TARGET = pathlib.Path(__file__).parent / "data" / "render_references.npz"
POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "site_xpos", "site_xmat")

# One of each type, on bodies that can be put anywhere. Finely divided, because OpenGL draws polygons where we draw balls.
XML = """
<mujoco>
  <visual><quality numslices="128" numstacks="64" numquads="16" offsamples="0"/><map znear="0.005" zfar="20"/></visual>
  <statistic extent="1"/>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1=".9 .6 .2" rgb2=".1 .2 .5" width="256" height="256"/>
    <material name="shiny" rgba=".2 .6 .3 1" specular=".9" shininess=".4"/>
    <material name="glowing" rgba=".3 .2 .7 1" emission=".5" specular=".2" shininess=".1"/>
    <material name="matt" rgba=".6 .5 .4 1" specular="0"/>
  </asset>
  <worldbody>
    <light directional="true" dir=".3 .4 -1" diffuse=".4 .35 .3" specular=".2 .2 .2"/>
    <geom name="floor" type="plane" size="0 0 .1" material="matt"/>
    <body name="lamp" mocap="true" pos=".5 -.5 2">
      <light name="spot" dir="-.2 .2 -1" diffuse=".5 .5 .6" attenuation="1 .1 .05" cutoff="70" exponent="4"/>
    </body>
    <body mocap="true"><geom name="board" type="plane" size=".3 .2 .1" rgba=".8 .8 .2 1"/></body>
    <body mocap="true"><geom name="ball" type="sphere" size=".15" material="shiny"/></body>
    <body mocap="true"><geom name="pill" type="capsule" size=".08 .15" rgba=".9 .1 .1 1"/></body>
    <body mocap="true"><geom name="egg" type="ellipsoid" size=".08 .14 .2" material="glowing"/></body>
    <body mocap="true"><geom name="can" type="cylinder" size=".1 .12" rgba=".1 .7 .8 1"/></body>
    <body mocap="true"><geom name="brick" type="box" size=".09 .12 .16"/></body>
    <body mocap="true"><geom name="hidden" type="box" size=".2 .2 .2" group="3"/></body>
    <body mocap="true"><geom name="clear" type="box" size=".2 .2 .2" rgba="1 0 0 0"/></body>
    <body mocap="true"><site name="mark" type="sphere" size=".06" rgba="1 .5 1 1"/></body>
    <body name="eye" mocap="true"><camera name="eye" fovy="50"/></body>
  </worldbody>
</mujoco>
"""


def random_poses(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Scatter the movable bodies over the floor and point the camera at them from a random side, in place."""
    for body in range(1, mj_model.nbody):
        number = mj_model.body_mocapid[body]
        name = mj_model.body(body).name
        if name == "lamp":
            continue
        quaternion = rng.normal(size=4)
        mj_data.mocap_pos[number] = rng.uniform([-0.5, -0.5, 0.25], [0.5, 0.5, 0.8])
        mj_data.mocap_quat[number] = quaternion / np.linalg.norm(quaternion)
        if name == "eye":
            turn, distance = rng.uniform(-np.pi, np.pi), rng.uniform(1.2, 2.0)
            position = np.array([distance * np.cos(turn), distance * np.sin(turn), rng.uniform(0.5, 1.6)])
            back = position - np.array([0.0, 0.0, 0.4])
            right = np.cross([0.0, 0.0, 1.0], back)
            axes = np.stack([right, np.cross(back, right), back], axis=1)
            axes /= np.linalg.norm(axes, axis=0)
            mj_data.mocap_pos[number] = position
            mujoco.mju_mat2Quat(mj_data.mocap_quat[number], axes.reshape(-1))
    mujoco.mj_forward(mj_model, mj_data)


def main() -> None:
    """Render the images and write the file."""
    mj_model = mujoco.MjModel.from_xml_string(XML)
    mj_data = mujoco.MjData(mj_model)
    rng = np.random.default_rng(SEED)
    columns: dict[str, list] = {name: [] for name in (*POSES, "rgb", "depth", "segmentation")}
    with ReferenceRenderer(mj_model, HEIGHT, WIDTH, site_groups=(0,)) as reference:
        for _ in range(IMAGES):
            random_poses(mj_model, mj_data, rng)
            for name in POSES:
                columns[name].append(getattr(mj_data, name).astype(np.float32))
            frame = reference(mj_data, "eye")
            columns["rgb"].append(frame.rgb)
            columns["depth"].append(frame.depth)
            columns["segmentation"].append(frame.segmentation.astype(np.int8))
    arrays = {name: np.stack(values) for name, values in columns.items()}
    np.savez_compressed(TARGET, xml=np.array(XML), version=np.array(mujoco.__version__), **arrays)
    print(f"wrote {TARGET.name}: {TARGET.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
