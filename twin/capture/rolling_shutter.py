"""Finds rolling shutter and image stabilization in films, and corrects frames for a rolling shutter.

Structure from motion assumes that all frames of a film have the same pinhole camera. Two things contradict this:

- A rolling shutter reads a frame's *lines* one after another: its rows, or its columns if the film was turned upright.
  A line's *share* s is its position across the frame, from −½ to ½. The *skew* of a frame is the rotation vector ω
  [rad] of the camera, in its axes, between the first line and the last one. To first order, a point with the camera
  coordinates X in the middle of the readout has the coordinates X − s ω × X while its line is read. A *corrected* frame
  shows what the camera would have seen without this rotation. Only the fast part of the rotation is corrected, which
  is due to camera shake. The slow part, like the camera's translation during the readout, is not corrected: it has
  almost the same effect as a change of the place's shape, so the reconstruction already explains it.
- Stabilization moves the lens or the cropped part of the picture, and with it the frame's principal point. The *shift*
  is that motion [focal lengths]. Stabilized films are found, but not corrected.

Skews and shifts are unknown. They are fitted to the points of the reconstruction, together with each frame's pose.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pycolmap
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from twin.capture.camera_models import Lens, PixelMap, border_pixels, raw_pixels
from twin.capture.mapping import registered_poses
from twin.capture.matching import Matcher
from twin.capture.worker import send_message
from twin.geometry.cameras import unproject
from twin.types import Array

_MIN_POINTS = 40  # least number of points in a frame from which its skew is fitted
_MIN_FRAMES = 8  # least number of such frames for a decision on a film
_JUDGED_FRAMES = 60  # largest number of a film's frames that are used for the decision
_MIN_DEPTH = 0.01  # [median depth of the points] points nearer to the camera are not used
_LOSS_SCALE = 0.5  # [px] scale of the Cauchy loss
_REWEIGHTINGS = 6
# Fits of all skews are followed by bundle adjustment, and repeated until a fit moves pixels by less than _SETTLED
# (median over frames).
_MAX_ROUNDS, _SETTLED = 8, 0.1  # [px]
_MAX_SKEW = 0.05  # [rad] larger skews are implausible: in 30 ms a hand turns a camera by 0.01 rad
_SLOW = 5.0  # [frames] standard deviation of the Gaussian that separates the slow part of the skews
_MAX_ZOOMS = 10  # largest number of iterations for the focal length of corrected images; two or three are usual
_NODE_PIXELS = 8  # [px] distance of the pixels at which pixel maps are computed
_MIN_GAIN = 0.02  # see `_gain`
# Standard deviation of an observation [px]; prior standard deviation of a skew [rad] or shift [focal lengths]. The
# prior keeps skews and shifts small where a frame's points do not determine them.
_NOISE, _PRIOR = 0.4, 0.01

Effect = Literal["zoom", "rows", "columns", "shift"]
"""A change of focal length, as by autofocus, a rolling shutter that reads rows or columns, or stabilization."""


@dataclass(frozen=True)
class RollingShutter:
    """The rolling shutter of one film."""

    axis: int  # pixel coordinate across the lines: 1 if lines are rows, 0 if they are columns
    skews: dict[int, Array]
    """Skew of each frame [rad], shape (3,), by the frame's index in the capture; none if it has too few points."""

    @property
    def median_deg(self) -> float:
        """Median over frames of the rotation during the readout [°]."""
        return float(np.rad2deg(np.median([np.linalg.norm(skew) for skew in self.skews.values()])))

    def to_json(self) -> dict[str, Any]:
        return {"axis": self.axis, "skews": {str(i): skew.tolist() for i, skew in self.skews.items()}}

    @staticmethod
    def from_json(entry: dict[str, Any]) -> "RollingShutter":
        return RollingShutter(entry["axis"], {int(i): np.array(skew) for i, skew in entry["skews"].items()})


