"""Writing a run's policy to a folder, and checking such a folder against its golden frames."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.weights_file import read_parameters, write_parameters
from jaxrl_vis.learner.acting.evaluate import num_recorded
from jaxrl_vis.report.outputs import check_writable
from jaxrl_vis.run.exported import contract as contracts
from jaxrl_vis.run.exported import golden, onnx_file, stablehlo
from jaxrl_vis.run.exported.contract import FORMATS, TOLERANCE, Contract
from jaxrl_vis.run.exported.layers import COMPUTATION, INPUTS, PolicyWeights, forward, layers_of
from jaxrl_vis.run.storage.folder import EXPORT_FOLDER
from jaxrl_vis.run.trained.policy import Policy, choose_seed, make_policy
from jaxrl_vis.run.trained.restored_run import Choice, load, open_run
from jaxrl_vis.run.trained.shipped import find, output_folder

_EPISODES = 8


class Check(NamedTuple):
    """Result of a check of an exported policy.

    Attributes:
        file: Path of the policy.
        difference: Maximum absolute difference from our own actions on the golden frames.
        count: Number of frames.
    """

    file: Path
    difference: float
    count: int

    @property
    def passed(self) -> bool:
        """True if the difference is within the tolerance."""
        return self.difference <= TOLERANCE  # False for NaN


def export_run(
    run_dir: Path | str,
    kind: str,
    out: Path | str | None = None,
    seed: int | None = None,
    checkpoint: Choice = None,
    overwrite: bool = False,
    trust: bool = False,
) -> Check:
    """Export the policy of a run, including normalisation and without exploration, and check the file.

    The folder receives the policy, contract.json and golden.npz. The policy is that of `load_policy`, in float32.

    Args:
        run_dir: The run folder, or the name of a policy that comes with the package.
        kind: ``onnx``, ``stablehlo`` or ``safetensors``.
        out: The folder; None for export/KIND in the run folder.
        seed, checkpoint, trust: As in `load_policy`.
        overwrite: Whether to replace an exported policy in ``out``.

    Returns:
        The result of `check_file` on the written folder.

    Raises:
        RequestError: The run cannot be used, the policy does not support the format, a library is missing, or ``out`` is not
            empty.
        StorageError: A file cannot be written.
    """
    if kind not in FORMATS:
        raise RequestError(f"--format {kind} is unknown: choose one of {', '.join(FORMATS)}")
    if kind == "onnx":
        onnx_file.require()
    run_dir = find(run_dir)
    folder = output_folder(run_dir) / EXPORT_FOLDER / kind if out is None else Path(out)
    _check_folder(folder, overwrite)
    # No other library would reproduce the rounding of networks in bfloat16 or TF32.
    trainer = open_run(run_dir, True, trust, eval_episodes=num_recorded(_EPISODES), compute_dtype="float32")
    seed = choose_seed(trainer, run_dir, seed)
    restored = load(trainer, run_dir, checkpoint)
    policy = make_policy(trainer, restored, seed)
    layers = None if kind == "stablehlo" else layers_of(policy)
    frames = golden.record(trainer, restored.train, policy)
    contract = contracts.make_contract(policy, run_dir, kind, _input_ranges(policy))
    _write(folder, kind, policy, layers, frames, contract)
    return check_file(folder)


def _check_folder(folder: Path, overwrite: bool) -> None:
    """Raise a RequestError if ``folder`` is a file, or has other contents than an exported policy to ``overwrite``."""
    check_writable(folder, "--out", folder=True)
    names = {entry.name for entry in folder.iterdir()} if folder.exists() else set()
    if names and contracts.FILE not in names:
        raise RequestError(f"{folder} holds other files: name an empty or a new folder with --out")
    if names and not overwrite:
        raise RequestError(f"{folder} holds an exported policy: --overwrite replaces it, or name another folder with --out")


def _input_ranges(policy: Policy) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the unclipped range (low [S], high [S]) of each input of a state policy; empty for images or if unknown."""
    if len(policy.observation_spec.shape) == 3:
        return {}
    try:
        layers = layers_of(policy)
    except RequestError:
        return {}
    ranges = {}
    for name in INPUTS:
        mean, scale = (layers.arrays[f"{layers.scaling(name)}/{part}"] for part in ("mean", "scale"))
        ranges[name] = (mean - layers.limit / scale, mean + layers.limit / scale)
    return ranges


