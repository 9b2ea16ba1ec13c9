"""dm_control's control loop, or one line that says why there is none."""

import sys

from twin.errors import InputError

try:
    from dm_control.rl import control
except ModuleNotFoundError as error:
    raise InputError(
        f"{error}: to drive in a scene needs dm_control, which installs on Python 3.11 and 3.12; this is "
        f"{sys.version_info.major}.{sys.version_info.minor}"
    ) from None

__all__ = ["control"]
