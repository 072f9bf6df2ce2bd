"""Compare our renderer with MuJoCo's own on every model in a folder of third-party models; see `render_parity`.

Each MJCF or URDF file is rendered in its initial and in a random pose: by its camera `cam`, or else by the free camera and all
of its own cameras. Sites and haze have rows of their own, if the model has them. If a camera or a light moves, the poses come
from `mjx.kinematics`, as in a task. Shadows, reflections, skins, flexes and multisampling are off.

The pass criterion is in `Measures.failures`. Models that do not load, that are hardly visible, or whose image by MuJoCo is
unreliable have verdicts of their own, which do not count as failures.
"""

import dataclasses
import pathlib
import time
import warnings
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import render_models
from PIL import Image
from render_comparison import dilated, matched_shares, near_edges

from benchmarks.rendering.reference import ReferenceRenderer
from jaxrl_vis.bench.scenes.models import forward, scatter_joints
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.render import Frame, Scene
from jaxrl_vis_envs.render.camera import camera_pose, pixel_rays, ray_parts

SUFFIXES = (".xml", ".mjcf", ".urdf")
VOID = 0.002  # fraction of an image; if less of it shows an object, there is nothing to compare
SEEN_PIXELS = 12  # minimum number of pixels, away from edges, of an object that must not be missing
LARGE_DIFFERENCE = 16  # grey levels
SHIFT = 2e-6  # camera displacement relative to the model's extent that should not change the image
SKY = 0.69  # fraction of zfar beyond which the sky occludes colours, see docs/renderer.md
FINE = 1e-3  # cell size of a plane's grid, m; MuJoCo makes at most some 200 cells per row
DEFORMABLES = ("skin", "flex")


@dataclasses.dataclass(frozen=True)
class Measures:
    """Differences between two images, away from edges; the worst over the poses of a row.

    Attributes:
        segmentation: Fraction of pixels that show the same object.
        depth: Fraction of object pixels with the same depth, within 1 mm or a thousandth.
        rgb: Mean absolute difference, grey levels of 255.
        max_difference: Maximum absolute difference, grey levels of 255.
        large_differences: Fraction of pixels with a channel that differs by more than 16 grey levels.
        matched: Minimum of `render_comparison.matched_shares`.
        missing: Labels that are visible in MuJoCo's image and absent from ours.
    """

    segmentation: float = 1.0
    depth: float = 1.0
    rgb: float = 0.0
    max_difference: int = 0
    large_differences: float = 0.0
    matched: float = 1.0
    missing: tuple[int, ...] = ()

    def failures(self) -> list[str]:
        """List the violated parts of the pass criterion."""
        held = {
            "seg": self.segmentation >= 0.99,
            "depth": self.depth >= 0.995,
            "rgb": self.rgb <= 4.0,
            ">16": self.large_differences <= 0.02,
            "match": self.matched >= 0.9,
            f"missing {self.missing}": not self.missing,
        }
        return [name for name, holds in held.items() if not holds]

    def worst_of(self, other: "Measures") -> "Measures":
        """Return the elementwise worse of two measures."""
        similarities, differences = ("segmentation", "depth", "matched"), ("rgb", "max_difference", "large_differences")
        values: dict[str, Any] = {name: min(getattr(self, name), getattr(other, name)) for name in similarities}
        values |= {name: max(getattr(self, name), getattr(other, name)) for name in differences}
        return Measures(**values, missing=tuple(sorted({*self.missing, *other.missing})))


def measure(ours: Frame, theirs: Frame, hidden: np.ndarray) -> Measures:
    """Compare two frames of NumPy arrays, ignoring colours where ``hidden`` [H, W] is True."""
    inside = ~(near_edges(ours.segmentation) | near_edges(theirs.segmentation))
    solid = inside & ((ours.segmentation >= 0) | (theirs.segmentation >= 0))
    difference = np.max(np.abs(ours.rgb.astype(np.int16) - theirs.rgb), axis=-1)
    coloured = inside & ~hidden
    # The labels of coincident surfaces are arbitrary in both renderers: either is accepted if depth and colour agree.
    either = (np.abs(ours.depth - theirs.depth) <= 1e-4 * np.maximum(1.0, theirs.depth)) & (difference <= 4)
    near = np.abs(ours.depth - theirs.depth) <= np.maximum(1e-3, 1e-3 * theirs.depth)
    labels, counts = np.unique(theirs.segmentation[inside & ~either], return_counts=True)
    missing = [
        int(label)
        for label in labels[(labels >= 0) & (counts >= SEEN_PIXELS)]
        if not np.any(dilated(ours.segmentation == label) & (theirs.segmentation == label))
    ]
    mean = np.abs(ours.rgb.astype(np.int16) - theirs.rgb)[coloured].mean() if coloured.any() else 0.0
    return Measures(
        segmentation=_fraction(inside & ((ours.segmentation == theirs.segmentation) | either), inside),
        depth=_fraction(solid & near, solid),
        rgb=float(mean),
        max_difference=int(difference[coloured].max(initial=0)),
        large_differences=1.0 - _fraction(coloured & (difference <= LARGE_DIFFERENCE), coloured),
        matched=min(matched_shares(ours, theirs).values(), default=1.0),
        missing=tuple(missing),
    )


