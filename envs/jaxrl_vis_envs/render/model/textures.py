"""Textures as MuJoCo's renderer samples them: bilinear within a resolution and linear between two (OpenGL's trilinear filter).

All images at all resolutions are in one array.

A row of the array holds a texel and its neighbours to the right, below, and both, each as red + 256 green + 65536 blue, with
alpha in the bits above these where the image has any: one lookup gives all that a bilinear mean needs.
"""

from typing import NamedTuple

import mujoco
import numpy as np

from jaxrl_vis_envs.render.model import reading

NONE, FLAT, CUBE, UNWRAPPED = range(4)
"""How a texture lies on an object: not at all, projected along z, from a cube around it, or by a mesh's own coordinates."""


class Image(NamedTuple):
    """One texture in the atlas: its first level, how many levels there are, and its faces (1, or 6 of a cube)."""

    first_level: int
    levels: int
    faces: int


class Atlas(NamedTuple):
    """Places of all textures. Hashable, for it is a static part of the scene.

    Attributes:
        levels: First row in the texels, width and height (of one face) of every image at every resolution.
        mappings: For each of the G drawn objects, how its texture lies on it.
        images: For each of the G drawn objects, its texture; None for none.
        uniform: For each of the G drawn objects, whether the texture repeats per metre and not per object.
        alpha: For each of the G drawn objects, whether its texture has alpha, which counts on what is transparent.
        sky: The texture of the sky, None for a plain one.
    """

    levels: tuple[tuple[int, int, int], ...]
    mappings: tuple[int, ...]
    images: tuple[Image | None, ...]
    uniform: tuple[bool, ...]
    alpha: tuple[bool, ...]
    sky: Image | None

    @property
    def used(self) -> bool:
        """Whether any object has a texture."""
        return any(mapping != NONE for mapping in self.mappings)


def build_atlas(mj_model: mujoco.MjModel, ids: np.ndarray, types: np.ndarray, textured: bool) -> tuple[Atlas, np.ndarray, str]:
    """Gathers the textures of the objects ``ids``, drawn as these types, and of the sky.

    Returns:
        The atlas, the texels [T, 4] uint32 (T at least 1), and "plain" or "texture" for the sky.
    """
    levels: list[tuple[int, int, int]] = []
    parts: list[np.ndarray] = []
    images: dict[int, Image] = {}

    def place(texture: int) -> Image:
        if texture not in images:
            pyramid = _pyramid(_faces(mj_model, texture), mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D)
            images[texture] = Image(len(levels), len(pyramid), len(pyramid[0][0]))
            for quads, (width, height) in pyramid:
                levels.append((sum(map(len, parts)), width, height))
                parts.append(quads.reshape(-1, 4))
        return images[texture]

    material = reading.object_materials(mj_model)[ids]
    texture = reading.object_textures(mj_model)[ids]
    facts = zip(ids.tolist(), types.tolist(), texture.tolist(), strict=True)
    mappings = [_mapping(mj_model, *fact) if textured else NONE for fact in facts]
    placed = tuple(place(int(t)) if how != NONE else None for how, t in zip(mappings, texture, strict=True))
    uniform = tuple(bool(how != NONE and mj_model.mat_texuniform[m]) for how, m in zip(mappings, material, strict=True))
    alpha = tuple(bool(how != NONE and mj_model.tex_nchannel[t] == 4) for how, t in zip(mappings, texture, strict=True))
    skybox = reading.skybox(mj_model)
    sky = None
    if textured and skybox >= 0 and not _is_plain_sky(mj_model, skybox):
        sky = place(skybox)
    texels = np.concatenate(parts) if parts else np.zeros((1, 4), np.uint32)
    atlas = Atlas(tuple(levels), tuple(mappings), placed, uniform, alpha, sky)
    return atlas, texels, "texture" if sky is not None else "plain"


def _mapping(mj_model: mujoco.MjModel, index: int, kind: int, texture: int) -> int:
    """Mapping of ``texture`` onto object ``index``, drawn as ``kind``."""
    if texture < 0 or mj_model.tex_nchannel[texture] not in (3, 4):
        return NONE
    flat = mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = mj_model.geom_dataid[index]
        if mj_model.mesh_texcoordadr[mesh] >= 0:
            return UNWRAPPED if flat else NONE  # a cube has no use for a mesh's own coordinates, and MuJoCo shows none
    return FLAT if flat else CUBE


