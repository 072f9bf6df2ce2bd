"""One training iteration, for one or several seeds, as compiled programs that are called in turn.

    keys        random keys of this iteration's rollout, derived from fold_in(key of the seed, iteration)
    play        reset, then scan over T: act, advance, observe            -> episodes of all environments or of one part
    learn       replay, statistics, gradient steps, metrics (`iteration`)

XLA compiles `play` and `learn` in parallel, and splitting them costs nothing: episodes are in the device's memory in either
case, and neither program waits for the host. `vmap` over the seed axis trains several learners at once. The loop state is
donated to `learn`, so the replay is updated in place. On several devices (`sharding`) each runs all of this on its part of the
seeds, or of one learner.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis.config import Config, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.plugins import build_component, find_component
from jaxrl_vis.learner import contrastive, td3
from jaxrl_vis.learner import iteration as iterations
from jaxrl_vis.learner.acting.evaluate import Evaluation, make_evaluate
from jaxrl_vis.learner.acting.rollout import Acting, Exploration, play
from jaxrl_vis.learner.acting.rollout_parts import PartResult, RolloutPart, part_result_spec, part_size
from jaxrl_vis.learner.algorithm import Algorithm, Setup
from jaxrl_vis.learner.auxtasks.auxiliary import Auxiliary, make_auxiliary
from jaxrl_vis.learner.ddpg import ddpg
from jaxrl_vis.learner.iteration import Insert, Learned, Update
from jaxrl_vis.learner.memory.replay import Replay, make_replay, num_bytes
from jaxrl_vis.learner.memory.sampling import Sampler
from jaxrl_vis.learner.networks import normalizer
from jaxrl_vis.learner.networks.networks import Networks, compute_dtype
from jaxrl_vis.learner.parallel.sharding import Layout, make_layout
from jaxrl_vis.learner.resolved import Resolved, resolve
from jaxrl_vis.types import Episodes, LoopState, Metrics, ReplayState, Statistics, TrainState
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.compiling.compilation import targets_cpu, tracing_for_default_device
from jaxrl_vis_envs.goals import object_mask

JIT_OPTIONS: dict[str, dict[str, Any]] = {"init": {"runs_once": True}, "learn": {"donate_argnums": 0}}
"""Further arguments of `jaxrl_vis_envs.jit`, by program."""

ALGORITHMS: dict[str, Callable[[Setup], Algorithm]] = dict(ddpg=ddpg.make, td3=td3.make, contrastive=contrastive.make)
"""Constructors of the built-in algorithms, by name."""

# A leading seed axis on everything but the iteration, which all seeds share (see `replay`).
_SEED_AXES = LoopState(train=0, replay=0, key=0, iteration=None)  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True)
class TrainStep:
    """Programs of a run, jitted but not yet compiled, and their ingredients; see `make_train_step`.

    Attributes:
        env, config, resolved, acting, auxiliary: Components from which the programs were built.
        replay: Sizes of one device's part of a learner's replay.
        replay_spec: Shapes and dtypes of this part; nothing is allocated.
        layout: Placement of seeds and shards; all programs take and return arrays with this placement.
        exploration: Exploration noise of training; evaluations have none.
        plays_parts: True if ``play`` can start at any environment, and thus also evaluate; otherwise it runs a whole rollout.
        part_size: P, number of each learner's environments that one call of ``play`` steps, on all devices together.
        init: keys [S] -> LoopState.
        keys: (keys [S], iteration []) -> keys [S] of this iteration's rollout.
        play: (TrainState, keys [S], number [] int32 of the first environment, `Exploration`) -> `PartResult`.
        learn: (LoopState, donated; parts of the rollout in their order) -> `Learned`.
        evaluate: See `evaluate.make_evaluate`.
        pure_insert, pure_update: The components of ``learn``, for one learner, not jitted.
    """

    env: GoalEnv
    config: Config
    resolved: Resolved
    acting: Acting
    auxiliary: Auxiliary
    replay: Replay
    replay_spec: ReplayState
    layout: Layout
    exploration: Exploration
    plays_parts: bool
    part_size: int
    init: Any
    keys: Any
    play: Any
    learn: Any
    evaluate: Any
    pure_insert: Insert
    pure_update: Update

    @property
    def algorithm(self) -> Algorithm:
        """Algorithm whose agents act and learn."""
        return self.acting.algorithm

    @property
    def networks(self) -> Networks:
        """Networks of the algorithm, for tools that inspect them; None if it has none."""
        return self.algorithm.networks

    @property
    def steps_per_iteration(self) -> int:
        """Number of environment steps per seed and iteration."""
        return self.config.run.num_envs * self.env.horizon

    @property
    def updates_per_iteration(self) -> int:
        """Number of gradient steps per seed and iteration."""
        return self.config.run.updates_per_iteration

    @property
    def num_iterations(self) -> int:
        """Number of iterations needed for the configured ``env_steps``."""
        return math.ceil(self.config.run.env_steps / self.steps_per_iteration)

    @property
    def replay_bytes(self) -> int:
        """Size of one seed's replay in bytes."""
        return num_bytes(self.replay_spec) * self.layout.shards.count

    @property
    def parts_spec(self) -> list[PartResult]:
        """Shapes, dtypes and placement of the parts of a rollout, as `learn` takes them."""
        full_states = self.replay_spec.episodes.full_states
        full_state_size = 0 if full_states is None else full_states.shape[-1]
        spec = part_result_spec(self.env, self.part_size, self.config.run.seeds, full_state_size)
        spec = self.layout.with_shardings(spec, self.layout.by_environment)
        return [spec] * math.ceil(self.config.run.num_envs / self.part_size)

    @functools.cached_property
    def insert(self) -> Any:
        """First component of `learn` as a separate program, for timing.

        (TrainState, ReplayState, Episodes, keys [S], iteration) -> (TrainState, ReplayState), the first two donated.
        """
        layout = self.layout
        seeds, replay = layout.by_seed, layout.replay

        def insert(
            train: TrainState, replay_state: ReplayState, episodes: Episodes, key: jax.Array, iteration: jax.Array
        ) -> tuple[TrainState, ReplayState]:
            train, replay_state = self.pure_insert(train, layout.unfold_replay(replay_state), episodes, key, iteration)
            return train, layout.fold_replay(replay_state, self.replay.num_envs)

        return layout.spread(
            jax.vmap(insert, (0, 0, 0, 0, None)),
            (seeds, replay, layout.by_environment, seeds, layout.replicated),
            (seeds, replay),
            jaxrl_vis_envs.jit,
            donate_argnums=(0, 1),
        )

    @functools.cached_property
    def update_many(self) -> Any:
        """Second component of `learn` as a separate program, for timing.

        (TrainState, ReplayState, keys [S], iteration) -> (TrainState, metrics) after ``updates_per_iteration`` gradient steps,
        the first donated.
        """
        layout = self.layout
        seeds = layout.by_seed

        def update_many(
            train: TrainState, replay_state: ReplayState, key: jax.Array, iteration: jax.Array
        ) -> tuple[TrainState, Metrics]:
            return self.pure_update(train, layout.unfold_replay(replay_state), key, iteration)

        return layout.spread(
            jax.vmap(update_many, (0, 0, 0, None)),
            (seeds, layout.replay, seeds, layout.replicated),
            (seeds, seeds),
            jaxrl_vis_envs.jit,
            donate_argnums=0,
        )


