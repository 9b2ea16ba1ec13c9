"""Child processes for libraries that may abort the whole process instead of raising."""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Call first in a child: it is killed when its parent dies, so that a killed build leaves no second writer."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() == 1:  # the parent was gone before the call
            os._exit(1)
