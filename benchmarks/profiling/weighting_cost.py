"""Cost of learning the weights of auxiliary losses, for several numbers of losses.

    python -m benchmarks.profiling.weighting_cost [--losses 5 10] [--modes latents] [--image-size 64] [--batch-size 512]

An encoder of the preset `paper` reads RGB-D images before and after an action. The main loss is that of a value head with three
hidden layers; every auxiliary loss is that of a linear head on both latents with its own targets. For every number of auxiliary
losses and every method of computing their gradients, gradient steps are timed with fixed weights and with OL-AUX-5. The
difference is the cost of the weighting itself.
"""

import argparse
import dataclasses
import functools
import sys
from typing import Any, get_args

import jax
import jax.numpy as jnp

import jaxrl_vis_envs
from jaxrl_vis.bench.timing import compile_timed
from jaxrl_vis.bench.timing import measure as measure_time
from jaxrl_vis.config import preset
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.learner.networks import forward_mode
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.networks.normalizer import Scaling
from jaxrl_vis.weighting import MAIN, Weighting, make_weighting, weighted_grad
from jaxrl_vis.weighting.gradients import GradientMode

STEPS = 40
"""Gradient steps per timed call."""
TARGETS = 64
"""Output size of each auxiliary head."""
LEARNING_RATE = 1e-4


