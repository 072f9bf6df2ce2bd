"""Weights files of the stalk detection networks, with their settings and origin."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp

from jaxrl_vis.config import fields
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.weights_file import check_range, read_parameters, write_parameters
from jaxrl_vis.stalks.phenotyping.detector.detect import Settings, init_detector
from jaxrl_vis.stalks.phenotyping.detector.detector_networks import Segmenter

SHIPPED = Path(__file__).with_name("stalks.safetensors")
"""Path of the shipped weights for calibrated cameras at night, trained on synthetic rows lit by a flash."""
PHOTOGRAPHS = Path(__file__).with_name("photographs.safetensors")
"""Path of the shipped weights for unknown cameras and for plants by day, trained on synthetic plants by day and at night; they
detect sections."""
SCHEMA = 2
"""File format version, increased when parameters change their meaning: since 2, box offsets are relative to the axis of
the proposal."""
_COMMAND = "jaxrl-vis phenotype train"
_HINTS = fields.hints(Settings)
_KEYS = {
    "pixels_per_metre": "density",
    "height": "lines",
    "crop_height": "snip_lines",
    "crop_width": "snip_columns",
    "band_height": "band_lines",
    "max_stalks": "most",
    "min_score": "least_score",
}
"""Keys in files of the `Settings` fields that have another name there."""
_FIELDS = {key: name for name, key in _KEYS.items()}
# Minimum, maximum and divisor of each setting: a file must not request a network that does not fit in memory.
_LIMITS: dict[str, tuple[float, float, int]] = {
    "pixels_per_metre": (0, 100_000, 1),
    **dict.fromkeys(("width", "full_width"), (32, 16384, 1)),
    **dict.fromkeys(("crop_height", "crop_width"), (16, 2048, 8)),
    **dict.fromkeys(("band_height", "anchor_widths"), (0.1, 4096, 1)),
    **dict.fromkeys(("channels", "segmenter"), (8, 512, 8)),
    "hidden": (1, 4096, 1),
    "section": (0, 32, 16),
    **dict.fromkeys(("candidates", "proposals", "max_stalks"), (1, 10_000, 1)),
    **dict.fromkeys(("proposal_threshold", "threshold", "min_score"), (0, 1, 1)),
}


def write_weights(
    path: Path, params: Mapping[str, Any], settings: Settings, about: Mapping[str, Any], bits: Literal[10, 16, 32] = 16
) -> None:
    """Write parameters to a file atomically.

    Args:
        path: Path of the .safetensors file.
        params: Nested dictionaries of arrays.
        settings: Settings of the networks.
        about: JSON-serialisable metadata on their origin.
        bits: Bits per number; see `write_parameters`.

    Raises:
        OSError: The file cannot be written.
    """
    stored = {_KEYS.get(name, name): value for name, value in dataclasses.asdict(settings).items()}
    write_parameters(path, params, {"schema": SCHEMA, "settings": stored, **about}, bits)


def read_weights(path: Path) -> tuple[dict[str, Any], Settings, dict[str, Any]]:
    """Read a file written by `write_weights`.

    Returns:
        Parameters, settings, and the metadata on their origin.

    Raises:
        RequestError: The file does not exist, is not a weights file of this version, or its parameters do not match its
            settings.
    """

    def declare(about: dict[str, Any]) -> tuple[Settings, Any]:
        values = about.pop("settings")
        if not isinstance(values, dict):
            raise ValueError("settings are not a table")
        values = {_FIELDS.get(str(key), str(key)): value for key, value in values.items()}
        if about.pop("schema") != SCHEMA or not values.keys() <= _HINTS.keys():
            raise RequestError(f"{path} holds weights of another version: train them again with `{_COMMAND}`")
        settings = _check_settings(path, values)
        return settings, declare_shapes(settings)

    return read_parameters(path, _COMMAND, declare)


def _check_settings(path: Path, values: dict[str, Any]) -> Settings:
    """Return the settings with these ``values``, after checking their types and ranges.

    Raises:
        RequestError: A type or range is invalid.
    """
    settings = Settings(**{name: fields.check(f"{path}: {name}", _HINTS[name], value) for name, value in values.items()})
    for name, (low, high, step) in _LIMITS.items():
        value = getattr(settings, name)
        check_range(path, name, value if isinstance(value, tuple) else (value,), low, high, step)
    if len(settings.channels) != len(Settings.channels):
        raise RequestError(f"{path}: its network must have {len(Settings.channels)} channels, not {len(settings.channels)}")
    return settings


@functools.lru_cache(maxsize=4)
def declare_shapes(settings: Settings) -> dict[str, Any]:
    """Return the shapes and dtypes of the networks' parameters as nested dictionaries, without computing any of them."""
    crops = jax.ShapeDtypeStruct((1, settings.crop_height, settings.crop_width, 3), jnp.float32)

    def draw(key: jax.Array) -> dict[str, Any]:
        return {"detector": init_detector(settings, key), "segmenter": Segmenter(settings.segmenter).lazy_init(key, crops)}

    return jax.eval_shape(draw, jax.random.key(0))
