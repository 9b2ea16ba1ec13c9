"""Drivers: they convert an episode's observations to actions.

A *driver* receives the environment and the newest `dm_env.TimeStep`, and returns an action within the environment's
`action_spec`. Drivers that use poses serve as references; a policy uses images only.
"""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import dm_env
import numpy as np
from numpy.typing import NDArray

from twin.env.dm import control
from twin.env.options import STEERING
from twin.env.route_follower import PurePursuit
from twin.env.task import check_actions
from twin.errors import InputError, short_repr
from twin.types import Array

Policy = Callable[[NDArray[np.uint8]], NDArray]
"""Maps images (3 · stack, height, width), the newest three channels last, to one number in [-1, 1] per action."""


class Driver(Protocol):
    """Called once per control step; `step.first()` is true at the start of an episode."""

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array: ...


class RouteDriver:
    """Follows the route by `PurePursuit` from poses, at the environment's speed."""

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array:
        task, pose = environment.task, environment.physics.planar_pose
        if step.first():
            self._pursuit = PurePursuit(task.world.route, task.options.speed, task.options.yaw_rate, task.segment.start)
        self._pursuit.update(pose)
        v, yaw_rate = self._pursuit.command(pose)
        return np.array([yaw_rate]) if task.options.action == STEERING else np.array([v, yaw_rate])


class BlindDriver:
    """Drives straight at full speed, regardless of the images."""

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array:
        spec = environment.action_spec()
        return np.array([0.0]) if spec.shape == (1,) else np.array([spec.maximum[0], 0.0])


class PolicyDriver:
    """Drives by a policy."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array:
        pixels = step.observation["pixels"]
        stack, height, width, channels = pixels.shape
        answer = self._policy(pixels.transpose(0, 3, 1, 2).reshape(stack * channels, height, width))
        spec = environment.action_spec()
        try:
            action = check_actions(answer, spec.shape)
        except ValueError:
            raise InputError(
                f"the policy returned {short_repr(answer)}; expected {spec.shape[0]} numbers in [-1, 1]"
            ) from None
        return spec.minimum + (np.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (spec.maximum - spec.minimum)


def find_callable(name: str) -> Policy:
    """Imports the callable `module:function`; the search path includes the working folder.

    Raises:
        InputError: the import failed, or it is not callable.
    """
    module, _, function = name.partition(":")
    if not (module and function):
        raise InputError(f"policy {name!r}: expected module:function, a callable of pixels (3 · stack, h, w)")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(module), function)
    except (Exception, SystemExit) as error:  # importing user code may raise anything
        raise InputError(f"policy {name!r}: {type(error).__name__}: {error}") from error
    if not callable(found):
        raise InputError(f"policy {name!r}: {found!r} cannot be called; expected a function of pixels")
    return found
