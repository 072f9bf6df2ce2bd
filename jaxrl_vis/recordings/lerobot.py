"""Writer of LeRobot datasets, see `lerobot_format`. Actions, states and images are stored losslessly."""

import fractions
import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.provenance import install_command
from jaxrl_vis.recordings import images
from jaxrl_vis.recordings import lerobot_format as form
from jaxrl_vis.recordings.episodes import Recordings

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_SECOND = 1.0  # default control period of episodes without one, s


def check_packages(with_video: bool = True) -> None:
    """Raise a `RequestError` unless the packages for writing and reading datasets are installed.

    Args:
        with_video: Whether PyAV must be installed, too, and able to write H.264.
    """
    try:
        import pandas  # noqa: F401
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise RequestError(f"LeRobot datasets need pyarrow and pandas: {install_command('lerobot')}") from error
    if with_video:
        images.check_video()


def write(recordings: Recordings, folder: Path) -> None:
    """Write episodes as a LeRobot dataset; the folder appears atomically.

    Args:
        recordings: The episodes.
        folder: A folder that does not exist or is empty.

    Raises:
        RequestError: A package is missing, or the folder is not empty.
        OSError: A file cannot be written.
    """
    check_packages(recordings.are_images)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise RequestError(f"{folder} is not empty: name a new folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as temporary:
        dataset = Path(temporary) / "dataset"
        _Writer(recordings, dataset).write()
        if folder.exists():
            folder.rmdir()
        shutil.move(dataset, folder)


class _Writer:
    def __init__(self, recordings: Recordings, folder: Path) -> None:
        self._recordings, self._folder = recordings, folder
        period = float(recordings.about.get("control_period", _SECOND))
        self._rate = fractions.Fraction(1 / period).limit_denominator(1000)
        fps = float(self._rate)
        self._fps = int(fps) if fps.is_integer() else fps
        self._features = form.features_of(recordings, self._fps)
        self._steps = recordings.count * recordings.horizon

    def write(self) -> None:
        videos = [name for name, feature in self._features.items() if feature["dtype"] == "video"]
        for name in videos:
            images.write_video(self._path(form.VIDEO, video_key=name), self._frames(name), self._rate)
        self._write_data()
        self._write_episodes(videos)
        self._write_tables(videos)

    def _path(self, pattern: str, **names: str) -> Path:
        path = self._folder / pattern.format(chunk_index=0, file_index=0, **names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _images(self, name: str, episode: int) -> np.ndarray:
        """Return the images [T+1, H, W, 1 or 3] uint8 of an episode for a feature."""
        recordings, is_goal = self._recordings, name in (form.GOAL_CAMERA, form.GOAL_DEPTH)
        if is_goal:
            assert recordings.goals is not None
            shown = np.broadcast_to(recordings.goals[episode], recordings.observations.shape[1:])
        else:
            shown = recordings.observations[episode]
        return shown[..., -1:] if name in (form.DEPTH, form.GOAL_DEPTH) else shown[..., :3]

    def _frames(self, name: str) -> Iterator[np.ndarray]:
        for episode in range(self._recordings.count):
            yield from self._images(name, episode)[:-1]

    def _columns(self) -> dict[str, np.ndarray]:
        """Return the numerical features of all steps by name: [N, T, ...]."""
        recordings = self._recordings
        count, steps = recordings.count, recordings.horizon
        frame = np.broadcast_to(np.arange(steps), (count, steps))
        columns = {
            form.ACTION: recordings.actions,
            "timestamp": (frame / float(self._rate)).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.broadcast_to(np.arange(count)[:, None], (count, steps)),
            "index": np.arange(count * steps).reshape(count, steps),
            "task_index": np.zeros((count, steps), np.int64),
        }
        if not recordings.are_images:
            columns[form.STATE] = recordings.observations[:, :-1]
            if recordings.goals is not None:
                columns[form.GOAL] = self._repeat_per_step(recordings.goals)
        if recordings.states is not None and recordings.goal_states is not None:
            columns[form.TRUE_STATE] = recordings.states[:, :-1]
            columns[form.TRUE_GOAL] = self._repeat_per_step(recordings.goal_states)
        return columns

    def _repeat_per_step(self, goals: np.ndarray) -> np.ndarray:
        return np.broadcast_to(goals[:, None], (len(goals), self._recordings.horizon, goals.shape[-1]))

    def _write_data(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        numbers, columns = self._columns(), {}
        for name, feature in self._features.items():
            if feature["dtype"] == "image":
                encoded = [
                    {"bytes": data, "path": None}
                    for episode in range(self._recordings.count)
                    for data in self._encode_pngs(name, episode)
                ]
                columns[name] = pa.array(encoded, pa.struct({"bytes": pa.binary(), "path": pa.string()}))
            elif feature["dtype"] != "video":
                values = np.ascontiguousarray(numbers[name]).reshape(self._steps, -1)
                column = pa.array(values.ravel(), pa.from_numpy_dtype(np.dtype(feature["dtype"])))
                # LeRobot's loader takes a vector of one number for a number.
                columns[name] = (
                    column if feature["shape"] == [1] else pa.FixedSizeListArray.from_arrays(column, values.shape[1])
                )
        pq.write_table(pa.table(columns), self._path(form.DATA))

    def _encode_pngs(self, name: str, episode: int) -> list[bytes]:
        """Encode the images of an episode before each action as PNG; the goal's image is encoded only once."""
        shown = self._images(name, episode)[:-1]
        if name == form.GOAL_DEPTH:
            return [images.encode_png(shown[0])] * len(shown)
        return [images.encode_png(image) for image in shown]

    def _write_episodes(self, videos: list[str]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        recordings, task = self._recordings, self._task()
        count, steps, numbers = recordings.count, recordings.horizon, self._columns()
        length = steps / float(self._rate)
        rows = []
        for episode in range(count):
            row: dict[str, Any] = {
                "episode_index": episode,
                "tasks": [task],
                "length": steps,
                "dataset_from_index": episode * steps,
                "dataset_to_index": (episode + 1) * steps,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for name in videos:
                row |= {f"videos/{name}/{what}_index": 0 for what in ("chunk", "file")}
                row |= {
                    f"videos/{name}/from_timestamp": episode * length,
                    f"videos/{name}/to_timestamp": (episode + 1) * length,
                }
            of_episode = {name: column[episode : episode + 1] for name, column in numbers.items()}
            for name, statistics in self._statistics(of_episode, [episode]).items():
                row |= {f"stats/{name}/{measure}": values for measure, values in statistics.items()}
            rows.append(row | self._last(episode))
        pq.write_table(pa.Table.from_pylist(rows), self._path(form.EPISODES))

    def _last(self, episode: int) -> dict[str, Any]:
        """Return the final observation (after the last action), by column."""
        recordings = self._recordings
        last: dict[str, Any] = {}
        if recordings.are_images:
            for name in (form.CAMERA, form.DEPTH):
                if name in self._features:
                    last[form.LAST + name] = images.encode_png(self._images(name, episode)[-1])
        else:
            last[form.LAST + form.STATE] = recordings.observations[episode, -1].tolist()
        if recordings.states is not None:
            last[form.LAST + form.TRUE_STATE] = recordings.states[episode, -1].tolist()
        if recordings.success is not None:
            last[form.SUCCESS] = bool(recordings.success[episode])
        return last

    def _statistics(self, numbers: Mapping[str, np.ndarray], episodes: list[int]) -> dict[str, dict[str, Any]]:
        statistics = {}
        for name, feature in self._features.items():
            if feature["dtype"] in ("image", "video"):
                shown = [self._images(name, episode)[:-1] for episode in episodes]
                statistics[name] = _image_statistics(shown)
            else:
                statistics[name] = _number_statistics(numbers[name].reshape(-1, *feature["shape"]))
        return statistics

    def _write_tables(self, videos: list[str]) -> None:
        import pandas as pd

        recordings = self._recordings
        pd.DataFrame({"task_index": [0]}, index=[self._task()]).to_parquet(self._path(form.TASKS))
        info = {
            "codebase_version": form.VERSION,
            "robot_type": recordings.about.get("task"),
            "total_episodes": recordings.count,
            "total_frames": self._steps,
            "total_tasks": 1,
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{recordings.count}"},
            "data_path": form.DATA,
            "video_path": form.VIDEO if videos else None,
            "features": self._features,
        }
        statistics = self._statistics(self._columns(), list(range(recordings.count)))
        for place, table in ((form.INFO, info), (form.STATS, statistics), (form.ABOUT, dict(recordings.about))):
            self._path(place).write_text(json.dumps(table, indent=4) + "\n", encoding="utf-8")

    def _task(self) -> str:
        return f"{self._recordings.about.get('task', 'recordings')}: reach the goal"


def _number_statistics(values: np.ndarray) -> dict[str, Any]:
    """Return statistics of values [steps, D], as lists of D numbers."""
    quantiles = np.quantile(values, list(_QUANTILES.values()), axis=0)
    return {
        "min": values.min(axis=0).tolist(),
        "max": values.max(axis=0).tolist(),
        "mean": values.mean(axis=0, dtype=np.float64).tolist(),
        "std": values.std(axis=0, dtype=np.float64).tolist(),
        "count": [len(values)],
    } | dict(zip(_QUANTILES, quantiles.tolist(), strict=True))


def _image_statistics(episodes: list[np.ndarray]) -> dict[str, Any]:
    """Return statistics of images [..., H, W, C] uint8, scaled by 1/255, [3, 1, 1] each; computed from exact histograms."""
    channels = episodes[0].shape[-1]
    counts = sum(np.stack([np.bincount(part[..., c].ravel(), minlength=256) for c in range(channels)]) for part in episodes)
    counts, levels = np.broadcast_to(counts, (3, 256)), np.arange(256) / 255.0
    total = counts.sum(axis=1)
    mean = counts @ levels / total
    fraction = np.cumsum(counts, axis=1) / total[:, None]
    occurs = counts > 0
    statistics = {
        "min": levels[occurs.argmax(axis=1)],
        "max": levels[255 - occurs[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0.0)),
    } | {name: levels[(fraction >= quantile).argmax(axis=1)] for name, quantile in _QUANTILES.items()}
    as_lists: dict[str, Any] = {name: values.reshape(3, 1, 1).tolist() for name, values in statistics.items()}
    return as_lists | {"count": [sum(len(part) for part in episodes)]}
