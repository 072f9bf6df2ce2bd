"""Ring buffer of whole episodes, stored byte for byte, each observation once.

    observations  [N, T+2, C, H, W/4] uint32     slots 0 ... T: the episode;  slot T+1: its goal
                   |                |
                   |                +-- four pixels (uint8) per word: XLA copies element by element, whatever their size
                   +-- rollouts of E episodes, one after the other; N is a multiple of E

Images whose width is not a multiple of four, and state vectors, are stored unpacked. If observations stack the images of the
latest control steps, only the newest image of each is stored: the others are in the slots before it, or repeat slot 0 at the
start of an episode. A goal is at rest, so that all its images are the same.

A rollout is written as one contiguous slice. Its position follows from the iteration, which all seeds share, so that under
`vmap` over seeds it stays a slice and does not become a scatter. Batches are sampled from the newest ``size`` episodes.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxrl_vis.learner.memory.random_integers import fractions_to_integers
from jaxrl_vis.types import Batch, Episodes, ReplayState

_WORD = 4  # bytes


def _packs(dtype: Any, width: int) -> bool:
    return dtype == jnp.uint8 and width % _WORD == 0


def pack(observations: jax.Array) -> jax.Array:
    """Pack observations for storage: [..., W] uint8 -> [..., W/4] uint32 if four divides W, else unchanged."""
    *shape, width = observations.shape
    if not _packs(observations.dtype, width):
        return observations
    return jax.lax.bitcast_convert_type(observations.reshape(*shape, width // _WORD, _WORD), jnp.uint32)


def unpack(observations: jax.Array) -> jax.Array:
    """Invert `pack`: [..., W/4] uint32 -> [..., W] uint8, other dtypes unchanged."""
    if observations.dtype != jnp.uint32:
        return observations
    *shape, words = observations.shape
    return jax.lax.bitcast_convert_type(observations, jnp.uint8).reshape(*shape, words * _WORD)


def _pack_steps(array: jax.Array) -> jax.Array:
    """Apply `pack` to each step of an array [episodes, steps, ...]; one number per step stays unchanged."""
    return pack(array) if array.ndim > 2 else array


class Indices(NamedTuple):
    """Positions of B transitions: [B] int32 each.

    Attributes:
        episode: Position of the episode in the replay, in [0, N).
        time: t, number of the transition's first step, in [0, T).
    """

    episode: jax.Array
    time: jax.Array


class Replay(NamedTuple):
    """Fixed sizes of a replay. All methods are pure.

    Attributes:
        num_rollouts: Number of rollouts that the ring holds.
        num_envs: E, number of episodes in a rollout.
        horizon: T, number of control steps in an episode.
        frame_stack: F, number of images that an observation stacks along C, the newest first; 1 for state vectors.
        mean_age: Mean age of samples, in rollouts, for probabilities that decay exponentially with age; None for uniform ones.
    """

    num_rollouts: int
    num_envs: int
    horizon: int
    frame_stack: int = 1
    mean_age: float | None = None

    @property
    def num_episodes(self) -> int:
        """N, the capacity in episodes."""
        return self.num_rollouts * self.num_envs

    def init(
        self,
        observation: jax.ShapeDtypeStruct,
        goal_state_size: int,
        action_size: int,
        stored: Mapping[str, jax.ShapeDtypeStruct] | None = None,
        full_state_size: int = 0,
    ) -> ReplayState:
        """Create an empty replay.

        Args:
            observation: Shape and dtype of one observation (`GoalEnv.observation_spec`).
            goal_state_size: G.
            action_size: A.
            stored: Shapes and dtypes of the arrays stored with one episode, by auxiliary task (`Auxiliary.stored_spec`); None
                for no such arrays.
            full_state_size: P - G, size of `Episodes.full_states`; 0 if they are not stored.
        """
        episodes, horizon = self.num_episodes, self.horizon
        fields = {
            name: _pack_steps(jnp.zeros((episodes, *spec.shape), spec.dtype)) for name, spec in dict(stored or {}).items()
        }
        first, *others = observation.shape
        stored_shape = (episodes, horizon + 2, first // self.frame_stack, *others)
        return ReplayState(
            episodes=Episodes(
                observations=pack(jnp.zeros(stored_shape, observation.dtype)),
                states=jnp.zeros((episodes, horizon + 2, goal_state_size), jnp.float32),
                actions=jnp.zeros((episodes, horizon, action_size), jnp.float32),
                stored=fields,
                full_states=jnp.zeros((episodes, horizon + 1, full_state_size), jnp.float32) if full_state_size else None,
            ),
            size=jnp.zeros((), jnp.int32),
        )

    def spec(self, *args: Any) -> ReplayState:
        """Return shapes and dtypes of the storage, without allocating it; arguments as for `init`."""
        return jax.eval_shape(lambda: self.init(*args))

    def _to_storage(self, rollout: Episodes) -> Episodes:
        """Convert a rollout's episodes to their stored form: only the newest image of each observation, packed."""
        newest = rollout.observations[:, :, : rollout.observations.shape[2] // self.frame_stack]
        stored = {name: _pack_steps(array) for name, array in rollout.stored.items()}
        return rollout.replace(observations=pack(newest), stored=stored)

    def of_rollout(self, rollout: Episodes) -> ReplayState:
        """Create a replay that holds just the E episodes of one rollout."""
        return ReplayState(episodes=self._to_storage(rollout), size=jnp.full((), self.num_envs, jnp.int32))

    def insert(self, state: ReplayState, rollout: Episodes, iteration: jax.Array) -> ReplayState:
        """Write the E episodes of a rollout, over the oldest ones once the ring is full; return the new state.

        Args:
            state: State of the replay before the insertion.
            rollout: E episodes, unpacked.
            iteration: [] int32, index of the iteration, which determines the position.
        """
        start = (iteration % self.num_rollouts) * self.num_envs
        episodes = jax.tree.map(
            lambda storage, new: jax.lax.dynamic_update_slice_in_dim(storage, new, start, axis=0),
            state.episodes,
            self._to_storage(rollout),
        )
        return ReplayState(episodes=episodes, size=jnp.minimum(state.size + self.num_envs, self.num_episodes))

    def _latest(self, iteration: jax.Array) -> jax.Array:
        """Return the position, [] int32, of the last episode of the rollout of ``iteration``."""
        return (iteration % self.num_rollouts + 1) * self.num_envs - 1

    def is_stored(self, state: ReplayState, iteration: jax.Array) -> jax.Array:
        """Return the mask [N] bool of occupied positions. A resumed run may begin anywhere in the ring.

        Args:
            state: The replay, with the rollout of ``iteration`` inserted.
            iteration: [] int32.
        """
        age = (self._latest(iteration) - jnp.arange(self.num_episodes)) % self.num_episodes
        return age < state.size

    def sample_indices(self, state: ReplayState, key: jax.Array, iteration: jax.Array, batch_size: int) -> Indices:
        """Sample B stored transitions: uniformly, or newer ones more often than older ones (``mean_age``).

        Args:
            state: The replay, with the rollout of ``iteration`` inserted.
            key: [] typed key.
            iteration: [] int32.
            batch_size: B.
        """
        of_episode, of_time = jax.random.uniform(key, (2, batch_size))
        latest = self._latest(iteration)
        size = jnp.maximum(state.size, 1)
        if self.mean_age is not None:  # an exponential distribution that ends with the oldest episode
            mean = self.mean_age * self.num_envs
            of_episode = -mean * jnp.log1p(of_episode * jnp.expm1(-size / mean)) / size
        age = fractions_to_integers(of_episode, size)
        return Indices(episode=(latest - age) % self.num_episodes, time=fractions_to_integers(of_time, self.horizon))

    def gather(
        self,
        state: ReplayState,
        indices: Indices,
        goal_slot: jax.Array,
        steps: int = 1,
        goal_episode: jax.Array | None = None,
    ) -> Batch:
        """Read transitions; their goals are slots of the same episode, or of another one.

        Args:
            state: The replay.
            indices: Positions of the transitions, [B] each.
            goal_slot: [B] int32 in [1, T+1].
            steps: Number of steps from the first to the last observation of a transition; fewer at the end of an episode.
            goal_episode: [B] int32, episodes of the goal slots; None for the transitions' own episodes.

        Returns:
            Transitions without rewards; ``state_tp1`` is the state after one step, even if ``steps`` is greater. Stacked images
            of goals are static: copies of the newest one.
        """
        observations, states, actions = state.episodes.observations, state.episodes.states, state.episodes.actions
        episode, time = indices
        last = jnp.minimum(time + steps, self.horizon) if steps > 1 else time + 1
        goal_episode = episode if goal_episode is None else goal_episode
        episodes, slots = jnp.stack([episode, goal_episode, episode]), jnp.stack([time, goal_slot, last])
        full_states = state.episodes.full_states
        return Batch(
            observations=self._read(observations, episodes, slots, jnp.array([[False], [True], [False]])),
            action=actions[episode, time],
            state_tp1=states[episode, time + 1],
            goal_state=states[goal_episode, goal_slot],
            full_states=None if full_states is None else full_states[episodes[::2], slots[::2]],
        )

    def _read(self, stored: jax.Array, episodes: jax.Array, slots: jax.Array, is_static: jax.Array) -> jax.Array:
        """Read observations [..., C, H, W] from slots [...] of episodes [...]; at rest, all stacked images are the newest."""
        if self.frame_stack == 1:
            return unpack(stored[episodes, slots])
        ago = jnp.where(is_static[..., None], 0, jnp.arange(self.frame_stack))
        images = unpack(stored[episodes[..., None], jnp.maximum(slots[..., None] - ago, 0)])
        return images.reshape(*slots.shape, -1, *images.shape[-2:])

    def stacked(self, state: ReplayState) -> jax.Array:
        """Return all observations of the episodes as they were collected, [N, T+2, ...]."""
        stored = state.episodes.observations
        episodes, slots = jnp.indices(stored.shape[:2])
        return self._read(stored, episodes, slots, slots > self.horizon)

    def read_stored(self, state: ReplayState, indices: Indices) -> dict[str, jax.Array]:
        """Read the arrays that auxiliary tasks stored for transitions, by task: [B, ...]."""
        return {name: unpack(array[indices.episode, indices.time]) for name, array in state.episodes.stored.items()}


def make_replay(transitions: int, num_envs: int, horizon: int, frame_stack: int = 1, mean_age: int | None = None) -> Replay:
    """Plan a replay of at least ``transitions`` transitions, rounded up to whole rollouts, without allocating it.

    Args:
        transitions: Minimum number of transitions to hold.
        num_envs: E, number of episodes in a rollout.
        horizon: T, number of control steps in an episode.
        frame_stack: F, number of images that an observation stacks.
        mean_age: Mean age of samples in transitions; None for uniform sampling.
    """
    of_rollout = num_envs * horizon
    in_rollouts = None if mean_age is None else mean_age / of_rollout
    return Replay(max(1, math.ceil(transitions / of_rollout)), num_envs, horizon, frame_stack, in_rollouts)


def num_bytes(spec: ReplayState) -> int:
    """Return the size in bytes of a replay with this spec."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(spec))
