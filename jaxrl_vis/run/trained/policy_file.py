"""Weights of a policy in one file beside config.json: a folder with these two files can be loaded like a run."""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import is_count
from jaxrl_vis.host.weights_file import read_about, read_parameters, write_parameters
from jaxrl_vis.learner.algorithm import PolicyParams
from jaxrl_vis.run.trained.shipped import find
from jaxrl_vis.run.trainer import Trainer
from jaxrl_vis.types import NormalizerState, TrainState

FILE_NAME = "policy.safetensors"
_WRITER = "jaxrl-vis push"
_SAME = "same"  # in the description: arrays that are not in the file -> those that they equal


class Source(NamedTuple):
    """Origin of a policy.

    Attributes:
        seed: Seed of the run that trained it.
        iteration: Iteration of its checkpoint.
    """

    seed: int
    iteration: int


def holds_policy(folder: Path) -> bool:
    """Return True if a folder contains the weights of a policy, but no checkpoints of its run."""
    return (folder / FILE_NAME).is_file() and not (folder / "checkpoints").exists()


def check_whole(run_dir: Path | str, use: str) -> None:
    """Raise a `RequestError` if a folder contains only a policy.

    Args:
        run_dir: The folder.
        use: Purpose that requires the whole learner, for the message.
    """
    if holds_policy(find(run_dir)):
        raise RequestError(f"{run_dir} holds a policy alone, and {use} needs the whole run: name the run folder")


def _name_parameters(parameters: PolicyParams) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(parameters)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def write(folder: Path, parameters: PolicyParams, source: Source, bits: Literal[16, 32] = 32) -> None:
    """Write the parameters of a policy into ``folder``.

    Args:
        folder: The folder.
        parameters: The parameters, float32.
        source: Their origin.
        bits: Bits per number. Observation statistics always keep 32, because their sums exceed the range of float16.

    Raises:
        OSError: The file cannot be written.
    """
    statistics = jax.tree.map(
        lambda part: jax.tree.map(lambda _: isinstance(part, NormalizerState), part),
        parameters,
        is_leaf=lambda part: isinstance(part, NormalizerState),
    )
    exact = [name for name, is_statistic in _name_parameters(statistics).items() if is_statistic]
    arrays, same = {name: np.asarray(leaf) for name, leaf in _name_parameters(parameters).items()}, {}
    for index, name in enumerate(exact):  # goals mostly have the statistics of observations
        first = next((other for other in exact[:index] if np.array_equal(arrays[other], arrays[name])), None)
        same |= {} if first is None else {name: first}
    written = {name: array for name, array in arrays.items() if name not in same}
    write_parameters(folder / FILE_NAME, written, {**source._asdict(), _SAME: same}, bits, exact)


def read_source(folder: Path) -> Source:
    """Read the origin of a folder's policy.

    Raises:
        RequestError: The file is damaged.
    """
    return _source(folder, read_about(folder / FILE_NAME, _WRITER))


def _source(folder: Path, about: dict[str, Any]) -> Source:
    source = Source(about.pop("seed", None), about.pop("iteration", None))
    if not all(map(is_count, source)):
        raise RequestError(f"{folder / FILE_NAME} does not say of which seed and iteration it is: push the run again")
    return source


def read(folder: Path, trainer: Trainer) -> tuple[TrainState, Source]:
    """Read a policy as a learner of one seed, whose agent consists of the policy's parameters; return it and its origin.

    Args:
        folder: Folder written by `write`.
        trainer: Trainer of the folder's configuration, from `make_trainer` with ``policy_alone``.

    Raises:
        RequestError: The file is damaged, or belongs to another configuration.
    """
    shapes = trainer.shapes.train
    expected = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), shapes.agent)

    same: dict[str, str] = {}

    def declare(about: dict[str, Any]) -> tuple[Source, dict[str, Any]]:
        named = _name_parameters(expected)
        aliases = about.pop(_SAME, {})
        if not isinstance(aliases, dict) or not all(isinstance(other, str) for other in aliases.values()):
            raise ValueError(_SAME)
        same.update(aliases)
        if any(named[name].shape != named[other].shape or other in same for name, other in same.items()):
            raise ValueError("an array is not the same as another one")
        return _source(folder, about), {name: leaf for name, leaf in named.items() if name not in same}

    nested, source, _ = read_parameters(folder / FILE_NAME, _WRITER, declare)
    read_leaves = _name_parameters(nested)
    leaves = [read_leaves[same.get(name, name)].astype(leaf.dtype)[None] for name, leaf in _name_parameters(expected).items()]
    nothing_seen = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return nothing_seen.replace(agent=jax.tree.unflatten(jax.tree.structure(expected), leaves)), source


def check_source(source: Source, seed: int | None = None, checkpoint: int | str | None = None) -> None:
    """Raise a `RequestError` if the requested seed or checkpoint is not that of the folder."""
    if seed not in (None, source.seed) or checkpoint not in (None, source.iteration):
        raise RequestError(f"the folder holds the policy of seed {source.seed} after iteration {source.iteration} alone")
