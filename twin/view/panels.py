"""The page's controls: the folder "Lighting", and the tabs "Film" and "Path".

"Lighting" has a slider through the field's lightings, sampling, and relighting by a photo. "Film" compares a filmed
frame with the twin's picture from the same camera pose. "Path" collects key views into a camera path, flies along it,
and renders it to a film.
"""

import itertools
import shlex
import sys
import tempfile
import threading
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from twin.capture.formats import IMAGE_SUFFIXES
from twin.env.episode_lighting import EpisodeLighting
from twin.errors import InputError
from twin.files import exists
from twin.geometry.images import read_image
from twin.nerf.baked import BakedField
from twin.nerf.lightings import added_lightings
from twin.scene import check_name
from twin.types import Array, Image
from twin.unpack import is_cached
from twin.view.camera_path import CameraPath, KeyView, named_lighting, path_frames, spaced_times, write_path_film
from twin.view.layers import clicked_frame
from twin.view.picture_loop import FilmedFrame
from twin.view.viewer import FOV, MOVED, Viewer, camera_pose_of

# ---- lighting

_MAX_PHOTO = 60 << 20  # [bytes]


class LightingPanel:
    """The folder "Lighting"."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._field = viewer, viewer.field
        self._rng, self._sampled = np.random.default_rng(), 0
        self._pending: set[str] = set()  # names of photos that are being fitted; more may be dropped meanwhile
        gui = viewer.server.gui
        self._folder = gui.add_folder("Lighting")
        with self._folder:
            # viser's type of a handle declares no setter of `value`.
            self._slider: Any = self._add_slider(0.0)
            button = gui.add_button("Sample a lighting", hint="a plausible lighting that was never filmed", order=10.0)
            viewer.on_click(button, lambda event: self._sample())
            self._name = gui.add_text("Name", "", hint="name for the lighting that a photo adds", order=11.0)
            upload = gui.add_upload_button(
                "Relight by a photo",
                mime_type="image/*",
                hint="a photo of the place, from near the filmed path; or drop it on the page",
                order=12.0,
            )
            self._upload = upload
            upload.on_upload(lambda event: self._photo_given(upload.value.name, upload.value.content))

    def _add_slider(self, value: float) -> viser.GuiInputHandle[float]:
        """A slider through the field's lightings; it blends between neighbors."""
        names = self._field.lightings
        slider = self._viewer.server.gui.add_slider(
            "lighting",
            0.0,
            float(max(1, len(names) - 1)),
            0.01,
            value,
            marks=tuple((float(k), name) for k, name in enumerate(names)),
            disabled=len(names) < 2,
            hint="blends from each lighting to the next",
            order=0.0,
        )
        self._viewer.on_update(slider, self._slid)
        return slider

    def _slid(self) -> None:
        self._viewer.set_lighting(slider_lighting(self._field, float(self._slider.value)))

    def choose(self, name: str) -> None:
        """Moves the slider to a lighting of the field, and shows it."""
        self._slider.value = float(self._field.lightings.index(name))
        self._slid()

    def _sample(self) -> None:
        embedding = self._field.sample_lighting(self._rng)
        self._sampled += 1
        self._viewer.set_lighting(EpisodeLighting(f"sampled lighting {self._sampled}", embedding))

    def _photo_given(self, name: str, content: bytes) -> None:
        with self._viewer.locked():
            if len(content) > _MAX_PHOTO:
                raise InputError(f"{name}: {len(content) >> 20} MB; expected a photo of at most {_MAX_PHOTO >> 20} MB")
            suffix = Path(name).suffix.lower()
            if suffix not in IMAGE_SUFFIXES:
                raise InputError(f"{name}: expected a photo ({', '.join(IMAGE_SUFFIXES)})")
            lighting = self._name.value.strip() or self._unused_name(Path(name).stem)
            check_name(lighting, "name")
            self._upload.disabled = True
            self._pending.add(lighting)
            text = f"{name}: finding its camera pose and fitting its lighting; this takes about a minute."
            self._viewer.notify("Relighting", text)
            self._viewer.submit(self._relight, lighting, suffix, content)

    def _unused_name(self, stem: str) -> str:
        """A name made from a photo's; numbered if it exists, as phones upload every photo as "image.jpg"."""
        stem, folder = "".join(c if c.isalnum() else "_" for c in stem), self._viewer.twin.scene.lightings
        taken = {*self._field.lightings, *self._pending}
        names = (f"{stem}_{k}" if k > 1 else stem for k in itertools.count(1))
        return next(one for one in names if one not in taken and not exists(folder / f"{one}.json"))

    def _relight(self, name: str, suffix: str, content: bytes) -> None:
        """Adds a photo's lighting by `twin relight` in another process, which frees its large memory when it ends."""
        root = str(self._viewer.twin.scene.root)
        try:
            with tempfile.TemporaryDirectory(prefix="twin-") as folder:
                photo = Path(folder) / f"photo{suffix}"
                photo.write_bytes(content)
                done = self._viewer.run([sys.executable, "-m", "twin.relight", root, str(photo), "--name", name])
            if self._viewer.closed.is_set():
                return
            with self._viewer.locked():
                if done.returncode:
                    last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
                    raise InputError(last.removeprefix("error: ").replace(str(photo), "the photo"))
                self._reload()
                self.choose(name)
                self._viewer.notify(f"Lighting {name} added", done.stdout.strip().splitlines()[1], "green")
        finally:
            self._pending.discard(name)
            self._upload.disabled = bool(self._pending)

    def _reload(self) -> None:
        """Reloads the lightings that photos have added to the scene."""
        filmed = self._field.lightings_by_name.filmed()
        added = added_lightings(self._viewer.twin.scene, filmed.vectors.shape[1])
        self._field.lightings_by_name = filmed.added(*added)
        value = min(float(self._slider.value), len(self._field.lightings) - 1.0)
        self._slider.remove()
        with self._folder:
            self._slider = self._add_slider(value)


