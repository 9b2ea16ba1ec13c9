"""Domain randomization: the robot, the weather and distractor objects differ from episode to episode.

The randomized quantities are:

- robot: tire friction, payload, latency, camera pose and wheels;
- pictures: fog, directional relighting and cast shadows (see `picture_effects.py`);
- place: distractor objects beside the corridor.

`Ranges` contains the bounds, a `RandomizationSample` the values of one episode; the sun's direction and color and the
pattern of shadows are drawn in `picture_effects.Weather`. Values are independent of each other, and uniform in their
ranges except for the fog's: clear air is more common than fog, so its extinction is the cube of a uniform value. With
`Ranges.hold_known`, measured parameters of the robot are not sampled, and the weather is randomized less when a photo
of the day is available.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import mujoco
import numpy as np

from twin.config import Condition
from twin.errors import InputError, short_repr
from twin.robot import HuskyParams

Interval = tuple[float, float]

PAYLOAD = "payload"
"""Name of a body on the top plate; its mass is zero until an episode sets a payload."""

VERSION = 6
"""Version of a sample's effects. Increase it whenever a change of the code changes the pictures of a sample."""

KNOWN_WEATHER_FRACTION = 0.6
"""When a photo of the day is available, the strengths of sun and shadows are multiplied by this fraction.

It was tuned with `benchmarks/day.py` in the simulated world of `twin.reality`. The ratio of a policy's change of
steering by the true day to that by the sampled sun and shadows, with 90 % intervals over policies and days, is 0.8
(0.6 to 0.96) for the full randomization. With this fraction it is 1.1 (0.8 to 1.4) for the part of the change that is
constant over a day, and 1.2 (1.0 to 1.4) for the part that varies along the route.

The policies are the twelve finished ones of Table 1 in docs/benchmarks.md; the days are the five designed weathers and
days 1 to 5. So a forecast for these policies and days is not independent of this value."""

_PAYLOAD_SIDE = 0.3  # [m] the payload has the inertia of a cube with this side
_TIRE_SUFFIX = "_tyre"
_PER_AXIS = ("camera_shift", "camera_turn")  # sampled for each axis; bounds may differ between axes
_MAX_BOUND = 1e6
_ABOVE_ZERO = float(np.nextafter(0.0, 1.0))
_BOUNDS = {
    **dict.fromkeys(("friction", "wheel_radius"), (_ABOVE_ZERO, _MAX_BOUND)),
    **dict.fromkeys(("payload", "latency", "extinction", "airlight", "sunlight", "shade"), (0.0, _MAX_BOUND)),
    "bystanders": (0.0, 1000.0),
    "wheel_difference": (-0.5, 0.5),
}
"""Allowed values of ranges; ranges that are not listed must be within ±`_MAX_BOUND`."""
_RANGES_BY_PARAMETER = {
    "friction": ("friction",),
    "center_of_mass": ("payload",),
    "payload_mass": ("payload",),
    "command_latency": ("latency",),
    "wheel_radius": ("wheel_radius", "wheel_difference"),
    "camera_height": ("camera_shift",),
    "camera_yaw": ("camera_turn",),
}
"""Parameter of `HuskyParams` → ranges that are held fixed if it was measured. A film that gives the camera's yaw gives
its pitch and roll, too, so a measured yaw holds all three. A measured height holds the camera's whole position."""
_MODEL_FIELDS = ("geom_friction", "geom_size", "geom_rbound", "geom_aabb", "bvh_aabb", "cam_pos", "cam_quat")


