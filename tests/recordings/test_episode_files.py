"""Recorded episodes: the same in every format and in the replay, and one clear line for whatever cannot be read."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrl_vis import indicator
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.memory.replay import Indices, Replay
from jaxrl_vis.recordings import convert
from jaxrl_vis.recordings.episodes import Recordings
from jaxrl_vis.types import Episodes

COUNT, STEPS, SIZE = 3, 4, 8
ABOUT = {"task": "VisualThing", "control_period": 0.04, "frame_stack": 1, "depth_range": [0.5, 1.5]}


def episodes(channels: int, frame_stack: int = 1) -> Episodes:
    """Return episodes in the form of a rollout's; images are noise, which only a lossless format keeps."""
    draw = np.random.default_rng(channels)
    shape = (COUNT, STEPS + 2, channels * frame_stack, SIZE, SIZE) if channels else (COUNT, STEPS + 2, 5)
    seen = draw.integers(0, 256, shape).astype(np.uint8) if channels else draw.normal(size=shape).astype(np.float32)
    if frame_stack > 1:  # older images are those of the steps before, and a goal stands still
        for slot in range(STEPS + 2):
            before = 0 if slot == 0 else slot if slot > STEPS else slot - 1
            seen[:, slot, channels:] = seen[:, before, : channels * (frame_stack - 1)]
            if slot in (0, STEPS + 1):
                seen[:, slot] = np.tile(seen[:, slot, :channels], (1, frame_stack, 1, 1))
    return Episodes(
        observations=jnp.asarray(seen),
        states=jnp.asarray(draw.normal(size=(COUNT, STEPS + 2, 3)), jnp.float32),
        actions=jnp.asarray(draw.uniform(-1, 1, (COUNT, STEPS, 2)), jnp.float32),
    )


def recorded(channels: int, frame_stack: int = 1) -> Recordings:
    success = np.array([1.0, 0.0, 1.0], np.float32)
    return Recordings.of_rollout(episodes(channels, frame_stack), success, ABOUT | {"frame_stack": frame_stack})


def assert_equal(actual: Recordings, wanted: Recordings) -> None:
    for name in ("observations", "actions", "goals", "states", "goal_states", "success"):
        np.testing.assert_array_equal(getattr(actual, name), getattr(wanted, name), err_msg=name)
        assert getattr(actual, name).dtype == getattr(wanted, name).dtype
    assert actual.about == wanted.about


@pytest.mark.parametrize("kind", ["npz", "lerobot"])
@pytest.mark.parametrize("channels", [0, 1, 3, 4])
def test_what_is_read_is_what_was_written(kind: str, channels: int, tmp_path: Path) -> None:
    if kind == "lerobot":
        pytest.importorskip("av")
        pytest.importorskip("pyarrow")
    wanted = recorded(channels)
    written = convert.write(wanted, tmp_path / "out", kind)
    assert convert.holds_recordings(written) and convert.holds_recordings(tmp_path / "out")
    assert_equal(convert.read(tmp_path / "out"), wanted)
    assert_equal(convert.read(tmp_path / "out").first(2), wanted.first(2))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(("channels", "frame_stack"), [(0, 1), (4, 1), (3, 2)])
def test_loaded_episodes_are_the_replay_that_the_learner_fills(channels: int, frame_stack: int, tmp_path: Path) -> None:
    played = episodes(channels, frame_stack)
    convert.write(recorded(channels, frame_stack), tmp_path / "played.npz", "npz")
    replay, state = convert.read(tmp_path / "played.npz").to_replay()
    wanted = Replay(1, COUNT, STEPS, frame_stack)
    wanted_state = wanted.of_rollout(played)
    assert replay == wanted
    jax.tree.map(np.testing.assert_array_equal, state, wanted_state)
    np.testing.assert_array_equal(replay.stacked(state), played.observations)
    indices = Indices(jnp.array([2, 0]), jnp.array([3, 1]))
    batch = replay.gather(state, indices, jnp.array([STEPS + 1, STEPS]))
    np.testing.assert_array_equal(batch.observation_t[0], played.observations[2, 3])
    np.testing.assert_array_equal(batch.goal[0], played.observations[2, -1])
    np.testing.assert_array_equal(batch.state_tp1[1], played.states[0, 2])


def test_recordings_without_goals_and_truth_take_the_last_observation(tmp_path: Path) -> None:
    whole = recorded(3)
    np.savez(tmp_path / "bare.npz", observations=whole.observations, actions=whole.actions.astype(np.float64))
    bare = convert.read(tmp_path / "bare.npz")
    assert bare.goals is None and bare.states is None and bare.actions.dtype == np.float32
    filled = bare.to_episodes()
    np.testing.assert_array_equal(filled.observations[:, -1], filled.observations[:, -2])
    assert not np.any(filled.states) and filled.states.shape == (COUNT, STEPS + 2, 1)


def test_the_indicator_learns_from_a_dataset_as_from_its_npz(tmp_path: Path) -> None:
    pytest.importorskip("av")
    pytest.importorskip("pyarrow")
    whole = recorded(0)
    options: dict[str, Any] = {"batch_size": 4, "hidden_sizes": (4,), "tolerance": 0.5}
    for kind in ("npz", "lerobot"):
        convert.write(whole, tmp_path / kind, kind)
    learners = [indicator.learn(tmp_path / kind, updates=2, **options) for kind in ("npz", "lerobot")]
    actions = [learner.act(whole.observations[0, 0], whole.goals[0]) for learner in learners]  # type: ignore[index]
    assert learners[1].episodes == COUNT
    np.testing.assert_array_equal(*actions)


