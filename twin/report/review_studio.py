"""Shared parts of the review video: rendering, saved pictures, panels, and prefetching in a second thread."""

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
    BACKGROUND,
    FARTHEST_DEPTH,
    INK,
    MUTED,
    NEAREST_DEPTH,
    PANEL_BACKGROUND,
    Color,
    FrameLayout,
    depth_colors,
    depth_scale,
    draw_text,
    fit,
    shorten,
    text_width,
)
from twin.report.video_writer import VideoWriter, even
from twin.types import Array, Image

_PICTURE_WIDTH = 1000  # [px] maximum, of pictures for the page
_PICTURE_QUALITY = 82


@dataclass(frozen=True)
class PagePicture:
    file: str
    """Path within the stage folder."""
    section: str
    """Name of the report section."""
    caption: str


@dataclass
class Studio:
    """Renders views of the field, counts renders, and saves pictures for the page."""

    name: str
    """Name of the scene."""
    field: RenderableField
    cameras: Cameras
    layout: FrameLayout
    writer: VideoWriter
    out: Path
    render_width: int
    path: Array
    """Path on the map: the route, or the camera positions of the longest source [m], shape (n, 2)."""
    pictures: list[PagePicture] = with_default(default_factory=list)
    renders: int = 0
    render_seconds: float = 0.0

    @property
    def fps(self) -> int:
        return self.writer.fps

    def render(
        self, camera_to_world: Array, intrinsics: Array, size: tuple[int, int], lighting: str, width: int | None = None
    ) -> Rendering:
        """Renders one view of the field, shapes (1, h, w, ...).

        `intrinsics` are fx, fy, cx, cy [px] at `size`. The view has the same aspect and a longer side of `width` [px],
        by default `render_width`.
        """
        shrink = (width or self.render_width) / max(size)
        small = (even(round(size[0] * shrink)), even(round(size[1] * shrink)))
        start = time.perf_counter()
        rendering = self.field.render(Viewpoints.of(camera_to_world, intrinsics, size), lighting, small)
        self.render_seconds += time.perf_counter() - start
        self.renders += 1
        return rendering

    def render_frame(self, i: int, lighting: str | None = None, width: int | None = None) -> Rendering:
        """Renders the field at the pose of frame i, by default in that frame's own appearance; see `render`."""
        cameras = self.cameras
        size = (int(cameras.sizes[i, 0]), int(cameras.sizes[i, 1]))
        light = lighting or appearance_of_frame(cameras, i)
        return self.render(cameras.camera_to_world[i], cameras.intrinsics[i], size, light, width)

    def real_frame(self, i: int) -> Image:
        """The undistorted frame i, with its masked part grayed out."""
        image = read_image(self.cameras.image_path(i))
        mask = self.cameras.mask_path(i)
        return image if mask is None else gray_out(image, read_image(mask)[..., 0] == 0)

    def save_picture(self, name: str, section: str, caption: str, picture: Image, width: int = _PICTURE_WIDTH) -> None:
        """Saves a picture for the page as `pictures/<name>.jpg`, at most `width` [px] wide."""
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
        self.pictures.append(PagePicture(f"pictures/{name}.jpg", section, caption))


