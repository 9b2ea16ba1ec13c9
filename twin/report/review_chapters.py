"""The chapters of the review film that need no robot: the field beside the real frames, and the light turning."""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from twin.env.drivers import FollowedDrive
from twin.errors import listing
from twin.geometry.cameras import nearest_frame
from twin.mjcf.world import World, arc_lengths
from twin.report.chase_camera import frame_indices
from twin.report.review_studio import Studio, as_picture, frames_to_compare, judged_row, side_by_side
from twin.report.video_layout import (
    ACCENT,
    AMBER,
    GREEN,
    INK,
    MUTED,
    RED,
    SUNKEN,
    Box,
    Colour,
    MapView,
    depth_colours,
    draw_text,
    facts,
    legend,
    place,
    plate,
    shorten,
)
from twin.robot import CAMERA_SIZE
from twin.types import Array, Image

COMPARISON_STRIP = (0.3, 0.42, 0.28)  # shares of the strip below: depth, plan, facts
LIGHT_STRIP = (0.62, 0.38)  # slider, plan
_CARD_SECONDS = 2.5
_COMPARISON_SECONDS = 0.6
_HOLD_SECONDS = 0.8  # a pure lighting stands still for this long
_ROW_HEIGHT = 240  # [px] of the pictures kept for the page


def title_card(studio: Studio, title: str, lines: list[str], seconds: float = _CARD_SECONDS) -> None:
    """A card that says what comes next."""
    studio.writer.write(studio.layout.card(title, lines), max(1, round(seconds * studio.fps)))


