"""Stage 7: a film in which a person can judge the twin, the numbers of the drive in it, and pictures for the page.

The film has up to three *chapters*: the field beside the real frames; the light turning, where there are two lightings
or more; and the Husky driven along the route by a scripted follower, where there is a route.
"""

from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from twin.assets.ground import Ground
from twin.config import SceneConfig
from twin.env.drivers import FollowedDrive, follow
from twin.env.physics import HuskyPhysics
from twin.files import write_json
from twin.geometry.cameras import Cameras
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import World, arc_lengths
from twin.nerf.baked import BakedField
from twin.nerf.rendering import RenderableField
from twin.report.chase_camera import Shot, camera_shots, chase_shots, pictures_of, route_shots
from twin.report.html import follower_verdict
from twin.report.review_chapters import (
    COMPARISON_STRIP,
    DRIVE_STRIP,
    LIGHT_STRIP,
    compare_with_the_film,
    comparison_frames,
    drive_metrics,
    film_drive,
    light_steps,
    rendered_instants,
    stride,
    title_card,
    trace,
    turn_the_light,
)
from twin.report.review_studio import Prefetched, Studio, side_by_side, spread
from twin.report.trust_map import trust_along, trust_metrics, trust_picture
from twin.report.video_layout import AMBER, GREEN, RED, Box, FrameLayout, MapView, footprints
from twin.report.video_writer import VideoWriter
from twin.report.visual_vs_collision import along_the_drive, compare, look, seen_row
from twin.runtime import bar
from twin.scene import SceneDir
from twin.types import Array

_SHARES = (0.25, 0.2, 0.55)  # of `review.renders`, per chapter
_WAITING = 64 * 2**20  # [bytes] of MuJoCo's pictures that wait to be shown
_SEEN_ROWS = 3  # looks whose gap is shown
_CRF = 24  # the demo's film stays near 5 MB
_MOODS = {"good": GREEN, "mixed": AMBER, "bad": RED, "plain": AMBER}


def run(scene: SceneDir, config: SceneConfig, out: Path) -> dict[str, Any]:
    """Drives the Husky along the route and films the twin.

    Args:
        scene: Reads the stages `metric`, `field`, `mesh` and `mjcf`.
        config: `review`, and `mjcf.route`.
        out: Gets `review.mp4`, `review.json` and `pictures/*.jpg`.

    Returns:
        Metrics for the report: `follower` (None where there is no route, and then `not_applicable` says why),
        `seen_touched` (see `twin.report.visual_vs_collision.compare`), `frames`, `duration_s`, `renders`,
        `render_seconds_per_frame`.
    """
    return write_review_video(scene, config, out, BakedField.load(scene.stage("field")))


def write_review_video(scene: SceneDir, config: SceneConfig, out: Path, field: RenderableField) -> dict[str, Any]:
    """`run` with any field."""
    cameras = Cameras.load(scene.stage("metric"))
    world = World.load(scene.stage("mjcf")) if config.mjcf.route and scene.has_route else None
    drive = follow(world, HuskyPhysics(world.model(), world.robot), config.review.speed) if world else None
    aspect = float(np.median(cameras.sizes[:, 1] / cameras.sizes[:, 0]))
    layout = FrameLayout.for_pictures(config.review.width, aspect)
    path = world.route[:, :2] if world else _longest_path(cameras)
    metrics: dict[str, Any] = {"follower": drive_metrics(drive) if drive else None}
    if not drive:
        metrics["not_applicable"] = no_drive_reason(config)
    with VideoWriter(out / "review.mp4", layout.size, config.review.fps, _CRF) as writer:
        studio = Studio(config.name, field, cameras, layout, writer, out, config.review.render_width, path)
        _keep_captures(studio)
        _film_chapters(studio, scene, config, world, drive)
        if world:
            along = trust_along(field, cameras, world)
            metrics["trust"] = trust_metrics(*along)
            caption = (
                "how far the robot's pictures can be trusted: near to what was filmed, and road where road must be"
            )
            studio.keep("trust", "review", caption, trust_picture(*along))
        verdict = follower_verdict(
            {"review": metrics, "mjcf": {"route_length_m": float(arc_lengths(world.route)[-1]) if world else None}}
        )
        studio.writer.write(layout.card(verdict.text, [], _MOODS[verdict.mood]), 3 * studio.fps)
    metrics |= {"frames": writer.frames, "duration_s": writer.frames / writer.fps, "renders": studio.renders}
    metrics |= {"trace": trace(drive)} if drive else {}
    if world and drive:
        metrics["seen_touched"] = _seen_and_touched(studio, scene, world, drive)
    # Times stay out of the file, so that the same build writes the same bytes.
    write_json(out / "review.json", metrics | {"pictures": [asdict(picture) for picture in studio.kept]})
    return metrics | {"render_seconds_per_frame": studio.render_seconds / max(1, studio.renders)}


