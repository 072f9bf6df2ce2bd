"""The training run: exact resumption, signals, bad input, memory, non-finite numbers."""

import dataclasses
import errno
import itertools
import json
import runpy
from pathlib import Path

import jax
import numpy as np
import pytest
import small_program
from fake_program import FakeProgram, as_plain, final_state, make_fake_trainer, rows_without_time, small_config

from jaxrl_vis.config import Config, preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.environment import make_env
from jaxrl_vis.run import loop as run_loop
from jaxrl_vis.run import trainer
from jaxrl_vis.run.compiled import memory
from jaxrl_vis.run.compiled.nonfinite import dump, nonfinite_simulation
from jaxrl_vis.run.storage import metrics
from jaxrl_vis.run.storage.checkpoint import Checkpoints
from jaxrl_vis.run.storage.folder import RunFolder, default_folder, read_config
from jaxrl_vis.run.trained import restored_run
from jaxrl_vis.run.trained.results import describe


def test_a_run_reports_logs_and_draws(straight, capsys):
    path, straight_trainer, reports = straight
    assert [report.iteration for report in reports] == list(range(1, 9))
    assert reports[-1].env_steps == 80 and reports[-1].updates == 24
    assert [i for i, report in enumerate(reports, 1) if "eval/success" in report.metrics] == [2, 4, 6, 8]
    rows = metrics.read_rows(path / "metrics.jsonl")
    assert [(row["iteration"], row["seed"]) for row in rows] == list(itertools.product((2, 4, 6, 8), (0, 1)))
    for row in rows:
        assert row["env_steps"] == 10 * row["iteration"] and row["updates"] == 3 * row["iteration"]
        assert 0 < row["eval/success"] < 1 and row["time/wall_s"] >= row["time/compile_s"] > 0
    means = np.mean([report.metrics["train/critic_loss"][1] for report in reports[2:4]])
    assert rows[3]["train/critic_loss"] == pytest.approx(means, rel=1e-6)
    assert (path / "curve.png").stat().st_size > 10_000 and (path / "video.gif").stat().st_size > 3_000
    record = json.loads((path / "config.json").read_text())
    assert record["schema"] == 2 and record["config"]["run"]["num_envs"] == 2 and record["versions"]["jax"] == jax.__version__
    assert {"git_revision", "preset", "device"} <= set(record)
    assert read_config(path) == small_config()


def test_train_iteration_is_traced_once(straight):
    assert straight[1].program.traces == 1


def test_a_replay_that_cannot_fit_is_refused_before_allocation(tmp_path, monkeypatch):
    there = memory.available_bytes()  # once: it changes with whatever else runs
    monkeypatch.setattr(memory, "available_bytes", lambda: there)
    config = small_config(replay_transitions=10**12, seeds=1)
    with pytest.raises(RequestError, match="GiB") as refused:
        list(make_fake_trainer(config, tmp_path / "run").run())
    assert not (tmp_path / "run").exists()
    text = str(refused.value)
    fitting = int(text.split("--replay-transitions ")[1].split()[0])
    assert 0 < fitting < 10**12 and fitting % 10 == 0 and "\n" not in text
    fits = make_fake_trainer(config.replace(replay_transitions=fitting), tmp_path / "other")
    line = memory.check_memory(fits.config, fits.shapes, fits.program.replay_bytes, 10)
    assert line.startswith("replay ") and " of " in line
    monkeypatch.setattr(memory, "available_bytes", lambda: 1000)
    with pytest.raises(RequestError, match="not even one rollout fits"):
        memory.check_memory(fits.config, fits.shapes, fits.program.replay_bytes, 10)


def test_an_evaluation_begins_early_only_where_there_is_room(straight, tmp_path, monkeypatch):
    """An early evaluation begins before the host has read the last iteration's results, and gives the same as a later one."""
    run_dir, made, _ = straight
    compiled = made.programs.compile()
    state, scratch = memory._sizes(compiled)
    largest, all_of_them = state + max(scratch.values()), state + sum(scratch.values())
    assert largest < all_of_them
    for there, fits in ((largest, False), (all_of_them - 1, False), (all_of_them, True)):
        monkeypatch.setattr(memory, "available_bytes", lambda there=there: there)
        assert memory.check_compiled(compiled, is_allocated=False) is fits
    monkeypatch.undo()
    monkeypatch.setattr(run_loop, "check_compiled", lambda *_: False)
    list(make_fake_trainer(read_config(run_dir), tmp_path / "later").run())
    assert rows_without_time(tmp_path / "later") == rows_without_time(run_dir)


