"""`jaxrl-vis verify`: a run is repeated, and any change in its folder is found."""

import dataclasses
import hashlib
import json
import math
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fake_program import FakeProgram, run_until_sigterm, small_config

from jaxrl_vis import cli
from jaxrl_vis.config import Config, config_from_dict
from jaxrl_vis.run.storage import recent
from jaxrl_vis.run.storage.checkpoint import Checkpoints
from jaxrl_vis.run.storage.folder import read_config, read_record, read_run_id
from jaxrl_vis.run.storage.metrics import RUN_ID
from jaxrl_vis.run.storage.sums import compare_sums, write_sums
from jaxrl_vis.run.trainer import Trainer
from jaxrl_vis.run.verifying import verification
from jaxrl_vis.run.verifying.inspection import Findings, RowConditions, check_record, missing_rows, read_file
from jaxrl_vis.run.verifying.verification import Verification, verify


def expected_in(path: Path) -> RowConditions:
    """Return the conditions for the rows of the run of eight iterations."""
    return RowConditions(seeds=[0, 1], updates=3, env_steps=10, eval_interval=2, run_id=read_run_id(path))


@pytest.fixture(scope="module")
def run_trainer(straight) -> Callable[..., Trainer]:
    """Function that makes trainers of the fake program, which is compiled once for all tests."""

    def function(config: Config, path: Path | None = None, resume: bool = False) -> Trainer:
        trainer = Trainer(config, FakeProgram(config), path, resume=resume)
        trainer.programs._compiled = straight[1].programs._compiled
        return trainer

    return function


@pytest.fixture(scope="module")
def verified(run_trainer) -> Callable[..., Verification]:
    """Function that verifies a folder and returns the report."""

    def function(path: Path, iterations: int | None = None, echo: Callable[[str], None] = lambda line: None) -> Verification:
        record, config, report = read_record(path), read_config(path), Verification()
        check_record(record, config, report)
        return verify(run_trainer(config), path, record, iterations, report, echo)

    return function


@pytest.fixture
def copy(straight, tmp_path) -> Path:
    """Run of two seeds and eight iterations, with an evaluation and both kinds of checkpoint after every second one."""
    return Path(shutil.copytree(straight[0], tmp_path / "run"))


def contents(path: Path) -> dict[str, tuple[int, str]]:
    files = [file for file in sorted(path.rglob("*")) if file.is_file()]
    return {str(file): (file.stat().st_mtime_ns, hashlib.sha256(file.read_bytes()).hexdigest()) for file in files}


