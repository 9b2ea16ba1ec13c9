"""What may be asked of an environment; the defaults are the paper's (DriveEnv-NeRF, arXiv 2403.15791) where it says."""

import dataclasses
import difflib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from twin.config import TRAINING, ObstacleConfig
from twin.env.camera_noise import CameraOptions
from twin.env.controller import COMMAND_TIMEOUT
from twin.env.domain_randomization import Ranges
from twin.errors import InputError, shown

CAUSES = ("goal", "collision", "out_of_bounds", "timeout", "rollover", "stuck")
"""Why an episode ends."""

TWIST, STEERING = "twist", "steering"
NERF, SIMULATOR = "nerf", "simulator"
CPU, CUDA = "cpu", "cuda"


@dataclass(frozen=True)
class Rewards:
    """What a step and an end are worth. The last step of an episode brings its cause's term, and `step` at the goal."""

    step: float = 0.1
    """A step that the episode survives."""
    collision: float = -4.0
    out_of_bounds: float = -5.0
    timeout: float = -5.0
    rollover: float = -5.0
    stuck: float = -5.0
    goal: float = 0.0
    progress: float = 0.0
    """Per metre along the route, backwards negative."""
    cross_track: float = 0.0
    """Per step, times the distance from the route as a share of the corridor's half width; negative punishes."""
    steering: float = 0.0
    """Per step, times the square of the yaw rate asked for as a share of the largest; negative punishes."""


@dataclass(frozen=True)
class Options:
    """Everything about an environment but its scene and its task."""

    rewards: Rewards = dataclasses.field(default_factory=Rewards)
    control_timestep: float = 0.1
    """Between two actions [s]."""
    size: tuple[int, int] = (160, 90)
    """Width, height of the pictures [px]."""
    stack: int = 4
    """Pictures in an observation, the newest last."""
    pixels: bool = True
    """Observe pictures; otherwise what `Drive.get_observation` says, which is fast and needs no field."""
    action: str = TWIST
    """twist (v [m/s], ω [rad/s]) or steering (ω [rad/s] at fixed speed)."""
    speed: float = 1.0
    """Highest speed of a twist; the speed when steering [m/s]."""
    yaw_rate: float = 1.0
    """Largest yaw rate to either side [rad/s]."""
    half_width: float | None = None
    """Of the corridor [m]; the scene's unless given."""
    time_limit: float | None = None
    """[s]; twice what the stretch takes at `speed` unless given."""
    start_offset: float = 0.3
    """The robot starts beside the route by a distance uniform within ± this [m]..."""
    start_heading: float = 10.0
    """... and turned away from its heading by an angle uniform within ± this [°]."""
    start_along: float = 0.0
    """Every second episode starts on the way instead, uniform up to this share of the stretch."""
    observe: str = NERF
    """nerf: pictures of the field; simulator: MuJoCo's own of the extracted mesh, in its own light."""
    lighting: str | Sequence[str] = TRAINING
    """See `episode_lighting.py`."""
    lighting_drift: bool = False
    """The light changes during an episode."""
    obstacles: str | int | Sequence[ObstacleConfig] = "scene"
    """`scene`: those of scene.toml; a number: so many that stand, drawn for every episode; or these."""
    camera: CameraOptions | None = None
    """What makes the camera imperfect: vibration, exposure, blur. None: nothing."""
    randomise: Ranges | None = None
    """How far robot, weather and bystanders differ from episode to episode; None: they do not. `True` stands for the
    default ranges."""
    device: str = CPU
    """cpu; or cuda: fields are marched on the GPU, and many worlds step there, too."""