def test_the_compilers_own_figures_count_on_a_cpu_too(straight, tmp_path, monkeypatch):
    """The evaluation's scratch memory, which depends on --eval-episodes, is checked before anything is allocated."""
    compiled = straight[1].programs.compile()
    memory.check_compiled(compiled, is_allocated=False)
    state = compiled["learn"].memory_analysis().argument_size_in_bytes
    monkeypatch.setattr(memory, "available_bytes", lambda: state + 100)
    with pytest.raises(RequestError, match="(evaluate|learn|play|nonfinite_leaves) needs .* --eval-episodes") as refused:
        memory.check_compiled(compiled, is_allocated=False)
    assert "\n" not in str(refused.value)
    monkeypatch.setattr(restored_run, "make_trainer", lambda config, **_: trainer.Trainer(config, FakeProgram(config)))
    monkeypatch.setattr(memory, "available_bytes", lambda: 100)
    with pytest.raises(RequestError, match="evaluate needs"):
        restored_run.evaluate_run(straight[0])


@pytest.mark.parametrize("break_state", [False, True])
def test_a_non_finite_number_stops_the_run(tmp_path, break_state, capsys):
    path = tmp_path / "run"
    with pytest.raises(trainer.NonFiniteError) as stopped:
        list(make_fake_trainer(small_config(), path, nan_at=4, break_state=break_state).run())
    text = str(stopped.value)
    assert "in iteration 5" in text and "train/critic_loss" in text and "iteration 4" in text and "\n" not in text
    (file,) = (path / "nonfinite").iterdir()
    assert str(file) in text
    dumped = np.load(file)
    assert "agent.critic.layer.kernel" in dumped["nonfinite_leaves"] and np.isnan(dumped["metrics.train/critic_loss"]).all()
    assert np.isnan(dumped["train.agent.critic.layer.bias"]).all() and dumped["key"].shape[0] == 2
    assert dumped["episodes.states"].shape[0] == (4 if break_state else 0)
    shapes = make_fake_trainer(small_config(), None).shapes
    restored = Checkpoints(path / "checkpoints", read_only=True).restore_for_resume(shapes)
    assert restored.iteration == 4 and all(np.isfinite(leaf).all() for leaf in as_plain(restored.train))


def test_numbers_that_the_simulation_made_are_distinguished_from_those_of_the_learner(tmp_path):
    with pytest.raises(trainer.NonFiniteError, match="not from the learner .achieved_state of environment 0"):
        list(make_fake_trainer(small_config(), tmp_path / "simulated", nan_at=4, break_state=True).run())
    with pytest.raises(trainer.NonFiniteError) as stopped:
        list(make_fake_trainer(small_config(), tmp_path / "learned", nan_at=4).run())
    assert "simulation" not in str(stopped.value)


