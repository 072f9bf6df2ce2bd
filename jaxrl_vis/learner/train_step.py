"""One training iteration, for one or several seeds, as one compiled program (`parts`: as two).

    key = fold_in(seed's key, iteration)
    rollout     reset, then scan over T: act, advance, observe            -> E episodes
    insert      one contiguous slice of the replay; observation statistics
    updates     scan over U: sample, relabel, reward, gradient step, target networks
    metrics     fixed-shape means

`vmap` over the seeds' axis makes it train several learners at once. The loop state is donated, so the replay is written where
it lies. On several devices (`sharding`) each runs all of this on its part of the seeds, or of one learner.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis.config import Config
from jaxrl_vis.learner import normalizer
from jaxrl_vis.learner.auxiliary import Auxiliary, make_auxiliary
from jaxrl_vis.learner.ddpg import Algorithm, Prepared, Working, make_ddpg
from jaxrl_vis.learner.evaluate import make_evaluate
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.learner.parts import Parts, make_parts
from jaxrl_vis.learner.replay import Replay, make_replay, num_bytes
from jaxrl_vis.learner.rollout import Exploration, play
from jaxrl_vis.learner.sampling import Choice, Sampler
from jaxrl_vis.learner.sharding import Layout, make_layout
from jaxrl_vis.learner.shards import Shards
from jaxrl_vis.resolved import Resolved, resolve
from jaxrl_vis.types import Episodes, LoopState, Metrics, ReplayState, TrainState
from jaxrl_vis.validation import validate
from jaxrl_vis_envs.base import GoalEnv

# A leading seed axis on everything but the iteration, which all seeds share (see `replay`).
_SEED_AXES = LoopState(train=0, replay=0, key=0, iteration=None)  # type: ignore[arg-type]

# Folded into an iteration's key for what draws statistics. Large, because small numbers give the keys of `jax.random.split`.
_STATISTICS = 0x73656E


@dataclasses.dataclass(frozen=True)
class TrainStep:
    """The compiled program of a run and what belongs to it; see `make_train_step`.

    Attributes:
        env, config, resolved, networks, auxiliary: What it was made of.
        replay: The sizes of one device's part of a learner's replay.
        layout: Where seeds and the parts of learners lie; all functions below take and return arrays that lie there.
        init: keys [S] -> LoopState.
        train_iteration: LoopState (donated) -> (LoopState, metrics of [S] float32).
        evaluate: See `evaluate.make_evaluate`.
        rollout, insert, update_many: The parts of an iteration as programs of their own, for whoever wants to time them:
            (TrainState, keys [S]) -> (Episodes, outcome);
            (TrainState, ReplayState, Episodes, keys [S], iteration) -> (TrainState, ReplayState), the first two donated;
            (TrainState, ReplayState, keys [S], iteration) -> (TrainState, metrics) after ``updates_per_iteration`` steps, the
            first donated.
        parts: The same iteration in two programs, as runs compute it (`jaxrl_vis.learner.parts`).
    """

    env: GoalEnv
    config: Config
    resolved: Resolved
    networks: Networks
    auxiliary: Auxiliary
    replay: Replay
    layout: Layout
    init: Any
    train_iteration: Any
    evaluate: Any
    rollout: Any
    insert: Any
    update_many: Any
    parts: Parts | None

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one seed in an iteration."""
        return self.config.num_envs * self.env.horizon

    @property
    def updates_per_iteration(self) -> int:
        """Gradient steps of one seed in an iteration."""
        return self.config.updates_per_iteration

    @property
    def num_iterations(self) -> int:
        """Iterations that `Config.env_steps` takes."""
        return math.ceil(self.config.env_steps / self.steps_per_iteration)

    @property
    def replay_spec(self) -> ReplayState:
        """Shapes of one seed's replay, or of one device's part of it, without allocating it."""
        sizes = self.env.observation_spec, self.env.goal_state_size, self.env.action_size
        return self.replay.spec(*sizes, with_flow=self.auxiliary.keeps_flow)

    @property
    def replay_bytes(self) -> int:
        """Bytes of one seed's replay."""
        return num_bytes(self.replay_spec) * self.layout.shards.count


def _mean(values: list[jax.Array]) -> jax.Array:
    return functools.reduce(jnp.add, values) / len(values)


