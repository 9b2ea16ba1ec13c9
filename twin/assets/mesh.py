"""Stage mesh: from a radiance field to what can be touched, all metric.

Writes `visual.npz` (coloured triangles), `ground.npz` (height field), `parts.npz` (closed convex parts of what stands
on it) and, for a drive, `route.npz` (the filmed path on the ground). Order: render views → ground → distance field of
what stands above it → surface and solid → convex parts → corridor cleared.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import runtime
from twin.assets import convex, solids, tsdf
from twin.assets import ground as assets_ground
from twin.assets.ground import Ground
from twin.assets.tsdf import LOOK_THROUGH, colour
from twin.assets.views import ColorField, Views, render_views
from twin.config import SceneConfig
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.route import distance_to_route, filmed_route, route_length
from twin.scene import SceneDir
from twin.types import Array

_VISUAL_FACES = 150_000
_ABOVE = 2.0  # [m] the visual mesh reaches this much higher than the obstacles
_BELOW = 1.0  # [m] and this much below the lowest ground
_VISUAL_GROUND_CELL = 0.4  # [m] at least, before decimation
_SPECK_AREA = 0.25  # [m²] smaller pieces of surface are floaters


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """The stage, see `twin.build`. Raises InputError where a route is asked of a camera that hardly moved."""
    from twin.nerf.field import RadianceField

    field = RadianceField.load(scene.stage("field"))
    cameras = Cameras.load(scene.stage("metric"))
    points = SparsePoints.load(scene.stage("metric"))
    return make(field, cameras, points, config, out, scene.build / ".cache" / "convex")


def make(
    field: ColorField, cameras: Cameras, points: SparsePoints, config: SceneConfig, out: Path, cache: Path
) -> dict[str, Any]:
    """Everything of the stage, from any field. Returns its metrics."""
    clock = _Stopwatch()
    settings = config.mesh
    route = filmed_route(cameras) if config.mjcf.route else None
    path = route if route is not None else cameras.positions[:, :2]
    low, high = path.min(0) - settings.margin, path.max(0) + settings.margin
    if route is None:
        # Around an object the far is backdrop; what the field resolves is its near box.
        low, high = np.maximum(low, field.bounds[0, :2]), np.minimum(high, field.bounds[1, :2])
    far = settings.margin + 2.0
    views = render_views(field, cameras, settings.views, settings.view_width, LOOK_THROUGH * far)
    clock.lap("render")
    height = _camera_height(config) if route is not None else None
    ground, ground_facts = assets_ground.build_ground(views, cameras, points, (low, high), settings, height)
    ground.save(out)
    clock.lap("ground")
    top = float(ground.height.max()) + settings.max_height + _ABOVE
    box = np.stack([np.append(low, ground.height.min() - _BELOW), np.append(high, top)])
    hits = _hits(views, ground, box, far)
    volume = tsdf.fuse_volume(hits, views, box, settings.voxel, far)
    clock.lap("fuse")
    visual, visual_facts = _visual(volume, views, ground)
    np.savez(out / "visual.npz", **visual)  # type: ignore[arg-type]
    clock.lap("surface")
    corridor = None
    if route is not None:
        corridor = solids.Corridor(route, config.mjcf.half_width + config.mjcf.corridor_margin)
        np.savez(out / "route.npz", xy=route, z=ground.at(route))
    pieces, left_out = solids.solid_pieces(volume, ground, corridor, cameras, settings)
    clock.lap("solids")
    part_facts = _save_parts(pieces, corridor, ground, config, out, cache)
    clock.lap("convex")
    return {
        **part_facts,
        **visual_facts,
        "ground": ground_facts | _roughness(ground, route),
        "views": len(views),
        "voxel_m": volume.voxel,
        "floaters": {
            "voxels_seen_through": volume.seen_through,
            "surface_pieces": visual_facts["floaters_removed"],
            "solid_specks": left_out["specks"],
        },
        "standing": left_out["standing"],
        "bounds_m": box.tolist(),
        "route_length_m": route_length(route) if route is not None else None,
        "seconds_of": clock.laps,
    }


class _Stopwatch:
    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now


def _camera_height(config: SceneConfig) -> float:
    """The camera height that set the scale, where all sources share one; else 0: each source's is estimated."""
    heights = {source.camera_height or config.metric.camera_height for source in config.source}
    return heights.pop() if len(heights) == 1 else 0.0


def _hits(views: Views, ground: Ground, box: Array, far: float) -> Array:
    """Rendered points above the ground in the box, (k, 3)."""
    hits = []
    for i in range(len(views)):
        points = views.points(i)[(views.depth[i] > 0) & (views.depth[i] < far)]
        points = points[((points > box[0]) & (points < box[1])).all(1)]
        hits.append(points[points[:, 2] > ground.at(points[:, :2]) + 0.1])
    return np.concatenate(hits)


