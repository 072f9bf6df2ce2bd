"""Models that the renderer is compared on with MuJoCo's own: ours, public ones from their packages, and one for each feature.

Public models are read where pip put them (dm_control, mujoco-mjx, mujoco), never copied. `build` returns a model that is ready
to be drawn by both renderers; `set_pose` puts it into the pose of a seed and a number.
"""

import dataclasses
import importlib.metadata
import importlib.util
import pathlib
import warnings
import zlib
from collections.abc import Callable

import mujoco
import numpy as np
from render_features import FEATURES, scene_xml

import jaxrl_vis_envs

SEED = 0
# OpenGL draws polygons where a ray caster draws balls, and lights their corners: with fine ones the two mean the same.
SLICES, STACKS, QUADS = 128, 64, 16
CAMERA = "parity"


@dataclasses.dataclass(frozen=True)
class RenderModel:
    """A model and how to look at it.

    Attributes:
        source: What it comes from: "ours", the name of a distribution, or "feature".
        load: Reads it; called without arguments.
        camera: Name or index of one of its cameras; None for one that `build` adds.
        view: For an added camera: azimuth and elevation in degrees as MuJoCo's free camera counts them, and the distance in
            multiples of the model's extent.
        site_groups: Groups of sites that are drawn.
    """

    source: str
    load: Callable[[], mujoco.MjSpec]
    camera: str | int | None = None
    view: tuple[float, float, float] = (120.0, -25.0, 1.5)
    site_groups: tuple[int, ...] = ()


def package_folder(name: str) -> pathlib.Path:
    """Where pip put a package, without importing it."""
    found = importlib.util.find_spec(name)
    if found is None or not found.submodule_search_locations:
        raise ModuleNotFoundError(f"the package {name} is missing: install the dev dependencies (make test does)", name=name)
    return pathlib.Path(found.submodule_search_locations[0])


def _from_package(package: str, path: str) -> Callable[[], mujoco.MjSpec]:
    return lambda: mujoco.MjSpec.from_file(str(package_folder(package).joinpath(*path.split("/"))))


def _suite(domain: str) -> Callable[[], mujoco.MjSpec]:
    return _from_package("dm_control", f"suite/{domain}.xml")


def _ours(task: str) -> Callable[[], mujoco.MjSpec]:
    folder = pathlib.Path(jaxrl_vis_envs.__file__).parent / "tasks" / "assets"
    return lambda: mujoco.MjSpec.from_file(str(folder / f"{task}.xml"))


def _feature(name: str) -> Callable[[], mujoco.MjSpec]:
    return lambda: mujoco.MjSpec.from_string(scene_xml(FEATURES[name]))


MODELS: dict[str, RenderModel] = {
    "fetch_reach": RenderModel("ours", _ours("fetch_reach"), 0),
    "dm_finger": RenderModel("dm_control", _suite("finger"), "cam0"),
    **{name: RenderModel("feature", _feature(name), "eye", site_groups=(0,)) for name in FEATURES},
}


def build(name: str) -> tuple[mujoco.MjModel, int]:
    """The model, ready to be drawn by both renderers, and the index of the camera that looks.

    Multisampling is off and surfaces are finely divided; nothing else of the model's look is changed.

    Raises:
        KeyError: There is no such model in `MODELS`.
        ModuleNotFoundError: The package that it comes from is not installed.
    """
    entry = MODELS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecated attributes in other people's models
        spec = entry.load()
        if entry.camera is None:
            _add_camera(spec, entry.view)
        mj_model = spec.compile()
    quality = mj_model.vis.quality
    quality.offsamples, quality.numslices, quality.numstacks, quality.numquads = 0, SLICES, STACKS, QUADS
    if entry.camera is None:
        return mj_model, mj_model.camera(CAMERA).id
    return mj_model, entry.camera if isinstance(entry.camera, int) else mj_model.camera(entry.camera).id


def _add_camera(spec: mujoco.MjSpec, view: tuple[float, float, float]) -> None:
    """Adds a fixed camera that looks at the model's middle as MuJoCo's free camera would."""
    mj_model = spec.compile()
    azimuth, elevation = np.deg2rad(view[:2])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    camera = spec.worldbody.add_camera()
    camera.name = CAMERA
    camera.pos = mj_model.stat.center - view[2] * mj_model.stat.extent * ahead
    camera.alt.xyaxes = [*right, *np.cross(right, ahead)]


