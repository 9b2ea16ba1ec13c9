"""A place on the day of the trials: cones, bins, crates and cars have moved since the film."""

from functools import cache

import numpy as np

from twin.geometry.passes import path_length, smooth_path
from twin.reality import place as places
from twin.reality import true_world
from twin.reality.centerline import RoadLine
from twin.reality.drawn_place import build_number
from twin.reality.filming import FilmingPlan, trajectory
from twin.reality.lighting import Lighting
from twin.reality.place_objects import DrivenLine, KnownPlace
from twin.reality.rasterizer import SHADOW_RANGE, PlaceRenderer, Rasterizer
from twin.reality.stretches import StretchRenderer, is_long
from twin.types import Array

_LENGTH_TOLERANCE = 0.98  # least length of the route, as a fraction of the longest path


def true_route(plan: FilmingPlan | None = None, line: DrivenLine | None = None) -> Array:
    """The route on the true ground [m], shape (m, 3).

    As in a build, it is the path of the first film whose path has at least 98 % of the longest path's length.
    """
    plan, line = plan or FilmingPlan(), line or RoadLine()
    paths = [smooth_path(trajectory(plan, line, lighting)[1][:, :3, 3]) for lighting in plan.lightings]
    lengths = np.array([path_length(path) for path in paths])
    xy = paths[int(np.argmax(lengths >= _LENGTH_TOLERANCE * lengths.max()))]
    return np.column_stack([xy, line.ground_height(xy)])


@cache
def place_on_test_day(number: int = 0, length: float = 0.0) -> KnownPlace:
    """The place with a number on the day of the trials; `length` [m] as for `place_sampling.draw`."""
    return build_number(number, displaced=True, length=length) if number else places.build(displaced=True)


def rasterizer_of(place: KnownPlace, light: Lighting, intrinsics: Array, size: tuple[int, int]) -> PlaceRenderer:
    """The rasterizer of a place under a lighting for a camera: fx, fy, cx, cy [px], and width, height [px]."""

    def make(part: KnownPlace) -> Rasterizer:
        return Rasterizer(true_world.world_spec(light, part).compile(), intrinsics, size, shadow_range(part))

    return StretchRenderer(place, make) if is_long(place) else make(place)


def shadow_range(place: KnownPlace) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The box in which the rasterizer casts shadows: lowest and highest corner [m]."""
    if place.number == 0:
        return SHADOW_RANGE
    (x0, y0), (x1, y1) = place.layout.field
    height = place.route.ground_height(place.route.at(np.linspace(0.0, place.route.length, 100)))
    return (x0, y0, float(height.min()) - 1.5), (x1, y1, float(height.max()) + 6.0)
