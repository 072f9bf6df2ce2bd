"""metrics.jsonl, including files that a disk or a user has damaged."""

import json
import math

import pytest
from fake_program import make_fake_trainer, rows_without_time, run_until_sigterm, small_config

from jaxrl_vis.errors import RequestError
from jaxrl_vis.report.learning import curve
from jaxrl_vis.run.loggers.group import Loggers
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.folder import RunFolder, read_run_id
from jaxrl_vis.studies.engine.cells import Cell, describe_progress, find_folder, latest_rows


def row(iteration: int, seed: int = 0, **changes) -> dict:
    counts = {"seed": seed, "iteration": iteration, "updates": 3 * iteration, "env_steps": 10 * iteration}
    return {**counts, "eval/success": 0.5, **changes}


def line(**changes) -> bytes:
    return json.dumps({**row(2), **changes}).encode()


DAMAGED = {
    "not UTF-8": line().replace(b"eval", b"ev\xff\xfe"),
    "not JSON": line().replace(b":", b"x", 1),
    "another value": b"[1, 2]",
    "a number": b"7",
    "a text for a count": line(iteration="2"),
    "truth for a count": line(seed=True),
    "nothing for a count": line(env_steps=None),
    "a fraction for a count": line(updates=6.0),
    "below nothing": line(iteration=-2),
    "a text for a figure": line(**{"eval/success": "0.5"}),
    "truth for a figure": line(**{"eval/success": True}),
    "a list for a figure": line(**{"eval/success": [0.5]}),
    "not a number": line(**{"eval/success": math.nan}),
    "infinity": line(**{"eval/success": math.inf}),
    "more than a float holds": line().replace(b"0.5", b"1e999"),
    "a huge number": line().replace(b"0.5", b"9" * 400),
    "thousands of digits": line().replace(b"0.5", b"9" * 5000),
    "a key is missing": json.dumps({name: value for name, value in row(2).items() if name != "env_steps"}).encode(),
    "too deep": b'{"a":' * 10**5,
    "twice": json.dumps(row(1)).encode(),
    "whose it is": line(run_id=7),
    "zeros": b"\0" * 80,
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_line_is_kept_aside_and_reported(tmp_path, kind):
    path, aside = tmp_path / "metrics.jsonl", tmp_path / "damaged" / "metrics.jsonl"
    rows = [row(1), row(3)]
    path.write_bytes(b"%s\n%s\n%s\n" % (json.dumps(rows[0]).encode(), DAMAGED[kind], json.dumps(rows[1]).encode()))
    assert metrics.read_rows(path) == rows
    said = metrics.truncate(path, 3, None, aside, aside, keeps_later=False)
    assert said is not None and "1 damaged line (line 2)" in said and str(aside) in said and "\n" not in said
    assert aside.read_bytes() == DAMAGED[kind] + b"\n" and metrics.read_contents(path).damaged == []
    assert metrics.read_rows(path) == rows and metrics.truncate(path, 3, None, aside, aside, keeps_later=False) is None


@pytest.mark.parametrize("torn", [b'{"seed": 0, "iter', b'{"seed": 0, "eval/\xc3', b"\0" * 50])
def test_what_a_kill_has_left_of_the_last_line_is_not_reported(tmp_path, torn):
    path = tmp_path / "metrics.jsonl"
    metrics.append_rows(path, [row(1)])
    path.write_bytes(path.read_bytes() + torn)
    assert metrics.read_contents(path) == metrics.Contents([row(1)], [], torn)
    assert metrics.truncate(path, 9, None, tmp_path / "aside", tmp_path / "aside", keeps_later=False) is None
    assert path.read_text() == json.dumps(row(1)) + "\n" and not (tmp_path / "aside").exists()


def test_rows_out_of_order_and_of_an_editor_of_windows(tmp_path):
    path = tmp_path / "metrics.jsonl"
    lines = [json.dumps(entry) for entry in (row(3), row(1), row(2, seed=1), row(2))]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([*lines, "", ""]).encode())
    assert metrics.read_rows(path) == [row(1), row(2, seed=1), row(2), row(3)]
    assert metrics.read_contents(path).damaged == []


def test_a_metrics_file_that_cannot_be_read_is_one_line(tmp_path):
    (tmp_path / "metrics.jsonl").mkdir()
    with pytest.raises(RequestError, match="cannot read .*metrics.jsonl"):
        metrics.read_rows(tmp_path / "metrics.jsonl")


