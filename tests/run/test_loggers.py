"""`--log tensorboard wandb`: contents of the libraries' own files afterwards. No network and no account is needed."""

import json
import shutil
import struct
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import wandb
from fake_program import make_fake_trainer, run_until_sigterm, small_config
from tensorboardX.proto import event_pb2
from wandb.proto import wandb_internal_pb2

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.loggers import group, tensorboard
from jaxrl_vis.run.storage import metrics

BLOCK = 32 * 1024  # of W&B's files, which are logs as LevelDB writes them


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    for name in ("CACHE", "CONFIG", "DATA"):
        monkeypatch.setenv(f"WANDB_{name}_DIR", str(tmp_path / "of-wandb"))


def events(folder: Path) -> list[Any]:
    """Return all events in TensorBoard's files in ``folder``, which are records with lengths and checksums."""
    results = []
    for file in sorted(folder.glob("events.out.tfevents.*")):
        data, place = file.read_bytes(), 0
        while place < len(data):
            (length,) = struct.unpack_from("<Q", data, place)
            results.append(event_pb2.Event.FromString(data[place + 12 : place + 12 + length]))
            place += 12 + length + 4
    return results


def read_curve(folder: Path, tag: str) -> list[tuple[int, float]]:
    return [(event.step, value.simple_value) for event in events(folder) for value in event.summary.value if value.tag == tag]


def records(file: Path) -> list[Any]:
    """Return all records in a .wandb file."""
    data, place, part, results = file.read_bytes(), 7, b"", []
    while place + 7 <= len(data):
        left = BLOCK - place % BLOCK
        if left < 7:
            place += left
            continue
        length, kind = struct.unpack_from("<HB", data, place + 4)
        part += data[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # whole, or the last part
            results.append(wandb_internal_pb2.Record.FromString(part))
            part = b""
    return results


def wandb_runs(path: Path) -> dict[int, list[dict[str, Any]]]:
    """Return the history of each seed's runs, in the order in which their files were written."""
    results: dict[int, list[dict[str, Any]]] = {}
    ids = json.loads((path / "wandb.json").read_text())
    for seed, known in ids.items():
        rows = results.setdefault(int(seed), [])
        for file in sorted(path.glob(f"wandb/*run-*/run-{known['id']}.wandb"), key=lambda file: file.stat().st_mtime_ns):
            for record in records(file):
                if record.WhichOneof("record_type") == "history":
                    rows.append(
                        {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
                    )
    return results


def expected(path: Path, seed: int, name: str) -> list[tuple[int, float]]:
    return [(row["env_steps"], row[name]) for row in metrics.read_rows(path / "metrics.jsonl") if row["seed"] == seed]


def assert_shown(path: Path, seed: int, name: str) -> None:
    """Check that TensorBoard shows a metric as metrics.jsonl does, each evaluation once."""
    curve, there = read_curve(path / "tensorboard" / f"seed{seed}", name), expected(path, seed, name)
    assert [step for step, _ in curve] == [step for step, _ in there] and there
    assert [value for _, value in curve] == pytest.approx([value for _, value in there])


def complete_wandb_runs(path: Path) -> dict[int, list[dict[str, Any]]]:
    """Return the histories once W&B's own process, for which `finish` does not wait, has written all rows of metrics.jsonl."""
    count, deadline = len(metrics.read_rows(path / "metrics.jsonl")), time.monotonic() + 10.0
    while sum(map(len, wandb_runs(path).values())) < count and time.monotonic() < deadline:
        time.sleep(0.05)
    return wandb_runs(path)


def check_all(path: Path) -> None:
    """Check that both loggers show each evaluation of both seeds once, as metrics.jsonl does."""
    runs = complete_wandb_runs(path)
    for seed in (0, 1):
        for name in ("eval/success", "train/critic_loss"):
            assert_shown(path, seed, name)
            there = expected(path, seed, name)
            assert len(there) == 4
            history = [(row["env_steps"], row[name]) for row in runs[seed] if name in row]
            assert history == there


def test_both_show_what_the_run_has_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(), path, log=("tensorboard", "wandb")).run())
    check_all(path)
    assert "failed" not in capsys.readouterr().out
    first = events(path / "tensorboard" / "seed0")
    images = {value.tag: value.image for event in first for value in event.summary.value if value.HasField("image")}
    assert images["curve"].encoded_image_string == (path / "curve.png").read_bytes()
    assert images["video"].encoded_image_string == (path / "video.gif").read_bytes() and images["video"].width > 100
    (text,) = [value for event in first for value in event.summary.value if value.tag == "config/text_summary"]
    assert '"num_envs": 2' in text.tensor.string_val[0].decode()
    last = complete_wandb_runs(path)[0][-1]
    assert (last["env_steps"], last["video/_type"], last["curve/_type"]) == (80, "video-file", "image-file")
    (file,) = path.glob(f"wandb/*run-*/run-{json.loads((path / 'wandb.json').read_text())['1']['id']}.wandb")
    run, *_ = [record.run for record in records(file) if record.WhichOneof("record_type") == "run"]
    config = {item.key: json.loads(item.value_json) for item in run.config.update}
    assert (run.run_group, run.display_name, run.project) == ("run", "run-seed1", "jaxrl-vis")
    assert config["num_envs"] == 2 and config["versions"]["jax"]


