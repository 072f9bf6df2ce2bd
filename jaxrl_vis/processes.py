"""Several processes that train as one, each with devices of its own, on one machine or on many (`jax.distributed`).

Every process runs the same program on the same arguments. The first one (of index 0) is where the others find each other; it
alone writes metrics, images and lines for people. What processes must do at the same moment, such as saving, they agree upon.
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
"""How long a process waits for the others at its start, s."""
_HEARTBEAT_S = 20  # without a sign of life for so long, a process counts as dead, and ends the others
_SHUTDOWN_S = 30
_LEAVE_S = 10


@dataclasses.dataclass(frozen=True)
class Place:
    """Of a process among the others.

    Attributes:
        coordinator: HOST:PORT of the first; None where the cluster's own variables say it (Slurm, Open MPI).
        count: Processes.
        index: Of this one, from 0.
    """

    coordinator: str | None
    count: int
    index: int


def find_place(
    coordinator: str | None = None,
    count: int | None = None,
    index: int | None = None,
    variables: Mapping[str, str] = os.environ,
) -> Place | None:
    """The place of this process, by options or by what a launcher has set; None where it is alone. Imports no JAX.

    Args:
        coordinator, count, index: The options, of which none or all are given.
        variables: Environment variables: those of ``srun`` and of Open MPI's ``mpirun`` are known.

    Raises:
        RequestError: The options make no sense.
    """
    given = {"--coordinator": coordinator, "--num-processes": count, "--process-id": index}
    missing = [name for name, value in given.items() if value is None]
    if len(missing) == len(given):
        return _by_launcher(variables)
    if missing:
        raise RequestError(f"{', '.join(given)} belong together: {' and '.join(missing)} is missing")
    assert coordinator is not None and count is not None and index is not None
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 2**16:
        raise RequestError(f"--coordinator must be HOST:PORT of the first process, such as node1:12345, not {coordinator!r}")
    if count < 1:
        raise RequestError(f"--num-processes must be at least 1, not {count}")
    if not 0 <= index < count:
        raise RequestError(f"--process-id must be one of 0 to {count - 1}, not {index}")
    return Place(coordinator, count, index) if count > 1 else None


def _by_launcher(variables: Mapping[str, str]) -> Place | None:
    launchers = (
        ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID", "SLURM_STEP_NODELIST"),
        ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK", "OMPI_MCA_orte_hnp_uri"),
    )
    for count, index, needed in launchers:
        if {count, index, needed} <= set(variables) and variables[count].isdigit() and int(variables[count]) > 1:
            return Place(variables.get("JAX_COORDINATOR_ADDRESS"), int(variables[count]), int(variables[index]))
    return None


def start(place: Place, seconds: int = START_S) -> None:
    """Finds the other processes. To be called before JAX has looked for devices.

    Args:
        place: From `find_place`.
        seconds: How long to wait for them.

    Raises:
        RequestError: They were not found.
    """
    import jax

    if place.coordinator is not None and place.index > 0:
        _wait_for(place.coordinator, seconds)
    try:
        jax.distributed.initialize(
            coordinator_address=place.coordinator,
            num_processes=place.count,
            process_id=place.index,
            initialization_timeout=seconds,
            heartbeat_timeout_seconds=_HEARTBEAT_S,
            shutdown_timeout_seconds=_SHUTDOWN_S,
        )
    except (RuntimeError, ValueError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise RequestError(
            f"process {place.index} of {place.count} has not found the others within {seconds} s: start all of them with the "
            f"same --coordinator and --num-processes, and check that its port is open ({reason})"
        ) from error


def _wait_for(coordinator: str, seconds: float) -> None:
    """Returns when the first process answers: JAX itself would end this one without a word that helps.

    Raises:
        RequestError: It does not.
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
        "mend --coordinator"
    )


def are_several() -> bool:
    """Whether this process has company."""
    return _count_and_index()[0] > 1


def is_first() -> bool:
    """Whether this process is the one that writes for people."""
    return _count_and_index()[1] == 0


def _count_and_index() -> tuple[int, int]:
    if "jax" not in sys.modules:
        return 1, 0
    import jax

    # Without `start` there is no company, and JAX is not made to look for devices, which may not be there.
    return (jax.process_count(), jax.process_index()) if jax.distributed.is_initialized() else (1, 0)


def meet(name: str) -> None:
    """Returns when all processes have come here.

    Args:
        name: Of the place.
    """
    if are_several():
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(name)


def leave_together() -> None:
    """Waits a while for the others to end, too, so that each has said why; else JAX would end them in the middle of it.

    To be called where what was asked for is refused, as all processes will find.
    """
    if not are_several():
        return
    import jax

    # In a thread, because JAX ends a process whose wait has failed.
    leaving = threading.Thread(target=jax.distributed.shutdown, daemon=True)
    leaving.start()
    leaving.join(_LEAVE_S)


def any_of(answer: bool) -> bool:
    """Whether any process says yes: all ask at the same point of the program, and get the same answer."""
    return bool(greatest(int(answer)))


def greatest(number: int) -> int:
    """The greatest number that any process gives: all ask at the same point of the program, and get the same answer."""
    if not are_several():
        return number
    import numpy as np
    from jax.experimental import multihost_utils

    return int(np.max(multihost_utils.process_allgather(np.asarray(number))))