def test_a_run_goes_on_without_damaged_rows(tmp_path, capsys):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=60), path).run())
    file = path / "metrics.jsonl"
    lines = file.read_bytes().splitlines()
    bad = [lines[0].replace(b"seed", b"s\xffed"), lines[3].replace(b"4", b'"4"', 1)]
    file.write_bytes(b"\n".join([bad[0], *lines[1:3], bad[1], *lines[4:], b""]))
    good = rows_without_time(path)
    assert len(good) == 4
    list(make_fake_trainer(small_config(), path, resume=True).run())
    assert "metrics.jsonl held 2 damaged lines (line 1, 4): kept in" in capsys.readouterr().out
    after = rows_without_time(path)
    assert after[:4] == good and [entry["iteration"] for entry in after[4:]] == [8, 8]
    assert (path / "checkpoints" / "damaged" / "metrics.jsonl").read_bytes().splitlines() == bad


def test_a_finished_run_that_lost_its_last_row_is_evaluated_again(straight, tmp_path, capsys):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(), path).run())
    file = path / "metrics.jsonl"
    *lines, last = file.read_bytes().splitlines()
    file.write_bytes(b"\n".join([*lines, last[:-9] + b"\xff", b""]))
    assert list(make_fake_trainer(small_config(), path, resume=True).run())[-1].iteration == 8
    assert "1 damaged line (line 8)" in capsys.readouterr().out
    *expected, restored = rows_without_time(straight[0])  # what it was trained with since the evaluation before is not kept
    assert rows_without_time(path) == [*expected, {name: restored[name] for name in restored if not name.startswith("train/")}]


@pytest.mark.parametrize(("env_steps", "number"), [(60, 5), (60, 6), (80, 5)])
def test_a_torn_last_row_that_was_whole_is_kept_aside_and_reported(tmp_path, capsys, env_steps, number):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=60), path).run())
    file = path / "metrics.jsonl"
    lines = file.read_bytes().splitlines()
    assert len(lines) == 6  # the last two are of one iteration
    torn = lines[number - 1][:-30]
    file.write_bytes(b"\n".join([*lines[: number - 1], torn]))
    for _ in range(2):  # a second time it has nothing to say
        list(make_fake_trainer(small_config(env_steps=env_steps), path, resume=True).run())
    said = capsys.readouterr().out
    assert said.count(f"metrics.jsonl held 1 damaged line (line {number}): kept in") == 1
    assert (path / "checkpoints" / "damaged" / "metrics.jsonl").read_bytes() == torn + b"\n"
    assert [entry["iteration"] for entry in rows_without_time(path)][-2:] == [env_steps // 10] * 2


def test_everything_else_that_reads_rows_leaves_damaged_ones_out(tmp_path):
    folder = RunFolder(tmp_path / "family-80")
    config = small_config()
    folder.open(config)
    whose = {"run_id": read_run_id(folder.path)}
    good = [row(entry, seed, **whose) for entry in (2, 4) for seed in (0, 1)]
    lines = [json.dumps(entry).encode() for entry in good]
    folder.metrics.write_bytes(
        b"\n".join([*lines, *DAMAGED.values(), json.dumps(row(8, **whose, **{"eval/success": None})).encode(), b""])
    )
    assert folder.rows()[:-1] == good
    cell = Cell("family", config)
    assert find_folder(cell, tmp_path) == folder.path and describe_progress(cell, tmp_path) == "80 of 80 steps"
    assert [entry["seed"] for entry in latest_rows(folder.path)] == [0]
    assert curve(folder.rows(), "eval/success") == [(20, 0.5), (40, 0.5)]
    said: list[str] = []
    loggers = Loggers(["tensorboard"], folder.path, said.append)
    loggers.open({}, [0, 1], folder.rows())
    loggers.close()
    assert said == []


def test_a_checkpoint_that_is_newer_than_the_rows_is_refused(tmp_path):
    path = tmp_path / "run"
    run_until_sigterm(make_fake_trainer(small_config(), path), 6)
    file = path / "metrics.jsonl"
    before = file.read_bytes()
    file.write_bytes(b"".join(before.splitlines(keepends=True)[:4]))
    with pytest.raises(RequestError, match="comes after an evaluation at iteration 6, but metrics.jsonl ends at 4: put back"):
        list(make_fake_trainer(small_config(), path, resume=True).run())
    file.write_bytes(before)
    assert list(make_fake_trainer(small_config(), path, resume=True).run())[-1].iteration == 8
