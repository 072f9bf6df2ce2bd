"""Each of the usual mistakes in docs/mistakes.md is made here, and what is shown must be what the page says.

Every row of the table has a mistake, in backticks: a command line, or a line of Python. What is shown follows, in backticks as
well, with `...` for what depends on the machine.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import jaxrl_vis
import jaxrl_vis_envs
from jaxrl_vis import cli
from jaxrl_vis_envs import State
from jaxrl_vis_envs.adapters.brax import BraxEnv
from jaxrl_vis_envs.adapters.gymnasium import GymnasiumEnv

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "mistakes.md"
ROWS = re.findall(r"^\| .*?`([^`]+)`.*? \| `([^`]+)` \| \[.*?\]\((\S+)\) \|$", DOCUMENT.read_text(), flags=re.MULTILINE)
THREADS = re.compile(r"https://github\.com/(google/brax|DLR-RM/stable-baselines3|vwxyzjn/cleanrl)/issues/\d+")


def test_the_table_has_twenty_mistakes_and_their_sources() -> None:
    lines = [line for line in DOCUMENT.read_text().splitlines() if line.startswith("| ") and "http" in line]
    assert len(ROWS) == len(lines) >= 20, "a row is not of the table's form"
    assert all(THREADS.fullmatch(source) for _, _, source in ROWS)
    assert len({mistake for mistake, _, _ in ROWS}) == len(ROWS)


def matches(shown: str, expected: str) -> bool:
    return re.fullmatch(".*".join(map(re.escape, expected.split("..."))), shown, flags=re.DOTALL) is not None


@pytest.fixture(scope="module")
def start() -> State:
    """State of Reacher that contains zeros, for which nothing is compiled."""
    env = jaxrl_vis_envs.make("Reacher")
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(env.reset, jax.random.key(0)))


@pytest.fixture
def folder(here: Path) -> Path:
    """Current folder with a run, runs/mine, that has a configuration but was never trained, and a task in my_task.py."""
    run = here / "runs" / "mine"
    (run / "checkpoints").mkdir(parents=True)
    (run / "config.json").write_text(
        json.dumps({"schema": 2, "run_id": "a" * 32, "config": {"environment": {"env": "Reacher"}, "run": {"preset": "debug"}}})
    )
    (here / "my_task.py").write_text("class MyReach:\n    pass\n")
    (here / "model.zip").write_text("")
    return here


@pytest.mark.parametrize(("mistake", "shown"), [row[:2] for row in ROWS], ids=[row[0] for row in ROWS])
def test_each_mistake_is_reported(
    mistake: str, shown: str, folder: Path, start: State, capsys: pytest.CaptureFixture[str]
) -> None:
    if mistake.startswith("jaxrl-vis "):
        command_line(mistake.split()[1:], shown, capsys)
    else:
        python(mistake, shown, start)
    assert not (folder / "runs" / "mine" / "metrics.jsonl").exists()


def command_line(words: list[str], shown: str, capsys: pytest.CaptureFixture[str]) -> None:
    status = cli.main(words)
    output = capsys.readouterr()
    assert status == 2 and output.out == ""
    (line,) = output.err.splitlines()
    assert matches(line, f"jaxrl-vis: {shown}"), line


def python(line: str, shown: str, state: State) -> None:
    names: dict[str, Any] = {"jax": jax, "np": np, "jaxrl_vis": jaxrl_vis, "jaxrl_vis_envs": jaxrl_vis_envs, "state": state}
    names |= {"GymnasiumEnv": GymnasiumEnv, "BraxEnv": BraxEnv, "env": jaxrl_vis_envs.make("Reacher")}
    run: Callable[[], None] = lambda: exec(line, names)  # noqa: S102, E731
    with pytest.raises(Exception) as refused:
        run()
    said = f"{type(refused.value).__name__}: {refused.value}"
    assert "\n" not in said
    assert matches(said, shown), said
