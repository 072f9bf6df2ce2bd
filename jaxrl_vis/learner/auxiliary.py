"""Auxiliary tasks and their weighting as parts of a learner: made from a `Config`, with what each of its steps does for them.

sampling   targets, from raw images
ddpg       latents of all observations that some task reads, losses, and a weighted gradient for each encoder
"""

import dataclasses
from typing import Any

import jax

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.auxtasks import AuxTask, Spec, Targets, View
from jaxrl_vis.learner.weighting import MAIN, Weighting, WeightingState, make_weighting
from jaxrl_vis.types import Batch, Params


@dataclasses.dataclass(frozen=True)
class Auxiliary:
    """The auxiliary tasks of a learner, which may be none, and how their losses are weighted.

    Attributes:
        tasks: By name.
        weighting: Of their losses and the main one.
        options: How the tasks were made.
        frame_stack: Images that an observation stacks.
    """

    tasks: dict[str, AuxTask]
    weighting: Weighting
    options: auxtasks.Options = auxtasks.Options()
    frame_stack: int = 1

    @property
    def needs(self) -> frozenset[str]:
        """The optional fields of `View` that some task reads."""
        return auxtasks.needs_of(self.tasks)

    @property
    def observations(self) -> int:
        """How many observations of a transition are encoded with gradient: before, goal, after, moved, in this order."""
        if "latent_moved" in self.needs:
            return 4
        return 3 if "latent_tp1" in self.needs else 2

    def init_heads(self, key: jax.Array) -> dict[str, Params]:
        """Fresh parameters of all heads, by task."""
        return {name: task.init(jax.random.fold_in(key, number)) for number, (name, task) in enumerate(self.tasks.items())}

    def init_state(self, encoder: Params) -> WeightingState | None:
        """The weighting's state; None where there is nothing to weight and nothing to remember.

        Args:
            encoder: Of the critic, in which gradients are compared.
        """
        return None if self.weighting.name == "none" else self.start(encoder)

    def start(self, encoder: Params) -> WeightingState:
        """The weighting's state before the first update."""
        return self.weighting.init((MAIN, *self.tasks), encoder)

    def targets(self, key: jax.Array, batch: Batch) -> Targets:
        """The targets of a batch, from its raw images; ``key`` is that of its rotations."""
        return auxtasks.make_targets(
            key, batch.observation_t, batch.observation_tp1, self.needs, self.options, self.frame_stack
        )

    def losses(
        self, heads: dict[str, Params], latents: jax.Array, image: jax.Array | None, batch: Batch
    ) -> dict[str, jax.Array]:
        """The loss of each task, [] float32 by name.

        Args:
            heads: From `init_heads`.
            latents: [2 to 4, B, L] of ``observations``.
            image: [B, C, H, W] what the first of them was encoded from; None if no task reads it.
            batch: The transitions, with targets.
        """
        if not self.tasks:
            return {}
        view = self._view(latents, image, batch)
        return {name: task.loss(heads[name], view) for name, task in self.tasks.items()}

    def predictions(
        self, heads: dict[str, Params], latents: jax.Array, image: jax.Array | None, batch: Batch
    ) -> dict[str, jax.Array]:
        """What each task predicts (`AuxTask.predict`), by name; arguments as of `losses`."""
        view = self._view(latents, image, batch)
        return {name: task.predict(heads[name], view) for name, task in self.tasks.items()}

    def _view(self, latents: jax.Array, image: jax.Array | None, batch: Batch) -> View:
        return View(
            latent_t=latents[0],
            action=batch.action,
            latent_tp1=latents[2] if self.observations > 2 else None,
            latent_moved=latents[3] if self.observations > 3 else None,
            motion=batch.targets.motion,
            image=image,
            flow=batch.targets.flow,
        )


def make_auxiliary(
    config: Config, observation: jax.ShapeDtypeStruct, action_size: int, frame_stack: int, dtype: Any
) -> Auxiliary:
    """The auxiliary tasks and the weighting that a configuration asks for.

    Args:
        config: The run.
        observation: Shape and dtype of one observation.
        action_size: A.
        frame_stack: Images that an observation stacks.
        dtype: What the networks compute in.

    Raises:
        RequestError: They do not go together, or not with the rest of the configuration.
    """
    weighting = make_weighting(config.weighting, **_options(config))
    if config.aux_tasks and not weighting.auxiliary:
        raise RequestError(
            f"aux_tasks are given, but weighting {config.weighting} learns none: choose --weighting ol_aux, or leave them out"
        )
    if weighting.auxiliary and not config.aux_tasks:
        raise RequestError(
            f"weighting {config.weighting} has no auxiliary tasks to weight: add --aux-tasks with some of "
            f"{' '.join(auxtasks.NAMES)}, or use --weighting none"
        )
    if config.updates_per_iteration % weighting.interval:
        raise RequestError(
            f"weighting_interval ({weighting.interval}) must divide updates_per_iteration ({config.updates_per_iteration})"
        )
    for name, is_set in (("random_shift", config.random_shift > 0), ("n_step", config.n_step > 1)):
        if config.aux_tasks and is_set:
            raise RequestError(f"{name} and aux_tasks exclude each other: targets are of single steps, as the camera saw them")
    spec = Spec(observation, action_size, config.latent_size, frame_stack, len(config.encoder_filters), dtype)
    options = auxtasks.RELEASE if config.aux_form == "release" else auxtasks.Options()
    return Auxiliary(auxtasks.make(config.aux_tasks, spec, options), weighting, options, frame_stack)


def _options(config: Config) -> dict[str, Any]:
    """Arguments of the function that makes the configuration's weighting."""
    options: dict[str, Any] = {}
    if config.weighting in ("ol_aux", "ol_aux_ablation"):
        options |= {
            "interval": config.weighting_interval,
            "learning_rate": config.critic_learning_rate,
            "beta": config.weighting_beta,
            "main_grad": config.weighting_main_grad,
            "window": config.weighting_window,
        }
    if config.weighting == "fixed":
        options["weights"] = config.weighting_fixed
    if config.weighting == "cosine":
        options["log"] = config.weighting_log
    return options