def test_a_state_that_cannot_be_dumped_hides_no_non_finite_number(tmp_path, monkeypatch):
    def no_room(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", no_room)
    with pytest.raises(trainer.NonFiniteError, match="in iteration 5.*cannot be written to .* .No space left on device"):
        list(make_fake_trainer(small_config(), tmp_path / "run", nan_at=4).run())


@pytest.mark.parametrize(
    ("name", "place", "said"),
    [
        ("states", (1, 3, 0), "achieved_state of environment 1 is not finite from step 0 on"),
        ("states", (1, 3, 4), "achieved_state of environment 1 is not finite from step 4 on"),
        ("states", (0, 2, 6), "achieved_state of environment 0 is not finite in its goal"),
        ("observations", (0, 1, 5), "observation of environment 1 is not finite from step 5 on"),
        ("actions", (0, 1, 3), None),
    ],
)
def test_where_a_simulation_went_wrong(name, place, said):
    made = make_fake_trainer(small_config(), None)
    loop = made.init(made.run_keys)
    episodes = loop.replay.episodes
    episodes = episodes.replace(observations=episodes.states)
    broken = getattr(episodes, name).at[place].set(np.inf)
    after = episodes.states.at[place[0], place[1], 4:6].set(np.nan) if name == "actions" else episodes.states
    episodes = episodes.replace(**({"states": after} | {name: broken}))
    evidence = nonfinite_simulation(loop.replace(replay=loop.replay.replace(episodes=episodes)), 2)
    assert evidence == (said and f"{said}, and all actions before it are")


def test_bad_episodes_of_a_replay_that_devices_share_are_dumped(tmp_path):
    """Episodes of a shared replay are numbered by rollout and environment."""
    made = make_fake_trainer(small_config(), None)
    loop = made.init(made.run_keys)
    states, actions = loop.replay.episodes.states, loop.replay.episodes.actions
    fold_replay = [array.reshape(2, -1, 2, *array.shape[2:]) for array in (states.at[1, 3].set(np.nan), actions)]
    episodes = loop.replay.episodes.replace(states=fold_replay[0], actions=fold_replay[1])
    dump(tmp_path / "dump.npz", loop.replace(replay=loop.replay.replace(episodes=episodes)), {}, [])
    dumped = np.load(tmp_path / "dump.npz")
    assert dumped["episodes.seed_index"].tolist() == [1] and dumped["episodes.slot"].tolist() == [3]
    assert np.isnan(dumped["episodes.states"]).all()


def test_keys_of_the_wrong_kind_or_number_are_refused():
    two = make_fake_trainer(small_config(), None)
    with pytest.raises(RequestError, match=r"init takes one key, or one for each of 2 seeds, not \(3,\) of them"):
        two.init(jax.random.split(jax.random.key(0), 3))
    with pytest.raises(RequestError, match=r"evaluate takes a typed JAX key, such as jax.random.key\(0\), not 0"):
        two.evaluate(two.shapes, 0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(RequestError, match="evaluate takes one key for all seeds"):
        two.evaluate(two.shapes, two.run_keys)


def test_a_filter_that_takes_everything_is_reported(tmp_path, capsys):
    list(make_fake_trainer(small_config(), tmp_path / "run", filtered_share=0.95).run())
    assert capsys.readouterr().out.count("warning: more than 90%") == 1


def test_init_takes_one_key_or_one_per_seed():
    one = make_fake_trainer(small_config(seeds=1), None)
    assert all(map(np.array_equal, as_plain(one.init(jax.random.key(0))), as_plain(one.init(one.run_keys))))
    two = make_fake_trainer(small_config(), None)
    assert two.init(jax.random.key(3)).key.shape == (2,)
    # A seed learns the same beside another one as alone.
    alone, together = one.init(one.run_keys), two.init(two.run_keys)
    alone, alone_metrics = one.train_iteration(alone)
    together, metrics_of_both = two.train_iteration(together)
    assert float(alone_metrics["train/critic_loss"][0]) == pytest.approx(
        float(metrics_of_both["train/critic_loss"][0]), rel=1e-5
    )


def test_names_of_default_folders():
    assert default_folder(Config()) == Path("runs/VisualFetchReach-oracle-fast-seed0")
    assert default_folder(Config().replace(seeds=5)).name == "VisualFetchReach-oracle-fast-seeds0to4"
    assert default_folder(Config().replace(algorithm="contrastive")).name == "VisualFetchReach-contrastive-fast-seed0"
    assert default_folder(Config().replace(algorithm="td3")).name == "VisualFetchReach-td3-oracle-fast-seed0"
    own = Config().replace(algorithm="mine:Own", method="theirs:Reward")
    assert default_folder(own).name == "VisualFetchReach-mine-Own-theirs-Reward-fast-seed0"
    assert describe(Config().replace(algorithm="contrastive")) == "contrastive, preset fast, seed 0"


def test_metrics_file_survives_a_torn_line(tmp_path):
    path = tmp_path / "metrics.jsonl"
    rows = [{"seed": 0, "iteration": i, "updates": i, "env_steps": 10 * i, "x": float(i)} for i in range(4)]
    metrics.append_rows(path, rows)
    with path.open("a") as file:
        file.write('{"seed": 0, "iter')
    assert metrics.read_rows(path) == rows
    aside = tmp_path / "aside.jsonl"
    assert metrics.truncate(path, 1, None, aside, aside, keeps_later=False) is None and not aside.exists()
    assert path.read_text().count("\n") == 2 and metrics.read_rows(path) == rows[:2]
    assert metrics.make_rows([3], {"iteration": 1}, {"a": [float("nan")]}) == [{"seed": 3, "iteration": 1, "a": None}]


def test_evaluate_and_play_a_run(straight, tmp_path, monkeypatch):
    path, _, reports = straight

    def fake_make_trainer(config, *arguments, policy_alone, **options):
        assert not policy_alone
        return trainer.Trainer(config, FakeProgram(config), *arguments, **options)

    monkeypatch.setattr(restored_run, "make_trainer", fake_make_trainer)
    values = restored_run.evaluate_run(path, episodes=7)
    assert values["eval/success"] == pytest.approx(reports[-1].metrics["eval/success"], rel=1e-5)
    assert [type(value) for value in values["eval/success"]] == [float, float]
    for suffix in (".gif", ".png", ".html"):
        restored_run.play_run(path, tmp_path / f"out{suffix}", episodes=4)
        assert (tmp_path / f"out{suffix}").stat().st_size > 1000
    with pytest.raises(RequestError, match="must end in"):
        restored_run.play_run(path, tmp_path / "out.avi")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RequestError, match="no run in"):
        restored_run.evaluate_run(tmp_path / "empty")
    RunFolder(tmp_path / "new").open(small_config())
    with pytest.raises(RequestError, match="no usable checkpoint"):
        restored_run.evaluate_run(tmp_path / "new")


def test_the_real_program_resumes_bit_for_bit(tmp_path, capsys):
    """The same as above with physics, cameras and networks. Traced once: the three runs share the program."""
    config = preset("debug", env="VisualReacher", full_checkpoint_interval=2)
    env = make_env(config)

    def run(path, resume=False, **changes):
        asked = config.replace(**changes)
        mine = trainer.Trainer(asked, small_program.make_train_step(env, asked), path, resume=resume)
        return mine, list(mine.run())

    mine, reports = run(tmp_path / "straight")
    assert [report.iteration for report in reports] == [1, 2, 3, 4]
    run(tmp_path / "cut", env_steps=400)
    run(tmp_path / "cut", resume=True)
    assert rows_without_time(tmp_path / "cut") == rows_without_time(tmp_path / "straight")
    both = final_state(tmp_path / "cut", mine.shapes), final_state(tmp_path / "straight", mine.shapes)
    assert all(map(np.array_equal, *both)) and any(leaf.any() for leaf in both[0])
    assert (tmp_path / "cut" / "video.gif").stat().st_size > 10_000
    assert small_program.traces(config) == 1  # in this process, whatever other tests have trained with it
    line = memory.check_memory(config, mine.shapes, mine.program.replay_bytes, mine.program.steps_per_iteration)
    assert line.startswith("replay ")


def test_the_script_runs(tmp_path, checkout, capsys, monkeypatch):
    monkeypatch.setattr(trainer, "make_train_step", small_program.make_train_step)
    script = runpy.run_path(str(checkout / "notebooks" / "train.py"))
    assert len((checkout / "notebooks" / "train.py").read_text().splitlines()) < 40
    script["main"]("debug", "VisualReacher", str(tmp_path / "run"))
    assert "last evaluation" in capsys.readouterr().out
    figures = restored_run.evaluate_run(tmp_path / "run")
    assert len(figures["eval/success"]) == 1
    restored_run.play_run(tmp_path / "run", tmp_path / "strip.png", episodes=8)  # as many as an evaluation: compiled already
    assert (tmp_path / "strip.png").exists()


def test_a_report_cannot_be_changed(straight):
    with pytest.raises(dataclasses.FrozenInstanceError):
        straight[2][0].iteration = 3
    assert run_loop.Report is trainer.Report
