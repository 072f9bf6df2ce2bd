"""`jaxrl-vis push` and `dataset`: what they publish from a run folder, and loading it again."""

import json
import sys
import types
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import yaml
from test_policy import SETTINGS, register

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.recordings import convert
from jaxrl_vis.run.pushed.card import score
from jaxrl_vis.run.pushed.push import check_target, push
from jaxrl_vis.run.trained.record import record_run
from jaxrl_vis.run.trained.restored_run import evaluate_run


@pytest.fixture(autouse=True)
def told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A state task that compiles quickly."""
    register(monkeypatch)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trained run of two seeds."""
    folder = tmp_path_factory.mktemp("pushed") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        register(monkeypatch)
        config = jaxrl_vis.preset("debug", env="Told", seed=3, seeds=2, **SETTINGS)
        assert len(list(jaxrl_vis.make_trainer(config, folder).run())) == 3
    return folder


@pytest.fixture(scope="module")
def pushed(run: Path) -> Path:
    """Folder to which the policy of the second seed was pushed."""
    folder = run.parent / "policy"
    with pytest.MonkeyPatch.context() as monkeypatch:
        register(monkeypatch)
        assert push(run, str(folder), seed=4) == str(folder)
    return folder


def test_a_pushed_policy_acts_as_the_runs(run: Path, pushed: Path) -> None:
    policies = [jaxrl_vis.load_policy(run, seed=4), jaxrl_vis.load_policy(pushed)]
    assert policies[1].seed == 4 and policies[1].iteration == policies[0].iteration == 3
    for ours, theirs in zip(*(jax.tree.leaves(policy.parameters) for policy in policies), strict=True):
        np.testing.assert_array_equal(ours, theirs)
        assert ours.dtype == theirs.dtype
    seen = np.linspace(-1, 1, policies[0].observation_spec.shape[0], dtype=np.float32)
    np.testing.assert_array_equal(*(policy(seen, -seen) for policy in policies))
    assert not np.array_equal(policies[1](seen, -seen), jaxrl_vis.load_policy(run, seed=3)(seen, -seen))
    with pytest.raises(RequestError, match="the policy of seed 4 after iteration 3 alone"):
        jaxrl_vis.load_policy(pushed, seed=3)


def test_the_card_says_what_the_run_has_measured(run: Path, pushed: Path) -> None:
    text = (pushed / "README.md").read_text()
    _, front, body = text.split("---\n", 2)
    data = yaml.safe_load(front)
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    last = {row["seed"]: row for row in rows if row["iteration"] == 3}
    (result,) = data["model-index"][0]["results"]
    assert result["metrics"][0]["value"] == pytest.approx(last[4]["eval/success"], abs=1e-4)
    assert result["dataset"]["name"] == "Told" and data["library_name"] == "jaxrl-vis"
    assert "| 4 (these weights) | 24 |" in body and "| 3 | 24 |" in body
    command = next(line for line in body.splitlines() if line.startswith("jaxrl-vis train"))
    assert command.startswith("jaxrl-vis train Told --preset debug") and "--seeds 2" in command
    assert "curve.png" in body and (pushed / "curve.png").read_bytes() == (run / "curve.png").read_bytes()
    assert "video.gif" not in body, "a state task has no video"
    assert json.loads((pushed / "config.json").read_text())["config"]["environment"]["env_folder"] is None


def test_intervals_are_wide_where_episodes_are_few() -> None:
    row = {"eval/success": 0.75, "eval/goal_distance": 0.1, "env_steps": 10}
    few, many = score(row, 8), score(row, 800)
    assert few.low == pytest.approx(0.4093, abs=1e-4) and few.high == pytest.approx(0.9285, abs=1e-4)
    assert few.low < many.low < 0.75 < many.high < few.high


def test_a_hub_gets_the_folder_that_a_folder_gets(run: Path, pushed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[str, dict[str, Any]]] = []

    class HfApi:
        def create_repo(self, repository: str, **options: Any) -> None:
            calls.append((repository, options))

        def upload_folder(self, folder_path: str, **options: Any) -> None:
            files = {path.name: path.read_bytes() for path in Path(folder_path).iterdir()}
            calls.append((options["repo_id"], files))

    monkeypatch.setitem(sys.modules, "huggingface_hub", types.SimpleNamespace(HfApi=HfApi))  # type: ignore[arg-type]
    assert push(run, "hub:somebody/arm", seed=4) == "hub:somebody/arm"
    assert [name for name, _ in calls] == ["somebody/arm"] * 2
    assert calls[1][1] == {path.name: path.read_bytes() for path in pushed.iterdir()}

    def refuse(*_: Any, **__: Any) -> None:
        raise OSError("401\nno token")

    monkeypatch.setattr(HfApi, "create_repo", refuse)
    with pytest.raises(RequestError, match=r"the hub has not taken somebody/arm \(OSError: 401 no token\): `hf auth login`"):
        push(run, "hub:somebody/arm")


