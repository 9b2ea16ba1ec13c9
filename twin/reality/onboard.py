"""What the camera of reality's Husky takes besides trials: no poses come with it.

A film while someone drives it down the filmed road, in light that was filmed, too, tells `twin.align` how the camera
sits. A photo in the weather of a trial, from where the robot then stands, tells `twin.relight` what day it is.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.env.options import Options
from twin.errors import InputError
from twin.geometry.images import write_image
from twin.progress import track
from twin.reality import world as worlds
from twin.reality.eye import Eye
from twin.reality.film import Plan, encode
from twin.reality.lighting import LIGHTINGS, Lighting
from twin.reality.raster import Raster
from twin.reality.road import Road, place
from twin.reality.robot import robot
from twin.reality.route import Route
from twin.reality.things import SEED
from twin.reality.weather import WEATHER

LIGHTING = "overcast"

_STATIONS = (4.0, 30.0)  # [m] along the road
_SPEED = 0.6  # [m/s]
_WEAVE, _PERIOD = 0.5, 11.0  # [m] to either side, [m] along the road: so that it turns a little
_TO_LINE, _TO_HEADING = 0.8, 1.5  # [rad/m], [1/s]
_FPS = 4
_CONTROL = 0.05  # [s]


def write(path: Path) -> None:
    """Drives and films; a few frames a second will do, as the robot is slow.

    Raises:
        InputError: no name of a film.
    """
    if path.suffix != ".mp4" or path.is_dir():
        raise InputError(f"{path}: expected the name of a film, such as robot.mp4")
    husky = robot()
    width, height = husky.params.camera_size
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = round((_STATIONS[1] - _STATIONS[0]) / _SPEED * _FPS)
    plan = replace(Plan(), width=width, height=height, fps=_FPS, crf=16)
    encode(track(_pictures(frames), "film from the robot", unit="frame", total=frames), plan, path)


def photograph(weather: str, path: Path) -> None:
    """Writes a photo, as `twin.relight` reads it.

    Raises:
        InputError: no such weather, or no name of a picture.
    """
    if weather not in WEATHER:
        raise InputError(f"lighting {weather!r}: reality's are {', '.join(WEATHER)}")
    if path.suffix not in (".png", ".jpg") or path.is_dir():
        raise InputError(f"{path}: expected the name of a picture, such as dawn.png")
    road, eye = _camera(WEATHER[weather])
    _stand(road, Route())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, eye.look(road.physics.camera_to_world, 0.0))


def _camera(light: Lighting) -> tuple[Road, Eye]:
    """The road, and the robot's camera on it with pictures of its full size."""
    husky = robot()
    road, size = Road("straight", husky, Options(pixels=False)), husky.params.camera_size
    intrinsics = road.intrinsics(size)
    raster = Raster(worlds.spec(light, place()).compile(), intrinsics, size)
    return road, Eye(raster, light, husky, intrinsics, size, np.random.default_rng([SEED, 43]))


def _stand(road: Road, line: Route) -> None:
    """Puts the robot on the road."""
    start = line.at(_STATIONS[0])
    road.physics.robot.place(float(start[0]), float(start[1]), float(line.heading(_STATIONS[0])))


def _pictures(count: int) -> Iterator[NDArray[np.uint8]]:
    line, (road, eye) = Route(), _camera(LIGHTINGS[LIGHTING])
    _stand(road, line)
    physics = road.physics.robot
    for i in range(count):
        yield eye.look(road.physics.camera_to_world, i / _FPS)
        for _ in range(round(1.0 / _FPS / _CONTROL)):
            physics.command(_SPEED, _towards(line, physics.planar_pose))
            physics.step(_CONTROL)


def _towards(line: Route, pose: NDArray[np.float64]) -> float:
    """Yaw rate [rad/s] that leads a base at x, y, yaw back to the weaving line."""
    station, lateral = (float(value[0]) for value in line.project(pose[None, :2]))
    phase = 2.0 * np.pi * station / _PERIOD
    slope = _WEAVE * 2.0 * np.pi / _PERIOD * np.cos(phase)
    wanted = float(line.heading(station)) + np.arctan(slope) - _TO_LINE * (lateral - _WEAVE * np.sin(phase))
    return float(_TO_HEADING * np.angle(np.exp(1j * (wanted - pose[2]))))
