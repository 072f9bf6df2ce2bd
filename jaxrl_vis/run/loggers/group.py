"""Loggers (``--log tensorboard wandb``) of metrics.jsonl, the configuration, the curve and the video.

metrics.jsonl remains the reference. At its start, a logger receives the rows that the file already has, and then every new row,
so that a resumed run, or a logger added later, shows each evaluation exactly once.

A failing logger is reported in one line and not used again: training continues without it.
"""

import importlib.util
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

from jaxrl_vis.errors import RequestError, nearest
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.run.storage.metrics import Row

LoggerName = Literal["tensorboard", "wandb"]
NAMES: tuple[str, ...] = get_args(LoggerName)

_MODULES = {"tensorboard": "tensorboardX", "wandb": "wandb"}
_LEAVING_S = {True: 10.0, False: 60.0}  # seconds allowed for closing a logger: after a signal, and at the end of a run


def check(names: Sequence[str]) -> None:
    """Check that loggers exist and that their libraries are installed, without importing them.

    Raises:
        RequestError: There is no such logger, or its library is missing.
    """
    for name in names:
        if name not in _MODULES:
            raise RequestError(f"unknown logger {name!r}{nearest(name, NAMES)}")
        if importlib.util.find_spec(_MODULES[name]) is None:
            raise RequestError(f"--log {name} needs {_MODULES[name]}: {install_command(name)}")


class Logger(Protocol):
    """Interface of a logger. Any method may raise any exception."""

    def log_rows(self, rows: Sequence[Row]) -> None:
        """Log rows of metrics.jsonl."""

    def log_image(self, name: str, file: Path, env_steps: int) -> None:
        """Log the image ``file``, a .png or .gif drawn after ``env_steps`` steps, as ``name``."""

    def close(self) -> None:
        """Wait until everything is delivered."""


class Loggers:
    """Loggers of one run. Nothing is opened before `open`.

    Args:
        names: Names of the loggers, from `NAMES`.
        folder: The run folder.
        echo: Called with one line about each failure.
    """

    def __init__(self, names: Sequence[str], folder: Path, echo: Callable[[str], None]):
        self._names, self._folder, self._echo = tuple(dict.fromkeys(names)), folder, echo
        self._loggers: dict[str, Logger] = {}

    def open(self, record: Mapping[str, Any], seeds: Sequence[int], rows: Sequence[Row]) -> None:
        """Open the loggers.

        Args:
            record: The contents of config.json.
            seeds: The seeds of the run.
            rows: Rows already in metrics.jsonl.
        """
        for name in self._names:

            def begin(name: str = name) -> None:
                self._loggers[name] = _open(name, self._folder, record, seeds, self._echo)
                self._loggers[name].log_rows(rows)

            self._try(name, begin)

    def log_rows(self, rows: Sequence[Row]) -> None:
        """Forward rows to the loggers."""
        for name, logger in list(self._loggers.items()):
            self._try(name, lambda logger=logger: logger.log_rows(rows))

    def log_image(self, name: str, file: Path, env_steps: int) -> None:
        """Forward an image to the loggers, if the file exists."""
        if file.exists():
            for logger_name, logger in list(self._loggers.items()):
                self._try(logger_name, lambda logger=logger: logger.log_image(name, file, env_steps))

    def close(self, in_a_hurry: bool = False) -> None:
        """Close the loggers within a time limit: a library waiting for a network could otherwise block the end of the run.

        Args:
            in_a_hurry: True after a signal: each logger gets 10 s instead of 60 s.
        """
        for name in list(self._loggers):
            logger = self._loggers.pop(name)
            thread = threading.Thread(target=self._try, args=(name, logger.close), daemon=True)
            thread.start()
            thread.join(_LEAVING_S[in_a_hurry])
            if thread.is_alive():
                self._echo(f"--log {name} has not sent everything yet and is not waited for; metrics.jsonl has it all")

    def _try(self, name: str, act: Callable[[], None]) -> None:
        try:
            act()
        except Exception as error:
            self._loggers.pop(name, None)
            description = " ".join(f"{type(error).__name__}: {error}".split())
            self._echo(f"--log {name} failed and is not used any more ({description[:200]}); metrics.jsonl has everything")


def _open(name: str, folder: Path, record: Mapping[str, Any], seeds: Sequence[int], echo: Callable[[str], None]) -> Logger:
    if name == "wandb":
        from jaxrl_vis.run.loggers.weights_and_biases import WeightsAndBiases

        return WeightsAndBiases(folder, record, seeds, echo)
    from jaxrl_vis.run.loggers.tensorboard import TensorBoard

    return TensorBoard(folder, record, seeds)
