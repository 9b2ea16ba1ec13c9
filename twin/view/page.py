"""The page of `twin view`: its panel, and what its controls do.

All pages of a server show the same lighting, layers, robot and obstacles; each has its own camera. Callbacks of viser
run on many threads: each holds the page's lock, and an `InputError` within one is shown as a notice.
"""

import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from twin.config import OBSTACLE_KINDS
from twin.env.mujoco_renderer import ChaseCamera
from twin.errors import InputError, join_names
from twin.geometry.cameras import Cameras
from twin.geometry.images import read_image
from twin.loading import Twin
from twin.nerf.baked import BakedField
from twin.nerf.lightings import added_lightings
from twin.report.episode_video import CAUSE_TEXT, draw_curves
from twin.report.video_layout import ACCENT, AMBER
from twin.runtime import child_environment
from twin.scene import check_name
from twin.types import Array, Image
from twin.view.camera_path import (
    CameraPath,
    EpisodeLighting,
    KeyView,
    named_lighting,
    path_frames,
    spaced_times,
    write_path_film,
)
from twin.view.driving import KEYS_DRIVER, DriveFacts, Driving
from twin.view.guarded_server import GuardedServer
from twin.view.layers import FILMED_CAMERAS, clicked_frame, scene_layers, wxyz_of
from twin.view.picture_loop import FilmedFrame, PictureLoop, Shot
from twin.view.scene_picture import ScenePicture

FILM_SIZE, FILM_FPS = (1280, 720), 30
"""Width, height [px] and frames per second of a path's film."""

_FOV = np.deg2rad(60.0)  # [rad] vertical angle of view of a new page's camera
_PATH_SPEED, _MIN_STEP = 1.5, 1.0  # [m/s] along a path, [s] between two key views
_MOVED, _TURNED = 0.03, 0.02  # [m], change of the view direction; a larger movement ends the comparison with the film
_ECHO_TIME = 1.0  # [s] within which a page reports a camera pose that the server has set
_HISTORY = 100  # control steps in the plot of torques
_PLOT_SIZE = 320, 150  # [px]
_FACTS_PERIOD = 0.24  # [s] between two updates of the panel's facts
_MAX_PHOTO = 60 << 20  # [bytes]
_PATH_COLOR = (255, 64, 129)
_OBSTACLE_AHEAD = 4.0  # [m] in front of the camera, where a new obstacle is put
_FRAME_CACHE = 4


