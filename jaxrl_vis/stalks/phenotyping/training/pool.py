"""Examples that threads make in the background while a network already learns from those that are there."""

import queue
import threading
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Pool(Generic[T]):
    """Examples, made by threads in the background.

    Attributes:
        examples: Those that are there.
    """

    def __init__(self, sources: list[Iterator[T]], most: int) -> None:
        """Start to make them.

        Args:
            sources: Each is read by a thread of its own.
            most: Greatest number of examples.
        """
        self._queue: queue.Queue[T | Exception | None] = queue.Queue(maxsize=16)
        self._stop = threading.Event()
        self._most, self._running = most, len(sources)
        self.examples: list[T] = []
        # The others follow when the first one has made something, and with it compiled what makes it.
        self._waiting = sources[1:]
        self._threads: list[threading.Thread] = []
        self._start(sources[0])

    def _start(self, source: Iterator[T]) -> None:
        self._threads.append(threading.Thread(target=self._make, args=(source,), daemon=True))
        self._threads[-1].start()

    def _make(self, source: Iterator[T]) -> None:
        try:
            for example in source:
                self._hand_over(example)
                if self._stop.is_set():
                    return
            self._hand_over(None)
        except Exception as error:  # told where the examples are wanted
            self._hand_over(error)

    def _hand_over(self, made: T | Exception | None) -> None:
        while not self._stop.is_set():
            try:
                self._queue.put(made, timeout=0.2)
                return
            except queue.Full:
                continue

    def fill(self, least: int) -> None:
        """Take what is ready, and wait until there are so many, or no more come."""
        while self._running and len(self.examples) < self._most:
            try:
                example = self._queue.get(block=len(self.examples) < least)
            except queue.Empty:
                return
            if isinstance(example, Exception):
                raise example
            while self._waiting:
                self._start(self._waiting.pop())
            if example is None:
                self._running -= 1
                continue
            self.add(example)
        if len(self.examples) >= self._most:
            self.stop()

    def add(self, example: T) -> None:
        """Keep an example."""
        self.examples.append(example)

    def stop(self) -> None:
        """Tell the threads to make no more."""
        self._stop.set()

    def close(self) -> None:
        """End the threads: one that still computes when the program ends would make it crash."""
        self.stop()
        for thread in self._threads:
            thread.join()