def _faces(mj_model: mujoco.MjModel, texture: int) -> np.ndarray:
    """[faces, height, width, 3 or 4] uint8 or float64, in [0, 255]."""
    pixels = reading.texture_pixels(mj_model, texture)
    if mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D:
        return pixels[None]
    edge = pixels.shape[1]
    return pixels.reshape(-1, edge, edge, pixels.shape[-1])


def _pyramid(faces: np.ndarray, repeats: bool) -> list[tuple[np.ndarray, tuple[int, int]]]:
    """The image at all resolutions down to one texel: quads [faces, height, width, 4] uint32, and (width, height)."""
    found = []
    while True:
        height, width = faces.shape[1:3]
        found.append((_quads(faces, repeats), (width, height)))
        if height == width == 1:
            return found
        faces = _halved(_halved(faces, 1), 2)


def _halved(faces: np.ndarray, axis: int) -> np.ndarray:
    """Half as many texels along ``axis``, read between the old ones."""
    count = faces.shape[axis]
    if count == 1:
        return faces
    half = count // 2
    place = np.clip((np.arange(half) + 0.5) * (count / half) - 0.5, 0, count - 1)
    left = np.floor(place).astype(int)
    right = np.minimum(left + 1, count - 1)
    weight = (place - left).reshape([-1 if index == axis else 1 for index in range(4)])
    return faces.take(left, axis) * (1.0 - weight) + faces.take(right, axis) * weight


def _quads(faces: np.ndarray, repeats: bool) -> np.ndarray:
    """Each texel with its neighbours, as described at the top. At the border the first ones again, or the last ones."""
    # Half added and the rest cut off: the nearest byte. The faces of skies are large, and signed numbers are converted faster.
    red, green, blue = ((faces[..., index] + 0.5).astype(np.int32) for index in range(3))
    packed = (red + (green << 8) + (blue << 16)).astype(np.uint32)
    if faces.shape[-1] == 4:
        packed += (faces[..., 3] + 0.5).astype(np.uint32) << 24

    def neighbour(values: np.ndarray, axis: int) -> np.ndarray:
        shifted = np.roll(values, -1, axis)
        if not repeats:
            last = [slice(None)] * 3
            last[axis] = slice(-1, None)
            shifted[tuple(last)] = values[tuple(last)]
        return shifted

    right, below = neighbour(packed, 2), neighbour(packed, 1)
    return np.stack([packed, right, below, neighbour(right, 1)], axis=-1)


def _is_plain_sky(mj_model: mujoco.MjModel, texture: int) -> bool:
    """Whether the sky is nothing but MuJoCo's gradient between two colours (also where both are the same)."""
    faces = _faces(mj_model, texture)[..., :3]
    if len(faces) != 6:
        return False
    edge = faces.shape[1]
    place = (2.0 * np.arange(edge) + 1.0) / edge - 1.0
    # A few texels tell most other skies; only what may be plain is looked at whole.
    few, all_ = slice(None, None, max(1, edge // 16)), slice(None)
    return all(_is_gradient(mj_model, faces[:, some, some], place[some]) for some in (few, all_))


def _is_gradient(mj_model: mujoco.MjModel, faces: np.ndarray, place: np.ndarray) -> bool:
    """Whether texels [6, N, N, 3] at ``place`` [N] (-1 to 1) across and down the faces of a cube are those of MuJoCo's sky."""
    across, down = np.meshgrid(place, place)
    one = np.ones_like(across)
    # Height of each texel's direction on the faces right, left, up, down, front, back.
    heights = np.stack([-down, -down, one, -one, -down, -down])
    sine = heights / np.sqrt(1.0 + across**2 + down**2)
    elevation = np.arcsin(sine) * 2.0 / np.pi
    share = (0.5 + elevation / np.sqrt(2.0 * (1.0 + elevation**2)))[..., None]
    top, bottom = reading.sky_colours(mj_model)
    return bool(np.abs(255.0 * (bottom * (1.0 - share) + top * share) - faces).max() <= 4.0)
