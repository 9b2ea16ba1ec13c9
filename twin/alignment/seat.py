"""How the front camera sits on a robot, by where it was while the robot drove over known ground.

The *seat* is the camera's height above flat ground and how it is turned from looking straight ahead: yaw to the left,
pitch down, roll to the right. Height, pitch and roll are what a pose differs by from that of a base at rest on the
ground below. Yaw shows in the direction of travel: a base that does not slide sideways goes where it heads, so what its
steps, from frame to frame, go sideways must not add up along the way. A camera ahead of the point that the robot turns
about swings outwards, so that the distance between the two is fitted along.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from twin.errors import InputError
from twin.geometry.cameras import opencv_to_mujoco
from twin.mjcf.export import rest_pose
from twin.robot import BASE_HEIGHT, HuskyParams

Array = NDArray[np.float64]

_MIN_FRAMES, _MIN_WAY = 16, 6.0  # frames, [m]
_PARTS = 8  # of the film, by whose disagreement errors are told
_NOISE, _OUTLYING = 0.01, 0.03  # [m] that a sum of sideways steps is off, and from which on it counts less
_PIVOT = 0.1  # [m] that the point the robot turns about may well be before or behind the base's origin
_ROUNDS = 3
_FAR_OFF, _JUMP = 8.0, 3.0  # medians: from the middle, and of steps
_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes right, down and forward (columns) of a camera that looks straight ahead, in the base."""


@dataclass(frozen=True)
class Seat:
    """Values or standard errors of a camera's seat.

    By how far the principal point is not where it was taken to be, yaw and pitch are off, and so they should: seen in
    pictures they are the same.
    """

    height: float
    """[m]"""
    yaw: float
    """[°]"""
    pitch: float
    """[°]"""
    roll: float
    """[°]"""


def find_seat(
    camera_to_world: Array, ground_at: Callable[[Array], Array], offset: tuple[float, float]
) -> tuple[Seat, Seat]:
    """The seat, and its standard errors: a jackknife over consecutive parts of the film.

    Args:
        camera_to_world: OpenCV axes, in the order they were filmed [m], shape (n, 4, 4).
        ground_at: Height of the ground [m] at points (n, 2), shape (n,).
        offset: Of the lens forward and left of the base's origin [m].

    Raises:
        InputError: too few frames, or too short a way.
    """
    poses = np.asarray(camera_to_world, float)
    way = float(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum())
    if len(poses) < _MIN_FRAMES or way < _MIN_WAY:
        raise InputError(
            f"{len(poses)} frames of the film were found on the place, over {way:.1f} m; expected at least "
            f"{_MIN_FRAMES} over {_MIN_WAY:g} m; drive further, slowly, on the filmed path and in light such as some "
            "film's"
        )
    yaw, lens = 0.0, np.array([*offset, 0.0])
    headings = heading_of(poses, 0.0)
    for _ in range(_ROUNDS):  # where a base is and heads shows once it is known how the camera sits on it
        angles, heights, bases = _stances(poses, headings - yaw, ground_at, lens)
        sound = _sound(np.column_stack([angles[:, 1:], heights]))
        lens[2], headings = heights[sound].mean(), _headings(poses, angles[sound, 1:].mean(0))
        yaw = _yaw(bases, headings, sound)
    part = np.arange(len(poses)) * _PARTS // len(poses)
    without = []
    for k in range(_PARTS):
        rest = sound & (part != k)
        without.append((heights[rest].mean(), _yaw(bases, headings, rest), *angles[rest, 1:].mean(0)))
    spread = np.sqrt((_PARTS - 1) * np.var(without, axis=0))
    value = Seat(float(lens[2]) + BASE_HEIGHT, float(np.degrees(yaw)), *np.degrees(angles[sound, 1:].mean(0)).tolist())
    return value, Seat(float(spread[0]), *np.degrees(spread[1:]).tolist())


def seated(params: HuskyParams, position: Array, heading: float, ground_at: Callable[[Array], Array]) -> Array:
    """camera_to_world (4, 4), OpenCV axes, of a robot's camera at x, y (2,) [m] whose base heads some way [rad]."""
    base, rotation = _base(position, heading, ground_at, np.array(params.camera_position))
    pose = np.eye(4)
    pose[:3, :3] = rotation @ params.camera_rotation
    pose[:3, 3] = base + rotation @ params.camera_position
    return opencv_to_mujoco(pose)  # which turns either into the other