def _object_mask(env: GoalEnv, config: Config, resolved: Resolved) -> Callable[[jax.Array], jax.Array] | None:
    """Return the function that reads the object's mask from images, for indicators; None if the environment marks no object.

    Raises:
        RequestError: No reward reads the mask, or noise hides it.
    """
    if not env.marks_object:
        return None
    reward = resolved.method.reward
    if reward not in ("indicator", "indicator_tolerance") and not callable(reward):
        raise RequestError(
            f"goal_mask=object is for indicator rewards, and this is --method {config.reward.method}: leave it out"
        )
    if config.environment.observation_noise:
        raise RequestError("goal_mask=object and observation_noise exclude each other: the mask is the lowest bit of an image")
    return object_mask


def _full_state_size(env: GoalEnv, config: Config) -> int:
    """Return the size of `Episodes.full_states`, 0 if the critic does not observe true states.

    Raises:
        RequestError: ``critic_states`` is set, but observations are states already, or the environment has no
            ``observe_state``.
    """
    if not config.ddpg.critic_states:
        return 0
    name = config.environment.env
    if len(env.observation_spec.shape) != 3:
        raise RequestError(f"critic_states is for images, and {name} observes states: leave it out")
    observe_state = getattr(env, "observe_state", None)
    if observe_state is None:
        raise RequestError(f"critic_states needs a task with observe_state, which {name} does not have: leave it out")
    return jax.eval_shape(lambda: observe_state(env.reset(jax.random.key(0)).data)).shape[0]


