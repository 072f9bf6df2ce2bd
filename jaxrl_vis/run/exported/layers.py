"""Layers of a policy with an actor of `Networks`, as NumPy arrays by name, and a forward pass in NumPy.

    observation, goal [N, C, H, W]     clip((x - mean) * scale, -limit, limit), float32
    encoder, the same for both         2x2 convolutions of stride 2, each with ReLU; flattened as [H, W, C]; one dense layer
    head                               [latent of the observation, of the goal]; dense layers with ReLU; output; tanh

States [N, S] have no encoder: normalised, they are their own latents.
"""

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.networks.policy import PolicyParams
from jaxrl_vis.run.trained.policy import Policy

INPUTS = ("observation", "goal")
OUTPUT = "action"

COMPUTATION = (
    "observation and goal: clip((x - INPUT/mean) * INPUT/scale, -limit, limit); goal has the numbers of observation if it has "
    "none of its own",
    "images alone, for each of the two: convolution K with encoder/K/kernel [out, in, row, column], stride 2, no padding, plus "
    "encoder/K/bias, ReLU; flatten as [row, column, channel]; times encoder/latent/kernel [in, out], plus encoder/latent/bias",
    "concatenate observation and goal; times head/K/kernel [in, out], plus head/K/bias, ReLU",
    "times head/output/kernel, plus head/output/bias; tanh",
)
"""Description of the computation of `forward`, for other users of the weights."""


@dataclasses.dataclass(frozen=True)
class PolicyWeights:
    """Weights of a policy.

    Attributes:
        limit: Bound of normalised observations.
        arrays: Float32 arrays by name: ``observation/mean``, ``encoder/0/kernel`` [out, in, 2, 2], ``head/0/kernel`` [in, out],
            ..., see `COMPUTATION`.
    """

    limit: float
    arrays: Mapping[str, np.ndarray]

    @property
    def convolutions(self) -> int:
        """Number of convolutions of the encoder; 0 for states."""
        return self._count("encoder")

    @property
    def hidden_layers(self) -> int:
        """Number of hidden layers of the head."""
        return self._count("head")

    def _count(self, part: str) -> int:
        return sum(bool(re.fullmatch(rf"{part}/\d+/kernel", name)) for name in self.arrays)

    def scaling(self, name: str) -> str:
        """Return the name of the input whose statistics normalise input ``name``: goals may share those of observations."""
        return name if f"{name}/mean" in self.arrays else INPUTS[0]

    def nested(self) -> dict[str, Any]:
        """Return the arrays as nested dictionaries."""
        tree: dict[str, Any] = {}
        for name, array in self.arrays.items():
            *folders, last = name.split("/")
            place = tree
            for folder in folders:
                place = place.setdefault(folder, {})
            place[last] = array
        return tree


def layers_of(policy: Policy) -> PolicyWeights:
    """Collect the layers of a policy.

    Raises:
        RequestError: The policy does not have an actor of `Networks`.
    """
    params, networks = policy.parameters, policy.algorithm.networks
    if not isinstance(params, PolicyParams) or not isinstance(networks, Networks):
        raise RequestError(
            f"algorithm {policy.config.run.algorithm} has a policy of its own, whose layers are not known: "
            "--format stablehlo exports any policy"
        )
    return collect(networks, params)


def collect(networks: Networks, params: PolicyParams) -> PolicyWeights:
    """Collect the layers of a policy of given networks."""
    arrays: dict[str, Any] = {}
    options = networks.config.network
    for name, statistics in zip(INPUTS, (params.observations, params.goals), strict=True):
        scaling = networks.scaling(statistics)
        arrays |= {f"{name}/mean": scaling.mean, f"{name}/scale": scaling.scale}
    if all(np.array_equal(arrays[f"observation/{part}"], arrays[f"goal/{part}"]) for part in ("mean", "scale")):
        del arrays["goal/mean"], arrays["goal/scale"]
    if networks.sees_images:
        encoder = params.actor["encoder"]
        for level in range(len(options.encoder_filters)):
            kernel = encoder[f"kernel_{level}"]  # [row, column and channel of a 2x2 window, out]
            arrays[f"encoder/{level}/kernel"] = kernel.reshape(2, 2, -1, kernel.shape[-1]).transpose(3, 2, 0, 1)
            arrays[f"encoder/{level}/bias"] = encoder[f"bias_{level}"]
        arrays |= {f"encoder/latent/{part}": leaf for part, leaf in encoder["latent"].items()}
    for layer in range(len(options.hidden_sizes)):
        arrays |= {f"head/{layer}/{part}": leaf for part, leaf in params.actor["head"][f"hidden_{layer}"].items()}
    arrays |= {f"head/output/{part}": leaf for part, leaf in params.actor["head"]["output"].items()}
    host = {name: np.ascontiguousarray(jax.device_get(array), np.float32) for name, array in arrays.items()}
    return PolicyWeights(float(options.normalizer_clip), host)


def forward(layers: PolicyWeights, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Compute actions in NumPy.

    Args:
        layers: The weights.
        observation, goal: [N, C, H, W] uint8 or [N, S] float32.

    Returns:
        [N, A] float32 in [-1, 1].
    """
    arrays, latents = layers.arrays, []
    for name, values in zip(INPUTS, (observation, goal), strict=True):
        source = layers.scaling(name)
        values = (values.astype(np.float32) - arrays[f"{source}/mean"]) * arrays[f"{source}/scale"]
        values = np.clip(values, -layers.limit, layers.limit)
        for level in range(layers.convolutions):
            values = _convolve(values, arrays[f"encoder/{level}/kernel"], arrays[f"encoder/{level}/bias"])
        if layers.convolutions:
            values = np.moveaxis(values, 1, -1).reshape(len(values), -1)
            values = values @ arrays["encoder/latent/kernel"] + arrays["encoder/latent/bias"]
        latents.append(values)
    values = np.concatenate(latents, axis=1)
    for layer in range(layers.hidden_layers):
        values = np.maximum(values @ arrays[f"head/{layer}/kernel"] + arrays[f"head/{layer}/bias"], 0.0)
    return np.tanh(values @ arrays["head/output/kernel"] + arrays["head/output/bias"])


def _convolve(images: np.ndarray, kernel: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Convolve images [N, C, H, W] with a kernel [out, C, 2, 2] and stride 2, and apply ReLU."""
    count, channels, height, width = images.shape
    rows, columns = height // 2, width // 2
    windows = images[:, :, : 2 * rows, : 2 * columns].reshape(count, channels, rows, 2, columns, 2)
    values = np.einsum("nchrwk,ocrk->nohw", windows, kernel, optimize=True) + bias[:, None, None]
    return np.maximum(values, 0.0)
