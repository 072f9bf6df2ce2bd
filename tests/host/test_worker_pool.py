"""Evaluation of numbers in parallel processes, and the file that stores the results."""

import functools
import itertools
import json
import multiprocessing
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType

import pytest

from jaxrl_vis import cli
from jaxrl_vis.errors import RequestError, Terminated, WorkerError
from jaxrl_vis.host import devices
from jaxrl_vis.host.worker_pool import Record, RecordFile, code_digest, evaluate_all, map_unordered, worker_pool
from jaxrl_vis.run import signals
from jaxrl_vis_envs.cores import num_cores


@pytest.fixture(autouse=True, scope="module")
def devices_are_listed_once() -> Iterator[None]:
    """List the devices once: each pool would start a process that does."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(devices, "list_devices", functools.cache(devices.list_devices))
        yield


def squared(offset: int, number: int) -> Record:
    return {"square": number * number + offset, "process": os.getpid(), "threads": os.environ.get("OMP_NUM_THREADS")}


def threads_of_xla(number: int) -> Record:
    return {"threads": os.environ.get("NPROC")}


def loads_glfw(number: int) -> Record:
    import mujoco  # noqa: F401 - without a display it would look for one in a process of its own

    return {"glfw": "glfw" in sys.modules, "gl": os.environ.get("MUJOCO_GL")}


def broken(number: int) -> Record:
    if number == 2:
        raise ValueError(f"number {number} is broken")
    return {"square": number * number}


def greedy(number: int) -> Record:
    import jax.numpy as jnp

    return {"total": float(jnp.zeros(10**14 + number, jnp.int8).sum())}  # 100 TB


def slow(number: int) -> Record:
    time.sleep(100 if number else 0)
    return {}


def killed(number: int) -> Record:
    os._exit(9)


def killed_while_sending(number: int) -> None:
    """Let this process end with the header of its result, which the pool's thread then waits for the rest of."""
    send = Connection._send  # type: ignore[attr-defined]

    def send_header(self: Connection, content: bytes) -> None:
        send(self, struct.pack("!i", len(content)))
        os._exit(9)

    Connection._send = send_header  # type: ignore[attr-defined]


def signalled(number: int) -> Record:
    """Send all signals to this process, as somebody would who signals the whole process group."""
    for item in signals.SIGNALS:
        subprocess.run(["kill", f"-{item}", str(os.getpid())], check=True)
    return {"ignored": sorted(signal.pthread_sigmask(signal.SIG_BLOCK, ()))}


def total(records: list[Record]) -> Record:
    return {"total": sum(record["square"] for record in records), "nothing": float("nan")}


def test_results_are_the_same_in_one_process_and_in_several():
    results: list[dict[int, Record]] = [{}, {}]
    for workers, into in zip((1, 2), results):
        evaluate_all(functools.partial(squared, 7), range(6), workers, into.__setitem__)
    one, two = results
    assert {number: record["square"] for number, record in one.items()} == {number: number**2 + 7 for number in range(6)}
    assert {number: record["square"] for number, record in two.items()} == {number: number**2 + 7 for number in range(6)}
    assert {record["process"] for record in one.values()} == {os.getpid()}
    assert os.getpid() not in {record["process"] for record in two.values()}
    assert all(int(record["threads"]) >= 1 for record in two.values())