@dataclass(frozen=True)
class Ranges:
    """Lowest and highest value of each quantity. Equal bounds hold it fixed."""

    friction: Interval = (0.7, 1.3)
    """Factor by which the robot's own tire friction is multiplied."""
    payload: Interval = (0.0, 20.0)
    """Mass on the top plate [kg]."""
    latency: Interval = (0.0, 0.1)
    """Delay of commands, in addition to the robot's own `command_latency` [s]."""
    camera_shift: Interval = (-0.02, 0.02)
    """Translation of the front camera along each of its axes [m]."""
    camera_turn: Interval = (-1.0, 1.0)
    """Rotation of the front camera about each of its axes [°]."""
    wheel_radius: Interval = (0.98, 1.02)
    """Factor by which the robot's own wheel radius is multiplied; the controller always uses the nominal radius."""
    wheel_difference: Interval = (-0.006, 0.006)
    """Right minus left wheel radius, relative to their mean; with a difference, the robot does not drive straight."""
    extinction: Interval = (0.0, 0.05)
    """Extinction of the fog [1/m], in addition to the film's haze; 0.05 is a visibility of 60 m. By default the
    visibility is above 480 m in half of the episodes, and below 120 m in a fifth."""
    airlight: Interval = (0.85, 1.15)
    """Ratio of the fog's brightness to that of the sky at the horizon."""
    sunlight: Interval = (0.0, 0.7)
    """Strength of `picture_effects.DirectionalRelighting`."""
    shade: Interval = (0.0, 0.75)
    """Strength of `picture_effects.CastShadows`: fraction of a color lost in full shadow."""
    bystanders: Interval = (0, 4)
    """Number of distractor objects beside the corridor: cones, boxes, bollards in any color."""
    hold_known: bool = False
    """True: measured parameters of the robot are held fixed (see `for_robot`). Under lightings fitted to a photo, the
    weather is randomized less (see `RandomizationSample.for_known_weather`)."""

    def __post_init__(self) -> None:
        """Raises InputError: a value is not a range, or lies outside the allowed bounds."""
        for name, pair in self.by_name().items():
            least, most = _BOUNDS.get(name, (-_MAX_BOUND, _MAX_BOUND))
            try:
                low, high = np.asarray(pair, float)
                valid = (low.ndim == 0 or (name in _PER_AXIS and low.shape == (3,))) and bool(
                    np.all((least <= low) & (low <= high) & (high <= most))
                )
            except (TypeError, ValueError, OverflowError):
                valid = False
            if not valid:
                expected = "more than 0" if least == _ABOVE_ZERO else f"{least:,g}"
                raise InputError(
                    f"randomise: {name} = {short_repr(pair)}; expected (lowest, highest), from {expected} to {most:,g}"
                )

    def by_name(self) -> dict[str, Interval]:
        """All ranges by name."""
        return {one.name: getattr(self, one.name) for one in fields(self) if one.name != "hold_known"}

    def for_robot(self, robot: HuskyParams) -> "Ranges":
        """These ranges for a scene's robot. With `hold_known`, measured parameters are held at the robot's values.

        A parameter counts as measured if `robot.toml` or `[robot]` gives a value other than the published one. Real
        trials use one robot: a rate over many sampled robots would measure robustness, not the success of that robot.
        """
        if not self.hold_known:
            return self
        as_built = RandomizationSample()
        names = [name for parameter in measured_parameters(robot) for name in _RANGES_BY_PARAMETER[parameter]]
        held: dict[str, Any] = {name: (getattr(as_built, name),) * 2 for name in names}
        return replace(self, **held)

    def sample(self, rng: np.random.Generator) -> "RandomizationSample":
        """Samples one episode's values, in the order of the fields."""
        values: dict[str, Any] = {}
        for name, pair in self.by_name().items():
            if name == "bystanders":
                values[name] = int(rng.integers(round(pair[0]), round(pair[1]) + 1))
            elif name in _PER_AXIS:
                values[name] = tuple(rng.uniform(*pair, 3).tolist())
            elif name == "extinction":
                values[name] = float(pair[0] + (pair[1] - pair[0]) * rng.uniform() ** 3)
            else:
                values[name] = float(rng.uniform(*pair))
        return RandomizationSample(**values)


