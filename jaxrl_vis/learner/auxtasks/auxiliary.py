"""Auxiliary tasks and their weighting as components of a learner, built from a `Config`. They are used in

collecting   to compute arrays of whole episodes (`AuxTask.episode`)
sampling     to compute views and targets of a batch (`AuxTask.view`, `AuxTask.target`)
ddpg         to compute latents of the observations that tasks read, losses, and a weighted gradient for each encoder
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jaxrl_vis.config import Config
from jaxrl_vis.config.methods import LOG_WEIGHTINGS
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.plugins import build_component, find_component
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.auxtasks import AuxTask, Spec, Transitions, View
from jaxrl_vis.types import Batch, Episodes, Params
from jaxrl_vis.weighting import MAIN, WEIGHTINGS, GradientMode, Weighting, WeightingState, limited, make_weighting, with_cosines

# Folded into a learner's key for the samples of a weighting.
_DRAWS = 0x647261
_EPISODES_AT_ONCE = 10  # processed together: about 500 images saturate a GPU, and more would exhaust its memory


@dataclasses.dataclass(frozen=True)
class Auxiliary:
    """Auxiliary tasks of a learner, possibly none, and the weighting of their losses.

    Attributes:
        tasks: Tasks by name.
        weighting: Weighting of their losses and the main one.
        gradient_mode: Mode in which the losses' gradients are computed (`weighting.gradients`).
    """

    tasks: dict[str, AuxTask]
    weighting: Weighting
    gradient_mode: GradientMode = "latents"

    @property
    def needs_image(self) -> bool:
        """True if some task reads normalised images."""
        return any("image" in task.needs for task in self.tasks.values())

    @property
    def encoded(self) -> tuple[str, ...]:
        """Names of the observations to encode with gradient besides ``before`` and ``goal``, as in `Inputs.pieces`.

        ``after`` if a task reads ``latent_tp1``, then the name of each task that has images of its own (`AuxTask.view`).
        """
        after = ("after",) if any("latent_tp1" in task.needs for task in self.tasks.values()) else ()
        return (*after, *(name for name, task in self.tasks.items() if task.view is not None))

    def init_heads(self, key: jax.Array) -> dict[str, Params]:
        """Initialise the parameters of all heads, by task, from a typed key []."""
        return {name: task.init(task.fold(key)) for name, task in self.tasks.items()}

    def init_state(self, params: Params, key: jax.Array) -> WeightingState | None:
        """Initialise the weighting's state; None without a weighting.

        Args:
            params: All parameters of the network in whose encoder gradients are compared.
            key: [] typed key of the learner.
        """
        if self.weighting.name == "none":
            return None
        state = self.start(params)
        return state if state.key is None else state.replace(key=jax.random.fold_in(key, _DRAWS))

    def start(self, params: Params) -> WeightingState:
        """Return the weighting's own initial state, with the same key for every learner, if it has one.

        Args:
            params: All parameters of the network in whose encoder gradients are compared.
        """
        held = (params,) if self.weighting.hold is not None else ()
        return self.weighting.init((MAIN, *self.tasks), params.get("encoder"), *held)

    def with_stored(self, episodes: Episodes) -> Episodes:
        """Return the E episodes of a rollout with the arrays that tasks compute once per episode (`AuxTask.episode`)."""
        images, stored = episodes.observations[:, :-1], {}
        for name, task in self.tasks.items():
            if task.episode is not None:
                stored[name] = jax.lax.map(task.episode, images, batch_size=_EPISODES_AT_ONCE)
        return episodes.replace(stored=stored)

    def stored_spec(self, observation: jax.ShapeDtypeStruct, horizon: int) -> dict[str, jax.ShapeDtypeStruct]:
        """Return shapes and dtypes of the arrays stored with one episode, by task.

        Args:
            observation: Shape and dtype of one observation.
            horizon: T.
        """
        images = jax.ShapeDtypeStruct((horizon + 1, *observation.shape), observation.dtype)
        return {name: jax.eval_shape(task.episode, images) for name, task in self.tasks.items() if task.episode is not None}

    def with_targets(self, key: jax.Array, batch: Batch, stored: dict[str, jax.Array]) -> Batch:
        """Return a batch with the views and targets of all tasks added.

        Args:
            key: [] typed key for random views.
            batch: Batch with raw images.
            stored: [B, ...] by task, arrays stored in the replay.
        """
        views, targets = {}, {}
        for name, task in self.tasks.items():
            transitions = Transitions(batch.observation_t, batch.observation_tp1, batch.action, stored.get(name))
            if task.view is not None:
                views[name], targets[name] = task.view(key if task.uses_batch_key else task.fold(key), transitions)
            elif task.target is not None:
                targets[name] = task.target(transitions)
        return batch.replace(views=views, targets=targets)

    def losses(
        self,
        heads: dict[str, Params],
        view: View,
        latents: dict[str, jax.Array],
        batch: Batch,
        latent_scales: Mapping[str, jax.Array] | None = None,
    ) -> dict[str, jax.Array]:
        """Compute the loss of each task, [] float32 by name.

        Args:
            heads: From `init_heads`.
            view: Inputs that all tasks share.
            latents: [B, L] of the tasks' own views, by name.
            batch: The transitions, with targets.
            latent_scales: [] float32 by name, factors of each loss's gradient with respect to its latents; None for 1.
        """
        views = self._views(view, latents, batch)
        if latent_scales is not None:
            views = {name: _scale_latents(view, latent_scales[name]) for name, view in views.items()}
        return {name: task.loss(heads[name], views[name]) for name, task in self.tasks.items()}

    def predictions(
        self, heads: dict[str, Params], view: View, latents: dict[str, jax.Array], batch: Batch
    ) -> dict[str, jax.Array]:
        """Compute the prediction of each task (`AuxTask.predict`), by name; arguments as for `losses`."""
        views = self._views(view, latents, batch)
        return {name: task.predict(heads[name], views[name]) for name, task in self.tasks.items()}

    def main_latents(self, latents: jax.Array, weights: Mapping[str, jax.Array]) -> jax.Array:
        """Scale the gradient of an actor's main loss with respect to the latents by the main loss's weight.

        Returns ``latents`` unchanged if that weight is always 1, or also applies to heads.

        Args:
            latents: [..., L].
            weights: [] float32 by name, weights of the critic's losses.
        """
        if self.weighting.main or self.weighting.heads == "weighted":
            return latents
        return _scale_gradient(latents, weights[MAIN])

    def _views(self, view: View, latents: dict[str, jax.Array], batch: Batch) -> dict[str, View]:
        """Return the inputs of each task, with its target shifted like the batch's images."""
        views = {}
        for name, task in self.tasks.items():
            target = batch.targets.get(name)
            if task.shift is not None and batch.shift is not None:
                target = task.shift(target, batch.shift)
            views[name] = view.replace(latent_view=latents.get(name), target=target)
        return views


