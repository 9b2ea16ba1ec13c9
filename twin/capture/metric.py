"""Stage `metric`: transforms cameras and points to metric, level coordinates, the *level frame*.

z points up along the ground's normal; z = 0 is the ground. The origin is on the ground below the first camera. x is the
initial driving direction, or east if the scale comes from GPS. With metric.up = "poses", the level frame keeps the axes
and the horizontal origin of the given poses. `gravity.py` estimates up and the road; `scale.py` estimates the scale.
"""

from pathlib import Path
from typing import Any

import numpy as np

from twin.capture.capture_data import Capture
from twin.capture.gravity import Gravity, Road, camera_up, find_road, heights_above_road, up_from_ground
from twin.capture.scale import (
    Scale,
    combine_scales,
    scale_from_distance,
    scale_from_gps,
    scale_from_height,
    scale_from_marker,
    scale_from_odometry,
)
from twin.config import SceneConfig
from twin.errors import InputError
from twin.files import write_json
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.passes import path_length, path_stations
from twin.geometry.poses import Similarity
from twin.scene import SceneDir
from twin.types import Array

_INITIAL_FRACTION = 0.08
"""Fraction of the first source's path, from its start, that gives the initial driving direction."""
_MAX_OFFSET = 10_000.0  # [m] largest coordinate of a camera; later stages compute in single precision
_SAME_HEIGHT = 0.1  # camera heights of sources that differ by more than this share are not the same
_MAX_UP_TILT = 45.0  # [°] largest angle between z of given poses that are z up, and the cameras' mean up axis
_FLOOR_QUANTILE = 0.02  # if no road is found, the floor is at this quantile of the points' heights


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Transforms cameras and points to the level, metric frame; writes `Cameras`, `SparsePoints` and `metric.json`.

    Returns the content of `metric.json`, see `_metrics`.

    Raises InputError: the data do not determine the scale, or with metric.up = "poses" the origin is far away.
    """
    cameras, points = Cameras.load(scene.stage("cameras")), SparsePoints.load(scene.stage("cameras"))
    capture = Capture.load(scene.stage("capture"))
    given = config.metric
    check_measured(capture, config)
    heights = {source.name: source.camera_height for source in capture.sources}
    up, road = _find_up(cameras, points.xyz, given.up)
    level, floor_source = _ground_level(cameras, points.xyz, up.direction, road)
    east: Array | None = None
    scales: dict[str, Scale] = {}
    if max((given.camera_height, *heights.values())) > 0:
        scales["camera_height"] = scale_from_height(cameras, up, points.xyz, road, given, heights)
    if given.distance is not None:
        scales["distance"] = scale_from_distance(cameras, up.direction, points.xyz, road, given.distance)
    row = {name: i for i, name in enumerate(capture.names)}
    rows = [row[name] for name in cameras.names]
    if given.gps:
        rng = np.random.default_rng(config.seed)
        scales["gps"], east = scale_from_gps(cameras, up.direction, capture.gps[rows], rng)
    if given.odometry and capture.odometry is not None:
        scales["odometry"] = scale_from_odometry(cameras, capture.odometry[rows], given.odometry_tolerance)
    if given.marker is not None:
        scales["marker"] = scale_from_marker(cameras, given.marker)
    if given.poses_are_metric:
        scales["poses_are_metric"] = Scale(1.0, 0.0)
    scale = combine_scales(scales)
    similarity = _level_frame(cameras, up.direction, level, scale.value, east, keep=given.up == "poses")
    cameras, points = cameras.transformed(similarity), points.transformed(similarity)
    offset = float(np.abs(cameras.positions).max())
    if given.up == "poses" and offset > _MAX_OFFSET:
        raise InputError(
            f'metric.up = "poses": a camera is {offset:,.0f} m from the origin (expected at most {_MAX_OFFSET:,.0f} '
            'm); subtract a common position from all poses, or use metric.up = "ground"'
        )
    cameras.save(out)
    points.save(out)
    stated = {name: heights[name] or given.camera_height for name in dict.fromkeys(cameras.sources)}
    metrics = _metrics(cameras, points, " + ".join(scales), scale, up, road, floor_source, similarity, stated)
    write_json(out / "metric.json", metrics)
    return metrics


def check_measured(capture: Capture, config: SceneConfig) -> None:
    """Raises InputError: a scale or a vertical is wanted that the films and photos do not have, whatever their cameras.

    Stage `cameras` calls this first, since it takes minutes.
    """
    given, other = config.metric, "give metric.camera_height or another scale"
    if capture.camera_to_world is None and given.poses_are_metric:
        raise InputError(f"metric.poses_are_metric: the input has no poses; {other}")
    if capture.camera_to_world is None and given.up == "poses":
        raise InputError('metric.up = "poses": the input has no poses; use "ground" or "cameras"')
    if given.odometry and capture.odometry is None:
        raise InputError(f"metric.odometry: no source is a bag with odometry; {other}")
    positions = int(np.isfinite(capture.gps[:, :2]).all(1).sum())
    if given.gps and positions < 3:
        raise InputError(f"metric.gps: {positions} frames have a position (need 3); {other}")


def _find_up(cameras: Cameras, points: Array, method: str) -> tuple[Gravity, Road | None]:
    if method == "ground":
        return up_from_ground(cameras.camera_to_world, points, cameras.sources)
    if method == "cameras":
        up = camera_up(cameras.camera_to_world)
        tilt = np.arccos(np.clip(-cameras.camera_to_world[:, :3, 1] @ up, -1.0, 1.0))
        gravity = Gravity(up, float(np.sqrt(np.mean(tilt**2)) / np.sqrt(min(len(cameras), 10))), "cameras")
    else:
        if (tilt := np.degrees(np.arccos(np.clip(camera_up(cameras.camera_to_world)[2], -1.0, 1.0)))) > _MAX_UP_TILT:
            raise InputError(
                f'metric.up = "poses": the cameras\' mean up axis is {tilt:.0f}° off the z axis of the given poses; '
                'expected poses with z up; use metric.up = "ground"'
            )
        gravity = Gravity(np.array([0.0, 0.0, 1.0]), 0.0, "poses")
    return gravity, find_road(points, cameras.positions, gravity.direction)


def _ground_level(cameras: Cameras, points: Array, up: Array, road: Road | None) -> tuple[float, str]:
    """Height of the floor along `up` in the unit of the reconstruction, and a description of its source."""
    if road is not None and road.reliable:
        return float(np.median(points[road.points] @ up)), "road points under the path"
    if road is not None:
        where = f"{len(road.points)} points within {road.reach:g} camera heights of the path"
        return float(np.median(cameras.positions @ up)) - road.drop, where
    heights = points @ up
    if len(heights):
        return float(np.quantile(heights, _FLOOR_QUANTILE)), "lowest points"
    return float((cameras.positions @ up).min()), "lowest camera"


def _level_frame(cameras: Cameras, up: Array, level: float, scale: float, east: Array | None, keep: bool) -> Similarity:
    """The similarity to the level frame; `keep` keeps the reconstruction's axes and horizontal origin."""
    first = cameras.positions[0]
    if keep:
        return Similarity(scale, np.eye(3), np.array([0.0, 0.0, -scale * level]))
    x_axis = east if east is not None else _driving_direction(cameras, up)
    x_axis = x_axis - (x_axis @ up) * up
    x_axis /= np.linalg.norm(x_axis)
    rotation = np.stack([x_axis, np.cross(up, x_axis), up])
    origin = first + (level - first @ up) * up
    return Similarity(scale, rotation, -scale * rotation @ origin)