@dataclasses.dataclass(frozen=True)
class Problem:
    """Losses that share an encoder.

    Attributes:
        networks: Networks of the critic.
        size: Batch size.
        names: Names of the auxiliary losses.
    """

    networks: Networks
    size: int
    names: tuple[str, ...]

    def params(self, key: jax.Array) -> dict[str, Any]:
        """Initialise the critic's parameters, and a linear head for each auxiliary loss."""
        critic_key, *keys = jax.random.split(key, 1 + len(self.names))
        width = 2 * self.networks.config.network.latent_size
        heads = {
            name: jax.random.normal(key, (width, TARGETS)) / width**0.5 for name, key in zip(self.names, keys, strict=True)
        }
        return {"critic": self.networks.init_critic(critic_key), "heads": heads}

    def batches(self, key: jax.Array, count: int) -> dict[str, jax.Array]:
        """Sample ``count`` batches.

        Returns:
            ``images`` [count, 2, B, C, H, W] uint8, ``action`` [count, B, A] float32 in [-1, 1], ``value`` [count, B] float32,
            and ``targets`` [count, L, B, TARGETS] float32 of L auxiliary losses.
        """
        image_key, action_key, value_key, target_key = jax.random.split(key, 4)
        shape = self.networks.observation_spec.shape
        draw = functools.partial(jax.random.normal, shape=(count, self.size))
        return {
            "images": jax.random.randint(image_key, (count, 2, self.size, *shape), 0, 256, jnp.uint8),
            "action": jax.random.uniform(action_key, (count, self.size, self.networks.action_size), minval=-1.0),
            "value": draw(value_key),
            "targets": jax.random.normal(target_key, (count, len(self.names), self.size, TARGETS)),
        }

    def encode(self, encoder: Any, batch: dict[str, jax.Array]) -> jax.Array:
        """Encode the images before and after the action to latents [2, B, latent].

        Args:
            encoder: Parameters of the encoder.
            batch: One batch of `batches`.
        """
        mean, scale = (jnp.full(self.networks.observation_spec.shape, value) for value in (127.5, 1 / 74.0))
        images = batch["images"].reshape(2 * self.size, *self.networks.observation_spec.shape)
        inputs = self.networks.prepare(Scaling(mean, scale), images)
        return self.networks.encode({"encoder": encoder}, inputs).reshape(2, self.size, -1)

    def losses(self, params: Any, latents: jax.Array, batch: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """Compute the main loss and each auxiliary loss, [] float32 by name: mean squared errors of value and targets.

        Args:
            params: Parameters as from `params`.
            latents: [2, B, latent], before and after the action.
            batch: One batch of `batches`.
        """
        value = self.networks.value(params["critic"], latents, batch["action"])
        both = jnp.concatenate([latents[0], latents[1]], axis=-1).astype(jnp.bfloat16)
        losses = {MAIN: jnp.mean(jnp.square(value - batch["value"]))}
        for name, target in zip(self.names, batch["targets"], strict=True):
            predicted = (both @ params["heads"][name].astype(jnp.bfloat16)).astype(jnp.float32)
            losses[name] = jnp.mean(jnp.square(predicted - target))
        return losses

    def make_steps(self, weighting: Weighting, mode: Any) -> Any:
        """Return the jitted function (params, weighting's state, batches) -> both after `STEPS` updates, and the weights.

        Args:
            weighting: Weighting of the losses.
            mode: Differentiation mode of `weighted_grad`.
        """
        find = weighted_grad(
            self.losses,
            weighting,
            lambda params: params["critic"]["encoder"],
            mode,
            forwards=forward_mode.with_tangents,
            encode=self.encode,
        )

        def steps(params: Any, state: Any, batches: dict[str, jax.Array]) -> tuple[Any, Any, Any]:
            def step(carry: tuple[Any, Any], number: jax.Array) -> tuple[tuple[Any, Any], Any]:
                params, state = carry
                result = find(params, state, jax.tree.map(lambda leaf: leaf[number % leaf.shape[0]], batches))
                params = jax.tree.map(lambda leaf, slope: leaf - LEARNING_RATE * slope, params, result.gradient)
                return (params, result.state), result.weights

            (params, state), weights = jax.lax.scan(step, (params, state), jnp.arange(STEPS))
            return params, state, weights

        return jaxrl_vis_envs.jit(steps)


def time_step(problem: Problem, weighting: Weighting, mode: str) -> float:
    """Return the time of a gradient step, s.

    Raises:
        AssertionError: Nothing was learned, or learned weights did not change.
    """
    params, batches = problem.params(jax.random.key(0)), problem.batches(jax.random.key(1), 4)
    state = weighting.init((MAIN, *problem.names), params["critic"]["encoder"])
    steps, _ = compile_timed(problem.make_steps(weighting, mode), params, state, batches)
    after, _, weights = steps(params, state, batches)
    moved = [float(jnp.max(jnp.abs(one - other))) for one, other in zip(*map(jax.tree.leaves, (params, after)), strict=True)]
    assert all(0 < change < float("inf") for change in moved), "no gradient step was taken"
    assert weighting.needs == "losses" or float(weights[problem.names[0]].std()) > 0, "weights stay as they are"
    return measure_time(lambda: steps(params, state, batches), repeats=5).median_s / STEPS


def main() -> int:
    """Print the table; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--losses", type=int, nargs="+", default=[5, 10], help="numbers of auxiliary losses")
    parser.add_argument(
        "--modes", nargs="+", choices=get_args(GradientMode), default=["latents"], help="modes of weighted_grad"
    )
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--batch-size", type=int, default=512)
    options = parser.parse_args()
    check_devices()
    spec = jax.ShapeDtypeStruct((4, options.image_size, options.image_size), jnp.uint8)
    networks = Networks(preset("paper", image_size=options.image_size), spec, 4, 0.0)
    print(f"{'mode':12}{'losses':>8}{'fixed, us':>12}{'OL-AUX-5, us':>14}{'added, us':>12}   on {jax.devices()[0].device_kind}")
    for method in options.modes:
        for count in options.losses:
            problem = Problem(networks, options.batch_size, tuple(f"loss_{number}" for number in range(count)))
            weightings = {"fixed": make_weighting("balance"), "learned": make_weighting("ol_aux", interval=5)}
            seconds = {name: time_step(problem, weighting, method) for name, weighting in weightings.items()}
            added = seconds["learned"] - seconds["fixed"]
            print(
                f"{method:12}{count:8}{1e6 * seconds['fixed']:12.0f}{1e6 * seconds['learned']:14.0f}{1e6 * added:12.0f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
