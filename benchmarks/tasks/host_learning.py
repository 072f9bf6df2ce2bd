"""Learning of FetchReach on the host (`host_fetch`) with `jaxrl_vis.indicator`: live, and from recorded episodes.

    MUJOCO_GL=egl python -m benchmarks.tasks.host_learning                 # all cells that have no record yet
    MUJOCO_GL=egl python -m benchmarks.tasks.host_learning --cells live_exact_noise0_seed100
    MUJOCO_GL=egl python -m benchmarks.tasks.host_learning --list

Live, the learner plays 40,000 steps, or until three evaluations in a row show a success of at least 0.9, and takes 25 gradient
steps after each episode of 50. Recorded, it takes 15,000 gradient steps on 1,000 episodes of a behaviour that goes towards the
goal in half of its steps, with noise, and anywhere in the others. ``make tables`` writes the records, one file for each cell,
into docs/indicator_rewards.md. Gymnasium-Robotics needs an older MuJoCo than this project, in an environment of its own; the
learner itself imports none.
"""

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from benchmarks.tasks.host_fetch import ACTION_SIZE, HORIZON, SHAPE, THRESHOLD, HostFetch, add_noise
from jaxrl_vis import indicator
from jaxrl_vis.errors import RequestError
from jaxrl_vis.host import provenance
from jaxrl_vis.host.files import write_atomically

