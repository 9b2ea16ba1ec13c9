"""Video of one episode: camera observation, chase camera, map, and curves of speed and cumulative reward."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from twin.assets.ground import Ground
from twin.env.episode import Episode
from twin.env.mujoco_renderer import SceneCamera, chase_poses
from twin.env.obstacles import obstacle_pose
from twin.errors import join_names
from twin.mjcf.world import World, point_at
from twin.report.video_layout import (
    ACCENT,
    AMBER,
    GREEN,
    INK,
    MUTED,
    PANEL_BACKGROUND,
    RED,
    Box,
    Color,
    FrameLayout,
    MapView,
    draw_facts,
    draw_label,
    draw_text,
    paste,
)
from twin.report.video_writer import VideoWriter, frame_indices
from twin.runtime import bar
from twin.types import Array, Image

_STRIP_SHARES = (0.42, 0.34, 0.24)  # shares of the strip's width: map, curves, facts
_FINAL_HOLD = 2.0  # [s] for which the last frame is held
_CRF = 22
CAUSE_TEXT = {
    "goal": "goal reached",
    "collision": "collision",
    "out_of_bounds": "left the corridor",
    "timeout": "out of time",
    "rollover": "rolled over",
    "stuck": "stuck",
    "": "cut off",
}
"""Cause of termination → its text in the video."""


def write_episode_video(
    path: Path,
    episode: Episode,
    observations: Sequence[Image],
    world: World,
    half_width: float,
    segment: tuple[float, float],
    ground_and_parts: tuple[Ground | None, list[Array]],
    title: str,
    width: int = 480,
    every: int = 2,
) -> None:
    """Writes an episode as an mp4.

    Args:
        path: The mp4.
        episode: The recorded episode.
        observations: Camera image at each control step, uint8, shape (h, w, 3).
        world: The world of the episode.
        half_width: Half width of the corridor [m].
        segment: Arc lengths of the task's start and end on the route [m].
        ground_and_parts: Ground and outlines of solid parts, for the map.
        title: Title in the header.
        width: Width of a panel [px].
        every: Control steps per video frame. The video plays this many times faster than real time.
    """
    layout = FrameLayout.for_pictures(width, observations[0].shape[0] / observations[0].shape[1])
    fps = max(1, round(1.0 / float(np.median(np.diff(episode.times))))) if len(episode.times) > 1 else 10
    camera = SceneCamera(world, layout.panel, obstacles=episode.obstacles)
    poses = chase_poses(episode.base_to_world)
    boxes = layout.strip(*_STRIP_SHARES)
    ground, parts = ground_and_parts
    s = np.append(np.arange(segment[0], segment[1], 0.25), segment[1])
    map_view = MapView.draw(boxes[0][2:], point_at(world.route[:, :2], s), ground, parts, half_width)
    total = np.cumsum(episode.rewards)
    last = len(episode.times) - 1
    instants = frame_indices(last + 1, every)
    note = f"lighting: {episode.lighting}" + (f", {every}× speed" if every > 1 else "")
    with VideoWriter(path, layout.size, fps, _CRF) as writer, bar("video", len(instants), "frame") as progress:
        for i in instants:
            time, canvas = float(episode.times[i]), layout.canvas(title, note)
            paste(canvas, observations[i], layout.left)
            paste(canvas, camera.render(episode.qpos[i], poses[i], time), layout.right)
            draw_label(canvas, "the robot’s camera", layout.left, size=layout.text, bold=True)
            draw_label(canvas, "MuJoCo scene, solid parts outlined", layout.right, size=layout.text, bold=True)
            obstacle_positions = [obstacle_pose(one, world.route, time)[:2] for one in episode.obstacles]
            base = episode.base_to_world[i]
            trail = episode.base_to_world[: i + 1, :2, 3]
            paste(
                canvas,
                map_view.with_marker(
                    base[:3, 3], base[:3, 0], trail, np.array(obstacle_positions) if obstacle_positions else None
                ),
                boxes[0],
            )
            draw_curves(
                canvas,
                boxes[1],
                [("speed [m/s]", episode.speed, ACCENT), ("cumulative reward", total, GREEN)],
                episode.times,
                i,
                layout.text,
            )
            draw_facts(canvas, boxes[2], _facts(episode, half_width, i, float(total[i])), layout.text)
            if i == last:
                _draw_outcome(canvas, layout, episode)
            writer.write(canvas, round(_FINAL_HOLD * fps) if i == last else 1)
            progress.update()


def draw_curves(
    canvas: Image, box: Box, rows: Sequence[tuple[str, Array, Color]], times: Array, now: int, size: int
) -> None:
    """Draws curves over `times` [s], shape (k,), one above the other into a box. They end at index `now`.

    `rows` contains name, values (k,) and color of each curve. A curve's scale covers all its values, so the scale
    is the same in all frames of a video.
    """
    x, y, width, height = box
    canvas[y : y + height, x : x + width] = PANEL_BACKGROUND
    each, pad = height // len(rows), 8
    for k, (name, values, color) in enumerate(rows):
        top, bottom = y + k * each + round(1.6 * size), y + (k + 1) * each - pad
        low, high = min(0.0, float(values.min())), max(0.0, float(values.max()))
        high = high if high > low else low + 1.0
        draw_text(canvas, name, x + pad, y + k * each + 4, size, MUTED)
        draw_text(canvas, f"{values[now]:.2f}", x + width - pad, y + k * each + 4, size, color, True, "right")
        across = x + pad + (times - times[0]) / max(float(times[-1] - times[0]), 1e-9) * (width - 2 * pad)
        down = bottom - (values - low) / (high - low) * (bottom - top)
        zero = round(bottom + low / (high - low) * (bottom - top))
        cv2.line(canvas, (x + pad, zero), (x + width - pad, zero), (70, 78, 90), 1)
        points = np.stack([across, down], -1)[: now + 1]
        cv2.polylines(canvas, [(points * 16).round().astype(np.int32)], False, color, 2, cv2.LINE_AA, 4)


def _facts(episode: Episode, half_width: float, i: int, reward: float) -> list[tuple[str, str, Color]]:
    off, trust = float(episode.cross_track[i]), float(episode.trust[i])
    return [
        ("time", f"{episode.times[i]:.1f} s", INK),
        ("driven", f"{episode.progress[i]:.1f} m", INK),
        ("off route", f"{abs(off):.2f} m", AMBER if abs(off) > 0.5 * half_width else INK),
        ("reward", f"{reward:.1f}", INK),
        ("trust", "–" if np.isnan(trust) else f"{trust:.2f}", AMBER if trust < 0.5 else INK),
    ]


def _draw_outcome(canvas: Image, layout: FrameLayout, episode: Episode) -> None:
    text = CAUSE_TEXT[episode.cause]
    if episode.cause == "collision":
        text = f"collision with {join_names(episode.touched, 2)}"
    color = GREEN if episode.success else RED
    draw_label(canvas, text, layout.right, "bottom right", round(layout.text * 1.2), color, True)
