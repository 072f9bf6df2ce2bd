"""Minimum cost of a gradient step, and the achieved fraction of the device's peak.

There are two counts: the compiler's own count of the program (`Compiled.cost_analysis`), and a lower bound from the shapes of
the layers, which holds for every implementation of the algorithm.
"""

import dataclasses
import math
from typing import Any

import jax

from jaxrl_vis.bench.peaks import device_peak
from jaxrl_vis.learner.networks.networks import Networks


@dataclasses.dataclass(frozen=True)
class Cost:
    """Cost of one gradient step.

    Attributes:
        flops: Floating-point operations; a multiply-add counts as two.
        bytes: Memory traffic in bytes; NaN if unknown.
    """

    flops: float
    bytes: float


def compiler_cost(compiled: Any, steps: int = 1) -> Cost | None:
    """Return the cost per gradient step from the compiler's count for a program of ``steps`` steps; None if unavailable.

    The compiler counts the body of a loop once, so pass a program with a single iteration.
    """
    analysis = compiled.cost_analysis()
    if isinstance(analysis, list):
        analysis = analysis[0] if analysis else None
    if not analysis or "flops" not in analysis:
        return None
    return Cost(float(analysis["flops"]) / steps, float(analysis.get("bytes accessed", math.nan)) / steps)


def encoder_products(networks: Networks) -> tuple[int, int]:
    """Return the number of multiply-adds of one encoder for one image: total, and first layer."""
    if not networks.sees_images:
        return 0, 0
    channels, height, width = networks.observation_spec.shape
    filters = networks.config.network.encoder_filters
    blocks = (height >> len(filters)) * (width >> len(filters))
    layers = []
    for level, outputs in enumerate(filters, start=1):
        pixels = blocks * 4 ** (len(filters) - level)
        layers.append(pixels * 4 * channels * outputs)
        channels = outputs
    layers.append(blocks * channels * networks.config.network.latent_size)
    return sum(layers), layers[0]


def head_products(sizes: tuple[int, ...]) -> int:
    """Return the number of multiply-adds per row of a stack of dense layers, of sizes (first inputs, ..., last outputs)."""
    return sum(first * second for first, second in zip(sizes, sizes[1:], strict=False))


def minimum_cost(networks: Networks, params: Any, batch_size: int) -> Cost:
    """Return a lower bound of the cost from the shapes of the layers, averaged over the actor's update interval.

    Products: every online encoder runs forward and backward on two images per transition (backward costs twice a forward pass,
    minus the gradient with respect to the image), and every target encoder runs forward on two; without target encoders, every
    online encoder also encodes the next image. The actor's head runs forward once as the target and once in both directions;
    the critic's once as the target, once in both directions, and once more in the actor's loss, forward and back to the action.
    A critic that observes true states has no encoder.

    Bytes: three images per transition are read once from the replay; online parameters and two Adam moments are read and
    written once, target parameters are read and written once. Activations are assumed to stay on the chip.

    Args:
        networks: Networks of the parameters.
        params: Online actor and critic parameters.
        batch_size: Number of transitions in a gradient step.
    """
    config = networks.config
    encoder, first_layer = encoder_products(networks)
    spec, hidden, actions = networks.observation_spec, config.network.hidden_sizes, networks.action_size
    latent = config.network.latent_size if networks.sees_images else math.prod(spec.shape)
    actor_head = head_products((2 * latent, *hidden, actions))
    critic_head = head_products((actions + (networks.critic_state_size or 2 * latent), *hidden, 1))
    actor_share = 1.0 / config.ddpg.actor_interval
    learned = 2 * (3 * encoder - first_layer)
    followed = (2 if config.network.target_encoder else 1) * encoder
    critic_products = (0 if networks.critic_state_size else learned + followed) + (1 + 3) * critic_head
    actor_products = (0 if networks.shares_encoder else followed) + actor_head
    actor_step_products = (0 if networks.shares_encoder else learned) + 3 * actor_head + 2 * critic_head
    products = critic_products + actor_products + actor_share * actor_step_products

    images = 3 * batch_size * math.prod(spec.shape) * spec.dtype.itemsize
    actor, critic = params
    online = _bytes(critic) + actor_share * _bytes(actor)
    targets = sum(_bytes(network if config.network.target_encoder else network["head"]) for network in (actor, critic))
    return Cost(flops=2.0 * batch_size * products, bytes=images + (2 + 4) * online + 2 * targets)


def _bytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def describe(cost: Cost, seconds: float, dtype: str, device_kind: str) -> dict[str, Any]:
    """Return operations, memory traffic and the achieved TFLOP/s and GB/s, with fractions of the device's peak if known.

    Args:
        cost: Cost of a gradient step.
        seconds: Duration of a gradient step in seconds.
        dtype: Compute dtype of the networks, bfloat16 or float32, which selects the peak.
        device_kind: Kind of the device, as in `device_peak`.
    """
    achieved = {
        "gflop": round(cost.flops / 1e9, 3),
        "mbyte": round(cost.bytes / 1e6, 3),
        "tflop_per_s": round(cost.flops / seconds / 1e12, 4),
        "gbyte_per_s": round(cost.bytes / seconds / 1e9, 2),
    }
    peak = device_peak(device_kind)
    if peak is not None:
        flops = peak.bfloat16 if dtype == "bfloat16" else peak.float32
        achieved["share_of_peak_flops"] = round(cost.flops / seconds / flops, 4)
        achieved["share_of_peak_bandwidth"] = round(cost.bytes / seconds / peak.memory, 4)
        achieved["roofline_updates_per_s"] = round(1.0 / max(cost.flops / flops, cost.bytes / peak.memory))
    return achieved
