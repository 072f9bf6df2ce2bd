"""Checkpoints: round trips, damage, kills while writing."""

import asyncio
import itertools
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest
from fake_program import FakeProgram, as_plain, make_fake_trainer, small_config

from jaxrl_vis.errors import RequestError, Terminated
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT, RECENT, REPLACED, Checkpoints
from jaxrl_vis.run.storage.manifest import FILE
from jaxrl_vis.run.storage.sums import write_sums

FAKE = Path(__file__).parents[1] / "fake_program.py"


@pytest.fixture(scope="module")
def states():
    """Loop states after 1, 2 and 3 iterations of the fake program, and the program's shapes."""
    trainer = make_fake_trainer(small_config(), None)
    loop, snapshots = trainer.init(jax.random.key(7)), []
    for _ in range(3):
        loop, _ = trainer.train_iteration(loop)
        snapshots.append(jax.tree.map(jnp.copy, loop))
    return snapshots, trainer.shapes


@pytest.fixture(scope="module")
def saved_once(states, tmp_path_factory):
    """Folder in which full and light checkpoints of iterations 1 to 3 were saved; orbax keeps 2 and 3 of both."""
    folder = tmp_path_factory.mktemp("saved") / "checkpoints"
    checkpoints = Checkpoints(folder)
    for iteration, loop in enumerate(states[0], start=1):
        checkpoints.save_light(iteration, loop.train, {"wall_s": 1.5 * iteration})
        checkpoints.save_full(iteration, loop, {"wall_s": 1.5 * iteration})
    checkpoints.close()
    return folder


@pytest.fixture
def saved(saved_once, tmp_path):
    """Copy of `saved_once`, which tests may change."""
    return shutil.copytree(saved_once, tmp_path / "checkpoints")


def test_everything_comes_back_bit_for_bit(states, saved):
    loops, shapes = states
    lines = []
    checkpoints = Checkpoints(saved, lines.append)
    assert checkpoints.iterations(FULL) == checkpoints.iterations(LIGHT) == [2, 3]
    restored = checkpoints.restore_for_resume(shapes)
    assert (restored.tier, restored.iteration, restored.progress) == (FULL, 3, {"wall_s": 4.5}) and not lines
    assert jax.tree.structure(restored.loop) == jax.tree.structure(loops[2])
    for new, old in zip(jax.tree.leaves(restored.loop), jax.tree.leaves(loops[2]), strict=True):
        assert new.dtype == old.dtype and new.shape == old.shape
    assert all(map(np.array_equal, as_plain(restored.loop), as_plain(loops[2])))
    light = Checkpoints(saved, lines.append, read_only=True).restore_train(shapes)
    assert light.loop is None or light.tier == FULL
    assert all(map(np.array_equal, as_plain(light.train), as_plain(loops[2].train)))


def test_a_light_save_survives_donation(tmp_path):
    trainer = make_fake_trainer(small_config(), None)
    loop, _ = trainer.train_iteration(trainer.init(jax.random.key(0)))
    expected = as_plain(loop.train)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save_light(1, loop.train, {})
    for _ in range(5):
        loop, _ = trainer.train_iteration(loop)
    checkpoints.wait()
    assert all(map(np.array_equal, as_plain(checkpoints.restore_train(trainer.shapes).train), expected))
    checkpoints.close()


def test_a_clock_that_is_set_stops_no_save(tmp_path, monkeypatch):
    """The clock, with which orbax measures its timeouts, advances by a day at each reading."""
    trainer = make_fake_trainer(small_config(), None)
    loop, _ = trainer.train_iteration(trainer.init(jax.random.key(0)))
    checkpoints, days, right = Checkpoints(tmp_path), itertools.count(), time.time
    monkeypatch.setattr(time, "time", lambda: right() + 86400.0 * next(days))
    checkpoints.save_light(1, loop.train, {})
    checkpoints.save_full(1, loop, {})
    checkpoints.wait()
    assert next(days) > 5
    monkeypatch.undo()
    assert checkpoints.restore_for_resume(trainer.shapes).tier == FULL
    checkpoints.close()


def test_a_full_save_does_not_keep_the_replay(tmp_path):
    """After saving, the replay can be donated again: otherwise the next iteration would hold it twice."""
    trainer = make_fake_trainer(small_config(), None)
    loop, _ = trainer.train_iteration(trainer.init(jax.random.key(0)))
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save_full(1, loop, {})
    trainer.train_iteration(loop)
    assert loop.replay.episodes.observations.is_deleted()
    checkpoints.close()


