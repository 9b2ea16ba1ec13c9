"""Compares the visual geometry (radiance field) with the collision geometry along a drive of the robot's camera.

*Gap*: z-depth of the collision geometry minus that of the field, along a pixel's ray. *Visual-only* geometry ("leak" in
the report's keys) is visible but has no collision geometry. *Collision-only* geometry ("ghost") has collision geometry
but is not visible. Differences are measured in three ways:

- on the ground: as heights, since a centimeter of height is decimeters along a ray at a low angle
- on obstacles: as distances to the nearest surface of the other geometry
- in the corridor: visual-only geometry by its height above the collision ground, collision-only parts by their gap,
  collision-only ground by the height above what is visible

Frames are matched within a film, so the field's depth is determined only where one film shows a place from two
directions. At other places the depth may differ from build to build. Collision-only geometry there is reported
separately, as `unfilmed_ghost_m`. The robot starts where it does not see such ground (`scene_xml.first_filmed`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.assets.ground import Ground
from twin.assets.solids import HEADROOM
from twin.geometry.cameras import (
    FAR,
    Cameras,
    RenderableField,
    Viewpoints,
    depth_determined,
    pixel_grid,
    unproject,
)
from twin.geometry.polyline import arc_lengths, point_at
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import CAMERA_SIZE, World
from twin.report.html import Section, Verdict, as_number, cautions_above, facts_of, pick
from twin.report.video_layout import (
    PANEL_BACKGROUND,
    caption_line,
    colored,
    depth_colors,
    fit,
    panel_row,
    scale_bar,
    titled_panel,
)
from twin.runtime import track
from twin.types import Array, Image

VIEW_SPACING = 2.0  # [m] of the drive between two views
MAX_DEPTH = 10.0  # [m] pixels with a larger depth are not compared
LARGE_ERROR = 0.2  # [m] larger differences count in the `_share` figures or get a caution

_MIN_OPACITY = 0.5  # pixels of lower opacity count as empty
_THINNING_CELL = 0.05  # [m]; point clouds are thinned to one point per cell
_MIN_OBSTACLE_HEIGHT = 0.2  # [m] above the ground
_ROUTE_STEP = 0.05  # [m] between stations; a point is assigned to the nearest one
_BIN = 1.0  # [m] of the route per bin of `along`


@dataclass(frozen=True)
class GeometryViews:
    """n views of both geometries. Depths (n, height, width) are z-depths [m]; FAR where a ray hits nothing."""

    camera_to_world: Array
    """Shape (n, 4, 4)."""
    visual_depth: Array
    collision_depth: Array
    is_ground: NDArray[np.bool_]
    """Mask (n, height, width) of the pixels whose ray hits the collision ground before any part."""
    rgb: NDArray[np.float32]
    """Colors of the field, shape (n, height, width, 3)."""

    def points(self, depth: Array, intrinsics: Array) -> Array:
        """Points at the given z-depths on the pixels' rays, shape (n, height, width, 3)."""
        rays = unproject(pixel_grid(*CAMERA_SIZE), intrinsics)
        turned = np.einsum("nhwi,nji->nhwj", rays * depth[..., None], self.camera_to_world[:, :3, :3])
        return turned + self.camera_to_world[:, None, None, :3, 3]


def render_views(field: RenderableField, world: World, camera_to_world: Array, lighting: str) -> GeometryViews:
    """Renders the field and casts rays at the collision geometry from camera poses (n, 4, 4)."""
    from twin.env.mujoco_renderer import ON_GROUND, CollisionCaster  # slow to import

    caster = CollisionCaster(world, CAMERA_SIZE, world.intrinsics, ground=True)
    visual_depth, collision_depth, is_ground, rgb = [], [], [], []
    for pose in track(list(camera_to_world), "visual vs collision", unit="view"):
        _, depth, hit = caster.cast(pose)
        collision_depth.append(np.where(depth > 0.0, depth, FAR).astype(np.float64))
        is_ground.append(hit == ON_GROUND)
        out = field.render(Viewpoints.of(pose, world.intrinsics, CAMERA_SIZE), lighting, CAMERA_SIZE)
        visual_depth.append(np.where(out.opacity[0] >= _MIN_OPACITY, out.depth[0], FAR).astype(np.float64))
        rgb.append(out.rgb[0])
    depths = np.stack(visual_depth), np.stack(collision_depth)
    return GeometryViews(camera_to_world, *depths, np.stack(is_ground), np.stack(rgb))


