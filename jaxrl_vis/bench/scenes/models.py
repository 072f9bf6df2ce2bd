"""Scenes for comparing renderers, and batches of poses in world coordinates, so that kinematics is not timed."""

import importlib.util
import itertools
import warnings
from pathlib import Path

import mujoco
import numpy as np

from jaxrl_vis.bench.scenes import clutter, packaged
from jaxrl_vis.errors import RequestError

SCENES = ("finger", "fetch_reach", "primitives")
MESH_SCENES = ("clutter", *packaged.PACKAGED)
"""Scenes of meshes, measured only if named."""
POSES = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
POSES += ("xpos", "xmat", "xipos")
FREE_METRES, FREE_RADIANS, BALL_RADIANS, SLIDE_METRES = 0.2, 0.5, 1.0, 0.3
SPREADS = {"scattered": 1.0, "start": 0.01}
"""Spread of the joints, see `scatter_joints`: at the start just enough that no two images are equal."""


def load(scene: str, textures: bool = True, highlights: bool = True, shadows: bool = False) -> mujoco.MjModel:
    """Load the model of a scene, with multisampling off. Its first camera is the viewpoint.

    Args:
        scene: ``finger`` (from the dm_control suite), ``fetch_reach`` (ours), ``primitives`` (127 mixed primitives on and
            over a table), ``clutter`` (500 meshes), one of `packaged.PACKAGED` (robots with the meshes of their packages), or
            the path of an MJCF file with a camera.
        textures: Whether to keep the textures of materials and sky.
        highlights: Whether to keep the specular component of lights.
        shadows: Whether to keep the shadows of lights that cast any.

    Raises:
        RequestError: The scene is unknown, its package is missing, its file is not a model, or it has no camera.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo's warnings about third-party models
        if scene == "primitives":
            mj_model = mujoco.MjModel.from_xml_string(primitives_xml())
        elif scene == "clutter":
            mj_model = clutter.clutter_spec().compile()
        elif scene in packaged.PACKAGED:
            mj_model = packaged.packaged_spec(scene).compile()
        else:
            path = _scene_path(scene)
            try:
                mj_model = mujoco.MjModel.from_xml_path(str(path))
            except ValueError as error:
                raise RequestError(f"{path} is not a MuJoCo model: {' '.join(str(error).split())}") from error
    if not mj_model.ncam:
        raise RequestError(f"scene {scene} has no camera: give it one in its <worldbody>")
    mj_model.vis.quality.offsamples = 0
    if not shadows:
        mj_model.vis.quality.shadowsize = 0
        mj_model.light_castshadow[:] = 0
    if not textures:
        mj_model.mat_texid[:] = -1
        # The sky is identified by its texture type.
        mj_model.tex_type[mj_model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX] = mujoco.mjtTexture.mjTEXTURE_CUBE
    if not highlights:
        mj_model.light_specular[:] = mj_model.vis.headlight.specular[:] = 0
    return mj_model


def _scene_path(scene: str) -> Path:
    if scene == "finger":
        package = importlib.util.find_spec("dm_control")
        if package is None or not package.submodule_search_locations:
            raise RequestError(
                "scene finger is that of dm_control, which is missing: pip install --no-deps dm_control (only its model is "
                "read: dm_control 1.0.x itself does not run with MuJoCo 4)"
            )
        return Path(package.submodule_search_locations[0]) / "suite" / "finger.xml"
    if scene == "fetch_reach":
        import jaxrl_vis_envs

        return Path(jaxrl_vis_envs.__file__).parent / "tasks" / "assets" / "fetch_reach.xml"
    if not Path(scene).is_file():
        raise RequestError(f"no scene {scene!r}: choose {', '.join((*SCENES, *MESH_SCENES))} or the path of an MJCF file")
    return Path(scene)


def primitives_xml() -> str:
    """Return MJCF of 127 geoms: floor, table top, and 25 free bodies each of sphere, capsule, ellipsoid, cylinder and box.

    Types, sizes, positions, camera and lights are the same as in MuJoCo Warp's own benchmark of that name, so that its results
    are comparable.
    """
    kinds = (
        ("sphere", ".05", "1 0 0 1", 0.8),
        ("capsule", ".04 .05", "0 1 0 1", 0.95),
        ("ellipsoid", ".05 .04 .03", "0 0 1 1", 1.1),
        ("cylinder", ".04 .04", "1 1 0 1", 1.2),
        ("box", ".03 .03 .03", "0 1 1 1", 1.4),
    )
    bodies = "\n".join(
        f'<body pos="{0.6 + 0.1 * column:g} {-0.4 + 0.2 * row:g} {height}"><freejoint/>'
        f'<geom type="{kind}" size="{size}" rgba="{rgba}"/></body>'
        for (kind, size, rgba, height), row, column in itertools.product(kinds, range(5), range(5))
    )
    return f"""
