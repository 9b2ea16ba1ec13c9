"""The judge of a trial on the road decides when the trial ends, and why: goal, collision, timeout, ...

It uses the task's numbers and the robot's position, tilt and contact, and shares no code with the twin's
`RewardAndTermination`. A test compares the two on a thousand paths.
"""

from bisect import bisect_left, bisect_right
from math import hypot

from twin.reality.road_task import RoadTask

_BEHIND, _AHEAD = 1.5, 4.0  # [m] range of the search for the nearest point: behind and ahead of the previous one


class RealJudge:
    """Judges one trial at a time."""

    def __init__(self, task: RoadTask) -> None:
        self._task = task
        self._points = task.line.tolist()
        self._knots = task.knots.tolist()

    def begin(self, x: float, y: float) -> None:
        """Starts a trial at a position [m]."""
        self.cause = ""
        """Cause of the trial's end, one of `twin.config.CAUSES`; empty while it goes on."""
        self.station, self.offset = self._task.start, 0.0
        """Station of the nearest point of the line, and the distance from that point, positive to its left [m]."""
        self._locate(x, y)
        self._rested, self._since = (x, y), 0.0

    def see(self, x: float, y: float, tilt: float, touched: bool, time: float) -> str:
        """Takes the robot's state once per control step; returns the cause of the trial's end, empty while it goes on.

        Args:
            x: Position of the base [m].
            y: Position of the base [m].
            tilt: Angle between the robot's and the world's up axes [rad].
            touched: True if the robot has touched an object.
            time: Time since the start [s].
        """
        task = self._task
        self._locate(x, y)
        distance, patience = task.stuck
        if hypot(x - self._rested[0], y - self._rested[1]) > distance:
            self._rested, self._since = (x, y), time
        if tilt > task.max_tilt:
            self.cause = "rollover"
        elif touched:
            self.cause = "collision"
        elif abs(self.offset) > task.half_width:
            self.cause = "out_of_bounds"
        elif self.station >= task.goal:
            self.cause = "goal"
        elif time > task.time_limit - 1e-6:
            self.cause = "timeout"
        elif time - self._since >= patience:
            self.cause = "stuck"
        return self.cause

    @property
    def progress(self) -> float:
        """Distance along the line from the task's start [m]."""
        return self.station - self._task.start

    def _locate(self, x: float, y: float) -> None:
        """Finds the nearest point of the line within the search range around the previous one."""
        low, high = self.station - _BEHIND, self.station + _AHEAD
        best = (float("inf"), self.station, 0.0)
        first = max(bisect_left(self._knots, low) - 1, 0)
        for k in range(first, min(bisect_right(self._knots, high), len(self._points) - 1)):
            (ax, ay), (bx, by) = self._points[k], self._points[k + 1]
            dx, dy = bx - ax, by - ay
            squared = dx * dx + dy * dy
            share = min(max(((x - ax) * dx + (y - ay) * dy) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
            away = hypot(x - ax - share * dx, y - ay - share * dy)
            if away < best[0]:
                left = dx * (y - ay) - dy * (x - ax)
                best = (away, self._knots[k] + share * (self._knots[k + 1] - self._knots[k]), left)
        self.station, self.offset = best[1], best[0] if best[2] >= 0.0 else -best[0]
