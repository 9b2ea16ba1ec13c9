"""Benchmark of the routes that twin finds in random simulated filmings: laps, there and back, stops, reversals, cuts.

    python benchmarks/routes.py [--first 1] [--count 40]

The number of a filming seeds it. Numbers 1 to 999 are for development; those from 1,000 on are for reports, each used
once. A filming is a set of camera poses along a random line, with errors like those of structure from motion, so no
pictures are needed. Prints a row per filming: the kind, the route's largest distance from the filmed line, the largest
step between its points, its sharpest turn over 2 m, and its length divided by that of the longest path filmed without
interruption. The exit status is 1 if a route is more than 0.3 m off the filmed line, has a step above 0.3 m, or turns
by more than 120°.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.geometry.passes import path_directions, path_length
from twin.geometry.route import filmed_route
from twin.types import Array

KINDS = (
    *("once", "stops", "backs_up", "frames_lost", "twice_with_cut", "there_and_back_on_the_spot"),
    *("there_and_back_other_lane", "laps", "loop_at_the_end", "cut_in_two", "two_films_overlapping"),
    *("two_films_with_gap", "two_lightings_one_reversed", "jump_ahead"),
)
_DENSE = 0.05  # [m] between points of a line
_MAX_OFF, _MAX_STEP, _MAX_TURN = 0.3, 0.3, 120.0  # [m], [m], [°]
_MIN_LENGTH = 0.9  # of the filmed line


@dataclass(frozen=True)
class Filming:
    """Cameras of a random filming and the true lines that the camera moved along."""

    kind: str
    cameras: Cameras
    lines: tuple[Array, ...]
    """True lines (m, 2) [m]; if the film has a gap, also the line across it, since a route may cross it."""
    longest: float
    """Length of the longest path filmed without interruption [m], without turning maneuvers."""


def drawn_line(rng: np.random.Generator, length: float) -> Array:
    """A road's center line of straights and bends of 6 to 40 m radius, points 5 cm apart."""
    curvature = list[float]()
    while len(curvature) * _DENSE < length:
        curvature += [0.0] * round(rng.uniform(4.0, 20.0) / _DENSE)
        radius, angle = float(np.exp(rng.uniform(np.log(6.0), np.log(40.0)))), rng.uniform(0.3, 1.6)
        curvature += [float(rng.choice([-1.0, 1.0])) / radius] * round(radius * angle / _DENSE)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(curvature[: round(length / _DENSE)]) * _DENSE
    return np.cumsum(np.stack([np.cos(heading), np.sin(heading)], -1) * _DENSE, 0)


def shifted(line: Array, lateral: float) -> Array:
    """A line moved to its left by `lateral` [m]."""
    along = path_directions(line, chord=5.0)
    return line + lateral * np.stack([-along[:, 1], along[:, 0]], -1)


def arc(start: Array, end: Array) -> Array:
    """The half circle from one point to another, turning left."""
    middle, half = (start + end) / 2, (start - end) / 2
    angle = np.linspace(0.0, np.pi, 60)
    turned = np.stack(
        [np.cos(angle) * half[0] - np.sin(angle) * half[1], np.sin(angle) * half[0] + np.cos(angle) * half[1]]
    )
    return middle + turned.T


