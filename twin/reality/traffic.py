"""Traffic in the films of a place: walkers, moving cars, and parked cars that are absent in the last lighting.

Only the films have traffic; truth and real test have none. A twin should therefore contain none.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from twin.reality import SEED, primitives
from twin.reality.place_objects import KnownPlace, PlaceObject
from twin.reality.primitives import MeshPart
from twin.reality.street_furniture import VEHICLES, add_vehicle, vehicle_size
from twin.types import Array

_WALKERS, _CARS, _PARKED = 3, 2, 4  # walkers and moving cars per film; parked cars
_WALKING_SPEED, _CAR_SPEED = (1.1, 1.7), (4.0, 8.0)  # ranges [m/s]
_MEETING_DISTANCE = (
    5.0,
    12.0,
)  # [m] range of the distance ahead of the camera at which a walker crosses the center line
_CROSSING = 9.0  # [m] a walker crosses from this lateral to its opposite
_OUT_OF_SIGHT = np.array([0.0, 0.0, -50.0])  # [m] foot of a mover that is not in the place
_CAR_LATERAL = 2.3  # [m] lateral of moving cars to the left of the filmed line
_PARKED_GAP = 1.6  # [m] from the center line to the nearer side of a parked car
_SKINS = ("red", "blue", "white", "dark", "green")


@dataclass(frozen=True)
class Mover:
    """A rigid object that moves during a film."""

    name: str
    part: MeshPart
    """Mesh with x ahead and z up, its foot at the origin."""
    pose: Callable[[float], tuple[Array, float]]
    """Foot point (3,) [m] and yaw [rad] at a time of the film [s]."""


def movers(place: KnownPlace, film: str, times: Array, cameras: Array) -> list[Mover]:
    """The walkers and cars that move during a film, always the same for a place and a film.

    Every walker crosses the road in front of the camera. The first car is oncoming; the others overtake the camera.

    Args:
        film: Name of the film.
        times: Times of the frames [s], shape (n,).
        cameras: camera_to_world of the frames, shape (n, 4, 4).
    """
    rng = np.random.default_rng([SEED, 51, place.number, sum(map(ord, film))])
    station = place.route.project(cameras[:, :2, 3])[0]
    forward = 1.0 if station[-1] >= station[0] else -1.0
    length = place.route.length

    def camera_station(time: float) -> float:
        return float(np.interp(time, times, station))

    def pose(at: float, lateral: float, turn: float) -> tuple[Array, float]:
        if not 0.0 <= at <= length:
            return _OUT_OF_SIGHT, 0.0
        return place.spot(at, lateral), place.heading(at) + turn

    found = []
    for k in range(_WALKERS):
        meeting = times[0] + (k + rng.uniform(0.3, 0.7)) / _WALKERS * np.ptp(times)
        at = camera_station(meeting) + forward * rng.uniform(*_MEETING_DISTANCE)
        speed, side = rng.uniform(*_WALKING_SPEED), rng.choice([-1.0, 1.0])

        def walk(
            time: float, at: float = at, meeting: float = meeting, speed: float = speed, side: float = side
        ) -> tuple[Array, float]:
            lateral = speed * (time - meeting)
            return pose(at, side * lateral, side * 0.5 * np.pi) if abs(lateral) < _CROSSING else (_OUT_OF_SIGHT, 0.0)

        found.append(Mover(f"walker_{k}", _walker(place, rng), walk))
    for k in range(_CARS):
        meeting = times[0] + (k + rng.uniform(0.3, 0.7)) / _CARS * np.ptp(times)
        oncoming = k == 0
        speed = forward * rng.uniform(*_CAR_SPEED) * (-1.0 if oncoming else 1.0)
        at = camera_station(meeting)
        kind, skin = str(rng.choice(VEHICLES)), str(rng.choice(_SKINS))

        def drive(time: float, at: float = at, meeting: float = meeting, speed: float = speed) -> tuple[Array, float]:
            return pose(at + speed * (time - meeting), forward * _CAR_LATERAL, 0.0 if speed > 0.0 else np.pi)

        found.append(Mover(f"moving_car_{k}", _vehicle(place, kind, skin), drive))
    return found


def parked_cars(place: KnownPlace, start: float, length: float) -> list[PlaceObject]:
    """Cars parked along `length` [m] of the road from station `start` on; they are not added to the place."""
    rng = np.random.default_rng([SEED, 52, place.number])
    before = len(place.objects)
    for k in range(_PARKED):
        kind, skin = str(rng.choice(VEHICLES)), str(rng.choice(_SKINS))
        station = start + (k + rng.uniform(0.35, 0.75)) / _PARKED * length
        side = -1.0 if k % 2 else 1.0
        add_vehicle(place, 100 + k, station, side * (_PARKED_GAP + vehicle_size(kind)[1] / 2), 0.0, kind, skin)
    cars = place.objects[before:]
    del place.objects[before:]
    return cars


def _vehicle(place: KnownPlace, kind: str, skin: str) -> MeshPart:
    """A vehicle's mesh with its foot at the origin."""
    add_vehicle(place, 0, 0.0, 0.0, 0.0, kind, skin)
    part, foot, yaw = place.objects.pop().part, place.spot(0.0, 0.0), place.heading(0.0)
    low = part.vertices[:, 2].min()
    return part.moved(np.array([-foot[0], -foot[1], -low])).moved(np.zeros(3), -yaw)


def _walker(place: KnownPlace, rng: np.random.Generator) -> MeshPart:
    """A walker's mesh in mid-stride, about 1.75 m tall."""
    coat, trousers = (str(rng.choice(_SKINS)) for _ in range(2))
    scale = rng.uniform(0.92, 1.08)

    def limb(skin: str, low: tuple[float, ...], high: tuple[float, ...], radius: float) -> MeshPart:
        return place.cell(skin, primitives.tube(np.array(low), np.array(high), radius, 1.15 * radius, 10))

    parts = [
        limb(trousers, (0.28, 0.1, 0.0), (0.0, 0.09, 0.85), 0.075),
        limb(trousers, (-0.28, -0.1, 0.0), (0.0, -0.09, 0.85), 0.075),
        limb(coat, (0.0, 0.0, 0.8), (0.02, 0.0, 1.45), 0.17),
        limb(coat, (-0.22, 0.24, 0.85), (0.0, 0.2, 1.42), 0.05),
        limb(coat, (0.22, -0.24, 0.85), (0.0, -0.2, 1.42), 0.05),
        limb("planks", (0.02, 0.0, 1.5), (0.03, 0.0, 1.74), 0.09),
    ]
    mesh = primitives.join(parts)
    return MeshPart(scale * mesh.vertices, mesh.faces, mesh.uv)
