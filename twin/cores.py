"""How many CPU cores there are to use."""

import os

_most: int | None = None


def use(most: int) -> None:
    """This process is one of several that share the cores: it uses so many of them."""
    global _most
    _most = most


def cores() -> int:
    """CPU cores this process may use: those it is bound to, where the system can tell, else all of the machine's."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(there, _most or there)
