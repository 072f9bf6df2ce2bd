"""Script of one of several processes that train together, with one device each; the tests start it twice.

python two_processes.py RUN_DIR HOST:PORT COUNT INDEX [steps=N] [die_at=ITERATION] [resume=1] ...

With COUNT 1 it trains alone. Its exit status is that of the command line.
"""

import os
import sys
from pathlib import Path

from jaxrl_vis import cli
from jaxrl_vis.host import distributed


def train(options) -> int:
    if options["count"] > 1:
        distributed.start(distributed.Rank(options["coordinator"], options["count"], options["index"]), 60)
    import jax
    import probe_environments as probes
    import quick_jax  # noqa: F401

    from jaxrl_vis.config import preset
    from jaxrl_vis.learner.train_step import make_train_step
    from jaxrl_vis.run.trainer import Trainer

    env = probes.GoWhereTold()
    env.distance_unit = "m"
    sizes = {"num_envs": 8, "updates_per_iteration": 4, "batch_size": 16, "replay_transitions": 3 * 8 * env.horizon}
    changes = {"seeds": options["seeds"], "env_steps": 8 * env.horizon * options["iterations"]}
    saving = {"checkpoint_interval": 2, "full_checkpoint_interval": 2, "eval_interval": 2, "eval_episodes": 8}
    config = preset("debug", **sizes, **changes, **saving, devices=len(jax.devices()))
    trainer = Trainer(config, make_train_step(env, config), options["run_dir"], resume=bool(options["resume"]))
    for report in trainer.run():
        print(f"report {report.iteration}", flush=True)
        if report.iteration == options["die_at"] and options["index"] == 1:
            os._exit(9)
    return 0


def main() -> None:
    run_dir, coordinator, count, index, *more = sys.argv[1:]
    options = {"run_dir": Path(run_dir), "coordinator": coordinator, "count": int(count), "index": int(index)}
    options |= {"seeds": 1, "iterations": 4, "die_at": -1, "resume": 0}
    options |= {name: int(value) for name, value in (word.split("=") for word in more)}
    cli.COMMANDS = {"train": (cli.train.Train, lambda _: train(options))}
    sys.argv[1:] = ["train"]
    cli.entry()


if __name__ == "__main__":
    main()
