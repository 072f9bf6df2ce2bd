"""Command ``jaxrl-vis audit``: compare image-based rewards with a task's true rewards."""

import dataclasses
import json
from pathlib import Path

from jaxrl_vis.cli.checks import check_counts, check_env
from jaxrl_vis.cli.task_images import TaskImages
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.devices import check_devices
from jaxrl_vis.host.files import write_atomically
from jaxrl_vis.host.provenance import device_name, revision
from jaxrl_vis.report.outputs import check_figure, check_writable


@dataclasses.dataclass(frozen=True)
class Audit(TaskImages):
    """Compare image-based rewards with a task's true rewards: false rewards, order, calibration, exploitation.

    Nothing is trained. A custom reward (--rewards module:function) is a function of two batches of images [B, C, H, W] uint8
    with values between 0 and 1. A run folder stands for the reward model trained in that run.
    """

    rewards: tuple[str, ...] = ("indicator", "indicator_tolerance")
    """Rewards to audit: indicator, indicator_tolerance, features, run folders, or module:function."""
    episodes: int = 64
    """Number of episodes of random actions."""
    goals: int = 32
    """Number of goals that a random search tries to reach using only the reward."""
    sequences: int = 64
    """Number of action sequences that the random search tries per goal."""
    noise: float = 0.0
    """Standard deviation of the camera noise on images and goals, grey levels; the search has none."""
    tolerance: float = 8.0
    """Maximum difference of equal elements for indicator_tolerance, grey levels."""
    tolerance_share: float = 0.99
    """Fraction of the image's elements that must be equal for indicator_tolerance."""
    reward_encoder: str | None = None
    """File with the encoder for features, from `jaxrl-vis encoder`."""
    out: Path | None = None
    """Also plot rewards against distances to this .png, .pdf or .svg file."""
    json: Path | None = None
    """Also write the numbers to this file."""
    trust: bool = False
    """Execute a run's own code without asking (docs/runs.md)."""


def run(options: Audit) -> int:
    """Audit the rewards, and print a table."""
    check_env(options.env)
    check_counts(episodes=options.episodes, goals=options.goals, sequences=options.sequences, image_size=options.image_size)
    if options.episodes < 2:
        raise RequestError(f"episodes {options.episodes}: other episodes' goals need at least 2")
    if options.noise < 0.0:
        raise RequestError(f"noise {options.noise} must not be negative")
    if options.out is not None:
        check_figure(options.out)
    if options.json is not None:
        check_writable(options.json, "--json")
    check_devices()
    from jaxrl_vis.learner.environment import locate_env, make_env
    from jaxrl_vis.studies.audit import report
    from jaxrl_vis.studies.audit.rewards import find_reward

    config = locate_env(options.config())
    env = make_env(config)
    config = config.replace(
        tolerance=options.tolerance, tolerance_share=options.tolerance_share, reward_encoder=options.reward_encoder
    )
    rewards = {name: find_reward(name, config, options.trust) for name in options.rewards}
    counts = {"episodes": options.episodes, "goals": options.goals, "sequences": options.sequences}
    records, pairs, values = report.audit(env, rewards, **counts, noise=options.noise, seed=options.seed)
    print(report.table(records))
    reached = int((pairs.distance <= env.threshold).sum())
    print(
        f"\n{len(pairs.distance):,} pairs of an image and a goal, of which {reached:,} truly reach it (distance up to "
        f"{env.threshold:g} {env.distance_unit}); {options.goals} goals, {options.sequences} action sequences each"
    )
    if options.out is not None:
        report.draw(pairs, values, env.threshold, env.distance_unit, options.out)
        print(options.out)
    if options.json is not None:
        asked = {key: value for key, value in dataclasses.asdict(options).items() if key not in ("out", "json", "trust")}
        origin = {"revision": revision(), "device": device_name()}
        record = {"audit": asked, **origin, "pairs": len(pairs.distance), "reached_pairs": reached, "rewards": records}
        write_atomically(options.json, json.dumps(record, indent=2) + "\n")
    return 0