def _driving_direction(cameras: Cameras, up: Array) -> Array:
    """Horizontal direction of the first part of the first source's path; without motion, that of the first view."""
    centers = cameras.positions[np.array(cameras.sources) == cameras.sources[0]]
    along = path_stations(centers)
    end = int(np.searchsorted(along, max(_INITIAL_FRACTION * along[-1], 1e-12)))
    direction = centers[min(max(end, 1), len(centers) - 1)] - centers[0]
    direction = direction - (direction @ up) * up
    for axis in (2, 1, 0):
        if np.linalg.norm(direction) > 1e-9:
            break
        direction = cameras.camera_to_world[0, :3, axis]
        direction = direction - (direction @ up) * up
    return direction


def _metrics(
    cameras: Cameras,
    points: SparsePoints,
    scale_source: str,
    scale: Scale,
    up: Gravity,
    road: Road | None,
    floor_source: str,
    similarity: Similarity,
    stated: dict[str, float],
) -> dict[str, Any]:
    heights = cameras.positions[:, 2]
    apart = _different_heights(np.array([stated[name] or np.nan for name in cameras.sources]), cameras.sources)
    if road is not None and road.reliable:
        z_up = np.array([0.0, 0.0, 1.0])
        local = heights_above_road(points.xyz[road.points], cameras.positions, z_up, road.drop * scale.value)
        if local is not None:
            apart = _different_heights(local, cameras.sources)
            heights = local[np.isfinite(local)]
    spread = 1.4826 * float(np.median(np.abs(heights - np.median(heights))))
    sources = np.array(cameras.sources)
    lengths = [path_length(cameras.positions[sources == name]) for name in dict.fromkeys(cameras.sources)]
    return {
        "scale_source": scale_source,
        "scale": scale.value,
        "scale_uncertainty": scale.uncertainty,
        "gravity_source": up.source,
        "gravity_uncertainty_deg": float(np.degrees(up.uncertainty)),
        "floor_source": floor_source,
        "road_points": len(road.points) if road is not None else 0,
        "road_reliable": bool(road is not None and road.reliable),
        "camera_height_median_m": float(np.median(heights)),
        "camera_height_spread_m": spread,
        **({"camera_height_m_of": apart} if apart else {}),
        "path_length_m": max(lengths),
        "similarity": {
            "scale": similarity.scale,
            "rotation": similarity.rotation.tolist(),
            "translation": similarity.translation.tolist(),
        },
        **scale.notes,
    }


def _different_heights(local: Array, sources: tuple[str, ...]) -> dict[str, float]:
    """Median camera height [m] of each source, given those of the frames (n,), NaN if unknown; empty if they agree."""
    names = np.array(sources)
    of = {name: local[(names == name) & np.isfinite(local)] for name in dict.fromkeys(sources)}
    found = {name: float(np.median(heights)) for name, heights in of.items() if len(heights)}
    values = np.array(list(found.values()))
    return found if len(found) > 1 and np.ptp(values) > _SAME_HEIGHT * np.median(values) else {}
