"""Stage `mesh`: collision and visual geometry in meters from the radiance field.

The stage renders views of the field, fits the ground, fuses a distance field above it, extracts the visual surface and
the solids, decomposes the solids into convex parts, and clears the corridor (`solids.py`) of them. It writes:

- `visual.npz`: colored triangles
- `ground.npz`, `ground.png`: the ground as a height field, and its picture from above
- `parts.npz`: convex parts of the obstacles
- `route.npz`: the route on the ground, unless the film goes around an object
"""

import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from twin import runtime
from twin.assets import convex, solids, tsdf
from twin.assets.ground import Ground, build_ground
from twin.assets.tsdf import FREE_SPACE_REACH, color_points
from twin.assets.views import ColorField, Views, render_views
from twin.config import MeshConfig, SceneConfig
from twin.geometry.cameras import Cameras, RenderableField, SparsePoints, project, scaled_intrinsics
from twin.geometry.images import write_image
from twin.geometry.passes import path_length
from twin.geometry.route import BRANCH, distance_to_route, every_second, filmed_branches, filmed_route, route_metrics
from twin.nerf.baked import BakedField
from twin.nerf.poles import Poles
from twin.scene import SceneDir
from twin.types import Array

_COUNTED_LENGTH = 100.0  # [m] on a longer route, the numbers below and those in `MeshConfig` are per this length
_VISUAL_FACES = 150_000
_MARGIN_ABOVE = 2.0  # [m] margin of the visual mesh's box above the highest obstacle
_MARGIN_BELOW = 1.0  # [m] margin of the visual mesh's box below the lowest ground
_VISUAL_GROUND_CELL = 0.4  # [m] smallest width of the ground triangles
_MAX_POLE = 3.1  # [m] what is higher is out of reach; comparisons end at the height of the highest part
_SPECK_AREA = 0.25  # [m²] smaller components are floaters, false surfaces in the air


def run(scene: SceneDir, config: SceneConfig, out: Path, device: str | None = None) -> dict[str, Any]:
    """Runs the stage, see `twin.build`. Raises InputError if the scene has a route but the camera hardly moved."""
    from twin.nerf.field import RadianceField

    field = RadianceField.load(scene.stage("field"), device)
    cameras = Cameras.load(scene.stage("metric"))
    points = SparsePoints.load(scene.stage("metric"))
    poles = Poles.load(scene.stage("field"))
    metrics = build_assets(field, cameras, points, config, out, scene.build / ".cache" / "convex", poles)
    baked = BakedField.load(scene.stage("field"), field.device)
    write_image(out / "ground.png", ground_picture(baked, cameras, Ground.load(out), baked.lightings[0]))
    return metrics


