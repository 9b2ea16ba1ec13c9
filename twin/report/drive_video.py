"""Videos of drives: two pictures, map, curves of two quantities, and facts; the last frame shows the outcome.

`write_episode_video` shows an episode in the twin: the camera observation, and a chase camera. `write_trial_video`
shows a trial on the road: the robot's picture, and the twin's from the same pose. *Replay*: the drive of the simulated
robot by the trial's commands (`twin.evaluation.trial_judge`).
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from twin.assets.ground import Ground
from twin.env.episode import Episode
from twin.env.mujoco_renderer import SceneCamera, chase_poses
from twin.env.obstacles import obstacle_pose
from twin.errors import join_names
from twin.evaluation.trial_judge import JudgedTrial, TrialViews
from twin.geometry.polyline import point_at
from twin.mjcf.world import World
from twin.report.video_layout import (
    ACCENT,
    AMBER,
    GREEN,
    INK,
    MUTED,
    PANEL_BACKGROUND,
    Box,
    Color,
    FrameLayout,
    MapView,
    draw_facts,
    draw_text,
    paste,
)
from twin.report.video_writer import VideoWriter, frame_indices
from twin.runtime import bar
from twin.types import Array, Image

_STRIP_SHARES = (0.42, 0.34, 0.24)  # shares of the strip's width: map, curves, facts
_FINAL_HOLD = 2.0  # [s] for which the last frame is held
_CRF = 22
_WIDTH = 480  # [px] width of a panel
_EVERY = 2  # control steps per frame of an episode's video, which plays this many times faster than real time
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

Curve = tuple[str, Array, Color]
"""Name, values (k,) and color."""
Place = tuple[World, float, tuple[float, float], tuple[Ground | None, list[Array]]]
"""For the map: the world; half width of the corridor [m]; arc lengths of the task's start and end on the route [m]; and
ground and outlines of convex parts (`twin.report.review_video.load_ground_and_parts`)."""
_Frame = tuple[int, Image, Image, tuple[Array, Array, Array, Array | None], tuple[str, str], float]
"""Index of the instant, left and right picture, arguments of `MapView.with_marker`, a further fact, and the trust."""


def write_episode_video(path: Path, episode: Episode, observations: Sequence[Image], place: Place, title: str) -> None:
    """Writes an episode as an mp4; `observations` are the robot's pictures at each control step, shape (h, w, 3)."""
    layout = FrameLayout.for_pictures(_WIDTH, observations[0].shape[0] / observations[0].shape[1])
    fps = max(1, round(1.0 / float(np.median(np.diff(episode.times))))) if len(episode.times) > 1 else 10
    route = place[0].route
    camera = SceneCamera(place[0], layout.panel, obstacles=episode.obstacles)
    poses = chase_poses(episode.base_to_world)
    total = np.cumsum(episode.rewards)
    instants = frame_indices(len(episode.times), _EVERY)

    def frames() -> Iterator[_Frame]:
        for i in instants:
            time, base = float(episode.times[i]), episode.base_to_world[i]
            obstacles = [obstacle_pose(one, route, time)[:2] for one in episode.obstacles]
            dots = np.array(obstacles) if obstacles else None
            marker = base[:3, 3], base[:3, 0], episode.base_to_world[: i + 1, :2, 3], dots
            from_behind = camera.render(episode.qpos[i], poses[i], time)
            yield i, observations[i], from_behind, marker, ("reward", f"{total[i]:.1f}"), float(episode.trust[i])

    end = f"collision with {join_names(episode.touched, 2)}" if episode.cause == "collision" else None
    texts = title, f"{_EVERY}× speed, lighting: {episode.lighting}", "MuJoCo scene, convex parts outlined"
    curves = [("speed [m/s]", episode.speed, ACCENT), ("cumulative reward", total, GREEN)]
    _write_frames(path, layout, fps, place, texts, episode, curves, frames(), len(instants), end)


