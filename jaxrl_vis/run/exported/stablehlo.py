"""Policies as StableHLO, serialised by `jax.export`, which JAX runs without this project."""

from pathlib import Path

import jax
import numpy as np
from jax import export

from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.exported.layers import INPUTS, OUTPUT
from jaxrl_vis.run.trained.policy import Policy

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
_MAX_BYTES = 1 << 30  # bytes


def to_bytes(policy: Policy) -> bytes:
    """Serialise a policy: observation and goal [batch, ...] -> action [batch, A] float32, for any batch and all `PLATFORMS`.

    Raises:
        RequestError: JAX cannot export the policy.
    """
    # Parameters as NumPy arrays become constants of the program.
    parameters, algorithm = jax.tree.map(np.asarray, policy.parameters), policy.algorithm

    def act(observation: jax.Array, goal: jax.Array) -> jax.Array:
        with jax.default_matmul_precision("highest"):
            return algorithm.act(parameters, observation, algorithm.encode_goal(parameters, goal))

    (batch,) = export.symbolic_shape("batch")
    spec = jax.ShapeDtypeStruct((batch, *policy.observation_spec.shape), policy.observation_spec.dtype)
    try:
        return bytes(export.export(jax.jit(act), platforms=PLATFORMS)(spec, spec).serialize())
    except Exception as error:  # custom policies may raise anything
        reason = " ".join(str(error).split())[:160]
        raise RequestError(
            f"the policy of algorithm {policy.config.run.algorithm} cannot be exported for any batch and platform ({reason})"
        ) from error


class Program:
    """Exported program.

    Args:
        path: The file.

    Attributes:
        inputs, outputs: Shape (with None for a free size) and NumPy dtype of each, by name.

    Raises:
        RequestError: The file is not an exported policy.
    """

    def __init__(self, path: Path):
        try:
            if path.stat().st_size > _MAX_BYTES:
                raise RequestError(f"{path} is larger than any policy: export it again")
            self._exported = export.deserialize(bytearray(path.read_bytes()))
            self.inputs = {name: _form(aval) for name, aval in zip(INPUTS, self._exported.in_avals, strict=True)}
            self.outputs = {name: _form(aval) for name, aval in zip((OUTPUT,), self._exported.out_avals, strict=True)}
        except RequestError:
            raise
        except OSError as error:
            raise RequestError(f"cannot read {path} ({error.strerror or error})") from error
        except Exception as error:  # flatbuffers raises arbitrary exceptions on damaged offsets
            raise RequestError(
                f"{path} is not a StableHLO program that JAX {jax.__version__} can read: export it again"
            ) from error

    def __call__(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Compute the actions [N, A] float32 of a batch."""
        return np.asarray(self._exported.call(observation, goal))


def _form(aval: jax.core.ShapedArray) -> tuple[tuple[int | None, ...], str]:
    return tuple(size if isinstance(size, int) else None for size in aval.shape), str(aval.dtype)
