"""Work done ahead of its use, in a second thread: Warp's kernels release the interpreter, so two cores are used."""

import queue
import threading
from collections.abc import Iterator
from types import TracebackType
from typing import Generic, TypeVar

T = TypeVar("T")

_WAIT = 0.2  # [s] between two looks at whether the reader has gone


class Ahead(Generic[T]):
    """Iterates over `items`, which a thread computes up to `depth` items ahead, from the moment of entering the block.

    An exception in the thread is raised where the next item is asked for. Leaving the block stops the thread.
    """

    def __init__(self, items: Iterator[T], depth: int):
        self._items = items
        self._queue: queue.Queue[tuple[bool, T | BaseException | None]] = queue.Queue(max(1, depth))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def _work(self) -> None:
        try:
            for item in self._items:
                self._put((True, item))
                if self._stop.is_set():
                    return
            self._put((False, None))
        except BaseException as error:  # handed on, whatever it is
            self._put((False, error))

    def _put(self, entry: tuple[bool, T | BaseException | None]) -> None:
        while not self._stop.is_set():
            try:
                self._queue.put(entry, timeout=_WAIT)
                return
            except queue.Full:
                continue

    def __enter__(self) -> "Ahead[T]":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def __iter__(self) -> Iterator[T]:
        while True:
            there, item = self._queue.get()
            if not there:
                if isinstance(item, BaseException):
                    raise item
                return
            yield item  # type: ignore[misc]
