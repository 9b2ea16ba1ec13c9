"""The film of one episode: what the robot sees, the robot from behind, where it is, and how fast and how rewarded.

*Traces* are curves over time, drawn up to the instant shown, on a scale that stays the same throughout.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from twin.assets.ground import Ground
from twin.env.episode import Episode
from twin.env.obstacles import pose_at
from twin.errors import listing
from twin.mjcf.world import World, point_at
from twin.report.chase_camera import SceneCamera, chase_poses, frame_indices
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
    FrameLayout,
    MapView,
    draw_text,
    facts,
    place,
    plate,
)
from twin.report.video_writer import VideoWriter
from twin.runtime import bar
from twin.types import Array, Image

_SHARES = (0.42, 0.34, 0.24)  # of the strip: plan, traces, facts
_ENDING = 2.0  # [s] that the last instant stays
_CRF = 22
_SPEED_WINDOW = 5  # instants
ENDINGS = {
    "goal": "goal reached",
    "collision": "collision",
    "out_of_bounds": "left the corridor",
    "timeout": "out of time",
    "rollover": "rolled over",
    "stuck": "stuck",
    "": "cut off",
}
"""Why an episode ended, in words."""


def film_episode(
    path: Path,
    episode: Episode,
    seen: Sequence[Image],
    world: World,
    half_width: float,
    stretch: tuple[float, float],
    surroundings: tuple[Ground | None, list[Array]],
    title: str,
    width: int = 480,
    every: int = 2,
) -> None:
    """Writes an mp4.

    Args:
        path: Where it goes.
        episode: What is shown.
        seen: Picture of the robot at each instant, uint8 (h, w, 3).
        world: What was driven in.
        half_width: Of the corridor [m].
        stretch: Arc lengths at which the task begins and ends [m].
        surroundings: Ground and outlines of solid parts, for the plan.
        title: Of the film.
        width: Of a panel [px].
        every: Instants between two pictures; the film runs as many times as fast.
    """
    layout = FrameLayout.for_pictures(width, seen[0].shape[0] / seen[0].shape[1])
    fps = max(1, round(1.0 / float(np.median(np.diff(episode.times))))) if len(episode.times) > 1 else 10
    camera = SceneCamera(world, layout.panel, obstacles=episode.obstacles)
    poses = chase_poses(episode.base_to_world)
    boxes = layout.strip(*_SHARES)
    ground, parts = surroundings
    s = np.append(np.arange(stretch[0], stretch[1], 0.25), stretch[1])
    plan = MapView.draw(boxes[0][2:], point_at(world.route[:, :2], s), ground, parts, half_width)
    total = np.cumsum(episode.rewards)
    last = len(episode.times) - 1
    shown = frame_indices(last + 1, every)
    note = f"light: {episode.lighting}" + (f", {every} times as fast" if every > 1 else "")
    with VideoWriter(path, layout.size, fps, _CRF) as writer, bar("film", len(shown), "picture") as progress:
        for i in shown:
            time, canvas = float(episode.times[i]), layout.canvas(title, note)
            place(canvas, seen[i], layout.left)
            place(canvas, camera.render(episode.qpos[i], poses[i], time), layout.right)
            plate(canvas, "what the robot sees", layout.left, size=layout.text, bold=True)
            plate(canvas, "physics, solid parts drawn over", layout.right, size=layout.text, bold=True)
            others = [pose_at(one, world.route, time)[:2] for one in episode.obstacles]
            base = episode.base_to_world[i]
            trail = episode.base_to_world[: i + 1, :2, 3]
            place(
                canvas,
                plan.with_marker(base[:3, 3], base[:3, 0], trail, np.array(others) if others else None),
                boxes[0],
            )
            traces(
                canvas,
                boxes[1],
                [("speed [m/s]", episode.speed, ACCENT), ("reward so far", total, GREEN)],
                episode.times,
                i,
                layout.text,
            )
            facts(canvas, boxes[2], _facts(episode, half_width, i, float(total[i])), layout.text)
            if i == last:
                _ending(canvas, layout, episode)
            writer.write(canvas, round(_ENDING * fps) if i == last else 1)
            progress.update()


def traces(
    canvas: Image, box: Box, rows: Sequence[tuple[str, Array, Colour]], times: Array, now: int, size: int
) -> None:
    """Draws curves, one above the other, in place.

    Args:
        canvas: Drawn on.
        box: Where.
        rows: Name, values (k,) and colour of each.
        times: [s], shape (k,).
        now: Instant up to which they are drawn.
        size: Of the text [px].
    """
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = SUNKEN
    each, pad = height // len(rows), 8
    for k, (name, values, colour) in enumerate(rows):
        top, bottom = y + k * each + round(1.6 * size), y + (k + 1) * each - pad
        low, high = min(0.0, float(values.min())), max(0.0, float(values.max()))
        high = high if high > low else low + 1.0
        draw_text(canvas, name, x + pad, y + k * each + 4, size, MUTED)
        draw_text(canvas, f"{values[now]:.2f}", x + width - pad, y + k * each + 4, size, colour, True, "right")
        across = x + pad + (times - times[0]) / max(float(times[-1] - times[0]), 1e-9) * (width - 2 * pad)
        down = bottom - (values - low) / (high - low) * (bottom - top)
        zero = round(bottom + low / (high - low) * (bottom - top))
        cv2.line(canvas, (x + pad, zero), (x + width - pad, zero), (70, 78, 90), 1)
        points = np.stack([across, down], -1)[: now + 1]
        cv2.polylines(canvas, [(points * 16).round().astype(np.int32)], False, colour, 2, cv2.LINE_AA, 4)


def _facts(episode: Episode, half_width: float, i: int, reward: float) -> list[tuple[str, str, Colour]]:
    off, trust = float(episode.cross_track[i]), float(episode.trust[i])
    return [
        ("time", f"{episode.times[i]:.1f} s", INK),
        ("driven", f"{episode.progress[i]:.1f} m", INK),
        ("off route", f"{abs(off):.2f} m", AMBER if abs(off) > 0.5 * half_width else INK),
        ("reward", f"{reward:.1f}", INK),
        ("trust", "–" if np.isnan(trust) else f"{trust:.2f}", AMBER if trust < 0.5 else INK),
    ]


def _ending(canvas: Image, layout: FrameLayout, episode: Episode) -> None:
    text = ENDINGS[episode.cause]
    if episode.cause == "collision":
        text = f"collision with {listing(episode.touched, 2)}"
    colour = GREEN if episode.success else RED
    plate(canvas, text, layout.right, "bottom right", round(layout.text * 1.2), colour, True)
