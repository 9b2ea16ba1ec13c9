"""The page's controls that compare a filmed frame with the twin's picture from the same camera pose."""

import time
from functools import lru_cache
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from twin.geometry.images import read_image
from twin.view.layers import clicked_frame
from twin.view.lighting_panel import LightingPanel
from twin.view.picture_loop import FilmedFrame
from twin.view.viewer import FOV, MOVED, Viewer, camera_pose_of

_TURNED = 0.02  # [rad] a larger turn of a page's camera, or a movement by more than MOVED, ends the comparison
_ECHO_TIME = 1.0  # [s] after the server sets a camera pose, in which movements that a page reports are ignored
_FRAME_CACHE = 4


class FilmPanel:
    """The tab "Film"."""

    def __init__(self, viewer: Viewer, lighting: LightingPanel) -> None:
        self._viewer, self._lighting = viewer, lighting
        self._cameras = viewer.cameras
        self.index: int | None = None
        """Index of the frame that is compared; None while nothing is compared."""
        self._share, self._placed = 0.5, 0.0
        self._read_frame = lru_cache(_FRAME_CACHE)(lambda i: read_image(self._cameras.image_path(i)))
        gui = viewer.server.gui
        gui.add_markdown("Compares a filmed frame with the twin from the same pose; move the line between them.")
        self._compare: Any = gui.add_checkbox("compare", False)
        sources = list(dict.fromkeys(self._cameras.sources))
        self._source: Any = gui.add_dropdown("film", sources)
        self._frame: Any = gui.add_slider("frame", 0, max(1, len(self._frames(sources[0])) - 1), 1, 0)
        self._divider = gui.add_slider("film | twin", 0.0, 1.0, 0.005, 0.5)
        self._note = gui.add_markdown("")
        viewer.on_update(self._compare, self._changed)
        viewer.on_update(self._frame, self._changed)
        viewer.on_update(self._source, self._source_changed)
        viewer.on_update(self._divider, self._divider_changed)

    def _frames(self, source: str) -> NDArray[np.int64]:
        return np.flatnonzero([name == source for name in self._cameras.sources])

    def frame(self) -> FilmedFrame | None:
        """The frame that is compared."""
        index = self.index
        if index is None:
            return None
        pose, intrinsics = self._cameras.camera_to_world[index], self._cameras.intrinsics[index]
        return FilmedFrame(self._read_frame(index), pose, intrinsics, self._share)

    def moved(self, client: viser.ClientHandle) -> None:
        """Ends the comparison if a page's camera has moved away from the frame's camera."""
        index = self.index  # other threads change it
        if index is not None and time.monotonic() - self._placed > _ECHO_TIME:
            pose = self._cameras.camera_to_world[index]
            axis = camera_pose_of(client)[:3, 2]
            away = np.linalg.norm(client.camera.position - pose[:3, 3]) > MOVED
            if away or np.linalg.norm(axis - pose[:3, 2]) > _TURNED:
                self.end()

    def end(self) -> None:
        """Ends the comparison."""
        self._compare.value = False  # calls `_changed`

    def _source_changed(self) -> None:
        self._frame.max = max(1, len(self._frames(self._source.value)) - 1)
        self._frame.value = min(int(self._frame.value), int(self._frame.max))
        self._changed()

    def _divider_changed(self) -> None:
        self._share = float(self._divider.value)
        self._viewer.loop.touch()

    def _changed(self) -> None:
        if not self._compare.value:
            if self.index is not None:
                self.index = None
                for client in self._viewer.clients():
                    client.camera.up_direction = np.array([0.0, 0.0, 1.0])
                    client.camera.fov = FOV
                self._viewer.loop.touch()
            return
        cameras, frames = self._cameras, self._frames(self._source.value)
        index = int(frames[min(int(self._frame.value), len(frames) - 1)])
        lighting = cameras.lightings[index]
        if self.index is None or cameras.lightings[self.index] != lighting:
            self._lighting.choose(lighting)
        self._read_frame(index)  # raises here if the frame cannot be read
        self.index, self._placed = index, time.monotonic()
        self._viewer.stop_following()
        used = "not used to train the field" if cameras.held_out[index] else "used to train the field"
        self._note.content = f"`{cameras.names[index]}`, {used}"
        pose, focal = cameras.camera_to_world[index], cameras.intrinsics[index, 1]
        fov = float(2.0 * np.arctan(cameras.sizes[index, 1] / 2.0 / focal))
        for client in self._viewer.clients():
            self._viewer.place(client, pose, fov, level=False)

    def listen_to_clicks(self, listen: bool) -> None:
        """Handles clicks on filmed cameras if `listen`, else ignores them."""
        scene = self._viewer.server.scene
        scene.remove_click_callback()
        if listen:
            scene.on_click()(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        index = clicked_frame(self._cameras, np.array(event.ray_origin), np.array(event.ray_direction))
        if index is None:
            return
        with self._viewer.locked():
            self._source.value = self._cameras.sources[index]
            self._frame.value = int(np.flatnonzero(self._frames(self._source.value) == index)[0])
            self._compare.value = True
