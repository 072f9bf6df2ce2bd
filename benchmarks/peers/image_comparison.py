"""Agreement of a peer renderer's images with ours: a comparison of speed is meaningless if the images differ."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

import jaxrl_vis_envs
from jaxrl_vis.bench.record import Measurement
from jaxrl_vis.bench.render import image_sizes
from jaxrl_vis.bench.scenes import images, models
from jaxrl_vis.bench.settings import Settings
from jaxrl_vis_envs.render import Scene, render_planes

CPU_SCENES = ("finger", "fetch_reach")
NUM_COMPARED = 32
"""Number of compared images per batch."""

# Renderings of the same scene differ by rounding and on silhouettes. On a CPU, in all scenes and
# sizes, depths agree in at least 99.92 % of the pixels (mujoco.Renderer) and 99.99 % (Warp), and colours without a texture
# differ by at most 1.0 (mujoco.Renderer) and 0.6 grey levels (Warp).
MIN_DEPTH_AGREEMENT, MIN_LABEL_AGREEMENT = 0.995, 0.99
MAX_DIFFERENCE = 1.5  # grey levels of 255, the mean over pixels and channels


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Input of a peer, and our images for comparison. K is at most `NUM_COMPARED`.

    Attributes:
        config: Entries of the record.
        mj_model: Model, rendered by its first cameras.
        cameras: Number of these cameras, of which each renders an image of every pose.
        scene: Our scene of the model, seen by the first camera.
        batches: Poses, see `models.random_poses`; the first ``config["images"] / cameras`` of each batch are rendered.
        repeats: Maximum number of timed repeats.
        rate: Our images per second.
        colours: Our images of the first poses of the first batch, [K, H, W, 3] uint8.
        depth: Depth in metres, inf for the sky, [K, H, W] float32.
        labels: Geoms, -1 for the sky, [K, H, W] int32.
        textured: Mask of the pixels that show a texture, [K, H, W] bool.
    """

    config: dict[str, Any]
    mj_model: mujoco.MjModel
    cameras: int
    scene: Scene
    batches: list[dict[str, np.ndarray]]
    repeats: int
    rate: float
    colours: np.ndarray
    depth: np.ndarray
    labels: np.ndarray
    textured: np.ndarray

    @property
    def has_labels(self) -> bool:
        """True if labels are among the measured outputs."""
        return self.config["pixels"] == images.MESH_OUTPUTS[0]

    def agreement(
        self,
        colours: np.ndarray,
        depth: np.ndarray,
        max_textured_difference: float = MAX_DIFFERENCE,
        max_difference: float = MAX_DIFFERENCE,
        labels: np.ndarray | None = None,
    ) -> dict[str, float]:
        """Compare a peer's images with ours. Surplus images of either are ignored.

        Args:
            colours: Images of the peer, [K, H, W, 3] uint8.
            depth: Depth in metres, inf for the sky, [K, H, W] float32.
            max_textured_difference: Bound on the mean difference over textured pixels, grey levels of 255.
            max_difference: Bound on the mean difference over pixels without a texture, grey levels of 255.
            labels: Geoms, -1 for the sky, [K, H, W] int32; None if the peer has none.

        Returns:
            Entries of the record: ``depth_agreement`` (see `depth_agreement`), ``label_agreement`` (a fraction of the pixels),
            ``colour_difference`` and ``textured_difference``: the mean absolute difference over channels and over pixels
            without and with a texture, in grey levels of 255. A difference over no pixels is omitted.

        Raises:
            AssertionError: The peer's images differ from ours.
        """
        count = min(len(depth), len(self.depth))
        differences = np.abs(self.colours[:count].astype(np.float32) - colours[:count].astype(np.float32)).mean(-1)
        textured = self.textured[:count]
        agreement = {"depth_agreement": round(depth_agreement(self.depth[:count], depth[:count]), 4)}
        complaints = []
        if agreement["depth_agreement"] < MIN_DEPTH_AGREEMENT:
            complaints.append(f"depths agree in {agreement['depth_agreement']} of the pixels, not in {MIN_DEPTH_AGREEMENT}")
        if labels is not None:
            agreement["label_agreement"] = round(float(np.mean(self.labels[:count] == labels[:count])), 4)
            if agreement["label_agreement"] < MIN_LABEL_AGREEMENT:
                complaints.append(f"labels agree in {agreement['label_agreement']} of the pixels, not in {MIN_LABEL_AGREEMENT}")
        for name, pixels, bound in (
            ("colour_difference", ~textured, max_difference),
            ("textured_difference", textured, max_textured_difference),
        ):
            if pixels.any():
                agreement[name] = round(float(differences[pixels].mean()), 3)
                if agreement[name] > bound:
                    complaints.append(f"{name} is {agreement[name]} grey levels, and {bound} at most are allowed")
        if complaints:
            raise AssertionError(f"the peer does not draw what we draw: {'; '.join(complaints)} ({self.config})")
        return agreement


