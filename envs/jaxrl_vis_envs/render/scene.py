"""What is drawn: everything that a picture needs besides the poses, read once from a MuJoCo model.

A `Scene` is a pytree. Sizes, colours, materials, lights and the field of view are leaves, so a batch of different looks is
``jax.vmap`` over ``scene.replace(rgba=...)``; what is drawn (geom types, ids, the picture's size) is static and fixes the
compiled program.

Arrays over objects are indexed as the segmentation is: object ``i`` is geom ``i`` of the model, and object ``ngeom + i`` is
site ``i``. Objects that are never seen keep their row, so that a row can be found without a table.
"""

import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

SUPPORTED_TYPES = (
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX,
)

# MuJoCo's half-size 0 of a plane means "without end" along that axis; this is far beyond any clip distance.
ENDLESS = 1e10


def _leaf() -> Any:
    return dataclasses.field()


def _static() -> Any:
    return dataclasses.field(metadata=dict(static=True))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """One camera's view of one model, without the poses. Make it with `Scene.from_mjmodel`.

    N is ngeom + nsite, L the number of active lights of the model (the headlight is apart), G the number of drawn objects.

    Attributes:
        size: [N, 3] float32, metres, as `mjModel.geom_size` means it for each type (endless planes: a very large half-size).
        rgba: [N, 4] float32 in [0, 1], the geom's own colour or its material's. Alpha only decides whether an object is drawn
            at all, when the scene is made.
        emission: [N] float32, the part of the colour that needs no light.
        specular: [N] float32 in [0, 1], strength of the highlight.
        shininess: [N] float32 in [0, 1]; the Phong exponent is 128 times this.
        fovy: [] float32, degrees, the vertical field of view.
        znear: [] float32, metres. What is nearer than this is cut away.
        zfar: [] float32, metres. What is further is not drawn, and it is the depth of the sky.
        light_position: [L, 3] float32, metres, in the light's frame (see `shade.light_poses`).
        light_direction: [L, 3] float32, unit, in the light's frame.
        light_ambient: [L, 3] float32.
        light_diffuse: [L, 3] float32.
        light_specular: [L, 3] float32.
        light_attenuation: [L, 3] float32: constant, linear (1/m) and quadratic (1/m^2). Only for lights with a position.
        light_cutoff: [L] float32, degrees, half-angle of the cone. Only for spot lights.
        light_exponent: [L] float32, how fast a spot light fades from its axis.
        headlight_ambient: [3] float32.
        headlight_diffuse: [3] float32.
        headlight_specular: [3] float32.
        sky_top: [3] float32 in [0, 1], colour of the sky straight up (world +z).
        sky_bottom: [3] float32 in [0, 1], colour straight down.
        object_ids: G indices of the drawn objects, grouped by type.
        object_types: G values of `mujoco.mjtGeom`.
        geom_count: ngeom of the model.
        camera_id: The camera's index in the model.
        height: H, pixels.
        width: W, pixels.
        light_types: L values of `mujoco.mjtLightType`.
        light_modes: L values of `mujoco.mjtCamLight`.
        light_bodies: L body indices.
        light_targets: L body indices, -1 for none.
        headlight: Whether the headlight is on.
    """

    size: jax.Array = _leaf()
    rgba: jax.Array = _leaf()
    emission: jax.Array = _leaf()
    specular: jax.Array = _leaf()
    shininess: jax.Array = _leaf()
    fovy: jax.Array = _leaf()
    znear: jax.Array = _leaf()
    zfar: jax.Array = _leaf()
    light_position: jax.Array = _leaf()
    light_direction: jax.Array = _leaf()
    light_ambient: jax.Array = _leaf()
    light_diffuse: jax.Array = _leaf()
    light_specular: jax.Array = _leaf()
    light_attenuation: jax.Array = _leaf()
    light_cutoff: jax.Array = _leaf()
    light_exponent: jax.Array = _leaf()
    headlight_ambient: jax.Array = _leaf()
    headlight_diffuse: jax.Array = _leaf()
    headlight_specular: jax.Array = _leaf()
    sky_top: jax.Array = _leaf()
    sky_bottom: jax.Array = _leaf()
    object_ids: tuple[int, ...] = _static()
    object_types: tuple[int, ...] = _static()
    geom_count: int = _static()
    camera_id: int = _static()
    height: int = _static()
    width: int = _static()
    light_types: tuple[int, ...] = _static()
    light_modes: tuple[int, ...] = _static()
    light_bodies: tuple[int, ...] = _static()
    light_targets: tuple[int, ...] = _static()
    headlight: bool = _static()

    @classmethod
    def from_mjmodel(
        cls,
        mj_model: mujoco.MjModel,
        camera: str | int,
        height: int = 64,
        width: int = 64,
        groups: tuple[int, ...] = (0, 1, 2),
        site_groups: tuple[int, ...] = (),
    ) -> Self:
        """Reads what is drawn from ``mj_model``.

        Args:
            mj_model: The model.
            camera: Name or index of the camera that looks.
            height: Picture height in pixels.
            width: Picture width in pixels.
            groups: Geom groups that are drawn (the default is that of `mujoco.Renderer`).
            site_groups: Site groups that are drawn. None by default, unlike `mujoco.Renderer`: a site is a marker for people.

        Returns:
            The scene. Objects with alpha 0 and objects of other groups are left out. Any other alpha counts as opaque, and a
            textured material is drawn in the mean colour of its texture.

        Raises:
            ValueError: The camera does not exist or is not a plain perspective one, the size is not positive, or something
                that would be seen has a type that this renderer cannot draw (meshes, height fields, signed distance fields).
        """
        camera_id = _find_camera(mj_model, camera)
        if height < 1 or width < 1:
            raise ValueError(f"a picture needs at least one pixel each way, not height={height}, width={width}")
        look = _object_looks(mj_model)
        types = np.concatenate([mj_model.geom_type, mj_model.site_type])
        drawn = np.concatenate([np.isin(mj_model.geom_group, groups), np.isin(mj_model.site_group, site_groups)])
        drawn &= look["rgba"][:, 3] > 0
        _refuse_unsupported(mj_model, types, drawn)
        # Grouped by type, so that the unrolled code of one type stays together.
        order = np.lexsort((np.arange(len(types)), types))
        ids = [int(index) for index in order if drawn[index]]
        leaves = {**look, **_light_parameters(mj_model)}
        leaves["sky_top"], leaves["sky_bottom"] = _sky_colours(mj_model)
        leaves["fovy"] = mj_model.cam_fovy[camera_id]
        leaves["znear"] = mj_model.vis.map.znear * mj_model.stat.extent
        leaves["zfar"] = mj_model.vis.map.zfar * mj_model.stat.extent
        active = np.flatnonzero(mj_model.light_active)
        return cls(
            **{name: jnp.asarray(value, jnp.float32) for name, value in leaves.items()},
            object_ids=tuple(ids),
            object_types=tuple(int(types[index]) for index in ids),
            geom_count=mj_model.ngeom,
            camera_id=camera_id,
            height=int(height),
            width=int(width),
            light_types=tuple(mj_model.light_type[active].tolist()),
            light_modes=tuple(mj_model.light_mode[active].tolist()),
            light_bodies=tuple(mj_model.light_bodyid[active].tolist()),
            light_targets=tuple(mj_model.light_targetbodyid[active].tolist()),
            headlight=bool(mj_model.vis.headlight.active),
        )

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)


