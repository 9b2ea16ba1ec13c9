"""Seen equals touched: whether what the field shows is where MuJoCo's collision geometry is.

Both are looked at by the robot's front camera along its drive. *Gap*: z-depth of the first solid thing along a pixel's
ray less that of the field. A *leak* is seen but not solid, a *ghost* solid but not seen. On ground that is looked at
from half a metre above, a centimetre of height is decimetres along the ray; so the size of a leak or ghost is measured
across: in the corridor by how far above the solid ground something is seen, or below it; elsewhere by the distance of
what is seen from the nearest solid surface, and the other way round.

Only a film that shows a place from two directions determines its depth, as frames are matched within a film. Elsewhere
(above all just ahead of the first frame of a drive, which one frame per film shows) the field's depth is not determined
and may differ from build to build; ghosts there are counted apart, as `unfilmed_ghost_m`.
"""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin.assets.ground import Ground
from twin.assets.solids import HEADROOM
from twin.geometry.cameras import Cameras, Viewpoints, opencv_to_mujoco, pixel_grid, project, unproject
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import CAMERA_SIZE, GROUND_GROUP, PART_GROUP, World, arc_lengths, point_at
from twin.nerf.rendering import FAR, RenderableField
from twin.report.html import Caution, Fact, Section, Verdict, number, pick
from twin.report.review_studio import panel, scale_bar, under
from twin.report.video_layout import GROUND, SUNKEN, depth_colours, fit
from twin.runtime import track
from twin.types import Array, Image

STEP = 2.0  # [m] of the drive between two looks
REACH = 10.0  # [m] depth up to which is compared
LARGE = 0.2  # [m] a leak or ghost beyond is large

_OPAQUE = 0.5  # opacity from which the field shows something
_CELL = 0.05  # [m] what is seen is thinned to one point per cell
_STANDING = 0.2  # [m] above the ground from where on something stands
_ROUTE_STEP = 0.05  # [m]
_BIN = 1.0  # [m] of the route, for the figure
_PARALLAX = 1.0  # [°] between the directions from which a film shows a point, for its depth to be determined


@dataclass(frozen=True)
class Looks:
    """n views of both. z-depths [m], FAR where nothing is, shape (n, height, width)."""

    camera_to_world: Array
    """Shape (n, 4, 4)."""
    seen: Array
    solid: Array
    is_ground: NDArray[np.bool_]
    """Whether the first solid thing is the ground, shape (n, height, width)."""
    rgb: NDArray[np.float32]
    """Of the field, shape (n, height, width, 3)."""

    def points(self, depth: Array, intrinsics: Array) -> Array:
        """Where the pixels' rays are at z-depths, shape (n, height, width, 3)."""
        rays = unproject(pixel_grid(*CAMERA_SIZE), intrinsics)
        local = rays * depth[..., None]
        return (
            np.einsum("nhwi,nji->nhwj", local, self.camera_to_world[:, :3, :3])
            + (self.camera_to_world[:, None, None, :3, 3])
        )


def look(field: RenderableField, world: World, camera_to_world: Array, lighting: str) -> Looks:
    """Renders the field and casts rays at the collision geometry from camera poses (n, 4, 4)."""
    import mujoco_warp as mjw  # slow to import

    model = world.model()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    camera = model.camera(world.names["camera"]).id
    on_device, state = mjw.put_model(model), mjw.put_data(model, data)
    context = mjw.create_render_context(
        model,
        cam_res=CAMERA_SIZE,
        cam_active=[world.names["camera"]],
        render_rgb=False,
        render_depth=True,
        render_seg=True,
        use_textures=False,
        enabled_geom_groups=[GROUND_GROUP, PART_GROUP],
    )
    ground = model.geom(world.names["ground"]).id
    shape = CAMERA_SIZE[::-1]
    seen, solid, is_ground, rgb = [], [], [], []
    positions, turns = data.cam_xpos.copy(), data.cam_xmat.reshape(-1, 3, 3).copy()
    mjw.refit_bvh(on_device, state, context)
    for pose in track(list(camera_to_world), "seen equals touched", unit="view"):
        flipped = opencv_to_mujoco(pose)
        positions[camera], turns[camera] = flipped[:3, 3], flipped[:3, :3]
        state.cam_xpos.assign(positions[None].astype(np.float32))
        state.cam_xmat.assign(turns[None].astype(np.float32))
        mjw.render(on_device, state, context)
        depth = context.depth_data.numpy()[0].reshape(shape).astype(np.float64)
        solid.append(np.where(depth > 0.0, depth, FAR))
        is_ground.append(context.seg_data.numpy()[0, :, 0].reshape(shape) == ground)
        out = field.render(Viewpoints.of(pose, world.intrinsics, CAMERA_SIZE), lighting, CAMERA_SIZE)
        seen.append(np.where(out.opacity[0] >= _OPAQUE, out.depth[0], FAR).astype(np.float64))
        rgb.append(out.rgb[0])
    return Looks(camera_to_world, np.stack(seen), np.stack(solid), np.stack(is_ground), np.stack(rgb))


