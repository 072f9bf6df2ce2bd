"""Texture atlas for sampling as in MuJoCo's renderer: bilinear within a mipmap level, linear between two (OpenGL's trilinear
filter).

All images at all levels are in one array.

A row of the array holds a texel and its neighbours to the right, below, and diagonally below, each packed as red + 256 green +
65536 blue, with alpha in the upper bits if the image has it: one lookup provides everything for bilinear interpolation.
"""

from typing import NamedTuple

import mujoco
import numpy as np

from jaxrl_vis_envs.render.model import reading

NONE, FLAT, CUBE, UNWRAPPED = range(4)
"""Mappings of a texture onto an object: none, projected along z, from a surrounding cube, or by the mesh's own coordinates."""


class Image(NamedTuple):
    """Texture in the atlas: index of its first level, number of levels, and number of faces (6 for a cube map, else 1)."""

    first_level: int
    levels: int
    faces: int


class Atlas(NamedTuple):
    """Layout of all textures. Hashable, because it is a static part of the scene.

    Attributes:
        levels: First row in the texels, width and height (of one face) of every image at every level.
        mappings: Texture mapping of each of the G rendered objects.
        images: Image that each of the G rendered objects has in the model; None without a texture.
        loaded: Image of each texture of the model; None for those that are not in the atlas.
        uniform: G flags, True for objects whose texture repeats per metre instead of per object.
        alpha: G flags, True for objects whose texture has alpha, which matters if they are transparent.
        sky: Image of the sky, None for a plain sky.
    """

    levels: tuple[tuple[int, int, int], ...]
    mappings: tuple[int, ...]
    images: tuple[Image | None, ...]
    loaded: tuple[Image | None, ...]
    uniform: tuple[bool, ...]
    alpha: tuple[bool, ...]
    sky: Image | None

    @property
    def has_textures(self) -> bool:
        """True if any object has a texture."""
        return any(mapping != NONE for mapping in self.mappings)


def build_atlas(
    mj_model: mujoco.MjModel, ids: np.ndarray, types: np.ndarray, textured: bool, further: tuple[int, ...] = ()
) -> tuple[Atlas, np.ndarray, str]:
    """Collect the textures of the rendered objects and of the sky, and further ones.

    Args:
        mj_model: MuJoCo model.
        ids: Indices of the rendered objects.
        types: Their types, as rendered.
        textured: False to collect no textures.
        further: Indices of further textures to load; ignored if no object has a texture.

    Returns:
        The atlas, the texels [T, 4] uint32 (T at least 1), and "plain" or "texture" for the sky.
    """
    levels: list[tuple[int, int, int]] = []
    parts: list[np.ndarray] = []
    images: dict[int, Image] = {}

    def add(texture: int) -> Image:
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
    images_by_object = tuple(add(int(t)) if mapping != NONE else None for mapping, t in zip(mappings, texture, strict=True))
    uniform = tuple(bool(mapping != NONE and mj_model.mat_texuniform[m]) for mapping, m in zip(mappings, material, strict=True))
    alpha = tuple(bool(mapping != NONE and mj_model.tex_nchannel[t] == 4) for mapping, t in zip(mappings, texture, strict=True))
    skybox = reading.skybox(mj_model)
    sky = None
    if textured and skybox >= 0 and not _is_plain_sky(mj_model, skybox):
        sky = add(skybox)
    for number in further if any(mappings) else ():
        add(number)
    texels = np.concatenate(parts) if parts else np.zeros((1, 4), np.uint32)
    loaded = tuple(images.get(number) for number in range(mj_model.ntex))
    atlas = Atlas(tuple(levels), tuple(mappings), images_by_object, loaded, uniform, alpha, sky)
    return atlas, texels, "texture" if sky is not None else "plain"


def _mapping(mj_model: mujoco.MjModel, index: int, kind: int, texture: int) -> int:
    """Return the mapping of ``texture`` onto object ``index``, rendered with type ``kind``."""
    if texture < 0 or mj_model.tex_nchannel[texture] not in (3, 4):
        return NONE
    flat = mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = mj_model.geom_dataid[index]
        if mj_model.mesh_texcoordadr[mesh] >= 0:
            return UNWRAPPED if flat else NONE  # a cube map ignores a mesh's own coordinates, and MuJoCo renders none
    return FLAT if flat else CUBE


def _faces(mj_model: mujoco.MjModel, texture: int) -> np.ndarray:
    """Return the texels [faces, height, width, 3 or 4] of a texture, uint8 or float64, in [0, 255]."""
    pixels = reading.texture_pixels(mj_model, texture)
    if mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D:
        return pixels[None]
    edge = pixels.shape[1]
    return pixels.reshape(-1, edge, edge, pixels.shape[-1])


def _pyramid(faces: np.ndarray, repeats: bool) -> list[tuple[np.ndarray, tuple[int, int]]]:
    """Return all mipmap levels down to one texel: quads [faces, height, width, 4] uint32, and (width, height)."""
    levels = []
    while True:
        height, width = faces.shape[1:3]
        levels.append((_quads(faces, repeats), (width, height)))
        if height == width == 1:
            return levels
        faces = _halved(_halved(faces, 1), 2)


def _halved(faces: np.ndarray, axis: int) -> np.ndarray:
    """Halve the number of texels along ``axis``, by linear interpolation."""
    count = faces.shape[axis]
    if count == 1:
        return faces
    half = count // 2
    position = np.clip((np.arange(half) + 0.5) * (count / half) - 0.5, 0, count - 1)
    left = np.floor(position).astype(int)
    right = np.minimum(left + 1, count - 1)
    weight = (position - left).reshape([-1 if index == axis else 1 for index in range(4)])
    return faces.take(left, axis) * (1.0 - weight) + faces.take(right, axis) * weight


def _quads(faces: np.ndarray, repeats: bool) -> np.ndarray:
    """Pack each texel with its neighbours (see the module docstring). Beyond the border, the image repeats or is clamped."""
    # Rounded by adding half and truncating. Signed integers, because they convert faster and skies have large faces.
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
    """Return True if the sky is MuJoCo's gradient between two colours, which may be equal."""
    faces = _faces(mj_model, texture)[..., :3]
    if len(faces) != 6:
        return False
    edge = faces.shape[1]
    position = (2.0 * np.arange(edge) + 1.0) / edge - 1.0
    # Compare a few texels first, which rule out most other skies, then all.
    sparse, all_ = slice(None, None, max(1, edge // 16)), slice(None)
    return all(_is_gradient(mj_model, faces[:, part, part], position[part]) for part in (sparse, all_))


def _is_gradient(mj_model: mujoco.MjModel, faces: np.ndarray, position: np.ndarray) -> bool:
    """Return True if texels [6, N, N, 3] at ``position`` [N] (-1 to 1) along both axes of a cube's faces match the gradient."""
    across, down = np.meshgrid(position, position)
    one = np.ones_like(across)
    # z of each texel's direction on the faces right, left, up, down, front, back.
    heights = np.stack([-down, -down, one, -one, -down, -down])
    sine = heights / np.sqrt(1.0 + across**2 + down**2)
    elevation = np.arcsin(sine) * 2.0 / np.pi
    share = (0.5 + elevation / np.sqrt(2.0 * (1.0 + elevation**2)))[..., None]
    top, bottom = reading.sky_colours(mj_model)
    return bool(np.abs(255.0 * (bottom * (1.0 - share) + top * share) - faces).max() <= 4.0)