def _visual(volume: tsdf.Volume, views: Views, ground: Ground) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Coloured triangles: the seen side of what stands, and the ground as fitted."""
    vertices, faces = tsdf.zero_level(volume.distance, volume.origin, volume.voxel)
    above = vertices[:, 2] - ground.at(vertices[:, :2]) > 0.05
    vertices, faces = tsdf.compact(vertices, faces[above[faces].any(1)])
    colours, seen = colour(vertices, tsdf.vertex_normals(vertices, faces), views, volume.band)
    # The back of the band is no surface: no view looks at it from outside.
    vertices, faces = tsdf.compact(vertices, faces[seen[faces].all(1)])
    vertices, faces, floaters = tsdf.without_specks(vertices, faces, _SPECK_AREA)
    vertices, faces = tsdf.decimate(vertices, faces, _VISUAL_FACES * 2 // 3)
    colours, seen = colour(vertices, tsdf.vertex_normals(vertices, faces), views, 2 * volume.band)
    colours = _nearest_colour(vertices, colours, seen)
    ground_vertices, ground_faces = tsdf.height_mesh(ground, _VISUAL_GROUND_CELL, _VISUAL_FACES // 3)
    column, row = np.rint((ground_vertices[:, :2] - ground.origin) / ground.cell).astype(int).T
    rows, columns = ground.height.shape
    ground_colours = ground.rgb[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    visual: dict[str, NDArray] = {
        "vertices": np.concatenate([vertices, ground_vertices]).astype(np.float32),
        "faces": np.concatenate([faces, ground_faces + len(vertices)]).astype(np.int32),
        "colors": np.concatenate([colours, ground_colours]).astype(np.uint8),
    }
    return visual, {
        "faces": len(visual["faces"]),
        "vertices": len(visual["vertices"]),
        "standing_faces": len(faces),
        "floaters_removed": floaters,
    }


def _nearest_colour(vertices: Array, colours: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    if known.all() or not known.any():
        return colours
    from scipy.spatial import cKDTree

    out = colours.copy()
    out[~known] = colours[known][cKDTree(vertices[known]).query(vertices[~known])[1]]
    return out


def _save_parts(
    pieces: list[convex.SolidPiece],
    corridor: solids.Corridor | None,
    ground: Ground,
    config: SceneConfig,
    out: Path,
    cache: Path,
) -> dict[str, Any]:
    """Decomposes, clears the corridor, keeps the nearest parts within the budget, writes `parts.npz`."""
    bound = config.mesh.max_protrusion
    made = convex.decompose(pieces, bound, cache, config.seed)
    kept = list(enumerate(made.parts))
    clipped = 0
    if corridor is not None:
        kept, clipped = solids.clear_corridor(made.parts, corridor, ground)
    dropped = len(kept) - config.mesh.max_parts
    if dropped > 0:
        # Pieces come nearest first, and so do their parts: what goes is what the robot is least likely to meet.
        kept = kept[: config.mesh.max_parts]
        runtime.say(f"  {dropped} convex parts beyond mesh.max_parts = {config.mesh.max_parts} left out, the farthest")
    parts = [part for _, part in kept]
    corners = [len(part.vertices) for part in parts]
    triangles = [len(part.faces) for part in parts]
    nothing = np.zeros((0, 3))
    np.savez(
        out / "parts.npz",
        vertices=np.concatenate([nothing, *(part.vertices for part in parts)]).astype(np.float32),
        faces=np.concatenate([nothing, *(part.faces for part in parts)]).astype(np.int32),
        vertex_start=np.concatenate([[0], np.cumsum(corners)]).astype(np.int64),
        face_start=np.concatenate([[0], np.cumsum(triangles)]).astype(np.int64),
    )
    protrusion = made.protrusion[[i for i, _ in kept]]
    return {
        "parts": len(parts),
        "parts_left_out": max(dropped, 0),
        "pieces": len(pieces),
        "max_protrusion_m": float(protrusion.max(initial=0.0)),
        "parts_beyond_bound": int((protrusion > bound).sum()),
        "uncovered_share": made.uncovered,
        "coacd_failed": made.failed,
        "coacd_cached": made.cached,
        "parts_halved": made.halved,
        "corridor_clipped": clipped,
    }


def _roughness(ground: Ground, route: Array | None) -> dict[str, float | None]:
    """Root mean square slope of the measured ground, and along the route its slope and bend: what a wheel feels."""
    dy, dx = np.gradient(ground.height, ground.cell)
    slope = np.hypot(dx, dy)[ground.measured]
    facts: dict[str, float | None] = {"slope_rms": float(np.sqrt(np.mean(slope**2))) if len(slope) else None}
    if route is not None and len(route) > 2:
        height = ground.at(route)
        step = route_length(route) / (len(route) - 1)
        facts["route_slope_rms"] = float(np.sqrt(np.mean((np.diff(height) / step) ** 2)))
        facts["route_bend_rms_per_m"] = float(np.sqrt(np.mean((np.diff(height, 2) / step**2) ** 2)))
        xy = ground.origin + ground.cell * np.stack(np.meshgrid(*map(np.arange, ground.height.shape[::-1])), -1)
        coarse = (slice(None, None, 4),) * 2
        beside = distance_to_route(route[::4], xy[coarse]) < 1.5
        facts["corridor_coverage"] = float(ground.measured[coarse][beside].mean())
    return facts
