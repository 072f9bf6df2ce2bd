"""Policies in the package: found by name, small, described by a card, and as good as those of the runs they come from."""

import json
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
import safetensors
import yaml
from safetensors.numpy import save
from test_policy import SETTINGS, register

import jaxrl_vis
from benchmarks.ship import FRESH_KEY, MAX_BYTES, ship
from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.command import training_command
from jaxrl_vis.run.storage.folder import read_config
from jaxrl_vis.run.trained import shipped
from jaxrl_vis.run.trained.restored_run import evaluate_run
from jaxrl_vis.types import NormalizerState

MIN_SUCCESS = {
    "fetch": 0.97,
    "sawyer": 0.9,
    "hand": 0.85,
    "finger": 0.9,
    "push": 0.95,
    "reacher": 0.0,
}  # at the last step, over fresh episodes, as the card says


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Trained run of two seeds on images, and a package folder in which the policy of the second one is called told."""
    folder = tmp_path_factory.mktemp("shipped")
    with pytest.MonkeyPatch.context() as monkeypatch:
        register(monkeypatch)
        config = jaxrl_vis.preset("debug", env="VisualTold", seed=3, seeds=2, encoders="shared", **SETTINGS)
        list(jaxrl_vis.make_trainer(config, folder / "run").run())
        monkeypatch.setattr(shipped, "FOLDER", folder / "package")
        ship(folder / "run", "told", seed=4, episodes=4)
    return folder / "run", folder / "package"


@pytest.fixture
def package(made: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """Package folder of `made`, in use, with its tasks registered."""
    register(monkeypatch)
    monkeypatch.setattr(shipped, "FOLDER", made[1])
    return made[1]


def test_what_is_shipped_acts_as_the_run(made: tuple[Path, Path], package: Path) -> None:
    whole, halved = jaxrl_vis.load_policy(made[0], seed=4), jaxrl_vis.load_policy("told")
    assert (halved.seed, halved.iteration, halved.env_name) == (4, 3, "VisualTold")
    for ours, theirs in zip(*(jax.tree.leaves(policy.parameters) for policy in (whole, halved)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-6)
    statistics = [
        [part for part in jax.tree.leaves(policy.parameters, is_leaf=is_statistic) if is_statistic(part)]
        for policy in (whole, halved)
    ]
    assert len(statistics[0]) == 2
    jax.tree.map(np.testing.assert_array_equal, *statistics)  # float16 would end at 65504, and their sums do not
    image = np.arange(48, dtype=np.uint8).reshape(halved.observation_spec.shape)
    np.testing.assert_allclose(whole(image, 255 - image), halved(image, 255 - image), atol=2e-3)
    assert not np.allclose(halved(image, 255 - image), jaxrl_vis.load_policy(made[0], seed=3)(image, 255 - image), atol=2e-3)
    with safetensors.safe_open(package / "told" / "policy.safetensors", framework="numpy") as file:
        kinds = {file.get_slice(name).get_dtype() for name in file.keys() if name.startswith("actor")}
        assert "observations/mean" in file.keys() and "goals/mean" not in file.keys(), "equal arrays are written once"
    assert kinds == {"F16"}


def is_statistic(part: object) -> bool:
    return isinstance(part, NormalizerState)


def test_commands_take_the_name(made: tuple[Path, Path], package: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", "told", "--json", "figures.json"]) == 0
    whole = evaluate_run(made[0])
    for name, (value,) in json.loads(Path("figures.json").read_text()).items():
        assert value == pytest.approx(whole[name][1], abs=1e-2)
    assert cli.main(["export", "told", "--format", "safetensors"]) == 0
    assert (here / "told" / "export" / "safetensors" / "contract.json").exists()
    assert sorted(path.name for path in (package / "told").iterdir()) == ["README.md", "config.json", "policy.safetensors"]
    capsys.readouterr()
    assert cli.main(["eval", "tolt"]) == 2
    assert "neither a run folder nor a policy called 'tolt'; did you mean told?" in capsys.readouterr().err
    assert cli.main(["play", "told", "--aux"]) == 2
    assert "--aux needs the whole run" in capsys.readouterr().err


def test_a_run_folder_of_that_name_goes_first(package: Path, here: Path) -> None:
    assert shipped.find("told") == package / "told"
    Path("told").mkdir()
    assert shipped.find("told") == package / "told", "no run, but what a policy of the package has left here"
    Path("told/config.json").write_text("{}")
    assert shipped.find("told") == Path("told")
    with pytest.raises(RequestError, match="told/config.json"):
        jaxrl_vis.load_policy("told")


@pytest.mark.parametrize(
    "same", [["goals/mean"], {"goals/mean": 3}, {"goals/mean": "goals/mean"}, {"goals/mean": "observations/count"}, {"a": "b"}]
)
def test_a_file_that_names_no_equal_array_is_refused(same: object, package: Path, tmp_path: Path) -> None:
    for file in ("config.json", "policy.safetensors"):
        shutil.copy(package / "told" / file, tmp_path)
    path = tmp_path / "policy.safetensors"
    with safetensors.safe_open(path, framework="numpy") as file:
        about, arrays = json.loads(file.metadata()["about"]), {name: file.get_tensor(name) for name in file.keys()}
    assert about["same"]["goals/mean"] == "observations/mean"
    path.write_bytes(save(arrays, {"about": json.dumps({**about, "same": same})}))
    with pytest.raises(RequestError, match="holds no weights"):
        jaxrl_vis.load_policy(tmp_path)


def test_what_is_too_large_is_not_shipped(made: tuple[Path, Path], package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.ship.MAX_BYTES", 100)
    with pytest.raises(RequestError, match="ship one of"):
        ship(made[0], "large", episodes=2)
    assert [path.name for path in package.iterdir()] == ["told"], "nothing is left of it"


@pytest.mark.parametrize("name", shipped.names())
def test_policies_of_the_package_are_small_and_their_cards_true(name: str) -> None:
    folder = shipped.FOLDER / name
    assert (folder / "policy.safetensors").stat().st_size <= MAX_BYTES
    config, text = read_config(folder), (folder / "README.md").read_text()
    assert training_command(config) in text and f'load_policy("{name}")' in text
    (result,) = yaml.safe_load(text.split("---\n", 2)[1])["model-index"][0]["results"]
    success, row = (
        result["metrics"][0]["value"],
        re.search(r"\(these weights\) \| ([\d,]+) \| ([\d.]+) \| .* \| (\d+) \|", text),
    )
    assert row and float(row[2]) == pytest.approx(success, abs=1e-3) and int(row[3]) >= 256
    assert result["dataset"]["name"] == config.environment.env and f"key {FRESH_KEY}" in text
    assert success >= MIN_SUCCESS[name]
    page = Path(__file__).parents[2] / "docs" / "play.md"
    (described,) = re.findall(rf"^\| `{name}` \|.*$", page.read_text(), re.MULTILINE)
    low, high = row.string[row.start() : row.end()].split("|")[3].split(" to ")
    for figure in (
        f"{row[1]} steps",
        f"{row[2]} ({low.strip()} to {high.strip()})",
        f"of {int(row[3]):,} fresh",
        config.environment.env,
    ):
        assert figure in described
