"""Run ids of checkpoints and rows: nothing of another run is resumed, counted or deleted."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from fake_program import FakeProgram, final_state, make_fake_trainer, rows_without_time, run_until_sigterm, small_config

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError, StorageError
from jaxrl_vis.run import trainer
from jaxrl_vis.run.compiled.programs import Programs
from jaxrl_vis.run.saving import Saver
from jaxrl_vis.run.storage import folder as folders
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT
from jaxrl_vis.run.storage.folder import RunFolder, read_run_id
from jaxrl_vis.run.storage.lock import FolderGoneError
from jaxrl_vis.run.storage.sums import write_sums
from jaxrl_vis.run.trained import restored_run


def checkpoints_in(path: Path) -> list[str]:
    return sorted(f"{entry.parent.name}/{entry.name}" for entry in path.glob("checkpoints/*/*") if entry.name.isdigit())


def test_everything_that_a_run_writes_carries_its_id(tmp_path):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=40), path).run())
    run_id = read_run_id(path)
    assert run_id is not None and len(run_id) == 32
    list(make_fake_trainer(small_config(), path, resume=True).run())
    assert read_run_id(path) == run_id and {row["run_id"] for row in metrics.read_rows(path / "metrics.jsonl")} == {run_id}
    for manifest in path.glob("checkpoints/*/*/manifest/metadata"):
        assert json.loads(manifest.read_text())["run_id"] == run_id
    list(make_fake_trainer(small_config(env_steps=20), path, overwrite=True).run())
    assert read_run_id(path) not in (None, run_id)


def test_a_new_run_does_not_go_on_with_an_old_ones_checkpoints(straight, tmp_path, capsys):
    """The old checkpoints could not be deleted, and the new run is interrupted before it reaches their iterations."""
    path = tmp_path / "run"
    run_until_sigterm(make_fake_trainer(small_config(), path), 2)
    for tier in (LIGHT, FULL):  # later than its own
        shutil.copytree(straight[0] / "checkpoints" / tier, path / "checkpoints" / tier, dirs_exist_ok=True)
    (path / "metrics.jsonl").open("a").write((straight[0] / "metrics.jsonl").read_text())
    capsys.readouterr()
    reports = list(make_fake_trainer(small_config(), path, resume=True).run())
    said = capsys.readouterr().out
    assert reports[0].iteration < 6 and "exactly" in said and "not of this run, and left out" in said
    assert "metrics.jsonl held 8 rows of another run: kept in" in said
    assert rows_without_time(path) == rows_without_time(straight[0])
    aside = path / "checkpoints" / "foreign"
    foreign = ["full-6", "full-8", "light-6", "light-8", "metrics.jsonl"]
    assert sorted(entry.name for entry in aside.iterdir()) == foreign
    assert metrics.read_rows(aside / "metrics.jsonl") == metrics.read_rows(straight[0] / "metrics.jsonl")


def test_starting_again_deletes_nothing_of_another_run(straight, tmp_path, capsys):
    path = tmp_path / "run"
    for repetition in range(2):
        run_until_sigterm(make_fake_trainer(small_config(), path, overwrite=repetition > 0), 2)
        for tier in (LIGHT, FULL):
            shutil.copytree(straight[0] / "checkpoints" / tier, path / "checkpoints" / tier, dirs_exist_ok=True)
        (path / "metrics.jsonl").open("a").write((straight[0] / "metrics.jsonl").read_text())
    capsys.readouterr()
    list(make_fake_trainer(small_config(env_steps=20), path, overwrite=True).run())
    assert capsys.readouterr().out.count("not of this run, and left out") == 4
    aside = path / "checkpoints" / "foreign"
    names = ["full-6", "full-8", "light-6", "light-8"]
    assert sorted(entry.name for entry in aside.iterdir()) == sorted(
        [*names, *(f"{name}-2" for name in names), "metrics.jsonl"]
    )
    assert (aside / "metrics.jsonl").read_text() == (straight[0] / "metrics.jsonl").read_text() * 2
    assert checkpoints_in(path) == ["full/2", "light/2"]


def test_what_uses_a_run_does_not_count_another_ones(straight, tmp_path, monkeypatch):
    path = tmp_path / "run"
    list(make_fake_trainer(small_config(env_steps=20), path).run())
    shutil.copytree(straight[0] / "checkpoints" / LIGHT, path / "checkpoints" / LIGHT, dirs_exist_ok=True)
    metrics.append_rows(path / "metrics.jsonl", metrics.read_rows(straight[0] / "metrics.jsonl"))
    assert {row["iteration"] for row in RunFolder(path).rows()} == {2}
    monkeypatch.setattr(restored_run, "make_trainer", lambda config, **_: trainer.Trainer(config, FakeProgram(config)))
    opened = restored_run.open_run(path)
    assert restored_run.load(opened, path).iteration == 2
    with pytest.raises(RequestError, match="no checkpoint of iteration 8, only of 2"):
        restored_run.load(opened, path, 8)


def test_a_run_that_lost_its_id_is_refused_in_one_line(straight, tmp_path):
    path = Path(shutil.copytree(straight[0], tmp_path / "run"))
    record = json.loads((path / "config.json").read_text())
    del record["run_id"]
    (path / "config.json").write_text(json.dumps(record))
    with pytest.raises(RequestError, match="^run_id in .*config.json must be a word, not None: put back what it held$"):
        list(make_fake_trainer(small_config(env_steps=100), path, resume=True).run())


def test_overwriting_empties_what_a_link_leads_to_and_keeps_the_link(tmp_path):
    path, scratch = tmp_path / "run", tmp_path / "scratch"
    list(make_fake_trainer(small_config(), path).run())
    (path / "checkpoints").rename(scratch)
    (scratch / "thesis.txt").write_text("precious")
    (path / "checkpoints").symlink_to(scratch)
    (path / "nonfinite").symlink_to(scratch)
    assert checkpoints_in(path) == ["full/6", "full/8", "light/6", "light/8"]
    list(make_fake_trainer(small_config(seed=5, env_steps=20), path, overwrite=True).run())
    assert checkpoints_in(path) == ["full/2", "light/2"] and (path / "checkpoints").is_symlink()
    assert (scratch / "thesis.txt").read_text() == "precious" and not (path / "nonfinite").exists()
    shutil.rmtree(scratch)  # a link that leads nowhere goes
    list(make_fake_trainer(small_config(env_steps=20), path, overwrite=True).run())
    assert checkpoints_in(path) == ["full/2", "light/2"] and not (path / "checkpoints").is_symlink()


def test_what_cannot_be_deleted_is_reported_before_a_new_run_starts(straight, tmp_path, monkeypatch):
    path = Path(shutil.copytree(straight[0], tmp_path / "run"))
    rmtree = shutil.rmtree

    def busy(folder, *arguments, **options):  # as where NFS keeps a deleted file that somebody reads
        if Path(folder).name == FULL and not options.get("ignore_errors"):
            raise OSError(39, "Directory not empty", str(folder))
        rmtree(folder, *arguments, **options)

    monkeypatch.setattr(folders.shutil, "rmtree", busy)
    with pytest.raises(RequestError, match="full stays .Directory not empty.. No new run was started: delete it") as refused:
        list(make_fake_trainer(small_config(seed=5), path, overwrite=True).run())
    assert "\n" not in str(refused.value)
    monkeypatch.undo()
    assert read_run_id(path) == read_run_id(straight[0]) and (path / "metrics.jsonl").exists()
    assert list(make_fake_trainer(small_config(env_steps=100), path, resume=True).run())[0].iteration == 9


def error_of_moved_run(trainer, iteration: int, act) -> StorageError:
    """Return the error of a run that ends because ``act`` changes its folder after ``iteration``."""
    with pytest.raises(StorageError) as stopped:
        for report in trainer.run():
            if report.iteration == iteration:
                act()
    assert "\n" not in str(stopped.value)
    return stopped.value


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="other systems do not say where a folder went")
def test_a_folder_that_is_moved_is_reported_where_it_is_and_goes_on_there(straight, tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    config = small_config(full_checkpoint_interval=4, checkpoint_interval=4)
    error = error_of_moved_run(make_fake_trainer(config, old), 5, lambda: old.rename(new))
    assert f"{old} was moved to {new}" in str(error) and f"go on with --run-dir {new} --resume" in str(error)
    assert not old.exists()  # nothing that would look like a run
    list(make_fake_trainer(config, new, resume=True).run())
    assert rows_without_time(new) == rows_without_time(straight[0])
    assert all(
        (a == b).all() for a, b in zip(final_state(new, straight[1].shapes), final_state(straight[0], straight[1].shapes))
    )


def test_a_folder_that_is_deleted_is_not_made_again(tmp_path):
    path = tmp_path / "run"
    error = error_of_moved_run(make_fake_trainer(small_config(), path), 3, lambda: shutil.rmtree(path))
    assert f"{path} is gone" in str(error) and "make room" not in str(error)
    assert not path.exists()


@pytest.mark.parametrize("resume", [False, True])
@pytest.mark.parametrize("is_moved", [False, True])
def test_a_folder_that_goes_while_the_run_compiles_is_not_made_again(straight, tmp_path, monkeypatch, resume, is_moved):
    """The lock was in the old folder: another run could begin in a new one."""
    path, there = tmp_path / "run", tmp_path / "there"
    if resume:
        shutil.copytree(straight[0], path)
    trainer = make_fake_trainer(small_config(env_steps=100), path, resume=resume)
    compile_all = Programs.compile

    def compile_slowly(*arguments, **options):
        compiled = compile_all(*arguments, **options)
        path.rename(there)
        if not is_moved:
            shutil.rmtree(there)
        return compiled

    monkeypatch.setattr(Programs, "compile", compile_slowly)
    with pytest.raises(FolderGoneError) as stopped:
        list(trainer.run())
    words = str(stopped.value)
    assert "before the run began" in words and "\n" not in words and "lost" not in words
    assert f"{path} is gone" in words or (is_moved and f"{path} was moved to {there} " in words)
    assert not path.exists() and there.exists() == is_moved


def test_a_folder_that_goes_at_the_very_end_is_not_made_again(tmp_path, monkeypatch, capsys):
    path = tmp_path / "run"
    monkeypatch.setattr(Saver, "finish", lambda saver: shutil.rmtree(path))
    with pytest.raises(FolderGoneError, match="is gone"):
        list(make_fake_trainer(small_config(env_steps=20), path).run())
    assert not path.exists() and "see curve" not in capsys.readouterr().out


@pytest.mark.parametrize("other", [None, "notes.txt", "checkpoints/light/2/manifest"])
def test_what_a_save_makes_again_of_a_deleted_folder_is_deleted_too(tmp_path, other):
    path = tmp_path / "run"

    def delete():
        shutil.rmtree(path)
        half = path / "checkpoints" / LIGHT / "2.orbax-checkpoint-tmp" / "train.orbax-checkpoint-tmp"
        half.mkdir(parents=True)  # as threads of tensorstore do, which make all folders that they need
        (half / "manifest.ocdbt").touch()
        if other is not None:
            (path / other).parent.mkdir(exist_ok=True)
            (path / other).touch()

    assert "is gone" in str(error_of_moved_run(make_fake_trainer(small_config(), path), 3, delete))
    assert path.exists() == (other is not None) and (other is None or (path / other).exists())


def test_checksums_do_not_make_a_folder_again(tmp_path):
    with pytest.raises(OSError):
        write_sums(tmp_path / "gone")
    assert not (tmp_path / "gone").exists()


def test_a_new_folder_of_the_same_name_is_left_alone(tmp_path):
    path = tmp_path / "run"

    def replace():
        path.rename(tmp_path / "moved")
        path.mkdir()
        (path / "notes.txt").write_text("mine")

    assert "was moved to" in str(error_of_moved_run(make_fake_trainer(small_config(), path), 3, replace)) or os.name != "posix"
    assert [entry.name for entry in path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("name", ["a" * 300, "a/" + "b" * 300])
@pytest.mark.parametrize(
    "words",
    [
        ["eval"],
        ["play"],
        ["train", "Reacher", "--preset", "debug", "--run-dir"],
        ["train", "--resume", "--run-dir"],
        ["figure", "5.4", "--draw-only", "--runs"],
        ["grasp", "eval", "--reach", "--loops", "policy", "--policy"],
        ["grasp", "run"],
    ],
    ids=["eval", "play", "train", "resume", "figure", "policy", "grasp"],
)
def test_a_name_that_is_too_long_is_one_line(tmp_path, monkeypatch, capsys, words, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    assert cli.main([*words, name]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "File name too long" in error and len(error) < 300


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.parametrize(
    "words",
    [
        ["eval"],
        ["play"],
        ["verify"],
        ["train", "--resume", "--run-dir"],
        ["train", "Reacher", "--preset", "debug", "--run-dir"],
    ],
    ids=["eval", "play", "verify", "resume", "train"],
)
def test_a_run_folder_whose_name_is_not_utf8_is_refused_before_work_is_lost(straight, tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    if "Reacher" not in words:
        shutil.copytree(straight[0], "run\udcff")
    before = sorted(Path().rglob("*"))
    assert cli.main([*words, "run\udcff"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "'run\\udcff' cannot be a run folder" in error
    assert sorted(Path().rglob("*")) == before


@pytest.mark.parametrize(
    "words", [["figure", "quadratic", "--out"], ["sweep", "Reacher", "--preset", "debug", "--runs"]], ids=["file", "folder"]
)
def test_a_place_for_results_that_no_system_knows_is_one_line(capsys, words):
    assert cli.main([*words, "a\0b.png"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "'a\\x00b.png' cannot be used" in error


@pytest.mark.parametrize("words", [["eval"], ["play"], ["train", "--resume", "--run-dir"]], ids=["eval", "play", "resume"])
@pytest.mark.parametrize("contents", [b"[" * 10**5, b'{"schema": 2, "log": 5}', b'{"schema": 2, "run_id": 5}', b"\xff", b"[]"])
def test_a_config_file_that_cannot_be_used_is_one_line(tmp_path, capsys, words, contents):
    (tmp_path / "config.json").write_bytes(contents)
    assert cli.main([*words, str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and len(error) < 600


@pytest.mark.parametrize(
    "contents, goes",
    [
        ({"_CHECKPOINT_METADATA": "", "SHA256SUMS": ""}, True),
        ({"manifest/metadata": '{"run_id": "ours"}'}, True),
        ({"manifest/metadata": '{"run_id": "theirs"}'}, False),
        ({"manifest/metadata": "{"}, False),
    ],
)
def test_what_a_thread_made_of_a_folder_that_was_moved_goes(tmp_path, contents, goes):
    for name, text in contents.items():
        file = tmp_path / "run" / "checkpoints" / LIGHT / "4" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    RunFolder(tmp_path / "run").remove_remains("ours")
    assert (tmp_path / "run").exists() != goes


def test_a_row_whose_id_has_a_wrong_bit_is_put_aside(straight, tmp_path, capsys):
    path = tmp_path / "run"
    run_until_sigterm(make_fake_trainer(small_config(), path), 4)
    file = path / "metrics.jsonl"
    *lines, last = file.read_text().splitlines(keepends=True)
    run_id = read_run_id(path)
    assert run_id is not None and run_id in last
    corrupted = last.replace(run_id, ("1" if run_id[0] == "0" else "0") + run_id[1:])
    file.write_text("".join([*lines, corrupted]))
    list(make_fake_trainer(small_config(), path, resume=True).run())
    assert "metrics.jsonl held 1 row of another run: kept in" in capsys.readouterr().out
    assert (path / "checkpoints" / "foreign" / "metrics.jsonl").read_text() == corrupted
    assert rows_without_time(path)[-2:] == rows_without_time(straight[0])[-2:]
