"""Metric scale of a reconstruction from the camera height, a known distance, GPS, odometry or a printed marker."""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from twin import runtime
from twin.capture.capture_data import nearest_longitudes
from twin.capture.gravity import Gravity, Road, below_path, heights_above_road, local_ground
from twin.config import DistanceConfig, MarkerConfig, MetricConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras, project, unproject
from twin.geometry.images import read_image
from twin.geometry.poses import inverse_pose
from twin.types import Array

_PIXEL_ERROR = 1.0  # [px] standard deviation of a point marked by hand
_GROUND_STEP = 0.25  # [drops] step along a ray that searches the ground
_GPS_TRIALS = 400
_GPS_FRAMES = 400  # about the largest number of frames from which the drift of GPS is estimated
_STRETCH = 2.0  # [m] length of the compared stretches of odometry; the heading hardly drifts over this length
_STRAIGHT = 0.7  # smallest ratio of end-to-end distance to length of a compared stretch
_MIN_STRETCHES = 5
_STRETCH_ROUNDS = 3  # the length of the stretches depends on the scale
_MAX_STRETCH_SPREAD = 0.3  # largest relative spread of the stretches' scales
_MIN_SIDE = 10  # road points needed on each side of the path to compare the two sides
_MIN_ANGLE = np.radians(2.0)  # [rad] smallest sufficient angle between the rays of two frames to a marker
_CORNER_ERROR = 0.2  # [px] lower bound of the standard deviation of a marker's corners in an image
_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])  # corners in the detector's order, side 1


@dataclass(frozen=True)
class Scale:
    """Meters per unit of the reconstruction."""

    value: float
    uncertainty: float  # relative standard deviation; 0 for poses that are given as metric
    notes: dict[str, Any] = field(default_factory=dict)  # further entries of `metric.json`


def combine_scales(scales: dict[str, Scale]) -> Scale:
    """The geometric mean of independent scales, weighted by their inverse relative variances.

    If the scales differ by more than their uncertainties explain, the combined uncertainty grows by the Birge ratio
    (Birge 1932). A scale with uncertainty 0, from poses that are given as metric, is used unchanged. The notes of all
    scales are merged. Several scales add two entries: `scales` holds each scale divided by the result, and its
    uncertainty; `scale_disagreement` is the largest difference between two scales in standard deviations.
    """
    if len(scales) == 1:
        return next(iter(scales.values()))
    notes = {name: note for one in scales.values() for name, note in one.notes.items()}
    logs = np.log([one.value for one in scales.values()])
    sigmas = np.array([one.uncertainty for one in scales.values()])
    exact = np.flatnonzero(sigmas == 0.0)
    if len(exact):
        mean, sigma = float(logs[exact[0]]), 0.0
    else:
        weights = 1.0 / sigmas**2
        mean = float(np.average(logs, weights=weights))
        birge = float(np.sqrt(np.sum(weights * (logs - mean) ** 2) / (len(logs) - 1)))
        sigma = max(1.0, birge) / float(np.sqrt(weights.sum()))
    apart = np.abs(logs[:, None] - logs) / np.maximum(np.hypot(sigmas[:, None], sigmas), 1e-9)
    notes["scales"] = {
        name: {"relative": float(np.exp(log - mean)), "uncertainty": float(one)}
        for name, log, one in zip(scales, logs, sigmas, strict=True)
    }
    notes["scale_disagreement"] = float(apart.max())
    return Scale(float(np.exp(mean)), sigma, notes)