def _scale_latents(view: View, weight: jax.Array) -> View:
    """Multiply the gradient with respect to a view's latents by ``weight`` [], leaving the latents unchanged."""
    names = ("latent_t", "latent_tp1", "latent_view")
    latents = {name: getattr(view, name) for name in names if getattr(view, name) is not None}
    return view.replace(**{name: _scale_gradient(latent, weight) for name, latent in latents.items()})


@jax.custom_vjp
def _scale_gradient(values: jax.Array, weight: jax.Array) -> jax.Array:
    return values


def _scale_forward(values: jax.Array, weight: jax.Array) -> tuple[jax.Array, jax.Array]:
    return values, weight


def _scale_backward(weight: jax.Array, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    return (weight * gradient).astype(gradient.dtype), jnp.zeros_like(weight)


_scale_gradient.defvjp(_scale_forward, _scale_backward)


def make_auxiliary(
    config: Config, observation: jax.ShapeDtypeStruct, action_size: int, frame_stack: int, dtype: Any
) -> Auxiliary:
    """Build the auxiliary tasks and the weighting of a configuration.

    Args:
        config: Configuration of the run.
        observation: Shape and dtype of one observation.
        action_size: A.
        frame_stack: Number of images that an observation stacks.
        dtype: Compute dtype of the networks.

    Raises:
        RequestError: A task or the weighting is unknown, or they are incompatible with each other or with the rest of the
            configuration.
    """
    if config.auxiliary.weighting in WEIGHTINGS:
        weighting = _limit_weights(config, make_weighting(config.auxiliary.weighting, **_options(config)))
    else:
        maker = find_component("weighting", config.auxiliary.weighting, WEIGHTINGS, config.environment.env_folder)
        weighting = build_component("weighting", config.auxiliary.weighting, maker, expected_type=Weighting)
    if config.study.weighting_cosines:
        if not config.auxiliary.aux_tasks:
            raise RequestError("weighting_cosines compares auxiliary losses, and there are none: add --aux-tasks")
        weighting = with_cosines(weighting)
    if config.auxiliary.aux_tasks and not weighting.auxiliary:
        raise RequestError(
            f"aux_tasks are given, but weighting {config.auxiliary.weighting} learns none: choose --weighting ol_aux, or leave "
            "them out"
        )
    if weighting.auxiliary and not config.auxiliary.aux_tasks:
        raise RequestError(
            f"weighting {config.auxiliary.weighting} has no auxiliary tasks to weight: add --aux-tasks with some of "
            f"{' '.join(auxtasks.NAMES)}, or use --weighting none"
        )
    if config.run.updates_per_iteration % weighting.interval:
        raise RequestError(
            f"weighting_interval ({weighting.interval}) must divide updates_per_iteration ({config.run.updates_per_iteration})"
        )
    if config.auxiliary.aux_tasks and config.study.n_step > 1:
        raise RequestError("n_step and aux_tasks exclude each other: targets are of single steps")
    options = auxtasks.RELEASE if config.study.aux_form == "release" else auxtasks.Options()
    spec = Spec(
        observation, action_size, config.network.latent_size, frame_stack, len(config.network.encoder_filters), dtype, options
    )
    gradient_mode: GradientMode = "per_loss" if weighting.needs == "gradients" else "latents"
    return Auxiliary(auxtasks.make(config.auxiliary.aux_tasks, spec, config.environment.env_folder), weighting, gradient_mode)


def _limit_weights(config: Config, weighting: Weighting) -> Weighting:
    """Limit the weights, or fix their sum, as configured. OL-AUX applies the maximum weight in its own rule."""
    maximum, total = config.study.weighting_maximum, config.study.weighting_total
    if config.auxiliary.weighting == "ol_aux":
        maximum = None
    return weighting if maximum is None and total is None else limited(weighting, maximum=maximum, total=total)


def _options(config: Config) -> dict[str, Any]:
    """Return the keyword arguments for the constructor of the configuration's weighting.

    Raises:
        RequestError: The number of values of eps differs from the number of tasks.
    """
    options: dict[str, Any] = {}
    tasks, eps = config.auxiliary.aux_tasks, config.study.weighting_task_eps
    if eps and len(eps) != len(tasks):
        raise RequestError(f"weighting_task_eps has {len(eps)} values for {len(tasks)} aux_tasks: give one for each")
    if config.study.weighting_heads is not None:
        options["heads"] = config.study.weighting_heads
    if eps:
        options["eps"] = dict(zip(tasks, eps, strict=True))
    elif config.study.weighting_eps is not None:
        options["eps"] = config.study.weighting_eps
    if config.auxiliary.weighting in ("ol_aux", "ol_aux_ablation"):
        options |= {
            "interval": config.auxiliary.weighting_interval,
            "learning_rate": config.ddpg.critic_learning_rate,
            "beta": config.auxiliary.weighting_beta,
        }
        if config.study.weighting_main_grad != "main":
            options["main_grad"] = config.study.weighting_main_grad
        if config.study.weighting_window != 1:
            options["window"] = config.study.weighting_window
        if config.study.weighting_maximum is not None and config.auxiliary.weighting == "ol_aux":
            options["maximum"] = config.study.weighting_maximum
    if config.auxiliary.weighting == "fixed":
        options["weights"] = config.auxiliary.weighting_fixed
    if config.auxiliary.weighting in LOG_WEIGHTINGS:
        options["log"] = config.study.weighting_log
    return options
