"""Camera paths: key views in time, smooth interpolation between them, their JSON file, and the film of a path.

    {"format": 1, "views": [{"time": 0.0, "camera_to_world": [[...], ...], "fov": 60.0, "lighting": "sun"}, ...]}

`time` [s] increases, `camera_to_world` is 4×4 with OpenCV axes in the scene's frame, `fov` [°] is the vertical angle of
view, and `lighting` is a name or mixture as for `twin film`, an embedding as a list of numbers, or a mixture of two of
these, {"from": ..., "to": ..., "share": 0.3}; by default it is that of `--lighting`, else the first filmed one.
Positions follow a cubic spline, and rotations a rotation spline; angle of view, lighting and fog are interpolated
linearly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from twin.env.episode_lighting import EpisodeLighting
from twin.errors import short_repr
from twin.files import read_json, wrap_read_errors, write_json
from twin.geometry.images import to_uint8
from twin.geometry.poses import pose_of
from twin.nerf.baked import BakedField
from twin.nerf.lightings import mixed_fog
from twin.nerf.sun import mixed_sunlight
from twin.types import Array
from twin.view.scene_picture import FreeCamera, ScenePicture

_FORMAT = 1
_CRF = 20
_MAX_VIEWS, _MAX_DURATION = 1000, 3600.0  # [s]
_MIN_FOV, _MAX_FOV = 5.0, 150.0  # [°]
_CURE = "save the path again in twin view, or correct the file"


@dataclass(frozen=True)
class MixedLighting(EpisodeLighting):
    """A lighting between two others. A path's file stores these two, since an embedding alone has no fog and no sun."""

    parts: tuple[EpisodeLighting, EpisodeLighting] = field(kw_only=True)
    share: float = field(kw_only=True)
    """Share of the way from the first part to the second one, between 0 and 1."""


@dataclass(frozen=True)
class KeyView:
    """A camera pose at a time on a path."""

    time: float
    """[s]"""
    camera_to_world: Array
    """OpenCV axes, shape (4, 4)."""
    fov: float
    """Vertical angle of view [°]."""
    lighting: EpisodeLighting


@dataclass(frozen=True)
class CameraPath:
    """Key views of increasing time; two or more."""

    views: tuple[KeyView, ...]

    def __post_init__(self) -> None:
        """Raises ValueError: too few or too many views, or times that do not increase."""
        times = [view.time for view in self.views]
        if not 2 <= len(times) <= _MAX_VIEWS:
            raise ValueError(f"{len(times)} views; expected 2 to {_MAX_VIEWS}")
        if np.min(np.diff(times)) < 1e-3 or self.duration > _MAX_DURATION:
            raise ValueError(f"times {short_repr(times)}; expected increasing ones, within {_MAX_DURATION:g} s")

    @property
    def duration(self) -> float:
        """[s]"""
        return self.views[-1].time - self.views[0].time

    def at(self, times: Array) -> list[tuple[Array, float, EpisodeLighting]]:
        """Pose (4, 4), vertical angle of view [°] and lighting at times after the start [s], shape (k,)."""
        from scipy.interpolate import CubicSpline, PchipInterpolator  # scipy is slow to import
        from scipy.spatial.transform import Rotation, RotationSpline

        knots = np.array([view.time for view in self.views]) - self.views[0].time
        poses = np.array([view.camera_to_world for view in self.views])
        t = np.clip(times, 0.0, knots[-1])
        # A cubic spline overshoots where the camera stands still. In this case, and for two views, PCHIP is used.
        still = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).min() < 1e-6
        curve = PchipInterpolator if still or len(knots) == 2 else CubicSpline
        turns = RotationSpline(knots, Rotation.from_matrix(poses[:, :3, :3]))(t).as_matrix()
        out = pose_of(turns, curve(knots, poses[:, :3, 3])(t))
        fov = np.interp(t, knots, [view.fov for view in self.views])
        before = np.clip(np.searchsorted(knots, t, "right") - 1, 0, len(knots) - 2)
        share = (t - knots[before]) / (knots[before + 1] - knots[before])
        return [
            (pose, float(angle), mixed_lighting(self.views[i].lighting, self.views[i + 1].lighting, float(s)))
            for pose, angle, i, s in zip(out, fov, before, share, strict=True)
        ]

    def save(self, path: Path) -> None:
        write_json(path, {"format": _FORMAT, "views": [_view_row(view) for view in self.views]})

    @staticmethod
    def load(path: Path, field: BakedField, lighting: str | None = None) -> "CameraPath":
        """Reads a path's JSON file; `lighting` is that of views without one, by default the first filmed one.

        Raises InputError: the file is missing or damaged, or a lighting is unknown.
        """
        lighting = lighting or field.lightings[0]
        named_lighting(field, lighting)  # raises for an unknown one, also if every view has its own
        head = read_json(path)
        with wrap_read_errors(path, _CURE):
            if not isinstance(head, dict) or head.get("format") != _FORMAT:
                found = head.get("format") if isinstance(head, dict) else head
                raise ValueError(f"format {short_repr(found)}, expected {_FORMAT}")
            rows = head["views"]
            if not isinstance(rows, list):
                raise ValueError(f"views = {short_repr(rows)}, expected a list")
            return CameraPath(tuple(_parse_view(row, k, field, lighting) for k, row in enumerate(rows)))


