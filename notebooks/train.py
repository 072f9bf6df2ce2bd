"""Train a robot from Python, as the command line does.

    python notebooks/train.py                            a small run for two laptop cores
    python notebooks/train.py fast VisualFetchReach      preset and environment

Watch the curve and the video appear in the folder that it prints.
"""

import sys

import jax

import jaxrl_vis


def main(preset: str = "cpu", env: str = "VisualFetchReach", run_dir: str | None = None) -> None:
    config = jaxrl_vis.preset(preset, env=env)
    trainer = jaxrl_vis.make_trainer(config, run_dir=run_dir)

    # One iteration by hand: a rollout, then gradient steps. The first call compiles.
    loop = trainer.init(jax.random.key(config.run.seed))
    loop, metrics = trainer.train_iteration(loop)
    print({name: float(value[0]) for name, value in metrics.items()})
    del loop, metrics  # the replay is large; run() makes its own

    # The whole thing: it evaluates, saves and draws by itself. The reports are for you.
    successes = []
    for report in trainer.run():
        if "eval/success" in report.metrics:
            successes.append(float(report.metrics["eval/success"][0]))
    print(f"success at the last evaluation: {successes[-1]:.2f}, the best: {max(successes):.2f}")
    print(f"files are in {trainer.folder.path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
