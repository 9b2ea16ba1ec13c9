"""How many CPU cores there are to use."""

import os
from functools import cache
from pathlib import Path

_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_most: int | None = None


def use(most: int) -> None:
    """This process is one of several that share the cores: it uses so many of them."""
    global _most
    _most = most


def cores() -> int:
    """CPU cores this process may use: those it is bound to, where the system can tell, else all of the machine's; no
    more than its container is allowed."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(there, _most or there, _quota() or there)


@cache
def _quota() -> int | None:
    """Of a container's processor time (Linux control groups 2), in whole cores; None: no bound."""
    try:
        quota, period = _QUOTA.read_text(encoding="ascii").split()
    except (OSError, ValueError):
        return None
    return None if quota == "max" else max(1, round(int(quota) / int(period)))
