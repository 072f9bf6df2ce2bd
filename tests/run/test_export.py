"""`jaxrl-vis export`: exported policies act as those of the runs, or an error reports that they do not."""

import dataclasses
import importlib
import json
import re
import shutil
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_policy import Seen, register

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.config import preset
from jaxrl_vis.errors import RequestError
from jaxrl_vis.learner.networks.networks import Networks
from jaxrl_vis.learner.networks.policy import make_policy
from jaxrl_vis.run.exported import golden, onnx_file, stablehlo
from jaxrl_vis.run.exported.contract import FORMATS, TOLERANCE, read_contract
from jaxrl_vis.run.exported.export import check_file, export_run
from jaxrl_vis.run.exported.layers import collect, forward, layers_of
from jaxrl_vis.types import NormalizerState, Statistics

FORMATS_HERE = [kind for kind in FORMATS if kind != "onnx" or importlib.util.find_spec("onnxruntime")]


@pytest.fixture(autouse=True)
def told(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture(scope="module")
def exported(runs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Path]:
    """Folder of each run's exported policy in each format."""
    folder = tmp_path_factory.mktemp("files")
    with pytest.MonkeyPatch.context() as monkeypatch:
        register(monkeypatch)
        for name, run in runs.items():
            for kind in FORMATS_HERE:
                assert export_run(run, kind, folder / name / kind).passed
    return {(name, kind): folder / name / kind for name in runs for kind in FORMATS_HERE}


@pytest.fixture
def copied(exported: dict[tuple[str, str], Path], tmp_path: Path) -> Any:
    """Function that copies an exported policy, to be corrupted."""

    def copy(kind: str, name: str = "VisualTold") -> Path:
        return Path(shutil.copytree(exported[name, kind], tmp_path / name / kind))

    return copy


def frames(folder: Path) -> golden.Golden:
    return golden.read(folder / golden.FILE, read_contract(folder).forms)


@pytest.mark.parametrize("kind", FORMATS_HERE)
@pytest.mark.parametrize("name", ["VisualTold", "Told"])
def test_golden_frames_are_the_task_s_and_their_actions_ours(name: str, kind: str, exported: dict, runs: dict) -> None:
    folder, policy = exported[name, kind], jaxrl_vis.load_policy(runs[name])
    recorded = frames(folder)
    assert recorded.observation.shape == (32, *policy.observation_spec.shape)
    assert recorded.observation.dtype == policy.observation_spec.dtype
    assert np.ptp(recorded.action) > 1e-4 and len(np.unique(recorded.goal, axis=0)) == 8
    np.testing.assert_allclose(recorded.action, jax.vmap(policy)(recorded.observation, recorded.goal), atol=1e-6)
    first = jax.vmap(Seen().see)(jnp.zeros((1, 1))) if name == "VisualTold" else np.zeros((1, 1))
    np.testing.assert_array_equal(recorded.observation[:1], first)  # every episode of this task starts at 0
    result = check_file(folder)
    assert result.passed and result.difference < 1e-5 and result.count == 32 and result.file.name == FORMATS[kind]


def test_the_contract_says_how_to_call_it(exported: dict, runs: dict) -> None:
    contract = json.loads((exported["VisualTold", "stablehlo"] / "contract.json").read_text())
    assert [(part["name"], part["shape"], part["dtype"], part["range"]) for part in contract["inputs"]] == [
        (name, ["batch", 2, 4, 6], "uint8", [0, 255]) for name in ("observation", "goal")
    ]
    (action,) = contract["outputs"]
    assert (action["name"], action["shape"], action["range"]) == ("action", ["batch", 1], [-1, 1])
    record = json.loads((runs["VisualTold"] / "config.json").read_text())
    assert contract["run"]["id"] == record["run_id"] and contract["run"]["revision"] == record["git_revision"]
    assert (contract["run"]["seed"], contract["run"]["iteration"], contract["control_period_s"]) == (3, 3, 1.0)
    (low, high), (other_low, _) = (
        part["range"] for part in json.loads((exported["Told", "stablehlo"] / "contract.json").read_text())["inputs"]
    )
    assert low[0] < 0 < high[0] and low == other_low  # goals share the statistics


def test_a_camera_task_describes_its_image(monkeypatch: pytest.MonkeyPatch, runs: dict) -> None:
    from jaxrl_vis.learner.environment import make_env
    from jaxrl_vis.run.exported.contract import make_contract
    from jaxrl_vis.run.trained.policy import Policy

    config = preset("debug", env="VisualReacher", pixels="rgbd")
    env = make_env(config)
    policy = Policy(env, config, 0, 7, None, None)  # type: ignore[arg-type]
    contract = make_contract(policy, runs["VisualTold"], "onnx", {})
    image = contract["image"]
    assert image["channels"] == ["red", "green", "blue", "depth"] and image["depth"]["range_m"] == [0.8, 1.1]
    np.testing.assert_allclose(image["camera"]["intrinsics"], env.scene.intrinsics(), rtol=1e-6)
    assert (image["camera"]["width"], image["camera"]["name"]) == (16, "above")
    assert "velocities" in contract["outputs"][0]["meaning"] and contract["task"]["settings"]["control"] == "velocity"
    json.dumps(contract, allow_nan=False)


# -- Parity of the networks


def made(name: str, **changes: Any) -> tuple[Any, ...]:
    """Return the weights of a preset's policy with random values, the shape and dtype of its observations, a batch of
    observations and goals, and the actions expected for them.
    """
    config = preset(name, compute_dtype="float32", **changes)
    channels = {"rgbd": 4, "rgb": 3, "depth": 1}[config.environment.pixels]
    size = config.environment.image_size
    is_visual = config.environment.env.startswith("Visual")
    shape, dtype = ((channels, size, size), np.uint8) if is_visual else ((7,), np.float32)
    networks = Networks(config, jax.ShapeDtypeStruct(shape, dtype), 3, 0.0)
    random = np.random.default_rng(0)

    def statistics() -> NormalizerState:
        mean, deviation = random.uniform(0, 255, shape), random.uniform(0, 80, shape)
        return NormalizerState(jnp.float32(10), jnp.asarray(mean, jnp.float32), jnp.asarray(10 * deviation**2, jnp.float32))

    actor, critic = (jax.eval_shape(init, jax.random.key(0)) for init in (networks.init_actor, networks.init_critic))

    def drawn(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        return jnp.asarray(random.normal(size=leaf.shape) / np.sqrt(leaf.shape[0]), jnp.float32)

    actor = jax.tree.map(drawn, networks.with_encoder(actor, critic))
    own_goals = statistics() if config.study.normalizers == "separate" else None
    policy = make_policy(networks)
    params = policy.params(actor, Statistics(statistics(), own_goals))
    inputs = [random.uniform(0, 256, (5, *shape)).astype(dtype) for _ in range(2)]
    expected = np.asarray(policy.act(params, inputs[0], policy.encode_goal(params, inputs[1])))
    assert np.ptp(expected) > 1e-2
    return collect(networks, params), shape, dtype, inputs, expected


VARIANTS = [
    *((name, {"env": "VisualFetchReach"}) for name in ("paper", "fast", "cpu", "debug")),
    ("fast", {"env": "VisualHandReach", "pixels": "rgb"}),  # a shared encoder
    ("cpu", {"env": "VisualReacher", "algorithm": "td3", "image_size": 37}),  # borders that no window covers
    ("debug", {"env": "FetchReach", "algorithm": "contrastive", "normalizers": "separate"}),
]


@pytest.mark.parametrize(("name", "changes"), VARIANTS, ids=str)
def test_layers_of_every_preset_act_as_the_networks(name: str, changes: dict[str, Any], tmp_path: Path) -> None:
    layers, shape, dtype, inputs, expected = made(name, **changes)
    np.testing.assert_allclose(forward(layers, *inputs), expected, atol=TOLERANCE / 10)
    if "onnx" not in FORMATS_HERE:
        pytest.skip("needs the extra export")
    (tmp_path / "policy.onnx").write_bytes(onnx_file.to_bytes(layers, shape, np.dtype(dtype)))
    model = onnx_file.Model(tmp_path / "policy.onnx")
    assert model.inputs["goal"] == (("batch", *shape), np.dtype(dtype).name)
    np.testing.assert_allclose(model(*inputs), expected, atol=TOLERANCE / 10)


def test_a_policy_of_one_s_own_leaves_as_stablehlo(runs: dict, tmp_path: Path) -> None:
    policy = jaxrl_vis.load_policy(runs["Told"])
    own = dataclasses.replace(policy, algorithm=policy.algorithm._replace(networks=None))
    with pytest.raises(RequestError, match="has a policy of its own, .*--format stablehlo"):
        layers_of(own)
    (tmp_path / "policy.stablehlo").write_bytes(stablehlo.to_bytes(own))
    zero = np.zeros((1, 1), np.float32)
    np.testing.assert_allclose(
        stablehlo.Program(tmp_path / "policy.stablehlo")(zero, zero)[0], policy(zero[0], zero[0]), atol=1e-6
    )


def test_stacked_images_are_put_together_as_the_task_does() -> None:
    """There are 8 episodes of 3 steps with images of 2 channels; pixels count the steps, goals are 100."""
    images = np.broadcast_to(np.arange(4)[None, None, :, None, None, None], (1, 8, 4, 2, 3, 3)).astype(np.uint8)
    recorded = {"frames": images, "goals": np.full((1, 8, 2, 3, 3), 100, np.uint8)}
    programs = types.SimpleNamespace(evaluate=lambda train: ({}, recorded))
    trainer = types.SimpleNamespace(programs=programs, seeds=range(1))

    class Policy:
        seed, env = 0, types.SimpleNamespace(frame_stack=3)

        def __call__(self, observation: jax.Array, goal: jax.Array) -> jax.Array:
            return jnp.mean(observation[None, :1] + goal[:1], axis=(1, 2, 3))

    frames = golden.record(trainer, None, Policy())  # type: ignore[arg-type]
    assert frames.observation.shape == (32, 6, 3, 3) and (frames.goal == 100).all()
    newest = frames.observation[:, 0, 0, 0]
    assert set(newest) == {0, 1, 2, 3}
    for age in range(3):
        np.testing.assert_array_equal(frames.observation[:, 2 * age, 0, 0], np.maximum(newest.astype(int) - age, 0))


# -- Elsewhere


def run_block(page: Path, file: str, folder: Path, missing: tuple[str, ...]) -> str:
    """Return the output of a script of the page, in a process that cannot import some packages."""
    (block,) = [text for text in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL) if f"# file: {file}\n" in text]
    script = folder.parent / file
    script.write_text(block)
    code = f"""
import runpy, sys
sys.modules.update(dict.fromkeys({missing!r}))
sys.argv = [{str(script)!r}, {str(folder)!r}]
runpy.run_path({str(script)!r}, run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder.parent)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif("onnx" not in FORMATS_HERE, reason="needs the extra export")
def test_the_page_s_script_runs_without_jax(copied: Any, checkout: Path) -> None:
    folder, page = copied("onnx"), checkout / "docs" / "export.md"
    printed = run_block(page, "run_policy.py", folder, ("jax", "jaxlib", "jaxrl_vis", "jaxrl_vis_envs", "onnx", "flax"))
    assert "VisualTold: an action every 1.0 s" in printed and re.search(r"largest difference \d\.\de-0[5-9]|0.0e", printed)
    assert len((folder.parent / "run_policy.py").read_text().splitlines()) <= 60


def test_stablehlo_runs_without_this_project(copied: Any, checkout: Path) -> None:
    page = checkout / "docs" / "export.md"
    printed = run_block(page, "run_stablehlo.py", copied("stablehlo"), ("jaxrl_vis", "jaxrl_vis_envs", "flax", "mujoco"))
    assert float(printed) < 1e-5


# -- What does not fit


@pytest.mark.parametrize("kind", FORMATS_HERE)
def test_another_policy_does_not_pass(
    kind: str, copied: Any, runs: dict, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copied(kind)
    export_run(runs["VisualTold"], kind, tmp_path / "other", seed=4)
    shutil.copy(tmp_path / "other" / FORMATS[kind], folder)
    assert not check_file(folder).passed
    assert cli.main(["export", "--check", str(folder / FORMATS[kind])]) == 1
    assert re.search(r"difference \S+ over 32 golden frames, which is too much", capsys.readouterr().out)
    assert cli.main(["export", "--check", str(tmp_path / "other")]) == 0


@pytest.mark.parametrize("kind", FORMATS_HERE)
def test_a_damaged_file_is_reported_in_one_line(kind: str, copied: Any) -> None:
    folder = copied(kind)
    file = folder / FORMATS[kind]
    whole = file.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], bytes(reversed(whole))):
        file.write_bytes(damaged)
        with pytest.raises(RequestError, match="export") as caught:
            check_file(folder)
        assert "\n" not in str(caught.value) and str(file) in str(caught.value)
    file.unlink()
    with pytest.raises(RequestError, match=f"{file.name} is missing"):
        check_file(folder)


@pytest.mark.parametrize("kind", FORMATS_HERE)
def test_a_contract_or_frames_that_do_not_fit_are_reported(kind: str, copied: Any, exported: dict) -> None:
    folder = copied(kind)
    shutil.copy(exported["Told", kind] / "contract.json", folder)
    with pytest.raises(RequestError, match="golden.npz has no 32 frames|golden.npz: observation is"):
        check_file(folder)
    shutil.copy(exported["Told", kind] / golden.FILE, folder)
    with pytest.raises(RequestError, match="does not fit its contract, observation is|cannot be run on its golden frames"):
        check_file(folder)
    (folder / golden.FILE).write_bytes((folder / golden.FILE).read_bytes()[:-40])
    with pytest.raises(RequestError, match="golden.npz is damaged"):
        check_file(folder)
    for text, words in (
        ("{", "is not JSON"),
        ("{}", "is not a contract"),
        ('{"schema": 9}', "is of schema 9, not 1"),
        ((exported["Told", kind] / "contract.json").read_text().replace('"batch"', "-1"), "is not a contract"),
    ):
        (folder / "contract.json").write_text(text)
        with pytest.raises(RequestError, match=words):
            check_file(folder)
    (folder / "contract.json").unlink()
    with pytest.raises(RequestError, match="has no contract.json beside it"):
        check_file(folder / FORMATS[kind])


def test_only_an_exported_policy_is_overwritten(copied: Any, runs: dict, tmp_path: Path) -> None:
    folder = copied("stablehlo")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(RequestError, match="holds an exported policy: --overwrite"):
        export_run(runs["VisualTold"], "safetensors", folder)
    assert export_run(runs["VisualTold"], "safetensors", folder, overwrite=True).passed
    assert {path.name for path in folder.iterdir()} == {"notes.txt", "contract.json", "golden.npz", "policy.safetensors"}
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    for out, words in ((tmp_path / "other", "holds other files"), (folder / "notes.txt", "is a file: name a folder")):
        with pytest.raises(RequestError, match=words):
            export_run(runs["VisualTold"], "stablehlo", out, overwrite=True)


def test_a_wrong_request_is_reported_in_one_line(
    runs: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(runs["Told"])
    (tmp_path / "empty").mkdir()
    shutil.copy(runs["Told"] / "config.json", tmp_path / "empty")
    for name in ("onnx", "onnxruntime"):
        monkeypatch.setitem(sys.modules, name, None)
    for words, said in (
        (["export"], "no run given"),
        (["export", str(tmp_path)], "is not a run folder"),
        (["export", str(tmp_path / "empty"), "--format", "stablehlo"], "no usable checkpoint: train it first"),
        (["export", run, "--format", "stablehlo", "--seed", "9"], "has trained no seed 9"),
        (["export", run], "needs onnx and onnxruntime: .*export"),
        (["export", run, "--check", run], "--check takes an exported file and writes nothing"),
        (["export", "--check", str(tmp_path / "none")], "does not exist"),
        (["export", run, "--format", "tflite"], "tflite"),
    ):
        assert cli.main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert re.search(said, line), line
    assert not (runs["Told"] / "export").exists()
