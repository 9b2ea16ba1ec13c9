"""The page's controls that collect key views into a camera path, fly along it, and render it to a film."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import viser

from twin.env.episode_lighting import EpisodeLighting
from twin.errors import InputError
from twin.scene import check_name
from twin.types import Array
from twin.unpack import is_cached
from twin.view.camera_path import CameraPath, KeyView, path_frames, spaced_times, write_path_film
from twin.view.layers import wxyz_of
from twin.view.viewer import Viewer, camera_pose_of

_FILM_SIZE, _FILM_FPS = (1280, 720), 30  # width, height [px] and frames per second
_SPEED, _MIN_STEP = 1.5, 1.0  # [m/s] default along a path; [s] shortest time between two key views
_COLOR = (255, 64, 129)


class PathPanel:
    """The tab "Path"."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, root = viewer, viewer.twin.scene.root
        self._root = Path.cwd() if is_cached(root) else root  # for results; a pack's cache may be deleted
        self._keys: list[tuple[Array, float, EpisodeLighting]] = []
        self.nodes: list[viser.SceneNodeHandle] = []
        """The key views and the path between them, as the browser draws them."""
        gui = viewer.server.gui
        self._note = gui.add_markdown("")
        viewer.on_click(gui.add_button("Add this view"), self._add_view)
        both = gui.add_button_group("views", ("remove last", "clear"))
        viewer.on_click(both, lambda event: self._remove_views(1 if both.value == "remove last" else len(self._keys)))
        self._speed = gui.add_slider("speed [m/s]", 0.2, 5.0, 0.1, _SPEED)
        viewer.on_update(self._speed, self._show)
        self._name = gui.add_text("Name", "path")
        self._fly_button = gui.add_button("Fly along it")
        viewer.on_click(self._fly_button, self._fly)
        viewer.on_click(gui.add_button("Save"), lambda event: self._save())
        viewer.on_click(gui.add_button("Load"), lambda event: self._load())
        self._film_button = gui.add_button("Render to a film")
        viewer.on_click(self._film_button, lambda event: self._render())
        self._progress: Any = gui.add_progress_bar(0.0, visible=False)
        self._show()

    def _path(self) -> CameraPath:
        """The path through the key views. Raises InputError: fewer than two, too many, or a path that is too long."""
        if len(self._keys) < 2:
            raise InputError(f"{len(self._keys)} views; add two or more: move the camera, then press Add this view")
        times = spaced_times([pose for pose, _, _ in self._keys], float(self._speed.value), _MIN_STEP)
        try:
            return CameraPath(tuple(KeyView(t, *view) for t, view in zip(times, self._keys, strict=True)))
        except ValueError as error:
            raise InputError(f"{error}; remove views, or raise the speed") from None

    def _file(self) -> Path:
        return self._root / "paths" / f"{check_name(self._name.value.strip(), 'name')}.json"

    def _add_view(self, event: viser.GuiEvent) -> None:
        client = event.client
        if client is None:
            return
        view = camera_pose_of(client), float(np.rad2deg(client.camera.fov)), self._viewer.lighting
        self._keys.append(view)
        self._show()

    def _remove_views(self, count: int) -> None:
        del self._keys[len(self._keys) - min(count, len(self._keys)) :]
        self._show()

    def _show(self) -> None:
        for node in self.nodes:
            node.remove()
        self.nodes = []
        scene = self._viewer.server.scene
        for k, (pose, fov, _) in enumerate(self._keys):
            self.nodes.append(
                scene.add_camera_frustum(
                    f"/path/view_{k}",
                    fov=float(np.deg2rad(fov)),
                    aspect=_FILM_SIZE[0] / _FILM_SIZE[1],
                    scale=0.2,
                    color=_COLOR,
                    wxyz=wxyz_of(pose[:3, :3]),
                    position=pose[:3, 3],
                )
            )
        length = 0.0
        if len(self._keys) > 1:
            path = self._path()
            length = path.duration
            points = np.array([pose[:3, 3] for pose, _, _ in path.at(path_frames(path, 8))])
            segments = np.stack([points[:-1], points[1:]], 1)
            self.nodes.append(scene.add_line_segments("/path/line", segments, _COLOR, thickness=0.03))
        views = "view" if len(self._keys) == 1 else "views"
        self._note.content = f"{len(self._keys)} {views}, {length:.1f} s. Each view keeps its lighting."
        self._viewer.loop.touch()

    def _save(self) -> None:
        path, file = self._path(), self._file()
        file.parent.mkdir(exist_ok=True)
        path.save(file)
        text = f"{file}; to film it: twin view {self._viewer.twin.scene.root} --path {file} --out film.mp4"
        self._viewer.notify("Path saved", text, "green")

    def _load(self) -> None:
        path = CameraPath.load(self._file(), self._viewer.field)
        self._keys = [(view.camera_to_world, view.fov, view.lighting) for view in path.views]
        self._show()

    def _fly(self, event: viser.GuiEvent) -> None:
        """Moves the camera of the user's page along the path in real time."""
        client, path = event.client, self._path()
        if client is not None and not self._fly_button.disabled:
            self._fly_button.disabled = True
            threading.Thread(target=self._fly_along, args=(client, path), daemon=True).start()

    def _fly_along(self, client: viser.ClientHandle, path: CameraPath) -> None:
        """Ends with the lighting from before, unless another was chosen in flight, which ends the flight."""
        viewer = self._viewer
        before = shown = viewer.lighting
        began = time.monotonic()
        try:
            while (now := time.monotonic() - began) < path.duration and client in viewer.clients():
                with viewer.locked():
                    if viewer.lighting is not shown or viewer.closed.is_set():
                        return
                    pose, fov, shown = path.at(np.array([now]))[0]
                    viewer.lighting = shown
                viewer.place(client, pose, float(np.deg2rad(fov)))
                time.sleep(0.05)
            with viewer.locked():
                if viewer.lighting is shown:
                    viewer.set_lighting(before)
        finally:
            self._fly_button.disabled = False

    def _render(self) -> None:
        path, file = self._path(), self._file()
        out = self._root / "films" / f"{file.stem}.mp4"
        out.parent.mkdir(exist_ok=True)
        self._film_button.disabled, self._progress.visible = True, True
        self._viewer.submit(self._write_film, path, out)

    def _write_film(self, path: CameraPath, out: Path) -> None:
        def on_frame(done: int, total: int) -> None:
            if self._viewer.closed.is_set():
                raise OSError("the page was closed")
            if done % 10 == 0 or done == total:
                self._progress.value = 100.0 * done / total

        try:
            frames = write_path_film(out, path, self._viewer.picture, _FILM_SIZE, _FILM_FPS, on_frame)
            self._viewer.notify("Film rendered", f"{out}: {frames} frames", "green")
        except OSError as error:
            self._viewer.notify("No film", str(error), "red")
        finally:
            self._film_button.disabled, self._progress.visible = False, False