def mixed_lighting(one: EpisodeLighting, other: EpisodeLighting, share: float) -> EpisodeLighting:
    """The lighting `share` of the way from one to another; neither changes with time."""
    if share <= 0.0 or one is other:
        return one
    if share >= 1.0:
        return other
    start = ((1.0 - share) * one.start + share * other.start).astype(np.float32)
    suns = mixed_sunlight(one.sunlight, other.sunlight, share)
    fog, name = mixed_fog(one.fog, other.fog, share), f"{one.name} → {other.name}"
    return MixedLighting(name, start, fog=fog, sunlight=suns, parts=(one, other), share=share)


def named_lighting(field: BakedField, name: str) -> EpisodeLighting:
    """A lighting of the field by its name or mixture. Raises InputError: it is unknown."""
    return EpisodeLighting(name, field.embedding(name), fog=field.fog(name), sunlight=field.sunlight(name))


def _view_row(view: KeyView) -> dict[str, Any]:
    return {
        "time": view.time,
        "camera_to_world": view.camera_to_world.tolist(),
        "fov": view.fov,
        "lighting": _lighting_row(view.lighting),
    }


def _lighting_row(lighting: EpisodeLighting) -> Any:
    if isinstance(lighting, MixedLighting):
        one, other = lighting.parts
        return {"from": _lighting_row(one), "to": _lighting_row(other), "share": lighting.share}
    # Only the name of a sampled lighting has a blank. The field does not know it, so its embedding is stored.
    return [float(x) for x in lighting.start] if " " in lighting.name else lighting.name


def _parse_view(row: Any, number: int, field: BakedField, lighting: str) -> KeyView:
    if not isinstance(row, dict):
        raise ValueError(f"view {number} is {short_repr(row)}, expected a table")
    pose = np.array(row["camera_to_world"], np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"view {number}: camera_to_world of shape {pose.shape}; expected 4×4 finite numbers")
    turn = pose[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0.0:
        raise ValueError(f"view {number}: the upper left 3×3 of camera_to_world is not a rotation")
    time, fov = float(row["time"]), float(row.get("fov", 60.0))
    if not np.isfinite(time) or not _MIN_FOV <= fov <= _MAX_FOV:
        raise ValueError(
            f"view {number}: time {time}, fov {fov}; expected a finite time, and fov from {_MIN_FOV:g} to {_MAX_FOV:g}°"
        )
    return KeyView(time, pose, fov, _parse_lighting(row.get("lighting", lighting), number, field))


def _parse_lighting(given: Any, number: int, field: BakedField) -> EpisodeLighting:
    if isinstance(given, str):
        return named_lighting(field, given)
    if isinstance(given, dict):
        one, other = (_parse_lighting(given[key], number, field) for key in ("from", "to"))
        share = float(given["share"])
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"view {number}: the lighting's share {share} is not from 0 to 1")
        return mixed_lighting(one, other, share)
    embedding = np.array(given, np.float32)
    dim = field.lightings_by_name.vectors.shape[1]
    if embedding.shape != (dim,) or not np.isfinite(embedding).all():
        raise ValueError(f"view {number}: lighting {short_repr(given)}; expected a name, {dim} numbers, or a mixture")
    return EpisodeLighting("sampled lighting", embedding)


def path_frames(path: CameraPath, fps: int) -> Array:
    """Times of a film's frames after the path's start [s], shape (k,)."""
    return np.arange(round(path.duration * fps) + 1) / fps


def write_path_film(
    out: Path,
    path: CameraPath,
    picture: ScenePicture,
    size: tuple[int, int],
    fps: int,
    on_frame: Callable[[int, int], None],
) -> int:
    """Renders a path, without robot and obstacles, to an mp4 of an even `size` [px]; returns its number of frames.

    `on_frame` is called with the numbers of frames written and in total; if it raises, nothing is written.
    """
    from twin.report.video_writer import VideoWriter

    views = path.at(path_frames(path, fps))
    with VideoWriter(out, size, fps, _CRF) as writer:
        for k, (pose, fov, lighting) in enumerate(views):
            camera = FreeCamera.of_fov(pose, float(np.deg2rad(fov)), size)
            writer.write(to_uint8(picture.render(camera, lighting).rgb[0]))
            on_frame(k + 1, len(views))
    return len(views)


def spaced_times(views: Sequence[Array], speed: float, least: float) -> list[float]:
    """Times at which a camera passes poses (4, 4) at a speed [m/s], with at least `least` [s] between neighbors."""
    points = np.array(views)[:, :3, 3]
    steps = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1) / speed, least)
    return np.concatenate([[0.0], np.cumsum(steps)]).round(3).tolist()