def scale_from_height(
    cameras: Cameras, up: Gravity, points: Array, road: Road | None, metric: MetricConfig, own: dict[str, float]
) -> Scale:
    """Scale from the known height of the cameras above the road; `points` (m, 3) are all sparse points.

    `own` holds the camera height of each source [m]; a source with 0 uses that of `metric`. The uncertainty combines
    these errors: the tolerance of the given heights, the variation of the reconstructed heights along the path and
    between sources, the error of the up direction, and the height difference of the ground across the path.

    Raises InputError: no road, or no source with a height has a frame.
    """
    if road is None:
        raise InputError(
            "metric.camera_height: no reconstructed point lies below the path; film with the ground in view, or give "
            "the scale as metric.distance, metric.marker or metric.gps"
        )
    on_road = points[road.points]
    sources = np.array(cameras.sources)
    scales, weights, sigmas, spreads, measurement = [], [], [], [], []
    for name in dict.fromkeys(cameras.sources):
        true_height = own.get(name, 0.0) or metric.camera_height
        if true_height <= 0:
            continue
        centers = cameras.positions[sources == name]
        local = heights_above_road(on_road, centers, up.direction, road.drop)
        if local is not None:
            measured = local[np.isfinite(local)]
            height = float(np.median(measured))
            spread = 1.4826 * float(np.median(np.abs(measured - height)))
            count = len(measured)
        else:  # too few points below this path; the whole road is used
            height, spread, count = road.drop, road.spread, 1
        scales.append(true_height / height)
        measurement.append(metric.camera_height_tolerance / true_height)
        weights.append(count)
        spreads.append(spread * true_height / height)
        # A road undulates smoothly, so the heights along it count as at most six independent ones.
        sigmas.append(spread / height / np.sqrt(min(count, 6)))
    if not scales:
        given = ", ".join(name for name, height in own.items() if height > 0)
        raise InputError(
            f"metric.camera_height: no frame was registered of the sources with a camera_height ({given}); give that "
            "of the other sources, too, or another scale"
        )
    value = float(np.average(scales, weights=weights))
    layer = road.spread / road.drop / np.sqrt(len(road.points))
    between = float(np.std(scales) / value) if len(scales) > 1 else 0.0
    # A road with few points, or with points on the verge only, adds an error of 5 %: the verge may be higher than the
    # road by a curb, about a tenth of the usual camera height.
    few = 0.0 if road.reliable else 0.05
    repeat = np.average(np.square(sigmas), weights=weights) + layer**2 + between**2 + few**2
    # One person measures all heights with one method, so averaging does not reduce their error.
    tape = float(np.average(measurement, weights=weights))
    tilt, sides = _ground_errors(cameras, up, on_road, road.drop)
    sigma = float(np.sqrt(repeat + tape**2 + tilt**2 + sides**2))
    notes = {
        "scale_per_source_relative": [round(s / value, 4) for s in scales],
        "local_height_spread_m": float(np.average(spreads, weights=weights)),
        "scale_uncertainty_of": {
            "height_as_measured": tape,
            "repeatability": float(np.sqrt(repeat)),
            "tilt": tilt,
            "left_against_right": sides,
        },
    }
    return Scale(value, sigma, notes)


def _ground_errors(cameras: Cameras, up: Gravity, road: Array, drop: float) -> tuple[float, float]:
    """Two relative errors of the camera height above the road points (k, 3).

    The first comes from the error of up: it is the angle of this error times the mean horizontal offset of the points,
    divided by the camera height. The second comes from camber or a curb: it is half the difference between the heights
    above the points to the left and to the right of the path, divided by the camera height.
    """
    nearest, height, _ = below_path(road, cameras.positions, up.direction)
    away = road - cameras.positions[nearest]
    away = away + height[:, None] * up.direction  # horizontal
    tilt = up.uncertainty * float(np.linalg.norm(away.mean(0))) / drop
    side = (away * cameras.camera_to_world[nearest, :3, 0]).sum(1)
    left, right = height[side < 0.0], height[side > 0.0]
    if min(len(left), len(right)) < _MIN_SIDE:
        return tilt, 0.0
    return tilt, abs(float(np.median(left) - np.median(right))) / 2.0 / drop