def test_the_dataset_has_the_schema_of_lerobot(tmp_path: Path) -> None:
    """Files, columns and types are those that lerobot 0.4.4 writes and reads."""
    pytest.importorskip("av")
    parquet = pytest.importorskip("pyarrow.parquet")
    import pandas as pd
    import pyarrow as pa

    folder = tmp_path / "dataset"
    convert.write(recorded(4), folder, "lerobot")
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 25 and isinstance(info["fps"], int)
    assert info["total_episodes"] == COUNT and info["total_frames"] == COUNT * STEPS and info["splits"] == {"train": "0:3"}
    for name, feature in info["features"].items():
        assert set(feature) >= {"dtype", "shape", "names"} and "/" not in name
        assert feature["names"] is None or len(feature["names"]) in (len(feature["shape"]), feature["shape"][0])
    assert info["features"]["observation.images.camera"]["dtype"] == "video"
    assert info["features"]["observation.images.depth"]["dtype"] == "image"
    assert not any(name.startswith("observation") and "state" in name for name in info["features"]), "truth must be no input"

    data = parquet.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert data.num_rows == COUNT * STEPS
    assert data.schema.field("action").type == pa.list_(pa.float32(), 2)
    assert data.schema.field("timestamp").type == pa.float32() and data.schema.field("index").type == pa.int64()
    assert data.schema.field("observation.images.depth").type == pa.struct({"bytes": pa.binary(), "path": pa.string()})
    videos = {name for name, feature in info["features"].items() if feature["dtype"] == "video"}
    assert set(data.column_names) == set(info["features"]) - videos
    np.testing.assert_allclose(data["timestamp"].to_numpy(), np.tile(np.arange(STEPS) * 0.04, COUNT), atol=1e-6)

    tasks = pd.read_parquet(folder / "meta/tasks.parquet")
    assert tasks.loc["VisualThing: reach the goal", "task_index"] == 0
    rows = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["dataset_from_index"] for row in rows] == [0, 4, 8] and rows[-1]["dataset_to_index"] == 12
    assert rows[1]["videos/observation.images.camera/from_timestamp"] == pytest.approx(4 * 0.04)
    for name in videos:
        path = folder / info["video_path"].format(video_key=name, chunk_index=0, file_index=0)
        import av

        with av.open(str(path)) as container:
            times = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
        np.testing.assert_allclose(times, np.arange(COUNT * STEPS) * 0.04, atol=1e-6)


def test_statistics_are_those_of_the_numbers(tmp_path: Path) -> None:
    pytest.importorskip("av")
    pytest.importorskip("pyarrow")
    whole = recorded(4)
    convert.write(whole, tmp_path / "dataset", "lerobot")
    statistics = json.loads((tmp_path / "dataset/meta/stats.json").read_text())
    images = whole.observations[:, :-1, ..., :3].reshape(-1, 3) / 255.0
    shown = statistics["observation.images.camera"]
    for measure, values in (("mean", images.mean(0)), ("std", images.std(0)), ("min", images.min(0)), ("max", images.max(0))):
        assert np.shape(shown[measure]) == (3, 1, 1)
        np.testing.assert_allclose(np.ravel(shown[measure]), values, atol=1e-9)
    np.testing.assert_allclose(np.ravel(shown["q50"]), np.median(images, axis=0), atol=1.01 / 255)
    actions = whole.actions.reshape(-1, 2)
    np.testing.assert_allclose(statistics["action"]["mean"], actions.mean(0), atol=1e-6)
    np.testing.assert_allclose(statistics["action"]["q90"], np.quantile(actions, 0.9, axis=0), atol=1e-6)
    assert statistics["action"]["count"] == [COUNT * STEPS]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.zeros((COUNT, STEPS + 1, 2), np.float32)}, r"actions must have the shape \(3, 4, A\)"),
        ({"goals": np.zeros((COUNT, SIZE, SIZE, 3), np.float32)}, "goals must have the shape"),
        ({"goal_states": None}, "come together"),
        ({"observations": np.zeros((COUNT, STEPS + 1, SIZE, SIZE, 2), np.uint8)}, "1, 3 or 4 channels"),
        ({"actions": np.full((COUNT, STEPS, 2), np.nan, np.float32)}, "finite"),
        ({"about": {"frame_stack": "two"}}, "frame_stack"),
    ],
)
def test_arrays_that_do_not_fit_are_named(change: dict[str, Any], message: str) -> None:
    whole = recorded(3)
    fields = ("observations", "actions", "goals", "states", "goal_states", "success", "about")
    with pytest.raises(RequestError, match=message):
        Recordings(**({name: getattr(whole, name) for name in fields} | change))


def test_damaged_files_are_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("av")
    pytest.importorskip("pyarrow")
    folder = tmp_path / "dataset"
    convert.write(recorded(3), folder, "lerobot")
    with pytest.raises(RequestError, match="not empty"):
        convert.check_out(folder, "lerobot")
    video = folder / "videos/observation.images.camera/chunk-000/file-000.mp4"
    whole = video.read_bytes()
    for corrupted in (whole[: len(whole) // 2], b"", b"no video"):
        video.write_bytes(corrupted)
        with pytest.raises(RequestError, match="dataset") as refusal:
            convert.read(folder)
        assert "\n" not in str(refusal.value)
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    with pytest.raises(RequestError, match=r"version v2.1: convert it to v3.0"):
        convert.read(folder)
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(RequestError, match="no recorded episodes"):
        convert.read(tmp_path / "torn.npz")
