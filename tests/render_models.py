"""Models for comparing the renderer with MuJoCo's own: ours, public ones from their packages, and one for each feature.

Public models are read where pip put them (dm_control, mujoco-mjx, mujoco), never copied. `build` returns a model for
both renderers; `set_pose` sets one of its random poses by number.
"""

import dataclasses
import importlib.metadata
import importlib.util
import pathlib
import warnings
import zlib
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
from render_features import FEATURES, for_mujoco_renderer, scene_spec

import jaxrl_vis_envs
from jaxrl_vis.bench.scenes.models import forward, scatter_joints
from jaxrl_vis_envs.compiling.compilation import compiler_options
from jaxrl_vis_envs.render import Frame, Scene, render
from jaxrl_vis_envs.render.model.cameras import FREE_CAMERA

SEED = 0
# OpenGL draws polygons where a ray caster draws balls, and lights their corners: with fine ones the two mean the same.
SLICES, STACKS, QUADS = 128, 64, 16
CAMERA, SWING = "parity", "parity_swing"
_VIEW = (120.0, -25.0, 1.5)


@dataclasses.dataclass(frozen=True)
class RenderModel:
    """Model, and the camera that it is rendered from.

    Attributes:
        source: Origin of the model: "ours", the name of a distribution, or "feature".
        load: Function without arguments that loads the model.
        camera: Name or index of one of its cameras; `FREE_CAMERA` for MuJoCo's default free camera; None for one that `build`
            adds.
        view: For an added camera: azimuth and elevation in degrees as MuJoCo's free camera counts them, and the distance in
            multiples of the model's extent.
        site_groups: Groups of sites that are drawn.
        leave_out: Elements that are not drawn, see `Scene.from_mjmodel`.
        limits: Additional bounds of this model, see `Tally.failures`.
        plane_backs: Option of `Scene.from_mjmodel`; True for models with planes that turn.
        finish: Function that changes the compiled model in place; None for none.
    """

    source: str
    load: Callable[[], mujoco.MjSpec]
    camera: str | int | None = None
    view: tuple[float, ...] = _VIEW
    site_groups: tuple[int, ...] = ()
    leave_out: tuple[str, ...] = ()
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)
    plane_backs: bool | None = None
    finish: Callable[[mujoco.MjModel], None] | None = None


def package_folder(name: str) -> pathlib.Path:
    """Return the folder of an installed package, without importing it.

    Raises:
        ModuleNotFoundError: The package is not installed.
    """
    found = importlib.util.find_spec(name)
    if found is None or not found.submodule_search_locations:
        raise ModuleNotFoundError(f"the package {name} is missing: install the dev dependencies (make test does)", name=name)
    return pathlib.Path(found.submodule_search_locations[0])


def _from_package(package: str, path: str) -> Callable[[], mujoco.MjSpec]:
    return lambda: mujoco.MjSpec.from_file(str(package_folder(package).joinpath(*path.split("/"))))


def _suite(domain: str, camera: str | int | None = 0, **more: Any) -> RenderModel:
    """Return a domain of the dm_control suite, unchanged; seen by its first camera unless another is given."""
    return RenderModel("dm-control", _from_package("dm_control", f"suite/{domain}.xml"), camera, **more)


def _mjx(path: str, camera: int | None = None, **more: Any) -> RenderModel:
    """Return a test model of mujoco-mjx."""
    return RenderModel("mujoco-mjx", _from_package("mujoco", f"mjx/test_data/{path}.xml"), camera, **more)


def _ours(task: str) -> RenderModel:
    folder = pathlib.Path(jaxrl_vis_envs.__file__).parent / "tasks" / "assets"
    return RenderModel("ours", lambda: mujoco.MjSpec.from_file(str(folder / f"{task}.xml")), 0)


def _feature(name: str) -> RenderModel:
    feature = FEATURES[name]
    boards = any('type="plane"' in thing for thing in feature.things) or None

    def finish(mj_model: mujoco.MjModel) -> None:
        for number, size in enumerate(feature.sizes):
            mj_model.geom_size[mj_model.geom(f"thing{number}").id] = size

    options: dict[str, Any] = {"site_groups": (0,), "plane_backs": boards, "limits": dict(feature.limits), "finish": finish}
    return RenderModel("feature", lambda: scene_spec(feature), "eye", **options)


def _raise_terrain(mj_model: mujoco.MjModel) -> None:
    """Give the quadruped's flat terrain a bowl with bumps, as in its escape task (by our own formula)."""
    rows, columns = np.mgrid[-1.0 : 1.0 : mj_model.hfield_nrow[0] * 1j, -1.0 : 1.0 : mj_model.hfield_ncol[0] * 1j]
    bowl = np.clip(2.5 * np.hypot(rows, columns) ** 2, 0.0, 1.0)
    mj_model.hfield_data[:] = (bowl * (0.7 + 0.3 * np.sin(40.0 * rows) * np.cos(35.0 * columns))).reshape(-1)