def test_targets_are_checked_before_the_work(pushed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for to, message in ((str(pushed), "not empty"), ("hub:arm", "named hub:user/name"), ("hub:a/b/c", "named hub:user/name")):
        with pytest.raises(RequestError, match=message):
            check_target(to)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(RequestError, match="huggingface_hub: .*hub"):
        check_target("hub:somebody/arm")
    assert not list(tmp_path.iterdir())


def test_commands_that_need_the_whole_run_say_so(pushed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["verify", str(pushed)], ["play", str(pushed), "--aux"]):
        assert cli.main(words) == 2
        assert "holds a policy alone, and" in capsys.readouterr().err


def test_a_pushed_policy_is_evaluated_and_recorded_as_the_run_is(run: Path, pushed: Path) -> None:
    of_run, of_policy = evaluate_run(run), evaluate_run(pushed)
    assert {name: values[1:] for name, values in of_run.items()} == of_policy
    assert all(len(values) == 2 for values in of_run.values())
    with pytest.raises(RequestError, match="the policy of seed 4 after iteration 3 alone"):
        evaluate_run(pushed, checkpoint=2)
    recorded = record_run(pushed, episodes=3, seed=7)
    assert recorded.about["run_seed"] == 4
    np.testing.assert_array_equal(recorded.goals, record_run(run, episodes=3, seed=7).goals)


def test_weights_of_another_network_are_refused(pushed: Path, tmp_path: Path) -> None:
    for file in ("policy.safetensors", "config.json"):
        (tmp_path / file).write_bytes((pushed / file).read_bytes())
    record = json.loads((tmp_path / "config.json").read_text())
    record["config"]["network"]["hidden_sizes"] = [16]
    (tmp_path / "config.json").write_text(json.dumps(record))
    with pytest.raises(RequestError, match="holds weights of another network"):
        jaxrl_vis.load_policy(tmp_path)


def test_recorded_episodes_are_those_of_the_policy(run: Path) -> None:
    recorded = record_run(run, episodes=5, seed=7)
    assert (recorded.count, recorded.about["task"], recorded.about["run_seed"]) == (5, "Told", 3)
    policy = jaxrl_vis.load_policy(run, seed=3)
    assert recorded.goals is not None and recorded.states is not None and recorded.goal_states is not None
    goals = np.repeat(recorded.goals[:, None], recorded.horizon, axis=1)
    acted = jax.vmap(jax.vmap(policy))(recorded.observations[:, :-1], goals)
    np.testing.assert_allclose(recorded.actions, acted, atol=1e-5)
    distance = np.linalg.norm(recorded.states[:, -1] - recorded.goal_states, axis=-1)
    np.testing.assert_array_equal(recorded.success, distance <= recorded.about["threshold"])
    again, other = record_run(run, episodes=3, seed=7), record_run(run, episodes=3, seed=8)
    np.testing.assert_array_equal(again.actions, recorded.actions[:3])
    assert not np.array_equal(other.goals, again.goals)


def test_the_command_writes_and_converts(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyarrow")
    pytest.importorskip("av")
    file, dataset, back = tmp_path / "played.npz", tmp_path / "dataset", tmp_path / "back.npz"
    assert cli.main(["dataset", str(run), "--format", "npz", "--out", str(file), "--episodes", "4"]) == 0
    assert capsys.readouterr().out.startswith(f"{file}: 4 episodes of 4 steps, ")
    assert cli.main(["dataset", str(file), "--out", str(dataset)]) == 0
    assert cli.main(["dataset", str(dataset), "--format", "npz", "--out", str(back), "--episodes", "3"]) == 0
    first, last = convert.read(file), convert.read(back)
    np.testing.assert_array_equal(first.observations[:3], last.observations)
    np.testing.assert_array_equal(first.actions[:3], last.actions)
    capsys.readouterr()
    before = file.read_bytes()
    for words, message in (
        (["--out", str(dataset)], "not empty"),
        (["--format", "npz", "--out", str(file)], "played.npz is there already: name a new file"),
    ):
        assert cli.main(["dataset", str(file), *words]) == 2
        assert message in capsys.readouterr().err
    assert file.read_bytes() == before
    assert cli.main(["dataset", str(tmp_path), "--out", str(tmp_path / "new")]) == 2
    assert "is not a run folder" in capsys.readouterr().err
