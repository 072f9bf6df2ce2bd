"""Domain randomisation: varies camera, lights, colours and dynamics between episodes. Off by default.

    env = make("VisualFetchReach", randomization=Randomization(camera_position=0.02, colour=0.1, mass=0.2))
    env = make("VisualFetchReach", randomization=typical("camera", "lights", "colours", "dynamics"))

    reset     samples the active deviations, with a key of their own, into `State.domain`; starts and goals are unaffected
    observe   renders a scene with those leaves changed; goal images have the appearance of their episode
    advance   steps a model with those leaves changed

Only numerical values vary, so all episodes share one compiled program, and under `jax.vmap` each environment has its own. The
GPU kernel of the renderer takes each of these leaves as an input, so it renders varied scenes too. Inactive deviations are
neither sampled, stored nor computed: if all of them are off, the program is the same as without randomisation.
"""

import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp

from jaxrl_vis_envs import checks
from jaxrl_vis_envs.render import Scene

Domain = dict[str, jax.Array]
"""Deviations of one episode, float32, by the name of their range in `Randomization`; only the active ones."""

# Folded into an episode's key. It is large, because folding in small numbers gives the keys that `jax.random.split` returns.
_TAG = 0x646F6D61

_ABSOLUTE = ("camera_position", "camera_orientation", "light_position", "light_direction", "colour")
_DYNAMICS = ("mass", "damping", "friction", "actuator_gain", "action_scale")


