"""Multi-process training, on one machine or several (`jax.distributed`); every process has devices of its own.

Every process runs the same program with the same arguments. The first process (index 0) is the coordinator; it alone writes
metrics, images and console output. Collective steps, such as saving, are synchronised.
"""

import dataclasses
import os
import socket
import sys
import threading
import time
from collections.abc import Mapping

from jaxrl_vis.errors import RequestError

START_S = 120
"""Default time that a process waits for the others at startup, s."""
_HEARTBEAT_S = 20  # a process without heartbeat for this long is considered dead, and the others are ended
_SHUTDOWN_TIMEOUT_S = 30
_EXIT_TIMEOUT_S = 10


@dataclasses.dataclass(frozen=True)
class Rank:
    """Rank of a process among the others.

    Attributes:
        coordinator: HOST:PORT of the first process; None if the cluster's own variables define it (Slurm, Open MPI).
        count: Number of processes.
        index: Index of this process, from 0.
    """

    coordinator: str | None
    count: int
    index: int


def find_rank(
    coordinator: str | None = None,
    count: int | None = None,
    index: int | None = None,
    variables: Mapping[str, str] = os.environ,
) -> Rank | None:
    """Determine the rank of this process from options or a launcher's variables; None for a single process. Imports no JAX.

    Args:
        coordinator, count, index: The options; all or none must be set.
        variables: Environment variables; those of ``srun`` and of Open MPI's ``mpirun`` are recognised.

    Raises:
        RequestError: The options are incomplete or invalid.
    """
    options = {"--coordinator": coordinator, "--num-processes": count, "--process-id": index}
    missing = [name for name, value in options.items() if value is None]
    if len(missing) == len(options):
        return _find_launcher_rank(variables)
    if missing:
        raise RequestError(f"{', '.join(options)} belong together: {' and '.join(missing)} is missing")
    assert coordinator is not None and count is not None and index is not None
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 2**16:
        raise RequestError(f"--coordinator must be HOST:PORT of the first process, such as node1:12345, not {coordinator!r}")
    if count < 1:
        raise RequestError(f"--num-processes must be at least 1, not {count}")
    if not 0 <= index < count:
        raise RequestError(f"--process-id must be one of 0 to {count - 1}, not {index}")
    return Rank(coordinator, count, index) if count > 1 else None


def _find_launcher_rank(variables: Mapping[str, str]) -> Rank | None:
    launchers = (
        ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID", "SLURM_STEP_NODELIST"),
        ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK", "OMPI_MCA_orte_hnp_uri"),
    )
    for count, index, needed in launchers:
        if {count, index, needed} <= set(variables) and variables[count].isdigit() and int(variables[count]) > 1:
            return Rank(variables.get("JAX_COORDINATOR_ADDRESS"), int(variables[count]), int(variables[index]))
    return None


def start(rank: Rank, seconds: int = START_S) -> None:
    """Connect to the other processes; call it before JAX initialises its devices.

    Args:
        rank: From `find_rank`.
        seconds: Timeout, s.

    Raises:
        RequestError: The other processes were not found in time, or JAX cannot connect to them.
    """
    import jax

    if rank.coordinator is not None and rank.index > 0:
        _wait_for(rank.coordinator, seconds)
    try:
        jax.distributed.initialize(
            coordinator_address=rank.coordinator,
            num_processes=rank.count,
            process_id=rank.index,
            initialization_timeout=seconds,
            heartbeat_timeout_seconds=_HEARTBEAT_S,
            shutdown_timeout_seconds=_SHUTDOWN_TIMEOUT_S,
        )
    except (RuntimeError, ValueError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise RequestError(
            f"process {rank.index} of {rank.count} has not found the others within {seconds} s: start all of them with the "
            f"same --coordinator and --num-processes, and check that its port is open ({reason})"
        ) from error


def _wait_for(coordinator: str, seconds: float) -> None:
    """Wait for the coordinator to accept connections: JAX itself would end this process without a helpful message.

    Raises:
        RequestError: It does not answer in time.
    """
    host, _, port = coordinator.rpartition(":")
    deadline, reason = time.monotonic() + seconds, "no answer"
    while time.monotonic() < deadline:
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=max(0.1, min(5.0, seconds))).close()
        except OSError as error:
            reason = error.strerror or str(error) or reason
            time.sleep(0.2)
        else:
            return
    raise RequestError(
        f"the first process does not answer at {coordinator} within {seconds:g} s ({reason}): start it with --process-id 0, or "
        "correct --coordinator"
    )


def is_multi_process() -> bool:
    """Return True if there are several processes."""
    return _count_and_index()[0] > 1


def is_first() -> bool:
    """Return True in the process that writes files and console output."""
    return _count_and_index()[1] == 0


def _count_and_index() -> tuple[int, int]:
    if "jax" not in sys.modules:
        return 1, 0
    import jax

    # Before `start` there is one process, and JAX must not initialise devices, which may be unavailable.
    return (jax.process_count(), jax.process_index()) if jax.distributed.is_initialized() else (1, 0)


def sync_processes(name: str) -> None:
    """Wait until all processes have reached this point.

    Args:
        name: Name of the synchronisation point.
    """
    if is_multi_process():
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(name)


def shut_down_together() -> None:
    """Shut down together with the other processes, within a timeout, so that each can print its error before JAX ends it.

    Call it after an error in the request, which all processes will raise.
    """
    if not is_multi_process():
        return
    import jax

    # In a thread, because JAX ends a process when its shutdown barrier fails.
    leaving = threading.Thread(target=jax.distributed.shutdown, daemon=True)
    leaving.start()
    leaving.join(_EXIT_TIMEOUT_S)


def any_process(answer: bool) -> bool:
    """Return True in all processes if ``answer`` is true in any; a collective call."""
    return bool(max_over_processes(int(answer)))


def max_over_processes(number: int) -> int:
    """Return the maximum of ``number`` over all processes; a collective call."""
    if not is_multi_process():
        return number
    import numpy as np
    from jax.experimental import multihost_utils

    return int(np.max(multihost_utils.process_allgather(np.asarray(number))))