def draw_filming(number: int) -> Filming:
    """The filming with this number; the kinds repeat in the order of `KINDS`."""
    rng = np.random.default_rng([2026, number])
    kind = KINDS[number % len(KINDS)]
    line = drawn_line(rng, rng.uniform(25.0, 90.0))
    total, spacing = path_length(line), rng.uniform(0.3, 1.8)
    films: list[tuple[str, str, list[Array]]] = []  # source, lighting, pieces of the way
    bridges: list[Array] = []
    longest = total
    if kind == "backs_up":
        k, back = rng.integers(len(line) // 3, 2 * len(line) // 3), round(rng.uniform(2.0, 6.0) / _DENSE)
        films = [("a", "day", [line[:k], line[k - back : k][::-1], line[k - back :]])]
    elif kind == "twice_with_cut":
        films = [("a", "day", [line, shifted(line, rng.uniform(-0.5, 0.5))])]
    elif kind == "there_and_back_on_the_spot":
        films = [("a", "day", [line, line[::-1]])]
    elif kind == "there_and_back_other_lane":
        lane = shifted(line, rng.uniform(2.4, 3.6))
        films = [("a", "day", [line, arc(line[-1], lane[-1]), lane[::-1]])]
    elif kind == "laps":
        radius = rng.uniform(8.0, 20.0)
        angle = np.linspace(0.0, 2 * np.pi * rng.uniform(1.6, 2.5), 4000)
        films = [("a", "day", [radius * np.stack([np.cos(angle), np.sin(angle)], -1)])]
        longest = 2 * np.pi * radius
    elif kind == "loop_at_the_end":
        radius, end = rng.uniform(6.0, 12.0), path_directions(line)[-1]
        normal = np.array([-end[1], end[0]])
        angle = np.linspace(0.0, 2 * np.pi, 1500)[:, None]
        loop = line[-1] + radius * (normal * (1 - np.cos(angle)) + end * np.sin(angle))
        films = [("a", "day", [line, loop])]
        longest = total + path_length(loop) - 6.0
    elif kind == "cut_in_two":
        k = len(line) // 2
        films = [("a", "day", [line[:k]]), ("b", "day", [line[k:]])]
    elif kind == "two_films_overlapping":
        k, over = len(line) // 2, round(rng.uniform(3.0, 10.0) / _DENSE)
        second = shifted(line, rng.uniform(-0.4, 0.4))
        films = [("a", "day", [line[:k]]), ("b", "day", [second[k - over :]])]
    elif kind == "two_films_with_gap":
        k, gap = len(line) // 2, round(rng.uniform(1.0, 7.0) / _DENSE)
        films = [("a", "day", [line[:k]]), ("b", "day", [line[k + gap :]])]
        bridges, longest = [line[k : k + gap]], max(k, len(line) - k - gap) * _DENSE
    elif kind == "two_lightings_one_reversed":
        films = [("a", "day", [line]), ("b", "night", [shifted(line, 1.0)[::-1]])]
    elif kind == "jump_ahead":
        k, gap = len(line) // 2, round(rng.uniform(6.0, 20.0) / _DENSE)
        gap = min(gap, len(line) - k - round(3.0 / _DENSE))
        films = [("a", "day", [line[:k], line[k + gap :]])]
        bridges, longest = [line[k : k + gap]], max(k, len(line) - k - gap) * _DENSE
    else:
        films = [("a", "day", [line])]
    cameras = [_filmed(rng, kind, *film, spacing) for film in films]
    merged = Cameras(
        names=tuple(name for one in cameras for name in one.names),
        camera_to_world=np.concatenate([one.camera_to_world for one in cameras]),
        intrinsics=np.concatenate([one.intrinsics for one in cameras]),
        sizes=np.concatenate([one.sizes for one in cameras]),
        lightings=tuple(name for one in cameras for name in one.lightings),
        sources=tuple(name for one in cameras for name in one.sources),
        times=np.concatenate([one.times for one in cameras]),
        held_out=np.concatenate([one.held_out for one in cameras]),
        images=Path("images"),
    )
    lines = tuple(piece for _, _, pieces in films for piece in pieces)
    return Filming(kind, merged, (*lines, *bridges), longest)


def _filmed(
    rng: np.random.Generator, kind: str, source: str, lighting: str, pieces: list[Array], spacing: float
) -> Cameras:
    """Frames about `spacing` [m] apart along pieces of the way, with noise in position and heading."""
    xy, heading, times, now = list[Array](), list[float](), list[float](), 0.0
    frame_time = 0.5
    for piece in pieces:
        station = np.arange(0.0, path_length(piece), spacing)
        station = np.sort(station + rng.uniform(-0.2, 0.2, len(station)) * spacing)
        knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(piece, axis=0), axis=1))])
        at = np.stack([np.interp(station, knots, piece[:, k]) for k in range(2)], -1)
        along = path_directions(piece, chord=2.0)[np.searchsorted(knots, np.clip(station, 0.0, knots[-1]))]
        backwards = kind == "backs_up" and len(xy) and piece is pieces[1]
        for point, direction in zip(at, -along if backwards else along, strict=True):
            xy.append(point)
            heading.append(float(np.arctan2(direction[1], direction[0])))
            times.append(now)
            now += frame_time
    if kind == "stops":
        k, n = int(rng.integers(2, len(xy) - 2)), int(rng.integers(5, 40))
        xy[k:k] = [xy[k] + 0.1 * rng.standard_normal(2) for _ in range(n)]
        heading[k:k] = [heading[k]] * n
        times = [frame_time * i for i in range(len(xy))]
    if kind == "frames_lost":
        k, n = int(rng.integers(2, len(xy) // 2)), max(1, int(rng.integers(2, 6) / spacing))
        for some in (xy, heading, times):
            del some[k : k + n]
    n = len(xy)
    yaw = np.array(heading) + 0.03 * rng.standard_normal(n)
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, 0, 0], pose[:, 1, 0] = np.sin(yaw), -np.cos(yaw)  # right
    pose[:, :3, 1] = [0.0, 0.0, -1.0]  # down
    pose[:, 0, 2], pose[:, 1, 2], pose[:, 2, 2] = np.cos(yaw), np.sin(yaw), 0.0  # forward
    pose[:, :2, 3], pose[:, 2, 3] = np.array(xy) + 0.02 * rng.standard_normal((n, 2)), 1.2
    if n > 20 and rng.random() < 0.3:  # one frame is registered wrongly
        pose[int(rng.integers(5, n - 5)), :3, 3] += [1.5 + 4.0 * spacing, -2.0 - 4.0 * spacing, 0.5]
    return Cameras(
        tuple(f"{source}/{i:06d}" for i in range(n)),
        pose,
        np.tile([300.0, 300.0, 320.0, 180.0], (n, 1)),
        np.tile([640, 360], (n, 1)),
        (lighting,) * n,
        (source,) * n,
        np.array(times),
        np.zeros(n, bool),
        Path("images"),
    )


def measure(filming: Filming) -> dict[str, float]:
    """Largest distance from the filmed line [m], largest step [m], sharpest turn over 2 m [°], length / `longest`."""
    route = filmed_route(filming.cameras)
    line, film = route.line, np.concatenate(filming.lines)
    off = np.array([np.linalg.norm(film - point, axis=1).min() for point in line])
    along = path_directions(line)
    turn = np.rad2deg(np.arccos(np.clip((along[8:] * along[:-8]).sum(1), -1.0, 1.0)))
    return {
        "off": float(off.max()),
        "step": float(np.linalg.norm(np.diff(line, axis=0), axis=1).max()),
        "turn": float(turn.max(initial=0.0)),
        "length": path_length(line) / filming.longest,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1, help="number of the first filming (default %(default)s)")
    parser.add_argument("--count", type=int, default=40, help="number of filmings (default %(default)s)")
    options = parser.parse_args()
    bad = refused = 0
    print(f"{'number':>6} {'kind':28} {'off [m]':>8} {'step [m]':>9} {'turn [°]':>9} {'length':>7}")
    for number in range(options.first, options.first + options.count):
        filming = draw_filming(number)
        try:
            row = measure(filming)
        except InputError as error:
            refused += 1
            print(f"{number:6} {filming.kind:28} refused: {error}")
            continue
        wrong = row["off"] > _MAX_OFF or row["step"] > _MAX_STEP or row["turn"] > _MAX_TURN
        wrong = wrong or row["length"] < _MIN_LENGTH
        bad += wrong
        figures = f"{row['off']:8.2f} {row['step']:9.2f} {row['turn']:9.0f} {row['length']:7.2f}"
        print(f"{number:6} {filming.kind:28} {figures}{'  WRONG' if wrong else ''}")
    print(f"{options.count} filmings: {bad} wrong, {refused} refused")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