def _make_update_many(config: Config, sampler: Sampler, algorithm: Algorithm):
    interval = config.actor_interval

    def update_many(train: TrainState, replay: ReplayState, key: jax.Array, iteration: jax.Array) -> tuple[TrainState, Metrics]:
        names: list[str] = []

        def updates(state: tuple[Working, Prepared], following: Choice) -> tuple[tuple[Working, Prepared], jax.Array]:
            """Updates of which the last one is the actor's, too; unrolled, so that the loop's body has no conditional.

            Each has its batch already, and reads and prepares the next one. A GPU does that while it computes; with its own
            batch it would have to begin with it.
            """
            (working, prepared), found = state, []
            for number in range(interval):
                coming = read(working, jax.tree.map(lambda leaf, number=number: leaf[number], following))
                gradients, metrics = algorithm.gradients(working, prepared, number == interval - 1)
                working, prepared = algorithm.apply(working, gradients), coming
                found.append(metrics)
            names[:] = found[-1]
            # As one vector, because writing each number by itself would be a kernel each.
            metrics = jnp.stack([_mean([each[name] for each in found if name in each]) for name in names])
            return (working, prepared), metrics

        def read(working: Working, choice: Choice) -> Prepared:
            return algorithm.prepare(working, sampler.batch(replay, choice))

        # What all updates learn from is chosen at once: in the loop, drawing numbers would be a dozen tiny kernels an update.
        keys = jax.random.split(key, config.updates_per_iteration)
        choices = jax.vmap(lambda update_key: sampler.choose(replay, update_key, iteration))(keys)
        working = algorithm.begin(train)
        prepared = read(working, jax.tree.map(lambda leaf: leaf[0], choices))
        # After the last one comes the first one again, for nobody.
        following = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, axis=0).reshape(-1, interval, *leaf.shape[1:]), choices)
        (working, _), metrics = jax.lax.scan(updates, (working, prepared), following)
        return algorithm.end(working), dict(zip(names, jnp.mean(metrics, axis=0), strict=True))

    return update_many


def _see(train: TrainState, episodes: Episodes, key: jax.Array, config: Config, sampler: Sampler) -> TrainState:
    """Takes the observations of a rollout into the statistics that observations are normalised with."""
    if config.normalizer_source == "rollouts":
        seen, goals = episodes.observations, episodes.observations[:, -1:]
        if train.goal_normalizer is not None:
            seen = seen[:, :-1]
        axes = (0, 1)
    else:  # as the authors' release: as many transitions as the rollout has, relabelled
        count = config.num_envs * sampler.replay.horizon
        latest = sampler.replay._replace(num_rollouts=1, mean_age=None)
        sampler = dataclasses.replace(sampler, config=config.replace(batch_size=count), replay=latest)
        rollout = latest.of_rollout(episodes)
        batch = sampler.batch(rollout, sampler.choose(rollout, key, jnp.zeros((), jnp.int32)))
        seen, goals = batch.observation_t, batch.goal
        if train.goal_normalizer is None:
            seen = jnp.concatenate([seen, goals])
        axes = (0,)
    train = train.replace(normalizer=normalizer.update(train.normalizer, seen, axes, sampler.shards))
    if train.goal_normalizer is None:
        return train
    return train.replace(goal_normalizer=normalizer.update(train.goal_normalizer, goals, axes, sampler.shards))


def _make_insert(config: Config, sampler: Sampler, auxiliary: Auxiliary) -> Callable:
    """What takes a rollout of one seed into its replay and its statistics."""

    def insert(
        train: TrainState, replay_state: ReplayState, episodes: Episodes, key: jax.Array, iteration: jax.Array
    ) -> tuple[TrainState, ReplayState]:
        episodes = auxiliary.with_flow(episodes)
        replay_state = sampler.replay.insert(replay_state, episodes, iteration)
        return _see(train, episodes, jax.random.fold_in(key, _STATISTICS), config, sampler), replay_state

    return insert


def _make_learn(insert: Callable, update_many: Callable, algorithm: Algorithm, shards: Shards) -> Callable:
    """What comes after a rollout of one seed: insertion, updates, metrics."""

    def learn(loop: LoopState, episodes: Episodes, outcome: Metrics, key: jax.Array) -> tuple[LoopState, Metrics]:
        train, replay_state = insert(loop.train, loop.replay, episodes, key, loop.iteration)
        train, metrics = update_many(train, replay_state, key, loop.iteration)
        found = {f"train/{name}": jnp.mean(values) for name, values in outcome.items()}
        found["train/value_at_goals"] = algorithm.value_at_goals(train, episodes.observations[:, -1])
        metrics |= shards.mean(found)
        metrics["guard/nonfinite"] = shards.total(_count_nonfinite((metrics, episodes.states, episodes.actions)))
        return LoopState(train=train, replay=replay_state, key=loop.key, iteration=loop.iteration + 1), metrics

    return learn


def _keys_of(keys: jax.Array, iteration: jax.Array) -> jax.Array:
    """Keys [S] of the seeds -> [2, S]: of an iteration's rollout, and of what comes after it."""
    return jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, iteration)), out_axes=1)(keys)


def _count_nonfinite(tree: Any) -> jax.Array:
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return sum((jnp.sum(~jnp.isfinite(leaf)) for leaf in floats), jnp.zeros((), jnp.int32)).astype(jnp.float32)


def _jitted(
    layout: Layout, init: Callable, train_iteration: Callable, rollout: Callable, insert: Callable, update_many: Callable
) -> dict[str, Any]:
    """The functions of one device's part as programs of all devices, by name."""
    seeds, environments, whole = layout.by_seed, layout.by_environment, layout.everywhere
    loop, replay = layout.loop, layout.replay
    spread = functools.partial(layout.spread, jit=jaxrl_vis_envs.jit)
    return {
        "init": spread(init, (seeds,), loop, runs_once=True),
        "train_iteration": spread(
            train_iteration, (loop,), (loop, seeds), kept_as=(loop, layout.read_by_host), donate_argnums=0
        ),
        "rollout": spread(rollout, (seeds, seeds), (environments, environments)),
        "insert": spread(insert, (seeds, replay, environments, seeds, whole), (seeds, replay), donate_argnums=(0, 1)),
        "update_many": spread(update_many, (seeds, replay, seeds, whole), (seeds, seeds), donate_argnums=0),
    }


