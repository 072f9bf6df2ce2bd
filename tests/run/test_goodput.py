"""Goodput: the arithmetic, its file, and the counters of interrupted and resumed runs."""

import pytest
from fake_program import make_fake_trainer, rows_without_time, small_config

from jaxrl_vis.run.goodput import Account, Goodput, Process, account, read_processes
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.checkpoint import RECENT, Checkpoints


def test_steps_of_all_processes_are_added_up():
    lines = [Process(0, 12), Process(10, 8, replay_lost=True), Process(15, 5)]
    total = account(lines, done=20)
    assert total == Account(done=20, begun=25, resumes=2, replays_lost=1) and total.goodput == 0.8
    assert total.describe(updates=200) == (
        "goodput 0.800: 4,000 of 5,000 gradient steps are kept; resumed 2 times, replay lost once"
    )


def test_a_run_that_has_not_begun_has_lost_nothing():
    assert account([Process(0)], done=0).goodput == 1.0


def test_a_count_outlives_its_process_without_being_closed(tmp_path):
    path = tmp_path / "processes.jsonl"
    first = Goodput(path)
    first.begin(0, replay_lost=False)
    for _ in range(1234):
        first.count()
    second = Goodput(path)
    second.begin(1200, replay_lost=True)
    second.count()
    assert read_processes(path) == [Process(0, 1234), Process(1200, 1, True)]
    assert second.account(1201) == Account(1201, 1235, 1, 1)
    assert len({len(line) for line in path.read_bytes().splitlines()}) == 1  # written in place


def test_what_earlier_processes_lost_without_an_account_is_not_made_up(tmp_path):
    goodput = Goodput(tmp_path / "processes.jsonl")
    goodput.begin(30, replay_lost=False)
    assert goodput.account(30) == Account(30, 30, 1, 0)


@pytest.mark.parametrize("damage", [b"\xff", b'{"start": 0, "begun": "7"}', b"[]", b'{"start": 0, "begun": -3}'])
def test_a_damaged_line_makes_the_goodput_unknown_and_is_kept(tmp_path, damage):
    path = tmp_path / "processes.jsonl"
    path.write_bytes(damage)
    goodput = Goodput(path)
    goodput.begin(4, replay_lost=False)
    goodput.count()
    assert path.read_bytes().startswith(damage + b"\n") and read_processes(path)[1] == Process(4, 1)
    total = goodput.account(5)
    assert total.goodput is None and "unknown" in total.describe(3) and total.resumes == 1


def abandon_run(config, path, iteration: int) -> None:
    """Abandon a run after the report of ``iteration``, without an end, as if it were killed."""
    trainer = make_fake_trainer(config, path, resume=path.exists())
    for report in trainer.run():
        if report.iteration == iteration:
            return


def test_a_run_that_was_killed_says_what_it_lost(straight, tmp_path, capsys):
    path, config = tmp_path / "run", small_config(full_checkpoint_interval=0)
    abandon_run(config, path, 3)
    first = read_processes(path / "processes.jsonl")[0].begun
    saved = Checkpoints(path / "checkpoints").newest()
    assert 3 <= first <= 4 and saved >= 2
    list(make_fake_trainer(config, path, resume=True).run())
    total = account(read_processes(path / "processes.jsonl"), done=8)
    assert total == Account(8, first + 8 - saved, 1, 0)
    assert total.describe(3) in capsys.readouterr().out
    rows = metrics.read_rows(path / "metrics.jsonl")
    assert rows[-1]["time/goodput"] == round(total.goodput, 3) and rows[0]["time/goodput"] == 1.0
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_a_lost_replay_is_counted_each_time(tmp_path, capsys):
    path, config = tmp_path / "run", small_config(full_checkpoint_interval=0)
    for iteration in (3, 6):
        abandon_run(config, path, iteration)
        Checkpoints(path / "checkpoints").recent.clear()
    list(make_fake_trainer(config, path, resume=True).run())
    out = capsys.readouterr().out
    assert "resumed 2 times, replay lost 2 times" in out and out.count("replay lost; networks go on") == 2


def test_a_run_without_interruption_has_a_goodput_of_one(straight):
    path, *_ = straight
    assert {row["time/goodput"] for row in metrics.read_rows(path / "metrics.jsonl")} == {1.0}
    assert read_processes(path / "processes.jsonl")[0] == Process(0, 8)


def test_overwrite_begins_a_new_account(tmp_path):
    path, config = tmp_path / "run", small_config(env_steps=20)
    list(make_fake_trainer(config, path).run())
    list(make_fake_trainer(config, path, overwrite=True).run())
    assert read_processes(path / "processes.jsonl") == [Process(0, 2)]
    assert not Checkpoints(path / "checkpoints").iterations(RECENT)  # nothing of a run that has ended needs it
