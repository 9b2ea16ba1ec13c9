"""The chapter of the review film with the robot in it, and what its drive comes to in numbers."""

import math
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from twin.env.chase import frame_indices
from twin.env.follower import Drive
from twin.mjcf.world import World, arc_lengths
from twin.report.chapters import title_card
from twin.report.panels import ACCENT, AMBER, GREEN, INK, RED, Colour, Picture, facts, place, plate
from twin.report.plan import Plan
from twin.report.studio import Studio, as_picture, side_by_side
from twin.report.words import listing
from twin.robot import CAMERA_SIZE

Array = NDArray[np.float64]
T = TypeVar("T")

DRIVE_STRIP = (0.62, 0.38)  # shares of the strip below: plan, facts
_LONGEST = 14.0  # [s] the drive may take in the film; a longer one is shown faster
_CROSSFADE = 0.25  # share of a lighting's stretch of the route in which it turns into the next
_TRACE_SAMPLES = 200  # of a drive, for the page
_CONTROL_RATE = 10  # instants per second in a Drive


def drive_metrics(drive: Drive) -> dict[str, Any]:
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


def speeds(drive: Drive) -> Array:
    """Speed over ground at each instant [m/s], averaged over half a second, shape (k,)."""
    steps = np.linalg.norm(np.diff(drive.base_to_world[:, :2, 3], axis=0), axis=1)
    each = np.concatenate([[0.0], steps / np.maximum(np.diff(drive.times), 1e-9)])
    window = min(5, len(each))
    padded = np.pad(each, (window // 2, window - 1 - window // 2), mode="edge")
    return np.convolve(padded, np.full(window, 1.0 / window), "valid")


def trace(drive: Drive) -> dict[str, list[float]]:
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


def stride(drive: Drive, fps: int) -> tuple[int, int]:
    """Control steps between two pictures of the drive, and film frames each is shown for; `_LONGEST` [s] in all."""
    speedup = max(1.0, float(drive.times[-1]) / _LONGEST)
    every = max(1, math.ceil(speedup * _CONTROL_RATE / fps - 1e-9))
    return every, max(1, int(fps * every / (_CONTROL_RATE * speedup) + 1e-9))


def rendered_instants(instants: list[T], budget: int) -> list[T]:
    """Those instants of the film that get a view of the field of their own; in between the last one stays."""
    return instants[:: max(1, -(-len(instants) // max(1, budget)))]


def film_drive(
    studio: Studio,
    plan: Plan,
    world: World,
    drive: Drive,
    chase: Iterable[Picture],
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


def _captions(world: World, drive: Drive, i: int, speed: float, driven: float) -> list[tuple[str, str, Colour]]:
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


def _ending(canvas: NDArray[np.uint8], studio: Studio, drive: Drive) -> None:
    text = {
        "goal": "goal reached",
        "touched": f"stopped: touched {listing(drive.touched, 2)}",
        "off_corridor": "stopped: left the corridor",
        "timeout": "stopped: out of time",
    }.get(drive.outcome, f"stopped: {drive.outcome}")
    colour = GREEN if drive.reached_goal else RED
    plate(canvas, text, studio.layout.right, "bottom right", round(studio.layout.text * 1.2), colour, True)
