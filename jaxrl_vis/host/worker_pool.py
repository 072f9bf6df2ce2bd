"""Evaluation of many numbered items, such as synthetic plots, in parallel processes; those already evaluated are skipped.

    records = RecordFile(path, about, summary)               # resumes the file if it has the same conditions
    missing = [number for number in numbers if number not in records]
    evaluate_all(function, missing, workers, records.add)    # function(number) -> record; records.add writes the file

Records are JSON values. A record must depend only on its number, so that it is the same for any number of workers.
"""

import contextlib
import functools
import hashlib
import itertools
import json
import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from jaxrl_vis.errors import RequestError, WorkerError, is_out_of_memory
from jaxrl_vis.host.files import is_count, read_json, write_atomically
from jaxrl_vis.run.signals import obey_parent_only, shielded_children
from jaxrl_vis_envs.cores import num_cores

Record = dict[str, Any]
"""Result of the evaluation of one number."""
A = TypeVar("A")
T = TypeVar("T")

# Variables that limit the threads of NumPy, SciPy, OpenCV and, last, XLA in a process.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC")
_CHECK_INTERVAL = 1.0  # s without a result after which workers that ended are looked for


def evaluate_all(
    evaluate: Callable[[int], Record], numbers: Iterable[int], workers: int, on_record: Callable[[int, Record], None]
) -> None:
    """Evaluate numbers in this process or in several.

    Args:
        evaluate: Maps a number to its record. With more than one worker it is pickled: a function at module level, or a
            `functools.partial` of one.
        numbers: Numbers to evaluate.
        workers: Number of processes; 1 for this one. They share the machine's GPUs and cores.
        on_record: Called in this process with a number and its record, in order of completion.

    Raises:
        WorkerError: A process was killed from outside, most likely because memory ran out.
    """
    numbers = list(numbers)
    with worker_pool(min(workers, len(numbers))) as unordered_map:
        for number, record in unordered_map(functools.partial(_numbered, evaluate), numbers):
            on_record(number, record)


def _numbered(evaluate: Callable[[int], Record], number: int) -> tuple[int, Record]:
    return number, evaluate(number)


def map_unordered(function: Callable[[A], T], arguments: Iterable[A], workers: int) -> Generator[T]:
    """Map a function over arguments, possibly endless, and yield the results in order of completion.

    Args:
        function: Maps an argument to its result. With more than one worker, both are pickled.
        arguments: Arguments of the calls.
        workers: Number of processes; 1 for this one. They are stopped with the iterator.

    Raises:
        WorkerError: A process was killed from outside, most likely because memory ran out.
    """
    with worker_pool(workers) as unordered_map:
        yield from unordered_map(function, arguments)


UnorderedMap = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
"""Map of a function over arguments, in this process as results are needed, or at once in several, as they complete."""


@contextlib.contextmanager
def worker_pool(workers: int) -> Iterator[UnorderedMap]:
    """Start worker processes that share the GPUs and cores, and yield a map over them; stop them at the end of the context.

    They are killed after an error, and exit if this process ends.

    Args:
        workers: Number of processes; 1 or less for this one.

    Raises:
        WorkerError: One was killed from outside, most likely because memory ran out, or memory of a device ran out.
    """
    if workers < 2:
        yield lambda function, arguments: map(function, arguments)
        return
    spawning = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with shielded_children():  # starts multiprocessing's helper process
        counter = spawning.Value("i", 0)
    pool = ProcessPoolExecutor(
        workers, mp_context=spawning, initializer=_prepare, initargs=(counter, _worker_env_vars(workers))
    )
    children: set[BaseProcess] = set()

    def submit(function: Callable[[A], T], argument: A) -> Future[T]:
        with shielded_children():  # may start a process, which only this one may end: see `_prepare`
            future = pool.submit(function, argument)
        children.update(set(multiprocessing.active_children()) - others)
        return future

    def unordered_map(function: Callable[[A], T], arguments: Iterable[A]) -> Iterator[T]:
        arguments = iter(arguments)
        # Two pending calls per worker, so that none waits for this process.
        waiting = {submit(function, argument) for argument in itertools.islice(arguments, 2 * workers)}
        return results(function, arguments, waiting)

    def results(function: Callable[[A], T], arguments: Iterator[A], waiting: set[Future[T]]) -> Iterator[T]:
        while waiting:
            ready, waiting = wait(waiting, _CHECK_INTERVAL, FIRST_COMPLETED)
            if not ready and any(child.exitcode for child in children):
                raise BrokenProcessPool("a worker was killed while it sent a result")
            waiting |= {submit(function, argument) for argument in itertools.islice(arguments, len(ready))}
            for result in ready:
                yield result.result()

    try:
        yield unordered_map
    except BrokenProcessPool as error:
        _kill(pool, children)
        raise WorkerError(
            f"one of {workers} processes was killed from outside, most likely because memory ran out: use fewer --workers"
        ) from error
    except BaseException as error:
        _kill(pool, children)
        if is_out_of_memory(error):
            raise WorkerError(f"memory ran out in one of {workers} processes, which share it: use fewer --workers") from error
        raise
    pool.shutdown()


def _kill(pool: ProcessPoolExecutor, children: Iterable[BaseProcess]) -> None:
    """Kill the worker processes of a pool, and wait for its thread to end."""
    results = pool._result_queue
    for child in children:
        child.kill()
    if results is not None:
        # Of a worker killed while it sent a result, the pool's thread would wait for the rest until the last writer is closed.
        results._writer.close()
    pool.shutdown(cancel_futures=True)


