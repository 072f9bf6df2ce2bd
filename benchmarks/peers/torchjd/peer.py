"""Results of TorchJD for the Jacobians of a file: ``python peer.py IN.npz OUT.npz``. Imports nothing of this project.

Names are those of `ours`: weights [n, K] of methods that return weights, directions [n, SIZE] of others, and for methods that
read losses, weights [n, STEPS, K] as the derivative of the scalarised loss.
"""

import multiprocessing
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any
from unittest import mock

import numpy as np
import torch
from torchjd import aggregation, scalarization

STCH_MU, CAGRAD_RADIUS, FAIR_ALPHA, VAC_BETA = 0.2, 0.5, 2.0, 0.3  # as in `ours`


def gramian_weights(weighting: Any) -> Callable[[torch.Tensor], np.ndarray]:
    """Return the function from a Jacobian to weights for a weighting of Gramians."""
    return lambda jacobian: weighting(jacobian @ jacobian.T).numpy()


def nash_weights() -> Callable[[torch.Tensor], np.ndarray]:
    """Return the function from a Jacobian to Nash-MTL's weights, with a fresh state for every Jacobian."""
    made: dict[int, Any] = {}

    def weights(jacobian: torch.Tensor) -> np.ndarray:
        count = len(jacobian)
        if count not in made:
            made[count] = aggregation.NashMTL(count, max_norm=0.0, update_weights_every=1, optim_niter=20)
        made[count].reset()
        return made[count].weighting(jacobian).numpy()

    return weights


METHODS: dict[str, Callable[[torch.Tensor], np.ndarray]] = {
    "uniform": lambda jacobian: aggregation.Mean()(jacobian).numpy(),
    "sum": lambda jacobian: aggregation.Sum()(jacobian).numpy(),
    "imtl_g": lambda jacobian: aggregation.IMTLG()(jacobian).numpy(),
    "aligned_mtl": lambda jacobian: aggregation.AlignedMTL()(jacobian).numpy(),
    "config": lambda jacobian: aggregation.ConFIG()(jacobian).numpy(),
    "mgda": gramian_weights(aggregation.MGDAWeighting()),
    "cagrad": gramian_weights(aggregation.CAGradWeighting(c=CAGRAD_RADIUS)),
    "fairgrad": gramian_weights(aggregation.FairGradWeighting(alpha=FAIR_ALPHA)),
    "upgrad": gramian_weights(aggregation.UPGradWeighting()),
    "dualproj": gramian_weights(aggregation.DualProjWeighting()),
    "nash_mtl": nash_weights(),
}


def random_directions(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Compute the directions [n, SIZE] of random methods by name, with the file's random numbers instead of PyTorch's."""
    jacobians = torch.from_numpy(arrays[f"{prefix}/jacobians"])
    results: dict[str, list[np.ndarray]] = {name: [] for name in ("pcgrad", "gradvac", "graddrop", "random")}
    for index, jacobian in enumerate(jacobians):
        orders = [torch.from_numpy(row) for row in arrays[f"{prefix}/orders"][index]]
        with mock.patch.object(torch, "randperm", side_effect=orders):
            results["pcgrad"].append(aggregation.PCGrad()(jacobian).numpy())
        # GradVac draws an order of the other losses: their positions among the remaining ones.
        others = [torch.tensor([j - (j > i) for j in row.tolist() if j != i]) for i, row in enumerate(orders)]
        vaccine, total = aggregation.GradVac(beta=VAC_BETA), torch.zeros(jacobian.shape[1])
        for _ in range(2):  # in the second step, the means are not 0
            with mock.patch.object(torch, "randperm", side_effect=list(others)):
                total = vaccine(jacobian)
        results["gradvac"].append(total.numpy())
        with mock.patch.object(torch, "rand", return_value=torch.from_numpy(arrays[f"{prefix}/uniform"][index])):
            results["graddrop"].append(aggregation.GradDrop()(jacobian).numpy())
        with mock.patch.object(torch, "randn", return_value=torch.from_numpy(arrays[f"{prefix}/normal"][index])):
            results["random"].append(aggregation.Random()(jacobian).numpy())
    return {name: np.stack(rows) for name, rows in results.items()}


def derivative(scalarizer: Any, losses: torch.Tensor) -> np.ndarray:
    """Return the weights: the derivative of a scalarised loss with respect to the losses [K]."""
    losses = losses.clone().requires_grad_()
    return torch.autograd.grad(scalarizer(losses), losses)[0].numpy()


def paths(losses: torch.Tensor) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and weights [STEPS, K] of each method that reads losses, for losses [STEPS, K]."""
    count = losses.shape[1]
    plain = {"geometric_mean": scalarization.GeometricMean(), "stch": scalarization.STCH(STCH_MU)}
    for name, scalarizer in plain.items():
        yield name, np.stack([derivative(scalarizer, values) for values in losses])
    for name, made in (("uncertainty", scalarization.UW(count)), ("imtl_l", scalarization.IMTLL(count))):
        made = made.double()
        optimizer, steps = torch.optim.Adam(made.parameters(), lr=1e-2), []
        for values in losses:
            steps.append(derivative(made, values))
            optimizer.zero_grad()
            made(values).backward()
            optimizer.step()
        yield name, np.stack(steps)
    average, steps = scalarization.DWA(), []
    for index, values in enumerate(losses):
        steps.append(derivative(average, values))
        if index % 2 == 1:
            average.step()
    yield "dwa", np.stack(steps)
    fast, steps = scalarization.FAMO(count).double(), []
    for index, values in enumerate(losses):
        if index:
            fast.update(values)
        steps.append(derivative(fast, values))
    yield "famo", np.stack(steps)


def compute(prefix: str, path: str) -> dict[str, np.ndarray]:
    """Compute all results for K losses, where ``prefix`` is K as text, from the file ``path``, by ``K/NAME``.

    Nash-MTL's weights are NaN for Jacobians without full rank.
    """
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    arrays = dict(np.load(path))
    jacobians, is_full = torch.from_numpy(arrays[f"{prefix}/jacobians"]), arrays[f"{prefix}/ranks"] == int(prefix)
    results: dict[str, np.ndarray] = {}
    for name, method in METHODS.items():
        # Takes seconds each, and linearly dependent gradients may have no solution: full rank only.
        chosen = is_full if name == "nash_mtl" else np.ones(len(jacobians), bool)
        directions = [method(jacobian) for jacobian in jacobians[torch.from_numpy(chosen)]]
        results[f"{prefix}/{name}"] = np.full((len(jacobians), len(directions[0])), np.nan)
        results[f"{prefix}/{name}"][chosen] = np.stack(directions)
        print(prefix, name, flush=True)
    results |= {f"{prefix}/{name}": value for name, value in random_directions(arrays, prefix).items()}
    by_path = [dict(paths(losses)) for losses in torch.from_numpy(arrays[f"{prefix}/losses"])]
    return results | {f"{prefix}/{name}": np.stack([outcome[name] for outcome in by_path]) for name in by_path[0]}


def main() -> None:
    """Read the file of Jacobians and write the file of results, with one process per number of losses."""
    prefixes = sorted({name.split("/")[0] for name in np.load(sys.argv[1])})
    results: dict[str, Any] = {"versions": np.array([f"torchjd {version('torchjd')}", f"torch {torch.__version__}"])}
    with multiprocessing.get_context("spawn").Pool(len(prefixes)) as pool:
        for part in pool.starmap(compute, [(prefix, sys.argv[1]) for prefix in prefixes]):
            results |= part
    np.savez(sys.argv[2], **results)


if __name__ == "__main__":
    main()
