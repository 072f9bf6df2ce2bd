"""User-defined parts, one file each in a folder outside the package: those of docs/extending.md, trained as it describes."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import probe_environments as probes
import pytest
from doc_blocks import ROOT, blocks, commands

import jaxrl_vis
from jaxrl_vis import cli
from jaxrl_vis.config import Config, fields, preset
from jaxrl_vis.config.methods import METHODS
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import plugins
from jaxrl_vis.learner import auxtasks
from jaxrl_vis.learner.environment import locate_env
from jaxrl_vis.learner.train_step import ALGORITHMS
from jaxrl_vis.run import trust
from jaxrl_vis.weighting import WEIGHTINGS
from jaxrl_vis_envs import registry
from jaxrl_vis_envs.pixels import PixelsConfig

PAGE = ROOT / "docs" / "extending.md"
FILES = {match[1]: block.text for block in blocks(PAGE) if (match := re.match(r"# file: (\w+\.py)\n", block.text)) is not None}
TYPED = [words[1:] for block in blocks(PAGE) if block.language == "sh" for words in commands(block)]
# With an environment that compiles at once: parts of one's own do not depend on it.
COMMANDS = {
    kind: [
        {"VisualReacher": "VisualTold"}.get(word, word)
        for word in next(words for words in TYPED if f"my_{kind}:" in " ".join(words))
    ]
    for kind in ("method", "loss", "weighting", "algorithm")
}
SMALL = ["--env-steps", "32", "--eval-episodes", "2"]


@pytest.fixture
def elsewhere(here: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Current folder with the files of the page; the user's cache is empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(trust, "_trusted_here", set())
    for name, text in FILES.items():
        (here / name).write_text(text)
    monkeypatch.setitem(registry._ENTRIES, "VisualTold", registry._Entry(lambda _: probes.SeenGoWhereTold(), PixelsConfig))
    return here


@pytest.mark.parametrize("kind", COMMANDS)
def test_a_part_of_ones_own_is_one_file_and_trains(elsewhere: Path, kind: str) -> None:
    assert cli.main([*COMMANDS[kind], *SMALL, "--run-dir", "run"]) == 0
    rows = [json.loads(line) for line in Path("run", "metrics.jsonl").read_text().splitlines()]
    assert rows and all(np.isfinite(value) for row in rows for value in row.values() if isinstance(value, float))
    expected = {"method": "train/positive_share", "loss": "train/weight/flipped", "weighting": "train/loss/egomotion"}
    assert expected.get(kind, "train/imitation_loss") in rows[-1]
    assert json.loads(Path("run", "config.json").read_text())["config"]["environment"]["env_folder"] == str(elsewhere)
    if kind == "algorithm":
        assert cli.main(["train", "--resume", "--env-steps", "64", "--run-dir", "run"]) == 0
        assert len(Path("run", "metrics.jsonl").read_text().splitlines()) > len(rows)
        assert cli.main(["eval", "run", "--episodes", "2"]) == 0
        assert cli.main(["play", "run", "--out", "played.gif", "--episodes", "1"]) == 0 and Path("played.gif").exists()
        policy = jaxrl_vis.load_policy("run")
        image = np.zeros(policy.observation_spec.shape, np.uint8)
        assert policy(image, image).shape == (policy.action_size,)


def test_a_strangers_part_is_asked_about(elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*COMMANDS["weighting"], *SMALL, "--env-steps", "16", "--run-dir", "run"]) == 0
    trust._trusted_here.clear()
    for path in trust._folder().iterdir():
        path.unlink()
    capsys.readouterr()
    assert cli.main(["eval", "run"]) == 2
    error = capsys.readouterr().err
    assert "its weighting my_weighting:make is imported from" in error and "--trust" in error and error.count("\n") == 1
    assert cli.main(["train", "--resume", "--run-dir", "run"]) == 2
    assert "its weighting my_weighting:make" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "orcale"}, "method cannot be 'orcale'; did you mean oracle?"),
        ({"algorithm": "dpg"}, "algorithm cannot be 'dpg'; did you mean ddpg?"),
        ({"weighting": "ol-aux"}, "weighting cannot be 'ol-aux'; did you mean ol_aux?"),
        ({"aux_tasks": ("egomotoin",)}, "aux_tasks cannot be 'egomotoin'; did you mean egomotion?"),
        ({"weighting": "my_weighting:mkae"}, "my_weighting has no mkae; did you mean make?"),
        ({"algorithm": "my_algorythm:make"}, "there is no module my_algorythm"),
        ({"algorithm": "my_algorithm:STEP_SIZE"}, "my_algorithm:STEP_SIZE is not an algorithm"),
        ({"method": "my_method:nearly_equal"}, "method my_method:nearly_equal cannot be made: TypeError"),
    ],
)
def test_unknown_names_get_one_line(elsewhere: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(RequestError) as refused:
        jaxrl_vis.make_trainer(preset("debug", env="VisualReacher", **changes))
    assert str(refused.value).startswith(message) and "\n" not in str(refused.value)


def test_modules_of_a_run_lie_in_one_folder(elsewhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (elsewhere / "other").mkdir()
    (elsewhere / "my_weighting.py").rename(elsewhere / "other" / "my_other_weighting.py")
    monkeypatch.syspath_prepend(str(elsewhere / "other"))
    config = preset("debug", env="VisualReacher", method="my_method:Forgiving", weighting="my_other_weighting:make")
    with pytest.raises(RequestError, match="must lie in one folder"):
        locate_env(config)
    sys.modules.pop("my_other_weighting", None)


def test_names_are_those_of_the_registries() -> None:
    hints = fields.hints(Config)
    for field, known in (
        ("method", METHODS),
        ("weighting", WEIGHTINGS),
        ("aux_tasks", auxtasks.NAMES),
        ("algorithm", ALGORITHMS),
    ):
        assert fields.choices(hints[field]) == tuple(known)
    own = Config().replace(method="a:b", aux_tasks=("egomotion", "c:d"))
    assert plugins.custom_names(own) == {"method": "a:b", "aux_tasks 2": "c:d"}
