"""The chapters of the review film that need no robot: the field beside the real frames, and the light turning."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from twin.geometry.cameras import nearest_frame
from twin.report.panels import (
    ACCENT,
    AMBER,
    GREEN,
    INK,
    MUTED,
    SUNKEN,
    Box,
    Picture,
    depth_colours,
    draw_text,
    facts,
    legend,
    place,
    plate,
    shorten,
)
from twin.report.plan import Plan
from twin.report.rows import judged_row
from twin.report.studio import Studio, as_picture, frames_to_compare, side_by_side

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


def compare_with_the_film(studio: Studio, plan: Plan, chosen: dict[str, list[int]], progress: tqdm) -> None:
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


def _comparison(
    studio: Studio, plan: Plan, i: int, lighting: str, pictures: tuple[Picture, Picture, Picture]
) -> Picture:
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


def plan_with(plan: Plan, pose: NDArray[np.float64], dots: NDArray[np.float64] | None, text: int) -> Picture:
    """The plan with its label, a marker at a camera pose, and the other cameras as dots."""
    picture = plan.with_marker(pose[:3, 3], pose[:3, 2], dots=dots)
    plate(picture, "from above", (0, 0, picture.shape[1], picture.shape[0]), size=round(text * 0.85))
    return picture


def light_steps(lightings: int, budget: int) -> int:
    """Views from one lighting to the next, so that all of them and the last one keep within the budget."""
    return max(2, (budget - 1) // max(1, lightings - 1))


def turn_the_light(studio: Studio, plan: Plan, budget: int, progress: tqdm) -> None:
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


def _slider(canvas: Picture, box: Box, lightings: tuple[str, ...], at: float, size: int) -> None:
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