RESULTS = Path("benchmarks") / "results" / "host"
_SMALL: dict[str, Any] = {
    "preset": "cpu",
    "batch_size": 64,
    "encoders": "shared",
    "target_encoder": False,
    "random_shift": 1,
    "encoder_filters": (8, 16, 32, 32),
    "latent_size": 64,
    "hidden_sizes": (128, 128),
}
_SEEDS, _NOISES, _EVALUATION_SEED, _BEHAVIOUR_SEED = (100, 101, 102), (2, 5), 10_000, 20_000
TARGET_SUCCESS, IN_A_ROW = 0.9, 3
_LATEST = 20
"""Number of final rows of metrics averaged for a record; each row is the mean over one call of `Learner.update`."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run.

    Attributes:
        mode: ``live`` (`learn_online`) or ``recorded`` (`learn_offline`).
        method: ``exact``, ``tolerance``, ``oracle``, ``contrastive`` or ``cloning``.
        noise: Standard deviation of the camera noise, grey levels.
        seed: Seed of the learner and, live, of the robot.
    """

    mode: str
    method: str
    noise: int
    seed: int

    @property
    def name(self) -> str:
        """Name of the record."""
        return f"{self.mode}_{self.method}_noise{self.noise}_seed{self.seed}"

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `indicator.Learner`, without ``capacity``."""
        of_method: dict[str, dict[str, Any]] = {
            "exact": {"method": "indicator_balance_filter", "relabel_probability": 0.8},
            # Noise of sigma differs by sigma sqrt(2) between two images; without noise, a few grey levels.
            "tolerance": {"tolerance": max(2.0, 3.0 * 2.0**0.5 * self.noise), "relabel_probability": 0.8},
            "oracle": {"method": "oracle", "relabel_probability": 0.8},
            "contrastive": {"algorithm": "contrastive", "method": "oracle", "random_shift": 0},
            "cloning": {"algorithm": "benchmarks.tasks.behaviour_cloning:make", "relabel_probability": 1.0},
        }
        return {**_SMALL, "seed": self.seed, "state_size": 3, "threshold": THRESHOLD, **of_method[self.method]}


@dataclasses.dataclass(frozen=True)
class Size:
    """Lengths of runs; the defaults are those of the stored records.

    Attributes:
        steps: Live: maximum number of environment steps.
        updates_per_episode: Live: gradient steps after each episode.
        interval: Live: environment steps between evaluations.
        episodes: Recorded: number of episodes.
        updates: Recorded: number of gradient steps.
        eval_episodes: Episodes of each evaluation during learning.
        final_episodes: Episodes of the evaluation at the end.
    """

    steps: int = 40_000
    updates_per_episode: int = 25
    interval: int = 2500
    episodes: int = 1000
    updates: int = 15_000
    eval_episodes: int = 20
    final_episodes: int = 100


def cells() -> list[Cell]:
    """Return all cells, the most important first."""
    first, *others = _SEEDS
    one = [Cell("live", "exact", 0, first), *(Cell("recorded", method, 0, first) for method in ("exact", "cloning"))]
    noisy = [Cell("recorded", method, noise, first) for noise in _NOISES for method in ("exact", "tolerance", "oracle")]
    more = [Cell(cell.mode, cell.method, cell.noise, seed) for seed in others for cell in one]
    return [*one, Cell("recorded", "oracle", 0, first), *noisy, *more]


def evaluate(learner: indicator.Learner, robot: HostFetch, episodes: int) -> float:
    """Return the success rate over ``episodes`` fixed goals; restarts the random sequence of ``robot``."""
    robot.reseed(_EVALUATION_SEED)
    return float(
        np.mean([robot.run_episode(lambda image, goal, _: learner.act(image, goal)).is_reached for _ in range(episodes)])
    )


def mean_shares(metrics: list[dict[str, float]]) -> dict[str, float]:
    """Return the means over the last `_LATEST` rows of all metrics with ``share`` in their name, without ``train/``."""
    last = metrics[-_LATEST:]
    return {name.removeprefix("train/"): float(np.mean([row[name] for row in last])) for name in last[0] if "share" in name}


def learn_online(cell: Cell, size: Size) -> dict[str, Any]:
    """Learn online, until `IN_A_ROW` evaluations reach `TARGET_SUCCESS` or for ``size.steps`` environment steps.

    Returns:
        ``rows`` (success by environment steps), final ``success``, ``shares`` (`mean_shares`) and ``seconds``.
    """
    learner = indicator.Learner(SHAPE, ACTION_SIZE, HORIZON, capacity=size.steps // HORIZON, **cell.options())
    robot, judge, draw = HostFetch(cell.noise, cell.seed), HostFetch(cell.noise, 0), np.random.default_rng(cell.seed)

    def explore(image: np.ndarray, goal: np.ndarray, _: np.ndarray) -> np.ndarray:
        if learner.episodes < 5 or draw.random() < 0.3:
            return draw.uniform(-1.0, 1.0, ACTION_SIZE)
        return learner.act(image, goal) + 0.2 * draw.standard_normal(ACTION_SIZE)

    rows, metrics, began = [], [], time.monotonic()
    for episode in range(1, size.steps // HORIZON + 1):
        played = robot.run_episode(explore)
        learner.add(played.observations, played.actions, played.goal, played.states)
        metrics.append(learner.update(size.updates_per_episode))
        if episode * HORIZON % size.interval == 0:
            rows.append({"env_steps": episode * HORIZON, "success": evaluate(learner, judge, size.eval_episodes)})
            print(cell.name, rows[-1], mean_shares(metrics), f"{time.monotonic() - began:.0f} s", flush=True)
            if len(rows) >= IN_A_ROW and min(row["success"] for row in rows[-IN_A_ROW:]) >= TARGET_SUCCESS:
                break
    success = evaluate(learner, judge, size.final_episodes)
    for each in (robot, judge):
        each.close()
    return {"rows": rows, "success": success, "shares": mean_shares(metrics), "seconds": time.monotonic() - began}


def record_episodes(path: Path, size: Size) -> None:
    """Write episodes of the noisy behaviour as .npz, with their success, seen without noise."""
    robot, draw = HostFetch(0.0, _BEHAVIOUR_SEED), np.random.default_rng(_BEHAVIOUR_SEED)

    def behave(_: np.ndarray, __: np.ndarray, towards: np.ndarray) -> np.ndarray:
        if draw.random() < 0.5:
            return draw.uniform(-1.0, 1.0, ACTION_SIZE)
        return np.append(5.0 * towards, 0.0) + 0.5 * draw.standard_normal(ACTION_SIZE)

    played = [robot.run_episode(behave) for _ in range(size.episodes)]
    robot.close()
    observations, actions, goals, states, reached = (np.stack(parts) for parts in zip(*played, strict=True))
    np.savez(path, observations=observations, actions=actions, goals=goals, states=states, reached=reached)


def learn_offline(cell: Cell, size: Size, folder: Path) -> dict[str, Any]:
    """Learn offline from recorded episodes, which are written first if ``folder`` lacks them.

    Returns:
        ``rows`` (success by gradient steps), final ``success``, ``behaviour_success`` of the recorded episodes, ``shares``
        (`mean_shares`) and ``seconds``.
    """
    path = folder / f"recorded_{size.episodes}.npz"
    if not path.exists():
        record_episodes(path, size)
    with np.load(path) as arrays:
        episodes = {name: arrays[name] for name in arrays.files}
    learner = indicator.Learner(SHAPE, ACTION_SIZE, HORIZON, capacity=size.episodes, **cell.options())
    draw = np.random.default_rng(cell.seed)
    for number in range(size.episodes):
        seen, goal = (add_noise(episodes[name][number], cell.noise, draw) for name in ("observations", "goals"))
        learner.add(seen, episodes["actions"][number], goal, episodes["states"][number])
    judge, rows, metrics, began = HostFetch(cell.noise, 0), [], [], time.monotonic()
    for updates in range(100, size.updates + 1, 100):
        metrics.append(learner.update(100))
        if updates % (size.updates // 5) == 0:
            rows.append({"updates": updates, "success": evaluate(learner, judge, size.eval_episodes)})
            print(cell.name, rows[-1], metrics[-1], f"{time.monotonic() - began:.0f} s", flush=True)
    success = evaluate(learner, judge, size.final_episodes)
    judge.close()
    return {
        "rows": rows,
        "success": success,
        "behaviour_success": float(np.mean(episodes["reached"])),
        "shares": mean_shares(metrics),
        "seconds": time.monotonic() - began,
    }


def run(cell: Cell, size: Size, results: Path, recordings: Path) -> None:
    """Run one cell and write its record, ``NAME.json``.

    Args:
        cell: The cell.
        size: Lengths of the run.
        results: Folder of the record; created if it does not exist.
        recordings: Existing folder of the recorded episodes.
    """
    result = learn_online(cell, size) if cell.mode == "live" else learn_offline(cell, size, recordings)
    about = {
        **dataclasses.asdict(cell),
        "size": dataclasses.asdict(size),
        "device": provenance.device_name(),
        "revision": provenance.revision(),
        "versions": provenance.versions() | {"mujoco": mujoco.__version__},
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }
    results.mkdir(parents=True, exist_ok=True)
    write_atomically(results / f"{cell.name}.json", json.dumps({**about, **result}, indent=1) + "\n")


def main(words: list[str] | None = None) -> int:
    """Run the cells that have no record; return the exit status, 2 after an error line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", nargs="+", help="cells by name; all if not given")
    parser.add_argument("--list", action="store_true", help="print the names of all cells")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the records")
    parser.add_argument("--recordings", type=Path, default=Path(tempfile.gettempdir()), help="folder of recorded episodes")
    for field in dataclasses.fields(Size):
        parser.add_argument(f"--{field.name.replace('_', '-')}", type=int, default=field.default)
    args = parser.parse_args(words)
    known = {cell.name: cell for cell in cells()}
    if args.list:
        print("\n".join(known))
        return 0
    size = Size(**{field.name: getattr(args, field.name) for field in dataclasses.fields(Size)})
    try:
        for name in args.cells or known:
            if name not in known:
                raise RequestError(f"there is no cell {name}: see --list")
            if not (args.results / f"{name}.json").exists():
                run(known[name], size, args.results, args.recordings)
    except RequestError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