def build_assets(
    field: ColorField,
    cameras: Cameras,
    points: SparsePoints,
    config: SceneConfig,
    out: Path,
    cache: Path,
    poles: Poles | None = None,
) -> dict[str, Any]:
    """Writes the files of the stage, except `ground.png`, from any field; returns the metrics."""
    clock = [("start", time.perf_counter())]
    settings = config.mesh
    filmed = filmed_route(cameras, config.route) if config.mjcf.route else None
    route = filmed.line if filmed else None
    branches = filmed_branches(cameras, config.branch) if filmed else {}
    lines = () if route is None else (route, *branches.values())
    path = np.concatenate(lines) if lines else cameras.positions[:, :2]
    low, high = path.min(0) - settings.margin, path.max(0) + settings.margin
    if route is None:
        # In a capture around an object, everything outside the field's near box is background.
        low, high = np.maximum(low, field.bounds[0, :2]), np.minimum(high, field.bounds[1, :2])
    far = _far(settings)
    share = max(1.0, sum(path_length(line) for line in lines) / _COUNTED_LENGTH)
    views = render_views(field, cameras, round(share * settings.views), settings.view_width, FREE_SPACE_REACH * far)
    clock.append(("render", time.perf_counter()))
    height = _camera_height(config) if route is not None else None
    ground, ground_metrics = build_ground(
        views, cameras, points, (low, high), settings, height, path if lines else None
    )
    ground.save(out)
    clock.append(("ground", time.perf_counter()))
    top = float(ground.height.max()) + settings.max_height + _MARGIN_ABOVE
    box = np.stack([np.append(low, ground.height.min() - _MARGIN_BELOW), np.append(high, top)])
    corridor = None
    if route is not None:
        corridor = solids.Corridor(lines, config.mjcf.half_width + config.mjcf.corridor_margin)
        others = {f"{BRANCH}{name}": np.column_stack([line, ground.at(line)]) for name, line in branches.items()}
        np.savez(out / "route.npz", xy=route, z=ground.at(route), **others)  # type: ignore[arg-type]
        path = np.concatenate([every_second(line) for line in lines])
    poles = poles or Poles.none()
    poles = replace(poles, height=np.minimum(poles.height, _MAX_POLE))
    inside = (poles.foot[:, :2] > box[0, :2]) & (poles.foot[:, :2] < box[1, :2])
    posts = solids.pole_parts(poles.select(np.flatnonzero(inside.all(1))), corridor, ground)
    surface, solid, outvoted = _fuse_sections(views, ground, corridor, path, box, settings)
    clock.append(("fuse", time.perf_counter()))
    visual, visual_metrics = _visual_mesh(
        *surface, posts, views, ground, settings.voxel, FREE_SPACE_REACH * far, round(share * _VISUAL_FACES)
    )
    np.savez(out / "visual.npz", **visual)  # type: ignore[arg-type]
    clock.append(("surface", time.perf_counter()))
    pieces, left_out = solids.solid_pieces(solid, box[0], settings.voxel, path, settings)
    clock.append(("solids", time.perf_counter()))
    part_metrics = _save_parts(pieces, posts, corridor, ground, config, round(share * settings.max_parts), out, cache)
    clock.append(("convex", time.perf_counter()))
    return {
        **part_metrics,
        **visual_metrics,
        "poles_left_out": len(poles) - len(posts),
        "ground": ground_metrics | _roughness(ground, route),
        "views": len(views),
        "voxel_m": settings.voxel,
        "floaters": {
            "voxels_seen_through": outvoted,
            "surface_pieces": visual_metrics["floaters_removed"],
            "solid_specks": left_out["specks"],
        },
        "standing": left_out["standing"],
        "bounds_m": box.tolist(),
        "route_length_m": path_length(route) if route is not None else None,
        **({"branches_m": {name: path_length(line) for name, line in branches.items()}} if branches else {}),
        "route": route_metrics(filmed) if filmed else None,
        "seconds_of": {name: end - start for (_, start), (name, end) in pairwise(clock)},
    }


def _camera_height(config: SceneConfig) -> float:
    """The given height of the camera [m]; 0 (estimate it per source) if none is given or if the sources differ."""
    heights = {source.camera_height or config.metric.camera_height for source in config.source}
    return heights.pop() if len(heights) == 1 else 0.0


def _surface_points(views: Views, ground: Ground, box: Array, far: float) -> Array:
    """Rendered points (k, 3) [m] that are in the box and above the ground."""
    hits = [np.zeros((0, 3))]
    for i in range(len(views)):
        points = views.points(i)[(views.depth[i] > 0) & (views.depth[i] < far)]
        points = points[((points > box[0]) & (points < box[1])).all(1)]
        hits.append(points[points[:, 2] > ground.at(points[:, :2]) + 0.1])
    return np.concatenate(hits)


