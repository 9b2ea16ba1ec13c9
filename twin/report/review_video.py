"""Stage `review`: the review video, metrics of a scripted drive, and pictures for the report page.

The video has up to three chapters. The first compares real and rendered frames. The second, if there are several
lightings, shows changing light. The third, if there is a route, shows a scripted driver that drives the Husky along it.
"""

import contextlib
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import cv2
import mujoco
import numpy as np

from twin.assets.ground import Ground
from twin.config import SceneConfig
from twin.env.drivers import RecordedDrive, follow_route
from twin.env.mujoco_renderer import SceneCamera, chase_poses
from twin.env.physics import HuskyPhysics
from twin.env.trust import Trust
from twin.errors import InputError
from twin.files import write_json
from twin.geometry.cameras import Cameras, RenderableField, Viewpoints, evenly_spaced
from twin.geometry.polyline import arc_lengths, heading_at, point_at
from twin.geometry.poses import look_at
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import World
from twin.nerf.baked import BakedField
from twin.report.html import follower_verdict
from twin.report.review_chapters import (
    COMPARISON_STRIP,
    DRIVE_STRIP,
    LIGHTING_STRIP,
    Studio,
    comparison_frames,
    frame_timing,
    lighting_steps,
    rendered_instants,
    smoothed_speed,
    spread_choice,
    write_comparison_chapter,
    write_drive_chapter,
    write_lighting_chapter,
    write_title_card,
)
from twin.report.video_layout import (
    AMBER,
    BACKGROUND,
    GREEN,
    INK,
    MUTED,
    RED,
    Box,
    FrameLayout,
    MapView,
    colored,
    draw_text,
    footprints,
    side_by_side,
)
from twin.report.video_writer import VideoWriter, frame_indices
from twin.report.visual_vs_collision import compare_geometry, gap_row, render_views, view_poses
from twin.robot import CAMERA_SIZE
from twin.runtime import bar
from twin.scene import SceneDir
from twin.types import Array, Image

Shot = tuple[Array | None, Array]
"""The robot's configuration (MuJoCo's qpos; None for the initial one), and a camera pose (OpenCV axes)."""