def damage(folder: Path, how: str) -> None:
    files = sorted((file for file in folder.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)
    if how == "delete data":
        for file in folder.rglob("d/*"):
            file.unlink()
    elif how == "delete manifest":
        for file in (folder / "manifest").iterdir():
            file.unlink()
    elif how == "truncate all":
        for file in files:
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    else:
        contents = bytearray(files[-1].read_bytes())
        contents[len(contents) // 2] ^= 0xFF
        files[-1].write_bytes(bytes(contents))


@pytest.mark.parametrize("how", ["delete data", "delete manifest", "truncate all", "flip a byte"])
def test_a_damaged_checkpoint_is_skipped_with_one_line(states, saved, how, capfd):
    loops, shapes = states
    damage(saved / FULL / "3", how)
    damage(saved / LIGHT / "3", how)
    lines = []
    restored = Checkpoints(saved, lines.append).restore_for_resume(shapes)
    assert (restored.tier, restored.iteration) == (FULL, 2)
    assert all(map(np.array_equal, as_plain(restored.loop), as_plain(loops[1])))
    assert len(lines) == 2 and "full/3 is damaged" in lines[0] and "light/3 is damaged" in lines[1]
    assert not any("\n" in line for line in lines)
    assert "Traceback" not in capfd.readouterr().err


def test_complaints_about_a_damaged_checkpoint_that_come_late_are_not_shown(states, saved, monkeypatch):
    """Threads that read a checkpoint may fail after reading was given up and the checkpoints were closed."""
    shown = []
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: shown.append(str(unraisable.exc_value)))

    class Late:
        def __del__(self):
            raise RuntimeError("late")

    damage(saved / FULL / "3", "delete data")
    checkpoints = Checkpoints(saved, lambda _: None)
    checkpoints.restore_for_resume(states[1])
    checkpoints.close()
    thread = threading.Thread(target=Late)
    thread.start()
    thread.join()
    assert "late" not in shown
    Late()
    assert "late" in shown  # what fails in the main thread is ours


def test_reads_that_orbax_abandons_are_not_reported(states, saved, caplog):
    """Of several reads that fail, orbax raises one error; the event loop reports the others whenever they are deleted."""
    damage(saved / FULL / "3", "delete data")
    checkpoints = Checkpoints(saved, lambda _: None)
    checkpoints.restore_for_resume(states[1])
    checkpoints.close()
    event_loop = asyncio.new_event_loop()
    for error in ('Error opening "zarr" driver', "an error of the caller's own"):
        event_loop.create_future().set_exception(ValueError(error))
    event_loop.close()
    assert "zarr" not in caplog.text and "of the caller's own" in caplog.text


def test_only_light_left(states, saved):
    for iteration in "23":
        damage(saved / FULL / iteration, "delete data")
    lines = []
    restored = Checkpoints(saved, lines.append).restore_for_resume(states[1])
    assert (restored.tier, restored.iteration, restored.loop, len(lines)) == (LIGHT, 3, None, 1)


def test_the_newest_checkpoint_counts_whatever_its_tier(states, saved):
    shutil.rmtree(saved / FULL / "3")
    restored = Checkpoints(saved).restore_for_resume(states[1])
    assert (restored.tier, restored.iteration) == (LIGHT, 3)
    assert all(map(np.array_equal, as_plain(restored.train), as_plain(states[0][2].train)))


def test_a_full_checkpoint_retires_when_a_newer_light_one_is_there(saved):
    checkpoints = Checkpoints(saved)
    checkpoints.retire_full()
    assert checkpoints.iterations(FULL) == [3] and checkpoints.iterations(LIGHT) == [2, 3]


def test_later_checkpoints_are_set_aside_and_written_again(states, saved):
    checkpoints = Checkpoints(saved)
    moved = checkpoints.set_aside_after(2)
    assert sorted(path.name for path in moved) == ["full-3", "light-3"] and all((path / "manifest").exists() for path in moved)
    assert checkpoints.iterations(FULL) == checkpoints.iterations(LIGHT) == [2]
    checkpoints.save_full(2, states[0][0], {"again": True})  # the same iteration once more replaces it
    assert checkpoints.restore_for_resume(states[1]).progress == {"again": True}
    checkpoints.save_full(3, states[0][2], {})
    assert checkpoints.iterations(FULL) == [2, 3]
    checkpoints.close()


def test_another_structure_is_named(saved):
    other = FakeProgram(small_config(image_size=8))
    shapes = jax.eval_shape(other.init, jax.random.split(jax.random.key(0), 2))
    with pytest.raises(RequestError, match=r"normalizer\.mean is float32\[2, 1, 16, 16\] there and float32\[2, 1, 8, 8\] here"):
        Checkpoints(saved).restore_for_resume(shapes)


@pytest.mark.parametrize(("before", "after"), [("normalizer.mean", "normalizer.meao"), ('"schema": 2', '"schema": 3')])
def test_a_changed_byte_of_a_manifest_is_damage_and_not_another_version(states, saved, before, after):
    for tier in (FULL, LIGHT):
        file = saved / tier / "3" / FILE
        file.write_text(file.read_text().replace(before, after, 1))
    lines = []
    assert Checkpoints(saved, lines.append).restore_for_resume(states[1]).iteration == 2
    assert lines == [f"checkpoint {tier}/3 is damaged ({FILE} has changed); trying the one before" for tier in (FULL, LIGHT)]


def test_nothing_saved_yet(states, tmp_path):
    checkpoints = Checkpoints(tmp_path / "none", read_only=True)
    assert checkpoints.newest() is None and checkpoints.restore_train(states[1]) is None
    assert not (tmp_path / "none").exists()


def test_a_manifest_of_another_schema_is_refused(states, saved):
    (file,) = [path for path in (saved / FULL / "3" / "manifest").iterdir() if "progress" in path.read_text(errors="replace")]
    file.write_text(file.read_text().replace('"schema": 2', '"schema": 1'))
    write_sums(saved / FULL / "3")
    with pytest.raises(RequestError, match="is of schema 1, not 2: use the version that wrote it"):
        Checkpoints(saved).restore_for_resume(states[1])


def test_kill_while_saving_keeps_the_checkpoint_before(tmp_path, clean_environment):
    run_dir = tmp_path / "run"
    command = [sys.executable, str(FAKE), str(run_dir), "kill"]
    process = subprocess.Popen(command, env=clean_environment, stdout=subprocess.DEVNULL, start_new_session=True)
    full = run_dir / "checkpoints" / FULL
    try:
        deadline, caught = time.monotonic() + 60, False
        while time.monotonic() < deadline and not caught and process.poll() is None:
            names = os.listdir(full) if full.exists() else []
            done = [name for name in names if name.isdigit()]
            caught = bool(done) and any("tmp" in name for name in names)
            time.sleep(0.001)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert caught and process.returncode == -signal.SIGKILL
    newest = max(int(name) for name in done)
    shutil.rmtree(run_dir / "checkpoints" / RECENT, ignore_errors=True)  # which may be newer, and would be restored
    config = small_config(env_steps=10**7, replay_transitions=50_000, num_envs=1000, full_checkpoint_interval=1)
    lines = []
    trainer = make_fake_trainer(config, None)
    checkpoints = Checkpoints(run_dir / "checkpoints", lines.append)
    restored = checkpoints.restore_for_resume(trainer.shapes)
    checkpoints.close()
    assert restored.tier == FULL and restored.iteration >= newest and not lines
    assert int(restored.loop.iteration) == restored.iteration
    assert not [name for name in os.listdir(full) if "tmp" in name]  # and the half-written one is gone


def test_a_checkpoint_that_is_still_being_written_is_not_written_twice(tmp_path, monkeypatch):
    """A signal arrives right after saving of a light checkpoint has begun on a slow disk."""
    save, iterations, saved = Checkpoints._save, Checkpoints.iterations, []

    def complete(checkpoints, tier):
        return [number for number in iterations(checkpoints, tier) if (tier, number) not in checkpoints._unsummed]

    def interrupted(checkpoints, tier, iteration, items, progress):
        save(checkpoints, tier, iteration, items, progress)
        saved.append((tier, iteration))
        if len(saved) == 1:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Checkpoints, "iterations", complete)
    monkeypatch.setattr(Checkpoints, "_save", interrupted)
    with pytest.raises(Terminated):
        list(make_fake_trainer(small_config(full_checkpoint_interval=0), tmp_path / "run").run())
    assert saved[0][0] == LIGHT and saved.count(saved[0]) == 1


@pytest.mark.parametrize("tier", [LIGHT, FULL])
def test_a_kill_while_a_checkpoint_is_replaced_leaves_the_old_one(states, saved, tier, monkeypatch):
    loops, shapes = states

    class KilledError(BaseException):
        pass

    def killed(*_, **__):
        raise KilledError

    replacing = Checkpoints(saved)
    monkeypatch.setattr(ocp.CheckpointManager, "save", killed)
    with pytest.raises(KilledError):
        replacing._save(tier, 3, {}, {})
    monkeypatch.undo()
    shutil.rmtree(saved / (FULL if tier == LIGHT else LIGHT))
    resumed = Checkpoints(saved)
    restored = resumed.restore_for_resume(shapes)
    assert (restored.tier, restored.iteration, restored.progress) == (tier, 3, {"wall_s": 4.5})

    (resumed.save_light if tier == LIGHT else resumed.save_full)(
        3, loops[2].train if tier == LIGHT else loops[2], {"wall_s": 9.0}
    )
    resumed.close()
    assert Checkpoints(saved).restore_for_resume(shapes).progress == {"wall_s": 9.0}
    assert not (saved / REPLACED).exists()
