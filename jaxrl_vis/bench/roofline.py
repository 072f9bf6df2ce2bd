"""The least that a gradient step costs, and what share of the device's peak is achieved.

There are two counts: the compiler's own of the program that it made (`Compiled.cost_analysis`), and one from the shapes of the
layers, which cannot be beaten without changing the algorithm.
"""

import dataclasses
import math
from typing import Any

import jax

from jaxrl_vis.bench.peaks import peak_of
from jaxrl_vis.learner.networks import Networks


@dataclasses.dataclass(frozen=True)
class Cost:
    """Floating-point operations and bytes of memory traffic of one gradient step."""

    flops: float
    bytes: float


def compiler_cost(compiled: Any, steps: int = 1) -> Cost | None:
    """The compiler's count of one of ``steps`` gradient steps. A loop's body counts once: give it a program with one turn."""
    analysis = compiled.cost_analysis()
    if isinstance(analysis, list):
        analysis = analysis[0] if analysis else None
    if not analysis or "flops" not in analysis:
        return None
    return Cost(float(analysis["flops"]) / steps, float(analysis.get("bytes accessed", math.nan)) / steps)


def encoder_products(networks: Networks) -> tuple[int, int]:
    """Multiply-adds of one network's encoder for one image: all of them, and the first layer's alone."""
    if not networks.sees_images:
        return 0, 0
    channels, height, width = networks.observation_spec.shape
    filters = networks.config.encoder_filters
    blocks = (height >> len(filters)) * (width >> len(filters))
    layers = []
    for level, outputs in enumerate(filters, start=1):
        pixels = blocks * 4 ** (len(filters) - level)
        layers.append(pixels * 4 * channels * outputs)
        channels = outputs
    layers.append(blocks * channels * networks.config.latent_size)
    return sum(layers), layers[0]


def head_products(sizes: tuple[int, ...]) -> int:
    """Multiply-adds of a stack of dense layers for one row: [first inputs, ..., last outputs]."""
    return sum(first * second for first, second in zip(sizes, sizes[1:], strict=False))


def least_cost(networks: Networks, params: Any, batch_size: int) -> Cost:
    """The count from the layers' shapes, in the mean over the actor's interval.

    Products: every online encoder takes two images a transition forward and backward (twice a forward pass, less the gradient
    of the image itself), and every target encoder two forward; without those, every online encoder takes the image after, too.
    The actor's head runs once forward as target and once both ways; the critic's once as target, once both ways, and once more
    in the actor's loss, forward and back to the action.

    Bytes: three images a transition are read once as they lie in the replay; online parameters and two Adam moments are read
    and written once, target parameters are read and written once. Activations are taken to stay on the chip.

    Args:
        networks: The networks whose parameters these are.
        params: Online actor and critic parameters.
        batch_size: Transitions in a gradient step.
    """
    config = networks.config
    encoder, first_layer = encoder_products(networks)
    spec, hidden, actions = networks.observation_spec, config.hidden_sizes, networks.action_size
    latent = config.latent_size if networks.sees_images else math.prod(spec.shape)
    actor_head = head_products((2 * latent, *hidden, actions))
    critic_head = head_products((2 * latent + actions, *hidden, 1))
    separate, actor_share = config.encoders == "separate", 1.0 / config.actor_interval
    learned = 2 * (3 * encoder - first_layer)
    followed = (2 if config.target_encoder else 1) * encoder
    of_critic = learned + followed + (1 + 3) * critic_head
    of_actor = (followed if separate else 0) + actor_head
    of_actor_step = (learned if separate else 0) + 3 * actor_head + 2 * critic_head
    products = of_critic + of_actor + actor_share * of_actor_step

    images = 3 * batch_size * math.prod(spec.shape) * spec.dtype.itemsize
    actor, critic = params
    online = _bytes(critic) + actor_share * _bytes(actor)
    targets = sum(_bytes(each if config.target_encoder else each["head"]) for each in (actor, critic))
    return Cost(flops=2.0 * batch_size * products, bytes=images + (2 + 4) * online + 2 * targets)


def _bytes(tree: Any) -> int:
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def describe(cost: Cost, seconds: float, dtype: str, device_kind: str) -> dict[str, Any]:
    """What was achieved: TFLOP/s, GB/s, and their shares of the device's peak where that is known."""
    achieved = {
        "gflop": round(cost.flops / 1e9, 3),
        "mbyte": round(cost.bytes / 1e6, 3),
        "tflop_per_s": round(cost.flops / seconds / 1e12, 4),
        "gbyte_per_s": round(cost.bytes / seconds / 1e9, 2),
    }
    peak = peak_of(device_kind)
    if peak is not None:
        flops = peak.bfloat16 if dtype == "bfloat16" else peak.float32
        achieved["share_of_peak_flops"] = round(cost.flops / seconds / flops, 4)
        achieved["share_of_peak_bandwidth"] = round(cost.bytes / seconds / peak.memory, 4)
        achieved["updates_per_s_at_the_roof"] = round(1.0 / max(cost.flops / flops, cost.bytes / peak.memory))
    return achieved
