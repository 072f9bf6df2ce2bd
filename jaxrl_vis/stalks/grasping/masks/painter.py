"""Images to masks by a trained generator, and its weights in a file."""

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
from jaxrl_vis.stalks.grasping.perception.cloud import RED, redness

Loss = Literal["gan", "segmentation"]
SHIPPED = Path(__file__).with_name("stalks_segmentation.safetensors")
"""Weights that come with the package: a plain segmentation, trained on synthetic stalks."""
SCHEMA = 1
_COMMAND = "jaxrl-vis grasp train"


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a generator.

    Attributes:
        loss: Loss that it learned by: it paints, or gives logits.
        channels: Channels of its levels.
    """

    loss: Loss = "segmentation"
    channels: tuple[int, ...] = (16, 32, 64, 96, 128, 128)

    @property
    def multiple(self) -> int:
        """Divisor of the height and width of an image."""
        return 2 ** len(self.channels)

    def generator(self, dtype: Any) -> Generator:
        """The network."""
        return Generator(self.channels, 3 if self.loss == "gan" else 1, dtype)


_HINTS = fields.hints(Settings)
_MAX_LEVELS = 10  # each of them halves the image


def normalise(images: jax.Array) -> jax.Array:
    """Images uint8 as float32 from -1 to 1."""
    return images.astype(jnp.float32) / 127.5 - 1.0


def compute_dtype() -> Any:
    """In which convolutions are computed on what JAX runs on."""
    return jnp.bfloat16 if jax.default_backend() in ("gpu", "tpu") else jnp.float32


class Painter:
    """Finds the pixels of stalks.

    Attributes:
        settings: Settings of its generator.
    """

    def __init__(self, params: Any, settings: Settings) -> None:
        """Args: the generator's parameters, and what it is."""
        self._params, self.settings = params, settings
        network = settings.generator(compute_dtype())

        def paint(params: Any, image: jax.Array) -> jax.Array:
            painted = network.apply(params, normalise(image)[None])
            assert isinstance(painted, jax.Array)
            if settings.loss == "segmentation":
                return painted[0, ..., 0] > 0.0
            return jnp.round(255.0 * jnp.clip(0.5 * (painted[0] + 1.0), 0.0, 1.0)).astype(jnp.uint8)

        self._paint = jax.jit(paint)

    def paint(self, image: np.ndarray) -> np.ndarray:
        """Paint an image [H, W, 3] uint8: [H, W, 3] uint8, the image with its stalks in red."""
        result = self._run(image)
        if self.settings.loss == "gan":
            return result
        painted = image.copy()
        painted[result] = (255, 0, 0)
        return painted

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return True for the pixels of an image [H, W, 3] uint8 that show a stalk of the near row: [H, W] bool."""
        result = self._run(image)
        return redness(result) > RED if self.settings.loss == "gan" else result

    def _run(self, image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        more = [(0, -size % self.settings.multiple) for size in (height, width)]
        return np.asarray(self._paint(self._params, np.pad(image, [*more, (0, 0)], mode="edge")))[:height, :width]


def write_weights(
    path: Path, params: Mapping[str, Any], settings: Settings, about: Mapping[str, Any], bits: Literal[10, 16, 32] = 16
) -> None:
    """Write a generator: its parameters, with so many bits each (`write_parameters`), its settings, and its origin.

    Raises:
        OSError: The file cannot be written.
    """
    write_parameters(path, params, {"schema": SCHEMA, "generator": dataclasses.asdict(settings), **about}, bits)


def read_weights(path: Path) -> tuple[dict[str, Any], Settings, dict[str, Any]]:
    """Read what `write_weights` wrote: parameters, settings, and where they come from.

    Raises:
        RequestError: There is no such file, or it holds no generator, or not the one that it speaks of.
    """

    def declare(about: dict[str, Any]) -> tuple[Settings, Any]:
        values = about.pop("generator")
        if not isinstance(values, dict):
            raise ValueError("the generator is no table")
        if about.pop("schema") != SCHEMA or values.keys() != _HINTS.keys() or values["loss"] not in ("gan", "segmentation"):
            raise RequestError(f"{path} holds weights of another version: train them again with `{_COMMAND}`")
        settings = Settings(**{name: fields.check(f"{path}: {name}", _HINTS[name], value) for name, value in values.items()})
        check_range(path, "channels", settings.channels, 8, 1024, 8)
        if len(settings.channels) > _MAX_LEVELS:
            raise RequestError(f"{path}: its network must have {_MAX_LEVELS} levels at most, not {len(settings.channels)}")
        return settings, declared(settings)

    return read_parameters(path, _COMMAND, declare)


@functools.lru_cache(maxsize=4)
def declared(settings: Settings) -> Any:
    """Shapes of the parameters of a generator: nested dictionaries, nothing of which is computed."""
    image = jax.ShapeDtypeStruct((1, settings.multiple, settings.multiple, 3), jnp.float32)
    generator = settings.generator(jnp.float32)
    return jax.eval_shape(lambda key: generator.lazy_init(key, image), jax.random.key(0))