def rows_in(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def change_config(path: Path, **changes: Any) -> None:
    record = json.loads((path / "config.json").read_text())
    record["config"] = dataclasses.asdict(config_from_dict(record["config"]).replace(**changes))
    (path / "config.json").write_text(json.dumps(record))


def test_a_run_that_nobody_touched_is_equal_and_stays_as_it_is(copy, verified):
    before = contents(copy)
    report = verified(copy)
    assert report.is_equal and report.problems == []
    assert not any(" then, " in line for line in report.caveats)
    # Two evaluations from the seed, one from full/6; and the states on the way.
    assert report.rows == 6 and report.checkpoints == ["light/8", "full/8"]
    assert contents(copy) == before
    assert "of iterations 6 to 6: checked, but not repeated" in " ".join(report.unverified)
    write_rows(copy, [row | {"time/wall_s": 5.0} for row in rows_in(copy)])  # times are left out
    whole = verified(copy, iterations=8)
    assert whole.is_equal and whole.rows == 8 and {"light/6", "full/6"} <= set(whole.checkpoints)
    assert not any("repeated" in line for line in whole.unverified)


def test_each_changed_digit_of_a_repeated_row_is_found(copy, verified):
    shutil.rmtree(copy / "checkpoints")
    missing = verified(copy).problems
    rows = rows_in(copy)
    names = [name for name in rows[0] if not name.startswith("time/")]
    for number, name in enumerate(names):
        changed = [dict(row) for row in rows]
        row = changed[number % 4]  # one seed or the other of the first two evaluations
        text = json.dumps(row[name])
        mantissa = text if isinstance(row[name], str) else text.partition("e")[0]  # the run's id has letters
        last = max(place for place, letter in enumerate(mantissa) if letter.isdigit())
        row[name] = json.loads(text[:last] + str((int(text[last]) + 1) % 10) + text[last + 1 :])
        write_rows(copy, changed)
        report = verified(copy)
        assert len(report.problems) > len(missing), name
        if "/" in name:
            assert f"{name} is {row[name]}" in report.differences[0] and 0.0 < report.largest < 1.0


def test_each_flipped_bit_of_a_full_checkpoint_is_found(copy, verified):
    draw = random.Random(0)
    full = copy / "checkpoints" / "full" / "8"
    for file in sorted(file for file in full.rglob("*") if file.is_file() and file.stat().st_size):
        before = file.read_bytes()
        bit = draw.randrange(8 * len(before))
        after = bytearray(before)
        after[bit // 8] ^= 1 << bit % 8
        file.write_bytes(after)
        assert compare_sums(full), file.name
        file.write_bytes(before)
    largest = max((file for file in full.rglob("d/*")), key=lambda file: file.stat().st_size)
    data = bytearray(largest.read_bytes())
    data[len(data) // 2] ^= 1
    largest.write_bytes(data)
    report = verified(copy)
    assert any(line.startswith("checkpoint full/8: ") or "full/8 is damaged" in line for line in report.problems)
    (full / "SHA256SUMS").unlink()  # as of a run that was killed before
    assert any("full/8 is damaged" in line for line in verified(copy).problems)


def test_a_checkpoint_of_another_state_is_found(copy, verified, run_trainer, tmp_path):
    """The checkpoint is whole and its checksums fit, but this run does not arrive at its state."""
    other = tmp_path / "other"
    list(run_trainer(small_config(seed=5, env_steps=60), other).run())
    whose = {name: value for name, value in read_record(copy).items() if name == RUN_ID}
    for tier in ("light", "full"):
        shutil.rmtree(copy / "checkpoints" / tier / "6")
        shutil.copytree(other / "checkpoints" / tier / "6", copy / "checkpoints" / tier / "6")
        manifest = copy / "checkpoints" / tier / "6" / "manifest" / "metadata"
        manifest.write_text(json.dumps(json.loads(manifest.read_text()) | whose))
        write_sums(copy / "checkpoints" / tier / "6")
    report = verified(copy, iterations=8)
    assert any("light/6 differs from the repetition" in line for line in report.problems)


@pytest.mark.parametrize(
    "change, problem",
    [
        (lambda rows: rows[:2] + rows[4:], "rows of iteration 4 are missing"),
        (lambda rows: rows[:-2], "rows of iteration 8 are missing"),
        (lambda rows: [], "rows of iteration 2, 4, 6, 8 are missing"),
        (lambda rows: rows[:5] + rows[6:], "iteration 6 has no row of seed 1"),
        (lambda rows: [*rows[:3], rows[2], *rows[3:]], "iteration 4, seed 0 occurs more than once"),
        (lambda rows: [*rows[:4], *rows[6:], *rows[4:6]], "iteration 6, seed 0 is out of order"),
        (lambda rows: [*rows[:6], rows[6] | {"seed": 9}, rows[7]], "is of seed 9"),
        (lambda rows: [*rows[:6], rows[6] | {"env_steps": 81}, rows[7]], "env_steps is 81, not 80"),
        (lambda rows: [*rows[:6], rows[6] | {"train/success": "0.5"}, rows[7]], "train/success: not a number"),
        (lambda rows: [*rows[:6], rows[6] | {"resume/replay_lost_at": 11}, rows[7]], "does not fit iteration 8"),
    ],
)
def test_rows_that_do_not_fit_are_found(straight, tmp_path, change, problem):
    write_rows(tmp_path, change(rows_in(straight[0])))
    findings, expected = Findings(), expected_in(straight[0])
    rows = read_file(tmp_path / "metrics.jsonl", expected, False, findings)
    missing = missing_rows(rows, expected, last_written=8, total=8, without=(), is_written=False)
    assert problem in "; ".join(findings.problems + missing)


def test_rows_that_are_none_are_found(straight, tmp_path):
    file = tmp_path / "metrics.jsonl"
    lines = (straight[0] / "metrics.jsonl").read_bytes().splitlines(keepends=True)
    lines[6] = lines[6][:9] + b"\xff" + lines[6][9:]
    file.write_bytes(b"".join(lines) + b'{"seed": 0, "itera')
    findings = Findings()
    assert len(read_file(file, expected_in(straight[0]), False, findings)) == 7
    assert findings.problems == ["metrics.jsonl: the last line is cut off", "metrics.jsonl, line 7: is damaged"]


def test_rows_and_checkpoints_of_another_run_are_found(copy, verified):
    record = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(record | {RUN_ID: "mine"}))
    rows = [row | {RUN_ID: "mine"} for row in rows_in(copy)]
    write_rows(copy, [*rows[:-1], rows[-1] | {RUN_ID: "other"}])
    for file in (copy / "checkpoints").glob("*/*/manifest/metadata"):
        name = "other" if file.parts[-4:-2] == ("light", "6") else "mine"
        file.write_text(json.dumps(json.loads(file.read_text()) | {RUN_ID: name}))
    for sums in (copy / "checkpoints").glob("*/*/SHA256SUMS"):
        sums.unlink()
    problems = "; ".join(verified(copy).problems)
    assert "line 8: is another run's (other)" in problems and "checkpoint light/6 is another run's (other)" in problems
    assert "line 7" not in problems and "full/6" not in problems


def test_what_is_missing_contradicts_or_is_foreign_is_said(copy, verified):
    (copy / "notes.txt").write_text("mine")
    (copy / "checkpoints" / "light" / "9.orbax-checkpoint-tmp-7").mkdir()
    (copy / "checkpoints" / "damaged" / "full-9").mkdir(parents=True)
    report = verified(copy)
    assert report.is_equal and "set aside before as damaged: full-9" in report.notes
    assert (
        "not files of a run: notes.txt" in report.notes
        and "checkpoints/light/9.orbax-checkpoint-tmp-7 is half-written" in report.notes
    )
    record = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(record | {"preset": "paper", "versions": {"jax": "0.1"}}))
    (copy / "curve.png").unlink()
    (copy / "checkpoints" / "full" / "6").rename(copy / "checkpoints" / "full" / "7")
    report = verified(copy)
    problems = "; ".join(report.problems)
    assert "preset is 'paper' above and 'debug' in the configuration" in problems
    assert "curve.png is missing" in problems and "full/7 says that it is of iteration 6" in problems
    assert any(line.startswith("jax 0.1 then, ") for line in report.caveats)
    shutil.rmtree(copy / "checkpoints")
    assert "checkpoints are missing: the run has come to iteration 8" in "; ".join(verified(copy).problems)


@pytest.fixture
def killed(run_trainer, tmp_path, monkeypatch) -> Path:
    """A run that kept a recent state after each iteration, and nothing else, and was killed after the sixth."""
    monkeypatch.setattr(recent, "_FRACTION", math.inf)
    path = tmp_path / "killed"
    reports = run_trainer(small_config(checkpoint_interval=0, full_checkpoint_interval=0), path).run()
    for report in reports:
        if report.iteration == 6:
            break
    saved = shutil.copytree(path, tmp_path / "then")
    reports.close()
    (saved / "run.lock").unlink()
    return saved


def test_recent_states_of_a_killed_run_are_compared_too(killed, verified):
    assert {file.name for file in (killed / "checkpoints").iterdir()} == {"recent"}
    before = contents(killed)
    report = verified(killed, iterations=6)
    assert report.is_equal and report.rows == 6 and report.checkpoints == ["recent/5", "recent/6"]
    assert not any("not files of a run" in line or "missing" in line for line in report.notes + report.unverified)
    assert contents(killed) == before
    rows = rows_in(killed)
    assert all("time/goodput" in row for row in rows)
    write_rows(killed, [row | {"time/goodput": None} for row in rows])  # where it is not known
    assert verified(killed).is_equal
    write_rows(killed, rows[:4])
    assert "rows of iteration 6 are missing" in "; ".join(verified(killed).problems)


def test_what_is_wrong_with_recent_states_is_found(killed, verified, run_trainer):
    folder = killed / "checkpoints" / "recent"
    state = folder / "6.state"
    data = bytearray(state.read_bytes())
    data[-1] ^= 1
    state.write_bytes(data)
    (folder / "7.state.tmp").touch()
    (folder / "7.old").touch()
    (killed / "processes.jsonl").write_text("{")
    report = verified(killed, iterations=6)
    # A power cut may leave that behind.
    assert report.is_equal and any("recent/6 cannot be used (wrong checksum" in line for line in report.notes)
    assert "not files of a run: checkpoints/recent/7.old" in report.notes
    assert any("goodput of the run is unknown" in line for line in report.notes)
    checkpoints = Checkpoints(killed / "checkpoints", run_id=read_run_id(killed))
    loop, progress = checkpoints.recent.restore(5, run_trainer(small_config()).programs.shapes)
    loop = loop.replace(train=loop.train.replace(agent=loop.train.agent | {"updates": loop.train.agent["updates"] + 1}))
    for run_id, problem in (("other", "recent/5 is another run's (other)"), (read_run_id(killed), "recent/5 differs from")):
        checkpoints.run_id = run_id
        checkpoints.recent.save(5, loop, 2, progress)
        assert problem in "; ".join(verified(killed, iterations=6).problems)


def test_a_run_that_is_still_written_is_verified_as_far_as_it_is_there(copy, verified):
    (copy / "run.lock").write_text("{}")
    with (copy / "metrics.jsonl").open("a") as file:
        file.write('{"seed": 0, "itera')
    shutil.rmtree(copy / "checkpoints" / "light" / "8")
    report = verified(copy)
    assert report.is_equal and any("may be writing" in line for line in report.notes)


def test_a_run_that_lost_its_replay_is_verified_up_to_there_and_after_full_checkpoints(verified, run_trainer, tmp_path):
    path = tmp_path / "light"
    config = small_config(full_checkpoint_interval=0, env_steps=40)
    list(run_trainer(config, path).run())
    list(run_trainer(config.replace(env_steps=80), path, resume=True).run())
    report = verified(path, iterations=8)
    assert report.is_equal and report.rows == 4
    assert any("after iteration 4 the run resumed from a light checkpoint" in line for line in report.unverified)
    assert any("of iterations 6 to 8: checked" in line for line in report.unverified)
    run_until_sigterm(run_trainer(config.replace(env_steps=100), path, resume=True), 9)
    list(run_trainer(config.replace(env_steps=120, full_checkpoint_interval=2), path, resume=True).run())
    report = verified(path, iterations=12)
    assert report.is_equal and report.rows == 8  # iterations 10 and 12, too, from full/10


def test_an_exactly_resumed_run_is_equal_whatever_its_interval_was(verified, run_trainer, tmp_path):
    path = tmp_path / "run"
    run_until_sigterm(run_trainer(small_config(eval_interval=4), path), 4)
    list(run_trainer(small_config(eval_interval=3, env_steps=90), path, resume=True).run())
    assert [row["iteration"] for row in rows_in(path)[::2]] == [4, 6, 9]
    report = verified(path, iterations=9)
    assert report.is_equal and report.rows == 6
    assert any("iteration 4 has means since iteration 0" in line for line in report.notes)


def test_the_command_says_what_it_found(copy, verified, monkeypatch, capsys):
    monkeypatch.setattr(
        verification, "verify_run", lambda path, iterations, cache_programs, echo, trust: verified(path, iterations, echo)
    )
    assert cli.main(["verify", str(copy)]) == 0
    out = capsys.readouterr().out
    assert "made by revision" in out and "iteration 4: 20 numbers of 2 seeds, all equal" in out
    assert out.splitlines()[-1].startswith("equal bit for bit: 6 rows, ")
    rows = rows_in(copy)
    rows[1]["train/goal_distance"] += 1e-9
    write_rows(copy, rows)
    record = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(record | {"versions": {"jax": "0.1"}}))
    assert cli.main(["verify", str(copy), "--iterations", "1"]) == 1
    out = capsys.readouterr().out
    assert "iteration 2, from the seed: seed 1 train/goal_distance is " in out and "largest relative difference: " in out
    (copy / "metrics.jsonl").unlink()
    shutil.rmtree(copy / "checkpoints")
    assert cli.main(["verify", str(copy)]) == 2
    assert "let the run reach an evaluation" in capsys.readouterr().err
    assert cli.main(["verify", str(copy / "nowhere")]) == 2