def scale_from_distance(
    cameras: Cameras, up: Array, points: Array, road: Road | None, distance: DistanceConfig
) -> Scale:
    """Scale from two marked points [px of the pinhole images], triangulated from two frames or assumed on the ground.

    `points` (m, 3) are all sparse points. On the ground, the uncertainty includes the spread of the heights there.

    Raises InputError: an unknown frame, a point outside its image, rays that do not meet, or no ground and no frame_b.
    """
    if road is None and not distance.frame_b:
        raise InputError(
            "metric.distance: no ground was reconstructed; mark the points in a second image, too: frame_b, a2, b2"
        )
    marked = {"a": distance.frame_a, "b": distance.frame_a}
    if distance.frame_b:
        if distance.frame_a == distance.frame_b:
            raise InputError(f"metric.distance: frame_a and frame_b are both {distance.frame_a!r}; mark two frames")
        marked |= {"a2": distance.frame_b, "b2": distance.frame_b}
    frames = [_marked_frame(cameras, key, frame, getattr(distance, key)) for key, frame in marked.items()]
    pixels = np.array([getattr(distance, key) for key in marked], np.float64)

    def rays(offset: Array) -> list[tuple[Array, Array]]:
        return [_ray(cameras, f, p) for f, p in zip(frames, pixels + offset, strict=True)]

    still = np.zeros_like(pixels)
    grounds = [(0.0, 0.0)] * 2
    if road is not None and not distance.frame_b:
        grounds = [_ground_along(ray, up, points[road.points], road) for ray in rays(still)]

    def length(offset: Array, raised: float = 0.0) -> float:
        """`raised`: the rise of the ground [standard deviations of its height]."""
        if distance.frame_b:
            a, b, a2, b2 = rays(offset)
            ends = _meeting_point(a, a2), _meeting_point(b, b2)
        else:
            a, b = rays(offset)
            (level_a, spread_a), (level_b, spread_b) = grounds
            ends = _on_ground(*a, up, level_a + raised * spread_a), _on_ground(*b, up, level_b + raised * spread_b)
        return float(np.linalg.norm(ends[0] - ends[1]))

    measured = length(still)
    if not np.isfinite(measured) or measured < 1e-9:
        raise InputError(
            "metric.distance: the points a and b coincide or do not lie before the camera; mark them again"
        )
    shifts = np.concatenate([np.eye(pixels.size), -np.eye(pixels.size)]) * _PIXEL_ERROR
    lengths = np.array([length(shift.reshape(pixels.shape)) for shift in shifts])
    # Each coordinate is shifted both ways, so half the sum of squares is the first-order variance.
    sigma = float(np.sqrt(0.5 * np.sum((lengths - measured) ** 2)) / measured)
    if not np.isfinite(sigma) or sigma > 0.5:
        raise InputError(
            "metric.distance: an error of 1 px changes it by over 50 %; mark points further apart, or in other frames"
        )
    ground = 0.5 * (length(still, 1.0) - length(still, -1.0)) / measured
    return Scale(distance.metres / measured, float(np.hypot(sigma, ground)), {"distance_units": measured})


def _marked_frame(cameras: Cameras, key: str, frame: str, pixel: tuple[float, ...]) -> int:
    if frame not in cameras.names:
        raise InputError(
            f"metric.distance: no registered frame {frame!r}; expected a name such as {cameras.names[0]!r} "
            "(build/2_cameras/images)"
        )
    index = cameras.names.index(frame)
    width, height = (int(v) for v in cameras.sizes[index])
    if not (0 <= pixel[0] <= width and 0 <= pixel[1] <= height):
        raise InputError(f"metric.distance.{key} = {list(pixel)}; expected [u, v] within {width}×{height} px")
    return index


def _ray(cameras: Cameras, frame: int, pixel: Array) -> tuple[Array, Array]:
    pose = cameras.camera_to_world[frame]
    direction = pose[:3, :3] @ unproject(pixel, cameras.intrinsics[frame])
    return pose[:3, 3], direction / np.linalg.norm(direction)


def _on_ground(origin: Array, direction: Array, up: Array, level: float) -> Array:
    descent = float(direction @ up)
    if descent > -1e-3:
        raise InputError("metric.distance: a marked point lies above the horizon, not on the ground; give frame_b")
    return origin + direction * (level - origin @ up) / descent


