"""Policies as ONNX: `PolicyWeights` are written node by node as a graph, run by onnxruntime. Both are the extra ``export``."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.run.exported.layers import INPUTS, OUTPUT, PolicyWeights

# Old enough for runtimes of 2022, including browsers.
_OPSET, _IR_VERSION = 17, 8
BATCH = "batch"


def require() -> tuple[Any, Any]:
    """Import onnx and onnxruntime, and return both modules.

    Raises:
        RequestError: One of them is missing.
    """
    try:
        return importlib.import_module("onnx"), importlib.import_module("onnxruntime")
    except ImportError as error:
        raise RequestError(f"--format onnx needs onnx and onnxruntime: {install_command('export')}") from error


class _Graph:
    """Nodes and initializers of a graph under construction."""

    def __init__(self, onnx: Any):
        self._onnx = onnx
        self.nodes: list[Any] = []
        self.initializers: dict[str, Any] = {}

    def constant(self, name: str, array: np.ndarray) -> str:
        self.initializers.setdefault(name, self._onnx.numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def node(self, operation: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(self._onnx.helper.make_node(operation, inputs, [output], name=output, **attributes))
        return output

    def dense(self, values: str, layers: PolicyWeights, name: str, output: str) -> str:
        kernel, bias = (self.constant(f"{name}/{part}", layers.arrays[f"{name}/{part}"]) for part in ("kernel", "bias"))
        return self.node("Gemm", [values, kernel, bias], output)


def to_bytes(layers: PolicyWeights, shape: tuple[int, ...], dtype: np.dtype, about: str = "") -> bytes:
    """Write a policy as an ONNX model: observation and goal [batch, ...] -> action [batch, A] float32.

    Args:
        layers: The policy.
        shape, dtype: Shape and dtype of an observation.
        about: Description stored in the model.

    Raises:
        RequestError: onnx or onnxruntime is missing.
    """
    onnx, _ = require()
    helper, graph = onnx.helper, _Graph(onnx)
    latents = [_latent(graph, onnx, layers, name) for name in INPUTS]
    values = graph.node("Concat", latents, "latents", axis=1)
    for layer in range(layers.hidden_layers):
        values = graph.dense(values, layers, f"head/{layer}", f"head/{layer}/sum")
        values = graph.node("Relu", [values], f"head/{layer}/values")
    values = graph.dense(values, layers, "head/output", "head/output/sum")
    graph.node("Tanh", [values], OUTPUT)
    size = layers.arrays["head/output/bias"].shape[0]
    kind = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    inputs = [helper.make_tensor_value_info(name, kind, [BATCH, *shape]) for name in INPUTS]
    outputs = [helper.make_tensor_value_info(OUTPUT, onnx.TensorProto.FLOAT, [BATCH, size])]
    graph_proto = helper.make_graph(graph.nodes, "policy", inputs, outputs, list(graph.initializers.values()))
    opset = [helper.make_opsetid("", _OPSET)]
    model = helper.make_model(
        graph_proto, producer_name="jaxrl-vis", opset_imports=opset, ir_version=_IR_VERSION, doc_string=about
    )
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _latent(graph: _Graph, onnx: Any, layers: PolicyWeights, name: str) -> str:
    """Add the normalisation and the encoder of one input; return the name of its latent [batch, latent]."""
    source = layers.scaling(name)
    mean, scale = (graph.constant(f"{source}/{part}", layers.arrays[f"{source}/{part}"]) for part in ("mean", "scale"))
    low, high = (
        graph.constant(end, np.array(value, np.float32)) for end, value in (("low", -layers.limit), ("high", layers.limit))
    )
    values = graph.node("Cast", [name], f"{name}/float", to=onnx.TensorProto.FLOAT)
    values = graph.node("Sub", [values, mean], f"{name}/centred")
    values = graph.node("Mul", [values, scale], f"{name}/scaled")
    values = graph.node("Clip", [values, low, high], f"{name}/normalized")
    for level in range(layers.convolutions):
        weights = [graph.constant(key, layers.arrays[key]) for key in (f"encoder/{level}/kernel", f"encoder/{level}/bias")]
        values = graph.node("Conv", [values, *weights], f"{name}/{level}/sum", kernel_shape=[2, 2], strides=[2, 2])
        values = graph.node("Relu", [values], f"{name}/{level}/values")
    if not layers.convolutions:
        return values
    values = graph.node("Transpose", [values], f"{name}/channels_last", perm=[0, 2, 3, 1])
    values = graph.node("Flatten", [values], f"{name}/features", axis=1)
    return graph.dense(values, layers, "encoder/latent", f"{name}/latent")


class Model:
    """ONNX model on the CPU, through onnxruntime.

    Args:
        path: The file.

    Attributes:
        inputs, outputs: Shape (with a name or None for a free size) and NumPy dtype of each, by name.

    Raises:
        RequestError: onnxruntime is missing, or cannot run the file.
    """

    def __init__(self, path: Path):
        _, runtime = require()
        options = runtime.SessionOptions()
        options.log_severity_level = 4  # otherwise exceptions are also logged on stderr
        try:
            contents = path.read_bytes()
            self._session = runtime.InferenceSession(contents, options, providers=["CPUExecutionProvider"])
        except OSError as error:
            raise RequestError(f"cannot read {path} ({error.strerror or error})") from error
        except Exception as error:  # onnxruntime's exceptions have no common base class
            raise RequestError(
                f"{path} is not an ONNX model that onnxruntime can run ({_first_line(error)}): export it again"
            ) from None
        self.inputs = {part.name: (tuple(part.shape), _dtype(part.type)) for part in self._session.get_inputs()}
        self.outputs = {part.name: (tuple(part.shape), _dtype(part.type)) for part in self._session.get_outputs()}

    def __call__(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Compute the actions [N, A] float32 of a batch."""
        return self._session.run([OUTPUT], dict(zip(INPUTS, (observation, goal), strict=True)))[0]


def _dtype(kind: str) -> str:
    """Return the NumPy dtype name of an onnxruntime type such as ``tensor(float)``."""
    name = kind.removeprefix("tensor(").removesuffix(")")
    return {"float": "float32", "double": "float64"}.get(name, name)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
