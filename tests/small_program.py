"""Real programs of the smallest preset, created once per process: the first test that trains with one traces it."""

import collections
import dataclasses
import functools

import jaxrl_vis_envs
from jaxrl_vis.config import HOST, Config, marked
from jaxrl_vis.learner import train_step
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.learner.train_step import JIT_OPTIONS
from jaxrl_vis_envs.base import GoalEnv

_TRACES: collections.Counter[Config] = collections.Counter()


def _trained_alike(config: Config) -> Config:
    defaults = Config()
    return config.replace(**{name: defaults.value(name) for name in marked(HOST)})


@functools.cache
def _program_of(config: Config, task: type[GoalEnv]) -> train_step.TrainStep:
    """Create the program of a configuration; ``task`` tells apart what tests register under one name."""
    program = train_step.make_train_step(make_env(config), config)
    original = program.learn.__wrapped__

    def learn(loop, parts):  # of the same name, so that what another process has compiled is found
        _TRACES[config] += 1
        return original(loop, parts)

    return dataclasses.replace(program, learn=jaxrl_vis_envs.jit(learn, **JIT_OPTIONS["learn"]))


def make_train_step(env: GoalEnv, config: Config, policy_alone: bool = False) -> train_step.TrainStep:
    """Replacement for `train_step.make_train_step` that reuses the functions of an earlier equal configuration."""
    if policy_alone:
        return train_step.make_train_step(env, config, policy_alone=True)
    return dataclasses.replace(_program_of(_trained_alike(config), type(env)), config=config)


def traces(config: Config) -> int:
    """Return the number of times that this process has traced `learn` of a configuration."""
    return _TRACES[_trained_alike(config)]