def no_drive_reason(config: SceneConfig) -> str:
    """Why nothing was driven, in words."""
    if not config.mjcf.route:
        return "scene.toml says that this is no drive (mjcf.route = false)"
    return "no route was found in the filmed path"


def _film_chapters(
    studio: Studio, scene: SceneDir, config: SceneConfig, world: World | None, drive: FollowedDrive | None
) -> None:
    renders, field, cameras = config.review.renders, studio.field, studio.cameras
    chosen = comparison_frames(studio, int(_SHARES[0] * renders))
    turns = int(_SHARES[1] * renders) if len(field.lightings) > 1 else 0
    drives = int(_SHARES[2] * renders) if drive else 0
    ground, parts = surroundings(scene)
    half_width = world.half_width if world else 0.0

    def plan(box: Box) -> MapView:
        return MapView.draw(box[2:], studio.path, ground, parts, half_width)

    strip, panel = studio.layout.strip, studio.layout.panel
    views, model = _views(studio, scene, world)
    behind = chase_shots(drive, stride(drive, studio.fps)[0]) if drive else []
    # Warp compiles kernels when they are first used; the field's are, before a second thread compiles the scene's.
    field.render(cameras.select(np.array([0])), field.lightings[0], (16, 8))
    total = sum(map(len, chosen.values())) + len(rendered_instants(behind, drives))
    total += light_steps(len(field.lightings), turns) * (len(field.lightings) - 1) + 1 if turns else 0
    # MuJoCo's pictures need no view of the field, so they are made while those of the first chapters are.
    with (
        Prefetched(pictures_of(model, views + behind, panel), max(4, _WAITING // (3 * panel[0] * panel[1]))) as ahead,
        bar("film", total, "view") as progress,
    ):
        compare_with_the_film(studio, plan(strip(*COMPARISON_STRIP)[1]), chosen, progress)
        if turns:
            turn_the_light(studio, plan(strip(*LIGHT_STRIP)[1]), turns, progress)
        pictures = iter(ahead)
        for number, picture in enumerate(islice(pictures, len(views))):
            caption = ("the scene that MuJoCo loads, solid parts drawn over", "further along")[number]
            studio.keep(f"scene_{number}", "mjcf", caption, picture)
        if world and drive:
            film_drive(studio, plan(strip(*DRIVE_STRIP)[0]), world, drive, pictures, drives, progress)
        else:
            title_card(studio, "No drive", [f"Nothing is driven here: {no_drive_reason(config)}."])


def _seen_and_touched(studio: Studio, scene: SceneDir, world: World, drive: FollowedDrive) -> dict[str, Any] | None:
    """Whether the robot touches what its camera sees, with pictures; None where the mesh stage left no ground."""
    folder = scene.stage("mesh")
    if not (folder / "ground.npz").exists():
        return None
    looks = look(studio.field, world, along_the_drive(drive.camera_to_world), studio.field.lightings[0])
    for number, k in enumerate(spread(range(len(looks.seen)), _SEEN_ROWS + 2)[1:-1]):
        row = seen_row(looks, k)
        studio.keep(
            f"seen_{number}", "seen_touched", "the field, and the solid scene from the same place", row, row.shape[1]
        )
    return compare(looks, world, studio.cameras, Ground.load(folder), Parts.load(folder / "parts.npz"))


def _views(studio: Studio, scene: SceneDir, world: World | None) -> tuple[list[Shot], World]:
    """What is shown of the scene itself, and the world to show it in."""
    folder = scene.stage("mjcf")
    if world:
        return route_shots(world.route), world
    # Only its model is drawn; there is no route to know.
    model = World(np.zeros((2, 3)), 0.0, (0.0, 0.0, 0.0, 0.0), folder)
    return (camera_shots(studio.cameras) if model.model_path.exists() else []), model


def surroundings(scene: SceneDir) -> tuple[Ground | None, list[Array]]:
    """What the plan shows of the mesh stage: the ground, and the outlines of low parts."""
    folder = scene.stage("mesh")
    ground = Ground.load(folder) if (folder / "ground.npz").exists() else None
    if not (folder / "parts.npz").exists():
        return ground, []
    with np.load(folder / "parts.npz", allow_pickle=False) as data:
        return ground, footprints(data["vertices"], data["vertex_start"], ground)


def _longest_path(cameras: Cameras) -> Array:
    """Camera positions of the longest source from above [m], shape (n, 2)."""
    longest = max(dict.fromkeys(cameras.sources), key=cameras.sources.count)
    return cameras.positions[[name == longest for name in cameras.sources], :2]


def _keep_captures(studio: Studio) -> None:
    """Four frames of each lighting, for the page."""
    cameras = studio.cameras
    for number, lighting in enumerate(dict.fromkeys(cameras.lightings)):
        mine = [i for i, name in enumerate(cameras.lightings) if name == lighting]
        row = [studio.real(i) for i in spread(mine, 4)]
        studio.keep(
            f"capture_{number}", "capture", f"{lighting}: frames from its start to its end", side_by_side(row, 180)
        )
