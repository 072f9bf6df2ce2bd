"""Weights of the networks that find stalks, with their settings and their origin."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxrl_vis.errors import RequestError
from jaxrl_vis.parameters import read_parameters, write_parameters
from jaxrl_vis.phenotyping.detector.detect import Settings

SHIPPED = Path(__file__).with_name("stalks.npz")
"""Weights that come with the package, trained on synthetic stalks."""
SCHEMA = 2
"""Raised where the same numbers mean something else: since 2, boxes and axes are in codes relative to the proposal's axis."""
_COMMAND = "jaxrl-vis phenotype train"


def write_weights(
    path: Path, params: Mapping[str, Any], settings: Settings, about: Mapping[str, Any], half: bool = True
) -> None:
    """Writes parameters. Nobody sees half of them.

    Args:
        path: The file, .npz.
        params: Nested dictionaries of arrays.
        settings: What they go with.
        about: Where they come from; anything that JSON holds.
        half: Keep 16 bits of each number.

    Raises:
        OSError: The file cannot be written.
    """
    write_parameters(path, params, {"schema": SCHEMA, "settings": dataclasses.asdict(settings), **about}, half)


def read_weights(path: Path) -> tuple[dict[str, Any], Settings, dict[str, Any]]:
    """Reads what `write_weights` wrote: parameters, settings, and where they come from.

    Raises:
        RequestError: There is no such file, or it holds no weights.
    """
    params, about = read_parameters(path, _COMMAND)
    try:
        known = {field.name for field in dataclasses.fields(Settings)}
        values: dict[str, Any] = {
            name: tuple(each) if isinstance(each, list) else each for name, each in about.pop("settings").items()
        }
        if about.pop("schema") != SCHEMA or not values.keys() <= known:
            raise RequestError(f"{path} holds weights of another version: train them again with `{_COMMAND}`")
        return params, Settings(**values), about
    except (KeyError, AttributeError) as error:
        raise RequestError(f"{path} holds no weights: name a file that `{_COMMAND}` wrote") from error
