"""Video of a trial on the road: the robot's picture beside the twin's from the same pose, map, curves and outcome.

*Replay*: the drive of the simulated robot by the recorded commands (`twin.evaluation.trial_judge`).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from twin.assets.ground import Ground
from twin.evaluation.trial_judge import JudgedTrial, TrialViews
from twin.mjcf.world import World, point_at
from twin.report.episode_video import CAUSE_TEXT, draw_curves
from twin.report.video_layout import (
    ACCENT,
    AMBER,
    GREEN,
    INK,
    RED,
    FrameLayout,
    MapView,
    draw_facts,
    draw_label,
    paste,
)
from twin.report.video_writer import VideoWriter
from twin.runtime import bar
from twin.types import Array, Image

_STRIP_SHARES = (0.42, 0.34, 0.24)  # shares of the strip's width: map, curves, facts
_FINAL_HOLD = 2.0  # [s] for which the last frame is held
_CRF = 22
_WIDTH = 480  # [px] width of a panel


def write_trial_video(
    path: Path,
    trial: JudgedTrial,
    replayed: Array,
    pictures: Sequence[Image],
    times: Array,
    views: TrialViews,
    world: World,
    half_width: float,
    segment: tuple[float, float],
    ground_and_parts: tuple[Ground | None, list[Array]],
    title: str,
) -> None:
    """Writes a trial as an mp4 that plays in real time.

    Args:
        path: The mp4.
        trial: The judged trial.
        replayed: Poses (x, y, yaw) of the twin's replay at the trial's times, shape (k, 3).
        pictures: n pictures of the robot's camera as the policy saw them, each uint8, shape (h, w, 3).
        times: Times of the pictures since the trial's start [s], shape (n,).
        views: The twin's pictures from the same poses.
        world: The scene's world.
        half_width: Half width of the corridor [m].
        segment: Arc lengths of the task's start and end on the route [m].
        ground_and_parts: Ground and outlines of solid parts, for the map.
        title: Title in the header.
    """
    layout = FrameLayout.for_pictures(_WIDTH, pictures[0].shape[0] / pictures[0].shape[1])
    fps = max(1, round((len(times) - 1) / max(float(times[-1] - times[0]), 1e-3)))
    boxes = layout.strip(*_STRIP_SHARES)
    s = np.append(np.arange(segment[0], segment[1], 0.25), segment[1])
    map_view = MapView.draw(boxes[0][2:], point_at(world.route[:, :2], s), *ground_and_parts, half_width)
    apart = np.linalg.norm(trial.poses[:, :2] - replayed[:, :2], axis=1)
    curves = [("cross-track error [m]", trial.cross_track, ACCENT), ("distance to the twin's replay [m]", apart, GREEN)]
    with VideoWriter(path, layout.size, fps, _CRF) as writer, bar("video", len(times), "frame") as progress:
        for i, time in enumerate(times):
            k = int(np.clip(np.searchsorted(trial.times, time + 1e-6) - 1, 0, len(trial.times) - 1))
            canvas = layout.canvas(title, f"twin: {views.lighting}")
            paste(canvas, pictures[i], layout.left)
            paste(canvas, views.twin[i], layout.right)
            draw_label(canvas, "the robot's camera", layout.left, size=layout.text, bold=True)
            draw_label(canvas, "the twin from the same pose", layout.right, size=layout.text, bold=True)
            heading = np.array([np.cos(trial.poses[k, 2]), np.sin(trial.poses[k, 2])])
            trail, dots = trial.poses[: k + 1, :2], replayed[: k + 1, :2]
            paste(canvas, map_view.with_marker(trial.poses[k, :2], heading, trail, dots), boxes[0])
            draw_curves(canvas, boxes[1], curves, trial.times, k, layout.text)
            off, trust = float(trial.cross_track[k]), float(views.trust[i])
            facts = [
                ("time", f"{trial.times[k]:.1f} s", INK),
                ("driven", f"{trial.progress[k]:.1f} m", INK),
                ("off route", f"{abs(off):.2f} m", AMBER if abs(off) > 0.5 * half_width else INK),
                ("PSNR", f"{views.psnr[i]:.1f} dB", INK),
                ("trust", f"{trust:.2f}", AMBER if trust < 0.5 else INK),
            ]
            draw_facts(canvas, boxes[2], facts, layout.text)
            if i == len(times) - 1:
                color = GREEN if trial.cause == "goal" else RED
                draw_label(
                    *(canvas, CAUSE_TEXT[trial.cause], layout.right, "bottom right"),
                    *(round(layout.text * 1.2), color, True),
                )
            writer.write(canvas, round(_FINAL_HOLD * fps) if i == len(times) - 1 else 1)
            progress.update()
