"""Options of an environment with their checks, among them the reward's terms (`Rewards`); and the check of actions.

Defaults are those of DriveEnv-NeRF (arXiv 2403.15791) where the paper states them.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from twin.config import STEERING, TRAINING, TWIST, ObstacleConfig
from twin.env.controller import COMMAND_TIMEOUT
from twin.env.domain_randomization import Ranges
from twin.env.picture_effects import CameraOptions
from twin.errors import InputError, name_hint, short_repr
from twin.mjcf.husky import TIMESTEP
from twin.types import Array
from twin.warp_runtime import wp

STATE_SIZES = {"speed": 1, "yaw_rate": 1, "cross_track": 1, "heading_error": 1, "turns": 3, "obstacle": 3}
"""Components of the state and their sizes; see `RewardAndTermination.state`."""

NERF, SIMULATOR, SPLATS = "nerf", "simulator", "splats"
ODOMETRY, PRIVILEGED = "odometry", "privileged"
CPU, CUDA = "cpu", "cuda"


@dataclass(frozen=True)
class Rewards:
    """Reward terms. The last step of an episode gets the term named after the cause of the episode's end.

    A last step at the goal also gets `step`.
    """

    step: float = 0.1
    """Reward of each step that does not end the episode."""
    collision: float = -4.0
    out_of_bounds: float = -5.0
    timeout: float = -5.0
    rollover: float = -5.0
    stuck: float = -5.0
    goal: float = 0.0
    progress: float = 0.0
    """Reward per meter along the route; backward motion counts negative."""
    cross_track: float = 0.0
    """Reward per step at or beyond the corridor's edge; inside, proportional to the distance from the route."""
    steering: float = 0.0
    """Reward per step at the largest yaw rate; it is proportional to the square of the commanded yaw rate."""


@dataclass(frozen=True)
class Options:
    """Everything that defines an environment except its scene and task."""

    rewards: Rewards = dataclasses.field(default_factory=Rewards)
    control_timestep: float = 0.1
    """Time between two actions [s]."""
    size: tuple[int, int] = (160, 90)
    """Width and height of the images [px]."""
    stack: int = 4
    """Number of images in an observation, the newest last."""
    pixels: bool = True
    """True: observations are images; False: they are `RewardAndTermination.state`, which needs no field."""
    state: str | None = None
    """Numbers observed besides the images: `odometry` (speed [m/s], yaw rate [rad/s]), `privileged` (all of
    `RewardAndTermination.state`, which needs the map), or None."""
    action: str = TWIST
    """`twist`: v [m/s] and ω [rad/s]; `steering`: ω [rad/s] only, at a fixed speed."""
    speed: float = 1.0
    """For `twist`, the highest speed [m/s]; for `steering`, the fixed speed [m/s]. A robot whose limit is
    lower drives at its limit."""
    yaw_rate: float = 1.0
    """Largest yaw rate to either side [rad/s]."""
    half_width: float | None = None
    """Half width of the corridor [m]; None: that of the scene."""
    time_limit: float | None = None
    """Time limit [s]; None: twice the time that the route segment takes at `speed`, or 1.5 times that
    at the robot's top speed if that is longer."""
    start_offset: float = 0.3
    """The start's distance from the route is sampled uniformly within ± this [m]."""
    start_heading: float = 10.0
    """The start's heading relative to the route is sampled uniformly within ± this [°]."""
    start_along: float = 0.0
    """If positive, for training: episodes start on the way to the goal, after a fraction of it that is uniform between
    0 and this, up to 0.8 half widths of the corridor beside the route (or `start_offset`, if that is more or 0), turned
    by up to twice `start_heading`, and rolling at `speed`."""
    along_time: float = 3.0
    """With `start_along`, the time after which episodes are cut off (truncated, with an empty cause) [s]."""
    observe: str = NERF
    """Origin of the images. `nerf`: the field. `simulator`: MuJoCo's renderer with the extracted mesh, under MuJoCo's
    lights. `splats`: MuJoCo's renderer with the Gaussian splats of a file; obstacles and robot have MuJoCo's lights."""
    splats: str | Path | None = None
    """3D Gaussian splats (.ply) in the scene's frame (meters, z up), for `observe="splats"`; their light is fixed."""
    lighting: str | Sequence[str] = TRAINING
    """Lighting of the episodes; see `episode_lighting.py`."""
    lighting_drift: bool = False
    """True: the lighting changes during an episode."""
    obstacles: str | int | Sequence[ObstacleConfig] = "scene"
    """`scene`: the obstacles of scene.toml. A number: this many static obstacles, sampled for each episode. A list: the
    obstacles of all episodes."""
    camera: CameraOptions | None = None
    """Camera noise: vibration, exposure, blur. None: no noise."""
    randomise: Ranges | None = None
    """Ranges of robot, weather and distractor objects; True: the default ones; None or False: no randomization."""
    device: str = CPU
    """cpu or cuda; with cuda, fields are rendered and vector environments stepped on the GPU."""


