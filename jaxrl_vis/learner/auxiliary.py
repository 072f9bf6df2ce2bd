"""Auxiliary tasks and their weighting as parts of a learner: made from a `Config`, with what each of its steps does for them.

collecting   optical flow, from raw images
sampling     the other targets, likewise
ddpg         latents of all observations that some task reads, losses, and a weighted gradient for each encoder
"""

import dataclasses
from typing import Any

import jax

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.auxtasks import AuxTask, Spec, Targets, View, optical_flow
from jaxrl_vis.learner.blocks import shifted
from jaxrl_vis.learner.weighting import MAIN, Way, Weighting, WeightingState, make_weighting
from jaxrl_vis.types import Batch, Episodes, Params

_EPISODES_AT_ONCE = 10  # of which optical flow is computed: some 500 images fill a GPU, and more would fill its memory


@dataclasses.dataclass(frozen=True)
class Auxiliary:
    """The auxiliary tasks of a learner, which may be none, and how their losses are weighted.

    Attributes:
        tasks: By name.
        weighting: Of their losses and the main one.
        options: How the tasks were made.
        frame_stack: Images that an observation stacks.
        way: How gradients of losses are found (`weighting.gradients`).
    """

    tasks: dict[str, AuxTask]
    weighting: Weighting
    options: auxtasks.Options = auxtasks.Options()
    frame_stack: int = 1
    way: Way = "latents"

    @property
    def needs(self) -> frozenset[str]:
        """The optional fields of `View` that some task reads."""
        return auxtasks.needs_of(self.tasks)

    @property
    def others(self) -> tuple[str, ...]:
        """What else than an observation and a goal is encoded with gradient: ``after`` and ``moved`` (`networks.Inputs`)."""
        read = {"after": "latent_tp1", "moved": "latent_moved"}
        return tuple(name for name, latent in read.items() if latent in self.needs)

    def init_heads(self, key: jax.Array) -> dict[str, Params]:
        """Fresh parameters of all heads, by task."""
        return {name: task.init(jax.random.fold_in(key, auxtasks.head_number(name))) for name, task in self.tasks.items()}

    def init_state(self, critic: Params) -> WeightingState | None:
        """The weighting's state; None where there is nothing to weight and nothing to remember.

        Args:
            critic: All parameters of the critic, in whose encoder gradients are compared.
        """
        return None if self.weighting.name == "none" else self.start(critic)

    def start(self, critic: Params) -> WeightingState:
        """The weighting's state before the first update."""
        kept = (critic,) if self.weighting.hold is not None else ()
        return self.weighting.init((MAIN, *self.tasks), critic.get("encoder"), *kept)

    @property
    def keeps_flow(self) -> bool:
        """Whether episodes are to be collected with their optical flow.

        It takes longer than all the rest of a gradient step, and a transition is sampled 5 to 20 times.
        """
        return "flow" in self.needs

    def with_flow(self, episodes: Episodes) -> Episodes:
        """A rollout's episodes with their optical flow, where it is kept."""
        if not self.keeps_flow:
            return episodes

        def of_episode(images: jax.Array) -> jax.Array:
            strength = optical_flow.flow_strength_along(images, self.frame_stack, self.options.stretch)
            return optical_flow.to_bytes(strength, self.options.stretch)

        return episodes.replace(flow=jax.lax.map(of_episode, episodes.observations[:, :-1], batch_size=_EPISODES_AT_ONCE))

    def targets(self, key: jax.Array, batch: Batch, flow: jax.Array | None) -> Targets:
        """The targets of a batch.

        Args:
            key: [] a typed key, that of its rotations.
            batch: With raw images.
            flow: [B, H, W] uint8, as kept; None where it is not.
        """
        images = batch.observation_t, batch.observation_tp1
        targets = auxtasks.make_targets(key, *images, self.needs - {"flow"}, self.options, self.frame_stack)
        return targets if flow is None else targets.replace(flow=optical_flow.from_bytes(flow, self.options.stretch))

    def losses(self, heads: dict[str, Params], view: View, batch: Batch) -> dict[str, jax.Array]:
        """The loss of each task, [] float32 by name.

        Args:
            heads: From `init_heads`.
            view: Of the transitions, without those targets that the batch carries.
            batch: The transitions, with targets.
        """
        if not self.tasks:
            return {}
        view = _with_targets(view, batch)
        return {name: task.loss(heads[name], view) for name, task in self.tasks.items()}

    def predictions(self, heads: dict[str, Params], view: View, batch: Batch) -> dict[str, jax.Array]:
        """What each task predicts (`AuxTask.predict`), by name; arguments as of `losses`."""
        view = _with_targets(view, batch)
        return {name: task.predict(heads[name], view) for name, task in self.tasks.items()}


def _with_targets(view: View, batch: Batch) -> View:
    """The view with the targets of the batch, moved as its images are."""
    flow = batch.targets.flow
    if flow is not None and batch.shift is not None:
        flow = shifted(flow[:, None], batch.shift)[:, 0]
    return view.replace(motion=batch.targets.motion, flow=flow)


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
    if config.aux_tasks and config.n_step > 1:
        raise RequestError("n_step and aux_tasks exclude each other: targets are of single steps")
    spec = Spec(observation, action_size, config.latent_size, frame_stack, len(config.encoder_filters), dtype)
    options = auxtasks.RELEASE if config.aux_form == "release" else auxtasks.Options()
    way: Way = "per_loss" if weighting.needs == "gradients" else "latents"
    return Auxiliary(auxtasks.make(config.aux_tasks, spec, options), weighting, options, frame_stack, way)


def _options(config: Config) -> dict[str, Any]:
    """Arguments of the function that makes the configuration's weighting."""
    options: dict[str, Any] = {}
    if config.weighting in ("ol_aux", "ol_aux_ablation"):
        options |= {
            "interval": config.weighting_interval,
            "learning_rate": config.critic_learning_rate,
            "beta": config.weighting_beta,
        }
        if config.weighting_main_grad != "main":
            options["main_grad"] = config.weighting_main_grad
        if config.weighting_window != 1:
            options["window"] = config.weighting_window
    if config.weighting == "fixed":
        options["weights"] = config.weighting_fixed
    if config.weighting == "cosine":
        options["log"] = config.weighting_log
    return options
