"""Stage `review`: the review video, metrics of a scripted drive, and pictures for the report page.

The video has up to three chapters: real against rendered frames; changing light, if there are several lightings; and
the Husky driven along the route by a scripted follower, if there is a route.
"""

from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from twin.assets.ground import Ground
from twin.config import SceneConfig
from twin.env.drivers import RecordedDrive, follow_route
from twin.env.physics import HuskyPhysics
from twin.files import write_json
from twin.geometry.cameras import Cameras
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import World, arc_lengths
from twin.nerf.baked import BakedField
from twin.nerf.rendering import RenderableField
from twin.report.html import follower_verdict
from twin.report.review_chapters import (
    COMPARISON_STRIP,
    DRIVE_STRIP,
    LIGHTING_STRIP,
    comparison_frames,
    drive_metrics,
    drive_trace,
    frame_timing,
    lighting_steps,
    rendered_instants,
    write_comparison_chapter,
    write_drive_chapter,
    write_lighting_chapter,
    write_title_card,
)
from twin.report.review_studio import Prefetcher, Studio, evenly_spaced, side_by_side
from twin.report.shots import Shot, camera_shots, chase_shots, render_shots, route_shots
from twin.report.trust_map import trust_grid, trust_metrics, trust_picture
from twin.report.video_layout import AMBER, GREEN, RED, Box, FrameLayout, MapView, load_footprints
from twin.report.video_writer import VideoWriter
from twin.report.visual_vs_collision import compare_geometry, gap_row, render_views, view_poses
from twin.runtime import bar
from twin.scene import SceneDir
from twin.types import Array

