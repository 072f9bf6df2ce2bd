"""Many numbered things, such as synthetic plots, evaluated in processes side by side; what is evaluated already is left out.

    kept = Kept(path, about, summary)                     # the file goes on where it was, if it is about the same
    missing = [number for number in numbers if number not in kept]
    evaluate_each(function, missing, workers, kept.add)   # function(number) -> record; kept.add writes the file

Records are what JSON can hold. What one says must depend on its number alone: then it is the same with any number of workers.
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
import time
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, TypeVar

from jaxrl_vis.errors import RequestError, WorkerError
from jaxrl_vis.files import read_json, write_atomically
from jaxrl_vis.run.signals import heed_parent_only, shielded_children
from jaxrl_vis_envs.cores import num_cores

Record = dict[str, Any]
"""What is kept of one number."""
A = TypeVar("A")
T = TypeVar("T")

# What limits the threads of NumPy, SciPy, OpenCV and XLA in a process.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC")


def evaluate_each(
    evaluate: Callable[[int], Record], numbers: Iterable[int], workers: int, done: Callable[[int, Record], None]
) -> None:
    """Evaluates numbers, in this process or in several.

    Args:
        evaluate: From a number to its record. With more than one worker it is pickled: a function of a module, or a
            `functools.partial` of one.
        numbers: What to evaluate.
        workers: How many processes; 1 for this one. They share the GPUs and the cores of the machine.
        done: Called in this process with each number and its record, in the order in which they are finished.

    Raises:
        WorkerError: A process was ended from outside, most likely as the memory was used up.
    """
    numbers = list(numbers)
    with processes(min(workers, len(numbers))) as each:
        for number, record in each(functools.partial(_numbered, evaluate), numbers):
            done(number, record)


def _numbered(evaluate: Callable[[int], Record], number: int) -> tuple[int, Record]:
    return number, evaluate(number)


def results_of(function: Callable[[A], T], arguments: Iterable[A], workers: int) -> Generator[T]:
    """Results of arguments, of which there may be no end, in the order in which they are finished.

    Args:
        function: From an argument to its result. With more than one worker both are pickled.
        arguments: What to call it with.
        workers: How many processes; 1 for this one. They are ended with the iterator.

    Raises:
        WorkerError: A process was ended from outside, most likely as the memory was used up.
    """
    with processes(workers) as each:
        yield from each(function, arguments)


class Each(Protocol):
    """Calls a function with arguments, in several processes or in this one; results come as they are finished."""

    def __call__(self, function: Callable[[A], T], arguments: Iterable[A]) -> Iterator[T]: ...  # noqa: D102


@contextlib.contextmanager
def processes(workers: int) -> Iterator[Each]:
    """Processes that share the GPUs and cores; after an error they are ended at once, and with this process however it ends.

    Args:
        workers: How many; 1 or less for this one.

    Raises:
        WorkerError: One was ended from outside, most likely as the memory was used up.
    """
    if workers < 2:
        yield lambda function, arguments: map(function, arguments)
        return
    spawning = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with shielded_children():  # starts multiprocessing's own helper
        counter = spawning.Value("i", 0)
    pool = ProcessPoolExecutor(workers, mp_context=spawning, initializer=_prepare, initargs=(counter, _environments(workers)))

    def submit(function: Callable[[A], T], argument: A) -> Future[T]:
        with shielded_children():  # a process may be started, and this one alone ends it: see `_prepare`
            return pool.submit(function, argument)

    def each(function: Callable[[A], T], arguments: Iterable[A]) -> Iterator[T]:
        arguments = iter(arguments)
        # Two each, so that none waits for this process.
        waiting = {submit(function, argument) for argument in itertools.islice(arguments, 2 * workers)}
        while waiting:
            ready, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            waiting |= {submit(function, argument) for argument in itertools.islice(arguments, len(ready))}
            for result in ready:
                yield result.result()

    try:
        yield each
    except BrokenProcessPool as error:
        raise WorkerError(
            f"one of {workers} processes was ended from outside, most likely for want of memory: use fewer --workers"
        ) from error
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        children = set(multiprocessing.active_children()) - others
        for child in children:
            child.kill()
        _wait_for(children, 5.0)
        raise
    pool.shutdown()


def _wait_for(children: Collection[BaseProcess], seconds: float) -> None:
    """Waits until children have ended, but no longer than so many seconds.

    `BaseProcess.join` would return too soon at times: the pool's own thread waits for its processes, too, and of two threads
    only one is told by the system how a process ended; the other takes it for one that runs until the first has noted it.
    """
    deadline = time.monotonic() + seconds
    while any(child.is_alive() for child in children) and time.monotonic() < deadline:
        time.sleep(0.01)


def share_accelerator() -> None:
    """Lets this process take memory of a GPU as it needs it, so that others find some; to be called before JAX is used."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")