class Page:
    """The page of one scene."""

    def __init__(self, twin: Twin, field: BakedField, server: GuardedServer, lighting: EpisodeLighting) -> None:
        self.twin, self.field, self.guarded = twin, field, server
        self.server = server.viser
        self.cameras: Cameras = twin.cameras()
        self.picture = ScenePicture(field)
        self.lighting = lighting
        self.driving: Driving | None = None
        self._lock = threading.RLock()
        self._jobs = ThreadPoolExecutor(1, thread_name_prefix="jobs")
        self._closed = threading.Event()
        self._rng = np.random.default_rng()
        self._film_index: int | None = None
        self._film_share = 0.5
        self._film_placed = 0.0
        self._follow: ChaseCamera | None = None
        self._keys: list[tuple[Array, float, EpisodeLighting]] = []
        self._key_nodes: list[viser.SceneNodeHandle] = []
        self._gizmos: dict[str, viser.TransformControlsHandle] = {}
        self._torques: deque[tuple[float, float, float]] = deque(maxlen=_HISTORY)
        self._facts_shown = 0.0
        self._sampled = 0
        self._read_frame = lru_cache(_FRAME_CACHE)(lambda i: read_image(self.cameras.image_path(i)))
        self._set_initial_camera()
        self.loop = PictureLoop(self.picture, self._shot)
        self._build_panel()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    # ---- cameras of the pages

    def _set_initial_camera(self) -> None:
        """A new page starts at the camera of the first filmed frame."""
        first = self.cameras.camera_to_world[0]
        camera = self.server.initial_camera
        camera.position = first[:3, 3]
        camera.look_at = first[:3, 3] + 4.0 * first[:3, 2]
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = float(_FOV)

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._moved(client))
        # A page may have been open before its initial camera was known.
        first = self.cameras.camera_to_world[0]
        if np.linalg.norm(client.camera.position - first[:3, 3]) > _MOVED:
            self._place(client, first, float(_FOV))
        self.loop.add(client)

    async def _disconnected(self, client: viser.ClientHandle) -> None:
        self.loop.remove(client)

    def _moved(self, client: viser.ClientHandle) -> None:
        if self._film_index is not None and time.monotonic() - self._film_placed > _ECHO_TIME:
            pose = self.cameras.camera_to_world[self._film_index]
            axis = _camera_pose(client)[:3, 2]
            away = np.linalg.norm(client.camera.position - pose[:3, 3]) > _MOVED
            if away or np.linalg.norm(axis - pose[:3, 2]) > _TURNED:
                self._compare.value = False
        self.loop.touch(client)

    def _place(self, client: viser.ClientHandle, pose: Array, fov: float, level: bool = True) -> None:
        """Moves a page's camera; if `level`, the page's controls turn it about the world's z axis."""
        with client.atomic():
            client.camera.up_direction = np.array([0.0, 0.0, 1.0]) if level else -pose[:3, 1]
            client.camera.position = pose[:3, 3]
            client.camera.look_at = pose[:3, 3] + 4.0 * pose[:3, 2]
            client.camera.fov = fov
        self.loop.touch(client)

    def _clients(self) -> list[viser.ClientHandle]:
        return list(self.server.get_clients().values())

    def _shot(self, client: viser.ClientHandle) -> Shot:
        """The present content of a page."""
        index, driving = self._film_index, self.driving
        film = None
        if index is not None:
            pose, intrinsics = self.cameras.camera_to_world[index], self.cameras.intrinsics[index]
            film = FilmedFrame(self._read_frame(index), pose, intrinsics, self._film_share)
        objects = driving.objects() if driving is not None and self._show_robot.value else None
        has_layers = bool(self._gizmos) or bool(self._key_nodes) or any(box.value for box in self._layer_boxes)
        return Shot(_camera_pose(client), client.camera.fov, self.lighting, objects, has_layers, film)

    # ---- panel

    def _build_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(
            dark_mode=True,
            show_logo=False,
            show_share_button=False,
            brand_color=(255, 193, 7),
        )
        gui.main_panel.dock_right()
        self._status = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Look", viser.Icon.SUN):
            self._build_look()
        with tabs.add_tab("Drive", viser.Icon.STEERING_WHEEL):
            self._drive_note = gui.add_markdown("The robot is being loaded ...")
            self._drive_folder = gui.add_folder("Husky", visible=False)
            self._obstacle_folder = gui.add_folder("Obstacles", visible=False)
        with tabs.add_tab("Film", viser.Icon.MOVIE):
            self._build_film()
        with tabs.add_tab("Path", viser.Icon.ROUTE):
            self._build_path()
        self._show_status()

    def _show_status(self) -> None:
        self._status.content = f"**{self.twin.scene.root.resolve().name}** in *{self.lighting.name}*"

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Holds the lock; an InputError within the block becomes a notice on all pages."""
        with self._lock:
            try:
                yield
            except InputError as error:
                self.notify("That did not work", str(error), "red")

    def _submit(self, job: Callable[..., None], *given: Any) -> None:
        """Runs a job after all earlier ones; the traceback of an unexpected error is printed."""
        self._jobs.submit(job, *given).add_done_callback(lambda future: future.cancelled() or future.result())

    def notify(self, title: str, body: str, color: Any = None, seconds: float | None = 12.0) -> None:
        """Shows a notice on all pages."""
        for client in self._clients():
            client.add_notification(title, body, auto_close_seconds=seconds, color=color)

    def _on_click(self, button: Any, work: Callable[[viser.GuiEvent], None]) -> None:
        def clicked(event: viser.GuiEvent) -> None:
            with self._told():
                work(event)

        button.on_click(clicked)

    def _on_update(self, handle: Any, work: Callable[[], None]) -> None:
        def updated(_: viser.GuiEvent) -> None:
            with self._told():
                work()

        handle.on_update(updated)

    # ---- lightings and layers

    def _build_look(self) -> None:
        gui = self.server.gui
        self._light_folder = gui.add_folder("Lighting")
        with self._light_folder:
            # viser's type of a handle declares no setter of `value`.
            self._slider: Any = self._add_slider(0.0)
            button = gui.add_button("Sample a lighting", hint="one that nobody filmed but could have", order=10.0)
            self._on_click(button, lambda event: self._sample())
            self._photo_name = gui.add_text("Name", "", hint="of the lighting that a photo adds", order=11.0)
            upload = gui.add_upload_button(
                "Relight by a photo",
                mime_type="image/*",
                hint="a photo of the place, from near the filmed path; or drop it on the page",
                icon=viser.Icon.PHOTO_UP,
                order=12.0,
            )
            self._upload = upload
            upload.on_upload(lambda event: self._photo_given(upload.value.name, upload.value.content))
        with gui.add_folder("Layers"):
            self._show_robot = gui.add_checkbox("robot and obstacles", True)
            self._on_update(self._show_robot, self.loop.touch)
            self._layer_boxes = []
            for layer in scene_layers(self.server.scene, self.twin, self.field):
                box = gui.add_checkbox(layer.name, False, hint=layer.hint)
                self._layer_boxes.append(box)

                def changed(box: Any = box, layer: Any = layer) -> None:
                    layer.show(box.value)
                    if layer.name == FILMED_CAMERAS:
                        self._listen_to_clicks(box.value)
                    self.loop.touch()

                self._on_update(box, changed)

    def _add_slider(self, value: float) -> viser.GuiInputHandle[float]:
        """A slider through the field's lightings; between two of them it mixes them."""
        names = self.field.lightings
        slider = self.server.gui.add_slider(
            "lighting",
            0.0,
            float(max(1, len(names) - 1)),
            0.01,
            value,
            marks=tuple((float(k), name) for k, name in enumerate(names)),
            disabled=len(names) < 2,
            hint="from one lighting to the next",
            order=0.0,
        )
        self._on_update(slider, self._slid)
        return slider

    def _slid(self) -> None:
        self.set_lighting(slider_lighting(self.field, float(self._slider.value)))

    def set_lighting(self, lighting: EpisodeLighting) -> None:
        """Shows another lighting on all pages and to the robot."""
        self.lighting = lighting
        self._show_status()
        self.loop.touch()
        if self.driving is not None:
            self.driving.set_lighting(lighting)

    def _sample(self) -> None:
        embedding = self.field.sample_lighting(self._rng)
        self._sampled += 1
        self.set_lighting(EpisodeLighting(f"sampled lighting {self._sampled}", embedding))

    def _photo_given(self, name: str, content: bytes) -> None:
        with self._told():
            if len(content) > _MAX_PHOTO:
                raise InputError(f"{name}: {len(content) >> 20} MB; expected a photo of at most {_MAX_PHOTO >> 20} MB")
            lighting = self._photo_name.value.strip() or "".join(c if c.isalnum() else "_" for c in Path(name).stem)
            check_name(lighting, "name")
            self._upload.disabled = True
            self.notify("Relighting", f"{name}: finding where it was taken, then fitting its light: about a minute.")
            self._submit(self._relight, lighting, Path(name).suffix, content)

    def _relight(self, name: str, suffix: str, content: bytes) -> None:
        """Adds a photo's lighting by `twin relight`, in a process of its own: it needs much memory for a minute."""
        try:
            with tempfile.TemporaryDirectory(prefix="twin-") as folder:
                photo = Path(folder) / f"photo{suffix}"
                photo.write_bytes(content)
                done = subprocess.run(
                    [sys.executable, "-m", "twin.relight", str(self.twin.scene.root), str(photo), "--name", name],
                    capture_output=True,
                    text=True,
                    env=child_environment(),
                )
            with self._told():
                if done.returncode:
                    last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
                    raise InputError(last.removeprefix("error: ").replace(str(photo), "the photo"))
                self.reload_lightings()
                self._slider.value = float(self.field.lightings.index(name))
                self._slid()
                self.notify(f"Lighting {name} added", done.stdout.strip().splitlines()[1], "green")
        finally:
            self._upload.disabled = False

    def reload_lightings(self) -> None:
        """Reads the lightings of photos again."""
        names = self.field.lightings_by_name.filmed()
        self.field.lightings_by_name = names
        self.field.add_lightings(*added_lightings(self.twin.scene, names.vectors.shape[1]))
        value = min(float(self._slider.value), len(self.field.lightings) - 1.0)
        self._slider.remove()
        with self._light_folder:
            self._slider = self._add_slider(value)

    # ---- the film beside the twin

    def _build_film(self) -> None:
        gui = self.server.gui
        gui.add_markdown("Move the dividing line between a filmed frame and the twin, seen from the same place.")
        self._compare: Any = gui.add_checkbox("compare", False)
        sources = list(dict.fromkeys(self.cameras.sources))
        self._source: Any = gui.add_dropdown("film", sources)
        self._frame: Any = gui.add_slider("frame", 0, max(1, len(self._frames(sources[0])) - 1), 1, 0)
        self._divider = gui.add_slider("film | twin", 0.0, 1.0, 0.005, 0.5)
        self._film_note = gui.add_markdown("")
        self._on_update(self._compare, self._film_changed)
        self._on_update(self._frame, self._film_changed)
        self._on_update(self._source, self._source_changed)
        self._on_update(self._divider, self._divider_changed)

    def _frames(self, source: str) -> NDArray[np.int64]:
        return np.flatnonzero([name == source for name in self.cameras.sources])

    def _source_changed(self) -> None:
        self._frame.max = max(1, len(self._frames(self._source.value)) - 1)
        self._frame.value = min(int(self._frame.value), int(self._frame.max))
        self._film_changed()

    def _divider_changed(self) -> None:
        self._film_share = float(self._divider.value)
        self.loop.touch()

    def _film_changed(self) -> None:
        if not self._compare.value:
            if self._film_index is not None:
                self._film_index = None
                for client in self._clients():
                    client.camera.up_direction = np.array([0.0, 0.0, 1.0])
                    client.camera.fov = float(_FOV)
                self.loop.touch()
            return
        frames = self._frames(self._source.value)
        index = int(frames[min(int(self._frame.value), len(frames) - 1)])
        lighting = self.cameras.lightings[index]
        if self._film_index is None or self.cameras.lightings[self._film_index] != lighting:
            self._slider.value = float(self.field.lightings.index(lighting))
            self._slid()
        self._read_frame(index)  # raises here if the frame cannot be read
        self._film_index, self._film_placed = index, time.monotonic()
        self._follow = None
        used = "held out: the field never saw it" if self.cameras.held_out[index] else "one that the field learned from"
        self._film_note.content = f"`{self.cameras.names[index]}`, {used}"
        pose, focal = self.cameras.camera_to_world[index], self.cameras.intrinsics[index, 1]
        fov = float(2.0 * np.arctan(self.cameras.sizes[index, 1] / 2.0 / focal))
        for client in self._clients():
            self._place(client, pose, fov, level=False)

    def _listen_to_clicks(self, listen: bool) -> None:
        """Handles clicks on filmed cameras if `listen`, else ignores them."""
        self.server.scene.remove_click_callback()
        if listen:
            self.server.scene.on_click()(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        index = clicked_frame(self.cameras, np.array(event.ray_origin), np.array(event.ray_direction))
        if index is None:
            return
        with self._told():
            source = self.cameras.sources[index]
            if self._source.value != source:
                self._source.value = source
                self._frame.max = max(1, len(self._frames(source)) - 1)
            self._frame.value = int(np.flatnonzero(self._frames(source) == index)[0])
            self._compare.value = True
            self._film_changed()

    # ---- camera paths

    def _build_path(self) -> None:
        gui = self.server.gui
        self._path_note = gui.add_markdown("")
        self._on_click(gui.add_button("Add this view", icon=viser.Icon.CAMERA_PLUS), self._add_view)
        both = gui.add_button_group("views", ("remove last", "clear"))
        self._on_click(both, lambda event: self._remove_views(1 if both.value == "remove last" else len(self._keys)))
        self._speed = gui.add_slider("speed [m/s]", 0.2, 5.0, 0.1, _PATH_SPEED)
        self._on_update(self._speed, self._show_path)
        self._path_name = gui.add_text("Name", "path")
        self._on_click(gui.add_button("Fly along it", icon=viser.Icon.PLAYER_PLAY), self._fly)
        self._on_click(gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY), lambda event: self._save_path(event))
        self._on_click(gui.add_button("Load", icon=viser.Icon.FOLDER_OPEN), lambda event: self._load_path())
        self._film_button = gui.add_button("Render to a film", icon=viser.Icon.MOVIE)
        self._on_click(self._film_button, lambda event: self._render_path())
        self._progress: Any = gui.add_progress_bar(0.0, visible=False)
        self._show_path()

    def path(self) -> CameraPath:
        """The path through the key views. Raises InputError: fewer than two."""
        if len(self._keys) < 2:
            raise InputError(f"{len(self._keys)} views; add two or more: move the camera, then press Add this view")
        times = spaced_times([pose for pose, _, _ in self._keys], float(self._speed.value), _MIN_STEP)
        return CameraPath(
            tuple(KeyView(t, *view) for t, view in zip(times, self._keys, strict=True)),
        )

    def _path_file(self) -> Path:
        return self.twin.scene.root / "paths" / f"{check_name(self._path_name.value.strip(), 'name')}.json"

    def _add_view(self, event: viser.GuiEvent) -> None:
        client = event.client
        if client is None:
            return
        self._keys.append((_camera_pose(client), float(np.rad2deg(client.camera.fov)), self.lighting))
        self._show_path()

    def _remove_views(self, count: int) -> None:
        del self._keys[len(self._keys) - min(count, len(self._keys)) :]
        self._show_path()

    def _show_path(self) -> None:
        for node in self._key_nodes:
            node.remove()
        self._key_nodes = []
        scene = self.server.scene
        for k, (pose, fov, _) in enumerate(self._keys):
            self._key_nodes.append(
                scene.add_camera_frustum(
                    f"/path/view_{k}",
                    fov=float(np.deg2rad(fov)),
                    aspect=FILM_SIZE[0] / FILM_SIZE[1],
                    scale=0.2,
                    color=_PATH_COLOR,
                    wxyz=wxyz_of(pose[:3, :3]),
                    position=pose[:3, 3],
                )
            )
        length = 0.0
        if len(self._keys) > 1:
            path = self.path()
            length = path.duration
            points = np.array([pose[:3, 3] for pose, _, _ in path.at(path_frames(path, 8))])
            segments = np.stack([points[:-1], points[1:]], 1)
            self._key_nodes.append(scene.add_line_segments("/path/line", segments, _PATH_COLOR, thickness=0.03))
        views = "view" if len(self._keys) == 1 else "views"
        self._path_note.content = f"{len(self._keys)} {views}, {length:.1f} s. Each keeps its lighting."
        self.loop.touch()

    def _save_path(self, event: viser.GuiEvent) -> None:
        path, file = self.path(), self._path_file()
        file.parent.mkdir(exist_ok=True)
        path.save(file)
        self.notify("Path saved", f"{file}; twin view {self.twin.scene.root} --path {file} --out film.mp4", "green")

    def _load_path(self) -> None:
        path = CameraPath.load(self._path_file(), self.field)
        self._keys = [(view.camera_to_world, view.fov, view.lighting) for view in path.views]
        self._show_path()

    def _fly(self, event: viser.GuiEvent) -> None:
        """Moves the page's camera along the path in real time."""
        client, path = event.client, self.path()
        if client is not None:
            threading.Thread(target=self._fly_along, args=(client, path), daemon=True).start()

    def _fly_along(self, client: viser.ClientHandle, path: CameraPath) -> None:
        before, began = self.lighting, time.monotonic()
        while (now := time.monotonic() - began) < path.duration and client in self._clients():
            pose, fov, lighting = path.at(np.array([now]))[0]
            self.lighting = lighting
            self._place(client, pose, float(np.deg2rad(fov)))
            time.sleep(0.05)
        self.set_lighting(before)

    def _render_path(self) -> None:
        path, file = self.path(), self._path_file()
        out = self.twin.scene.root / "films" / f"{file.stem}.mp4"
        out.parent.mkdir(exist_ok=True)
        self._film_button.disabled, self._progress.visible = True, True
        self._submit(self._write_film, path, out)

    def _write_film(self, path: CameraPath, out: Path) -> None:
        def on_frame(done: int, total: int) -> None:
            if self._closed.is_set():
                raise OSError("the page was closed")
            if done % 10 == 0 or done == total:
                self._progress.value = 100.0 * done / total

        try:
            frames = write_path_film(out, path, self.picture, FILM_SIZE, FILM_FPS, on_frame)
            self.notify("Film rendered", f"{out}: {frames} frames", "green")
        except OSError as error:
            self.notify("No film", str(error), "red")
        finally:
            self._film_button.disabled, self._progress.visible = False, False

    # ---- driving

    def add_driving(self, driving: Driving) -> None:
        """Shows the robot, and the controls that drive it."""
        gui = self.server.gui
        self._drive_note.visible = False
        with self._drive_folder:
            self._driver = gui.add_dropdown("driver", driving.drivers)
            self._on_update(self._driver, lambda: self._choose_driver(driving))
            self._run_button = gui.add_button("Start driving", icon=viser.Icon.PLAYER_PLAY)
            self._on_click(self._run_button, lambda event: self._toggle_drive(driving))
            self._on_click(gui.add_button("Back to the start"), lambda event: self._restart(driving))
            self._behind = gui.add_checkbox("follow the robot", True)
            self._drive_facts = gui.add_markdown("")
            self._robot_image = gui.add_image(np.zeros((180, 320, 3), np.uint8), label="the robot's picture")
            self._plot = gui.add_image(_plot([]), label="torque at the wheels [N m], last 10 s", format="png")
        with self._obstacle_folder:
            self._kind = gui.add_dropdown("kind", OBSTACLE_KINDS)
            add = gui.add_button("Add in front of the camera", icon=viser.Icon.PLUS)
            self._on_click(add, lambda event: self._add_obstacle(driving, event))
            self._on_click(gui.add_button("Remove all"), lambda event: self._remove_obstacles(driving))
            self._obstacle_text = gui.add_markdown("")
        self._drive_folder.visible = self._obstacle_folder.visible = True
        self.driving = driving
        self._show_obstacles(driving)
        driving.set_lighting(self.lighting)
        driving.reset()
        self.loop.touch()

    def no_driving(self, why: str) -> None:
        """Shows why the scene cannot be driven."""
        self._drive_note.content = why

    def _choose_driver(self, driving: Driving) -> None:
        driving.choose(self._driver.value)
        self._show_running(driving)

    def _toggle_drive(self, driving: Driving) -> None:
        if driving.running:
            driving.pause()
        else:
            if self._compare.value:
                self._compare.value = False
                self._film_changed()
            driving.start()
        self._show_running(driving)

    def _restart(self, driving: Driving) -> None:
        driving.reset()
        self._follow = None

    def _show_running(self, driving: Driving) -> None:
        by_keys = driving.running and driving.driver == KEYS_DRIVER
        self.guarded.set_driving(by_keys)
        self._run_button.label = "Stop" if driving.running else "Start driving"
        self._run_button.icon = viser.Icon.PLAYER_STOP if driving.running else viser.Icon.PLAYER_PLAY
        if by_keys:
            text = "W ahead, S back, A and D turn. Click the picture if the keys do nothing."
            self.notify("W A S D", text, seconds=6.0)

    def drove(self, facts: DriveFacts) -> None:
        """Shows the drive after a control step; called from the driving thread."""
        driving = self.driving
        if driving is None:
            return
        if self._torques and facts.time < self._torques[-1][0]:  # a new drive
            self._torques.clear()
        self._torques.append((facts.time, float(facts.torque[0]), float(facts.torque[1])))
        if driving.running and self._behind.value and self._film_index is None:
            if self._follow is None:
                self._follow = ChaseCamera(facts.base_to_world)
            pose = self._follow.follow(facts.base_to_world)
            for client in self._clients():
                self._place(client, pose, client.camera.fov)
        self.loop.touch()
        now = time.monotonic()
        if now - self._facts_shown >= _FACTS_PERIOD or not driving.running or facts.cause:
            self._facts_shown = now
            self._robot_image.image = facts.image.repeat(2, 0).repeat(2, 1)  # the panel does not enlarge it
            self._drive_facts.content = drive_table(facts)
            self._plot.image = _plot(self._torques)
        if facts.cause:
            good = facts.cause == "goal"
            text = CAUSE_TEXT[facts.cause]
            if facts.cause == "collision":
                text += f" with {join_names(facts.touched, 2)}"
            self.notify("The drive has ended", f"{text} after {facts.progress:.1f} m", "green" if good else "orange")
            self._show_running(driving)

    # ---- obstacles

    def _add_obstacle(self, driving: Driving, event: viser.GuiEvent) -> None:
        kind = self._kind.value
        name = driving.obstacles.free(kind)
        if name is None:
            raise InputError(f"all obstacles of the kind {kind} stand already; remove some")
        if event.client is None:
            return
        pose = _camera_pose(event.client)
        ahead = pose[:2, 2] / max(float(np.linalg.norm(pose[:2, 2])), 1e-6)
        x, y = pose[:2, 3] + _OBSTACLE_AHEAD * ahead
        driving.obstacles.put(name, float(x), float(y), float(np.arctan2(ahead[1], ahead[0])))
        driving.update_obstacles()
        self._show_obstacles(driving)

    def _remove_obstacles(self, driving: Driving) -> None:
        driving.obstacles.standing.clear()
        driving.update_obstacles()
        self._show_obstacles(driving)

    def _show_obstacles(self, driving: Driving) -> None:
        """Gives each standing obstacle a handle to drag it by."""
        standing = driving.obstacles.standing
        for name in [name for name in self._gizmos if name not in standing]:
            self._gizmos.pop(name).remove()
        for name in standing:
            if name not in self._gizmos:
                self._gizmos[name] = self._gizmo(driving, name)
        self._show_obstacle_text(driving)
        self.loop.touch()

    def _gizmo(self, driving: Driving, name: str) -> viser.TransformControlsHandle:
        x, y, yaw = driving.obstacles.pose(name)
        gizmo = self.server.scene.add_transform_controls(
            f"/obstacles/{name}",
            scale=0.8,
            active_axes=(True, True, False),
            rotation_limits=((0.0, 0.0), (0.0, 0.0), (-1000.0, 1000.0)),
            depth_test=False,
            opacity=0.7,
            position=(x, y, driving.ground_height(x, y) + 0.05),
            wxyz=(np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)),
        )

        def dragged(event: viser.TransformControlsEvent) -> None:
            with self._told():
                if name not in driving.obstacles.standing:
                    return
                (x, y, _), (w, _, _, z) = event.target.position, event.target.wxyz
                driving.obstacles.put(name, float(x), float(y), float(2.0 * np.arctan2(z, w)))
                driving.update_obstacles()
                if event.phase == "end":
                    event.target.position = (x, y, driving.ground_height(float(x), float(y)) + 0.05)
                    self._show_obstacle_text(driving)
                self.loop.touch()

        gizmo.on_update(dragged)
        return gizmo

    def _show_obstacle_text(self, driving: Driving) -> None:
        text = driving.obstacles.toml()
        note = "Drag an obstacle by its arrows, turn it by its ring."
        keep = f" To keep them, copy into `scene.toml`:\n```toml\n{text}\n```" if text else ""
        self._obstacle_text.content = note + keep

    def close(self) -> None:
        self._closed.set()
        self.loop.close()
        if self.driving is not None:
            self.driving.close()
        self._jobs.shutdown(wait=False, cancel_futures=True)
        with suppress(Exception):
            self.guarded.stop()