def set_pose(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, number: int) -> None:
    """Puts the joints into random pose ``number``, and the mocap bodies of the feature scenes too; runs the kinematics.

    Hinges and slides are uniform within their limits (hinges without: any angle; slides without: 0.3 m each way), balls turn by
    up to a radian, free bodies move by a tenth of the model's extent and turn by up to half a radian.
    """
    rng = np.random.default_rng([SEED, number])
    mujoco.mj_resetData(mj_model, mj_data)
    for joint in range(mj_model.njnt):
        start, kind = mj_model.jnt_qposadr[joint], mj_model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            mj_data.qpos[start : start + 3] += 0.1 * mj_model.stat.extent * rng.uniform(-1.0, 1.0, 3)
            _turn(mj_data.qpos[start + 3 : start + 7], 0.5, rng)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            _turn(mj_data.qpos[start : start + 4], 1.0, rng)
        else:
            reach = np.pi if kind == mujoco.mjtJoint.mjJNT_HINGE else 0.3
            low, high = mj_model.jnt_range[joint] if mj_model.jnt_limited[joint] else (-reach, reach)
            mj_data.qpos[start] = rng.uniform(low, high)
    for body in np.flatnonzero(mj_model.body_mocapid >= 0):
        name, mocap = mj_model.body(body).name, mj_model.body_mocapid[body]
        if name.startswith("thing"):
            quaternion = rng.normal(size=4)
            mj_data.mocap_pos[mocap] += rng.uniform(-0.08, 0.08, 3)
            mj_data.mocap_quat[mocap] = quaternion / np.linalg.norm(quaternion)
        elif name == "eye":
            _orbit(mj_data.mocap_pos[mocap], mj_data.mocap_quat[mocap], rng)
    forward(mj_model, mj_data)


def forward(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> None:
    """Runs what a picture needs: the poses of bodies, geoms, sites, cameras and lights."""
    mujoco.mj_kinematics(mj_model, mj_data)
    mujoco.mj_comPos(mj_model, mj_data)
    mujoco.mj_camlight(mj_model, mj_data)


def _turn(quaternion: np.ndarray, most: float, rng: np.random.Generator) -> None:
    """Turns a quaternion in place, by up to ``most`` radians about a random axis."""
    axis, turned = rng.normal(size=3), np.empty(4)
    mujoco.mju_axisAngle2Quat(turned, axis / np.linalg.norm(axis), rng.uniform(0.0, most))
    mujoco.mju_mulQuat(quaternion, quaternion.copy(), turned)


def _orbit(position: np.ndarray, quaternion: np.ndarray, rng: np.random.Generator) -> None:
    """Puts the eye somewhere around the middle of a feature scene, looking at it."""
    turn, distance = rng.uniform(-np.pi, np.pi), rng.uniform(1.2, 1.8)
    position[:] = distance * np.cos(turn), distance * np.sin(turn), rng.uniform(0.6, 1.5)
    back = position - np.array([0.0, 0.0, 0.35])
    right = np.cross([0.0, 0.0, 1.0], back)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    mujoco.mju_mat2Quat(quaternion, (axes / np.linalg.norm(axes, axis=0)).reshape(-1))


def poses_of(mj_data: mujoco.MjData) -> dict[str, np.ndarray]:
    """What the renderer reads of MjData, as a dictionary that `jax.vmap` understands."""
    names = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "subtree_com")
    return {name: np.array(getattr(mj_data, name), np.float32) for name in names}


def fingerprint(mj_model: mujoco.MjModel) -> int:
    """A number that changes when what the model looks like does: another version of the package that it comes from."""
    arrays = (
        mj_model.geom_type, mj_model.geom_size, mj_model.geom_pos, mj_model.geom_rgba, mj_model.body_pos, mj_model.light_pos,
        mj_model.cam_pos, mj_model.mat_rgba, mj_model.tex_data, mj_model.mesh_vert, mj_model.hfield_data,
    )  # fmt: skip
    # Rounded, so that another processor's last bit is not another model.
    return zlib.crc32(b"".join(np.round(np.asarray(array, np.float64), 4).tobytes() for array in arrays))


def versions() -> dict[str, str]:
    """Versions of the packages that models come from."""
    return {name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx", "dm-control")}
