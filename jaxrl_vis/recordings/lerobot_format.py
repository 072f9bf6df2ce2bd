"""Names and features of a LeRobot dataset of version 3, for its writer and its reader.

    meta/info.json  meta/stats.json  meta/tasks.parquet  meta/jaxrl_vis.json     metadata; the last file is ours
    meta/episodes/chunk-000/file-000.parquet      one row per episode
    data/chunk-000/file-000.parquet               one row per step: observation before the action, action, true states
    videos/KEY/chunk-000/file-000.mp4             colours, all episodes concatenated

LeRobot has one row per action, so an episode has T rows. The final observation, after the last action, is stored in columns of
meta/episodes that begin with `LAST`, which LeRobot's loader ignores.

Source: https://huggingface.co/docs/lerobot/lerobot-dataset-v3, and the loader of lerobot 0.4.4, with which it was tested.
"""

from typing import Any

from jaxrl_vis.recordings.episodes import Recordings

VERSION = "v3.0"
INFO, STATS, TASKS, ABOUT = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/jaxrl_vis.json"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

ACTION = "action"
STATE, GOAL = "observation.state", "observation.environment_state"  # the two vectors that LeRobot's policies take
CAMERA, GOAL_CAMERA = "observation.images.camera", "observation.images.goal"
DEPTH, GOAL_DEPTH = "observation.images.depth", "observation.images.goal_depth"
# Not `observation....`: all such columns are inputs of LeRobot's policies, which true states must not be.
TRUE_STATE, TRUE_GOAL = "truth.state", "truth.goal"
LAST, SUCCESS = "last/", "last/success"
"""Prefix of the columns of meta/episodes with the final observation, and the column of success."""

COUNTERS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that every dataset has, and their dtypes."""


def image_feature(height: int, width: int, fps: float | None) -> dict[str, Any]:
    """Describe images [H, W, 3]: as a video of ``fps`` frames per second, or as PNG if None."""
    feature: dict[str, Any] = {
        "dtype": "image" if fps is None else "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
    }
    if fps is not None:
        feature["info"] = {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": "gbrp",
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        }
    return feature


def vector_feature(size: int, name: str) -> dict[str, Any]:
    """Describe vectors [size] float32, whose components are named ``name_0``, ``name_1``, ..."""
    return {"dtype": "float32", "shape": [size], "names": [f"{name}_{index}" for index in range(size)]}


def features_of(recordings: Recordings, fps: float) -> dict[str, dict[str, Any]]:
    """Describe all columns and videos of recordings, by name."""
    features = {}
    if recordings.are_images:
        height, width, channels = recordings.observations.shape[2:]
        pairs = [(CAMERA, GOAL_CAMERA, fps)] if channels >= 3 else []
        pairs += [(DEPTH, GOAL_DEPTH, None)] if channels in (1, 4) else []
        for observation, goal, rate in pairs:
            features[observation] = image_feature(height, width, rate)
            if recordings.goals is not None:
                features[goal] = image_feature(height, width, rate)
    else:
        size = recordings.observations.shape[-1]
        features[STATE] = vector_feature(size, "state")
        if recordings.goals is not None:
            features[GOAL] = vector_feature(size, "goal")
    features[ACTION] = vector_feature(recordings.actions.shape[-1], "action")
    if recordings.states is not None:
        features[TRUE_STATE] = vector_feature(recordings.states.shape[-1], "state")
        features[TRUE_GOAL] = vector_feature(recordings.states.shape[-1], "goal")
    features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in COUNTERS.items()}
    return features