# ---- checks

_MAX_NUMBER, _MAX_SIDE, _MAX_STACK, _MAX_OBSTACLES, _MAX_BLUR_SAMPLES = 1e6, 4096, 64, 1000, 1000

Check = tuple[Callable[[Any], bool], str]
"""A function that returns True for valid values, and the text that describes valid values in an error."""


def _is_number(value: Any) -> bool:
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return real and bool(-_MAX_NUMBER <= value <= _MAX_NUMBER)


def _is_integer(value: Any, low: int, high: int) -> bool:
    return bool(isinstance(value, int | np.integer) and not isinstance(value, bool) and low <= value <= high)


def _is_sequence(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _one_of(*names: str) -> Check:
    return lambda value: isinstance(value, str) and value in names, " or ".join(map(repr, names))


_BOOLEAN: Check = (lambda value: isinstance(value, bool | np.bool_), "True or False")
_NONNEGATIVE: Check = (lambda x: _is_number(x) and x >= 0.0, f"a number from 0 to {_MAX_NUMBER:,.0f}")
_AT_LEAST_001: Check = (lambda x: _is_number(x) and x >= 0.01, f"a number from 0.01 to {_MAX_NUMBER:,.0f}")
_POSITIVE_OR_NONE: Check = (
    lambda x: x is None or (_is_number(x) and x > 0.0),
    f"None, or a number above 0, at most {_MAX_NUMBER:,.0f}",
)

IMAGE_SIZE: Check = (
    lambda size: _is_sequence(size) and len(size) == 2 and all(_is_integer(n, 8, _MAX_SIDE) for n in size),
    f"(width, height), whole numbers from 8 to {_MAX_SIDE}",
)

_CHECKS: dict[str, Check] = {
    "rewards": (
        lambda value: isinstance(value, Rewards) and all(map(_is_number, vars(value).values())),
        f"Rewards, or a dict of numbers, within ±{_MAX_NUMBER:,.0f}",
    ),
    "control_timestep": (
        lambda x: _is_number(x) and 0.01 <= x <= COMMAND_TIMEOUT and abs(x / TIMESTEP - round(x / TIMESTEP)) < 1e-8,
        f"a multiple of {TIMESTEP} [s], the time step of the physics, from 0.01 to {COMMAND_TIMEOUT} [s]: the robot "
        "stops when no command arrives for longer",
    ),
    "size": IMAGE_SIZE,
    "stack": (lambda value: _is_integer(value, 1, _MAX_STACK), f"a whole number from 1 to {_MAX_STACK}"),
    "pixels": _BOOLEAN,
    "state": (
        lambda value: value is None or (isinstance(value, str) and value in (ODOMETRY, PRIVILEGED)),
        f"None, {ODOMETRY!r} or {PRIVILEGED!r}",
    ),
    "action": _one_of(TWIST, STEERING),
    "speed": _AT_LEAST_001,
    "yaw_rate": _AT_LEAST_001,
    "half_width": _POSITIVE_OR_NONE,
    "time_limit": _POSITIVE_OR_NONE,
    "start_offset": _NONNEGATIVE,
    "start_heading": _NONNEGATIVE,
    "start_along": (lambda x: _is_number(x) and 0.0 <= x < 1.0, "0 or more, and less than 1"),
    "along_time": (lambda x: _is_number(x) and x > 0.0, f"a number above 0, at most {_MAX_NUMBER:,.0f}"),
    "observe": _one_of(NERF, SIMULATOR, SPLATS),
    "splats": (lambda value: value is None or (isinstance(value, str | Path) and str(value) != ""), "a path, or None"),
    "lighting": (
        lambda value: (
            isinstance(value, str)
            or (isinstance(value, Sequence) and len(value) > 0 and all(isinstance(name, str) for name in value))
        ),
        "a name, or a list of names",
    ),
    "lighting_drift": _BOOLEAN,
    "obstacles": (
        lambda value: (
            (isinstance(value, str) and value == "scene")
            or (_is_sequence(value) and all(isinstance(one, ObstacleConfig) for one in value))
            or _is_integer(value, 0, _MAX_OBSTACLES)
        ),
        f"'scene', a whole number from 0 to {_MAX_OBSTACLES}, or a list of ObstacleConfig",
    ),
    "camera": (
        lambda value: (
            value is None
            or (
                isinstance(value, CameraOptions)
                and all(_is_number(x) and x >= 0.0 for x in (value.vibration, value.exposure, value.shutter))
                and _is_integer(value.blur_samples, 1, _MAX_BLUR_SAMPLES)
            )
        ),
        f"None, or CameraOptions of numbers from 0 to {_MAX_NUMBER:,.0f}, with 1 to {_MAX_BLUR_SAMPLES} blur_samples",
    ),
    "randomise": (lambda value: value is None or isinstance(value, Ranges), "True, False, None or Ranges"),
    "device": _one_of(CPU, CUDA),
}


def parse_options(given: dict[str, Any]) -> Options:
    """Returns options from keywords.

    Raises:
        InputError: a keyword is unknown, or a value has the wrong type or is out of range.
    """
    given = dict(given)
    if isinstance(given.get("randomise"), bool):
        given["randomise"] = Ranges() if given["randomise"] else None
    if isinstance(given.get("obstacles"), np.integer):
        given["obstacles"] = int(given["obstacles"])
    if isinstance(given.get("rewards"), dict):
        given["rewards"] = _from_keywords(Rewards, given["rewards"], "reward")
    options = _from_keywords(Options, given, "option")
    for name in _CHECKS:
        check_option(name, getattr(options, name), _CHECKS[name])
    if (options.observe == SPLATS) != (options.splats is not None):
        raise InputError(
            f"observe = {options.observe!r}, splats = {short_repr(options.splats)}; expected both observe='splats' and "
            "splats='road.ply', or neither"
        )
    if options.state is not None and not options.pixels:
        raise InputError(f"state = {options.state!r} with pixels=False: the state is observed anyway; leave state out")
    if options.device == CUDA and not wp.is_cuda_available():
        raise InputError(f"device = {CUDA!r}: no CUDA device is visible to warp; use device={CPU!r}")
    return options


def state_size(options: Options) -> int:
    """Number k of components of the privileged state that are observed besides images: its first k."""
    return {None: 0, ODOMETRY: 2}.get(options.state, sum(STATE_SIZES.values()))


def check_option(name: str, value: Any, check: Check) -> None:
    """Raises InputError: the value is not valid."""
    is_valid, expectation = check
    if not is_valid(value):
        raise InputError(f"{name} = {short_repr(value)}; expected {expectation}")


def _from_keywords(kind: type, given: dict[str, Any], what: str) -> Any:
    names = [field.name for field in dataclasses.fields(kind)]
    for name in given:
        if name not in names:
            hint = name_hint(name, names, f"there are {', '.join(names)}")
            raise InputError(f"unknown {what} {name!r}; {hint}")
    return kind(**given)


def check_actions(actions: Any, shape: tuple[int, ...]) -> Array:
    """Returns actions as float64.

    Raises:
        ValueError: the shape is wrong, or the values are not finite real numbers (booleans are not accepted).
    """
    try:
        given = np.asarray(actions)
    except (TypeError, ValueError):  # ragged lists
        given = np.empty(0, object)
    if given.dtype.kind not in "iuf" or given.shape != shape or not np.isfinite(given).all():
        kind = f"{given.dtype} of shape {given.shape}"
        raise ValueError(f"action {short_repr(actions)} ({kind}); expected finite numbers of shape {shape}")
    return given.astype(np.float64, copy=False)