@pytest.mark.parametrize(("device", "threads"), [(devices.CPU, str(max(num_cores() // 2, 1))), ("NVIDIA H200", None)])
def test_workers_with_an_accelerator_compile_with_all_cores(monkeypatch, device: str, threads: str | None):
    """XLA computes nothing on the cores there, and would compile for minutes with one thread."""
    monkeypatch.setattr(devices, "list_devices", lambda: [devices.Device(device, {})])
    monkeypatch.delenv("NPROC", raising=False)
    results: dict[int, Record] = {}
    evaluate_all(threads_of_xla, range(2), 2, results.__setitem__)
    assert list(results.values()) == [{"threads": threads}] * 2


def test_workers_look_for_no_window_system(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    results: dict[int, Record] = {}
    evaluate_all(loads_glfw, range(2), 2, results.__setitem__)
    assert list(results.values()) == [{"glfw": False, "gl": "disable"}] * 2


def test_what_goes_wrong_in_a_process_is_reported():
    results: dict[int, Record] = {}
    before = set(threading.enumerate())
    with pytest.raises(ValueError, match="number 2 is broken"):
        evaluate_all(broken, range(3), 2, results.__setitem__)
    # A pool's thread that outlives it may print a traceback when the process ends.
    assert not set(threading.enumerate()) - before
    with pytest.raises(WorkerError, match="was killed from outside"):
        evaluate_all(killed, range(3), 2, results.__setitem__)
    assert not set(threading.enumerate()) - before


def test_a_worker_killed_while_it_sends_a_result_is_reported():
    """Regression test: half a result was waited for forever, at the end of a training with many workers, too."""
    before = set(threading.enumerate())
    with pytest.raises(WorkerError, match="was killed from outside"):
        list(map_unordered(killed_while_sending, itertools.count(), 2))
    assert not set(threading.enumerate()) - before


def test_memory_that_runs_out_on_a_device_is_one_line(monkeypatch, capsys):
    """Regression test: a traceback of JAX came out of `phenotype eval --workers 10` where other programs used the GPU, too."""
    before = set(multiprocessing.active_children())
    with pytest.raises(WorkerError, match="memory ran out in one of 2 processes.*use fewer --workers"):
        evaluate_all(greedy, range(2), 2, {}.__setitem__)
    assert not set(multiprocessing.active_children()) - before
    monkeypatch.setitem(cli.COMMANDS, "envs", (cli.COMMANDS["envs"][0], lambda _: greedy(0)))
    assert cli.main(["envs"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("jaxrl-vis: memory of the device") and error.count("\n") == 1


def test_signals_to_the_whole_group_do_not_reach_processes():
    """Workers ignore signals to the process group: only their parent ends them."""
    results: dict[int, Record] = {}
    evaluate_all(signalled, range(2), 2, results.__setitem__)
    assert all(set(record["ignored"]) >= set(signals.SIGNALS) for record in results.values()) and len(results) == 2


def test_a_signal_to_the_one_that_started_them_ends_processes():
    before = set(multiprocessing.active_children())
    started = time.monotonic()
    with signals.Ending() as ending, pytest.raises(Terminated):
        for _ in map_unordered(slow, itertools.count(), 2):
            signal.raise_signal(signal.SIGTERM)
    assert ending.signal == signal.SIGTERM and not set(multiprocessing.active_children()) - before
    assert time.monotonic() - started < 60


@pytest.mark.parametrize("workers", [1, 2])
def test_endless_numbers_are_taken_as_they_are_needed(workers: int):
    before = set(multiprocessing.active_children())
    results = map_unordered(functools.partial(squared, 1), itertools.count(), workers)
    some = [record["square"] for record in itertools.islice(results, 5)]
    results.close()
    assert set(some) <= {number**2 + 1 for number in range(12)} and len(set(some)) == 5
    assert workers == 2 or some == [1, 2, 5, 10, 17]
    assert not set(multiprocessing.active_children()) - before


def test_processes_begin_before_the_first_result_is_asked_for(tmp_path: Path):
    with worker_pool(2) as unordered_map:
        results = unordered_map(Path.touch, [tmp_path / "begun"])
        wait_until((tmp_path / "begun").exists, 60.0)
        assert list(results) == [None]


def test_what_goes_wrong_with_endless_numbers_is_reported():
    with pytest.raises(ValueError, match="number 2 is broken"):
        list(map_unordered(broken, itertools.count(), 2))
    with pytest.raises(WorkerError, match="was killed from outside"):
        list(map_unordered(killed, itertools.count(), 2))


def test_processes_end_with_the_one_that_started_them_however_that_ends(tmp_path: Path, clean_environment: dict[str, str]):
    script = tmp_path / "evaluation.py"
    script.write_text(
        "import os, time\n"
        "from pathlib import Path\n"
        "from jaxrl_vis.host.worker_pool import map_unordered\n"
        "def work(number):\n"
        "    Path(__file__).with_name(f'{number}.part').write_text(str(os.getpid()))\n"
        "    Path(__file__).with_name(f'{number}.part').rename(Path(__file__).with_name(f'{number}.pid'))\n"
        "    time.sleep(120)\n"
        "if __name__ == '__main__':\n"
        "    list(map_unordered(work, range(2), 2))\n"
    )
    started = subprocess.Popen([sys.executable, script], env=clean_environment)
    try:
        wait_until(lambda: len(list(tmp_path.glob("*.pid"))) == 2, 60.0)
    finally:
        started.kill()
        started.wait()
    workers = [int(path.read_text()) for path in tmp_path.glob("*.pid")]
    wait_until(lambda: not any(is_running(worker) for worker in workers), 10.0)


def wait_until(holds: Callable[[], bool], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, "it did not come to that in time"
        time.sleep(0.05)


def is_running(process: int) -> bool:
    """Return True if a process is running; an ended one may still be listed."""
    try:
        os.kill(process, 0)
        status = Path(f"/proc/{process}/stat")
        return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")
    except (ProcessLookupError, FileNotFoundError):
        return False


def test_a_file_goes_on_where_it_was_and_holds_one_evaluation(tmp_path: Path):
    path, about = tmp_path / "kept.json", {"family": "training", "method": "default"}
    records = RecordFile(path, about, total)
    records.add(3, {"square": 9, "room": float("inf")})
    records.add(1, {"square": 1, "room": 0.5})
    again = RecordFile(path, about, total)
    assert (
        again.records
        == records.records
        == {1: {"number": 1, "square": 1, "room": 0.5}, 3: {"number": 3, "square": 9, "room": None}}
    )
    again.add_all({2: {"square": 4}})
    results = json.loads(path.read_text())
    assert results["total"] == 14 and results["nothing"] is None and results["family"] == "training"
    assert [item["number"] for item in results["each"]] == [1, 2, 3]
    with pytest.raises(RequestError, match='another evaluation \\(method: "default", not "thesis"\\)'):
        RecordFile(path, {**about, "method": "thesis"}, total)
    path.write_text("{}")
    with pytest.raises(RequestError, match="holds no records to resume"):
        RecordFile(path, about, total)
    in_memory = RecordFile(None, about, total)
    in_memory.add(1, {"square": 1})
    assert 1 in in_memory and 2 not in in_memory


def test_other_code_is_distinguished(tmp_path: Path):
    package = ModuleType("package")
    package.__file__ = str(tmp_path / "__init__.py")
    (tmp_path / "training").mkdir()
    for name in ("__init__.py", "look.py", "training/fit.py"):
        (tmp_path / name).write_text("1")
    before = code_digest(package, leave_out=("training",))
    (tmp_path / "training/fit.py").write_text("2")
    assert code_digest(package, leave_out=("training",)) == before != code_digest(package)
    (tmp_path / "look.py").write_text("2")
    assert code_digest(package, leave_out=("training",)) != before


@pytest.mark.parametrize(
    "item",
    [
        '{"number": 3}, {"number": 3}',
        '{"number": "3"}',
        '{"number": null}',
        '{"number": true}',
        '{"number": -1}',
        '{"number": 1e400}',
        "3",
        '{"number": 3, "square": "text"}',
        '{"number": 3, "square": null}',
        '{"number": 3, "square": ' + "[" * 10**5,
    ],
)
def test_records_that_somebody_has_changed_are_one_line(tmp_path: Path, item: str):
    path = tmp_path / "kept.json"
    records = RecordFile(path, {}, total)
    records.add(3, {"square": 9})
    before = json.dumps(json.loads(path.read_text())["each"])[1:-1]
    path.write_text(path.read_text().replace("\n    " + before, "\n    " + item))
    with pytest.raises(RequestError, match="delete it, or name another file with --json") as refused:
        RecordFile(path, {}, total)
    assert "\n" not in str(refused.value) and str(path) in str(refused.value)
