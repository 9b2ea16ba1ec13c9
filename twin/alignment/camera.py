"""A film by the robot's own camera → how that camera sits, and its focal length.

The frames are found on the built place (`capture/register.py`), and the seat by where they were (`seat.py`). The
pictures that are drawn show the film's frames beside what the twin's robot sees from the same spots.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from twin import progress
from twin.alignment.seat import Seat, find_seat, heading_of, seated
from twin.assets.ground import Ground
from twin.capture.lens import Lens, same_aspect
from twin.capture.register_film import FilmRegistration, register_film
from twin.capture.video import FilmCount, read_film
from twin.config import CaptureConfig
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints
from twin.geometry.images import psnr, write_image
from twin.loading import load_scene
from twin.robot import HuskyParams, PixelCamera
from twin.scene import SceneDir
from twin.stamp import finished

_CHOICE = CaptureConfig(fps=2.0, max_frames=90)
_WORST_TURN, _WORST_HEIGHT = 0.3, 0.03  # [°], [m] standard errors beyond which a seat is not believed
_WORST_ERROR = 3.0  # [px at 1280] of a pinhole's inliers
_PICTURES, _WIDTH = 3, 640  # of the film, and their width [px]

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class CameraAlignment:
    """What a film told of the robot's camera."""

    film: FilmRegistration
    frames: int
    """Of the film that were looked for."""
    seat: Seat
    error: Seat
    """Standard errors."""
    focal_given: bool
    """Whether the focal length was given."""

    @property
    def in_words(self) -> str:
        """The film's fit in a line."""
        found = f"{len(self.film.frames)} of {self.frames} frames found on the place"
        return f"{found}, features {self.film.error:.2f} px off (median)"

    @property
    def identified(self) -> dict[str, tuple[Any, Any]]:
        """Fields of HuskyParams: value and standard error."""
        out: dict[str, tuple[Any, Any]] = {
            f"camera_{name}": (value, getattr(self.error, name)) for name, value in vars(self.seat).items()
        }
        if not self.focal_given:
            fx, fy, cx, cy = (float(value) for value in self.film.lens.intrinsics)
            out["camera_intrinsics"] = (fx, fy, cx, cy), (self.film.focal_error, self.film.focal_error, None, None)
            out["camera_size"] = (self.film.lens.width, self.film.lens.height), None
        return out

    def figures(self) -> dict[str, Any]:
        """Every figure, for JSON."""
        return {
            "frames": self.frames,
            "frames_found": len(self.film.frames),
            "reprojection_error_px": round(self.film.error, 3),
            "robot": {
                name: {"value": value, "standard_error": error} for name, (value, error) in self.identified.items()
            },
        }


def align_camera(film: Path, scene: SceneDir, params: HuskyParams) -> tuple[CameraAlignment, list[Image]]:
    """The seat by a film, and the film's frames that were looked for.

    Args:
        film: Of the robot driving on the place, mostly ahead, by its front camera, rectified.
        scene: Built.
        params: What is known of the robot; intrinsics among it are kept.

    Raises:
        InputError: a scene that is not built, or a film that does not show how the camera sits.
    """
    ground = _ground(scene)
    with progress.bar("reading the film", 0, "frame") as bar:
        frames = []
        for frame in read_film(film, _CHOICE, FilmCount(), lambda *_: None):
            frames.append(frame.image)
            bar.update()
    size = frames[0].shape[1], frames[0].shape[0]
    found = register_film(frames, _given(params, size), scene)
    worst = _WORST_ERROR * max(size) / 1280
    if found.error > worst:
        raise InputError(
            f"{film}: features lie {found.error:.1f} px off where a pinhole camera would show them, expected at most "
            f"{worst:.1f}; rectify the film (take the distortion out of it)"
        )
    seat, error = find_seat(found.camera_to_world, ground.at, params.camera_offset)
    if max(error.yaw, error.pitch, error.roll) > _WORST_TURN or error.height > _WORST_HEIGHT:
        raise InputError(
            f"{film}: leaves the camera's yaw, pitch, roll uncertain by {error.yaw:.2f}, {error.pitch:.2f}, "
            f"{error.roll:.2f}° and its height by {error.height:.3f} m, expected at most {_WORST_TURN:g}° and "
            f"{_WORST_HEIGHT:g} m; film a longer drive on the filmed path"
        )
    return CameraAlignment(found, len(frames), seat, error, bool(params.camera_intrinsics)), frames


def pictures(
    folder: Path, alignment: CameraAlignment, frames: list[Image], scene: SceneDir, robot: HuskyParams
) -> None:
    """Writes `camera.png`: frames of the film, left, and what the twin's robot sees from there."""
    field, ground = load_scene(scene.root).field(), _ground(scene)
    some = np.linspace(0, len(alignment.film.frames) - 1, _PICTURES + 2).round().astype(int)[1:-1]
    width, height = alignment.film.lens.width, alignment.film.lens.height
    size = min(_WIDTH, width), round(height * min(1.0, _WIDTH / width))
    lens = PixelCamera(tuple(alignment.film.lens.intrinsics.tolist()), (width, height)).resized(size)
    rows = []
    for k in some:
        pose = alignment.film.camera_to_world[k]
        heading = float(heading_of(pose, np.deg2rad(alignment.seat.yaw)))
        here = Viewpoints.of(seated(robot, pose[:2, 3], heading, ground.at), np.array(lens.intrinsics), size)
        filmed = cv2.resize(frames[alignment.film.frames[k]], size, interpolation=cv2.INTER_AREA)
        seen = [field.render(here, lighting).rgb[0] for lighting in field.lightings]
        best = max(seen, key=lambda rgb: psnr(rgb, filmed / np.float32(255.0)))
        rows.append(np.hstack([filmed, (np.clip(best, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)]))
    write_image(folder / "camera.png", np.vstack(rows))


def _ground(scene: SceneDir) -> Ground:
    """Of a scene that is built as far as is needed here. Raises InputError."""
    for stage in ("metric", "field", "mesh"):
        finished(scene, stage)
    return Ground.load(scene.stage("mesh"))


def _given(params: HuskyParams, size: tuple[int, int]) -> Lens | None:
    """The lens that is known of the robot, at the film's size."""
    if not params.camera_intrinsics:
        return None
    if not same_aspect(size, params.camera().size):
        width, height = params.camera().size
        raise InputError(
            f"the film is {size[0]}x{size[1]}, but camera_intrinsics in [robot] are for {width}x{height}; "
            "film with the whole picture, or give the intrinsics of the film"
        )
    return Lens("PINHOLE", tuple(params.camera().resized(size).intrinsics), *size)
