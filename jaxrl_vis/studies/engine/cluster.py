"""Execution of a grid's runs as cluster jobs by submitit: on Slurm, or by its local executor, which needs no cluster.

A job is one training command. A job that Slurm ends because of its time limit or preemption saves first, is queued again, and
resumes automatically. `grid` handles jobs like processes.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from jaxrl_vis.errors import RequestError
from jaxrl_vis.host.provenance import child_environment, install_command

ExecutorName = Literal["local", "slurm"]

_FAILED = 1
_DEFAULTS: dict[str, Any] = {"name": "jaxrl-vis", "timeout_min": 24 * 60, "gpus_per_node": 1, "cpus_per_task": 8}


class Training:
    """Callable of a job, pickled and called on the node.

    Args:
        words: The command.
        log: File for its output.
        environment: Variables added to those of the node.
    """

    def __init__(self, words: Sequence[str], log: Path, environment: Mapping[str, str]):
        self._words, self._log, self._environment = list(words), log.resolve(), dict(environment)
        self._folder, self._child = Path.cwd(), None

    def __call__(self) -> int:
        """Train, and return the command's exit status."""
        words = list(self._words)
        run_dir = self._folder / words[words.index("--run-dir") + 1] if "--run-dir" in words else None
        if "--resume" not in words and run_dir is not None and (run_dir / "config.json").exists():
            words.append("--resume")  # queued again
        with self._log.open("a", encoding="utf-8") as file:
            environment = {**os.environ, **self._environment}
            self._child = subprocess.Popen(words, stdout=file, stderr=file, env=environment, cwd=self._folder)
            if "SLURM_JOB_ID" in os.environ:  # Slurm signals every process of a job; a second signal would not wait
                return self._child.wait()
            before = signal.signal(signal.SIGTERM, lambda *_: self._terminate_child())
            try:
                return self._child.wait()
            finally:
                signal.signal(signal.SIGTERM, before)

    def checkpoint(self) -> Any:
        """Stop the run before the job is ended, and return the job to be queued again; called by submitit."""
        import submitit

        self._terminate_child()
        if self._child is not None:
            self._child.wait()
        return submitit.helpers.DelayedSubmission(Training(self._words, self._log, self._environment))

    def _terminate_child(self) -> None:
        if self._child is not None and self._child.poll() is None:
            self._child.send_signal(signal.SIGTERM)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_child": None}


class Job:
    """Submitted job with the interface of `subprocess.Popen` that `grid` uses.

    Args:
        job: Job of submitit.
        is_local: True if it runs on this machine, in a process whose id is that of the job.
    """

    def __init__(self, job: Any, is_local: bool = False):
        self._job, self._is_local = job, is_local
        self.returncode, self._is_cancelled = None, False

    def poll(self) -> int | None:
        """Return the exit status; None while the job is queued or running."""
        if self.returncode is None and self._job.done():
            self.returncode = -signal.SIGTERM if self._is_cancelled else _FAILED
            with contextlib.suppress(Exception):  # a cancelled or lost job has no result
                self.returncode = int(self._job.result())
        return self.returncode

    def send_signal(self, _: int) -> None:
        """Cancel the job; the run saves and ends. The signal's number is ignored."""
        self._is_cancelled = True
        if self._is_local:  # cancelling would kill it a second later
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(self._job.job_id), signal.SIGTERM)
        else:
            self._job.cancel()

    def kill(self) -> None:
        """Cancel the job immediately, by the executor's own means."""
        self._is_cancelled = True
        self._job.cancel()

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the job to end, and return its exit status.

        Raises:
            subprocess.TimeoutExpired: The job has not ended after ``timeout`` seconds, if that is not None.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while self.poll() is None:
            if end is not None and time.monotonic() >= end:
                raise subprocess.TimeoutExpired("a job", timeout or 0.0)
            time.sleep(0.2)
        return self.returncode or 0


class Cluster:
    """Submitter of runs as cluster jobs.

    Args:
        executor: Executor of the jobs.
        folder: Folder for submitit's own files.
        options: Parameters of submitit's executor as name=value, such as timeout_min=600 or slurm_partition=gpu.

    Raises:
        RequestError: submitit or Slurm is missing, or an option is unknown or not of the form name=value.
    """

    def __init__(self, executor: ExecutorName, folder: Path, options: Sequence[str] = ()):
        try:
            import submitit
        except ImportError as error:
            raise RequestError(f"--executor {executor} needs submitit: {install_command('cluster')}") from error
        self._is_local = executor == "local"
        parameters = {**_DEFAULTS, **dict(map(_read, options))}
        if self._is_local:
            parameters.pop("gpus_per_node")  # `grid` assigns a device to each run
        try:
            self._executor = submitit.AutoExecutor(folder, cluster=executor)
            self._executor.update_parameters(**parameters)
        except Exception as error:
            raise RequestError(f"--executor {executor} cannot be used: {' '.join(str(error).split())}") from error

    def start(self, words: Sequence[str], log: Path, environment: Mapping[str, str]) -> Job:
        """Submit a command; see `grid.start_process`."""
        own = {name: value for name, value in child_environment().items() if name == "PYTHONPATH"}
        return Job(self._executor.submit(Training(words, log, {**own, **environment})), self._is_local)


def _read(option: str) -> tuple[str, Any]:
    name, sign, value = option.partition("=")
    if not (name and sign and value):
        raise RequestError(f"--job-options are name=value, such as timeout_min=600 slurm_partition=gpu, not {option!r}")
    return name, int(value) if value.isdigit() else value
