"""What every section of the review film shares: the field, the cameras, the canvas, and the count of what was rendered.

A *view* is one rendered picture with its depth. A *picture* with a caption is kept for the page beside the film.
"""

import queue
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from dataclasses import field as with_default
from pathlib import Path
from types import TracebackType
from typing import Generic, TypeVar

import cv2
import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from twin.files import write_bytes
from twin.geometry.cameras import Cameras, Viewpoints
from twin.geometry.images import psnr, read_image, resize
from twin.nerf.rendering import RenderableField, Rendering
from twin.report.video_layout import (
    AMBER,
    FARTHEST_DEPTH,
    GROUND,
    INK,
    MUTED,
    NEAREST_DEPTH,
    SUNKEN,
    Colour,
    FrameLayout,
    depth_colours,
    depth_share,
    draw_text,
    fit,
    shorten,
    text_width,
)
from twin.report.video_writer import VideoWriter, even
from twin.types import Array, Image

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
    field: RenderableField
    cameras: Cameras
    layout: FrameLayout
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

    def real(self, i: int) -> Image:
        """Frame i as it was filmed (undistorted), with what its mask ignores greyed out."""
        image = read_image(self.cameras.image_path(i))
        mask = self.cameras.mask_path(i)
        return image if mask is None else greyed(image, read_image(mask)[..., 0] == 0)

    def keep(self, name: str, section: str, caption: str, picture: Image, width: int = _PICTURE_WIDTH) -> None:
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


def greyed(image: Image, ignored: NDArray[np.bool_]) -> Image:
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


def side_by_side(pictures: Sequence[Image], height: int) -> Image:
    """Pictures in a row, scaled to one height, with a thin gap."""
    gap = np.full((height, 6, 3), 255, np.uint8)
    row: list[Image] = []
    for picture in pictures:
        width = max(1, round(picture.shape[1] * height / picture.shape[0]))
        way = cv2.INTER_AREA if picture.shape[0] > height else cv2.INTER_CUBIC
        row += [gap, cv2.resize(picture, (width, height), interpolation=way).astype(np.uint8)]
    return np.concatenate(row[1:], 1)


def as_picture(rgb: NDArray) -> Image:
    """Colour in [0, 1] as uint8."""
    return (np.clip(np.nan_to_num(rgb), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


# ---- Pictures for the page in which a person can judge the field: film, render, depth and error of one frame in a row.
#
# The render has the lighting's own embedding, as it was learnt; nothing is fitted to the frame. *Error* is the mean over
# red, green and blue of |render − film|, as a share of full brightness.


PANEL = 320  # [px] longer side of each picture, and of what is rendered
MOST_ERROR = 0.3  # share of full brightness at the end of the error's colours
_DEPTH_TICKS = (2.0, 5.0, 10.0, 25.0)  # [m] between the ends
_GAP = 6  # [px]
_TEXT = 15  # [px]
_EDGE = 30  # [px] height of the lines above and below the pictures


def judged_row(studio: Studio, i: int) -> tuple[Image, float]:
    """Frame i filmed, rendered, its depth and its error side by side with their scales; and its PSNR [dB]."""
    cameras = studio.cameras
    view = studio.frame_view(i, cameras.lightings[i], PANEL)
    rgb, depth = view.rgb[0], depth_colours(view.depth[0], view.opacity[0])
    height, width = depth.shape[:2]
    film = resize(read_image(cameras.image_path(i)), width, height) / 255.0
    path = cameras.mask_path(i)
    # Any ignored pixel spoils the mean it goes into.
    mask = None if path is None else resize((read_image(path)[..., 0] > 0).astype(np.float32), width, height) > 0.999
    score = psnr(rgb, film, mask)
    wrong = error_colours(np.abs(rgb - film).mean(-1), mask)
    bar = max(40, width - 16)
    far = [(float(depth_share(m)), f"{m:g}") for m in (NEAREST_DEPTH, *_DEPTH_TICKS)]
    far.append((1.0, f"{FARTHEST_DEPTH:g} m"))
    ramp = NEAREST_DEPTH * (FARTHEST_DEPTH / NEAREST_DEPTH) ** np.linspace(0.0, 1.0, bar)
    errors = [(share, f"{100 * share * MOST_ERROR:.0f}") for share in (0.0, 1 / 3, 2 / 3)]
    errors.append((1.0, f"{100 * MOST_ERROR:.0f} %+"))
    unseen = ("never trained on", AMBER) if cameras.held_out[i] else ("trained on", MUTED)
    panels = [
        panel(fit(studio.real(i), (width, height)), "filmed", cameras.names[i], under(width, *unseen)),
        panel(as_picture(rgb), "rendered", f"{score:.1f} dB PSNR", under(width, "light as learnt, nothing fitted")),
        panel(depth, "depth", "grey: nothing solid", scale_bar(width, depth_colours(ramp[None]), far)),
        panel(
            wrong,
            "error",
            "of full brightness",
            scale_bar(width, error_colours(np.linspace(0, MOST_ERROR, bar)[None]), errors),
        ),
    ]
    gap = np.full((len(panels[0]), _GAP, 3), GROUND, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)] + [gap], 1), score


