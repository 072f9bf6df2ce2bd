"""One training iteration, for one or several seeds, as one compiled program.

    key = fold_in(seed's key, iteration)
    rollout     reset, then scan over T: act, advance, observe            -> E episodes
    insert      one contiguous slice of the replay; observation statistics
    updates     scan over U: sample, relabel, reward, gradient step, target networks
    metrics     fixed-shape means

`vmap` over the seeds' axis makes it train several learners at once. The loop state is donated, so the replay is written where
it lies.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis.config import Config, Resolved, resolve, validate
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner import normalizer
from jaxrl_vis.learner.ddpg import Algorithm, Working, make_ddpg
from jaxrl_vis.learner.networks import Networks
from jaxrl_vis.learner.relabel import choose_goal_slots, stand_still
from jaxrl_vis.learner.replay import Indices, Replay, make_replay, num_bytes
from jaxrl_vis.learner.rollout import Exploration, play
from jaxrl_vis.types import Batch, Episodes, LoopState, Metrics, ReplayState, TrainState
from jaxrl_vis_envs import goals
from jaxrl_vis_envs.base import GoalEnv
from jaxrl_vis_envs.compilation import env_jit
from jaxrl_vis_envs.randomization import typical
from jaxrl_vis_envs.registry import config_class

# A leading seed axis on everything but the iteration, which all seeds share (see `replay`).
_SEED_AXES = LoopState(train=0, replay=0, key=0, iteration=None)  # type: ignore[arg-type]

# Episodes of an evaluation whose images are handed back, for videos.
_NUM_RECORDED = 8


def make_env(config: Config) -> GoalEnv:
    """The task that a configuration asks for.

    Raises:
        RequestError: There is no such task, or it cannot be made like that.
    """
    validate(config)
    try:
        fields = {field.name for field in dataclasses.fields(config_class(config.env))}
        settings: dict[str, Any] = {name: getattr(config, name) for name in ("image_size", "pixels") if name in fields}
        if config.frame_stack is not None:
            settings["frame_stack"] = config.frame_stack
        if config.randomize:
            settings["randomization"] = typical(*config.randomize, strength=config.randomize_strength)
        return jaxrl_vis_envs.make(config.env, **settings)
    except ValueError as error:
        raise RequestError(str(error)) from error


@dataclasses.dataclass(frozen=True)
class TrainStep:
    """The compiled program of a run and what belongs to it; see `make_train_step`.

    Attributes:
        env, config, resolved, networks, replay: What it was made of.
        init: keys [S] -> LoopState.
        train_iteration: LoopState (donated) -> (LoopState, metrics of [S] float32).
        evaluate: (TrainState [S, ...], key) -> (metrics of [S] float32, recording [S, K, ...]), without noise. All seeds play
            the same episodes, and of the first K each frame is handed back, so that no video needs a program of its own.
        update_many: (TrainState, ReplayState, key, iteration) of one seed -> the same after ``updates_per_iteration`` steps.
    """

    env: GoalEnv
    config: Config
    resolved: Resolved
    networks: Networks
    replay: Replay
    init: Any
    train_iteration: Any
    evaluate: Any
    update_many: Any

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
        """Shapes of one seed's replay, without allocating it."""
        return self.replay.spec(self.env.observation_spec, self.env.goal_state_size, self.env.action_size)

    @property
    def replay_bytes(self) -> int:
        """Bytes of one seed's replay."""
        return num_bytes(self.replay_spec)


def reward_of(
    config: Config, resolved: Resolved, threshold: float, batch: Batch, reached: jax.Array | None = None
) -> jax.Array:
    """Rewards [B] float32 of relabelled transitions, by the same functions that score the environments.

    Args:
        config: Which reward.
        resolved: Its two values.
        threshold: Of the oracle's reward, in the unit of the true states.
        batch: The transitions.
        reached: [B, ...] what they have reached, as a goal would show it; None: as it was observed.
    """
    values = {"positive": resolved.reward_positive, "negative": resolved.reward_negative}
    if config.method == "oracle":
        return goals.oracle_reward(batch.state_tp1, batch.goal_state, threshold, **values)
    return goals.indicator_reward(batch.observation_tp1 if reached is None else reached, batch.goal, **values)