def gray_out(image: Image, ignored: NDArray[np.bool_]) -> Image:
    """Shows the ignored part of an image, shape (h, w), in gray stripes."""
    v, u = np.indices(ignored.shape)
    width = max(4, len(ignored) // 40)
    stripes = np.where((u + v) // width % 2 == 0, 0.55, 0.4)[..., None]
    gray = image.mean(-1, keepdims=True) * stripes + 30.0
    return np.where(ignored[..., None], gray, image).astype(np.uint8)


def evenly_spaced(indices: Sequence[int] | NDArray, count: int) -> list[int]:
    """At most `count` of the indices, evenly spaced, including the first and the last."""
    if count >= len(indices):
        return [int(i) for i in indices]
    if count <= 1:
        return [int(indices[len(indices) // 2])][:count]
    return [int(indices[i]) for i in np.unique(np.linspace(0, len(indices) - 1, count).round().astype(int))]


def frames_to_compare(cameras: Cameras, lighting: str, count: int) -> list[int]:
    """Frames of a lighting along its longest source, in order, half of them held out if there are enough."""
    of_lighting = [i for i, name in enumerate(cameras.lightings) if name == lighting]
    sources = [cameras.sources[i] for i in of_lighting]
    if not sources:
        return []
    longest = max(dict.fromkeys(sources), key=sources.count)
    mine = [i for i in of_lighting if cameras.sources[i] == longest]
    held_out = [i for i in mine if cameras.held_out[i]]
    trained = [i for i in mine if not cameras.held_out[i]]
    unseen = evenly_spaced(held_out, max(1, count // 2))
    return sorted([*unseen, *evenly_spaced(trained, count - len(unseen))])


def appearance_of_frame(cameras: Cameras, i: int) -> str:
    """Appearance of frame i, as a lighting for the field.

    A trained frame has its own embedding. A held-out frame gets the interpolation of the trained frames before and
    after it in its film, because light and exposure drift and are not part of the evaluation.
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
    """Concatenates pictures in a row, scaled to one height, with thin gaps."""
    gap = np.full((height, 6, 3), 255, np.uint8)
    row: list[Image] = []
    for picture in pictures:
        width = max(1, round(picture.shape[1] * height / picture.shape[0]))
        interpolation = cv2.INTER_AREA if picture.shape[0] > height else cv2.INTER_CUBIC
        row += [gap, cv2.resize(picture, (width, height), interpolation=interpolation).astype(np.uint8)]
    return np.concatenate(row[1:], 1)


def to_uint8(rgb: NDArray) -> Image:
    return (np.clip(np.nan_to_num(rgb), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


# ---- rows of panels

PANEL_SIZE = 320  # [px] longer side of each panel and of the render
MAX_ERROR = 0.3  # share of full brightness at the end of the color scale
_DEPTH_TICKS = (2.0, 5.0, 10.0, 25.0)  # [m] between the ends of the depth scale
_GAP = 6  # [px]
_TEXT = 15  # [px]
_LINE_HEIGHT = 30  # [px] height of the lines above and below a panel


def comparison_row(studio: Studio, i: int) -> tuple[Image, float]:
    """Real frame, render, depth and error of frame i with their scales, and its PSNR [dB].

    The render uses the lighting's trained embedding; nothing is fitted to the frame. The error is the mean over the
    channels of |render − film|, as a share of full brightness.
    """
    cameras = studio.cameras
    render = studio.render_frame(i, cameras.lightings[i], PANEL_SIZE)
    rgb, depth = render.rgb[0], depth_colors(render.depth[0], render.opacity[0])
    height, width = depth.shape[:2]
    film = resize(read_image(cameras.image_path(i)), width, height) / 255.0
    path = cameras.mask_path(i)
    # A pixel of the resized mask is valid only if all its source pixels are.
    mask = None if path is None else resize((read_image(path)[..., 0] > 0).astype(np.float32), width, height) > 0.999
    score = psnr(rgb, film, mask)
    error = error_colors(np.abs(rgb - film).mean(-1), mask)
    bar = max(40, width - 16)
    depth_ticks = [(float(depth_scale(m)), f"{m:g}") for m in (NEAREST_DEPTH, *_DEPTH_TICKS)]
    depth_ticks.append((1.0, f"{FARTHEST_DEPTH:g} m"))
    ramp = NEAREST_DEPTH * (FARTHEST_DEPTH / NEAREST_DEPTH) ** np.linspace(0.0, 1.0, bar)
    errors = [(share, f"{100 * share * MAX_ERROR:.0f}") for share in (0.0, 1 / 3, 2 / 3)]
    errors.append((1.0, f"{100 * MAX_ERROR:.0f} %+"))
    unseen = ("held out", AMBER) if cameras.held_out[i] else ("trained on", MUTED)
    panels = [
        titled_panel(
            fit(studio.real_frame(i), (width, height)), "real", cameras.names[i], caption_line(width, *unseen)
        ),
        titled_panel(
            to_uint8(rgb), "rendered", f"{score:.1f} dB PSNR", caption_line(width, "trained appearance, not fitted")
        ),
        titled_panel(depth, "depth", "gray: nothing solid", scale_bar(width, depth_colors(ramp[None]), depth_ticks)),
        titled_panel(
            error,
            "error",
            "of full brightness",
            scale_bar(width, error_colors(np.linspace(0, MAX_ERROR, bar)[None]), errors),
        ),
    ]
    gap = np.full((len(panels[0]), _GAP, 3), BACKGROUND, np.uint8)
    return np.concatenate([part for panel in panels for part in (gap, panel)] + [gap], 1), score


def error_colors(error: NDArray, mask: NDArray[np.bool_] | None = None) -> Image:
    """Colors of an error, shape (h, w), as a share of full brightness: dark is small; masked pixels are gray."""
    colors = (colormaps["viridis"](np.clip(error / MAX_ERROR, 0.0, 1.0))[..., :3] * 255 + 0.5).astype(np.uint8)
    if mask is not None:
        colors[~mask] = MUTED
    return colors


def scale_bar(width: int, ramp: Image, labels: list[tuple[float, str]]) -> Image:
    """A color bar with labels at shares of its length; labels without room are left out."""
    out = np.full((2 * _LINE_HEIGHT - 10, width, 3), BACKGROUND, np.uint8)
    bar = ramp.shape[1]
    left = (width - bar) // 2
    out[8:18, left : left + bar] = ramp[:1]
    free = left  # left end of the next label at least
    last = width - text_width(labels[-1][1], _TEXT) - 2 * _GAP  # left end of the last label
    for k, (share, text) in enumerate(labels):
        at, half = left + round(share * (bar - 1)), text_width(text, _TEXT) // 2
        align = "left" if k == 0 else "right" if k == len(labels) - 1 else "middle"
        if align == "middle" and (at - half < free or at + half > last):
            continue
        out[18:22, at : at + 1] = INK
        draw_text(out, text, at, 24, _TEXT, INK, align=align)
        free = at + (2 if k == 0 else 1) * half + _GAP
    return out


def caption_line(width: int, text: str, color: Color = MUTED) -> Image:
    out = np.full((2 * _LINE_HEIGHT - 10, width, 3), BACKGROUND, np.uint8)
    draw_text(out, shorten(text, width - 8, _TEXT), 4, 8, _TEXT, color)
    return out


def titled_panel(picture: Image, title: str, note: str, below: Image) -> Image:
    width = picture.shape[1]
    head = np.full((_LINE_HEIGHT, width, 3), BACKGROUND, np.uint8)
    draw_text(head, title, 4, 5, _TEXT, INK, True)
    free = width - text_width(title, _TEXT, True) - 20
    if note and free > 20:
        draw_text(head, shorten(note, free, _TEXT), width - 4, 5, _TEXT, MUTED, align="right")
    body = picture.copy()
    body[[0, -1]] = PANEL_BACKGROUND  # an edge for pictures as dark as the background
    return np.concatenate([head, body, below])


# ---- prefetching

T = TypeVar("T")

_POLL_INTERVAL = 0.2  # [s] between checks whether the reader has stopped


class Prefetcher(Generic[T]):
    """Iterates over `items`, which a thread computes up to `depth` items ahead from entering the block on.

    Warp kernels release the GIL, so this uses a second core. An exception in the thread is raised at the next item.
    Leaving the block stops the thread.
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
        except BaseException as error:  # raised again in the reader
            self._put((False, error))

    def _put(self, entry: tuple[bool, T | BaseException | None]) -> None:
        while not self._stop.is_set():
            try:
                self._queue.put(entry, timeout=_POLL_INTERVAL)
                return
            except queue.Full:
                continue

    def __enter__(self) -> "Prefetcher[T]":
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
