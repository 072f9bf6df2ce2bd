"""Appearance of a model as in MuJoCo's visualiser: colours, lights, and unsupported objects. NumPy only."""

import numbers
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np

from jaxrl_vis_envs.render.model.cameras import FREE_CAMERA, Camera, free_camera, free_camera_pose
from jaxrl_vis_envs.render.mounts import Mount

_SDF, _MESH, _BOX, _PLANE, _CAPSULE = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("SDF", "MESH", "BOX", "PLANE", "CAPSULE")
)

# A plane's half-size of 0 means infinite along that axis; this is far beyond any clipping distance.
INFINITE_SIZE = 1e10
# MuJoCo renders objects with a lower alpha as transparent.
OPAQUE = 0.995
# Values of `Scene.transparent`.
SOLID, CLEAR, CLEAR_FROM_BEHIND = range(3)
# OpenGL has eight lights; MuJoCo's renderer uses the headlight and then the model's in order.
MAX_LIGHTS = 8

LIGHTS = ("all", "mujoco")
"""Choices of lights: all except image lights, or only those that MuJoCo's renderer supports, which excludes point lights."""


def body_masses(mj_model: mujoco.MjModel, mounts: Iterable[Mount]) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return masses (kg) and parents of the bodies if any mount follows a centre of mass, else an empty array and tuple."""
    if all(mount.weighed_body < 0 for mount in mounts):
        return np.zeros(0), ()
    return mj_model.body_mass, tuple(mj_model.body_parentid.tolist())


def drawn_objects(
    mj_model: mujoco.MjModel,
    rgba: np.ndarray,
    groups: tuple[int, ...],
    site_groups: tuple[int, ...],
    tendon_groups: tuple[int, ...],
    leave_out: tuple[str, ...],
) -> np.ndarray:
    """Return the mask [ngeom + nsite + ntendon] of rendered objects: in a visible group, with alpha above 0, not left out."""
    geoms = np.isin(_clamped(mj_model.geom_group), groups)
    sites = np.isin(_clamped(mj_model.site_group), site_groups)
    left_out = [mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in leave_out]
    geoms[[index for index in left_out if index >= 0]] = False
    tendons = np.isin(_clamped(mj_model.tendon_group), tendon_groups)
    return np.concatenate([geoms, sites, tendons]) & (rgba[:, 3] > 0)


def _clamped(group: np.ndarray) -> np.ndarray:
    """Clamp group numbers to the valid range, as MuJoCo's visualiser does."""
    return np.clip(group, 0, mujoco.mjNGROUP - 1)


def check_model(mj_model: Any) -> None:
    """Raise a ValueError, with a hint for other model types, if ``mj_model`` is not a `mujoco.MjModel`."""
    if isinstance(mj_model, mujoco.MjModel):
        return
    hints = {
        "str": "; mujoco.MjModel.from_xml_path and from_xml_string read one",
        "MjSpec": "; its compile() makes one",
        "Model": "; mjx.put_model was given one",
    }
    kind = type(mj_model).__name__
    raise ValueError(f"a scene is read from a mujoco.MjModel, not from a {kind}{hints.get(kind, '')}")


def check_size(**lengths: int) -> None:
    """Raise a ValueError naming the first length that is not a positive integer."""
    for name, pixels in lengths.items():
        if not isinstance(pixels, numbers.Integral) or pixels < 1:
            raise ValueError(f"an image needs a whole number of pixels, at least 1, along each axis, not {name}={pixels!r}")


def group_numbers(name: str, groups: Any) -> tuple[int, ...]:
    """Return group numbers as a tuple, or raise a ValueError, since an invalid group would silently hide everything."""
    listed = list(groups) if isinstance(groups, Iterable) else [groups]
    if not all(isinstance(group, numbers.Integral) and not isinstance(group, bool) for group in listed):
        raise ValueError(f"{name} must be group numbers, such as (0, 1, 2), got {groups!r}")
    return tuple(map(int, listed))


def check_lights(lights: Any) -> None:
    """Raise a ValueError if ``lights`` is not one of `LIGHTS`."""
    if lights not in LIGHTS:
        raise ValueError(f"lights must be one of {', '.join(map(repr, LIGHTS))}, got {lights!r}")