def compare(case: images.Case, repeats: int, rate: float) -> Comparison:
    """Render our images for a `Comparison`.

    Args:
        case: Scene, poses and sizes.
        repeats: Maximum number of timed repeats.
        rate: Our images per second.
    """
    config, mj_model = {**case.config, "pixels": case.outputs[0]}, case.mj_model
    scene = images.make_scene(case)

    def draw(scene: Scene, poses: Any) -> tuple[Any, Any, Any]:
        planes = render_planes(scene, poses, segmentation=True, quantized=True)
        return planes.rgb, planes.depth, planes.segmentation

    compared = {name: jnp.asarray(rows[: NUM_COMPARED // case.cameras]) for name, rows in case.batches[0].items()}
    drawn = jaxrl_vis_envs.jit(lambda scene, poses: images.draw_all(case, scene, poses, draw))(scene, compared)
    colours, depth, segmentation = map(np.asarray, drawn)
    textured = np.append(textured_geoms(mj_model), scene.sky == "texture")  # index -1, the last, is the sky
    return Comparison(
        config=config,
        mj_model=mj_model,
        cameras=case.cameras,
        scene=scene,
        batches=case.batches,
        repeats=repeats,
        rate=rate,
        colours=np.moveaxis(colours, 1, -1),
        depth=np.where(depth < float(scene.zfar), depth, np.inf),
        labels=segmentation,
        textured=textured[segmentation],
    )


def measure_beside_ours(
    check: Callable[[], None], measure_peer: Callable[[Comparison], Measurement], min_poses: int = 0
) -> Callable[[Settings], Iterator[Measurement]]:
    """Return a benchmark that measures our renderer and a peer on the same poses, in the same call.

    Args:
        check: Function that raises a `RequestError` if the peer is missing.
        measure_peer: Function that measures the peer, and raises an AssertionError if its images differ from ours.
        min_poses: Minimum number of poses that the peer needs.
    """

    def measure(settings: Settings) -> Iterator[Measurement]:
        check()  # first, because the peer may be missing
        scenes = models.SCENES if settings.on_accelerator else CPU_SCENES
        for scene in (settings.scene,) if settings.scene else scenes:
            for case in images.cases(scene, settings, image_sizes(settings), min_poses):
                rates = {}
                for output in case.outputs:
                    ours = images.measure_output(case, output, settings.repeats)
                    rates[output] = ours.value
                    yield ours
                # A peer has one output: our first.
                yield measure_peer(compare(case, settings.repeats, rates[case.outputs[0]]))

    return measure


def textured_geoms(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the mask of geoms with a texture, [ngeom] bool."""
    if not mj_model.nmat:
        return np.zeros(mj_model.ngeom, bool)
    textures = mj_model.mat_texid[mj_model.geom_matid, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    return (mj_model.geom_matid >= 0) & (textures >= 0)


def depth_agreement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the fraction of pixels in which two depths [N, H, W] (m, inf for the sky) agree within 1 cm or 1 %.

    Silhouettes are included, so that renderers of the same scene agree on most pixels, but not on all.
    """
    sky = np.isinf(ours) & np.isinf(theirs)
    with np.errstate(invalid="ignore"):
        close = np.abs(ours - theirs) <= np.maximum(1e-2, 1e-2 * np.abs(theirs))
    return float(np.mean(sky | (close & np.isfinite(ours) & np.isfinite(theirs))))