def share_accelerator() -> None:
    """Let this process allocate GPU memory on demand, so that other processes can use the GPU; call it before using JAX."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def _worker_env_vars(workers: int) -> list[dict[str, str]]:
    """Return the environment variables of the workers: their GPU, if there are several, and their number of threads."""
    import jax

    from jaxrl_vis.host.devices import CPU, list_devices

    devices = list_devices()
    # With an accelerator, XLA needs its threads only to compile: for minutes with one, for seconds with many.
    limited = _THREADS if devices[0].name == CPU else _THREADS[:-1]
    threads = dict.fromkeys(limited, str(max(num_cores() // workers, 1)))
    # Workers open no window; otherwise importing MuJoCo would start a process that looks for GLFW and outlives the worker.
    share = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "disable")}
    if cache := jax.config.jax_compilation_cache_dir:  # a program is compiled once for all
        share["JAX_COMPILATION_CACHE_DIR"] = cache
    return [{**threads, **share, **devices[index % len(devices)].environment} for index in range(workers)]


def _end_with_parent() -> None:
    """Wait for the parent process to end, for example when killed, then exit: its results are no longer needed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _prepare(counter: Any, env_vars: list[dict[str, str]]) -> None:
    """Initialise a worker process."""
    obey_parent_only()  # a signal to the process group would otherwise interrupt parent and worker at once
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with counter.get_lock():
        index = counter.value
        counter.value += 1
    variables = env_vars[index % len(env_vars)]
    os.environ.update(variables)
    try:
        import cv2
    except ImportError:
        return
    cv2.setNumThreads(int(variables[_THREADS[0]]))


def code_digest(*packages: ModuleType, leave_out: tuple[str, ...] = ()) -> str:
    """Compute a digest of the code that records come from: 12 hexadecimal digits.

    Args:
        packages: Packages whose files are included.
        leave_out: Names of files and folders that affect no record.
    """
    digest = hashlib.sha256()
    for package in packages:
        folder = Path(str(package.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            name = path.relative_to(folder)
            if not set(leave_out) & set(name.parts):
                digest.update(name.as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


class RecordFile:
    """JSON file of records: their conditions, their summary, and one line per number.

    Attributes:
        records: Records by number.
    """

    def __init__(self, path: Path | None, about: Mapping[str, Any], summary: Callable[[list[Record]], Mapping[str, Any]]):
        """Read the file, if it exists; it must have been written under the same conditions.

        Args:
            path: The file; None to keep the records in memory only.
            about: Conditions under which numbers are evaluated.
            summary: Computes the summary of records in the order of their numbers.

        Raises:
            RequestError: The file has other conditions, cannot be read, or holds a damaged record.
        """
        self.records: dict[int, Record] = {}
        self._path, self._about, self._summary = path, json.loads(json.dumps(replace_non_finite(about))), summary
        self._lines: dict[int, str] = {}
        if path is not None and path.exists():
            for record in _read(path, self._about):
                self._keep(record["number"], record)
            self._check(path)

    def __contains__(self, number: int) -> bool:
        return number in self.records

    def add(self, number: int, record: Record) -> None:
        """Add the record of a number, and write the file."""
        self.add_all({number: record})

    def add_all(self, records: Mapping[int, Record]) -> None:
        """Add the records of several numbers, and write the file once."""
        for number, record in records.items():
            self._keep(number, {"number": number, **record})
        self.write()

    def write(self) -> None:
        """Write the file atomically, unless the records are kept in memory only."""
        if self._path is None:
            return
        ordered = sorted(self.records)
        figures = replace_non_finite({**self._about, **self._summary([self.records[number] for number in ordered])})
        head = json.dumps(figures, indent=2)
        lines = ",\n".join(f"    {self._lines[number]}" for number in ordered)
        write_atomically(self._path, f'{head[:-2]},\n  "each": [\n{lines}\n  ]\n}}\n')

    def _check(self, path: Path) -> None:
        """Raise a RequestError if the records that were read have been altered."""
        try:
            self._summary([self.records[number] for number in sorted(self.records)])
        except Exception as error:  # computing with altered records may raise anything
            raise RequestError(
                f"{path} holds a damaged record ({type(error).__name__}: {error}): delete it, or name another file with --json"
            ) from error

    def _keep(self, number: int, record: Record) -> None:
        record = replace_non_finite(record)
        # Results must not depend on whether a record was read from the file.
        line = json.dumps(record, allow_nan=False)
        self.records[number], self._lines[number] = json.loads(line), line


def replace_non_finite(value: Any) -> Any:
    """Return a copy with non-finite numbers replaced by None, at any depth, for JSON; tuples become lists."""
    if isinstance(value, Mapping):
        return {name: replace_non_finite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [replace_non_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _read(path: Path, about: Mapping[str, Any]) -> list[Record]:
    """Read the records of a file.

    Raises:
        RequestError: The file has other conditions, or cannot be read.
    """
    hint = "delete it, or name another file with --json"
    contents = read_json(path, hint=f"it holds no records to resume; {hint}")
    records = contents.get("each")
    if not isinstance(records, list) or not all(
        isinstance(record, dict) and is_count(record.get("number")) for record in records
    ):
        raise RequestError(f"{path} holds no records to resume: {hint}")
    other = [name for name, value in about.items() if contents.get(name) != value]
    if other:
        name = other[0]
        raise RequestError(
            f"{path} holds records of another evaluation "
            f"({name}: {_shorten(contents.get(name))}, not {_shorten(about[name])}): name another file with --json"
        )
    numbers = [record["number"] for record in records]
    if twice := sorted({number for number in numbers if numbers.count(number) > 1}):
        raise RequestError(f"{path} holds number {twice[0]} twice: {hint}")
    return records


def _shorten(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 60 else f"{text[:57]}..."
