"""Contract of an exported policy: all information needed to call it on a robot, in contract.json beside the file."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import is_count, read_json
from jaxrl_vis.run.exported.golden import COUNT
from jaxrl_vis.run.exported.golden import FILE as GOLDEN
from jaxrl_vis.run.exported.layers import INPUTS, OUTPUT
from jaxrl_vis.run.storage.folder import read_record
from jaxrl_vis.run.trained.policy import Policy
from jaxrl_vis.run.trained.results import describe
from jaxrl_vis_envs.render import Scene

FILE, SCHEMA = "contract.json", 1
FORMATS = {"onnx": "policy.onnx", "stablehlo": "policy.stablehlo", "safetensors": "policy.safetensors"}
"""Name of the policy's file by format."""
TOLERANCE = 1e-4
"""Maximum difference from our own actions at which a file passes; actions lie in [-1, 1]."""
_DTYPES = ("uint8", "float32")
_COLOURS = ("red", "green", "blue")

Form = tuple[tuple[int, ...], str]
"""Shape without the batch, and dtype."""


@dataclasses.dataclass(frozen=True)
class Contract:
    """Contract as read from a file.

    Attributes:
        format: Format, a key of `FORMATS`.
        file: Path of the policy.
        golden: Path of the golden frames.
        forms: Form of ``observation``, ``goal`` and ``action``.
        values: The whole contract, a JSON value.
    """

    format: str
    file: Path
    golden: Path
    forms: dict[str, Form]
    values: dict[str, Any]


def make_contract(
    policy: Policy, run_dir: Path, kind: str, unclipped: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> dict[str, Any]:
    """Create the contract of a policy.

    Args:
        policy: The policy.
        run_dir: Folder of its run.
        kind: A key of `FORMATS`.
        unclipped: Minimum and maximum [S] of each state input that are not clipped, by name; empty for images or if unknown.

    Returns:
        A JSON value.
    """
    env, record, config = policy.env, read_record(run_dir), policy.config
    shape, dtype = list(policy.observation_spec.shape), str(policy.observation_spec.dtype)
    task: dict[str, Any] = {
        "name": policy.env_name,
        "horizon": int(env.horizon),
        "threshold": float(env.threshold),
        "distance_unit": env.distance_unit,
        "settings": _plain(getattr(env, "config", None)),
    }
    inputs = []
    for name in INPUTS:
        limits = [0, 255] if dtype == "uint8" else None
        if name in unclipped:
            limits = [np.asarray(end, np.float64).tolist() for end in unclipped[name]]
        inputs.append({"name": name, "shape": ["batch", *shape], "dtype": dtype, "range": limits})
    return {
        "schema": SCHEMA,
        "format": kind,
        "file": FORMATS[kind],
        "golden": {"file": GOLDEN, "count": COUNT, "tolerance": TOLERANCE},
        "task": task,
        "inputs": inputs,
        "image": _image(policy) if len(shape) == 3 else None,
        "outputs": [
            {
                "name": OUTPUT,
                "shape": ["batch", int(policy.action_size)],
                "dtype": "float32",
                "range": [-1.0, 1.0],
                "meaning": env.action_meaning or None,
            }
        ],
        "control_period_s": float(env.control_period),
        "run": {
            "revision": record.get("git_revision"),
            "versions": record.get("versions"),
            "id": record.get("run_id"),
            "seed": policy.seed,
            "iteration": policy.iteration,
            "training": f"{config.run.algorithm}, {describe(config)}",
        },
    }


def _image(policy: Policy) -> dict[str, Any]:
    """Describe the image of a task: channels, depth, camera."""
    env = policy.env
    config, scene = getattr(env, "config", None), getattr(env, "scene", None)
    pixels = getattr(config, "pixels", None)
    described: dict[str, Any] = {
        "layout": "planar: [channel, row, column], row 0 at the top",
        "frame_stack": int(env.frame_stack),
        "stacking": "channels of the newest image first, then of those one, two, ... control steps before; goals repeat theirs",
        "channels": None if pixels is None else _channels(pixels),
        "depth": None,
        "camera": None,
    }
    if pixels in ("rgbd", "depth"):
        is_metric = config.depth_encoding == "metric"  # pyright: ignore[reportOptionalMemberAccess]
        ends = config.depth_range if is_metric else config.clip_range  # pyright: ignore[reportOptionalMemberAccess]
        described["depth"] = {
            "encoding": "metric: planar depth along the camera's axis, linear from 0 to 255, clipped outside"
            if is_metric
            else "zbuffer: far / (far - near) * (1 - near / depth), times 255",
            "range_m": [float(end) for end in ends],
        }
    if isinstance(scene, Scene) and scene.projection != "orthographic":
        described["camera"] = {
            "name": getattr(env, "camera", None),
            "width": int(scene.width),
            "height": int(scene.height),
            "intrinsics": np.asarray(scene.intrinsics(), np.float64).tolist(),
            "convention": "OpenCV: x right, y down, z ahead; pixels, (0, 0) is the centre of the top left one",
        }
    return described


def _channels(pixels: str) -> list[str]:
    return [*(_COLOURS if pixels != "depth" else ()), *(("depth",) if pixels != "rgb" else ())]


def _plain(config: Any) -> Any:
    """Return an environment's configuration as a JSON value, without fields of other types; None if it is not a dataclass."""
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        return None
    simple = (str, int, float, bool, list, tuple, dict, type(None))
    return {name: value for name, value in dataclasses.asdict(config).items() if isinstance(value, simple)}


def read_contract(path: Path) -> Contract:
    """Read the contract of an exported policy.

    Args:
        path: The policy's file, the contract, or the folder of both.

    Raises:
        RequestError: The contract is missing or damaged, describes another file, or the policy is missing.
    """
    folder = path if path.is_dir() else path.parent
    file, hint = folder / FILE, "export again with --overwrite"
    if not file.exists():
        subject = path if path.exists() else f"{path} does not exist, and"
        raise RequestError(f"{subject} has no {FILE} beside it: name a file that `jaxrl-vis export` wrote")
    values = read_json(file, hint=hint)
    try:
        if values["schema"] != SCHEMA:
            raise RequestError(f"{file} is of schema {values['schema']!r}, not {SCHEMA}: use the version that wrote it")
        name = FORMATS[values["format"]]
        forms = {part["name"]: _form(part) for part in [*values["inputs"], *values["outputs"]]}
        if set(forms) != {*INPUTS, OUTPUT} or values["file"] != name or values["golden"]["file"] != GOLDEN:
            raise ValueError
    except RequestError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise RequestError(f"{file} is not a contract of an exported policy: {hint}") from error
    if path.is_file() and path.name not in (name, FILE):
        raise RequestError(f"{file} describes {name}, not {path.name}: name that file")
    if not (folder / name).is_file():
        raise RequestError(f"{folder / name} is missing: {hint}")
    return Contract(values["format"], folder / name, folder / GOLDEN, forms, values)


def _form(entry: dict[str, Any]) -> Form:
    """Read the form of an input or output.

    Raises:
        ValueError, TypeError, KeyError: ``entry`` is invalid.
    """
    batch, *shape = entry["shape"]
    if batch != "batch" or entry["dtype"] not in _DTYPES or not 1 <= len(shape) <= 3:
        raise ValueError(entry)
    if not all(is_count(size) and 0 < size < 1 << 16 for size in shape):
        raise ValueError(shape)
    return tuple(shape), entry["dtype"]