def _fuse_sections(
    views: Views, ground: Ground, corridor: solids.Corridor | None, path: Array, box: Array, settings: MeshConfig
) -> tuple[tuple[Array, NDArray[np.int64]], solids.SolidVoxels, int]:
    """Fuses the views in one section of the place after the other, since a long road would not fit into memory.

    Returns vertices (v, 3) [m] and faces (f, 3) of the zero level above the ground; the solid; and the number of voxels
    at which free votes removed a surface.
    """
    voxel, far = settings.voxel, _far(settings)

    def heights(low: Array, high: Array) -> tuple[float, float]:
        lowest, highest = ground.extremes(low, high)
        return lowest - _MARGIN_BELOW, highest + settings.max_height + _MARGIN_ABOVE

    surfaces, solid, outvoted = [], [], 0
    sections = tsdf.divide(box, voxel, solids.frame_width(voxel), heights)
    for section in sections if len(sections) == 1 else runtime.track(sections, "fusing depth", unit="section"):
        low = np.maximum(box[0] + voxel * section.start, box[0])
        high = np.minimum(box[0] + voxel * (section.start + section.shape), box[1])
        near = views.select(tsdf.views_of_box(views, low, high, FREE_SPACE_REACH * far))
        hits = _surface_points(near, ground, np.stack([low, high]), far)
        if not len(hits):
            continue
        volume = tsdf.fuse_volume(hits, near, box[0], voxel, section, far)
        vertices, faces = tsdf.section_surface(volume)
        above = vertices[:, 2] - ground.at(vertices[:, :2]) > 0.05
        surfaces.append(tsdf.compact(vertices, faces[above[faces].any(1)]))
        solid.append(solids.solid_voxels(volume, ground, corridor, path, settings))
        outvoted += volume.outvoted
    return tsdf.join_surfaces(surfaces, box[0], voxel), solids.SolidVoxels.join(solid), outvoted


def _far(settings: MeshConfig) -> float:
    """Depth up to which views vote for surfaces [m]."""
    return settings.margin + 2.0