def _lower_ground(mj_model: mujoco.MjModel) -> None:
    """Lower the ground by 0.4 m, because the robot starts inside it."""
    mj_model.geom_pos[mj_model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD, 2] -= 0.4


def _look_from_the_left(mj_model: mujoco.MjModel) -> None:
    """Make the model's free camera orthographic, and turn it to another side."""
    view = mj_model.vis.global_
    view.orthographic, view.fovy, view.azimuth, view.elevation = 1, 2.5, 20.0, -15.0


_SUITE = ("acrobot", "ball_in_cup", "cartpole", "cheetah", "finger", "fish", "hopper", "humanoid", "humanoid_CMU")
_SUITE += ("manipulator", "pendulum", "point_mass", "reacher", "stacker", "swimmer", "walker")

MODELS: dict[str, RenderModel] = {
    **{task: _ours(task) for task in ("fetch_reach", "reacher", "finger_turn", "hand_reach", "sawyer_reach")},
    **{f"dm_{domain.lower()}": _suite(domain) for domain in _SUITE},
    "dm_lqr": _suite("lqr", None),
    "dm_dog": _suite("dog", None, view=(60.0, -15.0, 1.0), leave_out=("skin",)),
    "dm_quadruped": _suite("quadruped", "x", finish=_raise_terrain),
    "dm_quadruped_far": _suite("quadruped", None, view=(60.0, -20.0, 0.8), finish=_raise_terrain),
    "mjx_convex": _mjx("convex", 0),
    "mjx_humanoid": _mjx("humanoid/humanoid"),
    "mjx_pendula": _mjx("pendula"),
    "mjx_ray": _mjx("ray"),
    "mjx_tendon": _mjx("tendon/pulley_fixed_site_wrap"),
    "mjx_wrap": _mjx("tendon/wrap_sidesite"),
    "mjx_shadow_hand": _mjx("shadow_hand/scene_right"),
    "mjx_barkour": _mjx("barkour_v0/assets/barkour_v0_mjx", 0, finish=_lower_ground),
    "mujoco_model": RenderModel("mujoco", _from_package("mujoco", "testdata/model.xml")),
    "free_camera": _mjx("pendula", FREE_CAMERA),
    "free_camera_ortho": _suite("humanoid", FREE_CAMERA, finish=_look_from_the_left),
    **{name: _feature(name) for name in FEATURES},
}


def build(name: str, truth: bool = False) -> tuple[mujoco.MjModel, int]:
    """Build a model for rendering; return it and the index of its camera.

    Multisampling is off and surfaces are finely divided; nothing else of the model's appearance is changed.

    Args:
        name: One of `MODELS`.
        truth: If true, build it for MuJoCo's own renderer, for which a few features need a stand-in.

    Raises:
        KeyError: There is no such model in `MODELS`.
        ModuleNotFoundError: The package that it comes from is not installed.
    """
    entry = MODELS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecated attributes in other people's models
        spec = scene_spec(for_mujoco_renderer(FEATURES[name])) if truth and name in FEATURES else entry.load()
        if entry.camera is None:
            _add_camera(spec, entry.view)
        mj_model = spec.compile()
    if entry.finish is not None:
        entry.finish(mj_model)
    quality = mj_model.vis.quality
    quality.offsamples, quality.numslices, quality.numstacks, quality.numquads = 0, SLICES, STACKS, QUADS
    if entry.camera is None:
        return mj_model, mj_model.camera(CAMERA).id
    return mj_model, entry.camera if isinstance(entry.camera, int) else mj_model.camera(entry.camera).id


def make_scene(name: str, mj_model: mujoco.MjModel, camera: int, height: int, width: int) -> Scene:
    """Return our scene of a model from `build`.

    Raises:
        ValueError: Our renderer cannot draw it.
    """
    entry = MODELS[name]
    return Scene.from_mjmodel(
        mj_model,
        camera,
        height,
        width,
        site_groups=entry.site_groups,
        leave_out=entry.leave_out,
        plane_backs=entry.plane_backs,
    )


