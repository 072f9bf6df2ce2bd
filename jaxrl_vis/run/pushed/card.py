"""Card of a policy (README.md): task, success and training command, with metadata for a hub."""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxrl_vis.config import Config
from jaxrl_vis.run.command import training_command


class Score(NamedTuple):
    """Success rate at the last step of evaluation episodes.

    Attributes:
        success: Success rate, 0 to 1.
        low, high: Bounds of the 95 % Wilson interval.
        episodes: Number of episodes.
        env_steps: Environment steps trained before the evaluation.
        distance: Mean distance to the goal, in the task's unit.
    """

    success: float
    low: float
    high: float
    episodes: int
    env_steps: int
    distance: float


def score(row: Mapping[str, Any], episodes: int) -> Score:
    """Summarise a row of metrics.jsonl of an evaluation on ``episodes`` episodes."""
    from scipy.stats import binomtest

    success = float(row["eval/success"])
    interval = binomtest(round(success * episodes), episodes).proportion_ci(method="wilson")
    distance = float(row["eval/goal_distance"])
    return Score(success, float(interval.low), float(interval.high), episodes, int(row["env_steps"]), distance)


def card(
    config: Config,
    record: Mapping[str, Any],
    seed: int,
    scores: Mapping[int, Score],
    unit: str,
    pictures: Mapping[str, str] | None = None,
    shipped_name: str | None = None,
    remark: str = "",
) -> str:
    """Return the text of the model card (README.md).

    Args:
        config: Configuration of the run.
        record: The run's config.json.
        seed: Seed whose weights are in the folder.
        scores: Scores by seed; empty if none was evaluated at the iteration of the weights.
        unit: Unit of distances.
        pictures: Image files by caption; None for no images.
        shipped_name: Name of the policy if it ships with the package; None if the folder stands alone, with metrics.jsonl.
        remark: Additional sentence about the scores.
    """
    task, name = config.environment.env, f"{config.environment.env}, {config.reward.method}, {config.run.algorithm}"
    lines = [
        "---",
        *(f"{key}: {json.dumps(value)}" for key, value in _front_matter(task, name, scores.get(seed)).items()),
        "---",
        "",
    ]
    lines += [f"# {name}", "", f"A policy that reaches goals of the task {task}, trained by jaxrl-vis.", ""]
    lines += [f"![{caption}]({file})\n" for caption, file in (pictures or {}).items()]
    lines += ["| seed | environment steps | success | 95 % interval | episodes | mean distance |", "|---|---|---|---|---|---|"]
    for number, result in scores.items():
        here = " (these weights)" if number == seed else ""
        lines.append(
            f"| {number}{here} | {result.env_steps:,} | {result.success:.3f} | {result.low:.3f} to {result.high:.3f} | "
            f"{result.episodes} | {result.distance:.3g} {unit} |"
        )
    if not scores:
        lines[-2:] = [f"Weights of seed {seed}; not evaluated where they were saved."]
    versions = record.get("versions") or {}
    device = (record.get("device") or {}).get("name", "unknown")
    lines += [
        "",
        f"Success is measured at the last step of an episode, without exploration; the interval is Wilson's. {remark}".rstrip(),
        "",
        "## Use",
        "",
        "```python",
        "import jaxrl_vis",
        "",
        f'policy = jaxrl_vis.load_policy("{shipped_name or "FOLDER"}")  # observation, goal -> action in [-1, 1]',
        "```",
        "",
        "## Training",
        "",
        "```sh",
        training_command(config),
        "```",
        "",
        f"Revision {record.get('git_revision') or 'unknown'}; "
        + ", ".join(f"{package} {versions[package]}" for package in ("python", "jax", "mujoco") if package in versions)
        + f"; {device}. The configuration is in config.json"
        + ("." if shipped_name else ", evaluations are in metrics.jsonl."),
    ]
    if ":" in task:
        lines += ["", f"The task {task} is code of its own, which is not in this folder."]
    return "\n".join(lines) + "\n"


def _front_matter(task: str, name: str, of_seed: Score | None) -> dict[str, Any]:
    """Return the front matter; its values are written as JSON, a subset of YAML."""
    front: dict[str, Any] = {
        "library_name": "jaxrl-vis",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "robotics", "jax", "mujoco", "goal-conditioned", task],
    }
    if of_seed is not None:
        kind = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
        metric = {"type": "success_rate", "name": "success", "value": round(of_seed.success, 4), "verified": False}
        result = {"task": kind, "dataset": {"name": task, "type": task}, "metrics": [metric]}
        front["model-index"] = [{"name": name, "results": [result]}]
    return front
