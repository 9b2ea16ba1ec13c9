"""Stage `metric`: metres, z up, the floor under the path at z = 0.

The *level frame* this stage writes: z along the ground's normal away from it; the origin on the ground under the first
camera; x along the way driven first (east where the scale comes from GPS; unturned where the given poses are z-up
already). *Up*, the road and the path's evidence are `gravity.py`'s, the scale `scale.py`'s.
"""

from pathlib import Path
from typing import Any

import numpy as np

from twin.capture.capture_data import Capture
from twin.capture.gravity import Gravity, Road, camera_up, find_road, heights_above_road, up_from_ground
from twin.capture.scale import (
    Scale,
    chosen_way,
    scale_from_distance,
    scale_from_gps,
    scale_from_height,
    scale_from_marker,
)
from twin.config import SceneConfig
from twin.errors import InputError
from twin.files import write_json
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.poses import Similarity
from twin.geometry.route import refuse_jumps
from twin.scene import SceneDir
from twin.types import Array

_START = 0.08
"""The way driven first is the first part of the first source's path [share of its length]."""
_UNKNOWN_FLOOR = 0.02
"""Where no road is found the floor is this quantile of the points' heights."""


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Brings cameras and points into the level, metric frame.

    Writes `Cameras`, `SparsePoints` and `metric.json`.

    Returns:
        What `metric.json` holds: scale_source, scale, scale_uncertainty (relative), gravity_source,
        gravity_uncertainty_deg, camera_height_median_m, camera_height_spread_m, path_length_m, floor_source, the
        similarity from the reconstruction, and notes of the scale's own.

    Raises:
        InputError: no scale or several given, the chosen evidence is not in the data, or the path of a drive jumps.
    """
    cameras, points = Cameras.load(scene.stage("cameras")), SparsePoints.load(scene.stage("cameras"))
    capture = Capture.load(scene.stage("capture"))
    heights = {source.name: source.camera_height for source in capture.sources}
    way = chosen_way(config.metric, heights)
    if way == "poses_are_metric" and capture.camera_to_world is None:
        raise InputError(
            "metric.poses_are_metric: the input brought no poses; give metric.camera_height or another scale"
        )
    up, road = _find_up(cameras, points.xyz, config.metric.up, capture)
    level, floor_source = _ground_level(cameras, points.xyz, up.direction, road)
    east: Array | None = None
    if way == "camera_height":
        scale = scale_from_height(cameras, up.direction, points.xyz, road, config.metric.camera_height, heights)
    elif way == "distance":
        assert config.metric.distance is not None
        if road is None and not config.metric.distance.frame_b:
            raise InputError(
                "metric.distance: no ground was reconstructed to lay the points on; give frame_b, a2 and b2"
            )
        scale = scale_from_distance(cameras, up.direction, level, config.metric.distance)
    elif way == "gps":
        row = {name: i for i, name in enumerate(capture.names)}
        gps = capture.gps[[row[name] for name in cameras.names]]
        scale, (east, _) = scale_from_gps(cameras.positions, up.direction, gps, np.random.default_rng(config.seed))
    elif way == "marker":
        assert config.metric.marker is not None
        scale = scale_from_marker(cameras, config.metric.marker)
    else:
        scale = Scale(1.0, 0.0)
    similarity = _level_frame(cameras, up.direction, level, scale.value, east, keep=config.metric.up == "poses")
    placed, moved = cameras.transformed(similarity), points.transformed(similarity)
    if config.mjcf.route:
        refuse_jumps(placed)
    placed.save(out)
    moved.save(out)
    metrics = _metrics(placed, moved, way, scale, up, road, floor_source, similarity)
    write_json(out / "metric.json", metrics)
    return metrics


def _find_up(cameras: Cameras, points: Array, wanted: str, capture: Capture) -> tuple[Gravity, Road | None]:
    if wanted == "ground":
        return up_from_ground(cameras.camera_to_world, points)
    if wanted == "cameras":
        up = camera_up(cameras.camera_to_world)
        tilt = np.arccos(np.clip(-cameras.camera_to_world[:, :3, 1] @ up, -1.0, 1.0))
        found = Gravity(up, float(np.sqrt(np.mean(tilt**2)) / np.sqrt(min(len(cameras), 10))), "cameras")
    elif wanted == "poses":
        if capture.camera_to_world is None:
            raise InputError('metric.up = "poses": the input brought no poses; use "ground" or "cameras"')
        found = Gravity(np.array([0.0, 0.0, 1.0]), 0.0, "poses")
    else:
        raise InputError(f"metric.up = {wanted!r}; expected ground, cameras or poses")
    return found, find_road(points, cameras.positions, found.direction)


def _ground_level(cameras: Cameras, points: Array, up: Array, road: Road | None) -> tuple[float, str]:
    """Height of the floor along `up`, in the unit of the reconstruction, and where it comes from."""
    if road is not None and road.reliable:
        return float(np.median(points[road.points] @ up)), "road points under the path"
    if road is not None:
        where = f"{len(road.points)} points within {road.reach:g} camera heights of the path"
        return float(np.median(cameras.positions @ up)) - road.drop, where
    heights = points @ up
    if len(heights):
        return float(np.quantile(heights, _UNKNOWN_FLOOR)), "lowest points"
    return float((cameras.positions @ up).min()), "lowest camera"


def _level_frame(cameras: Cameras, up: Array, level: float, scale: float, east: Array | None, keep: bool) -> Similarity:
    """From the reconstruction to the level frame."""
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
    """Horizontal direction of the first part of the first source's path; where it stands still, of its first view."""
    centres = cameras.positions[np.array(cameras.sources) == cameras.sources[0]]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    end = int(np.searchsorted(along, max(_START * along[-1], 1e-12)))
    way = centres[min(max(end, 1), len(centres) - 1)] - centres[0]
    way = way - (way @ up) * up
    for axis in (2, 1, 0):
        if np.linalg.norm(way) > 1e-9:
            break
        way = cameras.camera_to_world[0, :3, axis]
        way = way - (way @ up) * up
    return way


def _metrics(
    cameras: Cameras,
    points: SparsePoints,
    way: str,
    scale: Scale,
    up: Gravity,
    road: Road | None,
    floor_source: str,
    similarity: Similarity,
) -> dict[str, Any]:
    heights = cameras.positions[:, 2]
    spread = 1.4826 * float(np.median(np.abs(heights - np.median(heights))))
    if road is not None and road.reliable:
        z_up = np.array([0.0, 0.0, 1.0])
        local = heights_above_road(points.xyz[road.points], cameras.positions, z_up, road.drop * scale.value)
        if local is not None:
            heights = local[np.isfinite(local)]
            spread = 1.4826 * float(np.median(np.abs(heights - np.median(heights))))
    sources = np.array(cameras.sources)
    lengths = [
        float(np.linalg.norm(np.diff(cameras.positions[sources == name], axis=0), axis=1).sum())
        for name in dict.fromkeys(cameras.sources)
    ]
    return {
        "scale_source": way,
        "scale": scale.value,
        "scale_uncertainty": scale.uncertainty,
        "gravity_source": up.source,
        "gravity_uncertainty_deg": float(np.degrees(up.uncertainty)),
        "floor_source": floor_source,
        "road_points": len(road.points) if road is not None else 0,
        "road_reliable": bool(road is not None and road.reliable),
        "camera_height_median_m": float(np.median(heights)),
        "camera_height_spread_m": spread,
        "path_length_m": max(lengths),
        "similarity": {
            "scale": similarity.scale,
            "rotation": similarity.rotation.tolist(),
            "translation": similarity.translation.tolist(),
        },
        **scale.notes,
    }
