"""Learners for tests, of many configurations: what these have in common is compiled once."""

import functools

import jax
import jax.numpy as jnp
import probe_environments as probes

import jaxrl_vis_envs
from jaxrl_vis.config import preset
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
    return config.replace(**{field: getattr(plain, field) for field in fields})


def begin(program, keys):
    """What ``program.init`` returns for typed keys [S]; programs that start alike share the compiled one."""
    env, start = program.env, _without(program.config, (*_LATER, *_NOT_AT_FIRST))
    of_env = str(env.observation_spec), env.goal_state_size, env.action_size, env.horizon
    return _compiled.setdefault(("init", start, of_env, program.resolved.critic_output_bias), program.init)(keys)


def experienced(program, key):
    """Arguments of ``program.update_many`` after one rollout, which programs share that differ in their updates only."""
    assert program.config.normalizer_source == "rollouts"
    what = type(program.env), _without(program.config, _LATER)
    loop, keys = begin(program, key[None]), key[None]
    episodes, _ = _compiled.setdefault(("rollout", *what), program.rollout)(loop.train, keys)
    insert = _compiled.setdefault(("insert", *what), program.insert)
    return *insert(loop.train, loop.replay, episodes, keys, loop.iteration), keys, loop.iteration


class OneOf(probes.Probe):
    """One of several probes of the same sizes, which a program is told when it runs."""

    def __init__(self, several, chosen):
        self.several, self.chosen = several, chosen

    def start(self, key):
        return jax.lax.switch(self.chosen, [probe.start for probe in self.several], key)

    def move(self, position, action):
        return jax.lax.switch(self.chosen, [probe.move for probe in self.several], position, action)


@functools.cache
def iteration_of_one(several, config):
    """(which one, LoopState) -> what ``train_iteration`` returns, in one of several probes: one program for all of them."""

    def iterate(chosen, loop):
        return make_train_step(OneOf(several, chosen), config).train_iteration.__wrapped__(loop)

    compiled = jaxrl_vis_envs.jit(iterate, donate_argnums=1)
    return lambda chosen, loop: compiled(jnp.int32(chosen), loop)