def parse_options(given: dict[str, Any]) -> Options:
    """Options from keywords.

    Raises:
        InputError: an unknown keyword, or a value out of range.
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
        given["rewards"] = _rewards(given["rewards"])
    options = Options(**given)
    _check_kinds(options)
    if options.action not in (TWIST, STEERING):
        raise InputError(f"action = {options.action!r}; expected {TWIST!r} or {STEERING!r}")
    if options.observe not in (NERF, SIMULATOR):
        raise InputError(f"observe = {options.observe!r}; expected {NERF!r} or {SIMULATOR!r}")
    if options.device not in (CPU, CUDA):
        raise InputError(f"device = {options.device!r}; expected {CPU!r} or {CUDA!r}")
    if options.device == CUDA and not wp.is_cuda_available():
        raise InputError(f"device = {CUDA!r}: no CUDA device is visible to warp; use device={CPU!r}")
    for name, low in (("control_timestep", 0.01), ("speed", 0.01), ("yaw_rate", 0.01), ("stack", 1)):
        if not getattr(options, name) >= low:
            raise InputError(f"{name} = {getattr(options, name)}; expected at least {low:g}")
    if not options.control_timestep <= COMMAND_TIMEOUT:
        raise InputError(
            f"control_timestep = {options.control_timestep}; expected at most {COMMAND_TIMEOUT} s: the robot stops "
            "where it hears nothing for so long"
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
    if len(options.size) != 2 or min(options.size) < 8:
        raise InputError(f"size = {options.size}; expected (width, height) of at least 8 px")
    return options


_MOST_STACK, _MOST_SIDE, _MOST_OBSTACLES, _MOST_NUMBER = 64, 4096, 1000, 1e6
_NUMBERS = ("control_timestep", "speed", "yaw_rate", "start_offset", "start_heading", "start_along")
_NUMBERS_OR_NONE = ("half_width", "time_limit")


def _check_kinds(options: Options) -> None:
    """Raises InputError where a value is of another kind than its option, not finite, or beyond all reason."""
    numbers: dict[str, Any] = {name: getattr(options, name) for name in _NUMBERS}
    numbers |= {name: value for name in _NUMBERS_OR_NONE if (value := getattr(options, name)) is not None}
    for name, kind in (("rewards", Rewards), ("camera", CameraOptions), ("randomise", Ranges)):
        value = getattr(options, name)
        if not isinstance(value, kind) and (value is not None or name == "rewards"):
            raise InputError(f"{name} = {shown(value)}; expected {kind.__name__}")
        if name != "randomise" and value is not None:
            numbers |= {f"{name}.{part}": part_value for part, part_value in vars(value).items()}
    for name, value in numbers.items():
        if not _is_number(value):
            raise InputError(f"{name} = {shown(value)}; expected a number, at most {_MOST_NUMBER:,.0f} in size")
    for name in ("pixels", "lighting_drift"):
        if not isinstance(getattr(options, name), bool | np.bool_):
            raise InputError(f"{name} = {shown(getattr(options, name))}; expected True or False")
    _check_whole("stack", options.stack, 1, _MOST_STACK)
    if not isinstance(options.size, Sequence) or isinstance(options.size, str) or len(options.size) != 2:
        raise InputError(f"size = {shown(options.size)}; expected (width, height) of at least 8 px")
    for side in options.size:
        _check_whole("size", side, 8, _MOST_SIDE)
    for name in ("action", "observe", "device"):
        if not isinstance(getattr(options, name), str):
            raise InputError(f"{name} = {shown(getattr(options, name))}; expected a word")
    light = options.lighting
    names = [light] if isinstance(light, str) else list(light) if isinstance(light, Sequence) else []
    if not names or not all(isinstance(name, str) for name in names):
        raise InputError(f"lighting = {shown(light)}; expected a name, or several")
    if isinstance(options.obstacles, str):
        return
    if isinstance(options.obstacles, Sequence):
        if not all(isinstance(one, ObstacleConfig) for one in options.obstacles):
            raise InputError(f"obstacles = {shown(options.obstacles)}; expected 'scene', a number, or ObstacleConfigs")
    else:
        _check_whole("obstacles", options.obstacles, 0, _MOST_OBSTACLES)


def _is_number(value: Any) -> bool:
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return real and -_MOST_NUMBER <= value <= _MOST_NUMBER


def _check_whole(name: str, value: Any, low: int, high: int) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or not low <= value <= high:
        raise InputError(f"{name} = {shown(value)}; expected a whole number from {low} to {high}")


def _rewards(given: dict[str, float]) -> Rewards:
    names = [f.name for f in dataclasses.fields(Rewards)]
    for name in given:
        if name not in names:
            raise InputError(f"unknown reward {name!r}; there are {', '.join(names)}")
    return Rewards(**given)


# ---- dm_control's control loop, or one line that says why there is none.


try:
    from dm_control.rl import control
except ModuleNotFoundError as error:
    raise InputError(
        f"{error}: to drive in a scene needs dm_control, which installs on Python 3.11 and 3.12; this is "
        f"{sys.version_info.major}.{sys.version_info.minor}"
    ) from None

__all__ = ["control"]
