"""Who drives: what an episode's observations are turned into actions by.

A *driver* is asked with the environment and the newest `dm_env.TimeStep`, and answers with an action that the
environment's `action_spec` allows. Drivers that are told the poses show what a task is worth; a policy is told
pictures.
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
from twin.env.follower import Pursuit
from twin.env.options import STEERING
from twin.env.tasks import checked_actions
from twin.errors import InputError, shown

Array = NDArray[np.float64]
Policy = Callable[[NDArray[np.uint8]], NDArray]
"""Pictures (3 · stack, height, width), the newest three channels last → numbers in [-1, 1], one per action."""


class Driver(Protocol):
    """Asked once per control step; `step.first()` says that an episode begins."""

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array: ...


class RouteDriver:
    """Follows the route by its poses (`follower.Pursuit`), at the environment's speed."""

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array:
        task, pose = environment.task, environment.physics.planar_pose
        if step.first():
            self._pursuit = Pursuit(task.world.route, task.options.speed, task.options.yaw_rate, task.stretch.start)
        self._pursuit.look(pose)
        v, yaw_rate = self._pursuit.command(pose)
        return np.array([yaw_rate]) if task.options.action == STEERING else np.array([v, yaw_rate])


class BlindDriver:
    """Straight on at full speed, whatever it sees."""

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array:
        spec = environment.action_spec()
        return np.array([0.0]) if spec.shape == (1,) else np.array([spec.maximum[0], 0.0])


class PolicyDriver:
    """Lets a policy drive."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def __call__(self, environment: control.Environment, step: dm_env.TimeStep) -> Array:
        pixels = step.observation["pixels"]
        stack, height, width, three = pixels.shape
        answer = self._policy(pixels.transpose(0, 3, 1, 2).reshape(stack * three, height, width))
        spec = environment.action_spec()
        try:
            action = checked_actions(answer, spec.shape)
        except ValueError:
            raise InputError(
                f"the policy answered {shown(answer)}; expected {spec.shape[0]} numbers in [-1, 1]"
            ) from None
        return spec.minimum + (np.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (spec.maximum - spec.minimum)


def find_callable(name: str) -> Policy:
    """The Python callable `module:function`; modules of the working folder are found.

    Raises:
        InputError: there is none of that name.
    """
    module, _, function = name.partition(":")
    if not (module and function):
        raise InputError(f"policy {name!r}: expected module:function, a callable of pixels (3 · stack, h, w)")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(importlib.import_module(module), function)
    except (Exception, SystemExit) as error:  # whatever the user's own code raises when it is imported
        raise InputError(f"policy {name!r}: {type(error).__name__}: {error}") from error
    if not callable(found):
        raise InputError(f"policy {name!r}: {found!r} cannot be called; expected a function of pixels")
    return found