@dataclasses.dataclass(frozen=True)
class Randomization:
    """Ranges of the deviations between episodes. Each deviation is uniform between plus and minus its range; 0 is off.

    Ranges described as fractions scale a value by 1 plus the deviation, and must be less than 1.

    Raises:
        ValueError: A range is not a finite number of at least 0, or a fraction is 1 or more.
    """

    camera_position: float = 0.0
    """Translation of the camera along each axis of its own frame, m."""
    camera_orientation: float = 0.0
    """Rotation of the camera about each axis of its own frame, rad."""
    camera_fovy: float = 0.0
    """Field of view, fraction."""
    light_position: float = 0.0
    """Translation of each light along each axis, m; no effect on directional lights."""
    light_direction: float = 0.0
    """Change of each light's unit direction along each axis: approximately its tilt in rad. No effect on the headlight."""
    light_diffuse: float = 0.0
    """Diffuse and specular intensity of each light, including the headlight, in each colour channel, fraction."""
    light_ambient: float = 0.0
    """Ambient intensity of each light, including the headlight, in each colour channel, fraction."""
    colour: float = 0.0
    """Red, green and blue of each geom, on a scale of 0 to 1; the sum is clipped to it."""
    mass: float = 0.0
    """Mass and inertia of each body, scaled together, fraction."""
    damping: float = 0.0
    """Damping of each joint, fraction."""
    friction: float = 0.0
    """Friction of all contacts and dry friction of all joints and tendons, scaled together, fraction."""
    actuator_gain: float = 0.0
    """Gain of each actuator (stiffness of a position servo), fraction."""
    action_scale: float = 0.0
    """Scale of each component of an action, fraction; also for tasks without actuators."""

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not (checks.is_finite(value) and value >= 0.0):
                raise ValueError(f"{name} of the randomization must be a finite range of at least 0, got {value!r}")
            if name not in _ABSOLUTE and value >= 1.0:
                raise ValueError(f"{name} of the randomization is a fraction and must be less than 1, got {value}")

    @property
    def active(self) -> dict[str, float]:
        """Active ranges, by name."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value > 0.0}

    @property
    def varies_appearance(self) -> bool:
        """True if images of the same poses differ between episodes."""
        return any(name not in _DYNAMICS for name in self.active)

    @property
    def varies_model(self) -> bool:
        """True if the physics model differs between episodes."""
        return any(name in _MODEL_LEAVES for name in self.active)

    def scaled(self, strength: float) -> Self:
        """Return a copy with every range scaled by ``strength``.

        Raises:
            ValueError: ``strength`` is not a finite number of at least 0, or a scaled range is out of bounds.
        """
        if not checks.is_finite(strength) or strength < 0.0:
            raise ValueError(f"the strength of a randomization must be a finite number of at least 0, got {strength!r}")
        return type(self)(**{name: strength * value for name, value in dataclasses.asdict(self).items()})


OFF = Randomization()

KINDS: dict[str, dict[str, float]] = {
    "camera": dict(camera_position=0.02, camera_orientation=0.02, camera_fovy=0.03),
    "lights": dict(light_position=0.3, light_direction=0.3, light_diffuse=0.3, light_ambient=0.3),
    "colours": dict(colour=0.1),
    "dynamics": dict(mass=0.2, damping=0.2, friction=0.3, actuator_gain=0.1, action_scale=0.1),
}
"""Typical ranges by kind: the uncertainty left after carefully measuring a real robot cell."""


def typical(*kinds: str, strength: float = 1.0) -> Randomization:
    """Return the typical ranges of the given `KINDS`, scaled by ``strength``.

    Raises:
        ValueError: There is no such kind, ``strength`` is not a finite number of at least 0, or a scaled range leaves its
            bounds.
    """
    for kind in kinds:
        if not isinstance(kind, str) or kind not in KINDS:
            raise ValueError(f"there is no randomization of {kind!r}; choose among {', '.join(KINDS)}")
    ranges: dict[str, float] = {}
    for kind in kinds:
        ranges |= KINDS[kind]
    return Randomization(**ranges).scaled(strength)


def sample(key: jax.Array, ranges: Randomization, model: Any, action_size: int, scene: Scene | None) -> Domain | None:
    """Sample the deviations of one episode.

    Args:
        key: Typed key of the episode; the deviations are independent of other samples from it.
        ranges: Ranges of the deviations.
        model: The `mjx.Model`.
        action_size: Number A of components of an action.
        scene: Scene that images are rendered from; None for a task without images, whose ``ranges`` must not vary appearance.

    Returns:
        The active deviations, or None if all are off. Each has its own key, so its value does not depend on which others are
        active.
    """
    active = ranges.active
    if not active:
        return None
    lights = 1 if scene is None else 1 + len(scene.light_types)  # the last is the headlight
    shapes = {
        "camera_position": (3,),
        "camera_orientation": (3,),
        "camera_fovy": (),
        "light_position": (lights - 1, 3),
        "light_direction": (lights - 1, 3),
        "light_diffuse": (lights, 3),
        "light_ambient": (lights, 3),
        "colour": (0 if scene is None else len(scene.rgba), 3),
        "mass": (model.nbody,),
        "damping": (model.nv,),
        "friction": (),
        "actuator_gain": (model.nu,),
        "action_scale": (action_size,),
    }
    key = jax.random.fold_in(key, _TAG)
    keys = {name: jax.random.fold_in(key, index) for index, name in enumerate(shapes)}
    return {name: jax.random.uniform(keys[name], shapes[name], jnp.float32, -limit, limit) for name, limit in active.items()}


def varied_scene(scene: Scene, domain: Domain | None) -> Scene:
    """Return ``scene`` with the camera, lights and colours of an episode, or unchanged if none of them varies."""
    if domain is None:
        return scene
    changes: dict[str, jax.Array] = {}
    if "camera_position" in domain:
        changes["camera_shift"] = scene.camera_shift + domain["camera_position"]
    if "camera_orientation" in domain:
        changes["camera_turn"] = scene.camera_turn + domain["camera_orientation"]
    if "camera_fovy" in domain:
        # The field of view is scaled by its angle or, for a camera with a sensor, by the sensor's size.
        factor = 1.0 + domain["camera_fovy"]
        changes |= {"fovy": scene.fovy * factor, "sensor": scene.sensor * factor}
    if "light_position" in domain:
        changes["light_position"] = scene.light_position + domain["light_position"]
    if "light_direction" in domain:
        changes["light_direction"] = scene.light_direction + domain["light_direction"]  # normalised where it is used
    for name, leaves in (("light_diffuse", ("diffuse", "specular")), ("light_ambient", ("ambient",))):
        if name in domain:
            factor = 1.0 + domain[name]
            for leaf in leaves:
                changes[f"light_{leaf}"] = getattr(scene, f"light_{leaf}") * factor[:-1]
                changes[f"headlight_{leaf}"] = getattr(scene, f"headlight_{leaf}") * factor[-1]
    if "colour" in domain:
        changes["rgba"] = scene.rgba.at[:, :3].set(jnp.clip(scene.rgba[:, :3] + domain["colour"], 0.0, 1.0))
    return scene.replace(**changes) if changes else scene


# Leaves of mjx.Model that each range scales along their first axis. Constraint softness (invweight0) is unchanged.
_MODEL_LEAVES = {
    "mass": ("body_mass", "body_inertia"),
    "damping": ("dof_damping",),
    "friction": ("geom_friction", "pair_friction", "dof_frictionloss", "tendon_frictionloss"),
    "actuator_gain": ("actuator_gainprm", "actuator_biasprm"),
}


def varied_model(model: Any, domain: Domain | None) -> Any:
    """Return ``model`` (`mjx.Model`) with the dynamics of an episode, or unchanged if none of them varies."""
    changes = {}
    for name, leaves in _MODEL_LEAVES.items():
        if domain is None or name not in domain:
            continue
        factor = 1.0 + domain[name]
        for leaf in leaves:
            value = jnp.asarray(getattr(model, leaf))
            changes[leaf] = value * factor.reshape(*factor.shape, *(1,) * (value.ndim - factor.ndim))
    return model.replace(**changes) if changes else model


def varied_action(action: jax.Array, domain: Domain | None) -> jax.Array:
    """Scale an action [A] by the episode's action scale: [A] float32, in [-2, 2]."""
    return action if domain is None or "action_scale" not in domain else action * (1.0 + domain["action_scale"])
