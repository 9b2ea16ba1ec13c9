"""Sends pictures to the pages: coarse ones while something moves, a fine one at rest.

One thread serves all pages in turn, so pictures never queue up: a change while one is rendered appears in the next.
"""

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import viser

from twin.env.episode_lighting import EpisodeLighting
from twin.geometry.images import to_uint8
from twin.runtime import return_memory
from twin.types import Array, Image
from twin.view.scene_picture import FreeCamera, ObjectState, ScenePicture

COARSE_AREA, FINE_AREA = 320 * 180, 1280 * 720
"""Maximum numbers of pixels of a coarse and a fine picture; a smaller page has pictures of its own size."""

_REST = 0.12  # [s] without a change, after which the fine picture is rendered
_MIN_PERIOD = 0.045  # [s] between two coarse pictures of a page; the browser needs CPU time, too
_MEMORY_PERIOD = 20.0  # [s] least time between two returns of freed memory
_COARSE_QUALITY, _FINE_QUALITY = 80, 92
_DEPTH_MARGIN, _DEPTH_SHARE = 0.06, 0.01  # layers are drawn up to [m] + fraction of depth behind the picture's surface
_MAX_DEPTH = 160.0  # [m] about the largest depth that viser can transmit; the picture hides layers beyond it


@dataclass(frozen=True)
class FilmedFrame:
    """A filmed frame that covers the picture's left part."""

    image: Image
    """Shape (h, w, 3)."""
    camera_to_world: Array
    intrinsics: Array
    """fx, fy, cx, cy [px] at the image's size."""
    share: float
    """Position of the dividing line, as a fraction of the page's width from the left."""


@dataclass(frozen=True)
class Shot:
    """The content of a page."""

    camera_to_world: Array
    fov: float
    """Vertical angle of view [rad]."""
    lighting: EpisodeLighting
    objects: ObjectState | None
    has_layers: bool
    """True if layers are shown, which need the picture's depth."""
    film: FilmedFrame | None = None


@dataclass
class _Page:
    client: viser.ClientHandle
    changed: bool = True
    needs_fine: bool = True
    rest_at: float = 0.0
    last: float = 0.0
    failed: bool = False
    """True if the last picture could not be rendered, which the page was told."""