class _Frame:
    """A registered frame with the points that it shows, and its skew."""

    def __init__(self, model: pycolmap.Reconstruction, image: pycolmap.Image) -> None:
        self._model, self._image = model, image
        self._keypoints = np.array([list(point.xy) for point in image.points2D]).reshape(-1, 2)  # as filmed [px]
        self.skew, self._axis = np.zeros(3), 1

    @property
    def points(self) -> int:
        """Number of points that the frame shows."""
        return int(self._image.num_points3D)

    @property
    def _camera(self) -> pycolmap.Camera:
        return self._model.cameras[self._image.camera_id]

    def equations(self, *effects: Effect) -> tuple[Array, Array]:
        """The linear dependence of the reprojection errors on pose and effects.

        Returns a matrix (n, 2, m) and errors (n, 2) [px] for n points: errors − matrix @ x are the errors after a small
        change x of translation, rotation, and of what each effect changes, to first order: the logarithm of the focal
        length (1), skew (3) or shift (2).
        """
        points2d = self._image.points2D
        seen = np.array([k for k, point in enumerate(points2d) if point.has_point3D()], np.int64)
        points = np.array([list(self._model.points3D[points2d[k].point3D_id].xyz) for k in seen]).reshape(-1, 3)
        pose = self._image.cam_from_world().matrix()
        x = points @ pose[:, :3].T + pose[:, 3]
        rays = self._corrected_rays()[seen]
        typical = np.median(np.abs(x[:, 2])) if len(x) else 1.0
        # Bundle adjustment may leave a point behind a camera, and not every lens model can be inverted everywhere.
        used = (x[:, 2] > _MIN_DEPTH * typical) & np.isfinite(rays).all(1) & (rays[:, 2] > 0)
        seen, x, rays = seen[used], x[used], rays[used]
        focal = self._camera.mean_focal_length()
        jacobian = np.zeros((len(x), 2, 3))  # d(projection) / d(camera coordinates)
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = focal / x[:, 2]
        jacobian[:, :, 2] = -focal * x[:, :2] / x[:, 2:] ** 2
        by_rotation = jacobian @ np.stack([np.cross(unit, x) for unit in np.eye(3)], 2)
        parts = [jacobian, by_rotation]
        for effect in effects:
            if effect == "zoom":
                parts.append(focal * (x[:, :2] / x[:, 2:])[..., None])
            elif effect == "shift":
                parts.append(np.broadcast_to(focal * np.eye(2), (len(x), 2, 2)))
            else:
                parts.append(-self._shares(_axis(effect))[seen, None, None] * by_rotation)
        return np.concatenate(parts, 2), focal * (rays[:, :2] / rays[:, 2:] - x[:, :2] / x[:, 2:])

    def fitted_skew(self, shutter: Effect) -> Array:
        """The skew (3,) that fits best to the present points."""
        return np.asarray(self.skew + _solution(*self.equations(shutter), self.skew)[6:])

    def correct(self, shutter: Effect, skew: Array) -> float:
        """Sets the skew, and moves the keypoints to where the corrected frame shows them; returns the change [px]."""
        change = self._camera.mean_focal_length() * np.linalg.norm(skew - self.skew)
        self.skew, self._axis = skew, _axis(shutter)
        moved = np.asarray(self._camera.img_from_cam(self._corrected_rays()))
        for point, xy in zip(self._image.points2D, moved, strict=True):
            point.xy = xy
        return float(change)

    def _shares(self, axis: int) -> Array:
        """The shares of all keypoints' lines, shape (k,)."""
        return np.asarray(self._keypoints[:, axis] / (self._camera.width, self._camera.height)[axis] - 0.5)

    def _corrected_rays(self) -> Array:
        """The directions of all keypoints in the middle of the readout, shape (k, 3)."""
        rays = np.asarray(self._camera.cam_from_img(self._keypoints))
        turn = Rotation.from_rotvec(self._shares(self._axis)[:, None] * self.skew)
        return np.asarray(turn.apply(np.column_stack([rays, np.ones(len(rays))])))