def _find_camera(mj_model: mujoco.MjModel, camera: str | int) -> int:
    """The camera's index, or a ValueError that names the cameras there are."""
    if isinstance(camera, str):
        camera_id = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_CAMERA, camera)
    else:
        camera_id = int(camera)
    if not 0 <= camera_id < mj_model.ncam:
        names = ", ".join(repr(mj_model.camera(index).name) for index in range(mj_model.ncam)) or "none"
        raise ValueError(f"there is no camera {camera!r} in the model; its cameras are: {names}")
    if np.any(mj_model.cam_sensorsize[camera_id] > 0) or mj_model.cam_projection[camera_id] != 0:
        raise ValueError(
            f"camera {camera!r} has a sensor size or is orthographic; only perspective cameras with fovy are drawn"
        )
    return camera_id


def _refuse_unsupported(mj_model: mujoco.MjModel, types: np.ndarray, drawn: np.ndarray) -> None:
    refused = []
    for index in np.flatnonzero(drawn & ~np.isin(types, SUPPORTED_TYPES)):
        is_geom = index < mj_model.ngeom
        number = int(index if is_geom else index - mj_model.ngeom)
        name = (mj_model.geom(number) if is_geom else mj_model.site(number)).name or f"number {number}"
        kind = mujoco.mjtGeom(types[index]).name.removeprefix("mjGEOM_").lower()
        refused.append(f"{'geom' if is_geom else 'site'} {name} ({kind})")
    if refused:
        raise ValueError(f"cannot draw {', '.join(refused)}: use primitives, a group that is not drawn, or alpha 0")


