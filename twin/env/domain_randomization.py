"""What differs from episode to episode: the robot, the air, the light, shadows, and things beside the corridor.

Of the robot tyre friction, payload, latency, camera pose and wheels differ; the air is hazy (see `weather.py`);
another sun lights what stands (see `weather.py`) and throws shadows that the film had not (see `weather.py`); and
*bystanders*, things where nothing is driven, stand as if they had been moved there.

*Ranges* say how far each may be from what was built and filmed; a *draw* is what one episode got, every value uniform
in its range and independent of the others. What is the robot's is applied to the episode's own copy of the model.
What is known of the robot, and of a day by a photo, need not be drawn: see `Ranges.hold_known`.
"""

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import mujoco
import numpy as np

from twin.config import RANDOMISED
from twin.env.episode_model import PAYLOAD
from twin.errors import InputError, shown
from twin.robot import HuskyParams
from twin.types import Array

Range = tuple[float, float]

VERSION = 4
"""Of what comes out of a draw. Raised where haze, light, shadows or bystanders of the same draw become others."""

UNTOLD = 0.6
"""Fraction of the sun and shadow randomisation that is kept where a photo of the day is available.

It was measured on the known-truth world's own pictures of ten days of the real test (the five stated weathers and days
1 to 5), with the twelve finished policies that are forecast there: a forecast for these days and policies is not
independent of it. Days 6 to 15 were no part of it. The change of steering between the twin under a photo's light and
air and the pictures of that day is 0.8 times that by the full randomisation (0.6 to 0.96), and with this fraction of it
1.1 times in what lasts for the day (0.8 to 1.4) and 1.2 times in what differs from place to place (1.0 to 1.4); see
`benchmarks/day.py`."""

_PAYLOAD_SIDE = 0.3  # [m] of the cube that the payload's inertia is of
_TYRE = "_tyre"
_MOST = 1e6  # of a bound of a range
_HELD_BY = {
    "friction": ("friction",),
    "center_of_mass": ("payload",),
    "payload_mass": ("payload",),
    "command_latency": ("latency",),
    "wheel_radius": ("wheel_radius", "wheel_difference"),
    "camera_height": ("camera_shift",),
    "camera_yaw": ("camera_turn",),
}
"""Of `HuskyParams`: what need not be drawn where it is known. Yaw is what only a film of the camera's own shows, and
with it pitch and roll; where the height was measured, the offset is taken as it is told."""
_FIELDS = ("geom_friction", "geom_size", "geom_rbound", "geom_aabb", "bvh_aabb", "cam_pos", "cam_quat")


@dataclass(frozen=True)
class Ranges:
    """Lowest and highest value of each quantity. Equal ones hold it fixed."""

    friction: Range = (0.7, 1.3)
    """Of the tyres, as a share of the robot's own."""
    payload: Range = (0.0, 20.0)
    """On the top plate [kg]."""
    latency: Range = (0.0, 0.1)
    """From a command to its taking effect, added to the robot's own [s]."""
    camera_shift: Range = (-0.02, 0.02)
    """Of the front camera along each of its axes [m]."""
    camera_turn: Range = (-1.0, 1.0)
    """Of the front camera about each of its axes [°]."""
    wheel_radius: Range = (0.98, 1.02)
    """As a share of the robot's own; its controller does not know."""
    wheel_difference: Range = (-0.006, 0.006)
    """By which the right wheels are larger than the left ones, as a share: who does not look drifts to a side."""
    extinction: Range = (0.0, 0.05)
    """Of the air [1/m], added to the film's; 0.05 is a visibility of 60 m."""
    airlight: Range = (0.85, 1.15)
    """How bright the haze is, as a share of the sky at the horizon."""
    sunlight: Range = (0.0, 0.7)
    """How much lighter what faces another sun is than what turns away; the `strength` of `Sides`."""
    shade: Range = (0.0, 0.75)
    """Share of a colour that is lost where shadows lie that the film did not have."""
    bystanders: Range = (0, 4)
    """Things beside the corridor: cones, boxes, bollards in any colour."""
    hold_known: bool = False
    """Whether only that is drawn which is not known: of the robot by the scene, see `for_robot`; of the weather by the
    photo that the episode's light, or a part of its mixture, was fitted to, see `Draw.on_a_known_day`."""

    def __post_init__(self) -> None:
        """Raises InputError: a range that is none, or out of its own."""
        for name, pair in self.each().items():
            try:
                low, high = np.asarray(pair, float)  # one held fixed may have a value per axis
                whole = bool((np.abs([low, high]) < _MOST).all())
            except (TypeError, ValueError, OverflowError):
                whole = False
            if not whole:
                raise InputError(f"randomise: {name} = {shown(pair)}; expected (lowest, highest), finite numbers")
            if not np.all(low <= high):
                raise InputError(f"randomise: {name} = {shown(pair)}; expected (lowest, highest)")
        for name in ("friction", "wheel_radius"):
            if not getattr(self, name)[0] > 0.0:
                raise InputError(f"randomise: {name} = {getattr(self, name)}; expected more than 0")
        if max(map(abs, self.wheel_difference)) > 0.5:
            raise InputError(f"randomise: wheel_difference = {self.wheel_difference}; expected at most ±0.5")
        for name in ("payload", "latency", "extinction", "airlight", "sunlight", "shade", "bystanders"):
            if not getattr(self, name)[0] >= 0.0:
                raise InputError(f"randomise: {name} = {getattr(self, name)}; expected at least 0")

    def each(self) -> dict[str, Range]:
        """Every range by its name."""
        return {one.name: getattr(self, one.name) for one in fields(self) if one.name != "hold_known"}

    def for_robot(self, robot: HuskyParams) -> "Ranges":
        """These ranges for a scene's robot: where it is known better than as published, it is held if that is wanted.

        Known is what `robot.toml` or `[robot]` made another than the published robot's. A road is driven by one robot:
        rates over many would tell how robust a policy is, and not what that one will do.
        """
        if not self.hold_known:
            return self
        as_built = RandomizationSample()
        drawn = [each for name in known_of(robot) for each in _HELD_BY[name]]
        held: dict[str, Any] = {name: (getattr(as_built, name),) * 2 for name in drawn}
        return replace(self, **held)

    def draw(self, rng: np.random.Generator) -> "RandomizationSample":
        """One episode's values."""
        return RandomizationSample(
            friction=float(rng.uniform(*self.friction)),
            payload=float(rng.uniform(*self.payload)),
            latency=float(rng.uniform(*self.latency)),
            camera_shift=tuple(rng.uniform(*self.camera_shift, 3).tolist()),
            camera_turn=tuple(rng.uniform(*self.camera_turn, 3).tolist()),
            wheel_radius=float(rng.uniform(*self.wheel_radius)),
            wheel_difference=float(rng.uniform(*self.wheel_difference)),
            extinction=float(rng.uniform(*self.extinction)),
            airlight=float(rng.uniform(*self.airlight)),
            sunlight=float(rng.uniform(*self.sunlight)),
            shade=float(rng.uniform(*self.shade)),
            bystanders=int(rng.integers(round(self.bystanders[0]), round(self.bystanders[1]) + 1)),
        )