def _jitted_evaluate(layout: Layout, evaluate: Callable) -> Any:
    in_specs, out_specs = (layout.by_seed, layout.everywhere), (layout.by_seed, layout.by_environment)
    kept_as = (layout.read_by_host, layout.read_by_host) if jax.process_count() > 1 else None
    return layout.spread(evaluate, in_specs, out_specs, jaxrl_vis_envs.jit, kept_as)


def make_train_step(env: GoalEnv, config: Config, layout: Layout | None = None) -> TrainStep:
    """Builds the program of a run. Nothing is compiled or allocated yet.

    Args:
        env: The environment.
        config: The run; what belongs to the environment is taken from ``env``.
        layout: Where it runs; None: as ``config`` says.

    Raises:
        RequestError: The configuration asks for something that cannot be.
    """
    resolved = resolve(validate(config), env.horizon)
    layout = make_layout(config) if layout is None else layout
    shards = layout.shards
    networks = Networks(config, env.observation_spec, env.action_size, resolved.critic_output_bias)
    auxiliary = make_auxiliary(config, env.observation_spec, env.action_size, env.frame_stack, networks.dtype)
    algorithm = make_ddpg(networks, config, resolved, auxiliary, shards)
    stacked = env.frame_stack if networks.sees_images else 1
    replay = make_replay(config.replay_transitions, config.num_envs, env.horizon, stacked, config.replay_mean_age)
    replay = replay._replace(num_envs=config.num_envs // shards.count)
    replay_spec = replay.spec(env.observation_spec, env.goal_state_size, env.action_size, auxiliary.keeps_flow)
    sampler = Sampler(config, resolved, replay, env.threshold, env.as_goal if stacked > 1 else None, auxiliary, shards)
    insert = _make_insert(config, sampler, auxiliary)
    update_many = _make_update_many(config, sampler, algorithm)
    learn = _make_learn(insert, update_many, algorithm, shards)
    exploration = Exploration(config.random_action_probability, config.action_noise)

    def init_seeds(keys: jax.Array) -> LoopState:
        # Of all seeds at once. Those of one seed, repeated under `vmap`, would lie in memory beside them.
        empty = jax.tree.map(lambda leaf: jnp.zeros((len(keys), *leaf.shape), leaf.dtype), replay_spec)
        return LoopState(
            train=jax.vmap(algorithm.init)(keys),
            replay=layout.folded(empty, replay.num_envs),
            key=keys,
            iteration=jnp.zeros((), jnp.int32),
        )

    def rollout(train: TrainState, keys: jax.Array) -> tuple[Episodes, Metrics]:
        episodes, outcome, _ = play(env, networks, train, keys, config.num_envs, exploration, shards=shards)
        return episodes, outcome

    def insert_seeds(
        train: TrainState, replay_state: ReplayState, episodes: Episodes, keys: jax.Array, iteration: jax.Array
    ) -> tuple[TrainState, ReplayState]:
        insert_each = jax.vmap(insert, (0, 0, 0, 0, None))
        train, replay_state = insert_each(train, layout.unfolded(replay_state), episodes, keys, iteration)
        return train, layout.folded(replay_state, replay.num_envs)

    def update_seeds(
        train: TrainState, replay_state: ReplayState, keys: jax.Array, iteration: jax.Array
    ) -> tuple[TrainState, Metrics]:
        return jax.vmap(update_many, (0, 0, 0, None))(train, layout.unfolded(replay_state), keys, iteration)

    learn_each = jax.vmap(learn, (_SEED_AXES, 0, 0, 0), (_SEED_AXES, 0))

    def learn_seeds(loop: LoopState, episodes: Episodes, outcome: Metrics, keys: jax.Array) -> tuple[LoopState, Metrics]:
        loop, metrics = learn_each(loop.replace(replay=layout.unfolded(loop.replay)), episodes, outcome, keys)
        return loop.replace(replay=layout.folded(loop.replay, replay.num_envs)), metrics

    def train_iteration(loop: LoopState) -> tuple[LoopState, Metrics]:
        keys = _keys_of(loop.key, loop.iteration)
        episodes, outcome = rollout(loop.train, keys[0])
        return learn_seeds(loop, episodes, outcome, keys[1])

    return TrainStep(
        env=env,
        config=config,
        resolved=resolved,
        networks=networks,
        auxiliary=auxiliary,
        replay=replay,
        layout=layout,
        **_jitted(layout, init_seeds, train_iteration, rollout, insert_seeds, update_seeds),
        evaluate=_jitted_evaluate(layout, make_evaluate(env, networks, config, shards)),
        parts=make_parts(env, networks, config, layout, _keys_of, learn_seeds),
    )
