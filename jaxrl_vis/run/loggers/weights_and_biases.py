"""Weights & Biases logger: one W&B run per seed, in a group named after the run folder.

``wandb.json`` in the run folder stores the W&B runs' ids and the last iteration sent: a resumed run continues under the same
ids and sends nothing twice. Entries of a run other than that of config.json are ignored. W&B's own files are in ``wandb/``.
Account, project, server and network use are configured in W&B itself (``wandb login``, ``WANDB_PROJECT``,
``WANDB_MODE=offline``).
"""

import contextlib
import io
import json
import os
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import wandb

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.files import read_json, write_atomically
from jaxrl_vis.run.signals import shielded_children
from jaxrl_vis.run.storage.folder import WANDB_STATE
from jaxrl_vis.run.storage.metrics import RUN_ID, Row, scalars

PROJECT = "jaxrl-vis"
_INIT_S = 30.0  # seconds to reach the server


class WeightsAndBiases:
    """Weights & Biases logger, see the module.

    Args:
        folder: The run folder.
        record: The contents of config.json.
        seeds: The seeds of the run.
        echo: Called with the addresses of the runs.

    Raises:
        RequestError: No account is logged in.
        Exception: Any error of W&B, for example if it cannot be reached.
    """

    def __init__(self, folder: Path, record: Mapping[str, Any], seeds: Sequence[int], echo: Callable[[str], None]):
        self._state_file = folder / WANDB_STATE
        self._run_id = record[RUN_ID]
        self._state = self._read_state()
        self._runs: dict[int, Any] = {}
        mode = wandb.setup().settings.mode
        if mode == "online" and not _is_logged_in():
            raise RequestError("nobody is logged in: `wandb login`, or WANDB_MODE=offline")
        group = folder.resolve().name
        for seed in seeds:
            options = {name: value for group in record["config"].values() for name, value in group.items()}
            known = self._state.setdefault(str(seed), {"id": uuid.uuid4().hex[:8], "iteration": 0, RUN_ID: self._run_id})
            with shielded_children():  # W&B's own process must outlive a Ctrl-C, to receive the end of the run
                run = wandb.init(
                    project=os.environ.get("WANDB_PROJECT", PROJECT),
                    group=group,
                    name=f"{group}-seed{seed}",
                    id=known["id"],
                    resume="allow" if mode == "online" else None,
                    reinit="create_new",
                    dir=str(folder),
                    config={**options, **{name: record[name] for name in ("versions", "device", "git_revision")}},
                    settings=wandb.Settings(console="off", silent=True, init_timeout=_INIT_S),
                )
            run.config.update({"seed": seed}, allow_val_change=True)
            run.define_metric("env_steps", hidden=True)
            run.define_metric("*", step_metric="env_steps")
            self._runs[seed] = run
            if run.url and mode == "online":
                echo(f"Weights & Biases shows seed {seed} at {run.url}")
        self._write_state()

    def _read_state(self) -> dict[str, dict[str, Any]]:
        if not self._state_file.exists():
            return {}
        state = read_json(self._state_file, hint="delete it to begin new runs there")
        return {seed: known for seed, known in state.items() if isinstance(known, dict) and known.get(RUN_ID) == self._run_id}

    def _write_state(self) -> None:
        write_atomically(self._state_file, json.dumps(self._state, indent=2) + "\n")

    def log_rows(self, rows: Sequence[Row]) -> None:
        """Log the metrics of new rows against ``env_steps``; W&B's own step is the iteration."""
        for row in rows:
            known = self._state[str(row["seed"])]
            if row["iteration"] <= known["iteration"]:
                continue
            values = {"env_steps": row["env_steps"], **scalars(row)}
            self._runs[row["seed"]].log(values, step=row["iteration"])
            known["iteration"] = row["iteration"]
        self._write_state()

    def log_image(self, name: str, file: Path, env_steps: int) -> None:
        """Log the unchanged file in the first seed's W&B run, at the iteration of its latest row."""
        seed, run = next(iter(self._runs.items()))
        media = wandb.Video(str(file), format="gif") if file.suffix == ".gif" else wandb.Image(str(file))
        run.log({"env_steps": env_steps, name: media}, step=self._state[str(seed)]["iteration"])

    def close(self) -> None:
        """Wait until W&B has everything."""
        for run in self._runs.values():
            run.finish()


def _is_logged_in() -> bool:
    with contextlib.redirect_stderr(io.StringIO()):
        return bool(wandb.login(prompt=False, verify=False))