def along_the_drive(camera_to_world: Array) -> Array:
    """The poses (k, 4, 4) of a drive, every `STEP` metres, the first included."""
    way = arc_lengths(camera_to_world[:, :2, 3])
    return camera_to_world[np.unique(np.searchsorted(way, np.arange(0.0, way[-1], STEP)))]


def compare(looks: Looks, world: World, cameras: Cameras, ground: Ground, parts: Parts) -> dict[str, Any]:
    """The numbers.

    Args:
        looks: Of both.
        world: Route and corridor.
        cameras: The filmed frames; those held out taught the field nothing and do not count as filmed.
        ground: Whose height field is touched.
        parts: The convex parts.

    Returns:
        Lengths in [m]: `median_m`, `p90_m` (|gap| of pixels that see something below the parts' greatest height, up to
        `REACH`), `ground_median_m`, `ground_p95_m` (height of the seen ground over the solid one, in the corridor),
        `standing_median_m` (what is seen standing, to the nearest solid surface), `leak_share`, `ghost_share` (of what
        is seen below the greatest height, further than `LARGE` from anything solid; of what is hit of the parts, as
        far from anything seen), `corridor_leak_m`, `corridor_ghost_m` (the largest), `unfilmed_ghost_m` (the largest
        where no film shows the corridor from two directions), and `along`, the largest by metre of the route. Every
        ghost in the corridor is in one of the two.
    """
    seen, solid = looks.points(looks.seen, world.intrinsics), looks.points(looks.solid, world.intrinsics)
    height = np.where(looks.seen < FAR, seen[..., 2] - ground.at(seen[..., :2]), np.inf)
    top = max([float((v[:, 2] - ground.at(v[:, :2])).max()) for v in parts.vertices], default=0.0)
    near = (looks.seen < REACH) & (height < max(top, _STANDING))
    gap = np.abs(looks.solid - looks.seen)
    out: dict[str, Any] = {"views": len(looks.seen), "pixels": int(near.sum())}
    out |= {"median_m": _quantile(gap[near], 0.5), "p90_m": _quantile(gap[near], 0.9)}

    station, inside = _in_corridor(world, seen, near & (height < HEADROOM))
    low = inside & (height < _STANDING)
    out |= {
        "ground_median_m": _quantile(np.abs(height[low]), 0.5),
        "ground_p95_m": _quantile(np.abs(height[low]), 0.95),
    }

    hit_station, hit = _in_corridor(world, solid, looks.solid < REACH)
    hit &= solid[..., 2] - np.where(hit, ground.at(solid[..., :2]), 0.0) < HEADROOM
    # Of the ground how far below it something is seen, of a part how far behind it.
    sunken = np.where(np.isfinite(height), -np.minimum(height, 0.0), FAR)
    behind = np.where(looks.seen > looks.solid, np.where(looks.is_ground, sunken, gap), 0.0)
    filmed = _depth_determined(cameras, solid, hit)
    leaks, ghosts = np.where(inside, height, 0.0), np.where(hit & filmed, behind, 0.0)
    out["corridor_leak_m"], out["corridor_ghost_m"] = float(max(leaks.max(), 0.0)), float(ghosts.max())
    out["unfilmed_ghost_m"] = float(np.where(hit & ~filmed, behind, 0.0).max())

    surface = _solid_surface(ground, parts)
    spots, part_hits = (
        _thinned(seen[near & (height > _STANDING)]),
        _thinned(solid[(looks.solid < REACH) & ~looks.is_ground]),
    )
    away = surface.distance(spots) if len(spots) else np.zeros(0)
    out["standing_median_m"] = _quantile(away, 0.5)
    out["leak_share"] = float((away > LARGE).mean()) if len(away) else None
    cloud = _thinned(seen[looks.seen < REACH + 2.0])
    unseen = cKDTree(cloud).query(part_hits)[0] if len(part_hits) and len(cloud) else np.zeros(0)
    out["ghost_share"] = float((unseen > LARGE).mean()) if len(unseen) else None

    edges = np.arange(0.0, arc_lengths(world.route)[-1] + _BIN, _BIN)
    out["along"] = {
        "station_m": [float(s) for s in edges[:-1] + _BIN / 2],
        "leak_m": _largest(edges, station, leaks, inside),
        "ghost_m": _largest(edges, hit_station, ghosts, hit & filmed),
        "ground_m": _medians(edges, station, np.abs(height), low),
    }
    return out