def texture_numbers(mj_model: mujoco.MjModel, textures: Any) -> tuple[int, ...]:
    """Return the indices of textures by name or index, or raise a ValueError that lists those that objects can have."""
    known = {mj_model.texture(index).name: index for index in range(mj_model.ntex) if mj_model.tex_nchannel[index] in (3, 4)}
    listed = [textures] if isinstance(textures, str) else list(textures)
    numbers = [known.get(texture) if isinstance(texture, str) else texture for texture in listed]
    if not all(number in known.values() for number in numbers):
        names = ", ".join(repr(name) for name in known if name) or "none has a name"
        raise ValueError(f"textures must be among the model's: {names}; got {textures!r}")
    return tuple(int(number) for number in numbers)  # pyright: ignore[reportArgumentType]


def check_names(mj_model: mujoco.MjModel, leave_out: tuple[str, ...]) -> None:
    """Raise a ValueError listing the names in ``leave_out`` that are neither a geom's name nor "skin" nor "flex"."""
    if isinstance(leave_out, str) or not isinstance(leave_out, Iterable):
        raise ValueError(f"leave_out must be a tuple of names, such as ('skin',), got {leave_out!r}")
    geoms = [mj_model.geom(index).name for index in range(mj_model.ngeom)]
    unknown = [name for name in leave_out if name not in geoms and name not in ("skin", "flex")]
    if unknown:
        names = ", ".join(repr(name) for name in geoms if name) or "none has a name"
        raise ValueError(f"cannot leave out {', '.join(map(repr, unknown))}: the model's geoms are: {names}; or skin, flex")


