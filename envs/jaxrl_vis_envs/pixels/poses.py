"""Poses for environments of other libraries, computed from their states by forward kinematics of their MuJoCo models."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxrl_vis_envs.physics import mjx_model
from jaxrl_vis_envs.physics.mjx_model import mjx
from jaxrl_vis_envs.render import Scene

# Fields of a model that poses depend on.
_KINEMATIC = (
    *("qpos0", "jnt_pos", "jnt_axis", "body_pos", "body_quat", "body_ipos", "body_iquat"),
    *("geom_pos", "geom_quat", "site_pos", "site_quat"),
)
_STATES = ("data", "pipeline_state")


class Poses:
    """Function from the state of an environment to the poses of its bodies, geoms and sites.

    Poses are computed from joint positions (and mocap poses). Those in a state are not used: after `mjx.step` they lag behind
    the joint positions by one physics step, and physics engines other than MJX compute none for geoms.

    Args:
        mj_model: The environment's model.
    """

    def __init__(self, mj_model: mujoco.MjModel) -> None:
        self._model = mjx_model.put_model(mj_model)
        self._data = mjx_model.rest_data(mj_model)

    def __call__(self, state: Any, model: Any = None) -> mjx.Data:
        """Compute the poses of one environment.

        Args:
            state: State of an environment with ``data`` (MuJoCo Playground) or ``pipeline_state`` (brax); or physics data with
                ``qpos`` or brax's ``q``; or joint positions [nq].
            model: Model with the environment's current geometry, if it is randomised: `mjx.Model`, or brax's System. None for
                that of ``mj_model``.

        Returns:
            Data at these joint positions, with the poses of bodies, geoms and sites; velocities and controls are not copied.

        Raises:
            ValueError: ``state`` has no joint positions, or those of several environments or of another model.
        """
        data = physics_data(state)
        qpos = joint_positions(data)
        if qpos.shape != self._data.qpos.shape:
            raise ValueError(f"joint positions of one environment have the shape {self._data.qpos.shape}, got {qpos.shape}")
        changes: dict[str, Any] = {"qpos": jnp.asarray(qpos, self._data.qpos.dtype)}
        if self._model.nmocap and hasattr(data, "mocap_pos"):
            changes |= {"mocap_pos": data.mocap_pos, "mocap_quat": data.mocap_quat}
        own = self._model
        if model is not None:
            own = own.replace(**{name: getattr(model, name) for name in _KINEMATIC})
        with jax.default_matmul_precision("highest"):
            return mjx_model.kinematics(own, self._data.replace(**changes))


def physics_data(state: Any) -> Any:
    """Return the physics data in a state of an environment, or in a state nested inside it, else ``state`` itself."""
    for name in _STATES:
        inner = getattr(state, name, None)
        if inner is not None and _has_positions(data := physics_data(inner)):
            return data
    return state


def _has_positions(data: Any) -> bool:
    return hasattr(data, "qpos") or hasattr(data, "q")


def joint_positions(data: Any) -> Any:
    """Return the joint positions [..., nq] in physics data: ``qpos``, brax's ``q``, or ``data`` itself if it is an array.

    Raises:
        ValueError: There are none.
    """
    for name in ("qpos", "q"):
        if hasattr(data, name):
            return getattr(data, name)
    if isinstance(data, jax.Array | np.ndarray):
        return data
    raise ValueError(
        f"joint positions are read from state.data, state.pipeline_state or physics data; a {type(data).__name__} has none"
    )


def find_model(env: Any) -> mujoco.MjModel:
    """Return the MuJoCo model of an environment or of the one it wraps: ``mj_model``, ``sys.mj_model`` or ``model``.

    Raises:
        ValueError: It has none.
    """
    for owner in (env, getattr(env, "unwrapped", None)):
        for holder, name in ((owner, "mj_model"), (getattr(owner, "sys", None), "mj_model"), (owner, "model")):
            model = getattr(holder, name, None)
            if isinstance(model, mujoco.MjModel):
                return model
    raise ValueError(
        f"{type(env).__name__} has no MuJoCo model as mj_model (MuJoCo Playground), sys.mj_model (brax) or model (Gymnasium)"
    )


def traced_model(env: Any) -> Any:
    """Return the model that an environment currently steps, an `mjx.Model` or brax's System; None if it has none.

    Wrappers for domain randomisation replace it while they trace the environment.
    """
    inner = getattr(env, "unwrapped", env)
    for name in ("sys", "_mjx_model", "mjx_model"):
        model = getattr(inner, name, None)
        if hasattr(model, "body_pos"):
            return model
    return None


def randomized_scene(scene: Scene, model: Any, mj_model: mujoco.MjModel) -> Scene:
    """Return ``scene`` with the sizes, colours and textures of the geoms of a randomised model.

    Args:
        scene: Scene of ``mj_model``.
        model: `mjx.Model` or brax's System.
        mj_model: The model before randomisation.
    """
    count = mj_model.ngeom
    # Differences are added, because some sizes in a scene differ from the model's: infinite planes have a large one.
    size = scene.size.at[:count].add(model.geom_size - jnp.asarray(mj_model.geom_size, jnp.float32))
    colours, before = _geom_colours(model), _geom_colours(mj_model)
    changed = jnp.any(colours != before, axis=1, keepdims=True)
    rgba = scene.rgba.at[:count].set(jnp.where(changed, colours, scene.rgba[:count]))
    texture = scene.texture.at[:count].set(_geom_textures(model))
    return scene.replace(size=size, rgba=rgba, texture=texture)


def _geom_colours(model: Any) -> jax.Array:
    """Return the colours of geoms or, if not set, of their materials: [ngeom, 4] float32."""
    own, material = jnp.asarray(model.geom_rgba, jnp.float32), jnp.asarray(model.geom_matid)
    if not len(model.mat_rgba):
        return own
    is_unset = jnp.all(own == jnp.array([0.5, 0.5, 0.5, 1.0], jnp.float32), axis=1) & (material >= 0)
    return jnp.where(is_unset[:, None], jnp.asarray(model.mat_rgba, jnp.float32)[material], own)


def _geom_textures(model: Any) -> jax.Array:
    """Return the index of the colour texture of each geom, -1 for none: [ngeom] int32."""
    material = jnp.asarray(model.geom_matid, jnp.int32)
    if not len(model.mat_rgba):
        return jnp.full(material.shape, -1, jnp.int32)
    texture = jnp.asarray(model.mat_texid, jnp.int32)[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)]
    return jnp.where(material >= 0, texture, -1)
