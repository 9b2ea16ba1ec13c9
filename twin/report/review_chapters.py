"""Chapters of the review video: comparison of real and rendered frames, changing light, and the drive.

All chapters use a `Studio`. *The page* is the build report, `report.html`.
"""

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from dataclasses import field as with_default
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from twin.env.drivers import RecordedDrive
from twin.errors import join_names
from twin.files import write_bytes
from twin.geometry.cameras import Cameras, RenderableField, Rendering, Viewpoints, evenly_spaced, nearest_frame
from twin.geometry.images import psnr, read_image, resize, to_uint8
from twin.geometry.polyline import arc_lengths
from twin.mjcf.world import World
from twin.report.video_layout import (
    ACCENT,
    AMBER,
    FARTHEST_DEPTH,
    GREEN,
    INK,
    MUTED,
    NEAREST_DEPTH,
    RED,
    Color,
    FrameLayout,
    MapView,
    caption_line,
    colored,
    depth_colors,
    depth_scale,
    draw_depth_legend,
    draw_facts,
    draw_label,
    draw_slider,
    fit,
    panel_row,
    paste,
    scale_bar,
    side_by_side,
    titled_panel,
)
from twin.report.video_writer import VideoWriter, even, frame_indices
from twin.robot import CAMERA_SIZE
from twin.types import Array, Image

# ---- studio

_PICTURE_WIDTH = 1000  # [px] greatest width of pictures for the page
_PICTURE_QUALITY = 82  # JPEG quality of these pictures


@dataclass
class Studio:
    """Renders views of the radiance field, counts renders, and saves pictures for the page."""

    name: str
    """Name of the scene."""
    field: RenderableField
    cameras: Cameras
    layout: FrameLayout
    writer: VideoWriter
    out: Path
    render_width: int
    path: Array
    """Path (n, 2) on the map [m]: the route if there is one, else the camera positions of the longest source."""
    pictures: list[dict[str, str]] = with_default(default_factory=list)
    """Pictures for the page: each one's file (relative to the stage folder), section and caption."""
    renders: int = 0
    render_seconds: float = 0.0

    @property
    def fps(self) -> int:
        return self.writer.fps

    def render(
        self, camera_to_world: Array, intrinsics: Array, size: tuple[int, int], lighting: str, width: int | None = None
    ) -> Rendering:
        """Renders one view of the field; the arrays of the result have shapes (1, h, w, ...).

        `intrinsics` are fx, fy, cx, cy [px] for a picture of `size`. The view has the aspect of `size`, and its longer
        side is `width` [px], by default `render_width`.
        """
        shrink = (width or self.render_width) / max(size)
        small = (even(round(size[0] * shrink)), even(round(size[1] * shrink)))
        start = time.perf_counter()
        rendering = self.field.render(Viewpoints.of(camera_to_world, intrinsics, size), lighting, small)
        self.render_seconds += time.perf_counter() - start
        self.renders += 1
        return rendering

    def render_frame(self, i: int, lighting: str | None = None, width: int | None = None) -> Rendering:
        """Renders the field at the pose of frame i, by default with its `appearance_of_frame`; see `render`."""
        cameras = self.cameras
        size = (int(cameras.sizes[i, 0]), int(cameras.sizes[i, 1]))
        light = lighting or appearance_of_frame(cameras, i)
        return self.render(cameras.camera_to_world[i], cameras.intrinsics[i], size, light, width)

    def real_frame(self, i: int) -> Image:
        """The undistorted frame i; its masked part has gray stripes."""
        image = read_image(self.cameras.image_path(i))
        mask = self.cameras.mask_path(i)
        return image if mask is None else gray_out(image, read_image(mask)[..., 0] == 0)

    def save_picture(self, name: str, section: str, caption: str, picture: Image, width: int = _PICTURE_WIDTH) -> None:
        """Saves a picture for the page as `pictures/<name>.jpg`, at most `width` [px] wide."""
        if picture.shape[1] > width:
            height = round(picture.shape[0] * width / picture.shape[1])
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _PICTURE_QUALITY])
        if not ok:
            raise OSError(f"could not encode picture {name}")
        path = self.out / "pictures" / f"{name}.jpg"
        path.parent.mkdir(exist_ok=True)
        write_bytes(path, data.tobytes())
        self.pictures.append({"file": f"pictures/{name}.jpg", "section": section, "caption": caption})