def _camera_pose(client: viser.ClientHandle) -> Array:
    """camera_to_world of a page's camera, OpenCV axes, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = viser.transforms.SO3(client.camera.wxyz).as_matrix()
    pose[:3, 3] = client.camera.position
    return pose


def slider_lighting(field: BakedField, value: float) -> EpisodeLighting:
    """The lighting at a value of the slider: at an integer k the field's k-th, between integers a mixture of two."""
    names = field.lightings
    k = min(int(value), max(0, len(names) - 2))
    share = round(value - k, 4)
    if share <= 0.0 or len(names) == 1:
        return named_lighting(field, names[k])
    return named_lighting(field, names[k + 1] if share >= 1.0 else f"{names[k]}:{names[k + 1]}:{share:g}")


def _plot(torques: Iterable[tuple[float, float, float]]) -> Image:
    """Curves of the torques (time [s], left, right [N m]) of the last control steps."""
    width, height = _PLOT_SIZE
    canvas = np.zeros((height, width, 3), np.uint8)
    times, left, right = np.array(list(torques) or [(0.0, 0.0, 0.0)]).T
    rows = [("left", left, AMBER), ("right", right, ACCENT)]
    draw_curves(canvas, (0, 0, width, height), rows, times, len(times) - 1, 13)
    return canvas


def drive_table(facts: DriveFacts) -> str:
    """The facts of a drive as a Markdown table."""
    (v, yaw), (left, right), (amps_left, amps_right) = facts.command, facts.torque, facts.current
    rows = [
        ("time", f"{facts.time:.1f} s, {facts.rate:.1f}× real time"),
        ("command", f"{v:+.2f} m/s, {yaw:+.2f} rad/s"),
        ("driven", f"{facts.speed:+.2f} m/s, {facts.yaw_rate:+.2f} rad/s"),
        ("torque left, right", f"{left:+.1f}, {right:+.1f} N m"),
        ("current left, right", f"{amps_left:+.1f}, {amps_right:+.1f} A"),
        ("along, off the route", f"{facts.progress:.1f} m, {facts.cross_track:+.2f} m"),
        ("trust in the picture", f"{facts.trust:.2f}"),
        ("touches", join_names(facts.touched, 2) if facts.touched else "nothing"),
    ]
    return "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows)