def _add_camera(spec: mujoco.MjSpec, view: tuple[float, ...]) -> None:
    """Add a fixed camera that looks at the model's centre as MuJoCo's free camera would."""
    mj_model = spec.compile()
    azimuth, elevation = np.deg2rad(view[:2])
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    # Where nothing can move, the camera swings around the middle.
    swing = mj_model.nq == 0
    holder = spec.worldbody.add_body(name=SWING, mocap=True, pos=mj_model.stat.center) if swing else spec.worldbody
    camera = holder.add_camera()
    camera.name = CAMERA
    camera.pos = (0.0 if swing else mj_model.stat.center) - view[2] * mj_model.stat.extent * ahead
    mujoco.mju_mat2Quat(camera.quat, np.stack([right, np.cross(right, ahead), -ahead], axis=1).reshape(-1))


def set_pose(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, number: int) -> None:
    """Set the joints, and the mocap bodies of feature scenes, to random pose ``number``, and run the kinematics, in place."""
    rng = np.random.default_rng([SEED, number])
    scatter_joints(mj_model, mj_data, rng)
    for body in np.flatnonzero(mj_model.body_mocapid >= 0):
        name, mocap = mj_model.body(body).name, mj_model.body_mocapid[body]
        if name.startswith("thing"):
            quaternion = rng.normal(size=4)
            mj_data.mocap_pos[mocap] += rng.uniform(-0.08, 0.08, 3)
            mj_data.mocap_quat[mocap] = quaternion / np.linalg.norm(quaternion)
        elif name == SWING:
            mujoco.mju_axisAngle2Quat(mj_data.mocap_quat[mocap], [0.0, 0.0, 1.0], rng.uniform(-np.pi, np.pi))
        elif name == "eye":
            _orbit(mj_data.mocap_pos[mocap], mj_data.mocap_quat[mocap], rng)
    forward(mj_model, mj_data)


def _orbit(position: np.ndarray, quaternion: np.ndarray, rng: np.random.Generator) -> None:
    """Move the eye of a feature scene to a random place on its side of the floor, looking at the centre, in place."""
    side = np.sign(position[2])
    turn, distance = rng.uniform(-np.pi, np.pi), rng.uniform(1.2, 1.8)
    position[:] = distance * np.cos(turn), distance * np.sin(turn), side * rng.uniform(0.6, 1.5)
    back = position - np.array([0.0, 0.0, 0.35])
    right = np.cross([0.0, 0.0, 1.0], back)
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    mujoco.mju_mat2Quat(quaternion, (axes / np.linalg.norm(axes, axis=0)).reshape(-1))


def poses_of(mj_data: mujoco.MjData) -> dict[str, np.ndarray]:
    """Return the fields of MjData that the renderer reads, as a dictionary of float32 arrays."""
    names = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "xpos", "xmat", "xipos")
    return {name: np.array(getattr(mj_data, name), np.float32) for name in names}


def draw(scene: Scene, poses: list[dict[str, np.ndarray]], quick: bool = False) -> list[Frame]:
    """Render several poses, each from `poses_of`; return a frame of NumPy arrays for each.

    The scene is an argument of the compiled program: scenes that differ only in the values of arrays share it.

    Args:
        scene: From `make_scene`.
        poses: Poses, at least one.
        quick: If true, compile without optimisation, which takes less time for a handful of small images.
    """
    drawer = _draw_quick if quick else _draw_all
    frames = jax.tree.map(np.asarray, drawer(scene, jax.tree.map(lambda *rows: np.stack(rows), *poses)))
    return [jax.tree.map(lambda planes, index=index: planes[index], frames) for index in range(len(poses))]


def _render_all(scene: Scene, poses: dict[str, jax.Array]) -> Frame:
    # One after the other: under `jax.vmap` as much again would have to be traced.
    return jax.lax.map(lambda pose: render(scene, SimpleNamespace(**pose)), poses)


_draw_all, _draw_quick = (
    jax.jit(_render_all, compiler_options={**compiler_options(), "xla_backend_optimization_level": level}) for level in (2, 0)
)


def fingerprint(mj_model: mujoco.MjModel) -> int:
    """Return a checksum of the model's appearance, which may change with the version of the package that it comes from."""
    numbers = (
        mj_model.geom_type, mj_model.geom_size, mj_model.geom_pos, mj_model.geom_rgba, mj_model.body_pos, mj_model.light_pos,
        mj_model.cam_pos, mj_model.mat_rgba, mj_model.mesh_vert, mj_model.hfield_data,
    )  # fmt: skip
    # Rounded, so that another processor's last bit is not another model.
    found = zlib.crc32(mj_model.tex_data.tobytes())
    for array in numbers:
        found = zlib.crc32(np.round(np.asarray(array, np.float64), 4).tobytes(), found)
    return found


def versions() -> dict[str, str]:
    """Return the versions of the packages that models come from, by name."""
    return {name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx", "dm-control")}
