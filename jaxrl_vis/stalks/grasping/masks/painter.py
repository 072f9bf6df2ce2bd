"""Inference of masks by a trained generator, and files of its weights."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxrl_vis.config import fields
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.weights_file import check_range, read_parameters, write_parameters
from jaxrl_vis.stalks.grasping.masks.mask_networks import Generator
from jaxrl_vis.stalks.grasping.perception.cloud import MASK_THRESHOLD, redness

Loss = Literal["gan", "segmentation"]
SHIPPED = Path(__file__).with_name("stalks_segmentation.safetensors")
"""File of weights shipped with the package: a plain segmentation, trained on synthetic stalks."""
SCHEMA = 1
_COMMAND = "jaxrl-vis grasp train"


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a generator.

    Attributes:
        loss: Loss of the training; with ``gan`` the generator paints images, with ``segmentation`` it returns logits.
        channels: Channels of each level, multiples of 8.
    """

    loss: Loss = "segmentation"
    channels: tuple[int, ...] = (16, 32, 64, 96, 128, 128)

    @property
    def multiple(self) -> int:
        """Number of pixels by which the height and width of the network's input must be divisible."""
        return 2 ** len(self.channels)

    def generator(self, dtype: Any) -> Generator:
        """Return the network, with convolutions computed in ``dtype``."""
        return Generator(self.channels, 3 if self.loss == "gan" else 1, dtype)


_HINTS = fields.hints(Settings)
_MAX_LEVELS = 10  # each level halves height and width


def normalize(images: jax.Array) -> jax.Array:
    """Convert images of any shape from uint8 to float32 in -1 to 1."""
    return images.astype(jnp.float32) / 127.5 - 1.0


def compute_dtype() -> Any:
    """Return the compute dtype of convolutions on JAX's default backend: bfloat16 on GPU and TPU, else float32."""
    return jnp.bfloat16 if jax.default_backend() in ("gpu", "tpu") else jnp.float32


class Painter:
    """Trained generator that segments the stalks of the near row.

    Attributes:
        settings: Settings of the generator.
    """

    def __init__(self, params: Any, settings: Settings) -> None:
        """Initialise the painter; an image size is compiled when it is first used.

        Args:
            params: Parameters of the generator.
            settings: Settings of the generator.
        """
        self._params, self.settings = params, settings
        network = settings.generator(compute_dtype())

        def paint(params: Any, image: jax.Array) -> jax.Array:
            painted = network.apply(params, normalize(image)[None])
            assert isinstance(painted, jax.Array)
            if settings.loss == "segmentation":
                return painted[0, ..., 0] > 0.0
            return jnp.round(255.0 * jnp.clip(0.5 * (painted[0] + 1.0), 0.0, 1.0)).astype(jnp.uint8)

        self._paint = jax.jit(paint)

    def paint(self, image: np.ndarray) -> np.ndarray:
        """Return a copy of an image [H, W, 3] uint8 with the stalks of the near row in red.

        With loss ``gan`` the copy is the generator's output, which also differs slightly beside the stalks.
        """
        result = self._run(image)
        if self.settings.loss == "gan":
            return result
        painted = image.copy()
        painted[result] = (255, 0, 0)
        return painted

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the mask [H, W] bool of the stalks of the near row in an image [H, W, 3] uint8."""
        result = self._run(image)
        return redness(result) > MASK_THRESHOLD if self.settings.loss == "gan" else result

    def _run(self, image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        more = [(0, -size % self.settings.multiple) for size in (height, width)]
        return np.asarray(self._paint(self._params, np.pad(image, [*more, (0, 0)], mode="edge")))[:height, :width]


def write_weights(
    path: Path, params: Mapping[str, Any], settings: Settings, about: Mapping[str, Any], bits: Literal[10, 16, 32] = 16
) -> None:
    """Write the parameters and settings of a generator to a file.

    Args:
        path: File to write.
        params: Parameters of the generator.
        settings: Settings of the generator.
        about: Further metadata, such as the origin of the weights.
        bits: Bits per parameter, see `write_parameters`.

    Raises:
        OSError: The file cannot be written.
    """
    write_parameters(path, params, {"schema": SCHEMA, "generator": dataclasses.asdict(settings), **about}, bits)


def read_weights(path: Path) -> tuple[dict[str, Any], Settings, dict[str, Any]]:
    """Read a file of `write_weights`: parameters, settings, and further metadata.

    Raises:
        RequestError: The file cannot be read, holds no generator of this version, or its parameters do not fit its settings.
    """

    def declare(about: dict[str, Any]) -> tuple[Settings, Any]:
        values = about.pop("generator")
        if not isinstance(values, dict):
            raise ValueError("the generator is not a table")
        if about.pop("schema") != SCHEMA or values.keys() != _HINTS.keys() or values["loss"] not in ("gan", "segmentation"):
            raise RequestError(f"{path} holds weights of another version: train them again with `{_COMMAND}`")
        settings = Settings(**{name: fields.check(f"{path}: {name}", _HINTS[name], value) for name, value in values.items()})
        check_range(path, "channels", settings.channels, 8, 1024, 8)
        if len(settings.channels) > _MAX_LEVELS:
            raise RequestError(f"{path}: its network must have {_MAX_LEVELS} levels at most, not {len(settings.channels)}")
        return settings, declare_shapes(settings)

    return read_parameters(path, _COMMAND, declare)


@functools.lru_cache(maxsize=4)
def declare_shapes(settings: Settings) -> Any:
    """Return the shapes and dtypes of a generator's parameters as nested dictionaries, without computing any."""
    image = jax.ShapeDtypeStruct((1, settings.multiple, settings.multiple, 3), jnp.float32)
    generator = settings.generator(jnp.float32)
    return jax.eval_shape(lambda key: generator.lazy_init(key, image), jax.random.key(0))