def object_types(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the `mujoco.mjtGeom` [ngeom + nsite + ntendon] of objects as rendered.

    A signed distance field is rendered as MuJoCo's mesh of it, a tendon as capsules.
    """
    types = np.concatenate([mj_model.geom_type, mj_model.site_type, np.full(mj_model.ntendon, _CAPSULE)])
    return np.where(types == _SDF, _MESH, types)


def drawing_order(mj_model: mujoco.MjModel, types: np.ndarray, ids: np.ndarray, opaque: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the objects ``ids`` in the reverse of MuJoCo's drawing order. Of coincident objects, the one drawn last is
    visible.

    MuJoCo draws objects in the order of declaration, except that the first reflecting one precedes all others, even if
    reflections are disabled. This exception does not apply to segmentation.

    Args:
        mj_model: MuJoCo model.
        types: `object_types`.
        ids: Indices of the rendered objects, ascending.
        opaque: Mask of the opaque objects.

    Returns:
        The ordered indices, and True if they differ from the reversed order of declaration.
    """
    material = object_materials(mj_model)[ids]
    reflectance = np.append(mj_model.mat_reflectance, 0.0)[material]
    reflecting = np.flatnonzero(np.isin(types[ids], (_BOX, _PLANE)) & opaque & (reflectance > 0))
    first = reflecting[0] if len(reflecting) else 0
    order = np.concatenate([ids[first : first + 1], np.delete(ids, slice(first, first + 1))])
    return order[::-1], bool(first > 0)


def bounds(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the radii [ngeom + nsite + ntendon] (m) of the bounding spheres by which MuJoCo sorts transparent objects."""
    x, y, z = mj_model.site_size.reshape(-1, 3).T
    kinds = mj_model.site_type
    sites = np.sqrt(x * x + y * y + z * z)
    sites = np.where(kinds == mujoco.mjtGeom.mjGEOM_SPHERE, x, sites)
    sites = np.where(kinds == mujoco.mjtGeom.mjGEOM_CAPSULE, x + y, sites)
    sites = np.where(kinds == mujoco.mjtGeom.mjGEOM_CYLINDER, np.sqrt(x * x + y * y), sites)
    sites = np.where(kinds == mujoco.mjtGeom.mjGEOM_ELLIPSOID, np.maximum(np.maximum(x, y), z), sites)
    return np.concatenate([mj_model.geom_rbound, sites, mj_model.tendon_width])


def check_supported(mj_model: mujoco.MjModel, groups: tuple[int, ...], leave_out: tuple[str, ...]) -> None:
    """Raise a one-line ValueError that lists the visible skins, or else the visible flexes, which are not supported."""
    deformables = (
        ("skin", mj_model.skin_group, mujoco.mjtObj.mjOBJ_SKIN),
        ("flex", mj_model.flex_group, mujoco.mjtObj.mjOBJ_FLEX),
    )
    for kind, group, accessor in deformables:
        visible = np.flatnonzero(np.isin(_clamped(group), groups)).tolist() if kind not in leave_out else []
        if visible:
            names = ", ".join(f"{kind} {mujoco.mj_id2name(mj_model, accessor, i) or f'number {i}'}" for i in visible)
            raise ValueError(f"cannot render {names}: move it to a hidden group, or use leave_out=({kind!r},)")


def object_materials(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the material [N] of every geom, then of every site and every tendon; -1 for none."""
    return np.concatenate([mj_model.geom_matid, mj_model.site_matid, mj_model.tendon_matid])


def object_textures(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the colour texture [N] of every geom, site and tendon; -1 for none."""
    material = object_materials(mj_model)
    if not mj_model.nmat:
        return np.full(len(material), -1)
    return np.where(material >= 0, mj_model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB], -1)


def object_appearance(mj_model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return size, colour and material of every geom, site and tendon. Keys as in `Scene`."""
    widths = np.repeat(mj_model.tendon_width[:, None], 3, axis=1)
    size = np.concatenate([mj_model.geom_size, mj_model.site_size, widths]).reshape(-1, 3)
    rgba = np.concatenate([mj_model.geom_rgba, mj_model.site_rgba, mj_model.tendon_rgba]).reshape(-1, 4).astype(np.float64)
    material = object_materials(mj_model)
    count = len(size)
    # Defaults of MuJoCo's visualiser for an object without a material.
    emission, specular, shininess = np.zeros(count), np.full(count, 0.5), np.full(count, 0.5)
    repeat = np.ones((count, 2))
    for index in np.flatnonzero(material >= 0):
        number = material[index]
        emission[index] = mj_model.mat_emission[number]
        specular[index] = mj_model.mat_specular[number]
        shininess[index] = mj_model.mat_shininess[number]
        repeat[index] = mj_model.mat_texrepeat[number]
        # The default grey means "not set": use the material's colour.
        if np.array_equal(rgba[index], [0.5, 0.5, 0.5, 1.0]):
            rgba[index] = mj_model.mat_rgba[number]
    planes = object_types(mj_model) == _PLANE
    size = np.where(planes[:, None] & (size <= 0), INFINITE_SIZE, size)
    return dict(size=size, rgba=rgba, emission=emission, specular=specular, shininess=shininess, texture_repeat=repeat)


def texture_pixels(mj_model: mujoco.MjModel, texture: int) -> np.ndarray:
    """Return the texels [rows, columns, channels] in [0, 255] that MuJoCo's renderer interpolates.

    Flat textures that are flagged as sRGB are decoded to float64, as in MuJoCo; all others are returned unchanged, as uint8.
    """
    height, width = int(mj_model.tex_height[texture]), int(mj_model.tex_width[texture])
    channels = int(mj_model.tex_nchannel[texture])
    start = int(mj_model.tex_adr[texture])
    pixels = mj_model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
    flat = mj_model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D
    if flat and mj_model.tex_colorspace[texture] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
        pixels = pixels.astype(np.float64)
        share = pixels[..., :3] / 255.0  # alpha is linear
        pixels[..., :3] = 255.0 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return pixels


def mean_texture_colours(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the mean RGBA colour [N, 4] in [0, 1] of the texture of every geom, site and tendon; ones without a texture."""
    means = np.ones((mj_model.ntex + 1, 4))  # the last row is for objects without a texture
    for texture in range(mj_model.ntex):
        pixels = texture_pixels(mj_model, texture)
        colour = pixels.reshape(-1, pixels.shape[-1]).mean(0) / 255.0
        means[texture, : max(3, len(colour))] = colour if len(colour) >= 3 else colour[0]
    return means[object_textures(mj_model)]


def skybox(mj_model: mujoco.MjModel) -> int:
    """Return the index of the sky's texture, -1 if there is none."""
    skyboxes = np.flatnonzero(mj_model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    return int(skyboxes[0]) if len(skyboxes) else -1


def sky_colours(mj_model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the sky's colours at zenith and nadir, [3] each, in [0, 1]; black without a sky."""
    texture = skybox(mj_model)
    if texture < 0:
        return np.zeros(3), np.zeros(3)
    pixels = texture_pixels(mj_model, texture)
    # Six square faces stacked vertically, in OpenGL's order: right, left, up, down, front, back.
    edge = pixels.shape[1]
    middle = edge // 2
    faces = pixels.reshape(-1, edge, edge, pixels.shape[-1])
    up, down = (faces[2], faces[3]) if len(faces) == 6 else (faces[0], faces[0])
    return up[middle, middle, :3] / 255.0, down[middle, middle, :3] / 255.0


def planes_clear_from_behind(mj_model: mujoco.MjModel, camera_id: int, camera: Camera, plane_backs: bool | None) -> np.ndarray:
    """Return the mask [ngeom + nsite + ntendon] of planes transparent from behind, see `Scene.from_mjmodel`."""
    planes = mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    if plane_backs is None:
        mj_data = mujoco.MjData(mj_model)
        for step in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
            step(mj_model, mj_data)
        normals = mj_data.geom_xmat.reshape(-1, 3, 3)[:, :, 2]
        is_free = camera_id == FREE_CAMERA
        position = free_camera_pose(free_camera(mj_model, camera))[0] if is_free else mj_data.cam_xpos[camera_id]
        planes = planes & (np.sum((position - mj_data.geom_xpos) * normals, axis=1) < 0)
    elif not plane_backs:
        planes = np.zeros(mj_model.ngeom, bool)
    return np.concatenate([planes, np.zeros(mj_model.nsite + mj_model.ntendon, bool)])


def transparency(alpha: np.ndarray, clear_planes: np.ndarray) -> np.ndarray:
    """Classify objects [N]: CLEAR if alpha is below `OPAQUE`, else CLEAR_FROM_BEHIND for ``clear_planes``, else SOLID."""
    return np.where(alpha < OPAQUE, CLEAR, np.where(clear_planes, CLEAR_FROM_BEHIND, SOLID))


def haze_plane(mj_model: mujoco.MjModel, drawn: np.ndarray) -> tuple[int, float]:
    """Return the index of the first rendered infinite plane (-1 for none, or without a sky), and the width of the haze."""
    infinite = (mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & np.all(mj_model.geom_size[:, :2] == 0, axis=1)
    planes = np.flatnonzero(infinite & drawn[: mj_model.ngeom])
    if not len(planes) or skybox(mj_model) < 0:
        return -1, 0.0
    return int(planes[0]), float(mj_model.vis.map.haze)


def lights(
    mj_model: mujoco.MjModel, material_specular: np.ndarray, shadows: bool, points: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return arrays and static properties of the active lights. Keys as in `Scene`.

    Image lights, which MuJoCo's renderer does not support, are ignored; so are point lights unless ``points``. At most
    `MAX_LIGHTS` are used, the headlight first, then the model's in order.
    """
    head = mj_model.vis.headlight
    known = mj_model.light_type != mujoco.mjtLightType.mjLIGHT_IMAGE
    if not points:
        known &= mj_model.light_type != mujoco.mjtLightType.mjLIGHT_POINT
    active = np.flatnonzero(mj_model.light_active.astype(bool) & known)[: MAX_LIGHTS - bool(head.active)]
    modes = mj_model.light_mode[active][:, None]
    # A tracking light keeps its orientation and its offset from the initial pose; others are in their body's frame.
    track, track_com = mujoco.mjtCamLight.mjCAMLIGHT_TRACK, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    position = np.where(modes == track, mj_model.light_pos0[active], mj_model.light_pos[active])
    position = np.where(modes == track_com, mj_model.light_poscom0[active], position)
    direction = np.where((modes == track) | (modes == track_com), mj_model.light_dir0[active], mj_model.light_dir[active])
    leaves = dict(
        light_position=position,
        light_direction=direction,
        light_ambient=mj_model.light_ambient[active],
        light_diffuse=mj_model.light_diffuse[active],
        light_specular=mj_model.light_specular[active],
        light_attenuation=mj_model.light_attenuation[active],
        light_cutoff=mj_model.light_cutoff[active],
        light_exponent=mj_model.light_exponent[active],
        headlight_ambient=head.ambient,
        headlight_diffuse=head.diffuse,
        headlight_specular=head.specular,
    )
    shiny = bool(np.any(material_specular > 0))
    highlights = [shiny and bool(np.any(colour > 0)) for colour in (*mj_model.light_specular[active], head.specular)]
    facts = dict(
        light_types=tuple(mj_model.light_type[active].tolist()),
        light_mounts=tuple(
            Mount(int(mj_model.light_mode[i]), int(mj_model.light_bodyid[i]), int(mj_model.light_targetbodyid[i]))
            for i in active
        ),
        light_highlights=tuple(highlights),
        light_shadows=tuple((mj_model.light_castshadow[active].astype(bool) & shadows).tolist()),
    )
    return leaves, facts
