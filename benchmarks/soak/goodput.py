"""Goodput of a long run that is killed at regular intervals, and an undisturbed run of as many steps."""

import json
import shutil
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.soak.run_process import Broken, RunProcess, kill_on_exit, read_rows
from jaxrl_vis.run.goodput import account, read_processes

_FOREVER = 10**9  # environment steps


def _success(folder: Path) -> list[float]:
    rows = read_rows(folder)
    return [row["eval/success"] for row in rows if row["iteration"] == rows[-1]["iteration"]]


def train_with_kills(folder: Path, every: float, minutes: float, options: Sequence[str]) -> dict[str, Any]:
    """Train for some time, killing the process at regular intervals; then evaluate the result.

    A run that the folder already holds is continued, so that an hour can be split over several calls; kills and minutes add up.

    Args:
        folder: The run folder.
        every: Time between kills, s.
        minutes: Duration of this call, minutes.
        options: Options of ``train``: task and preset.

    Returns:
        ``env_steps`` of its networks, per seed; ``kills``; ``minutes``; ``goodput``, gradient steps in its networks over
        gradient steps computed; ``replays_lost``, resumptions without the replay; and ``success`` at the end, one per seed.

    Raises:
        Broken: The run ends by itself, does not end after SIGTERM, or cannot be evaluated.
    """
    notes = folder.with_name(f"{folder.name}.kills.json")
    earlier: dict[str, float] = json.loads(notes.read_text()) if notes.exists() else {"kills": 0, "minutes": 0.0}
    started, kills = time.monotonic(), int(earlier["kills"])
    asked = [*options, "--env-steps", str(_FOREVER)]
    while True:
        left = started + 60.0 * minutes - time.monotonic()
        with kill_on_exit(RunProcess.start(folder, options=asked)) as process:
            process.wait_for(lambda: False, min(every, left))
            if not process.is_running():
                raise Broken(f"it ended by itself: {process.lines[-3:]}")
            if left > every:
                process.send(signal.SIGKILL)
                kills += 1
                lines = read_processes(folder / "processes.jsonl")
                print(f"kill {kills}: {len(lines)} processes, iterations begun {lines[-1]}", flush=True)
                continue
            if process.stop() not in (0, 143):
                raise Broken(f"SIGTERM was not heeded: {process.lines[-3:]}")
            break
    wall = earlier["minutes"] + (time.monotonic() - started) / 60.0
    notes.write_text(json.dumps({"kills": kills, "minutes": wall}))
    # Evaluate a copy: the run itself has not ended, and may be resumed with its replay.
    copy = folder.with_name(f"{folder.name}-evaluated")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    with kill_on_exit(RunProcess.start(copy, options=["--env-steps", "1"])) as process:
        if process.wait() != 0:
            raise Broken(f"it could not be evaluated: {process.lines[-3:]}")
    last = read_rows(copy)[-1]
    total = account(read_processes(folder / "processes.jsonl"), last["iteration"])
    if total.goodput is None:
        raise Broken("processes.jsonl is damaged")
    return {
        **{"env_steps": last["env_steps"], "kills": kills, "minutes": round(wall, 2), "goodput": total.goodput},
        **{"replays_lost": total.replays_lost, "success": _success(copy)},
    }


def train_undisturbed(folder: Path, env_steps: int, options: Sequence[str]) -> list[float]:
    """Return the final success of an undisturbed run of ``env_steps`` steps, per seed; an existing run is continued.

    Raises:
        Broken: The run fails, or takes more than a day.
    """
    with kill_on_exit(RunProcess.start(folder, options=[*options, "--env-steps", str(env_steps)])) as process:
        if process.wait(86400.0) != 0:
            raise Broken(f"the undisturbed run ended early: {process.lines[-3:]}")
    return _success(folder)


def report(killed: dict[str, Any], every: float, reference: Sequence[float] | None) -> dict[str, Any]:
    """Print the results, and return them for a file.

    Args:
        killed: Results of `train_with_kills`.
        every: Time between kills, s.
        reference: Success of an undisturbed run, per seed; None if there was none.
    """
    comparison = "" if reference is None else f", undisturbed {' '.join(f'{value:.3f}' for value in reference)}"
    print(
        "goodput {goodput:.4f} over {env_steps:,} environment steps and {minutes:g} minutes, killed {kills} times, every "
        "{every:g} s; replay lost {replays_lost} times; success at the end ".format(**killed, every=every)
        + " ".join(f"{value:.3f}" for value in killed["success"])
        + comparison
    )
    return killed | {"every": every, "undisturbed": None if reference is None else list(reference)}
