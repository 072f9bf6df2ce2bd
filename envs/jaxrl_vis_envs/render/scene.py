"""Scene: all inputs of an image except the poses, read once from a MuJoCo model.

A `Scene` is a pytree. Sizes, colours, materials, lights and camera parameters are leaves, so a batch of appearances is a
``jax.vmap`` over ``scene.replace(rgba=...)``; geom types, ids and the image size are static and determine the compiled program.

Arrays over objects are indexed like the segmentation: object ``i`` is geom ``i`` of the model, object ``ngeom + i`` is site
``i``, and object ``ngeom + nsite + i`` is tendon ``i``. Objects that are never visible keep their row, so that indexing needs
no lookup table. A tendon is rendered as several capsules.
"""

import dataclasses
from typing import Any, Self

import jax
import mujoco
import numpy as np

from jaxrl_vis_envs.render import mounts, viewpoint
from jaxrl_vis_envs.render.model import cameras, meshes, reading, tendons
from jaxrl_vis_envs.render.model import textures as atlases
from jaxrl_vis_envs.render.model.hierarchies import Hierarchies, build_hierarchies


def _leaf() -> Any:
    return dataclasses.field()


def _static() -> Any:
    return dataclasses.field(metadata=dict(static=True))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """One camera's view of one model, without the poses. Construct it with `Scene.from_mjmodel`.

    N is ngeom + nsite + ntendon, L the number of active lights (without the headlight), G the number of rendered objects, of
    which each capsule of a tendon is one.

    Attributes:
        size: [N, 3] float32, metres, as in `mjModel.geom_size` for each type (infinite planes: a very large half-size; tendons:
            their width in all three columns).
        bound: [N] float32, metres, radius of each object's bounding sphere, for sorting transparent objects.
        rgba: [N, 4] float32 in [0, 1], colour of the geom or its material. Alpha is used only for the objects marked in
            ``transparent``, which is fixed when the scene is constructed.
        emission: [N] float32, emitted fraction of the colour, independent of lights.
        specular: [N] float32 in [0, 1], specular reflectance.
        shininess: [N] float32 in [0, 1]; the Phong exponent is 128 times this.
        texture_repeat: [N, 2] float32, repetitions of the texture per object (per metre if ``atlas.uniform``).
        texture: [N] int32, the texture's index in the model, -1 for none. Objects with a texture in the model can have any that
            is loaded (see `from_mjmodel`), of the same type and number of channels.
        fovy: [] float32, vertical field of view: degrees, or metres for an orthographic camera.
        focal: [2] float32, focal lengths, metres, for a camera with a sensor size.
        principal: [2] float32, principal point relative to the sensor's centre, metres, for a camera with a sensor size.
        sensor: [2] float32, width and height of the sensor, metres.
        camera_position: [3] float32, metres, in the frame of the body that the camera is fixed to, or along the world's axes
            relative to the body that it tracks.
        camera_axes: [3, 3] float32 whose columns are the camera's axes (right, up, back), in the body's frame, or in the
            world's if it tracks a body. Unused for a camera that aims at a body.
        camera_shift: [3] float32, translation in the camera's own frame (right, up, back), metres, applied to its pose. For a
            free camera, its position in the world.
        camera_turn: [3] float32, rotation vector in the camera's own frame, radians, applied to its pose. For a free camera,
            its rotation in the world.
        body_mass: [nbody] float32, kg, if the camera or a light follows a centre of mass, else [0].
        znear: [] float32, depth of the near clipping plane, metres.
        zfar: [] float32, depth of the far clipping plane and of the sky, metres.
        light_position: [L, 3] float32, metres, in the frame of the body that the light is fixed to, or along the world's axes
            relative to the body that it tracks.
        light_direction: [L, 3] float32, unit vectors in the same frame. Unused for a light that aims at a body.
        light_ambient: [L, 3] float32.
        light_diffuse: [L, 3] float32.
        light_specular: [L, 3] float32.
        light_attenuation: [L, 3] float32: constant, linear (1/m) and quadratic (1/m^2). Unused for directional lights.
        light_cutoff: [L] float32, half-angle of a spot light's cone, degrees.
        light_exponent: [L] float32, exponent of a spot light's falloff from its axis.
        headlight_ambient: [3] float32.
        headlight_diffuse: [3] float32.
        headlight_specular: [3] float32.
        sky_top: [3] float32 in [0, 1], colour of a plain sky at the zenith (world +z).
        sky_bottom: [3] float32 in [0, 1], colour of a plain sky at the nadir.
        haze_colour: [3] float32 in [0, 1].
        cords: [ntendon, 15] float32, lengths, limits and gravity of tendons, see `model.tendons`.
        texels: [T, 4] uint32, all textures at all mipmap levels, see `textures.Atlas`.
        triangles: [R, 36] float32, triangles of all meshes and height fields, see `meshes.build_triangles`.
        clusters: [K, 8] float32, bounding spheres (metres) and cones of normals of the rendered triangle clusters, see
            `meshes.build_triangles`.
        cluster_places: [K, 2] int32: index of the cluster's object among the G, and first row of its triangles.
        hierarchies: Hierarchies over the triangles, see `hierarchies.Hierarchies`; None in a scene without triangles.
        object_ids: G indices of the rendered objects (a tendon's once for each of its capsules), in the reverse of MuJoCo's
            drawing order: of two objects at the same depth, MuJoCo shows the one drawn later, this renderer the one listed
            first. That is descending order, with the reflecting object, if any, at the end.
        object_types: G values of `mujoco.mjtGeom`.
        transparent: G flags: 0 opaque, 1 transparent, 2 a plane that is transparent from behind.
        reordered: True if a reflecting object is drawn before objects declared before it. MuJoCo's segmentation keeps the order
            of declaration.
        geom_count: ngeom of the model.
        tendon_paths: Paths of the tendons.
        camera_id: Index of the camera in the model; `cameras.FREE_CAMERA` for a free one.
        camera_mount: Attachment of the camera.
        body_parents: nbody indices of parent bodies if ``body_mass`` is used, else empty.
        projection: "perspective", "intrinsic" (a perspective camera with a sensor) or "orthographic".
        height: H, pixels.
        width: W, pixels.
        light_types: L values of `mujoco.mjtLightType`.
        light_mounts: L attachments of the lights.
        light_highlights: L + 1 booleans, the last for the headlight: True if the light can cause specular highlights. A light
            without a specular colour in the model cannot, and costs less.
        light_shadows: L booleans, True if the light casts shadows (none does unless shadows are requested).
        headlight: True if the headlight is on.
        sky: "plain" (a gradient between two colours), or "texture".
        haze: Index of the infinite plane with a hazy horizon, -1 for no haze; and the width of the haze.
        atlas: Layout of the textures in ``texels``.
    """

    size: jax.Array = _leaf()
    bound: jax.Array = _leaf()
    rgba: jax.Array = _leaf()
    emission: jax.Array = _leaf()
    specular: jax.Array = _leaf()
    shininess: jax.Array = _leaf()
    texture_repeat: jax.Array = _leaf()
    texture: jax.Array = _leaf()
    fovy: jax.Array = _leaf()
    focal: jax.Array = _leaf()
    principal: jax.Array = _leaf()
    sensor: jax.Array = _leaf()
    camera_position: jax.Array = _leaf()
    camera_axes: jax.Array = _leaf()
    camera_shift: jax.Array = _leaf()
    camera_turn: jax.Array = _leaf()
    body_mass: jax.Array = _leaf()
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
    haze_colour: jax.Array = _leaf()
    cords: jax.Array = _leaf()
    texels: jax.Array = _leaf()
    triangles: jax.Array = _leaf()
    clusters: jax.Array = _leaf()
    cluster_places: jax.Array = _leaf()
    hierarchies: Hierarchies | None = _leaf()
    object_ids: tuple[int, ...] = _static()
    object_types: tuple[int, ...] = _static()
    transparent: tuple[int, ...] = _static()
    reordered: bool = _static()
    geom_count: int = _static()
    tendon_paths: tuple[tendons.Path, ...] = _static()
    camera_id: int = _static()
    camera_mount: mounts.Mount = _static()
    body_parents: tuple[int, ...] = _static()
    projection: str = _static()
    height: int = _static()
    width: int = _static()
    light_types: tuple[int, ...] = _static()
    light_mounts: tuple[mounts.Mount, ...] = _static()
    light_highlights: tuple[bool, ...] = _static()
    light_shadows: tuple[bool, ...] = _static()
    headlight: bool = _static()
    sky: str = _static()
    haze: tuple[int, float] = _static()
    atlas: atlases.Atlas = _static()

    @property
    def site_count(self) -> int:
        """Number of sites of the model."""
        return len(self.size) - self.geom_count - len(self.tendon_paths)

    @classmethod
    def from_mjmodel(
        cls,
        mj_model: mujoco.MjModel,
        camera: cameras.Camera = None,
        height: int = 64,
        width: int = 64,
        groups: tuple[int, ...] = (0, 1, 2),
        site_groups: tuple[int, ...] = (),
        textured: bool = True,
        shadows: bool = False,
        haze: bool = False,
        plane_backs: bool | None = None,
        leave_out: tuple[str, ...] = (),
        lights: str = "all",
        tendon_groups: tuple[int, ...] = (0, 1, 2),
        textures: tuple[str | int, ...] = (),
    ) -> Self:
        """Build a scene from ``mj_model``.

        Args:
            mj_model: MuJoCo model.
            camera: Name or index of one of the model's cameras; None for the free camera of `mujoco.Renderer`, which views the
                whole model from outside; or a `mujoco.MjvCamera` with its own ``lookat``, ``distance``, ``azimuth`` and
                ``elevation``. A free camera does not move.
            height: Image height in pixels.
            width: Image width in pixels.
            groups: Visible geom groups (default as in `mujoco.Renderer`).
            site_groups: Visible site groups; by default no group, unlike in `mujoco.Renderer`, because sites are markers for
                users.
            tendon_groups: Visible groups of spatial tendons (default as in `mujoco.Renderer`).
            textured: Render textures. If False, which is cheaper, an object has its texture's mean colour, and the sky is a
                gradient between its colours at the zenith and the nadir.
            textures: Names or indices of further textures to load, for scenes whose objects have other textures than in the
                model.
            shadows: Render hard shadows of the lights that cast shadows in the model: one more ray per light.
            haze: Render haze at the horizon of the first infinite plane, as in the model's visual settings.
            plane_backs: If True, planes are partly transparent from behind, as in MuJoCo. If False, they look the same from
                both sides, which is cheaper. If None, only planes that the camera is behind in the model's initial pose are
                transparent, which is correct unless camera and plane pass each other.
            leave_out: Names of geoms not to render; "skin" and "flex" stand for all skins or flexes.
            lights: "all": all lights except image lights, which MuJoCo ignores too. "mujoco": point lights, which MuJoCo's
                renderer does not support, are also excluded, to reproduce its images.

        Returns:
            The scene. Objects with alpha 0 and objects of other groups are omitted.

        Raises:
            ValueError: ``mj_model`` is not a `mujoco.MjModel`, the camera, a texture or a geom in ``leave_out`` does not exist,
                a size is not a positive integer, groups are not integers, ``lights`` is invalid, or something visible is not
                supported (skins, flexes).
        """
        reading.check_model(mj_model)
        reading.check_size(height=height, width=width)
        groups = reading.group_numbers("groups", groups)
        site_groups = reading.group_numbers("site_groups", site_groups)
        tendon_groups = reading.group_numbers("tendon_groups", tendon_groups)
        reading.check_names(mj_model, leave_out)
        reading.check_lights(lights)
        camera_id = cameras.find_camera(mj_model, camera)
        appearance = reading.object_appearance(mj_model)
        types = reading.object_types(mj_model)
        drawn = reading.drawn_objects(mj_model, appearance["rgba"], groups, site_groups, tendon_groups, leave_out)
        reading.check_supported(mj_model, groups, leave_out)
        clear_planes = reading.planes_clear_from_behind(mj_model, camera_id, camera, plane_backs)
        transparency = reading.transparency(appearance["rgba"][:, 3], clear_planes)
        ids, reordered = reading.drawing_order(mj_model, types, np.flatnonzero(drawn), transparency[drawn] == reading.SOLID)
        paths = tendons.read_paths(mj_model)
        ids = np.repeat(ids, tendons.capsule_counts(mj_model, paths)[ids])
        further = reading.texture_numbers(mj_model, textures)
        atlas, texels, sky = atlases.build_atlas(mj_model, ids, types[ids], textured, further)
        if not textured:
            appearance["rgba"] *= reading.mean_texture_colours(mj_model)
        light_leaves, light_facts = reading.lights(mj_model, appearance["specular"][ids], shadows, points=lights == "all")
        leaves = {"bound": reading.bounds(mj_model), "cords": tendons.cord_columns(mj_model), **appearance, **light_leaves}
        leaves |= cameras.camera_parameters(mj_model, camera_id, camera)
        leaves["sky_top"], leaves["sky_bottom"] = reading.sky_colours(mj_model)
        leaves["haze_colour"] = mj_model.vis.rgba.haze[:3]
        camera_mount = cameras.camera_mount(mj_model, camera_id)
        leaves["body_mass"], parents = reading.body_masses(mj_model, (camera_mount, *light_facts["light_mounts"]))
        arrays = {name: np.asarray(value, np.float32) for name, value in leaves.items()}
        clear = transparency[ids] == reading.CLEAR
        fine = meshes.build_triangles(mj_model, ids, types[ids], clear)
        further_arrays = {
            "texels": texels,
            "texture": reading.object_textures(mj_model).astype(np.int32),
            "hierarchies": build_hierarchies(fine["triangles"], fine["cluster_places"]),
        }
        return cls(
            # All in one call: `jnp.asarray` would compile a program per shape.
            **jax.device_put(arrays | fine | further_arrays),
            object_ids=tuple(ids.tolist()),
            object_types=tuple(types[ids].tolist()),
            transparent=tuple(transparency[ids].tolist()),
            reordered=reordered,
            geom_count=mj_model.ngeom,
            tendon_paths=paths,
            camera_id=camera_id,
            camera_mount=camera_mount,
            body_parents=parents,
            projection=cameras.projection(mj_model, camera_id, camera),
            height=int(height),
            width=int(width),
            **light_facts,
            headlight=bool(mj_model.vis.headlight.active),
            sky=sky,
            haze=reading.haze_plane(mj_model, drawn) if haze else (-1, 0.0),
            atlas=atlas,
        )

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def intrinsics(self) -> jax.Array:
        """Compute the camera's intrinsic matrix in OpenCV's convention, in pixels.

        Pixel centres are at integer coordinates: (0, 0) is the centre of the top left pixel. The matrix is a function of the
        leaves ``fovy``, ``focal``, ``principal`` and ``sensor``, hence traceable.

        Returns:
            [3, 3] float32.

        Raises:
            ValueError: The camera is orthographic.
        """
        return viewpoint.intrinsic_matrix(self)

    def extrinsics(self, data: Any) -> jax.Array:
        """Compute the transform from the world's frame to the camera's in OpenCV's convention (x right, y down, z ahead).

        Args:
            data: Poses of one environment, as in `render`.

        Returns:
            [4, 4] float32, m.
        """
        return viewpoint.extrinsic_matrix(self, data)

    def points(self, depth: jax.Array, data: Any = None) -> jax.Array:
        """Convert a depth image to a point cloud in the order of the pixels.

        Args:
            depth: [H, W], planar depth in m, as in `Frame`. Pixels of the sky are points on the far plane.
            data: Poses of the same environment, for points in the world's frame; None for the camera's frame in OpenCV's
                convention (x right, y down, z ahead).

        Returns:
            [H, W, 3] float32, m.

        Raises:
            ValueError: ``depth`` is not one image of the scene's size.
        """
        return viewpoint.depth_points(self, depth, data)