def view_poses(camera_to_world: Array) -> Array:
    """Poses (k, 4, 4) of a drive every `VIEW_SPACING` meters, including the first."""
    way = arc_lengths(camera_to_world[:, :2, 3])
    return camera_to_world[np.unique(np.searchsorted(way, np.arange(0.0, way[-1], VIEW_SPACING)))]


def compare_geometry(
    views: GeometryViews, world: World, cameras: Cameras, ground: Ground, parts: Parts
) -> dict[str, Any]:
    """Computes the differences between visual and collision geometry.

    Held-out cameras do not count as filmed, because the field was not trained on them.

    Returns:
        Lengths are in [m]. A median, quantile or share is None if there are no points for it.

        - `views`, `pixels`: numbers of views and of compared pixels. A pixel is compared if its visible geometry is
          closer than `MAX_DEPTH` and not higher above the ground than the highest part.
        - `median_m`, `p90_m`: |gap| of these pixels.
        - `ground_median_m`, `ground_p95_m`: height difference of visible ground and collision ground in the corridor.
        - `standing_median_m`: median distance of visible obstacles from the nearest collision geometry.
        - `leak_share`: share of the points on visible obstacles further than `LARGE_ERROR` from collision geometry.
        - `ghost_share`: share of the points on parts in view further than `LARGE_ERROR` from visible geometry.
        - `corridor_leak_m`, `corridor_ghost_m`: largest visual-only and collision-only difference in the corridor; the
          latter is at most `MAX_DEPTH`.
        - `unfilmed_ghost_m`: largest collision-only difference where no film shows the corridor from two directions.
          These points do not count for `corridor_ghost_m`.
        - `along`: per meter of the route, the maxima `leak_m` and `ghost_m`, and the median `ground_m`.
    """
    visual = views.points(views.visual_depth, world.intrinsics)
    collision = views.points(views.collision_depth, world.intrinsics)
    height = np.where(views.visual_depth < FAR, visual[..., 2] - ground.at(visual[..., :2]), np.inf)
    top = max([float((v[:, 2] - ground.at(v[:, :2])).max()) for v in parts.vertices], default=0.0)
    near = (views.visual_depth < MAX_DEPTH) & (height < max(top, _MIN_OBSTACLE_HEIGHT))
    gap = np.abs(views.collision_depth - views.visual_depth)
    out: dict[str, Any] = {"views": len(views.visual_depth), "pixels": int(near.sum())}
    out |= {"median_m": _quantile(gap[near], 0.5), "p90_m": _quantile(gap[near], 0.9)}

    station, inside = _in_corridor(world, visual, near & (height < HEADROOM))
    low = inside & (height < _MIN_OBSTACLE_HEIGHT)
    off = np.abs(height[low])
    out |= {"ground_median_m": _quantile(off, 0.5), "ground_p95_m": _quantile(off, 0.95)}

    hit_station, hit = _in_corridor(world, collision, views.collision_depth < MAX_DEPTH)
    hit &= collision[..., 2] - np.where(hit, ground.at(collision[..., :2]), 0.0) < HEADROOM
    # Size of collision-only geometry: the height difference on the ground, the gap on a part.
    depth_below = np.where(np.isfinite(height), -np.minimum(height, 0.0), FAR)
    behind = np.where(views.visual_depth > views.collision_depth, np.where(views.is_ground, depth_below, gap), 0.0)
    behind = np.minimum(behind, MAX_DEPTH)  # where nothing is visible, the gap would be almost FAR
    filmed = np.zeros(hit.shape, bool)
    filmed[hit] = depth_determined(cameras, collision[hit])
    visual_only, collision_only = np.where(inside, height, 0.0), np.where(hit & filmed, behind, 0.0)
    out["corridor_leak_m"], out["corridor_ghost_m"] = float(max(visual_only.max(), 0.0)), float(collision_only.max())
    out["unfilmed_ghost_m"] = float(np.where(hit & ~filmed, behind, 0.0).max())

    surface = _collision_surface(ground, parts)
    obstacle_points = _thin(visual[near & (height > _MIN_OBSTACLE_HEIGHT)])
    part_points = _thin(collision[(views.collision_depth < MAX_DEPTH) & ~views.is_ground])
    distance = surface.distance(obstacle_points) if len(obstacle_points) else np.zeros(0)
    out["standing_median_m"] = _quantile(distance, 0.5)
    out["leak_share"] = float((distance > LARGE_ERROR).mean()) if len(distance) else None
    visual_cloud = _thin(visual[views.visual_depth < MAX_DEPTH + 2.0])
    unseen = cKDTree(visual_cloud).query(part_points)[0] if len(part_points) and len(visual_cloud) else np.zeros(0)
    out["ghost_share"] = float((unseen > LARGE_ERROR).mean()) if len(unseen) else None

    edges = np.arange(0.0, arc_lengths(world.route)[-1] + _BIN, _BIN)
    out["along"] = {
        "station_m": [float(s) for s in edges[:-1] + _BIN / 2],
        "leak_m": _by_bin(edges, station[inside], visual_only[inside].clip(0.0), np.max, 0.0),
        "ghost_m": _by_bin(edges, hit_station[hit & filmed], collision_only[hit & filmed].clip(0.0), np.max, 0.0),
        "ground_m": _by_bin(edges, station[low], np.abs(height[low]), np.median, None),
    }
    return out


