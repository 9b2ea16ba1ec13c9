"""Options of an environment. Defaults are those of DriveEnv-NeRF (arXiv 2403.15791) where the paper states them."""

import dataclasses
import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from twin.config import TRAINING, ObstacleConfig
from twin.env.camera_noise import CameraOptions
from twin.env.controller import COMMAND_TIMEOUT
from twin.env.domain_randomization import Ranges
from twin.errors import InputError, short_repr
from twin.types import Array
from twin.warp_runtime import wp

CAUSES = ("goal", "collision", "out_of_bounds", "timeout", "rollover", "stuck")
"""Causes of an episode's end, in the order of tables. `RewardAndTermination` decides which one takes precedence."""

TWIST, STEERING = "twist", "steering"
NERF, SIMULATOR = "nerf", "simulator"
CPU, CUDA = "cpu", "cuda"


@dataclass(frozen=True)
class Rewards:
    """Reward terms. The last step of an episode earns the term of its cause; the goal earns `step` as well."""

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
    """Reward per step, times the distance from the route as a fraction of the corridor's half width; a penalty if
    negative."""
    steering: float = 0.0
    """Reward per step, times the square of the commanded yaw rate as a fraction of the largest; a penalty if
    negative."""


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
    """Observe images; otherwise the state of `DriveTask.get_observation`, which is fast and needs no field."""
    action: str = TWIST
    """twist (v [m/s], ω [rad/s]) or steering (ω [rad/s] at fixed speed)."""
    speed: float = 1.0
    """Highest speed of a twist; the fixed speed for steering [m/s]."""
    yaw_rate: float = 1.0
    """Largest yaw rate to either side [rad/s]."""
    half_width: float | None = None
    """Half width of the corridor [m]; None: the scene's."""
    time_limit: float | None = None
    """Time limit [s]; None: twice the time that the route segment takes at `speed`."""
    start_offset: float = 0.3
    """The start's distance from the route is uniform within ± this [m]."""
    start_heading: float = 10.0
    """The start's heading relative to the route is uniform within ± this [°]."""
    start_along: float = 0.0
    """Half of the episodes start further along, uniform up to this fraction of the route segment."""
    observe: str = NERF
    """nerf: images of the field; simulator: MuJoCo's images of the extracted mesh, under MuJoCo's lights."""
    lighting: str | Sequence[str] = TRAINING
    """See `episode_lighting.py`."""
    lighting_drift: bool = False
    """The lighting changes during an episode."""
    obstacles: str | int | Sequence[ObstacleConfig] = "scene"
    """`scene`: those of scene.toml; a number: as many static ones, sampled for every episode; or these."""
    camera: CameraOptions | None = None
    """Camera noise: vibration, exposure, blur. None: no noise."""
    randomise: Ranges | None = None
    """Ranges of robot, weather and distractor objects from episode to episode; None: no randomization. `True` means the
    default ranges."""
    device: str = CPU
    """cpu or cuda. cuda renders fields on the GPU, and steps vector environments there."""


def parse_options(given: dict[str, Any]) -> Options:
    """Returns options from keywords.

    Raises:
        InputError: unknown keyword, or a value of the wrong type or out of range.
    """
    names = [f.name for f in dataclasses.fields(Options)]
    for name in given:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            raise InputError(
                f"unknown option {name!r}; "
                + (f"did you mean {near[0]!r}?" if near else f"there are {', '.join(names)}")
            )
    given = dict(given)
    if isinstance(given.get("randomise"), bool):
        given["randomise"] = Ranges() if given["randomise"] else None
    if isinstance(given.get("rewards"), dict):
        given["rewards"] = _parse_rewards(given["rewards"])
    options = Options(**given)
    _check_types(options)
    if options.action not in (TWIST, STEERING):
        raise InputError(f"action = {options.action!r}; expected {TWIST!r} or {STEERING!r}")
    if options.observe not in (NERF, SIMULATOR):
        raise InputError(f"observe = {options.observe!r}; expected {NERF!r} or {SIMULATOR!r}")
    if options.device not in (CPU, CUDA):
        raise InputError(f"device = {options.device!r}; expected {CPU!r} or {CUDA!r}")
    if options.device == CUDA and not wp.is_cuda_available():
        raise InputError(f"device = {CUDA!r}: no CUDA device is visible to warp; use device={CPU!r}")
    for name in ("control_timestep", "speed", "yaw_rate"):
        if not getattr(options, name) >= 0.01:
            raise InputError(f"{name} = {getattr(options, name)}; expected at least 0.01")
    if not options.control_timestep <= COMMAND_TIMEOUT:
        raise InputError(
            f"control_timestep = {options.control_timestep}; expected at most {COMMAND_TIMEOUT} s: the robot stops "
            "when no command arrives for that long"
        )
    for name in ("half_width", "time_limit"):
        value = getattr(options, name)
        if value is not None and not value > 0.0:
            raise InputError(f"{name} = {value}; expected more than 0")
    for name in ("start_offset", "start_heading"):
        if not getattr(options, name) >= 0.0:
            raise InputError(f"{name} = {getattr(options, name)}; expected at least 0")
    if not 0.0 <= options.start_along < 1.0:
        raise InputError(f"start_along = {options.start_along}; expected 0 or more, and less than 1")
    if options.obstacles != "scene" and isinstance(options.obstacles, str):
        raise InputError(f"obstacles = {options.obstacles!r}; expected 'scene', a number, or ObstacleConfigs")
    return options