@dataclass(frozen=True)
class RandomizationSample:
    """What one episode got; units as in `Ranges`. The default is the robot as built, in the place as filmed."""

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

    def on_a_known_day(self) -> "RandomizationSample":
        """The same on a day whose light and air a photo told: no haze but that air, and sun and shadows weaker."""
        return replace(self, extinction=0.0, airlight=1.0, sunlight=UNTOLD * self.sunlight, shade=UNTOLD * self.shade)

    def record(self) -> dict[str, Any]:
        """For the episode's record, JSON-able."""
        return asdict(self)


ANOTHER_DAY = Ranges(sunlight=(0.35, 0.7), shade=(0.35, 0.75), hold_known=True)
"""What policies are judged in: a day that is surely not the film's, and the robot at hand as far as it is known.
Training draws from nothing to as much, so as to be learnt from; in a forecast, its mild days would promise more than a
road keeps, whose sun is never the film's."""


def known_of(robot: HuskyParams) -> list[str]:
    """What need not be drawn of a robot, as it is another than the published robot's: names of `HuskyParams`."""
    published = HuskyParams()
    return [name for name in _HELD_BY if getattr(robot, name) != getattr(published, name)]


def asked(lighting: str) -> dict[str, Any]:
    """Options of an environment for the name of a lighting in tables, such as `held-out+randomised`."""
    plain = lighting.removesuffix(RANDOMISED)
    return {"lighting": plain, "randomise": ANOTHER_DAY if plain != lighting else None}


class Nominal:
    """The robot as built, to which draws are applied; remembers the fields they change."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """
        Args:
            model: Of `episode_spec`, as compiled.
        """
        self._tyres = np.array([i for i in range(model.ngeom) if model.geom(i).name.endswith(_TYRE)])
        self._right = np.array(["right" in model.geom(i).name for i in self._tyres])
        self._payload = model.body(PAYLOAD).id
        self._camera = model.camera("front").id
        self._fields = {name: np.array(getattr(model, name)) for name in _FIELDS}
        bodies = model.geom_bodyid[self._tyres]
        first, count = model.body_bvhadr[bodies], model.body_bvhnum[bodies]
        self._boxes = np.concatenate([np.arange(a, a + n) for a, n in zip(first, count, strict=True)])
        self._scratch = mujoco.MjData(model)

    def apply(self, draw: RandomizationSample, model: mujoco.MjModel) -> None:
        """Makes a copy of the model that of an episode."""
        tyres, camera, was = self._tyres, self._camera, self._fields
        model.geom_friction[tyres, 0] = was["geom_friction"][tyres, 0] * draw.friction
        radius = draw.wheel_radius * (1.0 + np.where(self._right, 0.5, -0.5) * draw.wheel_difference)
        model.geom_size[tyres] = was["geom_size"][tyres] * np.stack([radius, np.ones_like(radius), radius], 1)
        # What MuJoCo bounds a geom by may be too large, but never too small.
        grown = max(1.0, float(radius.max()))
        model.geom_rbound[tyres] = was["geom_rbound"][tyres] * grown
        model.geom_aabb[tyres] = was["geom_aabb"][tyres] * grown
        model.bvh_aabb[self._boxes] = was["bvh_aabb"][self._boxes] * [1.0, 1.0, 1.0, grown, grown, grown]
        model.cam_pos[camera] = was["cam_pos"][camera] + _turned(draw.camera_shift, was["cam_quat"][camera])
        turn, quaternion = np.zeros(4), np.zeros(4)
        mujoco.mju_euler2Quat(turn, np.deg2rad(draw.camera_turn), "xyz")
        mujoco.mju_mulQuat(quaternion, was["cam_quat"][camera], turn)
        model.cam_quat[camera] = quaternion
        if model.body_mass[self._payload] != draw.payload:
            model.body_mass[self._payload] = draw.payload
            model.body_inertia[self._payload] = draw.payload * _PAYLOAD_SIDE**2 / 6.0
            mujoco.mj_setConst(model, self._scratch)


def _turned(vector: tuple[float, ...], quaternion: Array) -> Array:
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, np.array(vector), quaternion)
    return out