def _in_corridor(world: World, points: Array, among: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Returns the stations (arc lengths on the route) [m] of points (..., 3), and a mask of the points in the corridor.

    Only the points selected by the mask `among` are looked up; the others have station −1. The corridor ends at the
    route's ends.
    """
    length = float(arc_lengths(world.route)[-1])
    stations = np.arange(0.0, length + _ROUTE_STEP, _ROUTE_STEP)
    distance, index = cKDTree(point_at(world.route[:, :2], stations)).query(points[among][:, :2])
    station, inside = np.full(among.shape, -1.0), np.zeros(among.shape, bool)
    station[among] = stations[index]
    # Points whose nearest point is an end of the route are excluded, since they may be beyond it.
    inside[among] = (distance <= world.half_width) & (index > 0) & (index < len(stations) - 2)
    return station, inside


def _collision_surface(ground: Ground, parts: Parts) -> Any:
    from twin.geometry.mesh_rays import Surface

    vertices, faces = ground.triangles(ground.cell, 2 * ground.height.size)
    together = trimesh.util.append_faces([vertices, *parts.vertices], [faces, *parts.faces])
    return Surface(together[0].astype(np.float64), together[1])


def _thin(points: Array) -> Array:
    _, first = np.unique(np.floor(points / _THINNING_CELL).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def _quantile(values: Array, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def _by_bin(edges: Array, station: Array, values: Array, reduce: Callable[[Array], Any], empty: float | None) -> list:
    """Reduces values at stations [m] to one value per bin (in `edges`) of the route; without values, to `empty`."""
    which = np.clip(np.digitize(station, edges) - 1, 0, len(edges) - 2)
    found = [values[which == k] for k in range(len(edges) - 1)]
    return [round(float(reduce(v)), 4) if len(v) else empty for v in found]


# ---- picture

_MAX_GAP = 0.3  # [m] |gap| at the ends of the color scale
_PANEL_WIDTH = 320  # [px] width of a panel


def gap_row(views: GeometryViews, k: int) -> Image:
    """Panels of view k in a row: rendered field, visual depth, collision depth, and gap."""
    visual, collision = views.visual_depth[k], views.collision_depth[k]
    size = (_PANEL_WIDTH, round(_PANEL_WIDTH * visual.shape[0] / visual.shape[1]))
    near = (visual < MAX_DEPTH) & (collision < MAX_DEPTH)
    gap = np.where(near, collision - visual, 0.0)
    colors = colored("coolwarm", np.clip(0.5 + 0.5 * gap / _MAX_GAP, 0.0, 1.0))
    colors[~near] = PANEL_BACKGROUND
    labels = [(0.0, f"−{_MAX_GAP * 100:g} cm"), (0.5, "0"), (1.0, f"+{_MAX_GAP * 100:g} cm")]
    scale = scale_bar(_PANEL_WIDTH, colored("coolwarm", np.linspace(0, 1, _PANEL_WIDTH - 16)[None]), labels)
    solid = caption_line(_PANEL_WIDTH, "ground and convex parts")
    panels = [
        titled_panel(fit(views.rgb[k], size), "field", "", caption_line(_PANEL_WIDTH, "as a policy sees it")),
        titled_panel(fit(depth_colors(visual), size), "visual", "depth", caption_line(_PANEL_WIDTH, "bright is near")),
        titled_panel(fit(depth_colors(collision), size), "collision", "depth", solid),
        titled_panel(fit(colors, size), "gap", f"within {MAX_DEPTH:g} m", scale),
    ]
    return panel_row(panels)


# ---- section of the build report


def geometry_section(report: dict[str, Any]) -> Section:
    """The review stage's comparison of visual with collision geometry of this module."""
    name, title = "seen_touched", "Visual and collision geometry"
    found = pick(report, name)
    if not isinstance(found, dict):
        return Section(name, title, "", not_applicable="no robot was driven, so there are no views to compare")
    visible = "height of visible geometry above the ground"
    behind = "distance by which visible geometry lies behind it"
    nearest = "median distance to the nearest surface"
    far = f"of points on parts, over {LARGE_ERROR:g} m from visible geometry"
    twice = "where no film shows the corridor from two directions; not part of the previous number"
    within = f"median within {MAX_DEPTH:g} m, ground and parts"
    facts = facts_of(
        found,
        ("median_m", "visual to collision geometry, along the ray", "{:.3f} m", within),
        ("p90_m", "the same, 90th percentile", "{:.3f} m", "large where the ground is seen at a low angle"),
        ("ground_median_m", "visual to collision ground", "{:.3f} m", "median height difference in the corridor"),
        ("ground_p95_m", "the same, 95th percentile", "{:.3f} m", "height difference in the corridor"),
        ("corridor_leak_m", "largest visual-only in the corridor", "{:.3f} m", visible),
        ("corridor_ghost_m", "largest collision-only in the corridor", "{:.3f} m", behind),
        ("unfilmed_ghost_m", "largest collision-only, filmed from one direction", "{:.3f} m", twice),
        ("standing_median_m", "visible obstacles to collision geometry", "{:.3f} m", nearest),
        ("leak_share", "visual-only", "{:.1%}", f"of obstacle points, over {LARGE_ERROR:g} m from collision geometry"),
        ("ghost_share", "collision-only", "{:.1%}", far),
        ("views", "views", "{}", "of the robot’s camera, along its drive"),
    )
    beyond = ". The largest difference is {:.3f} m, more than {:g} m."
    unfilmed = (
        "No film shows some of the corridor, usually its first meters, from two directions. The field’s depth there is "
        "not determined, may differ from build to build, and differs from collision geometry" + beyond
    )
    leak = "Something in the corridor is visible but has no collision geometry" + beyond
    ghost = "Collision geometry in the corridor is not visible" + beyond
    earlier = "film from a few meters before the start, or begin [route] points further along."
    apart = "Visual and collision geometry differ by {:.3f} m in the median, more than {:g} m."
    cautions = cautions_above(
        found,
        ("median_m", 0.05, apart, "raise nerf.steps, or lower mesh.voxel."),
        ("corridor_leak_m", LARGE_ERROR, leak, "mask what moved while filming."),
        ("corridor_ghost_m", LARGE_ERROR, ghost, "raise nerf.steps."),
        ("unfilmed_ghost_m", LARGE_ERROR, unfilmed, earlier),
    )
    done = (
        "A policy sees the radiance field but collides with MuJoCo’s ground and convex parts. Both were rendered from "
        "the robot’s camera along the drive and compared pixel by pixel."
    )
    median = as_number(found.get("median_m"))
    verdict = None
    if median is not None:
        verdict = Verdict(f"Visual and collision geometry differ by {100 * median:.1f} cm in the median.", "good")
    return Section(name, title, done, facts, cautions, verdict=verdict)
