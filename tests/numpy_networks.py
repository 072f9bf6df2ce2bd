"""Networks and Adam in NumPy, in float64, with hand-written gradients; they share no code with the learner."""

import numpy as np

Layers = list[tuple[np.ndarray, np.ndarray]]
"""(kernel [inputs, outputs], bias [outputs]) of each layer."""


def layers(head, which=None) -> Layers:
    """Return the layers of a head of the learner as float64; of stacked heads, those of the head with index ``which``."""
    names = [*sorted(name for name in head if name.startswith("hidden")), "output"]
    pairs = [(head[name]["kernel"], head[name]["bias"]) for name in names]
    pick = (lambda leaf: leaf) if which is None else (lambda leaf: leaf[which])
    return [(np.asarray(pick(kernel), np.float64), np.asarray(pick(bias), np.float64)) for kernel, bias in pairs]


def forward(network: Layers, inputs: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the outputs [N, outputs] of a network with ReLU hidden layers for inputs [N, inputs], and each layer's inputs."""
    seen, values = [], inputs
    for number, (kernel, bias) in enumerate(network):
        seen.append(values)
        values = values @ kernel + bias
        if number < len(network) - 1:
            values = np.maximum(values, 0.0)
    return values, seen


def backward(network: Layers, seen: list[np.ndarray], gradient: np.ndarray) -> tuple[Layers, np.ndarray]:
    """Return the gradients of all layers and of the inputs, given that of the outputs and each layer's inputs ``seen``."""
    found: Layers = []
    for (kernel, _), values in zip(network[::-1], seen[::-1], strict=True):
        found.append((values.T @ gradient, gradient.sum(axis=0)))
        gradient = (gradient @ kernel.T) * (values > 0.0 if values is not seen[0] else 1.0)
    return found[::-1], gradient


def polyak_average(online: Layers, target: Layers, decay: float) -> Layers:
    """Return the target network after one update: decay * target + (1 - decay) * online."""
    return [tuple(decay * old + (1.0 - decay) * new for old, new in zip(*both)) for both in zip(target, online)]


class Adam:
    """Adam optimiser of one network (Kingma and Ba, 2015), with its usual decay rates."""

    def __init__(self, rate: float):
        self.rate, self.count, self.means, self.squares = rate, 0, None, None

    def step(self, network: Layers, gradient: Layers) -> Layers:
        if self.means is None:
            self.means = [[np.zeros_like(leaf) for leaf in layer] for layer in gradient]
            self.squares = [[np.zeros_like(leaf) for leaf in layer] for layer in gradient]
        self.count += 1
        moved = []
        for layer, slopes, means, squares in zip(network, gradient, self.means, self.squares, strict=True):
            for index, slope in enumerate(slopes):
                means[index] = 0.9 * means[index] + 0.1 * slope
                squares[index] = 0.999 * squares[index] + 0.001 * slope**2
            moved.append(
                tuple(
                    leaf - self.rate * (mean / (1 - 0.9**self.count)) / (np.sqrt(square / (1 - 0.999**self.count)) + 1e-8)
                    for leaf, mean, square in zip(layer, means, squares, strict=True)
                )
            )
        return moved