def write_trial_video(
    path: Path,
    trial: JudgedTrial,
    replayed: Array,
    pictures: Sequence[Image],
    times: Array,
    views: TrialViews,
    place: Place,
    title: str,
) -> None:
    """Writes a trial as an mp4 that plays in real time.

    Args:
        replayed: Poses (x, y, yaw) of the twin's replay at the trial's times, shape (k, 3).
        pictures: n pictures of the robot's camera as the policy saw them, each uint8, shape (h, w, 3).
        times: Times of the pictures since the trial's start [s], shape (n,).
        views: The twin's pictures from the same poses.
    """
    layout = FrameLayout.for_pictures(_WIDTH, pictures[0].shape[0] / pictures[0].shape[1])
    fps = max(1, round((len(times) - 1) / max(float(times[-1] - times[0]), 1e-3)))

    def frames() -> Iterator[_Frame]:
        for i, time in enumerate(times):
            k = int(np.clip(np.searchsorted(trial.times, time + 1e-6) - 1, 0, len(trial.times) - 1))
            heading = np.array([np.cos(trial.poses[k, 2]), np.sin(trial.poses[k, 2])])
            marker = trial.poses[k, :2], heading, trial.poses[: k + 1, :2], replayed[: k + 1, :2]
            yield k, pictures[i], views.twin[i], marker, ("PSNR", f"{views.psnr[i]:.1f} dB"), float(views.trust[i])

    texts = title, f"twin: {views.lighting}", "the twin from the same pose"
    apart = np.linalg.norm(trial.poses[:, :2] - replayed[:, :2], axis=1)
    curves = [("cross-track error [m]", trial.cross_track, ACCENT), ("distance to the twin's replay [m]", apart, GREEN)]
    _write_frames(path, layout, fps, place, texts, trial, curves, frames(), len(times))


def _write_frames(
    path: Path,
    layout: FrameLayout,
    fps: int,
    place: Place,
    texts: tuple[str, str, str],
    drive: Episode | JudgedTrial,
    curves: Sequence[Curve],
    frames: Iterator[_Frame],
    count: int,
    end: str | None = None,
) -> None:
    """Writes `count` frames. `texts`: title, note, label of the right picture; `end`: the outcome, by default the
    cause's text."""
    title, note, label = texts
    world, half_width, (start, stop), (ground, parts) = place
    boxes = layout.strip(*_STRIP_SHARES)
    line = point_at(world.route[:, :2], np.append(np.arange(start, stop, 0.25), stop))
    map_view = MapView.draw(boxes[0][2:], line, ground, parts, half_width)
    with VideoWriter(path, layout.size, fps, _CRF) as writer, bar("video", count, "frame") as progress:
        for number, (i, left, right, marker, special, trust) in enumerate(frames, 1):
            canvas = layout.canvas(title, note)
            layout.draw_panels(canvas, (left, "the robot’s camera"), (right, label))
            paste(canvas, map_view.with_marker(*marker), boxes[0])
            draw_curves(canvas, boxes[1], curves, drive.times, i, layout.text)
            off = abs(float(drive.cross_track[i]))
            facts = [
                ("time", f"{drive.times[i]:.1f} s", INK),
                ("driven", f"{drive.progress[i]:.1f} m", INK),
                ("off route", f"{off:.2f} m", AMBER if off > 0.5 * half_width else INK),
                (*special, INK),
                ("trust", "–" if np.isnan(trust) else f"{trust:.2f}", AMBER if trust < 0.5 else INK),
            ]
            draw_facts(canvas, boxes[2], facts, layout.text)
            if number == count:
                layout.draw_outcome(canvas, end or CAUSE_TEXT[drive.cause], drive.cause == "goal")
            writer.write(canvas, round(_FINAL_HOLD * fps) if number == count else 1)
            progress.update()


def draw_curves(canvas: Image, box: Box, rows: Sequence[Curve], times: Array, now: int, size: int) -> None:
    """Draws curves over `times` [s], shape (k,), one above the other into a box. They end at index `now`.

    A curve's scale covers all its values, so the scale is the same in all frames of a video.
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
