"""When the poses of a log were measured, told from when they got into it.

A sensor of poses measures at a steady rate, but what it measures gets into the log sooner or later: from a fresh pose
to the next a robot moves as far after 0.05 s as after 0.15 s (DRIVE's log: within windows that turn, yaw is smooth to
0.3° over the number of fresh poses, to 0.7° over when they appeared). So the n-th measurement counts as of n periods
after the first one. Where fresh poses are later for good by more than half a period, some were lost. The first one
may be older than the window, by at most `OLDEST`.

Windows that disagree with their log's period by more than a late delivery explains count as they appeared, and their
first pose as older than the next by as much as those are apart; so do all of a log in which many do, or of a fast
sensor. All times are in samples; a window starts at 0.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes

Array = NDArray[np.float64]

OLDEST = 20  # samples that the first pose of a window may have been measured before its start, at most

_FAST = 1.75  # samples; sensors of a shorter period tell more by when their poses appear than by how many did
_JITTER = 4  # samples, at most, between when a pose was measured and when it appeared, but for what is common to all
_UNSTEADY = 0.1  # share of windows that disagree with their log's period by more, from which on there is none


def measured(fresh: NDArray[np.bool_]) -> Array:
    """When every pose of a log's windows was measured [samples], shape (n, k + 1).

    Args:
        fresh: Which poses but the first differ from the one before, shape (n, k).
    """
    appeared = [np.flatnonzero(row).astype(np.float64) + 1 for row in fresh]
    slopes = [theilslopes(each).slope for each in appeared if len(each) > 1]
    period = float(np.median(slopes)) if slopes else 1.0
    times = [_steady(each, period) for each in appeared]
    both = zip(times, appeared, strict=True)
    stray = np.array([np.abs(time[1:] - each).max(initial=0.0) > _JITTER for time, each in both], bool)
    if period < _FAST or stray.sum() > _UNSTEADY * len(stray):
        stray[:] = True
    out = np.zeros((len(fresh), fresh.shape[1] + 1))
    for i, each in enumerate(appeared):
        if len(each):
            time = _as_appeared(each, period) if stray[i] else times[i]
            out[i] = time[np.append(0, np.cumsum(fresh[i]))]
    return out


def _steady(appeared: Array, period: float) -> Array:
    """When a window's first pose and its fresh ones were measured by a steady sensor.

    Args:
        appeared: When fresh poses did.
        period: Of the sensor.
    """
    if not len(appeared):
        return np.zeros(1)
    number = np.arange(1.0, len(appeared) + 1)
    lost = np.maximum(0.0, np.ceil((appeared - appeared[0]) / period - number + 0.5))
    number += np.minimum.accumulate(lost[::-1])[::-1]  # what comes late, but comes, was not lost
    start = float(np.median(appeared - period * number))
    if start > period / 2:  # the robot rested, or as many were lost at first
        first = start - period * np.ceil(start / period)
    else:  # there was a pose when the window began
        first = start = min(start, 0.0)
    first = max(first, -OLDEST)
    return np.append(first, np.maximum(first, start + period * number))


def _as_appeared(appeared: Array, period: float) -> Array:
    """The same, by any other sensor; the period stands in where one fresh pose does not tell how far they are apart."""
    apart = float(np.median(np.diff(appeared))) if len(appeared) > 1 else period
    return np.append(max(min(float(appeared[0]) - apart, 0.0), -OLDEST), appeared)