class PictureLoop:
    """The thread that renders and sends pictures."""

    def __init__(self, picture: ScenePicture, shot: Callable[[viser.ClientHandle], Shot]) -> None:
        """`shot` returns the present content of a page."""
        self._picture, self._shot = picture, shot
        self._pages: dict[int, _Page] = {}
        self._wake, self._lock = threading.Event(), threading.Lock()
        self._closed = False
        self.fine = 0
        """Number of fine pictures sent."""
        self.has_shown = threading.Event()
        """Set once a fine picture was sent."""
        self._thread = threading.Thread(target=self._run, daemon=True, name="pictures")
        self._thread.start()

    def add(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._pages[client.client_id] = _Page(client)
        self._wake.set()

    def remove(self, client: viser.ClientHandle) -> None:
        with self._lock:
            self._pages.pop(client.client_id, None)

    def touch(self, client: viser.ClientHandle | None = None) -> None:
        """Requests a new picture for a page whose content has changed; None: for all pages."""
        with self._lock:
            for page in self._pages.values():
                if client is None or page.client is client:
                    page.changed = True
        self._wake.set()

    def close(self) -> None:
        self._closed = True
        self._wake.set()
        self._thread.join(5.0)

    def _run(self) -> None:
        returned = time.monotonic()
        while not self._closed:
            self._wake.clear()
            with self._lock:
                pages = list(self._pages.values())
            now, due = time.monotonic(), [60.0]
            for page in pages:
                if page.changed and now - page.last >= _MIN_PERIOD:
                    page.changed, page.needs_fine, page.last = False, True, now
                    self._send(page, fine=False)
                    page.rest_at = time.monotonic() + _REST
                    due.append(_REST)
                elif page.changed:
                    due.append(_MIN_PERIOD - (now - page.last))
                elif page.needs_fine and now >= page.rest_at:
                    page.needs_fine = False
                    self._send(page, fine=True)
                    if now - returned > _MEMORY_PERIOD:
                        return_memory()
                        returned = now
                elif page.needs_fine:
                    due.append(page.rest_at - now)
            if min(due) > 0.0:
                self._wake_within(pages, min(due))

    def _wake_within(self, pages: list[_Page], seconds: float) -> None:
        """Sleeps until a change, or `seconds`; after a change, also until the next coarse picture is due."""
        if self._wake.wait(seconds):
            soonest = min((page.last + _MIN_PERIOD for page in pages), default=0.0)
            time.sleep(max(0.0, min(soonest - time.monotonic(), seconds)))

    def _send(self, page: _Page, fine: bool) -> None:
        try:
            self._render(page.client, fine)
            page.failed = False
        except Exception as error:  # such as a file of the field that a build has replaced; the thread must go on
            if not page.failed:
                traceback.print_exc()
                page.client.add_notification("No picture", str(error), auto_close_seconds=None, color="red")
            page.failed = True

    def _render(self, client: viser.ClientHandle, fine: bool) -> None:
        size = picture_size((client.camera.image_width, client.camera.image_height), FINE_AREA if fine else COARSE_AREA)
        if size is None:
            return
        shot = self._shot(client)
        camera = FreeCamera.of_fov(shot.camera_to_world, shot.fov, size)
        if shot.film is not None:
            camera = film_camera(shot.film, size)
        out = self._picture.render(camera, shot.lighting, None if shot.film else shot.objects)
        image = to_uint8(out.rgb[0])
        if shot.film is not None:
            add_film(image, shot.film, camera)
        depth = out.depth[0] * (1.0 + _DEPTH_SHARE) + _DEPTH_MARGIN if shot.has_layers else None
        quality = _FINE_QUALITY if fine else _COARSE_QUALITY
        with self._lock:
            if client.client_id not in self._pages:
                return
        client.scene.set_background_image(
            image, format="jpeg", jpeg_quality=quality, depth=None if depth is None else np.minimum(depth, _MAX_DEPTH)
        )
        client.flush()
        if fine:
            self.fine += 1
            self.has_shown.set()


def picture_size(page: tuple[int, int], area: int) -> tuple[int, int] | None:
    """Even width and height [px] of a picture with a page's aspect ratio and about `area` pixels at most.

    A small page has pictures of its own size. None: the page is too small for a picture.
    """
    width, height = page
    if min(width, height) < 8:
        return None
    scale = min(1.0, float(np.sqrt(area / (width * height))))
    across, down = (max(8, round(n * scale / 2.0) * 2) for n in (width, height))
    return across, down


def film_camera(film: FilmedFrame, size: tuple[int, int]) -> FreeCamera:
    """The frame's camera, for a picture of this size in whose middle the frame is as large as possible."""
    height, width = film.image.shape[:2]
    scale = min(size[0] / width, size[1] / height)
    offset = (np.array(size) - scale * np.array([width, height])) / 2.0
    return FreeCamera(film.camera_to_world, film.intrinsics * scale + np.array([0.0, 0.0, *offset]), size)


def add_film(image: Image, film: FilmedFrame, camera: FreeCamera) -> None:
    """Draws the frame over the left part of a picture of `film_camera`, in place."""
    from twin.report.video_layout import draw_label  # slow to import

    (width, height), (rows, columns) = camera.size, film.image.shape[:2]
    scale = camera.intrinsics[0] / film.intrinsics[0]
    left, top = (round(float(n)) for n in (width - scale * columns, height - scale * rows))
    left, top = left // 2, top // 2
    right, bottom = min(width, left + round(scale * columns)), min(height, top + round(scale * rows))
    smaller = scale < 1.0
    resized = cv2.resize(
        film.image, (right - left, bottom - top), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    )
    edge = min(max(round(film.share * width), left), right)
    image[top:bottom, left:edge] = resized[:, : edge - left]
    image[:, max(0, edge - 1) : edge + 1] = 255
    text = max(9, height // 34)
    if edge - left > 6 * text:
        draw_label(image, "film", (left, top, edge - left, bottom - top), "bottom left", size=text, bold=True)
    if right - edge > 6 * text:
        draw_label(image, "twin", (edge, top, right - edge, bottom - top), "bottom right", size=text, bold=True)