def error_colours(error: NDArray, mask: NDArray[np.bool_] | None = None) -> Image:
    """Error as a share of full brightness, shape (h, w), as colours: dark is right, bright wrong; ignored is grey."""
    colours = (colormaps["viridis"](np.clip(error / MOST_ERROR, 0.0, 1.0))[..., :3] * 255 + 0.5).astype(np.uint8)
    if mask is not None:
        colours[~mask] = MUTED
    return colours


def scale_bar(width: int, ramp: Image, labels: list[tuple[float, str]]) -> Image:
    """A bar of colours over labels at shares of its length; those without room are left out."""
    out = np.full((2 * _EDGE - 10, width, 3), GROUND, np.uint8)
    bar = ramp.shape[1]
    left = (width - bar) // 2
    out[8:18, left : left + bar] = ramp[:1]
    free = left  # where the next label may begin
    last = width - text_width(labels[-1][1], _TEXT) - 2 * _GAP  # where the one at the end begins
    for k, (share, text) in enumerate(labels):
        at, half = left + round(share * (bar - 1)), text_width(text, _TEXT) // 2
        align = "left" if k == 0 else "right" if k == len(labels) - 1 else "middle"
        if align == "middle" and (at - half < free or at + half > last):
            continue
        out[18:22, at : at + 1] = INK
        draw_text(out, text, at, 24, _TEXT, INK, align=align)
        free = at + (2 if k == 0 else 1) * half + _GAP
    return out


def under(width: int, text: str, colour: Colour = MUTED) -> Image:
    """A line of words as tall as a scale."""
    out = np.full((2 * _EDGE - 10, width, 3), GROUND, np.uint8)
    draw_text(out, shorten(text, width - 8, _TEXT), 4, 8, _TEXT, colour)
    return out


def panel(picture: Image, title: str, note: str, below: Image) -> Image:
    """A picture between its title and what stands below."""
    width = picture.shape[1]
    head = np.full((_EDGE, width, 3), GROUND, np.uint8)
    draw_text(head, title, 4, 5, _TEXT, INK, True)
    free = width - text_width(title, _TEXT, True) - 20
    if note and free > 20:
        draw_text(head, shorten(note, free, _TEXT), width - 4, 5, _TEXT, MUTED, align="right")
    body = picture.copy()
    body[[0, -1]] = SUNKEN  # an edge where a picture is as dark as the ground
    return np.concatenate([head, body, below])


# ---- Work done ahead of its use, in a second thread: Warp's kernels release the interpreter, so two cores are used.


T = TypeVar("T")

_WAIT = 0.2  # [s] between two looks at whether the reader has gone


class Prefetched(Generic[T]):
    """Iterates over `items`, which a thread computes up to `depth` items ahead, from the moment of entering the block.

    An exception in the thread is raised where the next item is asked for. Leaving the block stops the thread.
    """

    def __init__(self, items: Iterator[T], depth: int):
        self._items = items
        self._queue: queue.Queue[tuple[bool, T | BaseException | None]] = queue.Queue(max(1, depth))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)

    def _work(self) -> None:
        try:
            for item in self._items:
                self._put((True, item))
                if self._stop.is_set():
                    return
            self._put((False, None))
        except BaseException as error:  # handed on, whatever it is
            self._put((False, error))

    def _put(self, entry: tuple[bool, T | BaseException | None]) -> None:
        while not self._stop.is_set():
            try:
                self._queue.put(entry, timeout=_WAIT)
                return
            except queue.Full:
                continue

    def __enter__(self) -> "Prefetched[T]":
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def __iter__(self) -> Iterator[T]:
        while True:
            there, item = self._queue.get()
            if not there:
                if isinstance(item, BaseException):
                    raise item
                return
            yield item  # type: ignore[misc]
