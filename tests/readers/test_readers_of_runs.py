"""Every reader of files in a run's folder returns a value or raises its own error, like those of `test_readers`."""

import json
import shutil
from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import json_text, texts, trees
from test_checkpoint import saved, saved_once, states  # noqa: F401 - fixtures
from test_readers import also_as_text, hold, named, worker  # noqa: F401 - a fixture

from jaxrl_vis.config import Config
from jaxrl_vis.errors import RequestError
from jaxrl_vis.run.storage.checkpoint import FULL, LIGHT, Checkpoints
from jaxrl_vis.run.storage.folder import RunFolder


def test_configurations(worker, tmp_path):  # noqa: F811
    folder = RunFolder(tmp_path / "run")
    folder.open(Config(), log=("tensorboard",))
    valid = json.loads(folder.config.read_text())
    corrupted = trees(valid, 2) | trees(valid["config"], 2).map(lambda config: {**valid, "config": config})
    hold(worker, "config", named("config.json", also_as_text(corrupted.map(json_text), json_text(valid))))


ROWS = [
    {"seed": seed, "iteration": i, "env_steps": 100 * i, "eval/success": 0.5, "loss": None}
    for i in (1, 2, 3)
    for seed in (0, 1)
]


def test_metrics(worker):  # noqa: F811
    valid = "\n".join(map(json_text, ROWS)) + "\n"
    lines = st.lists(st.sampled_from(ROWS).flatmap(lambda row: trees(row, 2)).map(json_text), min_size=1, max_size=6)
    hold(worker, "metrics", named("metrics.jsonl", st.one_of(lines.map("\n".join).map(str.encode), texts(valid))), False)


def test_manifests_of_checkpoints(states, saved):  # noqa: F811
    """A checkpoint with a corrupted manifest is used where possible, or left out with a line, or refused with one line."""
    shutil.rmtree(saved / FULL)
    (file,) = [path for path in (saved / LIGHT / "3" / "manifest").iterdir() if "progress" in path.read_text(errors="replace")]
    valid = json.loads(file.read_text())
    tally: Counter[str] = Counter()

    @settings(max_examples=max(settings().max_examples // 4, 1))  # each of them opens the folder of checkpoints
    @given(also_as_text(trees(valid, 2).map(json_text), json_text(valid)))
    def check_property(data):
        file.write_bytes(data)
        lines: list[str] = []
        try:
            restored = Checkpoints(saved, lines.append, read_only=True).restore_train(states[1])
        except RequestError as error:
            lines.append(str(error))
            tally["refused"] += 1
        else:
            assert restored is not None and (restored.iteration == 3 or lines)
            tally[str(restored.iteration)] += 1
        assert all(len(line.splitlines()) == 1 for line in lines)

    check_property()
    assert tally["2"] and tally["3"], tally
