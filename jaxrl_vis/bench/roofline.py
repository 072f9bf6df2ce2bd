"""What a gradient step costs at the least, and what share of the device that is.

Two counts stand side by side: the compiler's own (`Compiled.cost_analysis`), which includes what it made of the program, and
one from the layers' shapes, which cannot be beaten without changing the algorithm.
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


def compiler_cost(compiled: Any) -> Cost | None:
    """The compiler's count. A loop's body counts once, so give it a program with one gradient step."""
    analysis = compiled.cost_analysis()
    if isinstance(analysis, list):
        analysis = analysis[0] if analysis else None
    if not analysis or "flops" not in analysis:
        return None
    return Cost(float(analysis["flops"]), float(analysis.get("bytes accessed", math.nan)))


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
    """The count from the layers' shapes.

    Products: both targets encode two images a transition forward; both online networks two images forward and backward
    (twice a forward pass, less the gradient of the image itself). The actor's head runs once forward as target and once both
    ways; the critic's once as target, once both ways, and once more in the actor's loss, forward and back to the action.

    Bytes: three images a transition are read once as they lie in the replay; online parameters and two Adam moments are read
    and written once, target parameters are read and written once. Activations are taken to stay on the chip.

    Args:
        networks: What the parameters mean.
        params: Online actor and critic parameters.
        batch_size: Transitions in a gradient step.
    """
    encoder, first_layer = encoder_products(networks)
    spec, hidden, actions = networks.observation_spec, networks.config.hidden_sizes, networks.action_size
    latent = networks.config.latent_size if networks.sees_images else math.prod(spec.shape)
    actor_head = head_products((2 * latent, *hidden, actions))
    critic_head = head_products((2 * latent + actions, *hidden, 1))
    encoders = 2 * 2 * encoder + 2 * 2 * (3 * encoder - first_layer)
    products = encoders + (1 + 3) * actor_head + (1 + 3 + 2) * critic_head
    images = 3 * batch_size * math.prod(spec.shape) * spec.dtype.itemsize
    parameters = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(params))
    return Cost(flops=2.0 * batch_size * products, bytes=images + (2 + 4 + 2) * parameters)


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