@dataclass(frozen=True)
class RandomizationSample:
    """Values of one episode, units as in `Ranges`. The default is the robot as built, in the place as filmed."""

    friction: float = 1.0
    payload: float = 0.0
    latency: float = 0.0
    camera_shift: tuple[float, ...] = (0.0, 0.0, 0.0)
    camera_turn: tuple[float, ...] = (0.0, 0.0, 0.0)
    wheel_radius: float = 1.0
    wheel_difference: float = 0.0
    extinction: float = 0.0
    airlight: float = 1.0
    sunlight: float = 0.0
    shade: float = 0.0
    bystanders: int = 0

    def for_known_weather(self) -> "RandomizationSample":
        """This sample without fog and with weaker sun and shadows, for a day whose fog and light a photo shows."""
        sun, shade = KNOWN_WEATHER_FRACTION * self.sunlight, KNOWN_WEATHER_FRACTION * self.shade
        return replace(self, extinction=0.0, airlight=1.0, sunlight=sun, shade=shade)

    def record(self) -> dict[str, Any]:
        """The values for the episode's record, JSON-able; a new dict at each call."""
        return dict(vars(self))


EVALUATION_RANGES = Ranges(sunlight=(0.35, 0.7), shade=(0.35, 0.75), hold_known=True)
"""Ranges for evaluating policies. Measured parameters of the scene's robot are held fixed, and sun and shadows always
differ from those in the film. Training also has episodes with little sun and shadow, which ease learning, but would
make a forecast overestimate the success on the road."""


def measured_parameters(robot: HuskyParams) -> list[str]:
    """Names of the measured parameters: those whose values differ from the published robot's."""
    published = HuskyParams()
    return [name for name in _RANGES_BY_PARAMETER if getattr(robot, name) != getattr(published, name)]


def condition_options(condition: Condition) -> dict[str, Any]:
    """Environment options for the evaluation of a policy under a condition."""
    return {"lighting": condition.lighting, "randomise": EVALUATION_RANGES if condition.randomised else None}


class NominalModel:
    """Nominal values of the model's randomized fields; `apply` writes a sample's values to a copy of the model."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """`model` is the compiled `episode_spec`."""
        self._tires = np.array([i for i in range(model.ngeom) if model.geom(i).name.endswith(_TIRE_SUFFIX)])
        self._right = np.array(["right" in model.geom(i).name for i in self._tires])
        self._payload = model.body(PAYLOAD).id
        self._camera = model.camera("front").id
        self._fields = {name: np.array(getattr(model, name)) for name in _MODEL_FIELDS}
        bodies = model.geom_bodyid[self._tires]
        first, count = model.body_bvhadr[bodies], model.body_bvhnum[bodies]
        self._boxes = np.concatenate([np.arange(a, a + n) for a, n in zip(first, count, strict=True)])
        self._scratch = mujoco.MjData(model)

    def apply(self, sample: RandomizationSample, model: mujoco.MjModel) -> None:
        """Applies an episode's sample to a copy of the model, in place."""
        tires, camera, nominal = self._tires, self._camera, self._fields
        model.geom_friction[tires, 0] = nominal["geom_friction"][tires, 0] * sample.friction
        radius = sample.wheel_radius * (1.0 + np.where(self._right, 0.5, -0.5) * sample.wheel_difference)
        model.geom_size[tires] = nominal["geom_size"][tires] * np.stack([radius, np.ones_like(radius), radius], 1)
        # The bounds that MuJoCo stores for a geom may be larger than the geom, but not smaller.
        scale = max(1.0, float(radius.max()))
        model.geom_rbound[tires] = nominal["geom_rbound"][tires] * scale
        model.geom_aabb[tires] = nominal["geom_aabb"][tires] * scale
        model.bvh_aabb[self._boxes] = nominal["bvh_aabb"][self._boxes] * [1.0, 1.0, 1.0, scale, scale, scale]
        shift = np.zeros(3)
        mujoco.mju_rotVecQuat(shift, np.array(sample.camera_shift), nominal["cam_quat"][camera])
        model.cam_pos[camera] = nominal["cam_pos"][camera] + shift
        turn, quaternion = np.zeros(4), np.zeros(4)
        mujoco.mju_euler2Quat(turn, np.deg2rad(sample.camera_turn), "xyz")
        mujoco.mju_mulQuat(quaternion, nominal["cam_quat"][camera], turn)
        model.cam_quat[camera] = quaternion
        if model.body_mass[self._payload] != sample.payload:
            model.body_mass[self._payload] = sample.payload
            model.body_inertia[self._payload] = sample.payload * _PAYLOAD_SIDE**2 / 6.0
            mujoco.mj_setConst(model, self._scratch)
