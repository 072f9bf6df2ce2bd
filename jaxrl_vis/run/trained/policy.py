"""Trained policies as functions.

policy = load_policy("runs/mine")               # or the name of one that comes with the package
action = policy(observation, goal)              # one environment: planar [C, H, W] uint8, or [S] float32
actions = jax.vmap(policy)(observations, goals) # many
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import enable_compilation_cache
from jaxrl_vis.learner.algorithm import Algorithm, PolicyParams
from jaxrl_vis.run.storage.restoring import Restored
from jaxrl_vis.run.trained import policy_file
from jaxrl_vis.run.trained.restored_run import Choice, load, open_run
from jaxrl_vis.run.trained.shipped import find
from jaxrl_vis.run.trainer import Trainer
from jaxrl_vis_envs.base import GoalEnv


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """Trained actor without exploration, including normalisation, created by `load_policy`. Compatible with vmap and scan.

    Attributes:
        env: The environment of its training, with the image size and all other options of the run.
        config: The configuration of the run.
        seed: Seed of the run that trained it.
        iteration: Iteration of its checkpoint.
        parameters: Parameters of the policy, from `Algorithm.policy_params`.
        algorithm: The algorithm, whose ``act`` and ``encode_goal`` read them.
    """

    env: GoalEnv
    config: Config
    seed: int
    iteration: int
    parameters: PolicyParams = dataclasses.field(repr=False)
    algorithm: Algorithm = dataclasses.field(repr=False)

    @property
    def env_name(self) -> str:
        """Name of the environment, as in `jaxrl_vis_envs.make`."""
        return self.config.environment.env

    @functools.cached_property  # a state task traces its observation for it
    def observation_spec(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of an observation, and of a goal: [C, H, W] uint8 or [S] float32."""
        return self.env.observation_spec

    @property
    def action_size(self) -> int:
        """A, the size of an action."""
        return self.env.action_size

    def __call__(self, observation: Any, goal: Any) -> jax.Array:
        """Compute an action.

        Args:
            observation: Output of `GoalEnv.observe`: planar [C, H, W] uint8, or [S] float32 for state tasks.
            goal: ``obs["desired_goal"]``, in the same form.

        Returns:
            [A] float32 in [-1, 1].

        Raises:
            RequestError: A shape or a dtype does not match.
        """
        self._check("observation", observation)
        self._check("goal", goal)
        return self._act(self.parameters, observation, goal)

    @functools.cached_property
    def _act(self) -> Any:
        algorithm = self.algorithm

        def act(parameters: PolicyParams, observation: jax.Array, goal: jax.Array) -> jax.Array:
            observations, goals = (jnp.asarray(array, self.observation_spec.dtype)[None] for array in (observation, goal))
            return algorithm.act(parameters, observations, algorithm.encode_goal(parameters, goals))[0]

        return jax.jit(act)

    def _check(self, name: str, value: Any) -> None:
        """Raise a RequestError unless ``value`` has the shape and dtype of an observation."""
        spec = self.observation_spec
        shape, expected = np.shape(value), tuple(spec.shape)
        if shape != expected:
            hint = ""
            if shape[1:] == expected:
                hint = ": jax.vmap(policy) takes a batch"
            elif len(expected) == 3 and shape == (*expected[1:], expected[0]):
                hint = f": images are planar here, so move the channels first, np.moveaxis({name}, -1, 0)"
            elif len(expected) == 3 and name == "goal" and shape == (expected[0] // self.env.frame_stack, *expected[1:]):
                hint = f": repeat the goal's image {self.env.frame_stack} times, as policy.env.as_goal does"
            raise RequestError(f"{self.env_name}: {name} must have the shape {expected}, not {shape}{hint}")
        dtype = np.dtype(getattr(value, "dtype", None) or np.asarray(value).dtype)
        if spec.dtype == jnp.uint8:
            if dtype != np.uint8:
                raise RequestError(f"{self.env_name}: {name} must be uint8 from 0 to 255, not {dtype}")
        elif not jnp.issubdtype(dtype, jnp.floating):
            raise RequestError(f"{self.env_name}: {name} must be {spec.dtype}, not {dtype}")


def load_policy(run_dir: Path | str, seed: int | None = None, checkpoint: Choice = None, trust: bool = False) -> Policy:
    """Load the policy of a run, on any platform that JAX supports.

    Args:
        run_dir: The run folder, a folder of `jaxrl-vis push`, or the name of a policy that comes with the package.
        seed: Seed, for a run with several; None for the first.
        checkpoint: Iteration of a checkpoint, ``best`` for the best one by ``best_by``, or None for the newest valid one.
        trust: Whether to allow execution of the run's custom code (``module:Name``); not needed for runs that were trained
            here.

    Raises:
        RequestError: There is no run, no such seed or checkpoint, or no usable one; or its task is not available here, or is
            untrusted code.
    """
    run_dir = find(run_dir)
    if policy_file.holds_policy(run_dir):
        policy_file.check_source(policy_file.read_source(run_dir), seed, checkpoint)
    trainer = open_run(run_dir, trust=trust)
    seed = choose_seed(trainer, run_dir, seed)
    return make_policy(trainer, load(trainer, run_dir, checkpoint), seed)


def choose_seed(trainer: Trainer, run_dir: Path | str, seed: int | None) -> int:
    """Return ``seed``, or the first of the run for None.

    Raises:
        RequestError: The run has not trained it.
    """
    seed = trainer.config.run.seed if seed is None else seed
    if seed not in trainer.seeds:
        trained = f"seed {trainer.seeds[0]}" if len(trainer.seeds) == 1 else f"seeds {trainer.seeds[0]} to {trainer.seeds[-1]}"
        raise RequestError(f"the run in {run_dir} has trained no seed {seed}, only {trained}")
    return seed


def make_policy(trainer: Trainer, restored: Restored, seed: int) -> Policy:
    """Build the policy of one seed, and enable JAX's compilation cache.

    Args:
        trainer: From `restored_run.open_run`.
        restored: The learner, from `restored_run.load`.
        seed: One of the trainer's seeds.
    """
    enable_compilation_cache()
    index, algorithm = trainer.seeds.index(seed), trainer.program.algorithm
    train = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), restored.train)
    parameters = algorithm.policy_params(train.agent, train.statistics)
    return Policy(trainer.env, trainer.config, seed, restored.iteration, parameters, algorithm)