def slider_lighting(field: BakedField, value: float) -> EpisodeLighting:
    """The lighting at a value of the slider: at an integer k the field's k-th, between integers a mixture of two."""
    names = field.lightings
    k = min(int(value), max(0, len(names) - 2))
    share = round(value - k, 4)
    if share <= 0.0 or len(names) == 1:
        return named_lighting(field, names[k])
    return named_lighting(field, names[k + 1] if share >= 1.0 else f"{names[k]}:{names[k + 1]}:{share:g}")


# ---- film

_TURNED = 0.02  # [rad] a larger turn of a page's camera, or a movement by more than MOVED, ends the comparison
_ECHO_TIME = 1.0  # [s] movements that a page reports are ignored for this time after the server sets a camera pose
_FRAME_CACHE = 4


class FilmPanel:
    """The tab "Film"."""

    def __init__(self, viewer: Viewer, lighting: LightingPanel) -> None:
        self._viewer, self._lighting = viewer, lighting
        self._cameras = viewer.cameras
        self.index: int | None = None
        """Index of the frame that is compared; None while nothing is compared."""
        self._share, self._placed = 0.5, 0.0
        self._comparing: set[int] = set()  # ids of the pages that show the frame; one that opens later does not
        self._read_frame = lru_cache(_FRAME_CACHE)(self._uncached_frame)
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

    def _uncached_frame(self, index: int) -> Image:
        path = self._cameras.image_path(index)
        if not path.exists():
            raise InputError(f"there is no frame {self._cameras.names[index]}: packs have none; view the built scene")
        return read_image(path)

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
        if index is not None and client.client_id in self._comparing and time.monotonic() - self._placed > _ECHO_TIME:
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
        try:
            self._read_frame(index)  # before anything changes
        except InputError:
            self.end()
            raise
        if self.index is None or cameras.lightings[self.index] != lighting:
            self._lighting.choose(lighting)
        self.index, self._placed = index, time.monotonic()
        self._viewer.stop_following()
        used = "not used to train the field" if cameras.held_out[index] else "used to train the field"
        self._note.content = f"`{cameras.names[index]}`, {used}"
        pose, focal = cameras.camera_to_world[index], cameras.intrinsics[index, 1]
        fov = float(2.0 * np.arctan(cameras.sizes[index, 1] / 2.0 / focal))
        self._comparing = {client.client_id for client in self._viewer.clients()}
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


# ---- path

_FILM_SIZE, _FILM_FPS = (1280, 720), 30  # width, height [px] and frames per second
_SPEED, _MIN_STEP = 1.5, 1.0  # [m/s] default along a path; [s] shortest time between two key views
_COLOR = (255, 64, 129)


class PathPanel:
    """The tab "Path"."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, root = viewer, viewer.twin.scene.root
        self._root = Path.cwd() if is_cached(root) else root  # not the cache of a pack, which may be deleted
        self._keys: list[tuple[Array, float, EpisodeLighting]] = []
        self._loaded: CameraPath | None = None  # the path of `_keys` as its file has it, until views or speed change
        self.nodes: list[viser.SceneNodeHandle] = []
        """The key views and the path between them, as the browser draws them."""
        gui = viewer.server.gui
        self._note = gui.add_markdown("")
        viewer.on_click(gui.add_button("Add this view"), self._add_view)
        both = gui.add_button_group("views", ("remove last", "clear"))
        viewer.on_click(both, lambda event: self._remove_views(1 if both.value == "remove last" else len(self._keys)))
        self._speed = gui.add_slider("speed [m/s]", 0.2, 5.0, 0.1, _SPEED)
        viewer.on_update(self._speed, self._changed)
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
        if self._loaded is not None:
            return self._loaded
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
        self._changed()

    def _remove_views(self, count: int) -> None:
        del self._keys[len(self._keys) - min(count, len(self._keys)) :]
        self._changed()

    def _changed(self) -> None:
        self._loaded = None
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
                    wxyz=viser.transforms.SO3.from_matrix(pose[:3, :3]).wxyz,
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
        words = ["twin", "view", str(self._viewer.twin.scene.root), "--path", str(file)]
        text = f"{file}; to film it: {shlex.join(words)} --out film.mp4"
        self._viewer.notify("Path saved", text, "green")

    def _load(self) -> None:
        self._loaded = path = CameraPath.load(self._file(), self._viewer.field)
        self._keys = [(view.camera_to_world, view.fov, view.lighting) for view in path.views]
        self._show()

    def _fly(self, event: viser.GuiEvent) -> None:
        """Moves the camera of the user's page along the path in real time."""
        client, path = event.client, self._path()
        if client is not None and not self._fly_button.disabled:
            self._fly_button.disabled = True
            threading.Thread(target=self._fly_along, args=(client, path), daemon=True).start()

    def _fly_along(self, client: viser.ClientHandle, path: CameraPath) -> None:
        """Flies along a path, then restores the lighting. If the user chooses another lighting, the flight ends."""
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
        except (InputError, OSError) as error:
            self._viewer.notify("No film", str(error), "red")
        finally:
            self._film_button.disabled, self._progress.visible = False, False
