"""Reader of LeRobot datasets (version 3): exact for those of `lerobot`; others need one camera and episodes of equal length."""

import contextlib
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import read_json
from jaxrl_vis.recordings import images
from jaxrl_vis.recordings import lerobot_format as form
from jaxrl_vis.recordings.episodes import Recordings
from jaxrl_vis.recordings.lerobot import check_packages


def is_dataset(folder: Path) -> bool:
    """Return True if a folder is a LeRobot dataset of any version."""
    return (folder / form.INFO).is_file()


def read(folder: Path) -> Recordings:
    """Read a dataset with episodes of equal length.

    In datasets of other programs, the last row of an episode provides the final observation, and its action is dropped: T is
    one less.

    Args:
        folder: The dataset's folder.

    Raises:
        RequestError: It is missing, damaged, of another version, or has episodes of different lengths or several cameras.
    """
    check_packages()
    info = read_json(folder / form.INFO, hint="export it again")
    if not str(info.get("codebase_version")).startswith("v3."):
        raise RequestError(
            f"{folder} is a LeRobot dataset of version {info.get('codebase_version')}: convert it to {form.VERSION}"
        )
    try:
        return _Reader(folder, info).read()
    except RequestError as error:
        raise RequestError(f"{folder}: {error}") from error
    except Exception as error:  # pyarrow and PyAV raise various exceptions on damaged files
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise RequestError(f"{folder} cannot be read as a LeRobot dataset ({text}): export it again") from error


class _Reader:
    _rows: list[dict[str, Any]]
    _steps: int
    _data: Any

    def __init__(self, folder: Path, info: Mapping[str, Any]) -> None:
        self._folder, self._info, self._features = folder, info, info["features"]

    def read(self) -> Recordings:
        rows = self._table("meta/episodes").to_pylist()
        rows.sort(key=lambda row: row["episode_index"])
        lengths = {row["length"] for row in rows}
        if len(lengths) != 1:
            raise RequestError(f"episodes have from {min(lengths)} to {max(lengths)} steps: all must have equally many")
        self._rows, self._steps = rows, lengths.pop()
        self._data = self._table("data").sort_by("index")
        if len(self._data) != len(rows) * self._steps:
            raise RequestError(f"there are {len(self._data)} steps instead of {len(rows)} times {self._steps}")
        is_ours = any(name.startswith(form.LAST) for name in rows[0])
        actions = self._numbers(form.ACTION)
        observations, goals = self._observations(is_ours)
        states = goal_states = success = None
        if is_ours and form.TRUE_STATE in self._features:
            states = self._append_last(form.TRUE_STATE, self._numbers(form.TRUE_STATE))
            goal_states = self._numbers(form.TRUE_GOAL)[:, 0]
        if is_ours and form.SUCCESS in rows[0]:
            success = np.array([row[form.SUCCESS] for row in rows], np.bool_)
        about = {"task": self._info.get("robot_type"), "control_period": 1.0 / float(self._info["fps"])}
        if (self._folder / form.ABOUT).is_file():
            about |= read_json(self._folder / form.ABOUT, hint="export it again")
        return Recordings(observations, actions if is_ours else actions[:, :-1], goals, states, goal_states, success, about)

    def _table(self, folder: str) -> Any:
        """Return all .parquet files of a folder as one table."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        paths = sorted((self._folder / folder).glob("*/*.parquet"))
        return pa.concat_tables([pq.read_table(path) for path in paths])

    def _numbers(self, name: str) -> np.ndarray:
        """Return a numerical column [N, T, D] float32."""
        column = self._data[name].combine_chunks()
        size = self._features[name]["shape"][0]
        flat = column if self._features[name]["shape"] == [1] else column.flatten()
        values = flat.to_numpy(zero_copy_only=False).astype(np.float32)
        return values.reshape(len(self._rows), self._steps, size)

    def _append_last(self, name: str, values: np.ndarray) -> np.ndarray:
        """Append the value after the last action to a column [N, T, ...]: [N, T+1, ...]."""
        last = np.array([row[form.LAST + name] for row in self._rows], values.dtype)
        return np.concatenate([values, last[:, None]], axis=1)

    def _observations(self, is_ours: bool) -> tuple[np.ndarray, np.ndarray | None]:
        """Return observations [N, T+1, ...], and goals [N, ...] or None.

        Args:
            is_ours: Whether the dataset is one of `lerobot`, with goals and the observation after the last action. If not,
                observations are those before each action, [N, T, ...].

        Raises:
            RequestError: Another program's dataset has several cameras.
        """
        if is_ours and form.STATE not in self._features:
            names = [name for name in (form.CAMERA, form.DEPTH) if name in self._features]
            goals = [name for name in (form.GOAL_CAMERA, form.GOAL_DEPTH) if name in self._features]
            parts = [self._images(name) for name in names]
            for index, name in enumerate(names):
                last = np.stack([images.decode_png(row[form.LAST + name]) for row in self._rows])
                parts[index] = np.concatenate([parts[index], last[:, None]], axis=1)
            observations = np.concatenate([_channels(name, part) for name, part in zip(names, parts, strict=True)], axis=-1)
            if not goals:
                return observations, None
            return observations, np.concatenate([_channels(name, self._images(name, 1)[:, 0]) for name in goals], axis=-1)
        cameras = [name for name, feature in self._features.items() if feature["dtype"] in ("image", "video")]
        if len(cameras) > 1:
            raise RequestError(f"there are {len(cameras)} cameras ({', '.join(cameras)}): keep one of them")
        if cameras:
            return self._images(cameras[0]), None
        observations = self._numbers(form.STATE)
        if not is_ours:
            return observations, None
        goals_of_all = self._numbers(form.GOAL)[:, 0] if form.GOAL in self._features else None
        return self._append_last(form.STATE, observations), goals_of_all

    def _images(self, name: str, count: int | None = None) -> np.ndarray:
        """Return the first ``count`` images of every episode, or all T: [N, count, H, W, 3] uint8.

        Raises:
            RequestError: A video lacks frames of an episode.
        """
        count = count or self._steps
        height, width = self._features[name]["shape"][:2]
        shown = np.empty((len(self._rows), count, height, width, 3), np.uint8)
        if self._features[name]["dtype"] == "image":
            column = self._data[name]
            for episode, step in itertools.product(range(len(self._rows)), range(count)):
                shown[episode, step] = images.decode_png(column[episode * self._steps + step].as_py()["bytes"])
            return shown
        fps = float(self._info["fps"])
        with contextlib.ExitStack() as stack:
            videos: dict[tuple[int, int], Iterator[tuple[int, np.ndarray]]] = {}
            for episode, row in enumerate(self._rows):
                place = (row[f"videos/{name}/chunk_index"], row[f"videos/{name}/file_index"])
                if place not in videos:
                    pattern = self._info["video_path"].format(video_key=name, chunk_index=place[0], file_index=place[1])
                    frames = images.read_video(self._folder / pattern)
                    stack.callback(frames.close)
                    videos[place] = enumerate(frames)
                first = round(row[f"videos/{name}/from_timestamp"] * fps)
                step = -1
                for number, frame in videos[place]:
                    step = number - first
                    if 0 <= step < count:
                        shown[episode, step] = frame
                    if step >= self._steps - 1:
                        break
                if step != self._steps - 1:
                    raise RequestError(f"episode {episode} is not where it should be in the video of {name}: export it again")
        return shown


def _channels(name: str, shown: np.ndarray) -> np.ndarray:
    return shown[..., :1] if name in (form.DEPTH, form.GOAL_DEPTH) else shown