def test_a_resumed_run_shows_each_evaluation_once(tmp_path: Path) -> None:
    """The run is abandoned after iteration 7 and resumed from 3: rows after 3 are written again, by the same loggers."""
    path = tmp_path / "run"
    config = small_config(full_checkpoint_interval=3, checkpoint_interval=3)
    for report in make_fake_trainer(config, path, log=("wandb", "tensorboard")).run():
        if report.iteration == 7:
            break
    shutil.rmtree(path / "checkpoints" / "full" / "6")
    shutil.rmtree(path / "checkpoints" / "light" / "6", ignore_errors=True)
    ids = {seed: known["id"] for seed, known in json.loads((path / "wandb.json").read_text()).items()}
    list(make_fake_trainer(config, path, resume=True).run())
    check_all(path)
    assert ids == {seed: known["id"] for seed, known in json.loads((path / "wandb.json").read_text()).items()}


def test_a_logger_may_come_later_and_goes_with_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=40), path).run())
    assert not (path / "tensorboard").exists()
    list(make_fake_trainer(small_config(), path, resume=True, log=("tensorboard",)).run())
    assert_shown(path, 1, "eval/success")
    list(make_fake_trainer(small_config(env_steps=20), path, overwrite=True).run())
    assert not (path / "tensorboard").exists()


def test_a_logger_that_fails_is_one_line_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    def unreachable(**_: Any) -> None:
        raise wandb.errors.CommError("timed out\nconsider more patience")

    rows = tensorboard.TensorBoard.log_rows
    calls = []
    monkeypatch.setattr(
        tensorboard.TensorBoard,
        "log_rows",
        lambda self, new: (calls.append(new), full() if len(calls) > 2 else rows(self, new)),
    )
    monkeypatch.setattr(wandb, "init", unreachable)
    path = tmp_path / "run"
    reports = list(make_fake_trainer(small_config(), path, log=("tensorboard", "wandb")).run())
    assert len(reports) == 8 and len(expected(path, 0, "eval/success")) == 4 and len(calls) == 3
    lines = [line for line in capsys.readouterr().out.splitlines() if "--log" in line]
    assert ["--log wandb failed" in lines[0], "--log tensorboard failed" in lines[1]] == [True, True] and len(lines) == 2
    assert "No space left on device" in lines[1] and "timed out consider" in lines[0]


def test_nobody_waits_for_a_logger_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import threading

    monkeypatch.setattr(group, "_LEAVING_S", {True: 0.05, False: 0.05})
    stuck = threading.Event()
    monkeypatch.setattr(tensorboard.TensorBoard, "close", lambda self: stuck.wait(30))
    list(make_fake_trainer(small_config(env_steps=20), tmp_path / "run", log=("tensorboard",)).run())
    stuck.set()
    assert "--log tensorboard has not sent everything yet" in capsys.readouterr().out


def test_a_signal_saves_first_and_closes_the_loggers(tmp_path: Path) -> None:
    path = tmp_path / "run"
    run_until_sigterm(make_fake_trainer(small_config(env_steps=400), path, log=("tensorboard",)), 5)
    assert (path / "checkpoints" / "full").is_dir()
    assert_shown(path, 0, "eval/success")


def test_what_cannot_be_is_reported_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--preset", "debug", "--run-dir", str(tmp_path / "run")]
    assert cli.main(["train", *where, "--log", "tensorbord"]) == 2
    assert "did you mean tensorboard" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.setattr(group.importlib.util, "find_spec", lambda name: None)
    assert cli.main(["train", *where, "--log", "wandb"]) == 2
    error = capsys.readouterr().err
    assert "--log wandb needs wandb: " in error and "[wandb]'" in error and len(error.splitlines()) == 1
    with pytest.raises(RequestError, match="unknown logger 'wanda'"):
        make_fake_trainer(small_config(), tmp_path / "run", log=("wanda",))
    assert not (tmp_path / "run").exists()