def heading_of(camera_to_world: Array, yaw: float) -> Array:
    """Headings [rad] of bases whose cameras have these poses (..., 4, 4) and look left by a yaw [rad], shape (...)."""
    return np.arctan2(camera_to_world[..., 1, 2], camera_to_world[..., 0, 2]) - yaw


def _headings(poses: Array, lean: Array) -> Array:
    """Headings [rad] (n,) of bases whose cameras look straight ahead but for a pitch and a roll [rad] (2,)."""
    base = poses[:, :3, :3] @ _AHEAD.T @ Rotation.from_euler("YX", lean).as_matrix().T
    return np.arctan2(base[:, 1, 0], base[:, 0, 0])


def _sound(values: Array) -> NDArray[np.bool_]:
    """Which frames (n, k) lie where most do, in every column."""
    off = np.abs(values - np.median(values, axis=0))
    return (off <= _FAR_OFF * np.maximum(np.median(off, axis=0), 1e-6)).all(1)


def _yaw(bases: Array, headings: Array, use: NDArray[np.bool_]) -> float:
    """How far the camera looks left of where the base goes [rad].

    Args:
        bases: Where the base is, x, y [m], shape (n, 2).
        headings: Of the base if that were nothing [rad], shape (n,).
        use: Frames, shape (n,). Steps are added up between those that follow each other; where some are left out, or
            the robot seems to have jumped, a new sum begins.
    """
    way = np.diff(bases, axis=0)
    length = np.linalg.norm(way, axis=1)
    goes_on = use[1:] & use[:-1] & (length <= _JUMP * np.median(length))
    pieces = [piece for piece in np.split(np.arange(len(bases)), np.flatnonzero(~goes_on) + 1) if len(piece) > 2]

    def sideways(unknown: Array) -> Array:
        """What the point that the robot turns about, `pivot` before the base's origin [m], went sideways [m] up to each
        frame of a piece, less the piece's mean."""
        yaw, pivot = unknown
        heads = headings - yaw
        off = way + np.diff(pivot * np.stack([np.cos(heads), np.sin(heads)], 1), axis=0)
        middle = heads[:-1] + np.angle(np.exp(1j * np.diff(heads))) / 2.0
        step = off[:, 1] * np.cos(middle) - off[:, 0] * np.sin(middle)
        sums = [np.append(0.0, np.cumsum(step[piece[:-1]])) for piece in pieces]
        return np.concatenate([*(one - one.mean() for one in sums), [_NOISE * pivot / _PIVOT]])

    return float(least_squares(sideways, np.zeros(2), loss="soft_l1", f_scale=_OUTLYING).x[0])


def _stances(
    poses: Array, headings: Array, ground_at: Callable[[Array], Array], lens: Array
) -> tuple[Array, Array, Array]:
    """Of cameras over bases at rest below: yaw, pitch, roll [rad] (n, 3), heights above the bases' origins [m] (n,),
    and x, y of these [m] (n, 2)."""
    angles, heights, bases = np.zeros((len(poses), 3)), np.zeros(len(poses)), np.zeros((len(poses), 2))
    for i, (pose, heading) in enumerate(zip(poses, headings, strict=True)):
        base, rotation = _base(pose[:2, 3], heading, ground_at, lens)
        angles[i] = Rotation.from_matrix(rotation.T @ pose[:3, :3] @ _AHEAD.T).as_euler("ZYX")
        heights[i], bases[i] = (rotation.T @ (pose[:3, 3] - base))[2], base[:2]
    return angles, heights, bases


def _base(position: Array, heading: float, ground_at: Callable[[Array], Array], lens: Array) -> tuple[Array, Array]:
    """Origin [m] and axes (3, 3) of a base at rest whose lens, at a place in the base (3,), is at x, y (2,)."""
    rotation = Rotation.from_euler("Z", heading).as_matrix()
    arm = lens + np.array([0.0, 0.0, BASE_HEIGHT])  # from the ground
    for _ in range(2):  # a base that leans carries its lens to the side
        origin, (w, x, y, z) = rest_pose(ground_at, position - (rotation @ arm)[:2], heading)
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    return origin, rotation
