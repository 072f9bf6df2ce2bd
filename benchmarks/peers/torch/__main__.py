"""Speed of gradient steps of our learner and of the same learner in PyTorch, on the same device and in the same call.

    python -m benchmarks.peers.torch [--env VisualFetchReach] [--preset paper] [--image-size 64] [--batch-size 512]

Needs PyTorch. Trivial goals and random shifts of images are off for both, because PyTorch's learner lacks them.
"""

import dataclasses
import sys
from collections.abc import Iterator

import jax
import jax.numpy as jnp

from benchmarks.peers import command
from benchmarks.peers.torch import comparison
from jaxrl_vis.bench import Measurement, Settings, update
from jaxrl_vis.learner.train_step import make_train_step

LEFT_OUT = {"random_shift": 0, "trivial_goals": 1.0}
"""Configuration fields that PyTorch's learner lacks, with the values that disable them."""


def measure(settings: Settings) -> Iterator[Measurement]:
    """Yield our gradient steps per second, then PyTorch's.

    Raises:
        RequestError: PyTorch is missing, or its learner lacks an option that is set.
        AssertionError: PyTorch's results differ from ours.
    """
    comparison.load()  # first, because it may be missing
    updates = update.updates_per_call(settings)
    preset = update.training_config(settings, updates_per_iteration=updates)
    config = update.training_config(settings, updates_per_iteration=updates, **LEFT_OUT)
    program = make_train_step(settings.make_env(), config)
    comparison.check_config(program)
    ours = update.measure_program(program, settings)
    if names := [name for name, value in LEFT_OUT.items() if preset.value(name) != value]:
        ours = dataclasses.replace(ours, config={**ours.config, "without": " ".join(names)})
    yield ours
    seeds = update.init_with_full_replay(program).replace(iteration=jnp.zeros(1, jnp.int32))
    loop = jax.tree.map(lambda leaf: leaf[0], seeds)
    yield comparison.measure(program, loop.train, loop.replay, settings.repeats, ours)


if __name__ == "__main__":
    names = ("env", "preset", "image_size", "pixels", "batch_size")
    sys.exit(command.run("update", measure, __doc__, names))
