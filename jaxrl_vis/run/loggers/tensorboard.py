"""TensorBoard logger: one folder per seed in ``tensorboard/`` of the run folder, so that each seed is a curve.

Events are written synchronously: tensorboardX's own writer has a thread and a queue, which would block forever on a full disk.
A resumed run rewrites its files from metrics.jsonl, so that no evaluation appears twice, nor one that the run has discarded.
"""

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tensorboardX import summary
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2, summary_pb2

from jaxrl_vis.run.storage.folder import LOGGER_FOLDERS
from jaxrl_vis.run.storage.metrics import Row, scalars


class TensorBoard:
    """TensorBoard logger, see the module.

    Args:
        folder: The run folder.
        record: The contents of config.json.
        seeds: The seeds of the run.
    """

    def __init__(self, folder: Path, record: Mapping[str, Any], seeds: Sequence[int]):
        old = folder / LOGGER_FOLDERS[0]
        if old.is_symlink():
            old.unlink()
        elif old.exists():
            shutil.rmtree(old)  # otherwise files of another run would also be shown
        self._writers: dict[int, EventsWriter] = {}
        for seed in seeds:
            where = folder / LOGGER_FOLDERS[0] / f"seed{seed}"
            where.mkdir(parents=True)
            self._writers[seed] = EventsWriter(str(where / "events"))
            # Makes an open TensorBoard forget the contents of deleted files.
            start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
            self._write(seed, 0, session_log=start)
            self._write(seed, 0, summary=summary.text("config", f"```json\n{json.dumps(record, indent=2)}\n```"))
        self._flush()

    def _write(self, seed: int, env_steps: int, **fields: Any) -> None:
        self._writers[seed].write_event(event_pb2.Event(wall_time=time.time(), step=env_steps, **fields))

    def _flush(self) -> None:
        for writer in self._writers.values():
            writer.flush()

    def log_rows(self, rows: Sequence[Row]) -> None:
        """Log the metrics of rows at their ``env_steps``."""
        for row in rows:
            values = [summary_pb2.Summary.Value(tag=name, simple_value=value) for name, value in scalars(row).items()]
            self._write(row["seed"], row["env_steps"], summary=summary_pb2.Summary(value=values))
        self._flush()

    def log_image(self, name: str, file: Path, env_steps: int) -> None:
        """Log the unchanged file: TensorBoard plays a .gif. It goes to the first seed, whose episodes the video shows."""
        from PIL import Image

        with Image.open(file) as picture:
            width, height = picture.size
        image = summary_pb2.Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=file.read_bytes())
        value = summary_pb2.Summary.Value(tag=name, image=image)
        self._write(next(iter(self._writers)), env_steps, summary=summary_pb2.Summary(value=[value]))
        self._flush()

    def close(self) -> None:
        """Close the files."""
        for writer in self._writers.values():
            writer.close()
