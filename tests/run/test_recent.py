"""Recent states, which resume a process that was killed: exact, written once, checked, and never an obstacle."""

import errno
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_program import as_plain, make_fake_trainer, rows_without_time, small_config

from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.storage import recent
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT, RECENT, Checkpoints
from jaxrl_vis.run.storage.recent import Recent, Unusable, is_cheap

E = 2  # episodes of an iteration of the fake program, whose replay holds three iterations
NO_OTHERS = {"full_checkpoint_interval": 0, "checkpoint_interval": 100}


@pytest.fixture(scope="module")
def states():
    """Loop states after 1 to 7 iterations of the fake program, by iteration, and the program's shapes."""
    trainer = make_fake_trainer(small_config(), None)
    loop, states_at = trainer.init(jax.random.key(7)), {}
    for iteration in range(1, 8):
        loop, _ = trainer.train_iteration(loop)
        states_at[iteration] = jax.tree.map(jnp.copy, loop)
    return states_at, trainer.shapes


@pytest.fixture
def store(states, tmp_path):
    """A folder in which states 1 to 7 were saved, one after the other."""
    keeper = Recent(tmp_path / RECENT, print)
    for iteration, loop in states[0].items():
        keeper.save(iteration, loop, E, {"wall_s": float(iteration)})
    return tmp_path / RECENT


def test_the_newest_two_come_back_bit_for_bit(states, store):
    loops, shapes = states
    again = Recent(store, print)
    assert again.iterations() == [6, 7]
    for iteration in (6, 7):
        loop, progress = again.restore(iteration, shapes)
        assert jax.tree.structure(loop) == jax.tree.structure(loops[iteration]) and progress == {"wall_s": float(iteration)}
        assert all(map(np.array_equal, as_plain(loop), as_plain(loops[iteration])))


def test_a_rollout_is_written_once_and_deleted_when_no_state_needs_it(states, tmp_path):
    keeper, times = Recent(tmp_path, print), {}
    for iteration, loop in states[0].items():
        keeper.save(iteration, loop, E, {})
        for file in tmp_path.glob("*.rollout"):
            assert times.setdefault(file.name, file.stat().st_mtime_ns) == file.stat().st_mtime_ns
    assert len(times) == 7
    assert sorted(int(file.stem) for file in tmp_path.glob("*.rollout")) == [4, 5, 6, 7]  # state 6 has rollouts 4 to 6


def test_states_may_be_further_apart_than_the_replay_is_long(states, tmp_path):
    keeper, (loops, shapes) = Recent(tmp_path, print), states
    for iteration in (1, 3, 7):
        keeper.save(iteration, loops[iteration], E, {})
    for iteration in (3, 7):
        assert all(map(np.array_equal, as_plain(keeper.restore(iteration, shapes)[0]), as_plain(loops[iteration])))


def test_a_state_survives_donation(tmp_path):
    trainer = make_fake_trainer(small_config(), None)
    loop, _ = trainer.train_iteration(trainer.init(jax.random.key(0)))
    expected, keeper = as_plain(loop), Recent(tmp_path, print)
    keeper.save(1, loop, E, {})
    trainer.train_iteration(loop)
    assert loop.replay.episodes.observations.is_deleted()  # nothing holds on to it
    restored, _ = keeper.restore(1, trainer.shapes)
    assert all(map(np.array_equal, as_plain(restored), expected))
    trainer.train_iteration(restored)
    assert restored.replay.episodes.observations.is_deleted()


def flip(file, place: int) -> None:
    contents = bytearray(file.read_bytes())
    contents[place] ^= 0x10
    file.write_bytes(bytes(contents))