def comparison_frames(studio: Studio, budget: int) -> dict[str, list[int]]:
    """Which frames the first chapter shows, by lighting: with a render more per lighting, which is for the page, no
    more than `budget` in all (one frame per lighting at least)."""
    share = max(1, budget // max(1, len(studio.field.lightings)) - 1)
    return {name: frames_to_compare(studio.cameras, name, share) for name in studio.field.lightings}


def compare_with_the_film(studio: Studio, plan: MapView, chosen: dict[str, list[int]], progress: tqdm) -> None:
    """Chapter 1: real frame, the field from the same place, and its depth, lighting by lighting.

    Of each lighting the page gets the frame in the middle of those never trained on, see `judged_row`.
    """
    title_card(
        studio,
        "1  The film and its twin",
        [
            "Left: what the camera filmed. Right: what the radiance field renders there, in the same light.",
            "Frames marked “never trained on” were kept from it: there it shows what it has understood, "
            "not what it has memorised.",
        ],
    )
    for number, (lighting, frames) in enumerate(chosen.items()):
        unseen = [i for i in frames if studio.cameras.held_out[i]]
        best = unseen[len(unseen) // 2] if unseen else None
        for i in frames:
            view = studio.frame_view(i)
            real, rgb = studio.real(i), as_picture(view.rgb[0])
            depth = depth_colours(view.depth[0], view.opacity[0])
            canvas = _comparison(studio, plan, i, lighting, (real, rgb, depth))
            studio.writer.write(canvas, max(1, round(_COMPARISON_SECONDS * studio.fps)))
            if i == best and number == 0:
                studio.keep("poster_compare", "poster", "the film and its twin", canvas)
            if i == best:
                row, score = judged_row(studio, i)
                caption = (
                    f"{lighting}: filmed, rendered from the same place at {score:.1f} dB PSNR, how far away things "
                    "are, and where the render is wrong. From the middle of the film, never trained on."
                )
                studio.keep(f"compare_{number}", "field", caption, row, row.shape[1])
            progress.update()


def _comparison(studio: Studio, plan: MapView, i: int, lighting: str, pictures: tuple[Image, Image, Image]) -> Image:
    layout, cameras = studio.layout, studio.cameras
    held_out = bool(cameras.held_out[i])
    real, rgb, depth = pictures
    canvas = layout.canvas(f"The film and its twin: {lighting}", studio.name)
    place(canvas, real, layout.left)
    place(canvas, rgb, layout.right)
    plate(canvas, "filmed", layout.left, size=layout.text, bold=True)
    plate(canvas, "rendered by the twin", layout.right, size=layout.text, bold=True)
    if held_out:
        plate(canvas, "never trained on", layout.right, "bottom right", layout.text, AMBER, True)
    below, middle, right = layout.strip(*COMPARISON_STRIP)
    place(canvas, depth, below)
    plate(canvas, "rendered depth", below, size=round(layout.text * 0.85))
    legend(canvas, below, round(layout.text * 0.75))
    pose = cameras.camera_to_world[i]
    same = np.array([name == cameras.sources[i] for name in cameras.sources])
    place(canvas, plan_with(plan, pose, cameras.positions[same][:, :2], layout.text), middle)
    facts(
        canvas,
        right,
        [
            ("lighting", lighting, ACCENT),
            ("frame", cameras.names[i].split("/")[-1], INK),
            ("film time", f"{cameras.times[i]:.1f} s", INK),
            ("used to train", "no" if held_out else "yes", AMBER if held_out else MUTED),
        ],
        layout.text,
    )
    return canvas


def plan_with(plan: MapView, pose: NDArray[np.float64], dots: NDArray[np.float64] | None, text: int) -> Image:
    """The plan with its label, a marker at a camera pose, and the other cameras as dots."""
    picture = plan.with_marker(pose[:3, 3], pose[:3, 2], dots=dots)
    plate(picture, "from above", (0, 0, picture.shape[1], picture.shape[0]), size=round(text * 0.85))
    return picture


def light_steps(lightings: int, budget: int) -> int:
    """Views from one lighting to the next, so that all of them and the last one keep within the budget."""
    return max(2, (budget - 1) // max(1, lightings - 1))


def turn_the_light(studio: Studio, plan: MapView, budget: int, progress: tqdm) -> None:
    """Chapter 2: one place, while the appearance goes from lighting to lighting."""
    lightings, cameras, layout = studio.field.lightings, studio.cameras, studio.layout
    start = frames_to_compare(cameras, lightings[0], 9)
    if not start:
        return
    i = start[len(start) // 3]
    title_card(
        studio,
        "2  The light turns",
        [
            f"The same place rendered from {lightings[0]} to {lightings[-1]}. Nothing of the geometry changes: only "
            "the appearance vector the field is asked for.",
            "Right: the real frame taken nearest to this place in the light that prevails.",
        ],
    )
    nearest = {name: nearest_frame(cameras, i, name) for name in lightings}
    reals = {name: studio.real(k) for name, k in nearest.items() if k is not None}
    steps = light_steps(len(lightings), budget)
    shown = max(1, round(studio.fps / 6))  # video frames per rendered step
    kept = []
    for number, (a, b) in enumerate(pairwise(lightings)):
        for k in range(steps + (number == len(lightings) - 2)):
            share = k / steps
            rgb = as_picture(studio.frame_view(i, _mixture(a, b, share)).rgb[0])
            prevailing = a if share < 0.5 else b
            canvas = layout.canvas("The light turns", studio.name)
            place(canvas, rgb, layout.left)
            plate(canvas, "rendered by the twin", layout.left, size=layout.text, bold=True)
            if prevailing in reals:
                place(canvas, reals[prevailing], layout.right)
                plate(canvas, f"filmed: {prevailing}", layout.right, size=layout.text, bold=True)
            slider, side = layout.strip(*LIGHT_STRIP)
            _slider(canvas, slider, lightings, number + share, layout.text)
            place(canvas, plan_with(plan, cameras.camera_to_world[i], None, layout.text), side)
            pure = share in (0.0, 1.0)
            studio.writer.write(canvas, round(_HOLD_SECONDS * studio.fps) if pure else shown)
            if pure:
                kept.append(rgb)
            progress.update()
    studio.keep(
        "lightings",
        "field",
        f"one place under every lighting it was filmed in: {', '.join(lightings)}",
        side_by_side(kept[:4], _ROW_HEIGHT),
    )


def _mixture(a: str, b: str, share: float) -> str:
    return a if share <= 0.0 else b if share >= 1.0 else f"{a}:{b}:{share:.6g}"


def _slider(canvas: Image, box: Box, lightings: tuple[str, ...], at: float, size: int) -> None:
    """A bar with a stop per lighting and a knob at `at`, counted in stops."""
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = SUNKEN
    left, right, middle = x + round(0.08 * width), x + round(0.92 * width), y + height // 2
    stops = np.linspace(left, right, len(lightings)).round().astype(int)
    canvas[middle - 2 : middle + 2, left:right] = MUTED
    room = (right - left) // max(1, len(lightings) - 1)
    for k, (stop, name) in enumerate(zip(stops, lightings, strict=True)):
        canvas[middle - 7 : middle + 7, stop - 2 : stop + 2] = INK
        near = abs(at - k) < 0.5
        align = "left" if k == 0 else "right" if k == len(lightings) - 1 else "middle"
        edge = x + 12 if k == 0 else x + width - 12 if k == len(lightings) - 1 else int(stop)
        text = shorten(name, room - 8, size, near)
        draw_text(canvas, text, edge, middle + 16, size, GREEN if near else MUTED, near, align)
    knob = round(left + (right - left) * at / max(1, len(lightings) - 1))
    canvas[middle - 10 : middle + 10, knob - 5 : knob + 5] = AMBER
    draw_text(canvas, "appearance", x + 12, y + 8, size, MUTED)


# ---- The chapter of the review film with the robot in it, and what its drive comes to in numbers.


T = TypeVar("T")

DRIVE_STRIP = (0.62, 0.38)  # shares of the strip below: plan, facts
_LONGEST = 14.0  # [s] the drive may take in the film; a longer one is shown faster
_CROSSFADE = 0.25  # share of a lighting's stretch of the route in which it turns into the next
_TRACE_SAMPLES = 200  # of a drive, for the page
_CONTROL_RATE = 10  # instants per second in a Drive


def drive_metrics(drive: FollowedDrive) -> dict[str, Any]:
    """The numbers of a drive for the report."""
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


def speeds(drive: FollowedDrive) -> Array:
    """Speed over ground at each instant [m/s], averaged over half a second, shape (k,)."""
    steps = np.linalg.norm(np.diff(drive.base_to_world[:, :2, 3], axis=0), axis=1)
    each = np.concatenate([[0.0], steps / np.maximum(np.diff(drive.times), 1e-9)])
    window = min(5, len(each))
    padded = np.pad(each, (window // 2, window - 1 - window // 2), mode="edge")
    return np.convolve(padded, np.full(window, 1.0 / window), "valid")


def trace(drive: FollowedDrive) -> dict[str, list[float]]:
    """A drive thinned out for a figure: distance along the route [m], cross-track error [m], speed [m/s]."""
    index = np.unique(np.linspace(0, len(drive.times) - 1, _TRACE_SAMPLES).round().astype(int))
    columns = {"progress_m": drive.progress, "cross_track_m": drive.cross_track, "speed_m_s": speeds(drive)}
    return {name: [round(float(v), 4) for v in values[index]] for name, values in columns.items()}


def lighting_along(lightings: tuple[str, ...], share: float) -> tuple[str, str]:
    """The lighting at a share of the way, each having its stretch: as the field takes it, and for a reader."""
    stretch = min(int(share * len(lightings)), len(lightings) - 1)
    within = share * len(lightings) - stretch
    if stretch == len(lightings) - 1 or within <= 1.0 - _CROSSFADE:
        return lightings[stretch], lightings[stretch]
    mixed = (within - (1.0 - _CROSSFADE)) / _CROSSFADE
    a, b = lightings[stretch : stretch + 2]
    return f"{a}:{b}:{mixed:.6g}", f"{a} → {b}"


def stride(drive: FollowedDrive, fps: int) -> tuple[int, int]:
    """Control steps between two pictures of the drive, and film frames each is shown for; `_LONGEST` [s] in all."""
    speedup = max(1.0, float(drive.times[-1]) / _LONGEST)
    every = max(1, math.ceil(speedup * _CONTROL_RATE / fps - 1e-9))
    return every, max(1, int(fps * every / (_CONTROL_RATE * speedup) + 1e-9))


def rendered_instants(instants: list[T], budget: int) -> list[T]:
    """Those instants of the film that get a view of the field of their own; in between the last one stays."""
    return instants[:: max(1, -(-len(instants) // max(1, budget)))]


def film_drive(
    studio: Studio,
    plan: MapView,
    world: World,
    drive: FollowedDrive,
    chase: Iterable[Image],
    budget: int,
    progress: tqdm,
) -> None:
    """Chapter 3: the Husky from its own camera and from behind.

    Args:
        studio: What is filmed with.
        plan: Of the route.
        world: What is driven in.
        drive: What is shown.
        chase: Pictures from behind, one per `stride` of the drive and one of its last instant.
        budget: How many views of the field may be rendered.
        progress: Counts them.
    """
    layout = studio.layout
    every, hold = stride(drive, studio.fps)
    instants = frame_indices(len(drive.times), every)
    shown_speed = every * studio.fps / (_CONTROL_RATE * hold)
    title_card(
        studio,
        "3  The Husky drives",
        [
            f"A scripted driver follows the {arc_lengths(world.route)[-1]:.1f} m route in MuJoCo. It sees nothing: "
            "it shows that the place can be driven.",
            "Left: what the radiance field shows to its camera. Right: the physics, with the solid parts drawn over. "
            + (f"Shown {shown_speed:.3g} times as fast." if shown_speed > 1.01 else ""),
        ],
    )
    rendered = set(rendered_instants(instants, budget))
    moments = {instants[int(share * (len(instants) - 1))] for share in (0.08, 0.4, 0.65, 0.95)}
    speed, driven = speeds(drive), arc_lengths(drive.base_to_world[:, :2, 3])
    rgb, told = None, ""
    seen, behind = [], []
    for i, from_behind in zip(instants, chase, strict=True):
        if i in rendered or rgb is None:
            share = float(drive.progress[i] / max(arc_lengths(world.route)[-1], 1e-9))
            lighting, told = lighting_along(studio.field.lightings, float(np.clip(share, 0.0, 1.0)))
            view = studio.view(drive.camera_to_world[i], world.intrinsics, CAMERA_SIZE, lighting)
            rgb = as_picture(view.rgb[0])
            progress.update()
        canvas = layout.canvas("The Husky drives", studio.name)
        place(canvas, rgb, layout.left)
        place(canvas, from_behind, layout.right)
        plate(canvas, f"its camera in the twin: {told}", layout.left, size=layout.text, bold=True)
        plate(canvas, "physics, solid parts drawn over", layout.right, size=layout.text, bold=True)
        left, right = layout.strip(*DRIVE_STRIP)
        base = drive.base_to_world[i]
        trail = drive.base_to_world[: i + 1, :2, 3]
        place(canvas, plan.with_marker(base[:3, 3], base[:3, 0], trail), left)
        facts(canvas, right, _captions(world, drive, i, speed[i], driven[i]), layout.text)
        if i == instants[-1]:
            _ending(canvas, studio, drive)
        studio.writer.write(canvas, round(1.5 * studio.fps) if i == instants[-1] else hold)
        if i in moments:
            seen.append(rgb)
            behind.append(from_behind)
        if i == instants[len(instants) // 2]:
            studio.keep("poster_drive", "poster", "the Husky in the twin", canvas)
    studio.keep("drive_camera", "review", "what its camera shows along the route", side_by_side(seen, 200))
    studio.keep("drive_chase", "review", "the same moments in the physics", side_by_side(behind, 200))


def _captions(world: World, drive: FollowedDrive, i: int, speed: float, driven: float) -> list[tuple[str, str, Colour]]:
    error = float(drive.cross_track[i])
    off = abs(error) > 0.5 * world.half_width
    side = "left" if error > 0 else "right"
    last = i == len(drive.times) - 1
    touched = listing(drive.touched, 2) if last and drive.touched else "nothing but ground"
    return [
        ("time", f"{drive.times[i]:.1f} s", INK),
        ("speed", f"{speed:.2f} m/s", ACCENT),
        ("driven", f"{driven:.1f} m", INK),
        ("off the route", f"{abs(error):.2f} m {side}", AMBER if off else INK),
        ("touches", touched, RED if last and drive.touched else GREEN),
    ]


def _ending(canvas: NDArray[np.uint8], studio: Studio, drive: FollowedDrive) -> None:
    text = {
        "goal": "goal reached",
        "touched": f"stopped: touched {listing(drive.touched, 2)}",
        "off_corridor": "stopped: left the corridor",
        "timeout": "stopped: out of time",
    }.get(drive.outcome, f"stopped: {drive.outcome}")
    colour = GREEN if drive.reached_goal else RED
    plate(canvas, text, studio.layout.right, "bottom right", round(studio.layout.text * 1.2), colour, True)
