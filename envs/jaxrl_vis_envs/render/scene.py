"""What is drawn: everything that an image needs besides the poses, read once from a MuJoCo model.

A `Scene` is a pytree. Sizes, colours, materials, lights and the camera are leaves, so a batch of different appearances is
``jax.vmap`` over ``scene.replace(rgba=...)``; what is drawn (geom types, ids, the image's size) is static and fixes the
compiled program.

Arrays over objects are indexed as the segmentation is: object ``i`` is geom ``i`` of the model, and object ``ngeom + i`` is
site ``i``. Objects that are never seen keep their row, so that a row can be found without a table.
"""

import dataclasses
from typing import Any, Self

import jax
import mujoco
import numpy as np

from jaxrl_vis_envs.render import mounts
from jaxrl_vis_envs.render.model import cameras, meshes, reading, textures


def _leaf() -> Any:
    return dataclasses.field()


def _static() -> Any:
    return dataclasses.field(metadata=dict(static=True))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """One camera's view of one model, without the poses. Make it with `Scene.from_mjmodel`.

    N is ngeom + nsite, L the number of lights that are drawn with (the headlight is apart), G the number of drawn objects.

    Attributes:
        size: [N, 3] float32, metres, as `mjModel.geom_size` means it for each type (endless planes: a very large half-size).
        bound: [N] float32, metres, of a ball around each object, by which what is transparent is sorted.
        rgba: [N, 4] float32 in [0, 1], the geom's own colour or its material's. Alpha counts only for the objects in
            ``transparent``, which is settled when the scene is made.
        emission: [N] float32, the part of the colour that needs no light.
        specular: [N] float32 in [0, 1], strength of the highlight.
        shininess: [N] float32 in [0, 1]; the Phong exponent is 128 times this.
        texture_repeat: [N, 2] float32, how often a texture repeats over an object (over a metre where ``texture_uniform``).
        fovy: [] float32, the vertical field of view: degrees, or metres for an orthographic camera.
        focal: [2] float32, metres, of a camera with a sensor size.
        principal: [2] float32, metres, of a camera with a sensor size: where the axis meets the sensor, from its middle.
        sensor: [2] float32, metres, width and height of the sensor.
        camera_position: [3] float32, metres, in the frame of the body that the camera is fixed to, or along the world's axes
            from what it follows.
        camera_axes: [3, 3] float32 whose columns are the camera's axes (right, up, back), in the body's frame, or in the
            world's where it follows. Not read for a camera that aims at a body.
        camera_shift: [3] float32, metres in the camera's own frame (right, up, back), added to its pose. Of a free camera: its
            position in the world.
        camera_turn: [3] float32, radians, a rotation vector in the camera's own frame, applied to its pose. Of a free camera:
            its rotation in the world.
        body_mass: [nbody] float32, kg, where the camera or a light follows a centre of mass, else [0].
        znear: [] float32, metres. What is nearer than this is cut away.
        zfar: [] float32, metres. What is further is not drawn, and it is the depth of the sky.
        light_position: [L, 3] float32, metres, in the frame of the body that it is fixed to, or along the world's axes from
            what it follows.
        light_direction: [L, 3] float32, unit, in the same frame. Not read for a light that aims at a body.
        light_ambient: [L, 3] float32.
        light_diffuse: [L, 3] float32.
        light_specular: [L, 3] float32.
        light_attenuation: [L, 3] float32: constant, linear (1/m) and quadratic (1/m^2). Only for lights with a position.
        light_cutoff: [L] float32, degrees, half-angle of the cone. Only for spot lights.
        light_exponent: [L] float32, how fast a spot light fades from its axis.
        headlight_ambient: [3] float32.
        headlight_diffuse: [3] float32.
        headlight_specular: [3] float32.
        sky_top: [3] float32 in [0, 1], colour of a plain sky straight up (world +z).
        sky_bottom: [3] float32 in [0, 1], colour of a plain sky straight down.
        haze_colour: [3] float32 in [0, 1].
        texels: [T, 4] uint32, all textures at all resolutions, see `textures.Atlas`.
        triangles: [R, 36] float32, the triangles of all meshes and height fields, see `meshes.build_triangles`.
        clusters: [K, 4] float32, metres: balls around the clusters of triangles that are drawn.
        cluster_places: [K, 2] int32: which of the G objects each cluster belongs to, and the first row of its triangles.
        object_ids: G indices of the drawn objects, those that MuJoCo draws last first (of two at the same depth it shows the
            later one, and the renderer the one that comes first here): the last of the model, but one that reflects at the end.
        object_types: G values of `mujoco.mjtGeom`.
        transparent: Which of the G objects let light through: 0 not, 1 yes, 2 a plane that does so from behind.
        reordered: Whether an object that reflects is drawn before others that come before it in the model. In segmentations
            MuJoCo keeps to the model's order.
        geom_count: ngeom of the model.
        camera_id: The camera's index in the model; `cameras.FREE_CAMERA` for a free one.
        camera_mount: What the camera is fixed to.
        body_parents: nbody indices of the bodies that bodies hang on, where ``body_mass`` holds their masses, else none.
        projection: "perspective", "intrinsic" (a perspective camera with a sensor) or "orthographic".
        height: H, pixels.
        width: W, pixels.
        light_types: L values of `mujoco.mjtLightType`.
        light_mounts: What each of the L lights is fixed to.
        light_highlights: L + 1 booleans, the last for the headlight: whether the light makes highlights at all. One that has
            no specular colour in the model never does, and costs less.
        light_shadows: L booleans: whether the light casts shadows (none does unless shadows are asked for).
        headlight: Whether the headlight is on.
        sky: "plain" (a gradient between two colours), or "texture".
        haze: [N]-index of the endless plane whose horizon is hazy, -1 for no haze; and the width of the haze.
        atlas: Where each texture is in ``texels``.
    """

    size: jax.Array = _leaf()
    bound: jax.Array = _leaf()
    rgba: jax.Array = _leaf()
    emission: jax.Array = _leaf()
    specular: jax.Array = _leaf()
    shininess: jax.Array = _leaf()
    texture_repeat: jax.Array = _leaf()
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
    texels: jax.Array = _leaf()
    triangles: jax.Array = _leaf()
    clusters: jax.Array = _leaf()
    cluster_places: jax.Array = _leaf()
    object_ids: tuple[int, ...] = _static()
    object_types: tuple[int, ...] = _static()
    transparent: tuple[int, ...] = _static()
    reordered: bool = _static()
    geom_count: int = _static()
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
    atlas: textures.Atlas = _static()

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
    ) -> Self:
        """Reads what is drawn from ``mj_model``.

        Args:
            mj_model: The model.
            camera: Name or index of one of the model's cameras. None: a free camera as `mujoco.Renderer` has it, which looks
                at the whole model from outside; or an `mujoco.MjvCamera` with a ``lookat``, ``distance``, ``azimuth`` and
                ``elevation`` of its own. A free camera stays where it is, whatever moves.
            height: Image height in pixels.
            width: Image width in pixels.
            groups: Geom groups that are drawn (the default is that of `mujoco.Renderer`).
            site_groups: Site groups that are drawn. None by default, unlike `mujoco.Renderer`: a site is a marker for people.
            textured: Whether textures are drawn. Without, an object has the mean colour of its texture, and the sky is a
                gradient between its colours straight up and straight down; that is cheaper.
            shadows: Whether lights cast hard shadows, where the model says that they do: one more ray for each light.
            haze: Whether the horizon of the first endless plane is hazy, as the model's visual settings have it.
            plane_backs: Whether planes are half transparent from behind, as MuJoCo draws them, or (False) the same from both
                sides, which is cheaper. None: those are that the camera is behind of in the model's initial pose, which is
                right for cameras and planes that do not pass each other.
            leave_out: Names of geoms that are not drawn, and "skin" and "flex" for all of these.
            lights: "all" lights with all lights but images, which are left out as MuJoCo leaves them out. "mujoco" leaves out
                point lights too, which MuJoCo's renderer does not know: for images as it draws them.

        Returns:
            The scene. Objects with alpha 0 and objects of other groups are left out; tendons are not drawn.

        Raises:
            ValueError: ``mj_model`` is no `mujoco.MjModel`, the camera or a geom to be left out does not exist, a size is no
                positive integer, groups are no numbers, ``lights`` is no choice, or something that would be seen cannot be
                drawn (skins, flexes, shadows of meshes).
        """
        reading.check_model(mj_model)
        reading.check_size(height=height, width=width)
        groups = reading.group_numbers("groups", groups)
        site_groups = reading.group_numbers("site_groups", site_groups)
        reading.check_names(mj_model, leave_out)
        reading.check_lights(lights)
        camera_id = cameras.find_camera(mj_model, camera)
        appearance = reading.object_appearance(mj_model)
        types = reading.object_types(mj_model)
        drawn = reading.drawn_objects(mj_model, appearance["rgba"], groups, site_groups, leave_out)
        reading.refuse_unsupported(mj_model, types, drawn, groups, leave_out, shadows)
        seen_through = reading.planes_seen_through(mj_model, camera_id, camera, plane_backs)
        transparency = reading.transparency(appearance["rgba"][:, 3], seen_through)
        ids, reordered = reading.drawing_order(mj_model, types, np.flatnonzero(drawn), transparency[drawn] == reading.SOLID)
        atlas, texels, sky = textures.build_atlas(mj_model, ids, types[ids], textured)
        if not textured:
            appearance["rgba"] *= reading.mean_texture_colours(mj_model)
        light_leaves, light_facts = reading.lights(mj_model, appearance["specular"][ids], shadows, points=lights == "all")
        leaves = {"bound": reading.bounds(mj_model), **appearance, **light_leaves}
        leaves |= cameras.camera_parameters(mj_model, camera_id, camera)
        leaves["sky_top"], leaves["sky_bottom"] = reading.sky_colours(mj_model)
        leaves["haze_colour"] = mj_model.vis.rgba.haze[:3]
        camera_mount = cameras.camera_mount(mj_model, camera_id)
        leaves["body_mass"], parents = reading.weights(mj_model, (camera_mount, *light_facts["light_mounts"]))
        arrays = {name: np.asarray(value, np.float32) for name, value in leaves.items()}
        clear = transparency[ids] == reading.CLEAR
        arrays |= {"texels": texels, **meshes.build_triangles(mj_model, ids, types[ids], clear)}
        return cls(
            # All at once: `jnp.asarray` compiles a program for each shape.
            **jax.device_put(arrays),
            object_ids=tuple(ids.tolist()),
            object_types=tuple(types[ids].tolist()),
            transparent=tuple(transparency[ids].tolist()),
            reordered=reordered,
            geom_count=mj_model.ngeom,
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
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)