def make_train_step(env: GoalEnv, config: Config, layout: Layout | None = None, policy_alone: bool = False) -> TrainStep:
    """Build the programs of a run. Nothing is compiled or allocated yet.

    Args:
        env: The environment.
        config: Configuration of the run; properties of the environment are taken from ``env``.
        layout: Placement on devices; None for that of ``config``.
        policy_alone: Whether agents are policy parameters only (`Algorithm.of_policies`), for acting without training.

    Raises:
        RequestError: The configuration is invalid, or incompatible with the environment or the devices.
    """
    resolved = resolve(validate(config), env.horizon)
    layout = make_layout(config) if layout is None else layout
    shards = layout.shards
    auxiliary = make_auxiliary(config, env.observation_spec, env.action_size, env.frame_stack, compute_dtype(config))
    full_state_size = _full_state_size(env, config)
    critic_state_size = full_state_size + env.goal_state_size if full_state_size else 0
    setup = Setup(config, resolved, env.observation_spec, env.action_size, auxiliary, shards, critic_state_size)
    maker = find_component("algorithm", config.run.algorithm, ALGORITHMS, config.environment.env_folder)
    algorithm = build_component("algorithm", config.run.algorithm, maker, setup, expected_type=Algorithm)
    statistics = normalizer.init(env.observation_spec)
    unseen = Statistics(
        statistics,
        statistics if config.study.normalizers == "separate" else None,
        normalizer.init(jax.ShapeDtypeStruct((critic_state_size,), jnp.float32)) if critic_state_size else None,
    )
    if policy_alone:
        algorithm = algorithm.of_policies(unseen)
    observe_state: Any = getattr(env, "observe_state") if full_state_size and not policy_alone else None  # noqa: B009
    acting = Acting(env, algorithm, config.environment.observation_noise, observe_state)
    stacked = env.frame_stack if len(env.observation_spec.shape) == 3 else 1
    replay = make_replay(config.run.replay_transitions, config.run.num_envs, env.horizon, stacked, config.study.replay_mean_age)
    replay = replay._replace(num_envs=config.run.num_envs // shards.count)
    stored = auxiliary.stored_spec(env.observation_spec, env.horizon)
    replay_spec = replay.spec(env.observation_spec, env.goal_state_size, env.action_size, stored, full_state_size)
    as_goal, mask = env.as_goal if env.converts_goals else None, _object_mask(env, config, resolved)
    sampler = Sampler(config, resolved, replay, env.threshold, as_goal, auxiliary, shards, mask)
    insert = iterations.make_insert(config, sampler, auxiliary)
    with tracing_for_default_device():
        plays_parts = targets_cpu() and layout.mesh is None and shards.count == 1
    num_played = part_size(config.run.num_envs) if plays_parts else config.run.num_envs // shards.count

    def init_learner(key: jax.Array) -> TrainState:
        return TrainState(algorithm.init(key), *unseen)

    def init(keys: jax.Array) -> LoopState:
        # Allocate the replays of all seeds at once: under `vmap`, that of one seed would take memory in addition.
        empty = jax.tree.map(lambda leaf: jnp.zeros((len(keys), *leaf.shape), leaf.dtype), replay_spec)
        return LoopState(
            train=jax.vmap(init_learner)(keys),
            replay=jax.vmap(lambda replay_state: layout.fold_replay(replay_state, replay.num_envs))(empty),
            key=keys,
            iteration=jnp.zeros((), jnp.int32),
        )

    def rollout_keys(keys: jax.Array, iteration: jax.Array) -> jax.Array:
        return jax.vmap(lambda key: iterations.split_key(key, iteration)[0])(keys)

    def play_part(train: TrainState, keys: jax.Array, first: jax.Array, exploration: Exploration) -> PartResult:
        random_source = RolloutPart(first, config.run.num_envs) if plays_parts else shards
        episodes, outcome, _ = play(acting, train, keys, num_played, exploration, random_source=random_source)
        return episodes, outcome

    learn = iterations.make_learn(config, insert, algorithm, sampler, layout)
    seeds, environments, replicated = layout.by_seed, layout.by_environment, layout.replicated
    host = layout.host_spec

    def spread(name: str, function: Any, in_specs: tuple, out_specs: Any, final_specs: Any = None) -> Any:
        return layout.spread(function, in_specs, out_specs, jaxrl_vis_envs.jit, final_specs, **JIT_OPTIONS.get(name, {}))

    return TrainStep(
        env=env,
        config=config,
        resolved=resolved,
        acting=acting,
        auxiliary=auxiliary,
        replay=replay,
        replay_spec=replay_spec,
        layout=layout,
        exploration=Exploration(config.ddpg.random_action_probability, config.ddpg.action_noise),
        plays_parts=plays_parts,
        part_size=num_played * shards.count,
        init=spread("init", init, (seeds,), layout.loop),
        keys=spread("keys", rollout_keys, (seeds, replicated), seeds),
        play=spread("play", play_part, (seeds, seeds, replicated, replicated), (environments, environments)),
        learn=spread(
            "learn",
            jax.vmap(learn, (_SEED_AXES, 0), Learned(_SEED_AXES, 0)),  # type: ignore[arg-type]
            (layout.loop, environments),
            Learned(layout.loop, seeds),  # type: ignore[arg-type]
            final_specs=Learned(layout.loop, host),  # type: ignore[arg-type]
        ),
        evaluate=spread(
            "evaluate",
            make_evaluate(acting, config.run.eval_episodes, shards),
            (seeds, replicated),
            Evaluation(seeds, environments),  # type: ignore[arg-type]
            final_specs=Evaluation(host, host) if jax.process_count() > 1 else None,  # type: ignore[arg-type]
        ),
        pure_insert=insert,
        pure_update=iterations.make_update(config, sampler, algorithm),
    )
