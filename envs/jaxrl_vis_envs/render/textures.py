"""Textures as MuJoCo's renderer samples them: bilinear within a resolution and linear between two (OpenGL's trilinear filter).

All images at all resolutions are in one array.

A row of the array holds a texel and its neighbours to the right, below, and both, each as red + 256 green + 65536 blue: one
lookup gives all that a bilinear mean needs.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.render import model_reading

NONE, FLAT, CUBE, UNWRAPPED = range(4)
"""How a texture lies on an object: not at all, projected along z, from a cube around it, or by a mesh's own coordinates."""


class Image(NamedTuple):
    """One texture in the atlas: its first level, how many levels there are, and its faces (1, or 6 of a cube)."""

    first_level: int
    levels: int
    faces: int


class Atlas(NamedTuple):
    """Where each texture is. Hashable, for it is a static part of the scene.

    Attributes:
        levels: First row in the texels, width and height (of one face) of every image at every resolution.
        mappings: For each of the G drawn objects, how its texture lies on it.
        images: For each of the G drawn objects, its texture; None for none.
        uniform: For each of the G drawn objects, whether the texture repeats per metre and not per object.
        sky: The texture of the sky, None for a plain one.
    """

    levels: tuple[tuple[int, int, int], ...]
    mappings: tuple[int, ...]
    images: tuple[Image | None, ...]
    uniform: tuple[bool, ...]
    sky: Image | None

    @property
    def used(self) -> bool:
        """Whether any object has a texture."""
        return any(mapping != NONE for mapping in self.mappings)


def build_atlas(mj_model: mujoco.MjModel, ids: np.ndarray, textured: bool) -> tuple[Atlas, np.ndarray, str]:
    """Gathers the textures of the objects ``ids`` and of the sky.

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

    material = model_reading.object_materials(mj_model)[ids]
    texture = model_reading.object_textures(mj_model)[ids]
    mappings = [_mapping(mj_model, int(i), int(t)) if textured else NONE for i, t in zip(ids, texture, strict=True)]
    placed = tuple(place(int(t)) if how != NONE else None for how, t in zip(mappings, texture, strict=True))
    uniform = tuple(bool(how != NONE and mj_model.mat_texuniform[m]) for how, m in zip(mappings, material, strict=True))
    skybox = model_reading.skybox(mj_model)
    sky = None
    if textured and skybox >= 0 and not _is_plain_sky(mj_model, skybox):
        sky = place(skybox)
    texels = np.concatenate(parts) if parts else np.zeros((1, 4), np.uint32)
    atlas = Atlas(tuple(levels), tuple(mappings), placed, uniform, sky)
    return atlas, texels, "texture" if sky is not None else "plain"


def _mapping(mj_model: mujoco.MjModel, index: int, texture: int) -> int:
    """How ``texture`` lies on object ``index``."""
    if texture < 0 or mj_model.tex_nchannel[texture] not in (3, 4):
        return NONE
    flat = mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D
    if index < mj_model.ngeom and mj_model.geom_type[index] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = mj_model.geom_dataid[index]
        if mj_model.mesh_texcoordadr[mesh] >= 0:
            return UNWRAPPED if flat else NONE  # a cube has no use for a mesh's own coordinates, and MuJoCo shows none
    return FLAT if flat else CUBE


def _faces(mj_model: mujoco.MjModel, texture: int) -> np.ndarray:
    """[faces, height, width, 3] float64 in [0, 255]."""
    pixels = model_reading.texture_pixels(mj_model, texture)[..., :3].astype(np.float64)
    if mj_model.tex_colorspace[texture] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
        share = pixels / 255.0
        pixels = 255.0 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    if mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D:
        return pixels[None]
    edge = pixels.shape[1]
    return pixels.reshape(-1, edge, edge, 3)


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
    bytes_ = np.floor(faces + 0.5).astype(np.uint32)
    packed = bytes_[..., 0] + (bytes_[..., 1] << 8) + (bytes_[..., 2] << 16)

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
    faces = _faces(mj_model, texture)
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
    top, bottom = model_reading.sky_colours(mj_model)
    return bool(np.abs(255.0 * (bottom * (1.0 - share) + top * share) - faces).max() <= 4.0)


def sample(
    texels: jax.Array,
    levels: tuple[tuple[int, int, int], ...],
    first_level: jax.Array | int,
    level_count: jax.Array | int,
    face: jax.Array | int,
    place: tuple[jax.Array, jax.Array],
    spread_square: jax.Array,
    repeats: jax.Array | bool,
) -> tuple[jax.Array, ...]:
    """Colours of textures at many places.

    Args:
        texels: [T, 4] uint32, or in a kernel a block of memory that is looked up like it and brings the table of levels along.
        levels: As in `Atlas`.
        first_level: [P] int32 or a number: which texture.
        level_count: [P] int32 or a number.
        face: [P] int32 or a number: which face of a cube.
        place: Coordinates across and down, [P] float32 each; 0 to 1 is the whole image.
        spread_square: [P] float32, the square of how many texels (of the finest level) a pixel spans.
        repeats: [P] bool or a bool: whether the image goes on beyond its border, or its border does.

    Returns:
        Red, green and blue, [P] float32 each, in [0, 1].
    """
    level = jnp.clip(0.5 * jnp.log2(jnp.maximum(spread_square, 1e-12)), 0.0, level_count - 1.0)
    fine = jnp.floor(level)
    weight = level - fine
    fine = fine.astype(jnp.int32)
    coarse = jnp.minimum(fine + 1, level_count - 1)
    table = jnp.asarray(levels, jnp.int32) if isinstance(texels, jax.Array) else texels.levels
    near = _bilinear(texels, table, first_level + fine, face, place, repeats)
    far = _bilinear(texels, table, first_level + coarse, face, place, repeats)
    return tuple(a + weight * (b - a) for a, b in zip(near, far, strict=True))


def _bilinear(texels: jax.Array, table: jax.Array, level: jax.Array, face: jax.Array | int, place: tuple, repeats) -> tuple:
    facts = table.at[jnp.clip(level, 0, len(table) - 1)].get(mode="promise_in_bounds")
    first, shape = facts[..., 0], (facts[..., 1], facts[..., 2])
    lows, shares = [], []
    for axis in range(2):
        count = shape[axis].astype(jnp.float32)
        at = place[axis] * count - 0.5
        at = jnp.where(repeats, at, jnp.clip(at, 0.0, count - 1.0))
        low = jnp.floor(at)
        shares.append(at - low)
        lows.append((low - count * jnp.floor(low / count)).astype(jnp.int32))
    index = first + (face * shape[1] + lows[1]) * shape[0] + lows[0]
    # Clipped also against what is not a number.
    quad = texels.at[jnp.clip(index, 0, len(texels) - 1)].get(mode="promise_in_bounds")
    corners = tuple(quad[..., corner] for corner in range(4))
    return (_mixed if isinstance(texels, jax.Array) else _mix)(corners, *shares)


def _mix(corners: tuple, right: jax.Array, below: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Red, green and blue between four texels, with weights of 1/256 as graphics hardware has them.

    So two channels fit into one product of integers.
    """
    right, below = ((256.0 * share + 0.5).astype(jnp.int32) for share in (right, below))
    both = (right * below + 128) >> 8
    weights = (256 - right - below + both, right - both, below - both, both)
    red_blue, green = jnp.uint32(0), jnp.uint32(0)
    for texel, weight in zip(corners, weights, strict=True):
        weight = weight.astype(jnp.uint32)
        red_blue += (texel & 0xFF00FF) * weight
        green += ((texel >> 8) & 0xFF) * weight
    red, green, blue = (
        part.astype(jnp.int32).astype(jnp.float32) * (1.0 / (255.0 * 256.0))
        for part in (red_blue & 0xFFFF, green, red_blue >> 16)
    )
    return red, green, blue


