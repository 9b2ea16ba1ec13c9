"""The pilot turns pictures into commands by a policy, and stops the robot when something is wrong.

As in twin's environment, a policy sees a stack of the last few pictures, `timestep` apart, the newest last; the first
picture after standing fills the whole stack. Pictures that come faster are skipped. A *stop* is a command of zeros
with a *cause*. A stop empties the stack, and the robot rests before the next picture counts as the first of an episode.

A pilot has two clocks: `clock`, which also stamps the pictures, and `steady`, which never jumps; in a simulation both
are the simulated time. Both return nanoseconds. A pilot is not thread-safe.
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from twin_policy.onnx_policy import OnnxPolicy
from twin_policy.pictures import Camera, PictureError, Rectifier

Clock = Callable[[], int]

WAITING = "waiting for a picture"
DEADMAN = "deadman switch is not held"


@dataclass(frozen=True)
class Limits:
    """Limits beyond which the robot stops. Raises ValueError: a value out of range."""

    timeout: float = 0.3
    """Largest age of the newest picture behind a command [s]; 0.3 s tolerates one lost picture at 10 Hz."""
    inference: float = 0.1
    """Longest time from a picture's arrival to its command [s]."""
    ahead: float = 0.05
    """Largest time by which a stamp may be ahead of the clock [s]."""
    clock_jump: float = 0.05
    """Largest sudden change of `clock` relative to `steady` [s]."""
    early: float = 0.25
    """Largest time by which a picture may come before its control step [control steps]."""
    rest: float = 1.0
    """Shortest duration of a stop [s], in which the robot comes to rest, as at the start of an episode."""
    deadman: float = 0.0
    """Time for which one press of the deadman switch holds [s]; 0: there is no switch."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            low = 0.0 if field.name in ("early", "rest", "deadman") else 0.001
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= 10.0:
                raise ValueError(f"{field.name} = {value!r}; expected {low:g} to 10")
        if not self.early < 0.5:
            raise ValueError(f"early = {self.early!r}; expected less than 0.5 control steps")


@dataclass(frozen=True)
class Command:
    """A command, or the cause of a stop."""

    v: float = 0.0
    """[m/s]"""
    yaw_rate: float = 0.0
    """To the left [rad/s]."""
    cause: str = ""
    """Why the robot stops; empty while it drives."""
    stamp: int = 0
    """Stamp of the newest picture behind a driving command [ns]."""

    @property
    def drives(self) -> bool:
        return not self.cause


class Pilot:
    """Drives a robot by one policy and one camera."""

    def __init__(
        self,
        policy: OnnxPolicy,
        limits: Limits | None = None,
        pinhole: Camera | None = None,
        clock: Clock = time.time_ns,
        steady: Clock = time.monotonic_ns,
    ) -> None:
        """
        Args:
            policy: Determines the pictures' size, the stack and the control step.
            limits: None: the defaults.
            pinhole: The camera that the policy was trained with; None: the policy's own; if it has none, the robot's,
                without distortion, scaled to the policy's width.
            clock: Clock of the pictures' stamps [ns].
            steady: A clock that never jumps [ns].
        """
        self.policy, self.limits = policy, limits or Limits()
        self.counts: Counter[str] = Counter()
        """Numbers of stops, and of pictures that were used, between (two control steps), doubled, reordered, late,
        lost, waiting (during a stop) or refused."""
        self.duration = 0.0
        """Time from the arrival of the last used picture to its command [s]."""
        self._pinhole, self._clock, self._steady = pinhole or policy.camera, clock, steady
        self._rectifier: Rectifier | None = None
        self.no_camera = "no camera_info, so pictures cannot be rectified"
        """Cause of the stop while there is no valid camera."""
        self._offset: int | None = None  # clock − steady [ns]
        self._pressed = 0
        self._is_held = False
        self._last = self._rest_until = steady()
        self._command = Command(cause=WAITING)
        self.stack = np.zeros((0, 3, policy.size[1], policy.size[0]), np.uint8)
        """The last pictures, uint8 (0 or stack, 3, height, width), the newest last; empty after a stop."""
        self._newest: int | None = None  # stamp of the newest picture
        self._due = 0  # stamp at which the next picture is wanted
        self._used = 0  # stamp of the newest picture in the stack

    @property
    def has_camera(self) -> bool:
        """False while there is no valid camera; then `no_camera` says why."""
        return self._rectifier is not None

    # ---- inputs

    def set_camera(self, camera: Camera) -> None:
        """Sets the camera that takes the pictures; does nothing if it is the present one.

        Raises PictureError: see `Rectifier`.
        """
        if self._rectifier is not None and self._rectifier.camera == camera:
            return
        if self._rectifier is not None:
            self._stop("the camera's calibration changed")
        pinhole = self._pinhole or camera.without_distortion().resized(self.policy.size)
        self._rectifier = None
        try:
            self._rectifier = Rectifier(camera, pinhole)
        except PictureError as error:
            self.no_camera = str(error)
            raise

    def lose_camera(self, cause: str) -> None:
        """Forgets the camera and stops the robot, which waits until a valid one is set; the stop has this cause."""
        self.no_camera = cause
        if self._rectifier is not None:
            self._rectifier = None
            self._stop(cause)

    def press(self, held: bool = True) -> None:
        """Handles a message of the deadman switch; has no effect if there is none."""
        if held:
            self._pressed = self._steady()
            if self._command.cause == DEADMAN:
                self._command = Command(cause=WAITING)
        self._is_held = held
        self._may_drive()

    def picture(self, picture: Any, stamp: int) -> Command:
        """Handles a picture with its stamp [ns]: an object with `decode()`, such as RawPicture, or RGB uint8 (h, w, 3).

        Returns the command that holds now. If the picture was used, the command is new and has the picture's `stamp`.
        """
        begin = self._steady()
        if not self._may_drive():
            self.counts["waiting"] += 1
            return self.command()
        if not self._is_in_order(stamp):
            return self.command()
        step = self._nanoseconds(self.policy.timestep)
        wanted = max(self._due - int(self.limits.early * step), self._used + step // 2)
        if len(self.stack) and stamp < wanted:
            self.counts["between"] += 1
            return self.command()
        if self._rectifier is None:
            self.counts["waiting"] += 1
            return self._stop(self.no_camera, rest=False)
        try:
            decoded = picture if isinstance(picture, np.ndarray) else picture.decode()
            newest = self._rectifier(decoded).transpose(2, 0, 1)
        except PictureError as error:
            self.counts["refused"] += 1
            return self._stop(str(error))
        self._push(newest, stamp, step)
        try:
            v, yaw_rate = self.policy.command(np.ascontiguousarray(self.stack).reshape(self.policy.stack_shape))
        except Exception as error:  # whatever the network's runtime raises, the robot stops
            return self._stop(str(error).splitlines()[0] if str(error) else type(error).__name__)
        took = self._steady() - begin
        self.duration = took * 1e-9
        self.counts["used"] += 1
        if took > self._nanoseconds(self.limits.inference):
            return self._stop(f"inference took {self.duration:.3f} s; expected at most {self.limits.inference:g}")
        self._command = Command(v, yaw_rate, "", stamp)
        return self.command()

    # ---- output

    def command(self) -> Command:
        """The command that holds now; a stop if the newest picture is too old. Call it regularly."""
        if self._may_drive() and self._command.drives:
            age = self._clock() - self._command.stamp
            if age > self._nanoseconds(self.limits.timeout):
                self._stop(f"newest picture is {age * 1e-9:.2f} s old; expected at most {self.limits.timeout:g}")
        return self._command

    # ---- state

    def _may_drive(self) -> bool:
        """False while the robot has to stand. Also stops it if a clock jumped or the deadman switch is not held."""
        steady = self._steady()
        offset = self._clock() - steady
        jump = 0 if self._offset is None else offset - self._offset
        jump = min(steady - self._last, 0) or jump  # simulated time, which is both clocks, may go back
        self._last, self._offset, self._pressed = steady, offset, min(self._pressed, steady)
        if abs(jump) > self._nanoseconds(self.limits.clock_jump):
            self._stop(f"the clock jumped by {jump * 1e-9:+.2f} s")
        if self.limits.deadman and self._is_held:
            self._is_held = steady - self._pressed <= self._nanoseconds(self.limits.deadman)
        if self.limits.deadman and not self._is_held and self._command.cause != DEADMAN:
            self._stop(DEADMAN, rest=self._command.drives)
        return steady >= self._rest_until and (self._is_held or not self.limits.deadman)

    def _is_in_order(self, stamp: int) -> bool:
        """True if a picture is newer than all before, and neither late nor from the future."""
        if self._newest is not None and stamp <= self._newest:
            self.counts["doubled" if stamp == self._newest else "reordered"] += 1
            return False
        age = self._clock() - stamp
        seconds = abs(age) * 1e-9
        if age > self._nanoseconds(self.limits.timeout):
            self.counts["late"] += 1
            if not self._command.drives:  # a driving command has an older picture, so it expires by itself
                self._command = Command(
                    cause=f"pictures are {seconds:.2f} s old; expected at most {self.limits.timeout:g}"
                )
            return False
        if -age > self._nanoseconds(self.limits.ahead):
            self.counts["refused"] += 1
            self._stop(f"a picture's stamp is {seconds:.2f} s ahead of the clock; synchronize the camera's clock")
            return False
        self._newest = stamp
        return True

    def _push(self, newest: np.ndarray, stamp: int, step: int) -> None:
        if len(self.stack):
            lost = round((stamp - self._used) / step) - 1
            if lost > 0:
                self.counts["lost"] += lost
            self.stack = np.concatenate([self.stack[1:], newest[None]])
        else:
            self.stack = np.repeat(newest[None], self.policy.stack, 0)
            self._due = stamp
        # Pictures are due on a grid of control steps, since the camera's rate need not be a multiple of the policy's.
        # After a missed step, the grid starts again.
        self._due += step
        if self._due <= stamp:
            self._due = stamp + step
        self._used = stamp

    def _stop(self, cause: str, rest: bool = True) -> Command:
        if rest and (self._command.drives or self._command.cause != cause):
            self.counts["stops"] += 1
        if rest:
            self._rest_until = self._steady() + self._nanoseconds(self.limits.rest)
        self.stack, self._newest = self.stack[:0], None
        self._command = Command(cause=cause)
        return self._command

    @staticmethod
    def _nanoseconds(seconds: float) -> int:
        return round(seconds * 1e9)
