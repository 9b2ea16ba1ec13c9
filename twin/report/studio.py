"""What every section of the review film shares: the field, the cameras, the canvas, and the count of what was rendered.

A *view* is one rendered picture with its depth. A *picture* with a caption is kept for the page beside the film.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as with_default
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.files import write_bytes
from twin.geometry.cameras import Cameras, Viewpoints
from twin.geometry.images import read_image
from twin.nerf.rendering import Field, Rendering
from twin.report.panels import Layout, Picture
from twin.report.video import VideoWriter, even

Array = NDArray[np.float64]

_PICTURE_WIDTH = 1000  # [px] at most, of a picture for the page
_PICTURE_QUALITY = 82


@dataclass(frozen=True)
class KeptPicture:
    """A picture for the page."""

    file: str
    """Within the stage folder."""
    section: str
    """The stage whose section shows it."""
    caption: str


@dataclass
class Studio:
    """Renders views and keeps the books."""

    name: str
    """Of the scene."""
    field: Field
    cameras: Cameras
    layout: Layout
    writer: VideoWriter
    out: Path
    render_width: int
    path: Array
    """What the plan shows: the route, or the cameras of the longest source [m], shape (n, 2)."""
    kept: list[KeptPicture] = with_default(default_factory=list)
    renders: int = 0
    render_seconds: float = 0.0

    @property
    def fps(self) -> int:
        return self.writer.fps

    def view(
        self, camera_to_world: Array, intrinsics: Array, size: tuple[int, int], lighting: str, width: int | None = None
    ) -> Rendering:
        """One view of the field, shapes (1, h, w, ...).

        Args:
            camera_to_world: Shape (4, 4).
            intrinsics: fx, fy, cx, cy [px] at `size`.
            size: Of the camera [px]; the view is rendered smaller, with the same proportions.
            lighting: As the field takes it.
            width: Longer side of the view [px]; `render_width` unless given.
        """
        shrink = (width or self.render_width) / max(size)
        small = (even(round(size[0] * shrink)), even(round(size[1] * shrink)))
        start = time.perf_counter()
        rendering = self.field.render(Viewpoints.of(camera_to_world, intrinsics, size), lighting, small)
        self.render_seconds += time.perf_counter() - start
        self.renders += 1
        return rendering

    def frame_view(self, i: int, lighting: str | None = None, width: int | None = None) -> Rendering:
        """The field seen from where frame i was taken, in that frame's light unless told otherwise; see `view`."""
        cameras = self.cameras
        size = (int(cameras.sizes[i, 0]), int(cameras.sizes[i, 1]))
        light = lighting or light_of_frame(cameras, i)
        return self.view(cameras.camera_to_world[i], cameras.intrinsics[i], size, light, width)

    def real(self, i: int) -> Picture:
        """Frame i as it was filmed (undistorted), with what its mask ignores greyed out."""
        image = read_image(self.cameras.image_path(i))
        mask = self.cameras.mask_path(i)
        return image if mask is None else greyed(image, read_image(mask)[..., 0] == 0)

    def keep(self, name: str, section: str, caption: str, picture: Picture, width: int = _PICTURE_WIDTH) -> None:
        """Stores a picture for the page as `pictures/<name>.jpg`, `width` [px] wide at most."""
        if picture.shape[1] > width:
            height = round(picture.shape[0] * width / picture.shape[1])
            picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        ok, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _PICTURE_QUALITY])
        if not ok:
            raise OSError(f"could not encode picture {name}")
        path = self.out / "pictures" / f"{name}.jpg"
        path.parent.mkdir(exist_ok=True)
        write_bytes(path, data.tobytes())
        self.kept.append(KeptPicture(f"pictures/{name}.jpg", section, caption))


def greyed(image: Picture, ignored: NDArray[np.bool_]) -> Picture:
    """The image with its ignored part, shape (h, w), grey and striped: it was filmed, but not learnt."""
    v, u = np.indices(ignored.shape)
    width = max(4, len(ignored) // 40)
    stripes = np.where((u + v) // width % 2 == 0, 0.55, 0.4)[..., None]
    grey = image.mean(-1, keepdims=True) * stripes + 30.0
    return np.where(ignored[..., None], grey, image).astype(np.uint8)


def spread(indices: Sequence[int] | NDArray, count: int) -> list[int]:
    """At most `count` of the indices, evenly spread, the first and last included."""
    if count >= len(indices):
        return [int(i) for i in indices]
    if count <= 1:
        return [int(indices[len(indices) // 2])][:count]
    return [int(indices[i]) for i in np.unique(np.linspace(0, len(indices) - 1, count).round().astype(int))]


def frames_to_compare(cameras: Cameras, lighting: str, count: int) -> list[int]:
    """Frames of one lighting along its longest source, half of them held out where there are enough, in order."""
    of_lighting = [i for i, name in enumerate(cameras.lightings) if name == lighting]
    sources = [cameras.sources[i] for i in of_lighting]
    if not sources:
        return []
    longest = max(dict.fromkeys(sources), key=sources.count)
    mine = [i for i in of_lighting if cameras.sources[i] == longest]
    held_out = [i for i in mine if cameras.held_out[i]]
    trained = [i for i in mine if not cameras.held_out[i]]
    unseen = spread(held_out, max(1, count // 2))
    return sorted([*unseen, *spread(trained, count - len(unseen))])


def light_of_frame(cameras: Cameras, i: int) -> str:
    """What to ask the field for, to see the light of frame i.

    A trained frame has an appearance of its own. A held-out one was never looked at, so it gets what lies between the
    trained frames before and after it in its film: light and exposure drift, and they are not what is judged.
    """
    if not cameras.held_out[i]:
        return cameras.names[i]
    mine = [k for k, name in enumerate(cameras.sources) if name == cameras.sources[i] and not cameras.held_out[k]]
    before = max(
        (k for k in mine if cameras.times[k] <= cameras.times[i]), key=lambda k: cameras.times[k], default=None
    )
    after = min((k for k in mine if cameras.times[k] > cameras.times[i]), key=lambda k: cameras.times[k], default=None)
    if before is None or after is None:
        only = before if before is not None else after
        return cameras.lightings[i] if only is None else cameras.names[only]
    span = cameras.times[after] - cameras.times[before]
    return f"{cameras.names[before]}:{cameras.names[after]}:{(cameras.times[i] - cameras.times[before]) / span:.6g}"


def side_by_side(pictures: Sequence[Picture], height: int) -> Picture:
    """Pictures in a row, scaled to one height, with a thin gap."""
    gap = np.full((height, 6, 3), 255, np.uint8)
    row: list[Picture] = []
    for picture in pictures:
        width = max(1, round(picture.shape[1] * height / picture.shape[0]))
        way = cv2.INTER_AREA if picture.shape[0] > height else cv2.INTER_CUBIC
        row += [gap, cv2.resize(picture, (width, height), interpolation=way).astype(np.uint8)]
    return np.concatenate(row[1:], 1)


def as_picture(rgb: NDArray) -> Picture:
    """Colour in [0, 1] as uint8."""
    return (np.clip(np.nan_to_num(rgb), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
