"""Peak memory of this process and everything it started, sampled while a block runs."""

import threading
from types import TracebackType

import psutil

_PERIOD = 0.2  # [s]


class PeakMemory:
    """Context manager; `bytes` is the largest sum of resident sizes seen (shared pages count in each process)."""

    def __init__(self) -> None:
        self.bytes = 0
        self._stop = threading.Event()
        self._process = psutil.Process()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "PeakMemory":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self._stop.set()
        self._thread.join()

    def _watch(self) -> None:
        while True:
            total = 0
            for process in (self._process, *self._process.children(recursive=True)):
                try:
                    total += process.memory_info().rss
                except psutil.Error:
                    continue  # it ended between the listing and the look
            self.bytes = max(self.bytes, total)
            if self._stop.wait(_PERIOD):
                return