def _object_looks(mj_model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Size, colour and material of every geom, then of every site. Keys as in `Scene`."""
    size = np.concatenate([mj_model.geom_size, mj_model.site_size]).reshape(-1, 3)
    rgba = np.concatenate([mj_model.geom_rgba, mj_model.site_rgba]).reshape(-1, 4).astype(np.float64)
    material = np.concatenate([mj_model.geom_matid, mj_model.site_matid])
    count = len(size)
    # What MuJoCo's visualiser gives to an object without a material.
    emission, specular, shininess = np.zeros(count), np.full(count, 0.5), np.full(count, 0.5)
    for index in np.flatnonzero(material >= 0):
        number = material[index]
        emission[index] = mj_model.mat_emission[number]
        specular[index] = mj_model.mat_specular[number]
        shininess[index] = mj_model.mat_shininess[number]
        # The default grey means "not set", and then the material's colour counts.
        if np.array_equal(rgba[index], [0.5, 0.5, 0.5, 1.0]):
            rgba[index] = mj_model.mat_rgba[number]
        rgba[index, :3] *= _mean_texture_colour(mj_model, mj_model.mat_texid[number, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    planes = np.concatenate([mj_model.geom_type, mj_model.site_type]) == mujoco.mjtGeom.mjGEOM_PLANE
    size = np.where(planes[:, None] & (size <= 0), ENDLESS, size)
    return dict(size=size, rgba=rgba, emission=emission, specular=specular, shininess=shininess)


def _texture_pixels(mj_model: mujoco.MjModel, texture: int) -> np.ndarray:
    """[rows, columns, channels] uint8."""
    height, width = int(mj_model.tex_height[texture]), int(mj_model.tex_width[texture])
    channels = int(mj_model.tex_nchannel[texture])
    start = int(mj_model.tex_adr[texture])
    return mj_model.tex_data[start : start + height * width * channels].reshape(height, width, channels)


def _mean_texture_colour(mj_model: mujoco.MjModel, texture: int) -> np.ndarray:
    """[3] in [0, 1]; ones where there is no texture."""
    if texture < 0:
        return np.ones(3)
    pixels = _texture_pixels(mj_model, texture)
    colour = pixels.reshape(-1, pixels.shape[-1]).mean(0) / 255.0
    return colour[:3] if len(colour) >= 3 else np.full(3, colour[0])


def _sky_colours(mj_model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Colours straight up and straight down of the first skybox texture, black without one. [3] each, in [0, 1]."""
    skyboxes = np.flatnonzero(mj_model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    if not len(skyboxes):
        return np.zeros(3), np.zeros(3)
    pixels = _texture_pixels(mj_model, int(skyboxes[0]))
    # Six square faces above each other, in OpenGL's order: right, left, up, down, front, back.
    edge = pixels.shape[1]
    middle = edge // 2
    faces = pixels.reshape(-1, edge, edge, pixels.shape[-1])
    up, down = (faces[2], faces[3]) if len(faces) == 6 else (faces[0], faces[0])
    return up[middle, middle, :3] / 255.0, down[middle, middle, :3] / 255.0


def _light_parameters(mj_model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Leaves of the active lights and of the headlight. Keys as in `Scene`."""
    active = np.flatnonzero(mj_model.light_active)
    modes = mj_model.light_mode[active][:, None]
    # A tracking light keeps its orientation and its offset of the initial pose; the others are given in their body's frame.
    track, track_com = mujoco.mjtCamLight.mjCAMLIGHT_TRACK, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    position = np.where(modes == track, mj_model.light_pos0[active], mj_model.light_pos[active])
    position = np.where(modes == track_com, mj_model.light_poscom0[active], position)
    direction = np.where((modes == track) | (modes == track_com), mj_model.light_dir0[active], mj_model.light_dir[active])
    head = mj_model.vis.headlight
    return dict(
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