def _environments(workers: int) -> list[dict[str, str]]:
    """Variables of each worker: its GPU, if there are several, and how many threads it may have."""
    import jax

    from jaxrl_vis.devices import list_devices

    devices = list_devices()
    threads = dict.fromkeys(_THREADS, str(max(num_cores() // workers, 1)))
    # Workers open no window; importing MuJoCo would start another process that looks for GLFW, and outlives its worker.
    share = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "disable")}
    if cache := jax.config.jax_compilation_cache_dir:  # one compiles for all
        share["JAX_COMPILATION_CACHE_DIR"] = cache
    return [{**threads, **share, **devices[index % len(devices)].environment} for index in range(workers)]


def _end_with_parent() -> None:
    """Waits until the process that started this one is gone, killed for instance: nobody wants what is computed here then."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _prepare(counter: Any, environments: list[dict[str, str]]) -> None:
    """Makes a new process one of several."""
    heed_parent_only()  # both would otherwise be interrupted at once, by a signal to all of them
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with counter.get_lock():
        index = counter.value
        counter.value += 1
    variables = environments[index % len(environments)]
    os.environ.update(variables)
    try:
        import cv2
    except ImportError:
        return
    cv2.setNumThreads(int(variables[_THREADS[0]]))


def code_of(*packages: ModuleType, leave_out: tuple[str, ...] = ()) -> str:
    """What tells apart versions of the code that records come from: 12 hexadecimal digits.

    Args:
        packages: Whose files count.
        leave_out: Names of files, and of folders, that change no record.
    """
    digest = hashlib.sha256()
    for package in packages:
        folder = Path(str(package.__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            name = path.relative_to(folder)
            if not set(leave_out) & set(name.parts):
                digest.update(name.as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


class Kept:
    """A JSON file of records: what they are about, what they say together, and a line for each number.

    Attributes:
        records: Of each number.
    """

    def __init__(self, path: Path | None, about: Mapping[str, Any], summary: Callable[[list[Record]], Mapping[str, Any]]):
        """Reads the file, if there is one that is about the same.

        Args:
            path: The file; None to keep records in memory alone.
            about: Under what conditions numbers are evaluated.
            summary: What records, in the order of their numbers, say together.

        Raises:
            RequestError: The file is about something else, or cannot be read.
        """
        self.records: dict[int, Record] = {}
        self._path, self._about, self._summary = path, json.loads(json.dumps(finite(about))), summary
        self._lines: dict[int, str] = {}
        if path is not None and path.exists():
            for record in _read(path, self._about):
                self._keep(record["number"], record)
            self._check(path)

    def __contains__(self, number: int) -> bool:
        return number in self.records

    def add(self, number: int, record: Record) -> None:
        """Keeps what came of a number, and writes the file."""
        self.add_all({number: record})

    def add_all(self, records: Mapping[int, Record]) -> None:
        """Keeps what came of several numbers, and writes the file once."""
        for number, record in records.items():
            self._keep(number, {"number": number, **record})
        self.write()

    def write(self) -> None:
        """Writes the file."""
        if self._path is None:
            return
        ordered = sorted(self.records)
        figures = finite({**self._about, **self._summary([self.records[number] for number in ordered])})
        head = json.dumps(figures, indent=2)
        lines = ",\n".join(f"    {self._lines[number]}" for number in ordered)
        write_atomically(self._path, f'{head[:-2]},\n  "each": [\n{lines}\n  ]\n}}\n')

    def _check(self, path: Path) -> None:
        """Raises a RequestError where records that were read are not such as they were written."""
        try:
            self._summary([self.records[number] for number in sorted(self.records)])
        except Exception as error:  # whatever comes of computing with what somebody has changed
            raise RequestError(
                f"{path} holds a damaged record ({type(error).__name__}: {error}): delete it, or name another file with --json"
            ) from error

    def _keep(self, number: int, record: Record) -> None:
        record = finite(record)
        # What is computed from a record must not depend on whether it was read from the file.
        line = json.dumps(record, allow_nan=False)
        self.records[number], self._lines[number] = json.loads(line), line


def finite(value: Any) -> Any:
    """What JSON can hold: None in place of what is not a number, however deep."""
    if isinstance(value, Mapping):
        return {name: finite(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _read(path: Path, about: Mapping[str, Any]) -> list[Record]:
    """The records of a file.

    Raises:
        RequestError: It is about something else, or cannot be read.
    """
    mend = "delete it, or name another file with --json"
    found = read_json(path, mend=f"it holds no records to go on with; {mend}")
    records = found.get("each")
    if not isinstance(records, list) or not all(isinstance(each, dict) and _is_count(each.get("number")) for each in records):
        raise RequestError(f"{path} holds no records to go on with: {mend}")
    other = [name for name, value in about.items() if found.get(name) != value]
    if other:
        name = other[0]
        raise RequestError(
            f"{path} holds records of another evaluation ({name}: {_short(found.get(name))}, not {_short(about[name])}): "
            "name another file with --json"
        )
    numbers = [each["number"] for each in records]
    if twice := sorted({number for number in numbers if numbers.count(number) > 1}):
        raise RequestError(f"{path} holds number {twice[0]} twice: {mend}")
    return records


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 60 else f"{text[:57]}..."