def _write(
    folder: Path, kind: str, policy: Policy, layers: PolicyWeights | None, frames: golden.Golden, contract: dict[str, Any]
) -> None:
    """Write the files, the contract last, so that an interrupted export has no contract. ``layers`` is None for StableHLO.

    Raises:
        StorageError: A file cannot be written.
    """
    file, described = folder / FORMATS[kind], folder / contracts.FILE
    contents = b""  # created before existing files are deleted
    if kind == "stablehlo":
        contents = stablehlo.to_bytes(policy)
    elif kind == "onnx" and layers is not None:
        spec = policy.observation_spec
        about = f"{policy.env_name}: observation and goal to action; see {contracts.FILE}"
        contents = onnx_file.to_bytes(layers, spec.shape, np.dtype(spec.dtype), about)
    elif layers is not None:
        shapes = {name: list(array.shape) for name, array in layers.arrays.items()}
        contract["network"] = {"limit": layers.limit, "shapes": shapes, "computation": list(COMPUTATION)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        described.unlink(missing_ok=True)
        for name in set(FORMATS.values()) - {file.name}:
            (folder / name).unlink(missing_ok=True)
        if contents:
            write_atomically(file, contents)
        elif layers is not None:
            write_parameters(file, layers.nested(), {"contract": contract}, bits=32)
        write_atomically(folder / golden.FILE, golden.to_bytes(frames))
        write_atomically(described, json.dumps(contract, indent=2) + "\n")
    except OSError as error:
        raise StorageError(f"cannot write to {folder} ({error.strerror or error}): make room, or name another --out") from error


def check_file(path: Path | str) -> Check:
    """Run an exported policy on its golden frames, and return the result of the comparison with their actions.

    Args:
        path: The policy's file, or its folder.

    Raises:
        RequestError: A file is missing or damaged, the policy does not fit its contract, or a library is missing.
    """
    contract = contracts.read_contract(Path(path))
    frames = golden.read(contract.golden, contract.forms)
    run = _load_weights(contract) if contract.format == "safetensors" else _load_program(contract)
    try:
        action = run(frames.observation, frames.goal)
    except Exception as error:  # the file may contain an arbitrary graph
        reason = " ".join(str(error).split())[:120]
        raise RequestError(f"{contract.file} cannot be run on its golden frames ({reason}): export it again") from error
    if action.shape != frames.action.shape:
        raise RequestError(f"{contract.file} gives actions {action.shape}, not {frames.action.shape}: export it again")
    return Check(contract.file, float(np.max(np.abs(action.astype(np.float64) - frames.action))), len(frames.action))


def _load_program(contract: Contract) -> Any:
    """Load a policy in ONNX or StableHLO, and compare its inputs and outputs with the contract.

    Raises:
        RequestError: The file cannot be loaded, or does not fit the contract.
    """
    model = (onnx_file.Model if contract.format == "onnx" else stablehlo.Program)(contract.file)
    tensors = {**model.inputs, **model.outputs}
    for name, (shape, dtype) in contract.forms.items():
        if name not in tensors:
            raise RequestError(f"{contract.file} has no {name}, which its contract names: export it again")
        (_, *sizes), kind = tensors[name]
        if tuple(sizes) != shape or kind != dtype:
            raise RequestError(
                f"{contract.file} does not fit its contract, {name} is {kind} {tuple(sizes)} and not {dtype} {shape}: "
                "export it again"
            )
    return model


def _load_weights(contract: Contract) -> Any:
    """Load weights, and return their forward pass in NumPy."""

    def declare(about: dict[str, Any]) -> tuple[float, Any]:
        network = about["contract"]["network"]
        limit = float(network["limit"])
        if not limit > 0:
            raise ValueError("limit")
        shapes: dict[str, Any] = {}
        for name, shape in network["shapes"].items():
            if not all(isinstance(size, int) and size > 0 for size in shape):
                raise ValueError(name)
            shapes[name] = np.broadcast_to(np.float32(0), shape)  # a view, of any size
        return limit, PolicyWeights(limit, shapes).nested()

    params, limit, about = read_parameters(contract.file, "jaxrl-vis export", declare)
    arrays = {name: np.asarray(_leaf(params, name)) for name in about["contract"]["network"]["shapes"]}
    layers = PolicyWeights(limit, arrays)
    return lambda observation, goal: forward(layers, observation, goal)


def _leaf(params: Any, name: str) -> Any:
    for part in name.split("/"):
        params = params[part]
    return params
