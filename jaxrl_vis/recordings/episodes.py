"""Recorded episodes on the host, and their conversion to a replay.

recordings = Recordings.of_rollout(episodes, success, about)    from the result of `rollout.play`, in conventional layouts
replay, state = recordings.to_replay()                          in the learner's layout, byte for byte what was recorded
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.memory.replay import Replay
from jaxrl_vis.types import Episodes, ReplayState

_CHANNELS = (1, 3, 4)  # depth; colour; both


@dataclasses.dataclass(frozen=True, eq=False)
class Recordings:
    """N episodes of T steps each. Images are [H, W, C] uint8: colour, depth, or both in this order.

    Attributes:
        observations: [N, T+1, H, W, C] uint8, the newest image of each stack, or [N, T+1, S] float32; after 0, 1, ... T steps.
        actions: [N, T, A] float32, as executed, in [-1, 1].
        goals: [N, H, W, C] uint8, or [N, S] float32; None for episodes without goals.
        states: [N, T+1, G] float32, true states at the same times; None if unknown.
        goal_states: [N, G] float32, true states of the goals; None if unknown.
        success: [N] bool, at the last step; None if unknown.
        about: Metadata: ``task``, ``control_period`` (s), ``frame_stack``, ``depth_range`` (m), ...
    """

    observations: np.ndarray
    actions: np.ndarray
    goals: np.ndarray | None = None
    states: np.ndarray | None = None
    goal_states: np.ndarray | None = None
    success: np.ndarray | None = None
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shapes, types and numbers.

        Raises:
            RequestError: An array is invalid; the message names it.
        """
        observations, actions = self.observations, self.actions
        images = observations.dtype == np.uint8 and observations.ndim == 5 and observations.shape[-1] in _CHANNELS
        if not images and not (observations.dtype == np.float32 and observations.ndim == 3):
            raise RequestError(
                "observations must be images [N, T+1, H, W, C] uint8 with 1, 3 or 4 channels, or vectors [N, T+1, S] float32, "
                f"not {observations.dtype} of {observations.shape}"
            )
        count, slots = observations.shape[:2]
        if not count or slots < 2:
            raise RequestError(f"observations of {count} episodes and {slots} times: there must be an episode of a step")
        steps = slots - 1
        if actions.dtype != np.float32 or actions.ndim != 3 or actions.shape[:2] != (count, steps) or not actions.shape[2]:
            raise RequestError(
                f"actions must have the shape ({count}, {steps}, A) float32, not {actions.dtype} of {actions.shape}"
            )
        size = 0 if self.states is None else self.states.shape[-1]
        expected: dict[str, tuple[tuple[int, ...], Any]] = {
            "goals": ((count, *observations.shape[2:]), observations.dtype),
            "states": ((count, slots, size), np.float32),
            "goal_states": ((count, size), np.float32),
            "success": ((count,), np.bool_),
        }
        for name, (shape, dtype) in expected.items():
            array = getattr(self, name)
            if array is not None and (array.shape != shape or array.dtype != dtype):
                raise RequestError(f"{name} must have the shape {shape} {np.dtype(dtype)}, not {array.dtype} of {array.shape}")
        stack = self.about.get("frame_stack", 1)
        if not isinstance(stack, int) or stack < 1:
            raise RequestError(f"about.frame_stack must be a whole number from 1, not {stack!r}")
        if (self.states is None) != (self.goal_states is None):
            raise RequestError("states and goal_states come together: give both or neither")
        for name in ("observations", "actions", "goals", "states", "goal_states"):
            array = getattr(self, name)
            if array is not None and array.dtype == np.float32 and not np.all(np.isfinite(array)):
                raise RequestError(f"{name} must be finite numbers: leave the episodes out that are not")

    @property
    def count(self) -> int:
        """N, the number of episodes."""
        return self.observations.shape[0]

    @property
    def horizon(self) -> int:
        """T, the number of steps per episode."""
        return self.actions.shape[1]

    @property
    def are_images(self) -> bool:
        """True if observations are images."""
        return self.observations.dtype == np.uint8

    @property
    def frame_stack(self) -> int:
        """F, the number of images stacked in an observation of the policy; each image is recorded only once."""
        return self.about.get("frame_stack", 1)

    @classmethod
    def of_rollout(cls, episodes: Episodes, success: Any, about: Mapping[str, Any]) -> Self:
        """Convert the episodes of one learner, [N, ...] arrays on any device, to recordings on the host.

        Args:
            episodes: As `rollout.play` returns them.
            success: [N], at the last step.
            about: As in `Recordings`.
        """
        images_or_states = np.asarray(episodes.observations)
        if images_or_states.dtype == np.uint8:
            channels = images_or_states.shape[2] // int(about.get("frame_stack", 1))
            images_or_states = np.moveaxis(images_or_states[:, :, :channels], 2, -1)
        states = np.asarray(episodes.states)
        return cls(
            observations=np.ascontiguousarray(images_or_states[:, :-1]),
            actions=np.asarray(episodes.actions),
            goals=np.ascontiguousarray(images_or_states[:, -1]),
            states=states[:, :-1],
            goal_states=states[:, -1],
            success=np.asarray(success) > 0,
            about=about,
        )

    def first(self, count: int | None) -> Self:
        """Return the first ``count`` episodes; all if None."""
        arrays = (field.name for field in dataclasses.fields(self) if field.name != "about")
        return dataclasses.replace(
            self, **{name: array[:count] for name in arrays if (array := getattr(self, name)) is not None}
        )

    def to_episodes(self) -> Episodes:
        """Convert to the learner's layout, with one image in each slot. Missing goals are replaced by the last observation,
        missing true states by zeros with G = 1.
        """
        goals = self.observations[:, -1] if self.goals is None else self.goals
        with_goals = np.concatenate([self.observations, goals[:, None]], axis=1)
        if self.states is None or self.goal_states is None:
            states = np.zeros((self.count, self.horizon + 2, 1), np.float32)
        else:
            states = np.concatenate([self.states, self.goal_states[:, None]], axis=1)
        planar = np.moveaxis(with_goals, -1, 2) if self.are_images else with_goals
        return Episodes(observations=jnp.asarray(planar), states=jnp.asarray(states), actions=jnp.asarray(self.actions))

    def to_replay(self) -> tuple[Replay, ReplayState]:
        """Return a replay of exactly these episodes, and its state, for sampling.

        It contains the true states, which oracle rewards need, only if they were recorded.
        """
        of_one_image = Replay(1, self.count, self.horizon)
        state = jax.jit(of_one_image.of_rollout)(self.to_episodes())
        return of_one_image._replace(frame_stack=self.frame_stack), state
