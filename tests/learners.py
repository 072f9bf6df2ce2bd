"""Learners for tests, of many configurations; functions that do not depend on their differences are compiled once."""

import functools

import jax
import jax.numpy as jnp
import probe_environments as probes

import jaxrl_vis_envs
from jaxrl_vis.config import preset
from jaxrl_vis.learner.acting.rollout_parts import join_parts
from jaxrl_vis.learner.train_step import make_train_step

# Fields that only gradient steps and evaluations read. (`normalizer_source` can make insertion relabel, too.)
_LATER = ("updates_per_iteration", "batch_size", "n_step", "target_decay", "target_update_interval", "actor_interval") + (
    *("actor_learning_rate", "relabel_probability", "trivial_goals", "action_penalty", "random_shift", "eval_episodes"),
    *("reward_noise", "reward_false_positives", "reward_false_negatives", "reward_clutter"),
)
# Those that a rollout reads, but not a fresh learner: what rewards mean for one, `critic_output_bias` says.
_NOT_AT_FIRST = ("normalizer_source", "normalizer_floor", "reward_positive", "reward_negative", "observation_noise")

_compiled = {}


def _without(config, fields):
    plain = preset("debug")
    return config.replace(**{field: plain.value(field) for field in fields})


def begin(program, keys):
    """Return the result of ``program.init`` for typed keys [S]; programs with the same initialisation share a compiled one."""
    env, start = program.env, _without(program.config, (*_LATER, *_NOT_AT_FIRST))
    of_env = str(env.observation_spec), env.goal_state_size, env.action_size, env.horizon
    return _compiled.setdefault(("init", start, of_env, program.resolved.critic_output_bias), program.init)(keys)


def _parts(program, play, train, keys):
    firsts = range(0, program.config.run.num_envs, program.part_size)
    return [play(train, keys, jnp.int32(first), program.exploration) for first in firsts]


def rollout(program, train, keys):
    """Return episodes [S, E, ...] and outcome of a training rollout with typed keys [S]."""
    parts = _parts(program, program.play, train, keys)
    return jax.tree.map(lambda *leaves: join_parts(leaves, program.config.run.num_envs, axis=1), *parts)


def train_iteration(program, loop):
    """Train for one iteration as `Programs.train_iteration` does, compiling functions when called; ``loop`` is donated."""
    return program.learn(loop, _parts(program, program.play, loop.train, program.keys(loop.key, loop.iteration)))


def update_arguments(program, key):
    """Return arguments for ``program.update_many`` after one rollout; programs that differ only in updates share its code."""
    assert program.config.study.normalizer_source == "rollouts"
    what = type(program.env), _without(program.config, _LATER)
    loop, keys = begin(program, key[None]), key[None]
    play = _compiled.setdefault(("play", *what), program.play)
    parts = _parts(program, play, loop.train, keys)
    episodes, _ = jax.tree.map(lambda *leaves: join_parts(leaves, program.config.run.num_envs, axis=1), *parts)
    insert = _compiled.setdefault(("insert", *what), program.insert)
    return *insert(loop.train, loop.replay, episodes, keys, loop.iteration), keys, loop.iteration


class OneOf(probes.Probe):
    """Environment that is one of several probes of equal sizes, selected by the traced index ``chosen``."""

    def __init__(self, several, chosen):
        self.several, self.chosen = several, chosen

    def start(self, key):
        return jax.lax.switch(self.chosen, [probe.start for probe in self.several], key)

    def move(self, position, action):
        return jax.lax.switch(self.chosen, [probe.move for probe in self.several], position, action)


@functools.cache
def iteration_of_one(several, config):
    """Return a function (index of the probe, LoopState) -> `train_iteration`, compiled once for several probes."""

    def iterate(chosen, loop):
        program = make_train_step(OneOf(several, chosen), config)
        keys = program.keys.__wrapped__(loop.key, loop.iteration)
        return program.learn.__wrapped__(loop, _parts(program, program.play.__wrapped__, loop.train, keys))

    compiled = jaxrl_vis_envs.jit(iterate, donate_argnums=1)
    return lambda chosen, loop: compiled(jnp.int32(chosen), loop)