def gray_out(image: Image, ignored: NDArray[np.bool_]) -> Image:
    """Returns the image with gray stripes where the mask `ignored` (h, w) is True."""
    v, u = np.indices(ignored.shape)
    width = max(4, len(ignored) // 40)
    stripes = np.where((u + v) // width % 2 == 0, 0.55, 0.4)[..., None]
    gray = image.mean(-1, keepdims=True) * stripes + 30.0
    return np.where(ignored[..., None], gray, image).astype(np.uint8)


def spread_choice(indices: Sequence[int] | NDArray, count: int) -> list[int]:
    """At most `count` of the indices, evenly spaced from the first to the last; if `count` is 1, the middle one."""
    some = [len(indices) // 2] if count == 1 and len(indices) else evenly_spaced(len(indices), max(0, count))
    return [int(indices[i]) for i in some]


def frames_to_compare(cameras: Cameras, lighting: str, count: int) -> list[int]:
    """At most `count` frames of a lighting's longest source, in order. Half are held-out frames, if enough exist."""
    of_lighting = [i for i, name in enumerate(cameras.lightings) if name == lighting]
    sources = [cameras.sources[i] for i in of_lighting]
    if not sources:
        return []
    longest = max(dict.fromkeys(sources), key=sources.count)
    mine = [i for i in of_lighting if cameras.sources[i] == longest]
    held_out = [i for i in mine if cameras.held_out[i]]
    trained = [i for i in mine if not cameras.held_out[i]]
    unseen = spread_choice(held_out, max(1, count // 2))
    return sorted([*unseen, *spread_choice(trained, count - len(unseen))])


def appearance_of_frame(cameras: Cameras, i: int) -> str:
    """Appearance of frame i, as a lighting for the field.

    A training frame has its own embedding. A held-out frame gets an embedding interpolated between those of the
    training frames before and after it in its film, so that drifts of light and exposure do not count as errors.
    At an end of the film, it gets the embedding of its only neighbor.
    """
    if not cameras.held_out[i]:
        return cameras.names[i]
    film = (np.array(cameras.sources) == cameras.sources[i]) & ~cameras.held_out
    mine = sorted(np.flatnonzero(film), key=lambda k: cameras.times[k])
    after = np.searchsorted(cameras.times[mine], cameras.times[i], "right")
    around = mine[max(0, after - 1) : after + 1]
    names, times = [cameras.names[k] for k in around], cameras.times[around]
    if 0 < after < len(mine):
        return f"{names[0]}:{names[1]}:{(cameras.times[i] - times[0]) / (times[1] - times[0]):.6g}"
    return names[0] if names else cameras.lightings[i]


# ---- first and second chapter

PANEL_SIZE = 320  # [px] longer side of each panel and of the rendered view
MAX_ERROR = 0.3  # [share of full brightness] end of the color scale of errors
_DEPTH_TICKS = (2.0, 5.0, 10.0, 25.0)  # [m] labels between the ends of the depth scale
COMPARISON_STRIP = (0.3, 0.42, 0.28)  # shares of the strip: depth, map, facts
LIGHTING_STRIP = (0.62, 0.38)  # shares of the strip: slider, map
_CARD_SECONDS = 2.5  # [s] for which a title is shown
_COMPARISON_SECONDS = 0.6  # [s] for which a compared frame is shown
_HOLD_SECONDS = 0.8  # [s] for which a filmed lighting is shown without interpolation
_ROW_HEIGHT = 240  # [px] height of the picture of lightings
_MAX_STILLS = 4  # largest number of lightings in it


def write_title_card(studio: Studio, title: str, lines: list[str]) -> None:
    studio.writer.write(studio.layout.card(title, lines), max(1, round(_CARD_SECONDS * studio.fps)))


def comparison_frames(studio: Studio, budget: int) -> dict[str, list[int]]:
    """Lighting → its frames in chapter 1.

    The lightings share the `budget` of renders equally; one render of each lighting is kept for the page.
    """
    share = max(1, budget // max(1, len(studio.field.lightings)) - 1)
    return {name: frames_to_compare(studio.cameras, name, share) for name in studio.field.lightings}


def write_comparison_chapter(studio: Studio, map_view: MapView, chosen: dict[str, list[int]], progress: tqdm) -> None:
    """Chapter 1: real frame, render and depth. The middle held-out frame of each lighting is also shown on the page."""
    write_title_card(
        studio,
        "1  The film and its twin",
        [
            "Left: the real frame. Right: the radiance field rendered at the same pose, in the same light.",
            "Frames marked “held out” were excluded from training; they measure generalization.",
        ],
    )
    for number, (lighting, frames) in enumerate(chosen.items()):
        unseen = [i for i in frames if studio.cameras.held_out[i]]
        best = unseen[len(unseen) // 2] if unseen else None
        for i in frames:
            view = studio.render_frame(i)
            pictures = to_uint8(view.rgb[0]), depth_colors(view.depth[0], view.opacity[0])
            canvas = _comparison_canvas(studio, map_view, i, lighting, *pictures)
            studio.writer.write(canvas, max(1, round(_COMPARISON_SECONDS * studio.fps)))
            if i == best and number == 0:
                studio.save_picture("poster_compare", "poster", "the film and its twin", canvas)
            if i == best:
                row, score = comparison_row(studio, i)
                caption = (
                    f"{lighting}: real frame, render at the same pose ({score:.1f} dB PSNR), depth, and error. "
                    "The frame was not used for training."
                )
                studio.save_picture(f"compare_{number}", "field", caption, row, row.shape[1])
            progress.update()


def _comparison_canvas(studio: Studio, map_view: MapView, i: int, lighting: str, rgb: Image, depth: Image) -> Image:
    layout, cameras, held_out = studio.layout, studio.cameras, bool(studio.cameras.held_out[i])
    canvas = layout.canvas(f"The film and its twin: {lighting}", studio.name)
    layout.draw_panels(canvas, (studio.real_frame(i), "real"), (rgb, "rendered by the twin"))
    if held_out:
        draw_label(canvas, "held out", layout.right, "bottom right", layout.text, AMBER, True)
    below, middle, right = layout.strip(*COMPARISON_STRIP)
    paste(canvas, depth, below)
    draw_label(canvas, "depth", below, size=round(layout.text * 0.85))
    draw_depth_legend(canvas, below, round(layout.text * 0.75))
    pose = cameras.camera_to_world[i]
    same = np.array([name == cameras.sources[i] for name in cameras.sources])
    paste(canvas, map_with_pose(map_view, pose, cameras.positions[same][:, :2], layout.text), middle)
    facts = [
        ("lighting", lighting, ACCENT),
        ("frame", cameras.names[i].split("/")[-1], INK),
        ("film time", f"{cameras.times[i]:.1f} s", INK),
        ("used to train", "no" if held_out else "yes", AMBER if held_out else MUTED),
    ]
    draw_facts(canvas, right, facts, layout.text)
    return canvas


def comparison_row(studio: Studio, i: int) -> tuple[Image, float]:
    """Returns the panels of frame i in a row (real frame, render, depth, error), and the PSNR of the render [dB].

    The render uses the lighting's trained embedding; nothing is fitted to the frame. The error is the mean over the
    channels of |render − film|, as a share of full brightness.
    """
    cameras = studio.cameras
    render = studio.render_frame(i, cameras.lightings[i], PANEL_SIZE)
    rgb, depth = render.rgb[0], depth_colors(render.depth[0], render.opacity[0])
    height, width = depth.shape[:2]
    film = resize(read_image(cameras.image_path(i)), width, height) / 255.0
    path = cameras.mask_path(i)
    # A pixel of the shrunk mask is valid if it covers no masked pixel.
    mask = None if path is None else resize((read_image(path)[..., 0] > 0).astype(np.float32), width, height) > 0.999
    score = psnr(rgb, film, mask)
    error = error_colors(np.abs(rgb - film).mean(-1), mask)
    bar = max(40, width - 16)
    ramp = NEAREST_DEPTH * (FARTHEST_DEPTH / NEAREST_DEPTH) ** np.linspace(0.0, 1.0, bar)
    ticks = [(float(depth_scale(m)), f"{m:g}") for m in (NEAREST_DEPTH, *_DEPTH_TICKS)]
    depths = scale_bar(width, depth_colors(ramp[None]), [*ticks, (1.0, f"{FARTHEST_DEPTH:g} m")])
    ticks = [(share, f"{100 * share * MAX_ERROR:.0f}") for share in (0.0, 1 / 3, 2 / 3)]
    errors = error_colors(np.linspace(0, MAX_ERROR, bar)[None])
    errors = scale_bar(width, errors, [*ticks, (1.0, f"{100 * MAX_ERROR:.0f} %+")])
    unseen = caption_line(width, *(("held out", AMBER) if cameras.held_out[i] else ("trained on", MUTED)))
    own = caption_line(width, "light not fitted to this frame")
    panels = [
        titled_panel(fit(studio.real_frame(i), (width, height)), "real", cameras.names[i], unseen),
        titled_panel(to_uint8(rgb), "rendered", f"{score:.1f} dB PSNR", own),
        titled_panel(depth, "depth", "gray: nothing solid", depths),
        titled_panel(error, "error", "of full brightness", errors),
    ]
    return panel_row(panels), score


def error_colors(error: NDArray, mask: NDArray[np.bool_] | None = None) -> Image:
    """Colors of errors (h, w), which are given as shares of full brightness.

    Small errors are dark. Pixels where `mask` is False are gray.
    """
    colors = colored("viridis", np.clip(error / MAX_ERROR, 0.0, 1.0))
    if mask is not None:
        colors[~mask] = MUTED
    return colors


def map_with_pose(map_view: MapView, pose: NDArray[np.float64], dots: NDArray[np.float64] | None, text: int) -> Image:
    picture = map_view.with_marker(pose[:3, 3], pose[:3, 2], dots=dots)
    draw_label(picture, "map", (0, 0, picture.shape[1], picture.shape[0]), size=round(text * 0.85))
    return picture


def lighting_steps(lightings: int, budget: int) -> int:
    """Number of views per transition between two lightings, at least 2; `budget` also covers one final view."""
    return max(2, (budget - 1) // max(1, lightings - 1))


def write_lighting_chapter(studio: Studio, map_view: MapView, budget: int, progress: tqdm) -> None:
    """Chapter 2: one pose rendered while the appearance is interpolated between lightings."""
    lightings, cameras, layout = studio.field.lightings, studio.cameras, studio.layout
    start = frames_to_compare(cameras, lightings[0], 9)
    if not start:
        return
    i = start[len(start) // 3]
    write_title_card(
        studio,
        "2  Changing light",
        [
            f"One pose rendered from {lightings[0]} to {lightings[-1]}. The geometry is constant; only the appearance "
            "embedding changes.",
            "Right: the nearest real frame, in the lighting that has more weight.",
        ],
    )
    nearest = {name: nearest_frame(cameras, i, name) for name in lightings}
    reals = {name: studio.real_frame(k) for name, k in nearest.items() if k is not None}
    steps = lighting_steps(len(lightings), budget)
    shown = max(1, round(studio.fps / 6))  # video frames per view
    stills = []
    for number, (a, b) in enumerate(pairwise(lightings)):
        for k in range(steps + (number == len(lightings) - 2)):
            share = k / steps
            light = {0.0: a, 1.0: b}.get(share, f"{a}:{b}:{share:.6g}")
            rgb = to_uint8(studio.render_frame(i, light).rgb[0])
            prevailing = a if share < 0.5 else b
            canvas = layout.canvas("Changing light", studio.name)
            real = (reals[prevailing], f"real: {prevailing}") if prevailing in reals else None
            layout.draw_panels(canvas, (rgb, "rendered by the twin"), real)
            slider, side = layout.strip(*LIGHTING_STRIP)
            draw_slider(canvas, slider, lightings, number + share, layout.text)
            paste(canvas, map_with_pose(map_view, cameras.camera_to_world[i], None, layout.text), side)
            pure = share in (0.0, 1.0)
            studio.writer.write(canvas, round(_HOLD_SECONDS * studio.fps) if pure else shown)
            if pure:
                stills.append(rgb)
            progress.update()
    names = lightings[:_MAX_STILLS]
    which = "every filmed lighting" if len(names) == len(lightings) else f"{len(names)} of {len(lightings)} lightings"
    caption = f"one pose in {which}: {', '.join(names)}"
    studio.save_picture("lightings", "field", caption, side_by_side(stills[: len(names)], _ROW_HEIGHT))


# ---- drive

T = TypeVar("T")

DRIVE_STRIP = (0.62, 0.38)  # shares of the strip: map, facts
_MAX_DRIVE_SECONDS = 14.0  # [s] in the video; longer drives are sped up
_CROSSFADE_SHARE = 0.25  # fraction of a lighting's route segment, at its end, in which it blends into the next
_CONTROL_RATE = 10  # control steps per second of a RecordedDrive


def smoothed_speed(drive: RecordedDrive) -> Array:
    """Ground speed [m/s], averaged over half a second, shape (k,)."""
    steps = np.linalg.norm(np.diff(drive.base_to_world[:, :2, 3], axis=0), axis=1)
    each = np.concatenate([[0.0], steps / np.maximum(np.diff(drive.times), 1e-9)])
    window = min(5, len(each))
    padded = np.pad(each, (window // 2, window - 1 - window // 2), mode="edge")
    return np.convolve(padded, np.full(window, 1.0 / window), "valid")


def lighting_at(lightings: tuple[str, ...], share: float) -> tuple[str, str]:
    """Name (for the field) and label of the lighting at a fraction of the route; lightings get equal segments."""
    index = min(int(share * len(lightings)), len(lightings) - 1)
    within = share * len(lightings) - index
    if index == len(lightings) - 1 or within <= 1.0 - _CROSSFADE_SHARE:
        return lightings[index], lightings[index]
    mixed = (within - (1.0 - _CROSSFADE_SHARE)) / _CROSSFADE_SHARE
    a, b = lightings[index : index + 2]
    return f"{a}:{b}:{mixed:.6g}", f"{a} → {b}"


def frame_timing(drive: RecordedDrive, fps: int) -> tuple[int, int]:
    """Returns control steps and video frames per picture, so that the drive takes `_MAX_DRIVE_SECONDS` at most."""
    speedup = max(1.0, float(drive.times[-1]) / _MAX_DRIVE_SECONDS)
    every = max(1, math.ceil(speedup * _CONTROL_RATE / fps - 1e-9))
    return every, max(1, int(fps * every / (_CONTROL_RATE * speedup) + 1e-9))


def rendered_instants(instants: list[T], budget: int) -> list[T]:
    """Instants for which the field is rendered, at most `budget`. At the other instants, the last view is repeated."""
    return instants[:: max(1, -(-len(instants) // max(1, budget)))]


def write_drive_chapter(
    studio: Studio,
    map_view: MapView,
    world: World,
    drive: RecordedDrive,
    chase: Iterable[Image],
    budget: int,
    progress: tqdm,
) -> None:
    """Chapter 3: the drive, seen by the robot's camera and from behind the robot.

    `chase` gives the pictures from behind the robot, one per shown instant (see `review_video.chase_shots`). At most
    `budget` views of the field are rendered.
    """
    layout = studio.layout
    every, hold = frame_timing(drive, studio.fps)
    instants = frame_indices(len(drive.times), every)
    shown_speed = every * studio.fps / (_CONTROL_RATE * hold)
    write_title_card(
        studio,
        "3  The Husky drives",
        [
            f"A scripted driver without camera follows the {world.length:.1f} m route in MuJoCo, to "
            "test whether the route is drivable.",
            "Left: the radiance field, from the robot’s camera. Right: the MuJoCo scene from behind the robot, "
            "with its convex parts outlined. " + (f"{shown_speed:.3g}× speed." if shown_speed > 1.01 else ""),
        ],
    )
    rendered = set(rendered_instants(instants, budget))
    moments = {instants[int(share * (len(instants) - 1))] for share in (0.08, 0.4, 0.65, 0.95)}
    speed, driven = smoothed_speed(drive), arc_lengths(drive.base_to_world[:, :2, 3])
    rgb, label = None, ""
    camera_stills, chase_stills = [], []
    for i, from_behind in zip(instants, chase, strict=True):
        if i in rendered or rgb is None:
            share = float((drive.progress[i] - world.start) / world.length)
            lighting, label = lighting_at(studio.field.lightings, float(np.clip(share, 0.0, 1.0)))
            view = studio.render(drive.camera_to_world[i], world.intrinsics, CAMERA_SIZE, lighting)
            rgb = to_uint8(view.rgb[0])
            progress.update()
        canvas = layout.canvas("The Husky drives", studio.name)
        robot_view, behind = (rgb, f"robot camera: {label}"), (from_behind, "MuJoCo scene, convex parts outlined")
        layout.draw_panels(canvas, robot_view, behind)
        left, right = layout.strip(*DRIVE_STRIP)
        base = drive.base_to_world[i]
        trail = drive.base_to_world[: i + 1, :2, 3]
        paste(canvas, map_view.with_marker(base[:3, 3], base[:3, 0], trail), left)
        draw_facts(canvas, right, _drive_facts(world, drive, i, speed[i], driven[i]), layout.text)
        if i == instants[-1]:
            layout.draw_outcome(canvas, _outcome_text(drive), drive.reached_goal)
        studio.writer.write(canvas, round(1.5 * studio.fps) if i == instants[-1] else hold)
        if i in moments:
            camera_stills.append(rgb)
            chase_stills.append(from_behind)
        if i == instants[len(instants) // 2]:
            studio.save_picture("poster_drive", "poster", "the Husky in the twin", canvas)
    for name, caption, stills in (
        ("drive_camera", "views of the robot’s camera along the route", camera_stills),
        ("drive_chase", "the same moments from behind the robot", chase_stills),
    ):
        studio.save_picture(name, "review", caption, side_by_side(stills, 200))


def _drive_facts(
    world: World, drive: RecordedDrive, i: int, speed: float, driven: float
) -> list[tuple[str, str, Color]]:
    error = float(drive.cross_track[i])
    off = abs(error) > 0.5 * world.half_width
    side = "left" if error > 0 else "right"
    last = i == len(drive.times) - 1
    touched = join_names(drive.touched, 2) if last and drive.touched else "nothing but ground"
    return [
        ("time", f"{drive.times[i]:.1f} s", INK),
        ("speed", f"{speed:.2f} m/s", ACCENT),
        ("driven", f"{driven:.1f} m", INK),
        ("off the route", f"{abs(error):.2f} m {side}", AMBER if off else INK),
        ("touches", touched, RED if last and drive.touched else GREEN),
    ]


def _outcome_text(drive: RecordedDrive) -> str:
    return {
        "goal": "goal reached",
        "touched": f"stopped: touched {join_names(drive.touched, 2)}",
        "off_corridor": "stopped: left the corridor",
        "timeout": "stopped: out of time",
    }[drive.outcome]