def _ground_along(ray: tuple[Array, Array], up: Array, on_road: Array, road: Road) -> tuple[float, float]:
    """Height along `up` at which a ray first meets the ground, and the standard deviation of the ground's height there.

    The ground is the median of the road points (k, 3) around a place; if the ray meets none, that of all of them.
    """
    origin, direction = ray
    heights = on_road @ up
    middle = float(np.median(heights))
    _on_ground(*ray, up, middle)  # raises an error for a ray above the horizon
    end = (float(origin @ up) - float(heights.min()) + road.drop) / -float(direction @ up)
    before = None
    for distance in np.arange(0.0, end, _GROUND_STEP * road.drop):
        place = origin + distance * direction
        ground = local_ground(on_road, place, up, road.drop)
        if ground is None:
            continue
        above = float(place @ up) - ground[0]
        if above <= 0.0:
            if before is not None:  # the ray crosses the ground between this place and the one before
                distance -= (distance - before[0]) * above / (above - before[1])
            return float((origin + distance * direction) @ up), ground[1]
        before = distance, above
    return middle, 1.4826 * float(np.median(np.abs(heights - middle)))


def _meeting_point(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """The point nearest to two rays, shape (3,); NaN if the rays are parallel or the point lies behind a camera."""
    (o1, d1), (o2, d2) = first, second
    along, _, rank, _ = np.linalg.lstsq(np.stack([d1, -d2], 1), o2 - o1, rcond=1e-9)
    if rank < 2 or np.any(along <= 0):
        return np.full(3, np.nan)
    return 0.5 * (o1 + along[0] * d1 + o2 + along[1] * d2)


def local_east_north_up(gps: Array) -> Array:
    """East, north and up [m] (n, 3) of positions given as latitude [°], longitude [°], altitude [m] (WGS 84) (n, 3).

    The origin is the median of each coordinate: far from the tangent plane's origin lengths are distorted, so a single
    wrong position, even the first, must not be the origin.
    """
    gps = np.column_stack([gps[:, 0], nearest_longitudes(gps[:, 1], float(gps[0, 1])), gps[:, 2]])
    return np.asarray(pycolmap.GPSTransform().ellipsoid_to_enu(gps, *np.median(gps, axis=0)))


def scale_from_gps(cameras: Cameras, up: Array, gps: Array, rng: np.random.Generator) -> tuple[Scale, Array]:
    """Scale and horizontal east axis (3,) from GPS positions by a robust similarity fit in the horizontal plane.

    Altitudes are not used: they are several times less accurate than latitude and longitude, and up is known already.
    `gps` (n, 3) holds latitude [°], longitude [°] and altitude [m] per camera, NaN where unknown. `rng` draws the pairs
    of cameras for the first fits. For the uncertainty see `_drift_uncertainty`.

    Raises InputError: fewer than 3 positions, or positions that do not spread beyond their own error.
    """
    centers, known = cameras.positions, np.all(np.isfinite(gps[:, :2]), axis=1)
    if known.sum() < 3:
        raise InputError(
            f"metric.gps: {known.sum()} registered frames have a position (need 3); give the scale another way"
        )
    filled = np.where(np.isfinite(gps[known]), gps[known], 0.0)
    target = local_east_north_up(filled)[:, :2] @ np.array([1.0, 1.0j])
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    source = centers[known] @ first + 1j * (centers[known] @ second)
    # In complex numbers a similarity of the plane is target = factor · source + offset.
    best = np.inf
    for _ in range(_GPS_TRIALS):
        i, j = rng.choice(len(source), 2, replace=False)
        if abs(source[j] - source[i]) < 1e-9 * np.ptp(np.abs(source - source[0])):
            continue
        factor = (target[j] - target[i]) / (source[j] - source[i])
        error = float(np.median(np.abs(target - target[i] - factor * (source - source[i]))))
        if error < best:
            best, fit, offset = error, factor, target[i] - factor * source[i]
    if not np.isfinite(best):
        raise InputError("metric.gps: the camera never moved; give the scale another way")
    inliers = np.abs(target - offset - fit * source) <= max(3.0 * 1.4826 * best, 1e-6)
    for _ in range(10):
        a, b = source[inliers], target[inliers]
        fit = np.vdot(a - a.mean(), b - b.mean()) / np.vdot(a - a.mean(), a - a.mean())
        offset = b.mean() - fit * a.mean()
        residual = np.abs(target - offset - fit * source)
        again = residual <= max(3.0 * 1.4826 * float(np.median(residual)), 1e-6)
        if np.array_equal(again, inliers) or again.sum() < 3:
            break
        inliers = again
    residual = np.abs(target - offset - fit * source)[inliers]
    extent = float(np.std(source[inliers]) * abs(fit))
    films = np.array(cameras.sources)[known][inliers]
    sigma = _drift_uncertainty(source[inliers], target[inliers], films) / float(abs(fit))
    if not np.isfinite(sigma) or sigma > 0.3:
        raise InputError(
            f"metric.gps: positions fit within {np.median(residual):.1f} m but spread over {extent:.1f} m only; film "
            "a longer way, or give the scale another way"
        )
    # The rotation maps coordinates along (first, second) to (east, north), so its complex conjugate is the east axis in
    # coordinates along (first, second).
    rotation = fit / abs(fit)
    east = first * rotation.real - second * rotation.imag
    notes = {
        "gps_frames": int(known.sum()),
        "gps_inliers": int(inliers.sum()),
        "gps_residual_median_m": float(np.median(residual)),
    }
    return Scale(float(abs(fit)), sigma, notes), east


def _drift_uncertainty(source: NDArray, target: NDArray, films: NDArray) -> float:
    """Standard deviation of |factor| in the least-squares fit target = factor · source + offset, complex numbers (n,).

    Errors of GPS drift: those of neighboring frames are alike, and a fit absorbs much of a slow drift, so residuals are
    smaller than the errors. Model: a fraction ν of the errors' variance is independent, the rest has the correlation
    exp(−distance in frames / τ) within a film and none between films. ν and τ are averaged over a grid, weighted by
    the restricted likelihood (Patterson and Thompson, Biometrika 58, 1971), which accounts for what the fit absorbs.
    """
    some = np.unique(np.linspace(0, len(source) - 1, min(len(source), _GPS_FRAMES)).astype(int))
    source, target, films, n = source[some], target[some], films[some], len(some)
    order = np.arange(n)
    apart = np.where(films[:, None] == films, np.abs(order[:, None] - order), np.inf)
    design = np.stack([source - source.mean(), np.ones(n)], 1)
    pseudo = np.linalg.pinv(design)
    scores, variances = [], []
    for tau in np.geomspace(0.3, 10.0 * n, 14):
        for nu in (0.0, 0.02, 0.1, 0.3, 0.6):
            correlation = (1.0 - nu) * np.exp(-apart / tau) + nu * np.eye(n)
            factor = np.linalg.cholesky(correlation + 1e-9 * np.eye(n))
            x, y = (solve_triangular(factor, one, lower=True) for one in (design, target))
            q, r = np.linalg.qr(x)
            rest = float(np.sum(np.abs(y - q @ (q.conj().T @ y)) ** 2))
            # Real and imaginary parts count as two observations each, hence no factors 1 / 2.
            log_determinants = 2.0 * np.log(np.diag(factor)).sum() + 2.0 * np.log(np.abs(np.diag(r))).sum()
            scores.append(-(n - 2) * np.log(max(rest, 1e-300)) - log_determinants)
            spread = (pseudo[0] @ correlation @ pseudo[0].conj()).real
            variances.append(rest / (2.0 * max(n - 2, 1)) * spread)  # along the factor, not across it
    weight = np.exp(np.array(scores) - max(scores))
    return float(np.sqrt(np.sum(weight * variances) / weight.sum()))


def scale_from_odometry(cameras: Cameras, odometry: Array, tolerance: float) -> Scale:
    """Scale from `odometry`, the camera positions [m] measured by the robot, shape (n, 3), NaN where unknown.

    Each source has its own coordinate frame. The heading of odometry drifts, most on skid-steered wheels, but its
    lengths are right to a few percent. So the path is divided into stretches of `_STRETCH`. The distance between a
    stretch's ends by odometry is compared with that in the reconstruction; directions are ignored. `tolerance` is the
    relative standard deviation of the error that all stretches share; their spread adds to it.

    Raises InputError: too few stretches, or stretches that contradict each other.
    """
    sources = np.array(cameras.sources)
    films = [np.flatnonzero(sources == name) for name in dict.fromkeys(cameras.sources)]
    filmed = np.where(np.isfinite(odometry), cameras.positions, np.nan)
    steps = [np.linalg.norm(np.diff(one[rows], axis=0), axis=1) for rows in films for one in (odometry, filmed)]
    by_odometry, reconstructed = np.concatenate(steps[::2]), np.concatenate(steps[1::2])
    moving = (by_odometry > 0.0) & (reconstructed > 0.0)
    value = float(np.median(by_odometry[moving] / reconstructed[moving])) if moving.any() else 1.0
    for _ in range(_STRETCH_ROUNDS):  # noise lengthens the steps by odometry, so the first value is too large
        length = _STRETCH / max(value, 1e-12)
        pairs = [(rows[a], rows[b]) for rows in films for a, b in _stretches(filmed[rows], length)]
        first, last = np.array(pairs, int).reshape(-1, 2).T
        moved = np.linalg.norm(odometry[last] - odometry[first], axis=1)
        weights = np.linalg.norm(filmed[last] - filmed[first], axis=1)
        usable = np.flatnonzero(moved)  # not where odometry stood still
        moved, weights = moved[usable], weights[usable]
        if len(moved) < _MIN_STRETCHES:
            known = int(np.isfinite(odometry).all(1).sum())
            raise InputError(
                f"metric.odometry: {known} of {len(odometry)} registered frames have odometry, over {len(moved)} "
                f"stretches of {_STRETCH:g} m (need {_MIN_STRETCHES}); record odometry while filming, or give the "
                "scale another way"
            )
        logs = np.log(moved / weights)
        middle = float(np.median(logs))
        spread = 1.4826 * float(np.median(np.abs(logs - middle)))
        inliers = np.abs(logs - middle) <= max(3.0 * spread, 1e-3)
        # Isotropic noise of planar positions lengthens distances, but leaves the mean of their logarithms unchanged.
        value = float(np.exp(np.average(logs[inliers], weights=weights[inliers])))
    if spread > _MAX_STRETCH_SPREAD:
        raise InputError(
            f"metric.odometry: length by odometry / reconstructed length varies by {spread:.0%} (expected at most "
            f"{_MAX_STRETCH_SPREAD:.0%}); check the stamps of pictures and odometry, or give the scale another way"
        )
    # Neighboring stretches share slip and reconstruction errors: about three count as one independent stretch.
    repeat = spread / np.sqrt(max(inliers.sum() / 3.0, 1.0))
    notes = {
        "odometry_stretches": len(moved),
        "odometry_inliers": int(inliers.sum()),
        "odometry_length_m": float(moved[inliers].sum()),
        "odometry_spread_relative": spread,
    }
    return Scale(value, float(np.hypot(tolerance, repeat)), notes)


def _stretches(positions: Array, length: float) -> list[tuple[int, int]]:
    """First and last indices of consecutive stretches of at least `length` along reconstructed positions (n, 3).

    Stretches contain no unknown position; winding ones are left out, see `_STRAIGHT`. They are not chosen by odometry:
    its noise would end them early, and leave out those that it shortens.
    """
    out, first, way = [], 0, 0.0
    for last in range(1, len(positions)):
        step = float(np.linalg.norm(positions[last] - positions[last - 1]))
        if not np.isfinite(step):
            first, way = last, 0.0
            continue
        way += step
        if way >= length:
            if np.linalg.norm(positions[last] - positions[first]) >= _STRAIGHT * way:
                out.append((first, last))
            first, way = last, 0.0
    return out


def scale_from_marker(cameras: Cameras, marker: MarkerConfig) -> Scale:
    """Scale from a printed square marker (ArUco or AprilTag) in the scene: a square is fitted to its corners.

    Raises InputError: a marker not seen from two directions, or a side that the corners determine to 20 % or worse.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.family))
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, settings)
    frames, corners = [], []
    for i in runtime.track(range(len(cameras)), "marker", unit="frame"):
        gray = cv2.cvtColor(read_image(cameras.image_path(i)), cv2.COLOR_RGB2GRAY)
        found, ids, _ = detector.detectMarkers(gray)
        hits = [k for k, value in enumerate(np.ravel(ids) if ids is not None else []) if int(value) == marker.id]
        if len(hits) == 1:  # two markers of this number in one image are both ignored
            frames.append(i)
            # OpenCV's pixel coordinates start at the center of the first pixel, ours at its corner.
            corners.append(np.asarray(found[hits[0]], np.float64).reshape(4, 2) + 0.5)
    if len(frames) < 2:
        raise InputError(
            f"metric.marker: {marker.family} number {marker.id} was found in {len(frames)} frames (need 2); film it "
            "nearer and from more than one place"
        )
    poses, intrinsics = cameras.camera_to_world[frames], cameras.intrinsics[frames]
    pixels = np.array(corners)
    square = np.array([_triangulate(pixels[:, k], poses, intrinsics) for k in range(4)])
    rays = square.mean(0) - poses[:, :3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if not np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)) >= _MIN_ANGLE:  # also if unknown
        raise InputError("metric.marker: seen from one direction only; film it while passing by")
    side, sigma = fit_square(pixels, square, poses, intrinsics)
    if not sigma <= 0.2:
        raise InputError(
            f"metric.marker: the standard deviation of its side is {sigma:.0%} (expected at most 20%); film it "
            "nearer, sharper and from more places"
        )
    return Scale(marker.size / side, sigma, {"marker_frames": len(frames)})


def fit_square(pixels: Array, start: Array, camera_to_world: Array, intrinsics: Array) -> tuple[float, float]:
    """Side of the square whose corners are observed at `pixels` (n, 4, 2), and its relative standard deviation.

    The square's position, rotation and side minimize the reprojection error, from the corners `start` (4, 3). Their
    covariance is (JᵀJ)⁻¹ times the variance of the residuals, at least that of `_CORNER_ERROR`.
    """
    center = start.mean(0)
    side = float(np.linalg.norm(start - np.roll(start, 1, axis=0), axis=1).mean())
    first, second = _SQUARE.T @ (start - center)
    axes = np.linalg.qr(np.stack([first, second], 1))[0]
    axes *= np.sign([axes[:, 0] @ first, axes[:, 1] @ second])

    def residuals(changes: Array) -> Array:
        """`changes`: shift [start sides], rotation vector [rad], logarithm of side / start side."""
        turned = Rotation.from_rotvec(changes[3:6]).apply(axes.T)
        corners = center + side * (changes[:3] + np.exp(changes[6]) * _SQUARE @ turned)
        seen = [project(corners, pose, lens)[0] for pose, lens in zip(camera_to_world, intrinsics, strict=True)]
        return (np.array(seen) - pixels).ravel()

    fit = least_squares(residuals, np.zeros(7), method="lm")
    variance = max(2.0 * fit.cost / (pixels.size - 7), _CORNER_ERROR**2)
    covariance = variance * np.linalg.pinv(fit.jac.T @ fit.jac)
    return side * float(np.exp(fit.x[6])), float(np.sqrt(covariance[6, 6]))


def _triangulate(pixels: Array, camera_to_world: Array, intrinsics: Array) -> Array:
    """Triangulates the point (3,) observed at `pixels` (n, 2), one per view; NaN if equal poses do not determine it.

    The linear solution of Hartley & Zisserman 2004, sec. 12.2.
    """
    world_to_camera = inverse_pose(camera_to_world)
    fx, fy, cx, cy = intrinsics.T
    u, v = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    if np.ptp(camera_to_world[:, :3, 3], axis=0).max() == 0.0:
        return np.full(3, np.nan)
    rows = [c[:, None] * world_to_camera[:, 2] - world_to_camera[:, k] for k, c in enumerate((u, v))]
    homogeneous = np.linalg.svd(np.concatenate(rows))[2][-1]
    return homogeneous[:3] / homogeneous[3]
