"""How many CPU cores there are to use."""

import os


def cores() -> int:
    """CPU cores this process may use: those it is bound to, where the system can tell, else all of the machine's."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