def _visual_mesh(
    vertices: Array,
    faces: NDArray[np.int64],
    posts: list[convex.ConvexPart],
    views: Views,
    ground: Ground,
    voxel: float,
    far: float,
    max_faces: int,
) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Returns about `max_faces` colored triangles, two thirds of them above the ground, and metrics.

    `vertices` (v, 3) [m] and `faces` (f, 3) are the zero level above the ground, `posts` the parts of poles. Pixels of
    views that are deeper than `far` [m] are background.
    """
    band = tsdf.BAND_VOXELS * voxel
    reach = 1.1 * far + 4 * band  # surfaces beyond it differ by more than the tolerance from all depths
    colors, seen = color_points(vertices, tsdf.vertex_normals(vertices, faces), views, band, reach)
    # Valid distances form a band around each surface. The rear boundary of that band also yields triangles. They are no
    # surface, and no view sees them, so they are removed.
    vertices, faces = tsdf.compact(vertices, faces[seen[faces].all(1)])
    vertices, faces, floaters = tsdf.remove_specks(vertices, faces, _SPECK_AREA)
    vertices, faces = tsdf.decimate(vertices, faces, max_faces * 2 // 3)
    colors, seen = color_points(vertices, tsdf.vertex_normals(vertices, faces), views, 2 * band, reach)
    for post in posts:
        shade, shown = color_points(post.vertices, _outward(post), views, 2 * band, reach)
        faces = np.concatenate([faces, post.faces + len(vertices)])
        vertices = np.concatenate([vertices, post.vertices])
        colors, seen = np.concatenate([colors, shade]), np.append(seen, shown)
    if seen.any():
        colors[~seen] = colors[seen][cKDTree(vertices[seen]).query(vertices[~seen])[1]]
    ground_vertices, ground_faces = ground.triangles(_VISUAL_GROUND_CELL, max_faces // 3)
    column, row = np.rint((ground_vertices[:, :2] - ground.origin) / ground.cell).astype(int).T
    ground_colors = ground.rgb[row, column]
    standing = len(faces)
    faces = np.concatenate([faces, ground_faces + len(vertices)])
    vertices = np.concatenate([vertices, ground_vertices])
    colors = np.concatenate([colors, ground_colors])
    visual: dict[str, NDArray] = {"vertices": vertices.astype(np.float32), "faces": faces.astype(np.int32)}
    visual["colors"] = colors
    counts = {"faces": len(faces), "vertices": len(vertices), "standing_faces": standing, "floaters_removed": floaters}
    return visual, counts


def _outward(part: convex.ConvexPart) -> Array:
    """Unit vectors from a part's middle axis to its vertices, shape (v, 3)."""
    away = part.vertices - part.vertices.mean(0)
    away[:, 2] = 0.0
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def _save_parts(
    pieces: list[convex.SolidPiece],
    posts: list[convex.ConvexPart],
    corridor: solids.Corridor | None,
    ground: Ground,
    config: SceneConfig,
    max_parts: int,
    out: Path,
    cache: Path,
) -> dict[str, Any]:
    """Decomposes the pieces, clears the corridor, keeps the nearest `max_parts`, and writes `parts.npz`.

    `posts` are the parts of poles. They come last, in addition to the others.
    """
    bound = config.mesh.max_protrusion
    decomposition = convex.decompose(pieces, bound, cache, config.seed)
    kept = list(enumerate(decomposition.parts))
    clipped = 0
    if corridor is not None:
        kept, clipped = solids.clear_corridor(decomposition.parts, corridor, ground)
    dropped = len(kept) - max_parts
    if dropped > 0:
        # Parts are sorted by distance from the path; the farthest are the least relevant to the robot.
        kept = kept[:max_parts]
        runtime.log_line(f"  left out the {dropped} farthest convex parts, as mesh.max_parts = {config.mesh.max_parts}")
    parts = [*(part for _, part in kept), *posts]
    empty = np.zeros((0, 3))
    np.savez(
        out / "parts.npz",
        vertices=np.concatenate([empty, *(part.vertices for part in parts)]).astype(np.float32),
        faces=np.concatenate([empty, *(part.faces for part in parts)]).astype(np.int32),
        vertex_start=np.cumsum([0, *(len(part.vertices) for part in parts)]).astype(np.int64),
        face_start=np.cumsum([0, *(len(part.faces) for part in parts)]).astype(np.int64),
    )
    protrusion = decomposition.protrusion[[i for i, _ in kept]]
    return {
        "parts": len(parts),
        "poles": len(posts),
        "parts_left_out": max(dropped, 0),
        "pieces": len(pieces),
        "max_protrusion_m": float(protrusion.max(initial=0.0)),
        "parts_beyond_bound": int((protrusion > bound).sum()),
        "uncovered_share": decomposition.uncovered,
        "coacd_failed": decomposition.failed,
        "coacd_cached": decomposition.cached,
        "parts_halved": decomposition.split,
        "corridor_clipped": clipped,
    }


def _roughness(ground: Ground, route: Array | None) -> dict[str, float | None]:
    """RMS slope of the measured ground.

    With a route, also the RMS slope and curvature along it, and the share of the ground near it that was measured.
    """
    dy, dx = np.gradient(ground.height, ground.cell)
    slope = np.hypot(dx, dy)[ground.measured]
    metrics: dict[str, float | None] = {"slope_rms": float(np.sqrt(np.mean(slope**2))) if len(slope) else None}
    if route is not None and len(route) > 2:
        height = ground.at(route)
        step = path_length(route) / (len(route) - 1)
        metrics["route_slope_rms"] = float(np.sqrt(np.mean((np.diff(height) / step) ** 2)))
        metrics["route_bend_rms_per_m"] = float(np.sqrt(np.mean((np.diff(height, 2) / step**2) ** 2)))
        xy = ground.origin + ground.cell * np.stack(np.meshgrid(*map(np.arange, ground.height.shape[::-1])), -1)
        coarse = (slice(None, None, 4),) * 2
        beside = distance_to_route(route[::4], xy[coarse], 1.5) < 1.5
        # With wide cells no coarse node may be near the route.
        metrics["corridor_coverage"] = float(ground.measured[coarse][beside].mean()) if beside.any() else None
    return metrics


# ---- picture of the ground