def _make_update_many(config: Config, resolved: Resolved, env: GoalEnv, replay: Replay, algorithm: Algorithm):
    def update_many(train: TrainState, memory: ReplayState, key: jax.Array, iteration: jax.Array) -> tuple[TrainState, Metrics]:
        def choose(update_key: jax.Array) -> tuple[Indices, jax.Array]:
            sample_key, goal_key = jax.random.split(update_key)
            indices = replay.sample_indices(memory, sample_key, iteration, config.batch_size)
            relabel, balance = config.relabel_probability, resolved.balance_probability
            return indices, choose_goal_slots(goal_key, indices.time, env.horizon, relabel, balance)

        def one_update(carry: tuple[TrainState, Working], chosen: tuple[Indices, jax.Array]) -> tuple[Any, Metrics]:
            batch, reached = replay.gather(memory, *chosen), None
            if env.frame_stack > 1:
                batch, reached = stand_still(batch, env.as_goal)
            reward = reward_of(config, resolved, env.threshold, batch, reached)
            train, working, metrics = algorithm.update(*carry, batch, reward)
            return (train, working), metrics

        # What all updates learn from is chosen at once: in the loop, drawing numbers would be a dozen tiny kernels an update.
        chosen = jax.vmap(choose)(jax.random.split(key, config.updates_per_iteration))
        (train, _), metrics = jax.lax.scan(one_update, (train, algorithm.working(train)), chosen)
        return train, jax.tree.map(jnp.mean, metrics)

    return update_many


def _count_nonfinite(tree: Any) -> jax.Array:
    floats = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return sum((jnp.sum(~jnp.isfinite(leaf)) for leaf in floats), jnp.zeros((), jnp.int32)).astype(jnp.float32)


def make_train_step(env: GoalEnv, config: Config) -> TrainStep:
    """Builds the program of a run. Nothing is compiled or allocated yet.

    Raises:
        RequestError: The configuration asks for something that cannot be.
    """
    resolved = resolve(validate(config), env.horizon)
    networks = Networks(config, env.observation_spec, env.action_size, resolved.critic_output_bias)
    if config.method != "oracle" and not networks.sees_images:
        raise RequestError(f"method {config.method} compares images: use --env Visual{config.env}, or --method oracle")
    algorithm = make_ddpg(networks, config, resolved)
    replay = make_replay(config.replay_transitions, config.num_envs, env.horizon)
    update_many = _make_update_many(config, resolved, env, replay, algorithm)

    def init(key: jax.Array) -> LoopState:
        return LoopState(
            train=algorithm.init(key),
            replay=replay.init(env.observation_spec, env.goal_state_size, env.action_size),
            key=key,
            iteration=jnp.zeros((), jnp.int32),
        )

    def per_seed(function, in_axes: Any = 0, out_axes: Any = 0):
        return jax.vmap(function, in_axes=in_axes, out_axes=out_axes)

    def train_iteration(loop: LoopState) -> tuple[LoopState, Metrics]:
        keys = per_seed(lambda key: jax.random.split(jax.random.fold_in(key, loop.iteration)), out_axes=1)(loop.key)
        exploration = Exploration(config.random_action_probability, config.action_noise)
        episodes, outcome = play(env, networks, loop.train, keys[0], config.num_envs, exploration)
        return per_seed(learn, (_SEED_AXES, 0, 0, 0), (_SEED_AXES, 0))(loop, episodes, outcome, keys[1])

    def learn(loop: LoopState, episodes: Episodes, outcome: Metrics, key: jax.Array) -> tuple[LoopState, Metrics]:
        memory = replay.insert(loop.replay, episodes, loop.iteration)
        train = loop.train.replace(normalizer=normalizer.update(loop.train.normalizer, episodes.frames))
        train, metrics = update_many(train, memory, key, loop.iteration)
        metrics |= {f"train/{name}": jnp.mean(values) for name, values in outcome.items()}
        metrics["guard/nonfinite"] = _count_nonfinite((metrics, episodes.states, episodes.actions))
        return LoopState(train=train, replay=memory, key=loop.key, iteration=loop.iteration + 1), metrics

    def evaluate(train: TrainState, key: jax.Array) -> tuple[Metrics, dict[str, jax.Array]]:
        num_recorded = min(_NUM_RECORDED, config.eval_episodes)
        keys = jnp.broadcast_to(key, (jax.tree.leaves(train)[0].shape[0],))
        episodes, outcome = play(env, networks, train, keys, config.eval_episodes, num_kept=num_recorded)
        # For people, the newest of stacked images, which come first.
        newest = episodes.frames
        if env.frame_stack > 1:
            newest = newest[:, :, :, : newest.shape[3] // env.frame_stack]
        frames, goals = newest[:, :, :-1], newest[:, :, -1]
        metrics = {
            "eval/success": jnp.mean(outcome["success"], axis=1),
            "eval/goal_distance": jnp.mean(outcome["goal_distance"], axis=1),
            "eval/goal_distance_median": jnp.median(outcome["goal_distance"], axis=1),
        }
        return metrics, {"frames": frames, "goals": goals, "success": outcome["success"][:, :num_recorded]}

    return TrainStep(
        env=env,
        config=config,
        resolved=resolved,
        networks=networks,
        replay=replay,
        init=env_jit(per_seed(init, out_axes=_SEED_AXES), runs_once=True),
        train_iteration=env_jit(train_iteration, donate_argnums=0),
        evaluate=env_jit(evaluate),
        update_many=env_jit(per_seed(update_many, (0, 0, 0, None)), donate_argnums=0),
    )