def _fraction(part: np.ndarray, total: np.ndarray) -> float:
    return float(part.sum() / total.sum()) if total.any() else 1.0


@dataclasses.dataclass(frozen=True)
class View:
    """Row of the table: a camera (None: the free one), and whether sites and haze are rendered."""

    camera: int | None
    sites: bool = False
    haze: bool = False

    def title(self, mj_model: mujoco.MjModel) -> str:
        """Return a short title for the table."""
        name = "free" if self.camera is None else mj_model.camera(self.camera).name or str(self.camera)
        return name + " + sites" * self.sites + " + haze" * self.haze


def views(mj_model: mujoco.MjModel) -> list[View]:
    """List the views of a model, one per row of the table."""
    named = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_CAMERA, "cam")
    cameras = [named] if named >= 0 else [None, *range(mj_model.ncam)]
    rows = [View(camera) for camera in cameras]
    if mj_model.nsite:
        rows.append(View(cameras[0], sites=True))
    endless = (mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & np.all(mj_model.geom_size[:, :2] == 0, axis=1)
    if np.any(endless) and np.any(mj_model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
        rows.append(View(cameras[0], haze=True))
    return rows


class Comparison:
    """Model from a file, its poses, and the comparison of its views.

    Attributes:
        mj_model: The model.
        size: Length of the longer side of an image, pixels.
        data: The poses.
    """

    def __init__(self, path: pathlib.Path, size: int) -> None:
        """Read the model; raise a ValueError if MuJoCo cannot."""
        self.mj_model = mujoco.MjModel.from_xml_path(str(path))
        quality = self.mj_model.vis.quality
        quality.offsamples = 0
        quality.numslices, quality.numstacks, quality.numquads = (
            render_models.SLICES, render_models.STACKS, render_models.QUADS,
        )  # fmt: skip
        # MuJoCo lights only the grid's vertices, and loses a spot light's edge between them: use the finest grid.
        self.mj_model.geom_size[self.mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, 2] = FINE
        buffer = self.mj_model.vis.global_
        buffer.offwidth, buffer.offheight = max(buffer.offwidth, size), max(buffer.offheight, size)
        self.size = size
        self.data = list(self._poses())

    def _poses(self) -> Iterator[mujoco.MjData]:
        """Yield the initial pose, and a random one if there are joints."""
        start = mujoco.MjData(self.mj_model)
        forward(self.mj_model, start)
        yield start
        if self.mj_model.nq:
            scattered = mujoco.MjData(self.mj_model)
            scatter_joints(self.mj_model, scattered, np.random.default_rng(0), 0.3)
            forward(self.mj_model, scattered)
            yield scattered

    def our_poses(self) -> list[dict[str, np.ndarray]]:
        """Return the poses for our renderer: from MJX's kinematics if a camera or light moves and MJX supports the model."""
        moving = np.any(self.mj_model.cam_bodyid > 0) or np.any(self.mj_model.light_bodyid > 0)
        moving |= np.any(self.mj_model.cam_targetbodyid >= 0) or np.any(self.mj_model.light_targetbodyid >= 0)
        if moving and not self.mj_model.nmocap:  # MJX does not move children of mocap bodies
            try:
                model = mjx.put_model(self.mj_model)
                empty = mjx.make_data(self.mj_model)
                move = jax.jit(lambda qpos: mjx.kinematics(model, empty.replace(qpos=qpos)))
                return [render_models.poses_of(move(jnp.asarray(data.qpos))) for data in self.data]
            except (NotImplementedError, ValueError):  # MJX does not support a joint, geom or solver
                pass
        return [render_models.poses_of(data) for data in self.data]

    def image_size(self, view: View) -> tuple[int, int]:
        """Return height and width of a view's images, pixels, in the aspect ratio of the camera's resolution."""
        wide, high = (1, 1) if view.camera is None else self.mj_model.cam_resolution[view.camera]
        scale = self.size / max(wide, high)
        return max(1, round(high * scale)), max(1, round(wide * scale))

    def compare(self, view: View, pictures: pathlib.Path | None = None) -> tuple[Measures | None, str]:
        """Compare a view in all poses; return its measures (None if our renderer refuses the model) and the verdict.

        Args:
            view: Camera and features to render.
            pictures: Prefix of the PNG files for ours, MuJoCo's and the difference times 8, side by side; None for no files.
        """
        height, width = self.image_size(view)
        groups = (0, 1, 2) if view.sites else ()
        options: dict[str, Any] = dict(site_groups=groups, haze=view.haze, lights="mujoco")
        remark = ""
        try:
            try:
                scene = Scene.from_mjmodel(self.mj_model, view.camera, height, width, **options)
            except ValueError as refusal:
                said = [kind for kind in DEFORMABLES if f"{kind} " in str(refusal)]
                if not said:
                    raise
                scene = Scene.from_mjmodel(self.mj_model, view.camera, height, width, leave_out=DEFORMABLES, **options)
                remark = f" without {' and '.join(said)} (limit)"
        except ValueError as refusal:
            return None, f"**FAIL**: refused: {' '.join(str(refusal).split())}"
        theirs = self.reference(view)
        shown = max(float(np.mean(frame.segmentation >= 0)) for frame in theirs)
        ours = render_models.draw(scene, self.our_poses(), quick=True)
        total = Measures()
        for our, their, data in zip(ours, theirs, self.data, strict=True):
            measures = measure(our, their, np.zeros(their.depth.shape, bool))
            for limit, hidden in self.limits(scene, their, data).items():
                if measures.failures() and np.any(hidden):
                    measures = measure(our, their, hidden)
                    remark += f", without {limit} (limit)" if limit not in remark else ""
            total = total.worst_of(measures)
        if pictures is not None:
            for number, (our, their) in enumerate(zip(ours, theirs, strict=True)):
                difference = np.minimum(8 * np.abs(our.rgb.astype(np.int16) - their.rgb), 255).astype(np.uint8)
                Image.fromarray(np.concatenate([our.rgb, their.rgb, difference], axis=1)).save(f"{pictures}_{number}.png")
        if shown < VOID:
            return total, f"void: {shown:.1%} of the picture shows an object"
        failures = total.failures()
        if not failures:
            return total, "pass" + remark
        doubt = self.reference_fault(view, scene, ours, theirs)
        return total, f"no verdict: {doubt}" if doubt else "**FAIL**: " + ", ".join(failures) + remark

    def reference(self, view: View, shift: np.ndarray | float = 0.0) -> list[Frame]:
        """Render all poses with MuJoCo's renderer, with the camera moved by ``shift`` [3] (m, world axes)."""
        height, width = self.image_size(view)
        frames = []
        groups = (0, 1, 2) if view.sites else ()
        with ReferenceRenderer(self.mj_model, height, width, site_groups=groups, haze=view.haze) as renderer:
            for data in self.data:
                camera: Any = view.camera
                if camera is None:
                    camera = mujoco.MjvCamera()
                    mujoco.mjv_defaultFreeCamera(self.mj_model, camera)
                    camera.lookat[:] += shift
                    frames.append(renderer(data, camera))
                    continue
                data.cam_xpos[camera] += shift
                frames.append(renderer(data, camera))
                data.cam_xpos[camera] -= shift
        return frames

    def reference_fault(self, view: View, scene: Scene, ours: list[Frame], theirs: list[Frame]) -> str:
        """Return the reason that makes MuJoCo's images an invalid reference, as text; an empty string if they are valid."""
        nowhere = np.zeros(theirs[0].segmentation.shape, bool)
        for direction in ([0.3, 0.5, 0.8], [-0.7, 0.2, 0.1]):
            moved = self.reference(view, SHIFT * self.mj_model.stat.extent * np.array(direction))
            if any(measure(one, other, nowhere).failures() for one, other in zip(moved, theirs, strict=True)):
                return "MuJoCo's image changes when its camera moves by a hair"
        endless = (self.mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & np.all(self.mj_model.geom_size[:, :2] == 0, 1)
        for our, their, data in zip(ours, theirs, self.data, strict=True):
            for floor in np.flatnonzero(endless):
                position, away = seen_points(scene, our, data)
                beyond = np.linalg.norm((position[:, None, None] + away) - data.geom_xpos[floor][:, None, None], axis=0)
                lost = (our.segmentation == floor) & (their.segmentation != floor) & (beyond > float(scene.zfar))
                if np.mean(lost) > 0.01:
                    return "MuJoCo's endless floor ends at zfar from its middle, and the camera is beyond"
        return ""

    def limits(self, scene: Scene, frame: Frame, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """Return cumulative masks [H, W] bool of known colour differences (docs/renderer.md), by name.

        MuJoCo renders its sky on a cylinder around the camera, which occludes everything beyond; and it lights only a grid's
        vertices, so the edge of a spot light lies anywhere between them.
        """
        position, away = seen_points(scene, frame, data)
        hidden = np.zeros(frame.depth.shape, bool)
        if np.any(self.mj_model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
            reach = SKY * float(scene.zfar)
            hidden = (np.hypot(away[0], away[1]) > reach) | (np.abs(away[2]) > reach)
        lit = np.zeros(frame.depth.shape, np.int64)
        spots = self.mj_model.light_active.astype(bool) & (self.mj_model.light_type == mujoco.mjtLightType.mjLIGHT_SPOT)
        for number, light in enumerate(np.flatnonzero(spots)):
            ray = position[:, None, None] + away - data.light_xpos[light][:, None, None]
            cosine = np.tensordot(data.light_xdir[light], ray, axes=1) / np.maximum(np.linalg.norm(ray, axis=0), 1e-9)
            lit += (cosine > np.cos(np.deg2rad(self.mj_model.light_cutoff[light]))).astype(np.int64) << number
        edges = near_edges(np.where(frame.segmentation >= 0, lit, 0))
        return {"what is behind the sky": hidden, "edges of spot lights": hidden | dilated(edges)}


def seen_points(scene: Scene, frame: Frame, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's position [3] (m), and the visible point of each pixel relative to it [3, H, W] (m), in world axes."""
    position, rotation, _ = camera_pose(scene, data)
    start, direction, _ = ray_parts(scene, pixel_rays(scene, *np.indices(frame.depth.shape)))
    points = [np.asarray(s + frame.depth * d) * np.ones(frame.depth.shape) for s, d in zip(start, direction, strict=True)]
    return np.asarray(position), np.tensordot(np.asarray(rotation), np.stack(points), axes=1)


def report(folder: pathlib.Path, size: int, pictures: pathlib.Path | None) -> int:
    """Print the table of a folder; return 1 if a row fails, else 0."""
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    print("| model | view | seg | depth | rgb | max | > 16 | match | s | verdict |\n" + "| --- " * 10 + "|", flush=True)
    rows = failed = 0
    for path in paths:
        name = str(path.relative_to(folder))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # MuJoCo's warnings about third-party models
            for title, measures, verdict, seconds in folder_rows(path, name, size, pictures):
                rows, failed = rows + 1, failed + ("FAIL" in verdict)
                figures = (
                    " | | | | |"
                    if measures is None
                    else (
                        f"{measures.segmentation:.4f} | {measures.depth:.4f} | {measures.rgb:.2f} | {measures.max_difference} |"
                        f" {measures.large_differences:.2%} | {measures.matched:.3f}"
                    )
                )
                print(f"| {name} | {title} | {figures} | {seconds:.0f} | {verdict} |", flush=True)
    print(f"\n{rows} rows of {len(paths)} files, {failed} failed")
    return int(failed > 0)


def folder_rows(
    path: pathlib.Path, name: str, size: int, pictures: pathlib.Path | None
) -> Iterator[tuple[str, Measures | None, str, float]]:
    """Yield view, measures, verdict and time (s) of each row of a file."""
    start = time.perf_counter()
    try:
        comparison = Comparison(path, size)
    except (ValueError, mujoco.FatalError) as error:
        yield "", None, f"not loaded: {' '.join(str(error).split())[:120]}", time.perf_counter() - start
        return
    for view in views(comparison.mj_model):
        start, title = time.perf_counter(), view.title(comparison.mj_model)
        target = None
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            target = pictures / f"{name}_{title}".replace("/", "_").replace(" ", "")
        measures, verdict = comparison.compare(view, target)
        yield title, measures, verdict, time.perf_counter() - start