def _in_corridor(world: World, points: Array, among: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """Stations [m] of points (..., 3) and which of them lie in the corridor, between the route's ends."""
    length = float(arc_lengths(world.route)[-1])
    stations = np.arange(0.0, length + _ROUTE_STEP, _ROUTE_STEP)
    away, index = cKDTree(point_at(world.route[:, :2], stations)).query(points[among][:, :2])
    station, inside = np.full(among.shape, -1.0), np.zeros(among.shape, bool)
    station[among] = stations[index]
    # Beyond an end the nearest point is that end.
    inside[among] = (away <= world.half_width) & (index > 0) & (index < len(stations) - 2)
    return station, inside


def _depth_determined(cameras: Cameras, points: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which points (..., 3) of those `among` two training frames of one film show from `_PARALLAX` apart or more.

    What hides a point from a frame is not considered, nor are masks.
    """
    mine = points[among]
    found = np.zeros(len(mine), bool)
    films, trained = np.array(cameras.sources), ~np.asarray(cameras.held_out, bool)
    for film in dict.fromkeys(cameras.sources):
        first = np.full((len(mine), 3), np.nan)  # the direction from which the film shows a point first
        for i in np.flatnonzero((films == film) & trained):
            left = np.flatnonzero(~found)
            pixels, depth = project(mine[left], cameras.camera_to_world[i], cameras.intrinsics[i])
            shown = left[(depth > 0.0) & (pixels >= 0.0).all(1) & (pixels <= cameras.sizes[i]).all(1)]
            ray = cameras.positions[i] - mine[shown]
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            # By chords, as the arc cosine of nearly equal directions is imprecise. NaN (not shown before) is not apart.
            found[shown] = np.linalg.norm(ray - first[shown], axis=1) >= 2.0 * np.sin(np.radians(_PARALLAX) / 2.0)
            new = np.isnan(first[shown, 0])
            first[shown[new]] = ray[new]
    out = np.zeros(among.shape, bool)
    out[among] = found
    return out


def _solid_surface(ground: Ground, parts: Parts) -> Any:
    from twin.geometry.mesh_rays import Surface

    rows, columns = ground.height.shape
    x, y = np.meshgrid(
        ground.origin[0] + ground.cell * np.arange(columns), ground.origin[1] + ground.cell * np.arange(rows)
    )
    vertices = [np.stack([x, y, ground.height], -1).reshape(-1, 3)]
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = [np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])]
    start = len(vertices[0])
    for v, f in zip(parts.vertices, parts.faces, strict=True):
        vertices.append(v)
        faces.append(f + start)
        start += len(v)
    return Surface(np.concatenate(vertices), np.concatenate(faces))


def _thinned(points: Array) -> Array:
    """One of the points (n, 3) per cell."""
    _, first = np.unique(np.floor(points / _CELL).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def _quantile(values: Array, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def _largest(edges: Array, station: Array, values: Array, among: NDArray[np.bool_]) -> list[float]:
    out = np.zeros(len(edges) - 1)
    np.maximum.at(out, np.clip(np.digitize(station[among], edges) - 1, 0, len(out) - 1), values[among])
    return [round(float(v), 4) for v in out]


def _medians(edges: Array, station: Array, values: Array, among: NDArray[np.bool_]) -> list[float | None]:
    which, mine = np.clip(np.digitize(station[among], edges) - 1, 0, len(edges) - 2), values[among]
    found = [mine[which == k] for k in range(len(edges) - 1)]
    return [round(float(np.median(v)), 4) if len(v) else None for v in found]


# ---- What the report says and shows of `visual_vs_collision.py`: words, and pictures of single looks; no HTML here.


_FEW_FOLLOW = 0.05  # [m] median gap from which on it is worth a caution
_MOST_GAP = 0.3  # [m] at the ends of the gap's colours
_WIDTH = 320  # [px] of a panel


def seen_section(report: dict[str, Any]) -> Section:
    """Whether the robot touches what its camera sees; not a stage of its own, but part of the review."""
    found = pick(report, "seen_touched")
    name, title = "seen_touched", "Seen and touched"
    if not isinstance(found, dict):
        return Section(name, title, "", not_applicable="nothing was driven here, so nothing was looked at on the way")
    rows = (
        ("median_m", "seen against solid, along the ray", "{:.3f} m", f"median within {REACH:g} m, ground and parts"),
        ("p90_m", "the same, worst places", "{:.3f} m", "90 of 100 pixels are better; ground is seen at a low angle"),
        ("ground_median_m", "seen ground over solid ground", "{:.3f} m", "median in the corridor, measured upright"),
        ("ground_p95_m", "the same, worst places", "{:.3f} m", "95 of 100 pixels are better"),
        ("corridor_leak_m", "largest leak in the corridor", "{:.3f} m", "seen above the solid ground, but not solid"),
        ("corridor_ghost_m", "largest ghost in the corridor", "{:.3f} m", "solid, but seen through"),
        (
            "unfilmed_ghost_m",
            "the same, filmed from one place",
            "{:.3f} m",
            "where no film shows the corridor from two places; not in the line above",
        ),
        ("standing_median_m", "what stands, to the nearest solid", "{:.3f} m", "median"),
        ("leak_share", "seen far from anything solid", "{:.1%}", f"of what stands, by more than {LARGE:g} m"),
        ("ghost_share", "solid far from anything seen", "{:.1%}", f"of the parts in view, by more than {LARGE:g} m"),
        ("views", "views", "{}", "of the robot’s camera, along its drive"),
    )
    facts = [Fact(label, number(found.get(key), form), meaning) for key, label, form, meaning in rows]
    cautions = []
    for key, limit, what, cure in (
        ("median_m", _FEW_FOLLOW, "What is seen and what is solid differ", "raise nerf.steps, or lower mesh.voxel."),
        ("corridor_leak_m", LARGE, "Something in the corridor is seen but not solid", "mask what moved while filming."),
        ("corridor_ghost_m", LARGE, "Solid things in the corridor are not seen", "raise nerf.steps."),
        (
            "unfilmed_ghost_m",
            LARGE,
            "The robot sees through something solid in the corridor that no film shows from two places; the field’s "
            "depth there is not determined and may differ from build to build",
            "begin the drive a little further on, or begin to film a little earlier.",
        ),
    ):
        value = found.get(key)
        if isinstance(value, int | float) and value > limit:
            cautions.append(Caution(f"{what}: {number(value, '{:.3f} m')}, more than {limit:g} m.", cure))
    return Section(
        name,
        title,
        "What a policy sees is the field, what it bumps into are MuJoCo’s ground and convex parts. Both were looked at "
        "along the drive by the robot’s camera and compared, pixel by pixel.",
        facts,
        cautions,
        verdict=_verdict(found),
    )


def _verdict(found: dict[str, Any]) -> Verdict | None:
    apart = found.get("median_m")
    if not isinstance(apart, int | float):
        return None
    return Verdict(f"What the robot sees is {100 * apart:.1f} cm from what it touches, in the median.", "good")


def seen_row(looks: Looks, k: int) -> Image:
    """Look k: the field, how far what it shows is, how far what is solid is, and the gap between them in colours."""
    height, width = looks.seen.shape[1:]
    size = (_WIDTH, round(_WIDTH * height / width))
    near = (looks.seen < REACH) & (looks.solid < REACH)
    gap = np.where(near, looks.solid - looks.seen, 0.0)
    share = np.clip(0.5 + 0.5 * gap / _MOST_GAP, 0.0, 1.0)
    colours = (colormaps["coolwarm"](share)[..., :3] * 255 + 0.5).astype(np.uint8)
    colours[~near] = SUNKEN
    bar = _WIDTH - 16
    ramp = (colormaps["coolwarm"](np.linspace(0, 1, bar))[None, :, :3] * 255 + 0.5).astype(np.uint8)
    labels = [(0.0, f"ghost −{_MOST_GAP * 100:g} cm"), (0.5, "0"), (1.0, f"leak +{_MOST_GAP * 100:g} cm")]
    panels = [
        panel(fit(looks.rgb[k], size), "the field", "", under(_WIDTH, "what a policy sees")),
        panel(fit(depth_colours(looks.seen[k]), size), "seen", "how far", under(_WIDTH, "bright is near")),
        panel(fit(depth_colours(looks.solid[k]), size), "solid", "how far", under(_WIDTH, "ground and convex parts")),
        panel(fit(colours[k], size), "gap", f"up to {REACH:g} m", scale_bar(_WIDTH, ramp, labels)),
    ]
    space = np.full((len(panels[0]), 6, 3), GROUND, np.uint8)
    return np.concatenate([part for one in panels for part in (space, one)] + [space], 1)