def correct_model(
    model: pycolmap.Reconstruction, matcher: Matcher, refine: Callable[[pycolmap.Reconstruction], None]
) -> tuple[dict[str, RollingShutter], list[str]]:
    """Finds the films with a rolling shutter; corrects the keypoints of the model for it, and refines the model.

    The model, a complete reconstruction, is changed only if a rolling shutter is found. `refine` runs bundle
    adjustment. Returns the rolling shutters by the name of the source, and the names of the stabilized sources.
    """
    capture = matcher.capture
    films: dict[str, tuple[Effect, dict[int, _Frame]]] = {}
    stabilized = []
    registered = registered_poses(model, matcher)[0]
    for s in np.unique(capture.source_index[registered]).tolist():
        own = registered[capture.source_index[registered] == s]
        frames = {int(i): _Frame(model, model.images[int(matcher.image_ids[i])]) for i in own}
        frames = {i: frame for i, frame in frames.items() if frame.points >= _MIN_POINTS}
        if len(frames) < _MIN_FRAMES:
            continue
        judged = list(frames.values())[:: -(-len(frames) // _JUDGED_FRAMES)]
        shutter, is_stabilized = _effects(judged)
        if shutter:
            films[capture.sources[s].name] = shutter, frames
        if is_stabilized:
            stabilized.append(capture.sources[s].name)
    for _ in range(_MAX_ROUNDS if films else 0):
        moved = [_fit_film(list(frames.values()), shutter) for shutter, frames in films.values()]
        refine(model)
        if max(moved) < _SETTLED:
            break
    found = {
        name: RollingShutter(_axis(shutter), {i: frame.skew for i, frame in frames.items()})
        for name, (shutter, frames) in films.items()
    }
    for name, one in found.items():
        send_message(say=f"  {name}: corrected for a rolling shutter ({one.median_deg:.2f}° per readout, median)")
    for name in stabilized:
        send_message(say=f"  {name}: the film is stabilized, which bends the reconstruction; turn it off if you can")
    return found, stabilized


def _fit_film(frames: list[_Frame], shutter: Effect) -> float:
    """Fits the skews of a film's frames, in order of time, to the present points; returns the median change [px]."""
    skews = np.array([frame.fitted_skew(shutter) for frame in frames])
    skews[np.linalg.norm(skews, axis=1) > _MAX_SKEW] = 0.0
    skews -= gaussian_filter1d(skews, _SLOW, axis=0, mode="nearest")
    return float(np.median([frame.correct(shutter, skew) for frame, skew in zip(frames, skews, strict=True)]))


def _axis(shutter: Effect) -> int:
    return 0 if shutter == "columns" else 1


def _effects(frames: list[_Frame]) -> tuple[Effect | None, bool]:
    """The kind of a film's rolling shutter, None without one, and whether the film is stabilized."""
    both: tuple[Effect, Effect] = ("rows", "columns")
    equations = [frame.equations("zoom", *both, "shift") for frame in frames]
    columns = {"rows": [7, 8, 9], "columns": [10, 11, 12], "shift": [13, 14]}

    def gain(*effects: Effect) -> float:
        used = [*range(7), *(column for effect in effects for column in columns[effect])]  # pose, zoom and effects
        return _gain([(matrix[:, :, used], error) for matrix, error in equations], len(columns[effects[-1]]))

    gains = [gain(effect) for effect in both]
    shutter = both[int(np.argmax(gains))] if max(gains) >= _MIN_GAIN else None
    return shutter, (gain(shutter, "shift") if shutter else gain("shift")) >= _MIN_GAIN


def _gain(equations: list[tuple[Array, Array]], extra: int) -> float:
    """Relative reduction of a film's median reprojection error if each frame has its own last `extra` parameters.

    The baseline has the same values of these parameters in all frames: their median, or zeros if that is better. So an
    error of the lens model, which affects all frames equally, is not mistaken for shake. Parameters are fitted to every
    second point, and errors are measured at the other points. `equations` are those of the film's frames, see
    `_Frame.equations`.
    """
    fitted = [_solution(matrix[::2], error[::2]) for matrix, error in equations]

    def median_error(common: Array | None) -> float:
        """Median error with the last parameters equal to `common` in all frames; None: each frame has its own."""
        errors = []
        for (matrix, error), solution in zip(equations, fitted, strict=True):
            if common is not None:
                rest = error - matrix[:, :, -extra:] @ common
                solution = np.concatenate([_solution(matrix[::2, :, :-extra], rest[::2]), common])
            errors.append(np.linalg.norm(error - matrix @ solution, axis=1)[1::2])
        return float(np.median(np.concatenate(errors)))

    typical = np.median([solution[-extra:] for solution in fitted], axis=0)
    return 1.0 - median_error(None) / min(median_error(typical), median_error(np.zeros(extra)))


def _solution(matrix: Array, error: Array, present: Array | None = None) -> Array:
    """The x (m,) with the least Cauchy loss of error (n, 2) − matrix (n, 2, m) @ x, under the prior.

    `present` (m − 6,) are skews and shifts to which x adds; None for zeros.
    """
    flat, m = matrix.reshape(-1, matrix.shape[2]), matrix.shape[2]
    prior = np.concatenate([np.zeros(6), np.full(m - 6, (_NOISE / _PRIOR) ** 2)])
    pull = -prior * np.concatenate([np.zeros(6), np.zeros(m - 6) if present is None else present])
    weight = np.ones(len(error))
    for _ in range(_REWEIGHTINGS):
        weighted = flat.T * np.repeat(weight, 2)
        solution = np.linalg.lstsq(weighted @ flat + np.diag(prior), weighted @ error.reshape(-1) + pull, rcond=None)[0]
        weight = 1.0 / (1.0 + (np.linalg.norm(error - matrix @ solution, axis=1) / _LOSS_SCALE) ** 2)
    return np.asarray(solution)


# ---- corrected images


def corrected_map(lens: Lens, pinhole: Lens, skew: Array, axis: int) -> PixelMap:
    """The pixel map of a frame's corrected pinhole image; for `skew` and `axis` see `RollingShutter`.

    It is computed at some pixels and interpolated linearly, with errors of about 0.01 px.
    """
    nodes = [np.linspace(0.5, side - 0.5, max(2, side // _NODE_PIXELS)) for side in (lens.height, lens.width)]
    y, x = np.meshgrid(*nodes, indexing="ij")
    raw = _raw_pixels(lens, unproject(np.column_stack([x.ravel(), y.ravel()]), pinhole.intrinsics), skew, axis)
    rows, columns = (
        np.array([np.interp(np.arange(side) + 0.5, at, unit) for unit in np.eye(len(at))]).T
        for side, at in zip((lens.height, lens.width), nodes, strict=True)
    )
    grid = (raw - 0.5).reshape(*x.shape, 2)
    return np.stack([rows @ grid[..., k] @ columns.T for k in (0, 1)], 2).astype(np.float32)


def corrected_pinhole(lens: Lens, pinhole: Lens, shutter: RollingShutter) -> Lens:
    """The pinhole lens of a film's corrected images; its focal length keeps all their pixels inside the raw frames."""
    size, border = np.array([lens.width, lens.height], float), border_pixels(lens)
    for _ in range(_MAX_ZOOMS):
        rays = unproject(border, pinhole.intrinsics)
        raw = np.stack([_raw_pixels(lens, rays, skew, shutter.axis) for skew in shutter.skews.values()])
        outside = float(np.max([-raw, raw - size]))
        if outside <= 0.0:
            break
        factor = 1.0 + 2.0 * (outside + 0.1) / float(size.min())
        pinhole = pinhole.with_intrinsics(pinhole.intrinsics * [factor, factor, 1.0, 1.0])
    return pinhole


def _raw_pixels(lens: Lens, rays: Array, skew: Array, axis: int) -> Array:
    """Pixels (n, 2) of a raw frame that show the directions (n, 3)."""
    raw = raw_pixels(lens, rays)
    for _ in range(2):  # the line in which a point is read depends a little on the skew
        share = raw[:, axis] / (lens.width, lens.height)[axis] - 0.5
        raw = raw_pixels(lens, Rotation.from_rotvec(-share[:, None] * skew).apply(rays))
    return raw