_RENDER_SHARES = (0.25, 0.2, 0.55)  # of `review.renders` per chapter
_PREFETCH_BYTES = 64 * 2**20  # [bytes] of prefetched MuJoCo pictures
_GAP_ROWS = 3  # views whose gap is shown
_CRF = 24  # about 5 MB for the demo's video
_MOOD_COLORS = {"good": GREEN, "mixed": AMBER, "bad": RED, "plain": AMBER}


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Drives the Husky along the route and writes the review video.

    Args:
        scene: The stages `metric`, `field`, `mesh` and `mjcf` are read.
        config: `review` and `mjcf.route` are used.
        out: Receives `review.mp4`, `review.json` and `pictures/*.jpg`.

    Returns:
        Metrics for the report: `follower` (None without a route; `not_applicable` then contains the reason),
        `seen_touched` (see `twin.report.visual_vs_collision.compare_geometry`), `frames`, `duration_s`, `renders`,
        `render_seconds_per_frame`.
    """
    return write_review_video(scene, config, out, BakedField.load(scene.stage("field")))


def write_review_video(scene: SceneDir, config: SceneConfig, out: Path, field: RenderableField) -> dict[str, Any]:
    """`run` with any field."""
    cameras = Cameras.load(scene.stage("metric"))
    world = World.load(scene.stage("mjcf")) if config.mjcf.route and scene.has_route else None
    drive = follow_route(world, HuskyPhysics(world.model(), world.robot), config.review.speed) if world else None
    aspect = float(np.median(cameras.sizes[:, 1] / cameras.sizes[:, 0]))
    layout = FrameLayout.for_pictures(config.review.width, aspect)
    path = world.route[:, :2] if world else _longest_path(cameras)
    metrics: dict[str, Any] = {"follower": drive_metrics(drive) if drive else None}
    if not drive:
        metrics["not_applicable"] = no_drive_reason(config)
    with VideoWriter(out / "review.mp4", layout.size, config.review.fps, _CRF) as writer:
        studio = Studio(config.name, field, cameras, layout, writer, out, config.review.render_width, path)
        _save_capture_pictures(studio)
        _write_chapters(studio, scene, config, world, drive)
        if world:
            along = trust_grid(field, cameras, world)
            metrics["trust"] = trust_metrics(*along)
            caption = "trust in the robot's camera views: high close to filmed poses and where road is seen as road"
            studio.save_picture("trust", "review", caption, trust_picture(*along))
        verdict = follower_verdict(
            {"review": metrics, "mjcf": {"route_length_m": float(arc_lengths(world.route)[-1]) if world else None}}
        )
        studio.writer.write(layout.card(verdict.text, [], _MOOD_COLORS[verdict.mood]), 3 * studio.fps)
    metrics |= {"frames": writer.frames, "duration_s": writer.frames / writer.fps, "renders": studio.renders}
    metrics |= {"trace": drive_trace(drive)} if drive else {}
    if world and drive:
        metrics["seen_touched"] = _compare_geometry(studio, scene, world, drive)
    # The file contains no times, so that the same build writes the same bytes.
    write_json(out / "review.json", metrics | {"pictures": [asdict(picture) for picture in studio.pictures]})
    return metrics | {"render_seconds_per_frame": studio.render_seconds / max(1, studio.renders)}


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
    views, model = _scene_shots(studio, scene, world)
    behind = chase_shots(drive, frame_timing(drive, studio.fps)[0]) if drive else []
    # Warp compiles kernels at first use; compile those of the field before the second thread compiles the scene's.
    field.render(cameras.select(np.array([0])), field.lightings[0], (16, 8))
    total = sum(map(len, chosen.values())) + len(rendered_instants(behind, drives))
    total += lighting_steps(len(field.lightings), turns) * (len(field.lightings) - 1) + 1 if turns else 0
    # MuJoCo's pictures need no view of the field; they are rendered in parallel with the first chapters.
    with (
        Prefetcher(
            render_shots(model, views + behind, panel), max(4, _PREFETCH_BYTES // (3 * panel[0] * panel[1]))
        ) as ahead,
        bar("video", total, "view") as progress,
    ):
        write_comparison_chapter(studio, map_in(strip(*COMPARISON_STRIP)[1]), chosen, progress)
        if turns:
            write_lighting_chapter(studio, map_in(strip(*LIGHTING_STRIP)[1]), turns, progress)
        pictures = iter(ahead)
        for number, picture in enumerate(islice(pictures, len(views))):
            caption = ("the MuJoCo scene with solid parts", "further along the route")[number]
            studio.save_picture(f"scene_{number}", "mjcf", caption, picture)
        if world and drive:
            write_drive_chapter(studio, map_in(strip(*DRIVE_STRIP)[0]), world, drive, pictures, drives, progress)
        else:
            write_title_card(studio, "No drive", [f"Nothing is driven here: {no_drive_reason(config)}."])


def _compare_geometry(studio: Studio, scene: SceneDir, world: World, drive: RecordedDrive) -> dict[str, Any] | None:
    """Compares visual with collision geometry and saves pictures; None without ground in the mesh stage."""
    folder = scene.stage("mesh")
    if not (folder / "ground.npz").exists():
        return None
    views = render_views(studio.field, world, view_poses(drive.camera_to_world), studio.field.lightings[0])
    for number, k in enumerate(evenly_spaced(range(len(views.visual_depth)), _GAP_ROWS + 2)[1:-1]):
        row = gap_row(views, k)
        studio.save_picture(
            f"seen_{number}", "seen_touched", "the field and the collision geometry at the same pose", row, row.shape[1]
        )
    return compare_geometry(views, world, studio.cameras, Ground.load(folder), Parts.load(folder / "parts.npz"))


def _scene_shots(studio: Studio, scene: SceneDir, world: World | None) -> tuple[list[Shot], World]:
    folder = scene.stage("mjcf")
    if world:
        return route_shots(world.route), world
    # Only the model is rendered, so the route is a placeholder.
    model = World(np.zeros((2, 3)), 0.0, (0.0, 0.0, 0.0, 0.0), folder)
    return (camera_shots(studio.cameras) if model.model_path.exists() else []), model


def load_ground_and_parts(scene: SceneDir) -> tuple[Ground | None, list[Array]]:
    """Ground and outlines of low parts of the mesh stage, for the map."""
    folder = scene.stage("mesh")
    ground = Ground.load(folder) if (folder / "ground.npz").exists() else None
    return ground, load_footprints(folder / "parts.npz", ground)


def _longest_path(cameras: Cameras) -> Array:
    longest = max(dict.fromkeys(cameras.sources), key=cameras.sources.count)
    return cameras.positions[[name == longest for name in cameras.sources], :2]


def _save_capture_pictures(studio: Studio) -> None:
    cameras = studio.cameras
    for number, lighting in enumerate(dict.fromkeys(cameras.lightings)):
        mine = [i for i, name in enumerate(cameras.lightings) if name == lighting]
        row = [studio.real_frame(i) for i in evenly_spaced(mine, 4)]
        studio.save_picture(
            f"capture_{number}", "capture", f"{lighting}: frames from start to end", side_by_side(row, 180)
        )
