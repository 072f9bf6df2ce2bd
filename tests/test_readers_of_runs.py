"""The law of `test_readers`, for what lies in a run's folder."""

import json

from hypothesis import strategies as st
from mutations import json_text, texts, trees
from test_readers import also_as_text, hold, named, worker  # noqa: F401 - the fixture

from jaxrl_vis.config import Config
from jaxrl_vis.run.folder import _record


def test_configurations(worker):  # noqa: F811
    valid = json.loads(json.dumps(_record(Config(), ("tensorboard",))))
    spoilt = trees(valid, 2) | trees(valid["config"], 2).map(lambda config: {**valid, "config": config})
    hold(worker, "config", named("config.json", also_as_text(spoilt.map(json_text), json_text(valid))))


ROWS = [
    {"seed": seed, "iteration": i, "env_steps": 100 * i, "eval/success": 0.5, "loss": None}
    for i in (1, 2, 3)
    for seed in (0, 1)
]


def test_metrics(worker):  # noqa: F811
    valid = "\n".join(map(json_text, ROWS)) + "\n"
    lines = st.lists(st.sampled_from(ROWS).flatmap(lambda row: trees(row, 2)).map(json_text), min_size=1, max_size=6)
    hold(worker, "metrics", named("metrics.jsonl", st.one_of(lines.map("\n".join).map(str.encode), texts(valid))))
