"""Whether another renderer draws what ours draws: a comparison of speed means nothing where the images differ."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.compilation import env_jit
from jaxrl_vis_envs.render import Scene, render_planes

COMPARED = 32
"""Images of a batch that are compared."""

# Renderers that draw the same scene differ by rounding, and on the silhouettes of what they draw. On a CPU, in all scenes and
# sizes, depths agree in at least 99.92 % of the pixels (mujoco.Renderer) and 99.99 % (Warp), and colours without a texture
# differ by at most 1.0 (mujoco.Renderer) and 0.6 grey levels (Warp).
LEAST_DEPTH_AGREEMENT = 0.995
MOST_DIFFERENCE = 1.5  # grey levels of 255, the mean over pixels and channels


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What a peer is given, and what we drew of it. K is at most `COMPARED`.

    Attributes:
        config: What the record says was drawn.
        mj_model: The model; its first camera looks.
        scene: Our reading of it.
        batches: Poses, see `render_scenes.random_poses`; ``config["images"]`` of each are drawn.
        repeats: Timed repeats at most.
        rate: Our images per second.
        colours: [K, H, W, 3] uint8, ours in the first poses of the first batch.
        depth: [K, H, W] float32 metres, inf for the sky.
        textured: [K, H, W] bool, whether a pixel shows a texture.
    """

    config: dict[str, Any]
    mj_model: mujoco.MjModel
    scene: Scene
    batches: list[dict[str, np.ndarray]]
    repeats: int
    rate: float
    colours: np.ndarray
    depth: np.ndarray
    textured: np.ndarray

    def agreement(
        self, colours: np.ndarray, depth: np.ndarray, most_textured_difference: float = MOST_DIFFERENCE
    ) -> dict[str, float]:
        """Compares a peer's images with ours.

        Args:
            colours: [K, H, W, 3] uint8, the peer's. Where one has more images than the other, they are left out.
            depth: [K, H, W] float32 metres, inf for the sky.
            most_textured_difference: Bound of the mean difference of pixels that show a texture, grey levels of 255.

        Returns:
            What a record keeps: ``depth_agreement`` (see `depth_agreement`), ``colour_difference`` and
            ``textured_difference``: the mean over pixels and channels of the absolute difference in grey levels of 255, where
            there is no texture and where there is one. A difference of no pixels is left out.

        Raises:
            AssertionError: The peer draws something else.
        """
        count = min(len(depth), len(self.depth))
        differences = np.abs(self.colours[:count].astype(np.float32) - colours[:count].astype(np.float32)).mean(-1)
        textured = self.textured[:count]
        found = {"depth_agreement": round(depth_agreement(self.depth[:count], depth[:count]), 4)}
        complaints = []
        if found["depth_agreement"] < LEAST_DEPTH_AGREEMENT:
            complaints.append(f"depths agree in {found['depth_agreement']} of the pixels, not in {LEAST_DEPTH_AGREEMENT}")
        for name, pixels, most in (
            ("colour_difference", ~textured, MOST_DIFFERENCE),
            ("textured_difference", textured, most_textured_difference),
        ):
            if pixels.any():
                found[name] = round(float(differences[pixels].mean()), 3)
                if found[name] > most:
                    complaints.append(f"{name} is {found[name]} grey levels, and {most} at most are allowed")
        if complaints:
            raise AssertionError(f"the peer does not draw what we draw: {'; '.join(complaints)} ({self.config})")
        return found


def compare(
    config: dict[str, Any], mj_model: mujoco.MjModel, batches: list[dict[str, np.ndarray]], repeats: int, rate: float
) -> Comparison:
    """Draws our share of a `Comparison`, whose attributes the arguments are."""
    size = config["image_size"]
    scene = Scene.from_mjmodel(mj_model, 0, size, size)

    def draw(poses: dict[str, jax.Array]) -> tuple[Any, Any, Any]:
        planes = render_planes(scene, SimpleNamespace(**poses), segmentation=True, quantized=True)
        return planes.rgb, planes.depth, planes.segmentation

    some = {name: jnp.asarray(rows[:COMPARED]) for name, rows in batches[0].items()}
    colours, depth, segmentation = (np.asarray(plane) for plane in env_jit(jax.vmap(draw))(some))
    textured = np.append(textured_geoms(mj_model), scene.sky == "texture")  # the sky is -1, the last
    return Comparison(
        config=config,
        mj_model=mj_model,
        scene=scene,
        batches=batches,
        repeats=repeats,
        rate=rate,
        colours=np.moveaxis(colours, 1, -1),
        depth=np.where(depth < float(scene.zfar), depth, np.inf),
        textured=textured[segmentation],
    )


def textured_geoms(mj_model: mujoco.MjModel) -> np.ndarray:
    """[ngeom] bool, which geoms have a texture."""
    if not mj_model.nmat:
        return np.zeros(mj_model.ngeom, bool)
    textures = mj_model.mat_texid[mj_model.geom_matid, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    return (mj_model.geom_matid >= 0) & (textures >= 0)


def depth_agreement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Share of pixels where two depths [N, H, W] in metres, inf for the sky, are within a centimetre or a hundredth.

    Silhouettes count too: two renderers that draw the same scene agree on most pixels, not on all.
    """
    sky = np.isinf(ours) & np.isinf(theirs)
    with np.errstate(invalid="ignore"):
        close = np.abs(ours - theirs) <= np.maximum(1e-2, 1e-2 * np.abs(theirs))
    return float(np.mean(sky | (close & np.isfinite(ours) & np.isfinite(theirs))))
