"""Time of TorchJD's methods on the problem of `cost`: ``python peer_cost.py SETTINGS OUT.json``. Imports only PyTorch.

Rows as in `cost`: alone, from a Jacobian's Gramian to weights (or from the Jacobian to a direction); step, with `mtl_backward`
and `jac_to_grad`. Runs on the GPU if PyTorch sees one.
"""

import functools
import json
import statistics
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import torch
from torchjd import aggregation as A  # noqa: N812
from torchjd.autojac import jac_to_grad, mtl_backward

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
# Name of ours -> (aggregator of K losses, weighting of a Gramian if it has one).
METHODS: dict[str, Callable[[int], tuple[Any, Any]]] = {
    "sum": lambda count: (A.Sum(), None),
    "uniform": lambda count: (A.Mean(), None),
    "random": lambda count: (A.Random(), None),
    "mgda": lambda count: (A.MGDA(), A.MGDAWeighting()),
    "upgrad": lambda count: (A.UPGrad(), A.UPGradWeighting()),
    "dualproj": lambda count: (A.DualProj(), A.DualProjWeighting()),
    "cagrad": lambda count: (A.CAGrad(c=0.5), A.CAGradWeighting(c=0.5)),
    "imtl_g": lambda count: (A.IMTLG(), A.IMTLGWeighting()),
    "nash_mtl": lambda count: (A.NashMTL(count, update_weights_every=1), None),
    "fairgrad": lambda count: (A.FairGrad(alpha=2.0), A.FairGradWeighting(alpha=2.0)),
    "aligned_mtl": lambda count: (A.AlignedMTL(), A.AlignedMTLWeighting()),
    "config": lambda count: (A.ConFIG(), None),
    "pcgrad": lambda count: (A.PCGrad(), A.PCGradWeighting()),
    "gradvac": lambda count: (A.GradVac(), A.GradVacWeighting()),
    "graddrop": lambda count: (A.GradDrop(), None),
}


def wait() -> None:
    """Wait for the device."""
    if DEVICE.type == "cuda":
        torch.cuda.synchronize()


def time_call(function: Callable[[], Any], repeats: int, passes: int, budget: float) -> float:
    """Return the median time of a call, s, of up to ``repeats`` timings, at least three, within about ``budget`` seconds."""
    function()
    wait()
    seconds, end = [], time.perf_counter() + budget
    for count in range(repeats):
        if count >= 3 and time.perf_counter() > end:
            break
        started = time.perf_counter()
        for _ in range(passes):
            function()
        wait()
        seconds.append((time.perf_counter() - started) / passes)
    return statistics.median(seconds)


def problem(
    settings: dict[str, Any], count: int
) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor, list[torch.Tensor]]:
    """Sample trunk, heads, inputs and targets, float32 with the shapes of those in `cost`."""
    width, size = settings["width"], settings["batch_size"]
    torch.manual_seed(0)
    trunk = [(torch.randn(width, width, device=DEVICE) / width**0.5).requires_grad_() for _ in range(3)]
    heads = [(torch.randn(width, settings["targets"], device=DEVICE) / width**0.5).requires_grad_() for _ in range(count)]
    targets = [torch.randn(size, settings["targets"], device=DEVICE) for _ in range(count)]
    return trunk, heads, torch.randn(size, width, device=DEVICE), targets


def make_step(
    trunk: list[torch.Tensor], heads: list[torch.Tensor], inputs: torch.Tensor, targets: list[torch.Tensor]
) -> Callable[[Any], None]:
    """Return a function that sets the gradients (``grad``) of all parameters by an aggregator."""

    def step(aggregator: Any) -> None:
        hidden = inputs
        for layer in trunk:
            hidden = torch.tanh(hidden @ layer)
        losses = [torch.mean((hidden @ head - target) ** 2) for head, target in zip(heads, targets, strict=True)]
        for parameter in (*trunk, *heads):
            parameter.grad = None
        mtl_backward(losses, features=hidden)
        jac_to_grad(trunk, aggregator)

    return step


def main() -> None:
    """Time all methods for the settings in the first argument (JSON), and write the rows to the file in the second."""
    settings = json.loads(sys.argv[1])
    timing, rows = (settings["repeats"], settings["passes"], settings["budget"]), []
    for count in settings["losses"]:
        trunk, heads, inputs, targets = problem(settings, count)

        step = make_step(trunk, heads, inputs, targets)
        jacobian = torch.randn(count, sum(layer.numel() for layer in trunk), device=DEVICE)
        gramian = jacobian @ jacobian.T
        for name, make in METHODS.items():
            aggregator, weighting = make(count)
            alone = functools.partial(aggregator, jacobian) if weighting is None else functools.partial(weighting, gramian)
            row = {"method": name, "losses": count}
            rows.append(row | {"what": "alone", "seconds": time_call(alone, *timing)})
            rows.append(row | {"what": "step", "seconds": time_call(functools.partial(step, aggregator), *timing)})
    versions = {"torchjd": version("torchjd"), "torch": torch.__version__}
    with open(sys.argv[2], "w") as file:
        json.dump({"device": str(DEVICE), "versions": versions, "rows": rows}, file)


if __name__ == "__main__":
    main()
