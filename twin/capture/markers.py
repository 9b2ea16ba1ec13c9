"""Scale from a printed square marker (ArUco or AprilTag): its corners are found, triangulated and measured."""

import cv2
import numpy as np

from twin import progress
from twin.capture.scale import Scale
from twin.config import MarkerConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.geometry.images import read_image
from twin.geometry.poses import Array, inverse_pose

_MIN_ANGLE = np.radians(2.0)  # [rad] between the rays of two frames


def scale_from_marker(cameras: Cameras, marker: MarkerConfig) -> Scale:
    """Metres per unit from a marker that stands in the scene.

    Raises:
        InputError: unknown family, no size, or not seen from two places.
    """
    families = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if marker.family not in families:
        raise InputError(f"metric.marker.family = {marker.family!r}; expected one of {', '.join(families)}")
    if not marker.size > 0:
        raise InputError(f"metric.marker.size = {marker.size}; expected the side of the black square [m]")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.family))
    if not 0 <= marker.id < len(dictionary.bytesList):
        raise InputError(f"metric.marker.id = {marker.id}; {marker.family} has 0 to {len(dictionary.bytesList) - 1}")
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, settings)
    frames, corners = [], []
    for i in progress.track(range(len(cameras)), "marker", unit="frame"):
        grey = cv2.cvtColor(read_image(cameras.image_path(i)), cv2.COLOR_RGB2GRAY)
        found, ids, _ = detector.detectMarkers(grey)
        hits = [k for k, value in enumerate(np.ravel(ids) if ids is not None else []) if int(value) == marker.id]
        if len(hits) == 1:  # two of the same number in one picture: neither can be trusted
            frames.append(i)
            # OpenCV counts from the centre of the first pixel, cameras here from its corner.
            corners.append(np.asarray(found[hits[0]], np.float64).reshape(4, 2) + 0.5)
    if len(frames) < 2:
        raise InputError(
            f"metric.marker: {marker.family} number {marker.id} was found in {len(frames)} frames (need 2); film it "
            "nearer and from more than one place"
        )
    poses, intrinsics = cameras.camera_to_world[frames], cameras.intrinsics[frames]
    square = np.array([_triangulate(np.array(corners)[:, k], poses, intrinsics) for k in range(4)])
    rays = square.mean(0) - poses[:, :3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)) < _MIN_ANGLE:
        raise InputError("metric.marker: seen from one direction only; film it while passing by")
    sides = np.linalg.norm(square - np.roll(square, 1, axis=0), axis=1)
    side = float(sides.mean())
    sigma = float(sides.std() / side)
    if sigma > 0.2:
        raise InputError(
            f"metric.marker: its four sides differ by {sigma:.0%}; film it nearer, sharper and from more places"
        )
    return Scale(marker.size / side, sigma / 2.0, {"marker_frames": len(frames)})


def _triangulate(pixels: Array, camera_to_world: Array, intrinsics: Array) -> Array:
    """The point seen at `pixels` (n, 2): linear triangulation (Hartley & Zisserman 2004, sec. 12.2), then Gauss-Newton
    on the reprojection error."""
    world_to_camera = inverse_pose(camera_to_world)
    fx, fy, cx, cy = intrinsics.T
    u, v = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    rows = np.concatenate(
        [
            u[:, None] * world_to_camera[:, 2] - world_to_camera[:, 0],
            v[:, None] * world_to_camera[:, 2] - world_to_camera[:, 1],
        ]
    )
    homogeneous = np.linalg.svd(rows)[2][-1]
    point = homogeneous[:3] / homogeneous[3]
    for _ in range(10):
        local = np.einsum("nij,j->ni", world_to_camera[:, :3, :3], point) + world_to_camera[:, :3, 3]
        z = local[:, 2]
        residual = np.concatenate([(local[:, 0] / z - u) * fx, (local[:, 1] / z - v) * fy])
        turn = world_to_camera[:, :3, :3]
        du = (turn[:, 0] - (local[:, 0] / z)[:, None] * turn[:, 2]) / z[:, None] * fx[:, None]
        dv = (turn[:, 1] - (local[:, 1] / z)[:, None] * turn[:, 2]) / z[:, None] * fy[:, None]
        point = point - np.linalg.lstsq(np.concatenate([du, dv]), residual, rcond=None)[0]
    return point
