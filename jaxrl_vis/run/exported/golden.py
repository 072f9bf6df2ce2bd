"""Golden frames: inputs from the task, with the actions of our own policy, in an .npz file."""

import io
import zipfile
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.exported.layers import INPUTS, OUTPUT
from jaxrl_vis.run.trained.policy import Policy
from jaxrl_vis.run.trainer import Trainer
from jaxrl_vis.types import TrainState

COUNT = 32
FILE = "golden.npz"


class Golden(NamedTuple):
    """Inputs and outputs of a policy.

    Attributes:
        observation, goal: [32, ...] in the dtype of the task.
        action: [32, A] float32.
    """

    observation: np.ndarray
    goal: np.ndarray
    action: np.ndarray


def record(trainer: Trainer, train: TrainState, policy: Policy) -> Golden:
    """Record 32 frames, evenly spaced over the recorded episodes of an evaluation, with their goals and the policy's actions.

    They are the same at every call.

    Args:
        trainer: From `open_run`, with few episodes per evaluation.
        train: The learner, [S, ...].
        policy: The policy of one of its seeds.
    """
    _, recorded = trainer.programs.evaluate(train)
    index = trainer.seeds.index(policy.seed)
    frames, goals = (
        np.asarray(jax.device_get(recorded[name]))[index] for name in ("frames", "goals")
    )  # [K, T+1, ...], [K, ...]
    episodes, steps = frames.shape[:2]
    stack = policy.env.frame_stack
    chosen = np.linspace(0, episodes * steps - 1, COUNT).astype(int)
    observations, aims = [], []
    for episode, step in zip(*divmod(chosen, steps), strict=True):
        # Stack images, the newest first; at the start of an episode, its first image is repeated.
        images = [frames[episode, max(step - age, 0)] for age in range(stack)]
        observations.append(np.concatenate(images) if stack > 1 else images[0])
        aims.append(np.concatenate([goals[episode]] * stack) if stack > 1 else goals[episode])
    observation, goal = np.stack(observations), np.stack(aims)
    with jax.default_matmul_precision("highest"):
        action = np.asarray(jax.vmap(policy)(observation, goal))
    return Golden(observation, goal, action)


def to_bytes(golden: Golden) -> bytes:
    """Return golden frames as the contents of a compressed .npz file."""
    file = io.BytesIO()
    np.savez_compressed(file, **golden._asdict())
    return file.getvalue()


def read(path: Path, forms: dict[str, tuple[tuple[int, ...], str]]) -> Golden:
    """Read golden frames.

    Args:
        path: The file.
        forms: Shape without the batch, and dtype, of ``observation``, ``goal`` and ``action``.

    Raises:
        RequestError: The file is missing or damaged, or its arrays have other shapes.
    """
    hint = "export again with --overwrite"
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        for name in (*INPUTS, OUTPUT):
            shape, dtype = forms[name]
            max_bytes = COUNT * int(np.prod(shape)) * np.dtype(dtype).itemsize + 1024
            if not 0 < sizes.get(f"{name}.npy", 0) <= max_bytes:  # before anything is unpacked
                raise RequestError(f"{path} has no {COUNT} frames of {name} as the contract says: {hint}")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in (*INPUTS, OUTPUT)}
    except FileNotFoundError as error:
        raise RequestError(f"{path} is missing: {hint}") from error
    except RequestError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise various exceptions
        raise RequestError(f"{path} is damaged ({type(error).__name__}): {hint}") from error
    for name, array in arrays.items():
        shape, dtype = forms[name]
        if array.shape != (COUNT, *shape) or array.dtype != np.dtype(dtype):
            raise RequestError(f"{path}: {name} is {array.dtype} {array.shape}, not {dtype} {(COUNT, *shape)}: {hint}")
    return Golden(**arrays)