@pytest.mark.parametrize("name", ["7.state", "7.rollout", "5.rollout"])
@pytest.mark.parametrize("how", ["flip", "cut", "delete", "empty"])
def test_damage_anywhere_is_noticed(states, store, name, how):
    size = (store / name).stat().st_size
    for place in np.linspace(0, size - 1, 23).astype(int) if how == "flip" else [0]:
        shutil.copytree(store, store.with_name("copy"))
        file = store.with_name("copy") / name
        if how == "flip":
            flip(file, place)
        elif how == "cut":
            file.write_bytes(file.read_bytes()[: size * 2 // 3])
        elif how == "empty":
            file.write_bytes(b"")
        else:
            file.unlink()
        with pytest.raises(Unusable) as refused:
            Recent(store.with_name("copy"), print).restore(7, states[1])
        assert "\n" not in str(refused.value)
        shutil.rmtree(store.with_name("copy"))


def test_another_structure_is_refused(store):
    with pytest.raises(RequestError, match="has another structure"):
        Recent(store, print).restore(7, make_fake_trainer(small_config(image_size=8), None).shapes)


def test_another_runs_states_are_not_there(states, tmp_path):
    theirs, ours = Recent(tmp_path / RECENT, print), Recent(tmp_path / RECENT, print)
    theirs.run_id, ours.run_id = "theirs", "ours"
    theirs.save(5, states[0][5], E, {})
    assert theirs.iterations() == [5] and ours.iterations() == []
    aside = tmp_path / "foreign" / RECENT
    assert not theirs.set_aside_foreign_runs(aside) and ours.set_aside_foreign_runs(aside)
    ours.save(1, states[0][1], E, {})
    assert ours.iterations() == [1] and theirs.iterations() == []
    store = Recent(tmp_path / "foreign" / RECENT, print)
    assert all(map(np.array_equal, as_plain(store.restore(5, states[1])[0]), as_plain(states[0][5])))


def test_no_room_is_said_once_and_ends_nothing(states, tmp_path, monkeypatch):
    lines: list[str] = []
    keeper = Recent(tmp_path / RECENT, lines.append)
    keeper.save(1, states[0][1], E, {})

    def full_disk(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(recent, "_bytes", full_disk)
    keeper.save(2, states[0][2], E, {})
    assert len(lines) == 1 and "No space left on device" in lines[0] and not keeper.is_due(ignore_time=True)
    # What there is stays until a checkpoint is as new: the run may never find room for one.
    assert keeper.iterations() == [1] and not list((tmp_path / RECENT).glob("*.tmp"))
    monkeypatch.undo()
    assert all(map(np.array_equal, as_plain(keeper.restore(1, states[1])[0]), as_plain(states[0][1])))
    keeper.retire(0)
    assert keeper.iterations() == [1]
    keeper.retire(1)
    assert not (tmp_path / RECENT).exists()


def abandon_run(config, path, iteration: int, **options) -> None:
    for report in make_fake_trainer(config, path, resume=path.exists(), **options).run():
        if report.iteration == iteration:
            return


@pytest.fixture
def always(monkeypatch):
    """Keep a state after every iteration."""
    monkeypatch.setattr(recent, "_FRACTION", np.inf)


@pytest.mark.parametrize("after", [1, 3, 4, 7])
def test_a_run_that_is_killed_goes_on_exactly(straight, tmp_path, always, capsys, after):
    path, config = tmp_path / "run", small_config(**NO_OTHERS)
    abandon_run(config, path, after)
    assert Checkpoints(path / "checkpoints").iterations(RECENT)[-1] in (after, after + 1)
    list(make_fake_trainer(config, path, resume=True).run())
    out = capsys.readouterr().out
    assert "of 8, exactly" in out and "replay lost 0 times" in out
    assert rows_without_time(path) == rows_without_time(straight[0])
    assert not (path / "checkpoints" / RECENT).exists()


def test_a_run_that_is_killed_again_and_again_goes_on_exactly(straight, tmp_path, always):
    path, config = tmp_path / "run", small_config(**NO_OTHERS)
    for after in (2, 4, 5, 7):
        abandon_run(config, path, after)
    list(make_fake_trainer(config, path, resume=True).run())
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_killed_in_an_evaluation_it_is_evaluated_again(straight, tmp_path, always, monkeypatch, capsys):
    path, config = tmp_path / "run", small_config(**NO_OTHERS)
    trainer = make_fake_trainer(config, path)

    def killed(*_):
        raise KeyboardInterrupt  # a plain one, as if there were no handler: nothing is saved on the way out

    monkeypatch.setattr("jaxrl_vis.run.loop.metrics.append_rows", killed)
    with pytest.raises(KeyboardInterrupt):
        list(trainer.run())
    monkeypatch.undo()
    list(make_fake_trainer(config, path, resume=True).run())
    assert "resumed at iteration 2 of 8, exactly" in capsys.readouterr().out
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_a_damaged_one_is_kept_and_the_one_before_is_used(straight, tmp_path, always, capsys):
    path, config = tmp_path / "run", small_config(**NO_OTHERS)
    abandon_run(config, path, 5)
    newest = Checkpoints(path / "checkpoints").iterations(RECENT)[-1]
    flip(path / "checkpoints" / RECENT / f"{newest}.state", -1)
    list(make_fake_trainer(config, path, resume=True).run())
    out = capsys.readouterr().out
    assert f"recent/{newest} is damaged" in out and f"resumed at iteration {newest - 1} of 8, exactly" in out
    assert (path / "checkpoints" / "damaged" / f"recent-{newest}").exists()
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_a_light_checkpoint_is_never_newer(tmp_path, monkeypatch):
    monkeypatch.setattr(recent, "_FRACTION", 1e-9)  # next to never by the clock
    path, config = tmp_path / "run", small_config(full_checkpoint_interval=0)
    abandon_run(config, path, 5)
    checkpoints = Checkpoints(path / "checkpoints")
    assert checkpoints.iterations(RECENT)[-1] == checkpoints.iterations(LIGHT)[-1] == 4


def test_a_full_checkpoint_takes_its_place(straight, tmp_path, always):
    path, config = tmp_path / "run", small_config(**NO_OTHERS)
    abandon_run(config, path, 3)
    list(make_fake_trainer(config.replace(full_checkpoint_interval=3), path, resume=True).run())
    assert Checkpoints(path / "checkpoints").iterations(FULL) == [6, 8] and not (path / "checkpoints" / RECENT).exists()
    assert rows_without_time(path) == rows_without_time(straight[0])


def test_a_large_replay_is_left_to_full_checkpoints(states):
    small = states[1].replay
    episodes = small.episodes.replace(observations=jax.ShapeDtypeStruct((1, 20_000, 52, 4, 64, 16), jnp.uint32))
    assert is_cheap(small) and not is_cheap(small.replace(episodes=episodes))