<mujoco model="primitives">
  <visual>
    <map znear=".01" zfar="200"/>
    <headlight ambient=".2 .2 .2" diffuse=".8 .8 .8" specular="1 1 1"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="1 1 1" rgb2="1 1 1" width="64" height="384"/>
    <texture name="grid" type="2d" builtin="checker" rgb1=".1 .2 .3" rgb2=".2 .3 .4" width="512" height="512"/>
    <material name="grid" texture="grid" texrepeat="1 1" texuniform="true"/>
  </asset>
  <worldbody>
    <light directional="true" pos="0 0 3" dir="0 0 -1"/>
    <camera pos="3 0 2" xyaxes="0 1 0 -.6 0 1"/>
    <geom type="plane" size="0 0 .05" material="grid"/>
    <geom type="box" pos=".8 0 .5" size=".5 1 .01"/>
    {bodies}
  </worldbody>
</mujoco>
"""


def scatter_joints(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, rng: np.random.Generator, spread: float = 1.0) -> None:
    """Set every joint to a random position, in place, without running the kinematics.

    Hinges and slides are uniform within their limits (hinges without: any angle; slides without: 0.3 m each way), balls turn by
    up to a radian, free bodies move along each axis by up to a tenth of the model's extent (0.2 m at most) and turn by up to
    half a radian.

    Args:
        mj_model: Model.
        mj_data: State, which is reset and whose ``qpos`` is written.
        rng: Random generator.
        spread: Fraction in [0, 1] of the distance from the start to that position.
    """
    mujoco.mj_resetData(mj_model, mj_data)
    joints = mujoco.mjtJoint
    kinds, starts = mj_model.jnt_type, mj_model.jnt_qposadr
    reach = np.where(kinds == joints.mjJNT_HINGE, np.pi, SLIDE_METRES)[:, None] * np.array([-1.0, 1.0])
    low, high = np.where(mj_model.jnt_limited[:, None], mj_model.jnt_range, reach).T
    angles = rng.uniform(low, high)
    simple = (kinds == joints.mjJNT_HINGE) | (kinds == joints.mjJNT_SLIDE)
    here = starts[simple]
    mj_data.qpos[here] = (1.0 - spread) * mj_data.qpos[here] + spread * angles[simple]
    free = starts[kinds == joints.mjJNT_FREE][:, None]
    max_shift = spread * min(0.1 * mj_model.stat.extent, FREE_METRES)
    mj_data.qpos[free + np.arange(3)] += max_shift * rng.uniform(-1.0, 1.0, (len(free), 3))
    balls = starts[kinds == joints.mjJNT_BALL][:, None]
    for addresses, radians in ((free + 3 + np.arange(4), FREE_RADIANS), (balls + np.arange(4), BALL_RADIANS)):
        mj_data.qpos[addresses] = _rotate_randomly(mj_data.qpos[addresses], spread * radians, rng)


def _rotate_randomly(quaternions: np.ndarray, max_angle: float, rng: np.random.Generator) -> np.ndarray:
    """Rotate [N, 4] quaternions by up to ``max_angle`` radians about random axes."""
    axes = rng.normal(size=(len(quaternions), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    half = rng.uniform(0.0, max_angle, (len(quaternions), 1)) / 2
    real, vector = quaternions[:, :1], quaternions[:, 1:]
    turn_real, turn = np.cos(half), np.sin(half) * axes
    product = real * turn + turn_real * vector + np.cross(vector, turn)
    return np.concatenate([real * turn_real - np.sum(vector * turn, 1, keepdims=True), product], axis=1)


def forward(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> None:
    """Compute the inputs of rendering in ``mj_data``: poses of bodies, geoms, sites, cameras, lights, tendons, and limits."""
    mujoco.mj_kinematics(mj_model, mj_data)
    mujoco.mj_comPos(mj_model, mj_data)
    mujoco.mj_camlight(mj_model, mj_data)
    if mj_model.ntendon:
        mujoco.mj_tendon(mj_model, mj_data)
        mujoco.mj_makeConstraint(mj_model, mj_data)


def random_poses(mj_model: mujoco.MjModel, count: int, seed: int, spread: float = 1.0) -> dict[str, np.ndarray]:
    """Compute poses in world coordinates for ``count`` random joint positions.

    Args:
        mj_model: Model.
        count: Number of poses.
        seed: Seed of the joint positions.
        spread: See `scatter_joints`.

    Returns:
        Arrays [count, ...] float32 by name (`POSES`), shaped as in MjData.
    """
    rng, mj_data = np.random.default_rng(seed), mujoco.MjData(mj_model)
    poses = {name: np.empty((count, *getattr(mj_data, name).shape), np.float32) for name in POSES}
    for index in range(count):
        scatter_joints(mj_model, mj_data, rng, spread)
        forward(mj_model, mj_data)
        for name, rows in poses.items():
            rows[index] = getattr(mj_data, name)
    return poses


def needed_tests(mj_model: mujoco.MjModel, poses: dict[str, np.ndarray], size: int) -> np.ndarray:
    """Compute ray-geom tests per pixel under perfect culling by bounding spheres, averaged over ``poses``: [ngeom] float.

    A geom needs a test in every pixel that the projection of its bounding sphere covers, a plane in every pixel. Geoms that
    are not rendered (because of their group, or with alpha 0) need none.

    Args:
        mj_model: Model, seen by its first camera.
        poses: Poses from `random_poses`.
        size: Height and width of the image in pixels.
    """
    drawn = np.isin(mj_model.geom_group, (0, 1, 2)) & (mj_model.geom_rgba[:, 3] > 0)
    endless = drawn & (mj_model.geom_rbound <= 0)
    round_ = np.flatnonzero(drawn & ~endless)
    axes = poses["cam_xmat"][:, 0].reshape(-1, 3, 3)
    offset = poses["geom_xpos"][:, round_] - poses["cam_xpos"][:, :1]
    x, y, away = np.moveaxis(np.einsum("ngi,nij->ngj", offset, axes), -1, 0) * np.array([1.0, 1.0, -1.0])[:, None, None]
    radius = mj_model.geom_rbound[round_]
    reach = np.tan(np.deg2rad(mj_model.cam_fovy[0]) / 2)
    middles = (2.0 * np.arange(size) + 1.0 - size) / size * reach
    tests = endless.astype(float)
    for u, v in itertools.product(middles, middles):
        # The sphere's centre is within one radius of the ray (u, v, -1), and the sphere is not entirely behind the camera.
        length = u * u + v * v + 1.0
        along = (x * u + y * v + away) / length
        apart = x * x + y * y + away * away - along * along * length
        met = (apart <= radius * radius) & (away + radius > 0.0)
        tests[round_] += np.mean(met, axis=0) / (size * size)
    return tests