_MAX_STACK, _MAX_SIDE, _MAX_OBSTACLES, _MAX_NUMBER = 64, 4096, 1000, 1e6
_NUMBERS = ("control_timestep", "speed", "yaw_rate", "start_offset", "start_heading", "start_along")
_OPTIONAL_NUMBERS = ("half_width", "time_limit")


def _check_types(options: Options) -> None:
    """Raises InputError: an option has the wrong type, is not finite, or exceeds the limits above."""
    numbers: dict[str, Any] = {name: getattr(options, name) for name in _NUMBERS}
    numbers |= {name: value for name in _OPTIONAL_NUMBERS if (value := getattr(options, name)) is not None}
    for name, kind in (("rewards", Rewards), ("camera", CameraOptions), ("randomise", Ranges)):
        value = getattr(options, name)
        if not isinstance(value, kind) and (value is not None or name == "rewards"):
            raise InputError(f"{name} = {short_repr(value)}; expected {kind.__name__}")
        if name != "randomise" and value is not None:
            numbers |= {f"{name}.{field}": field_value for field, field_value in vars(value).items()}
    for name, value in numbers.items():
        if not _is_number(value):
            raise InputError(f"{name} = {short_repr(value)}; expected a number, at most {_MAX_NUMBER:,.0f} in size")
    for name in ("pixels", "lighting_drift"):
        if not isinstance(getattr(options, name), bool | np.bool_):
            raise InputError(f"{name} = {short_repr(getattr(options, name))}; expected True or False")
    _check_integer("stack", options.stack, 1, _MAX_STACK)
    if not isinstance(options.size, Sequence) or isinstance(options.size, str) or len(options.size) != 2:
        raise InputError(f"size = {short_repr(options.size)}; expected (width, height) of at least 8 px")
    for side in options.size:
        _check_integer("size", side, 8, _MAX_SIDE)
    for name in ("action", "observe", "device"):
        if not isinstance(getattr(options, name), str):
            raise InputError(f"{name} = {short_repr(getattr(options, name))}; expected a string")
    lighting = options.lighting
    names = [lighting] if isinstance(lighting, str) else list(lighting) if isinstance(lighting, Sequence) else []
    if not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"lighting = {short_repr(lighting)}; expected a name, or several")
    if isinstance(options.obstacles, str):
        return
    if isinstance(options.obstacles, Sequence):
        if not all(isinstance(one, ObstacleConfig) for one in options.obstacles):
            value = short_repr(options.obstacles)
            raise InputError(f"obstacles = {value}; expected 'scene', a number, or ObstacleConfigs")
    else:
        _check_integer("obstacles", options.obstacles, 0, _MAX_OBSTACLES)


def _is_number(value: Any) -> bool:
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return real and -_MAX_NUMBER <= value <= _MAX_NUMBER


def _check_integer(name: str, value: Any, low: int, high: int) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(f"{name} = {short_repr(value)}; expected a whole number from {low} to {high}")


def _parse_rewards(given: dict[str, float]) -> Rewards:
    names = [f.name for f in dataclasses.fields(Rewards)]
    for name in given:
        if name not in names:
            raise InputError(f"unknown reward {name!r}; there are {', '.join(names)}")
    return Rewards(**given)


def check_actions(actions: Any, shape: tuple[int, ...]) -> Array:
    """Returns actions as float64.

    Raises:
        ValueError: wrong shape, not real numbers (booleans are not accepted), or not finite.
    """
    try:
        given = np.asarray(actions)
    except (TypeError, ValueError):  # ragged lists
        given = np.empty(0, object)
    if given.dtype.kind not in "iuf" or given.shape != shape or not np.isfinite(given).all():
        kind = f"{given.dtype} of shape {given.shape}"
        raise ValueError(f"action {short_repr(actions)} ({kind}); expected finite numbers of shape {shape}")
    return given.astype(np.float64, copy=False)