_TEXEL = 0.025  # [m] side of a texel
_BEST_DISTANCE = 3.5  # [m] horizontal, from the lens to a texel; nearer texels are seldom in the image
_MAX_DISTANCE = 12.0  # [m]; farther ground keeps its mean color
_WIDTH = 640  # [px] width of the renderings
_MAX_TEXELS = 12_000_000
_DEPTH_TOLERANCE = 0.15  # a texel is visible if its depth differs from the rendered one by a smaller fraction


def ground_picture(field: RenderableField, cameras: Cameras, ground: Ground, lighting: str) -> NDArray[np.uint8]:
    """Picture of the ground from above under one lighting, shape (rows · k, columns · k, 3): MuJoCo's ground texture.

    The height field has rows × columns cells of k² texels each. Row 0 is at the lowest y. The picture is composed of
    renderings at filmed poses: a texel takes its color from the pose that has it ahead, at the distance nearest to
    `_BEST_DISTANCE`. Texels that no pose sees well have the ground's mean color.
    """
    rows, columns = (n - 1 for n in ground.height.shape)
    k = max(1, round(ground.cell / _TEXEL))
    while k > 1 and rows * columns * k * k > _MAX_TEXELS:
        k -= 1
    cells = ground.rgb.astype(np.uint16)
    cells = (cells[1:, 1:] + cells[1:, :-1] + cells[:-1, 1:] + cells[:-1, :-1] + 2) // 4
    picture = np.repeat(np.repeat(cells.astype(np.uint8), k, 0), k, 1)
    step = ground.cell / k
    best = np.full(picture.shape[:2], np.inf, np.float32)
    trained = cameras.select(np.flatnonzero([name == lighting for name in cameras.lightings]))
    reach = int(np.ceil(_MAX_DISTANCE / step))
    with runtime.bar("ground picture", len(trained), "view") as bar:
        for i in range(len(trained)):
            bar.update()
            pose = trained.camera_to_world[i]
            column, row = np.floor((pose[:2, 3] - ground.origin) / step).astype(int)
            low = np.maximum([row - reach, column - reach], 0)
            window = slice(low[0], max(0, row + reach)), slice(low[1], max(0, column + reach))
            v, u = np.indices(best[window].shape) + low[:, None, None]
            xy = ground.origin + (np.stack([u, v], -1) + 0.5) * step
            distance = np.linalg.norm(xy - pose[:2, 3], axis=-1)
            ahead = ((xy - pose[:2, 3]) @ pose[:2, 2]) > 0.5 * distance
            cost = np.abs(np.log(np.maximum(distance, 1e-3) / _BEST_DISTANCE)).astype(np.float32)
            at = np.flatnonzero((ahead & (distance < _MAX_DISTANCE) & (cost < best[window])).ravel())
            if not len(at):
                continue
            points = np.concatenate([xy.reshape(-1, 2)[at], ground.at(xy.reshape(-1, 2)[at])[:, None]], 1)
            width, height = trained.sizes[i].tolist()
            size = _WIDTH, max(2, round(_WIDTH * height / width))
            pixel, depth = project(points, pose, scaled_intrinsics(trained.intrinsics[i], (width, height), size))
            inside = (pixel > 0.5).all(1) & (pixel < np.array(size) - 0.5).all(1) & (depth > 0.1)
            if not inside.any():
                continue
            shown = field.render(trained.select(np.array([i])), lighting, size)
            at, pixel, depth = at[inside], pixel[inside], depth[inside]
            seen = shown.depth[0][tuple(pixel.astype(int).T[::-1])]
            visible = np.abs(seen / depth - 1.0) < _DEPTH_TOLERANCE
            across = pixel[visible].T[::-1] - 0.5
            colors = np.stack([map_coordinates(shown.rgb[0, ..., c], across, order=1) for c in range(3)], -1)
            where = np.unravel_index(at[visible], best[window].shape)
            picture[window][where] = np.clip(colors * 255.0 + 0.5, 0, 255).astype(np.uint8)
            best[window][where] = cost.ravel()[at[visible]]
    return picture
