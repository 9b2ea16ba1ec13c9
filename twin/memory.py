"""Peak memory of this process and everything it started, sampled while a block runs."""

import threading
from types import TracebackType

import psutil

_PERIOD = 0.2  # [s]


def resident() -> int:
    """Sum of the resident sizes of this process and everything it started; shared pages count in each [bytes]."""
    this, total = psutil.Process(), 0
    for process in (this, *this.children(recursive=True)):
        try:
            total += process.memory_info().rss
        except psutil.Error:
            continue  # it ended between the listing and the look
    return total


class PeakMemory:
    """Context manager; `bytes` is the largest `resident()` seen."""

    def __init__(self) -> None:
        self.bytes = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "PeakMemory":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            self.bytes = max(self.bytes, resident())
            if self._stop.wait(_PERIOD):
                return