_mixed = jax.custom_jvp(_mix)


@_mixed.defjvp
def _mix_tangents(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """Integers have no slope; that of the mean that they stand for."""
    corners, right, below = primals
    _, right_move, below_move = tangents
    moves = []
    for channel in range(3):
        one, two, three, four = (((c >> (8 * channel)) & 255).astype(jnp.int32).astype(jnp.float32) / 255.0 for c in corners)
        to_right = (two - one) * (1.0 - below) + (four - three) * below
        to_below = (three - one) * (1.0 - right) + (four - two) * right
        moves.append(to_right * right_move + to_below * below_move)
    return _mix(corners, right, below), tuple(moves)


def cube_place(direction: tuple) -> tuple[jax.Array, tuple[jax.Array, jax.Array], tuple]:
    """Where a direction meets a cube map, as OpenGL has it.

    Args:
        direction: Three [P] float32, of any length.

    Returns:
        The face [P] int32, the coordinates on it (across and down, [P] each), and what `cube_move` needs.
    """
    x, y, z = direction
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    along_x = (ax >= ay) & (ax >= az)
    along_y = ~along_x & (ay >= az)
    major = jnp.where(along_x, x, jnp.where(along_y, y, z))
    negative = major < 0.0
    face = jnp.where(along_x, 0, jnp.where(along_y, 2, 4)) + negative
    sign = jnp.where(negative, -1.0, 1.0)
    across = jnp.where(along_x, -sign * z, jnp.where(along_y, x, sign * x))
    down = jnp.where(along_y, sign * z, -y)
    inverse = 0.5 / jnp.maximum(jnp.abs(major), 1e-20)
    place = (across * inverse + 0.5, down * inverse + 0.5)
    return face, place, (along_x, along_y, sign, inverse)


def cube_move(choice: tuple, place: tuple, change: tuple) -> tuple[jax.Array, jax.Array]:
    """How the place on a cube's face moves (across and down, [P] each) when the direction moves by ``change``."""
    along_x, along_y, sign, inverse = choice
    x, y, z = change
    major = sign * jnp.where(along_x, x, jnp.where(along_y, y, z))
    across = jnp.where(along_x, -sign * z, jnp.where(along_y, x, sign * x))
    down = jnp.where(along_y, sign * z, -y)
    return (across - (2.0 * place[0] - 1.0) * major) * inverse, (down - (2.0 * place[1] - 1.0) * major) * inverse
