"""The page of `twin view`: its tabs Look, Drive, Film and Path, and the content of its picture."""

from typing import TYPE_CHECKING, Any

import viser

from twin.env.episode_lighting import EpisodeLighting
from twin.loading import Twin
from twin.nerf.baked import BakedField
from twin.view.guarded_server import GuardedServer
from twin.view.layers import FILMED_CAMERAS, scene_layers
from twin.view.panels import FilmPanel, LightingPanel, PathPanel
from twin.view.picture_loop import Shot
from twin.view.viewer import Viewer, camera_pose_of

if TYPE_CHECKING:
    from twin.view.drive_panel import DrivePanel
    from twin.view.driving import DriveFacts, Driving


class Page:
    """The page of one scene."""

    def __init__(self, twin: Twin, field: BakedField, server: GuardedServer, lighting: EpisodeLighting) -> None:
        self.viewer = Viewer(twin, field, server, lighting, self.shot)
        self._drive: DrivePanel | None = None
        tabs = self.viewer.server.gui.add_tab_group()
        with tabs.add_tab("Look"):
            self.lightings = LightingPanel(self.viewer)
            self._build_layers()
        self._drive_tab = tabs.add_tab("Drive")
        with self._drive_tab:
            self._drive_note = self.viewer.server.gui.add_markdown("The robot is being loaded ...")
        with tabs.add_tab("Film"):
            self.film = FilmPanel(self.viewer, self.lightings)
        with tabs.add_tab("Path"):
            self._path = PathPanel(self.viewer)
        self.viewer.serve(self._moved)

    def _build_layers(self) -> None:
        viewer, gui = self.viewer, self.viewer.server.gui
        with gui.add_folder("Layers"):
            self._show_robot = gui.add_checkbox("robot and obstacles", True)
            viewer.on_update(self._show_robot, viewer.loop.touch)
            self._layer_boxes = []
            for layer in scene_layers(viewer.server.scene, viewer.twin, viewer.field):
                box = gui.add_checkbox(layer.name, False, hint=layer.hint)
                self._layer_boxes.append(box)

                def changed(box: Any = box, layer: Any = layer) -> None:
                    layer.show(box.value)
                    if layer.name == FILMED_CAMERAS:
                        self.film.listen_to_clicks(box.value)
                    viewer.loop.touch()

                viewer.on_update(box, changed)

    def _moved(self, client: viser.ClientHandle) -> None:
        self.film.moved(client)
        self.viewer.loop.touch(client)

    def shot(self, client: viser.ClientHandle) -> Shot:
        """The present content of a page."""
        viewer, drive = self.viewer, self._drive
        film, driving = self.film.frame(), viewer.driving
        objects = driving.objects() if driving is not None and self._show_robot.value else None
        has_handles = drive is not None and bool(drive.gizmos)
        has_layers = has_handles or bool(self._path.nodes) or any(box.value for box in self._layer_boxes)
        return Shot(camera_pose_of(client), client.camera.fov, viewer.lighting, objects, has_layers, film)

    def add_driving(self, driving: "Driving") -> None:
        """Shows the robot, and the controls that drive it."""
        from twin.view.drive_panel import DrivePanel  # needs dm_control, and is slow to import

        viewer = self.viewer
        viewer.picture.add_objects(driving.world, driving.obstacles.pool)
        self._drive_note.visible = False
        with self._drive_tab:
            self._drive = DrivePanel(viewer, self.film, driving)
        viewer.driving = driving
        driving.set_lighting(viewer.lighting)
        driving.reset()
        viewer.loop.touch()

    def no_driving(self, why: str) -> None:
        """Shows why the scene cannot be driven."""
        self._drive_note.content = why

    def drove(self, facts: "DriveFacts") -> None:
        """Shows the state of the drive after a control step or a reset; called on several threads."""
        if self._drive is not None:
            self._drive.drove(facts)

    def drive_failed(self, error: Exception) -> None:
        """Shows why a drive has ended with an error."""
        if self._drive is not None:
            self._drive.failed(error)
