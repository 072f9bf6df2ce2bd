"""A policy's weights in one file beside config.json: a folder of these two can be loaded as a run can."""

from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import is_count
from jaxrl_vis.host.weights_file import read_parameters, write_parameters
from jaxrl_vis.learner.algorithm import PolicyParams
from jaxrl_vis.run.trainer import Trainer

FILE_NAME = "policy.safetensors"


class Source(NamedTuple):
    """Origin of a policy.

    Attributes:
        seed: Seed of the run that trained it.
        iteration: Iteration of its checkpoint.
    """

    seed: int
    iteration: int


def holds_policy(folder: Path) -> bool:
    """Return True if a folder holds the weights of a policy and no checkpoints of its run."""
    return (folder / FILE_NAME).is_file() and not (folder / "checkpoints").exists()


def _named(parameters: PolicyParams) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(parameters)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def write(folder: Path, parameters: PolicyParams, source: Source) -> None:
    """Write the parameters of a policy, float32, into ``folder``.

    Raises:
        OSError: The file cannot be written.
    """
    write_parameters(folder / FILE_NAME, _named(parameters), source._asdict(), bits=32)


def read(folder: Path, trainer: Trainer) -> tuple[PolicyParams, Source]:
    """Read the parameters of a policy.

    Args:
        folder: A folder of `write`.
        trainer: Trainer of the configuration in the folder.

    Raises:
        RequestError: The file is damaged, or belongs to another configuration.
    """
    train = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), trainer.shapes.train)
    wanted = jax.eval_shape(trainer.program.algorithm.policy_params, train.agent, train.statistics)

    def declare(about: dict[str, Any]) -> tuple[Source, dict[str, Any]]:
        source = Source(about.pop("seed"), about.pop("iteration"))
        if not all(map(is_count, source)):
            raise ValueError("seed and iteration must be whole numbers")
        return source, _named(wanted)

    nested, source, _ = read_parameters(folder / FILE_NAME, "jaxrl-vis push", declare)
    read_leaves = _named(nested)
    leaves = [read_leaves[name].astype(leaf.dtype) for name, leaf in _named(wanted).items()]
    return jax.tree.unflatten(jax.tree.structure(wanted), leaves), source


def check_seed(source: Source, seed: int | None, checkpoint: int | str | None) -> None:
    """Raise a `RequestError` if another seed or checkpoint is asked for than the folder holds."""
    if seed not in (None, source.seed) or checkpoint not in (None, source.iteration):
        raise RequestError(f"the folder holds the policy of seed {source.seed} after iteration {source.iteration} alone")
