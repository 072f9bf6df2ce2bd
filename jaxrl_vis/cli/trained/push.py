"""Command ``jaxrl-vis push``: share the policy of a run in a folder or on a hub."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxrl_vis.cli.checks import check_run, may_run_code
from jaxrl_vis.cli.parsing import AlsoPositional
from jaxrl_vis.cli.trained.options import TrustOption


@dataclasses.dataclass(frozen=True)
class Push(TrustOption):
    """Push a trained policy to a folder or a hub: card, curve, video, configuration and weights; `load_policy` reads it."""

    run_dir: Annotated[Path, AlsoPositional()]
    """The run folder."""
    to: str
    """A new folder, or hub:user/name for the Hugging Face hub (needs the extra hub, and `hf auth login` once)."""
    seed: int | None = None
    """Seed whose policy is pushed; the run's first if not given."""


def run(options: Push) -> int:
    """Push a policy."""
    run_dir = check_run(options.run_dir)
    trust = may_run_code(run_dir, options.trust)
    from jaxrl_vis.run.pushed.push import check_target, push

    check_target(options.to)
    print(push(run_dir, options.to, options.seed, trust))
    return 0