_RENDER_SHARES = (0.25, 0.2, 0.55)  # shares of `review.renders` for the chapters
_PREFETCH_BYTES = 64 * 2**20  # [bytes] largest memory of prefetched MuJoCo pictures
_GAP_ROWS = 3  # number of views whose gap between visual and collision geometry is on the page
_CRF = 24  # quality of x264; gives about 5 MB for the demo's video
_MOOD_COLORS = {"good": GREEN, "mixed": AMBER, "bad": RED, "plain": AMBER}


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Drives the Husky along the route and writes the review video.

    Args:
        scene: The stages `metric`, `field`, `mesh` and `mjcf` are read.
        config: `review` and `mjcf.route` are used.
        out: Receives `review.mp4`, `review.json` and `pictures/*.jpg`.

    Returns:
        Metrics for the report: `follower`, `frames`, `duration_s`, `renders`, `render_seconds_per_frame`. With branches
        also `branches`: metrics like `follower` by name; those drives are not in the video. With a route also `trust`
        (see `trust_metrics`), `trace` (see `drive_trace`) and `seen_touched` (see
        `twin.report.visual_vs_collision.compare_geometry`). Without one, `follower` is None, and `not_applicable`
        contains the reason.
    """
    return write_review_video(scene, config, out, BakedField.load(scene.stage("field")))


def write_review_video(scene: SceneDir, config: SceneConfig, out: Path, field: RenderableField) -> dict[str, Any]:
    """Same as `run`, with any field instead of the baked one of the scene."""
    cameras = Cameras.load(scene.stage("metric"))
    world = World.load(scene.stage("mjcf")) if config.mjcf.route and scene.has_route else None
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot), config.review.speed) if world else None
    aspect = float(np.median(cameras.sizes[:, 1] / cameras.sizes[:, 0]))
    layout = FrameLayout.for_pictures(config.review.width, aspect)
    path = world.route[:, :2] if world else _longest_path(cameras)
    metrics: dict[str, Any] = {"follower": drive_metrics(drive) if drive else None}
    if not drive:
        metrics["not_applicable"] = no_drive_reason(config)
    if world and world.branches:
        metrics["branches"] = {name: branch_metrics(world, config.review.speed, name) for name in world.branches}
    with VideoWriter(out / "review.mp4", layout.size, config.review.fps, _CRF) as writer:
        studio = Studio(config.name, field, cameras, layout, writer, out, config.review.render_width, path)
        _save_capture_pictures(studio)
        _write_chapters(studio, scene, config, world, drive)
        if world:
            along = trust_grid(field, cameras, world)
            metrics["trust"] = trust_metrics(*along, world.start)
            caption = "trust in views of the robot's camera: high near filmed poses where the road has no holes"
            studio.save_picture("trust", "review", caption, trust_picture(*along))
        verdict = follower_verdict({"review": metrics, "mjcf": {"route_length_m": world.length if world else None}})
        studio.writer.write(layout.card(verdict.text, [], _MOOD_COLORS[verdict.mood]), 3 * studio.fps)
    metrics |= {"frames": writer.frames, "duration_s": writer.frames / writer.fps, "renders": studio.renders}
    metrics |= {"trace": drive_trace(drive)} if drive else {}
    if world and drive:
        metrics["seen_touched"] = _compare_geometry(studio, scene, world, drive)
    # The file contains no run times, so that the same build writes the same bytes.
    write_json(out / "review.json", metrics | {"pictures": studio.pictures})
    return metrics | {"render_seconds_per_frame": studio.render_seconds / max(1, studio.renders)}


def branch_metrics(world: World, speed: float, name: str) -> dict[str, Any]:
    """The scripted driver's drive along a branch at a speed [m/s].

    Raises InputError: the branch begins off the ground.
    """
    try:
        return drive_metrics(follow_route(world, HuskyPhysics(world.model(), world.robot), speed, branch=name))
    except InputError as error:
        raise InputError(f"branch {name}: {error}") from None


def no_drive_reason(config: SceneConfig) -> str:
    if not config.mjcf.route:
        return "scene.toml sets mjcf.route = false"
    return "no route was found in the filmed path"


def _write_chapters(
    studio: Studio, scene: SceneDir, config: SceneConfig, world: World | None, drive: RecordedDrive | None
) -> None:
    renders, field, cameras = config.review.renders, studio.field, studio.cameras
    chosen = comparison_frames(studio, int(_RENDER_SHARES[0] * renders))
    turns = int(_RENDER_SHARES[1] * renders) if len(field.lightings) > 1 else 0
    drives = int(_RENDER_SHARES[2] * renders) if drive else 0
    ground, parts = load_ground_and_parts(scene)
    half_width = world.half_width if world else 0.0

    def map_in(box: Box) -> MapView:
        return MapView.draw(box[2:], studio.path, ground, parts, half_width)

    strip, panel = studio.layout.strip, studio.layout.panel
    views, model = _scene_shots(cameras, scene, world)
    behind = chase_shots(drive, frame_timing(drive, studio.fps)[0]) if drive else []
    # Warp compiles kernels at first use. The field's are compiled here, before the second thread compiles those of
    # the renderer.
    field.render(cameras.select(np.array([0])), field.lightings[0], (16, 8))
    total = sum(map(len, chosen.values())) + len(rendered_instants(behind, drives))
    total += lighting_steps(len(field.lightings), turns) * (len(field.lightings) - 1) + 1 if turns else 0
    # MuJoCo's pictures need no view of the field; they are rendered in parallel with the first chapters.
    shots, depth = render_shots(model, views + behind, panel), max(4, _PREFETCH_BYTES // (3 * panel[0] * panel[1]))
    with prefetched(shots, depth) as pictures, bar("video", total, "view") as progress:
        write_comparison_chapter(studio, map_in(strip(*COMPARISON_STRIP)[1]), chosen, progress)
        if turns:
            write_lighting_chapter(studio, map_in(strip(*LIGHTING_STRIP)[1]), turns, progress)
        for number, picture in enumerate(islice(pictures, len(views))):
            caption = ("the MuJoCo scene with its convex parts outlined", "further along the route")[number]
            studio.save_picture(f"scene_{number}", "mjcf", caption, picture)
        if world and drive:
            write_drive_chapter(studio, map_in(strip(*DRIVE_STRIP)[0]), world, drive, pictures, drives, progress)
        else:
            write_title_card(studio, "No drive", [f"No robot is driven: {no_drive_reason(config)}."])


def _compare_geometry(studio: Studio, scene: SceneDir, world: World, drive: RecordedDrive) -> dict[str, Any] | None:
    """Compares visual with collision geometry and saves pictures; returns None if the mesh stage has no ground."""
    folder = scene.stage("mesh")
    if not (folder / "ground.npz").exists():
        return None
    views = render_views(studio.field, world, view_poses(drive.camera_to_world), studio.field.lightings[0])
    caption = "the field and the collision geometry at the same pose"
    for number, k in enumerate(spread_choice(range(len(views.visual_depth)), _GAP_ROWS + 2)[1:-1]):
        row = gap_row(views, k)
        studio.save_picture(f"seen_{number}", "seen_touched", caption, row, row.shape[1])
    return compare_geometry(views, world, studio.cameras, Ground.load(folder), Parts.load(folder / "parts.npz"))


def _scene_shots(cameras: Cameras, scene: SceneDir, world: World | None) -> tuple[list[Shot], World]:
    """Two shots with the robot at its initial pose, and the world: overviews of the route, or filmed camera poses."""
    if world:
        length = float(arc_lengths(world.route)[-1])
        return [(None, overview_pose(world.route, share * length)) for share in _OVERVIEW_POSITIONS], world
    # Only the model is rendered, so the route is a placeholder.
    model = World(np.zeros((2, 3)), 0.0, (0.0, 0.0, 0.0, 0.0), scene.stage("mjcf"))
    n = len(cameras)
    frames = dict.fromkeys((n // 4, 3 * n // 4)) if model.model_path.exists() else ()
    return [(None, cameras.camera_to_world[i]) for i in frames], model


def load_ground_and_parts(scene: SceneDir) -> tuple[Ground | None, list[Array]]:
    """Returns the ground of the mesh stage (None without this stage) and the outlines of its parts, for the map."""
    folder = scene.stage("mesh")
    if not (folder / "ground.npz").exists():
        return None, []
    ground = Ground.load(folder)
    return ground, footprints(Parts.load(folder / "parts.npz"), ground)


def _longest_path(cameras: Cameras) -> Array:
    longest = max(dict.fromkeys(cameras.sources), key=cameras.sources.count)
    return cameras.positions[np.array(cameras.sources) == longest, :2]


def _save_capture_pictures(studio: Studio) -> None:
    cameras = studio.cameras
    for number, lighting in enumerate(dict.fromkeys(cameras.lightings)):
        mine = np.flatnonzero(np.array(cameras.lightings) == lighting)
        row = side_by_side([studio.real_frame(i) for i in spread_choice(mine, 4)], 180)
        studio.save_picture(f"capture_{number}", "capture", f"{lighting}: frames from start to end", row)


# ---- numbers of the drive

_TRACE_SAMPLES = 200  # largest number of samples in a drive's trace


def drive_metrics(drive: RecordedDrive) -> dict[str, Any]:
    base = drive.base_to_world
    yaw = np.unwrap(np.arctan2(base[:, 1, 0], base[:, 0, 0]))
    return {
        "reached_goal": bool(drive.reached_goal),
        "outcome": drive.outcome,
        "touched": list(drive.touched),
        "max_cross_track_m": drive.max_cross_track,
        "mean_cross_track_m": drive.mean_cross_track,
        "seconds": float(drive.times[-1]),
        "distance_m": float(arc_lengths(base[:, :2, 3])[-1]),
        "turn_deg": float(np.rad2deg(yaw[-1] - yaw[0])),
    }


def drive_trace(drive: RecordedDrive) -> dict[str, list[float]]:
    """A downsampled drive: distance along the route [m], cross-track error [m], speed [m/s]."""
    index = evenly_spaced(len(drive.times), _TRACE_SAMPLES)
    columns = {"progress_m": drive.progress, "cross_track_m": drive.cross_track, "speed_m_s": smoothed_speed(drive)}
    return {name: [round(float(v), 4) for v in values[index]] for name, values in columns.items()}


# ---- shots of the MuJoCo scene


_OVERVIEW_BEHIND, _OVERVIEW_ABOVE, _OVERVIEW_AHEAD = 9.0, 7.0, 10.0  # [m] camera: behind, above; target: ahead
_OVERVIEW_POSITIONS = (0.0, 0.45)  # places of the overviews, as fractions of the route's length


def overview_pose(route: Array, s: float) -> Array:
    """Camera pose behind and above the point at arc length s [m] of a route (m, 3); it looks along the route."""
    ahead, here = point_at(route, s + _OVERVIEW_AHEAD), point_at(route, s)
    if np.linalg.norm((ahead - here)[:2]) < 1e-6:  # at the end of the route: use its last heading
        here = point_at(route, s - 1.0)
    along = (ahead - here) * [1.0, 1.0, 0.0]
    along /= np.linalg.norm(along)
    return look_at(here - _OVERVIEW_BEHIND * along + [0.0, 0.0, _OVERVIEW_ABOVE], here + _OVERVIEW_AHEAD * along)


def chase_shots(drive: RecordedDrive, every: int) -> list[Shot]:
    """Shots from behind the driving robot: one in every `every` control steps, and one at the last step."""
    poses = chase_poses(drive.base_to_world)
    return [(drive.qpos[i], poses[i]) for i in frame_indices(len(drive.times), every)]


def render_shots(world: World, shots: list[Shot], size: tuple[int, int]) -> Iterator[Image]:
    """Renders shots in order. All use one renderer, because creating it takes seconds."""
    if not shots:
        return
    camera = SceneCamera(world, size)
    data = mujoco.MjData(camera.model)
    if camera.model.nkey:
        mujoco.mj_resetDataKeyframe(camera.model, data, 0)
    for qpos, pose in shots:
        yield camera.render(data.qpos if qpos is None else qpos, pose)


# ---- map of the trust estimate

_TRUST_STEP = 1.5  # [m] along the route, between two views
_OFFSETS = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)  # [half widths of the corridor] sideways, left positive
_TRUST_SIZE = (80, 45)  # [px] of the rendered views
_BATCH = 32
_LOW_TRUST = 0.5  # views below this count as untrusted
_MAP_WIDTH, _CELL_HEIGHT = 720, 16  # [px] of the whole map, and of a cell
_LABEL_ROOM = 60  # [px] least distance between two labels
_LABEL_STEPS = [step * 10**k for k in range(1, 9) for step in (1, 2, 5)]  # [m] between two labels
_MARGIN_ROWS, _MARGIN_RIGHT = 26, 50  # [px] above and below; at the right, for the last label


def trust_grid(field: RenderableField, cameras: Cameras, world: World) -> tuple[Array, Array, Array]:
    """Trust (`twin.env.trust`) in views of the front camera along the route, on and beside it.

    Returns:
        Arc lengths [m], shape (k,); lateral offsets, left positive [m], shape (m,); trust in [0, 1], shape (m, k).
    """
    s = np.arange(0.0, arc_lengths(world.route)[-1], _TRUST_STEP)
    offsets = np.array(_OFFSETS) * world.half_width
    heading = heading_at(world.route, s)
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1)
    down = np.tan(np.deg2rad(world.robot.camera_pitch))
    ahead = np.stack([np.cos(heading), np.sin(heading), np.full_like(heading, -down)], -1)
    poses = []
    for offset in offsets:
        eyes = point_at(world.route, s) + offset * left + [0.0, 0.0, world.robot.camera_height]
        poses += [look_at(eye, eye + direction) for eye, direction in zip(eyes, ahead, strict=True)]
    estimator, out = Trust(cameras), []
    for start in range(0, len(poses), _BATCH):
        batch = np.array(poses[start : start + _BATCH])
        views = Viewpoints.of(batch, world.intrinsics, CAMERA_SIZE)
        out.append(estimator.of(batch, field.render(views, field.lightings[0], _TRUST_SIZE)))
    return s, offsets, np.concatenate(out).reshape(len(offsets), len(s))


def trust_metrics(s: Array, offsets: Array, trust: Array, start: float) -> dict[str, Any]:
    """Figures of the result of `trust_grid` in the corridor, from the arc length `start` [m] on."""
    inside = np.abs(offsets) <= np.abs(offsets[offsets != 0.0]).min() + 1e-9
    s, trust = s[s >= start], trust[inside][:, s >= start]
    return {
        "mean": float(trust.mean()),
        "lowest": float(trust.min()),
        "lowest_at_m": float(s[int(trust.min(0).argmin())]),
        "low_share": float((trust < _LOW_TRUST).mean()),
    }


def trust_picture(s: Array, offsets: Array, trust: Array) -> Image:
    """Draws the result of `trust_grid`: arc length to the right, the route's left at the top, high trust bright."""
    size = _MAP_WIDTH, _CELL_HEIGHT * len(offsets)
    body = cv2.resize(colored("viridis", trust[::-1]), size, interpolation=cv2.INTER_NEAREST)
    out = np.full((size[1] + 2 * _MARGIN_ROWS, size[0] + 64 + _MARGIN_RIGHT, 3), BACKGROUND, np.uint8)
    out[_MARGIN_ROWS : _MARGIN_ROWS + body.shape[0], 64:-_MARGIN_RIGHT] = body
    for k, offset in enumerate(offsets[::-1]):
        draw_text(out, f"{offset:+.1f} m", 58, _MARGIN_ROWS + k * _CELL_HEIGHT + 1, 11, MUTED, align="right")
    per_meter = _MAP_WIDTH / (len(s) * _TRUST_STEP)
    step = next(step for step in _LABEL_STEPS if step * per_meter >= _LABEL_ROOM)
    for at in np.arange(0, s[-1] + 1e-9, step):
        draw_text(out, f"{at:.0f} m", 64 + round(at * per_meter), out.shape[0] - _MARGIN_ROWS + 5, 12, MUTED)
    draw_text(out, "trust from 0 (dark) to 1 (bright), along the route and beside it", 64, 5, 12, INK)
    return out


# ---- prefetching

T = TypeVar("T")
_END = object()


@contextlib.contextmanager
def prefetched(items: Iterator[T], depth: int) -> Iterator[Iterator[T]]:
    """Within the block, a thread computes `items`, up to `depth` ahead of the consumer.

    Warp kernels release the GIL, so the thread uses a second core. If computing an item fails, the iteration raises the
    exception at that item.
    """
    with ThreadPoolExecutor(1) as pool:
        ahead = deque(pool.submit(next, items, _END) for _ in range(depth))

        def computed() -> Iterator[Any]:
            while (item := ahead.popleft().result()) is not _END:
                ahead.append(pool.submit(next, items, _END))
                yield item

        try:
            yield computed()
        finally:
            pool.shutdown(cancel_futures=True)
