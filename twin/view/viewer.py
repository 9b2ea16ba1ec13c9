"""The open pages of `twin view`: their cameras, shared lighting and robot, notices, and background jobs.

All pages of a server show the same lighting, layers, robot and obstacles; each has its own camera. viser runs callbacks
on many threads. Callbacks of controls hold the viewer's lock; their `InputError` or `OSError` is shown as a notice.
"""

import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from twin.env.episode_lighting import EpisodeLighting
from twin.errors import InputError
from twin.geometry.cameras import Cameras
from twin.geometry.poses import pose_of
from twin.loading import Twin
from twin.nerf.baked import BakedField
from twin.types import Array
from twin.view.guarded_server import GuardedServer
from twin.view.picture_loop import PictureLoop, Shot
from twin.view.scene_picture import ScenePicture

if TYPE_CHECKING:
    from twin.env.mujoco_renderer import ChaseCamera
    from twin.view.driving import Driving

FOV = float(np.deg2rad(60.0))
"""Vertical angle of view of a new page's camera [rad]."""
MOVED = 0.03
"""[m]; a camera that is closer than this to a pose counts as being there."""


class Viewer:
    """The pages of one server; other classes add their controls."""

    def __init__(
        self,
        twin: Twin,
        field: BakedField,
        server: GuardedServer,
        lighting: EpisodeLighting,
        shot: Callable[[viser.ClientHandle], Shot],
    ) -> None:
        """`shot` returns the present content of a page."""
        self.twin, self.field, self.guarded, self.lighting = twin, field, server, lighting
        self.server = server.viser
        self.cameras: Cameras = twin.cameras()
        self.picture = ScenePicture(field)
        self.driving: Driving | None = None
        self.closed = threading.Event()
        self._chase: ChaseCamera | None = None
        self._lock = threading.RLock()
        self._jobs = ThreadPoolExecutor(1, thread_name_prefix="jobs")
        self._child: subprocess.Popen[str] | None = None  # the running job's process
        self._first = self.cameras.camera_to_world[0]
        camera = self.server.initial_camera  # starts at the first filmed frame
        camera.position = self._first[:3, 3]
        camera.look_at = self._first[:3, 3] + 4.0 * self._first[:3, 2]
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = FOV
        self.loop = PictureLoop(self.picture, shot)
        self._status = self.server.gui.add_markdown("")
        self._show_status()

    def _show_status(self) -> None:
        self._status.content = f"**{self.twin.scene.root.resolve().name}** in *{self.lighting.name}*"

    def set_lighting(self, lighting: EpisodeLighting) -> None:
        """Changes the lighting of all pages and of the robot's pictures."""
        self.lighting = lighting
        self._show_status()
        self.loop.touch()
        if self.driving is not None:
            self.driving.set_lighting(lighting)

    # ---- pages and their cameras

    def serve(self, moved: Callable[[viser.ClientHandle], None]) -> None:
        """Begins to send pictures to pages; `moved` is called after each movement of a page's camera."""

        def connected(client: viser.ClientHandle) -> None:
            client.camera.on_update(lambda _: moved(client))
            # A page that connects early does not know the initial camera yet.
            if np.linalg.norm(client.camera.position - self._first[:3, 3]) > MOVED:
                self.place(client, self._first, FOV)
            self.loop.add(client)
            if client.client_id not in self.server.get_clients():  # it has closed meanwhile
                self.loop.remove(client)

        async def disconnected(client: viser.ClientHandle) -> None:
            self.loop.remove(client)

        self.server.on_client_connect(connected)
        self.server.on_client_disconnect(disconnected)

    def clients(self) -> list[viser.ClientHandle]:
        """The open pages."""
        return list(self.server.get_clients().values())

    def place(self, client: viser.ClientHandle, pose: Array, fov: float, level: bool = True) -> None:
        """Moves a page's camera; if `level`, the page's controls turn it about the world's z axis."""
        with client.atomic():
            client.camera.up_direction = np.array([0.0, 0.0, 1.0]) if level else -pose[:3, 1]
            client.camera.position = pose[:3, 3]
            client.camera.look_at = pose[:3, 3] + 4.0 * pose[:3, 2]
            client.camera.fov = fov
        self.loop.touch(client)

    def follow(self, base_to_world: Array) -> None:
        """Moves the cameras of all pages behind the robot, with smoothing, which `stop_following` resets."""
        from twin.env.mujoco_renderer import ChaseCamera  # slow to import

        if self._chase is None:
            self._chase = ChaseCamera(base_to_world)
        pose = self._chase.follow(base_to_world)
        for client in self.clients():
            self.place(client, pose, client.camera.fov)

    def stop_following(self) -> None:
        self._chase = None

    # ---- controls, notices and jobs

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Holds the lock; wrong input, or a file that cannot be written, becomes a notice on all pages."""
        with self._lock:
            try:
                yield
            except (InputError, OSError) as error:
                self.notify("That did not work", str(error), "red")

    def on_click(self, button: Any, work: Callable[[viser.GuiEvent], None]) -> None:
        def clicked(event: viser.GuiEvent) -> None:
            with self.locked():
                work(event)

        button.on_click(clicked)

    def on_update(self, handle: Any, work: Callable[[], None]) -> None:
        def updated(_: viser.GuiEvent) -> None:
            with self.locked():
                work()

        handle.on_update(updated)

    def notify(self, title: str, body: str, color: Any = None, seconds: float | None = 12.0) -> None:
        """Shows a notice on all pages."""
        for client in self.clients():
            client.add_notification(title, body, auto_close_seconds=seconds, color=color)

    def submit(self, job: Callable[..., None], *given: Any) -> None:
        """Runs a job in the background, after all earlier ones; prints the traceback of an unexpected error."""
        self._jobs.submit(job, *given).add_done_callback(lambda future: future.cancelled() or future.result())

    def run(self, command: Sequence[str]) -> subprocess.CompletedProcess[str]:
        """Runs a command, for a job; returns its exit status and output. `close` ends it."""
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as self._child:
            if self.closed.is_set():
                self._child.terminate()
            output = self._child.communicate()
            return subprocess.CompletedProcess(command, self._child.returncode, *output)

    def close(self) -> None:
        self.closed.set()
        if self._child is not None:
            self._child.terminate()  # otherwise, this process would wait for the job
        self.loop.close()
        if self.driving is not None:
            self.driving.close()
        self._jobs.shutdown(wait=False, cancel_futures=True)
        with suppress(Exception):
            self.guarded.stop()


def camera_pose_of(client: viser.ClientHandle) -> Array:
    """camera_to_world of a page's camera, OpenCV axes, shape (4, 4)."""
    return pose_of(viser.transforms.SO3(client.camera.wxyz).as_matrix(), client.camera.position)
