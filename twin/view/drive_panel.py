"""The page's controls that drive the robot and place obstacles, and its display of the drive's state."""

import time
import traceback
from collections import deque
from collections.abc import Iterable

import numpy as np
import viser

from twin.config import OBSTACLE_KINDS
from twin.errors import InputError, join_names
from twin.report.drive_video import CAUSE_TEXT, draw_curves
from twin.report.video_layout import ACCENT, AMBER
from twin.types import Image
from twin.view.driving import KEYS_DRIVER, DriveFacts, Driving
from twin.view.panels import FilmPanel
from twin.view.viewer import Viewer, camera_pose_of

_HISTORY = 100  # control steps in the plot of torques
_PLOT_SIZE = 320, 150  # [px]
_FACTS_PERIOD = 0.24  # [s] between two updates of the panel's facts
_OBSTACLE_AHEAD = 4.0  # [m] in front of the camera, where a new obstacle is put


class DrivePanel:
    """The folders "Husky" and "Obstacles"."""

    def __init__(self, viewer: Viewer, film: FilmPanel, driving: Driving) -> None:
        self._viewer, self._film, self._driving = viewer, film, driving
        self.gizmos: dict[str, viser.TransformControlsHandle] = {}
        """Handles by which obstacles are dragged, by the obstacle's name."""
        self._torques: deque[tuple[float, float, float]] = deque(maxlen=_HISTORY)
        self._facts_shown = 0.0
        gui = viewer.server.gui
        folders = [gui.add_folder(name, visible=False) for name in ("Husky", "Obstacles")]
        with folders[0]:
            self._driver = gui.add_dropdown("driver", tuple(driving.drivers))
            viewer.on_update(self._driver, self._choose_driver)
            self._run_button = gui.add_button("Start driving")
            viewer.on_click(self._run_button, lambda event: self._toggle_drive())
            viewer.on_click(gui.add_button("Back to the start"), lambda event: self._restart())
            self._behind = gui.add_checkbox("follow the robot", True)
            self._facts = gui.add_markdown("")
            self._robot_image = gui.add_image(np.zeros((180, 320, 3), np.uint8), label="the robot's picture")
            self._plot = gui.add_image(
                _plot([]), label="torque at the wheels [N m], last 100 control steps", format="png"
            )
        with folders[1]:
            self._kind = gui.add_dropdown("kind", OBSTACLE_KINDS)
            add = gui.add_button("Add in front of the camera")
            viewer.on_click(add, self._add_obstacle)
            viewer.on_click(gui.add_button("Remove all"), lambda event: self._remove_obstacles())
            self._obstacle_text = gui.add_markdown("")
        for folder in folders:
            folder.visible = True
        self._show_obstacles()

    def _choose_driver(self) -> None:
        try:
            self._driving.choose(self._driver.value)
        finally:
            self._show_running()

    def _toggle_drive(self) -> None:
        if self._driving.running:
            self._driving.pause()
        else:
            self._film.end()
            self._driving.start()
        self._show_running()

    def _restart(self) -> None:
        try:
            self._driving.reset()
        finally:
            if not self._driving.running:
                self._show_running()
        self._viewer.stop_following()

    def _show_running(self) -> None:
        running = self._driving.running
        by_keys = running and self._driving.driver == KEYS_DRIVER
        self._viewer.guarded.set_driving(by_keys)
        self._run_button.label = "Stop" if running else "Start driving"
        if by_keys:
            text = "W ahead, S back, A and D turn. If the keys do nothing, click the picture."
            self._viewer.notify("W A S D", text, seconds=6.0)

    def drove(self, facts: DriveFacts) -> None:
        """Shows the state of the drive after a control step or a reset; called on several threads."""
        driving = self._driving
        if self._torques and facts.time < self._torques[-1][0]:  # a new drive
            self._torques.clear()
        self._torques.append((facts.time, float(facts.torque[0]), float(facts.torque[1])))
        if driving.running and self._behind.value and self._film.index is None:
            self._viewer.follow(facts.base_to_world)
        self._viewer.loop.touch()
        now = time.monotonic()
        if now - self._facts_shown >= _FACTS_PERIOD or not driving.running or facts.cause:
            self._facts_shown = now
            self._robot_image.image = facts.image.repeat(2, 0).repeat(2, 1)  # the panel does not enlarge it
            self._facts.content = drive_table(facts)
            self._plot.image = _plot(self._torques)
        if facts.cause:
            text = CAUSE_TEXT[facts.cause]
            if facts.cause == "collision":
                text += f" with {join_names(facts.touched, 2)}"
            color = "green" if facts.cause == "goal" else "orange"
            self._viewer.notify("The drive has ended", f"{text} after {facts.progress:.1f} m", color)
            self._show_running()

    def failed(self, error: Exception) -> None:
        """Shows the error that has ended the drive."""
        text = str(error)
        if not isinstance(error, InputError):
            traceback.print_exception(error)
            text = f"{type(error).__name__}: {error}"
        self._viewer.notify("The drive has stopped", text, "red")
        self._show_running()

    # ---- obstacles

    def _add_obstacle(self, event: viser.GuiEvent) -> None:
        kind = self._kind.value
        name = self._driving.obstacles.free(kind)
        if name is None:
            raise InputError(f"all obstacles of the kind {kind} are in the scene already; press Remove all")
        if event.client is None:
            return
        pose = camera_pose_of(event.client)
        ahead = pose[:2, 2] / max(float(np.linalg.norm(pose[:2, 2])), 1e-6)
        x, y = pose[:2, 3] + _OBSTACLE_AHEAD * ahead
        self._driving.obstacles.put(name, float(x), float(y), float(np.arctan2(ahead[1], ahead[0])))
        self._driving.update_obstacles()
        self._show_obstacles()

    def _remove_obstacles(self) -> None:
        self._driving.obstacles.standing.clear()
        self._driving.update_obstacles()
        self._show_obstacles()

    def _show_obstacles(self) -> None:
        """Gives each standing obstacle a handle to drag it by."""
        standing = self._driving.obstacles.standing
        for name in [name for name in self.gizmos if name not in standing]:
            self.gizmos.pop(name).remove()
        for name in standing:
            if name not in self.gizmos:
                self.gizmos[name] = self._gizmo(name)
        self._show_obstacle_text()
        self._viewer.loop.touch()

    def _gizmo(self, name: str) -> viser.TransformControlsHandle:
        driving = self._driving
        x, y, yaw = driving.obstacles.pose(name)
        gizmo = self._viewer.server.scene.add_transform_controls(
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
            with self._viewer.locked():
                if name not in driving.obstacles.standing:
                    return
                (x, y, _), (w, _, _, z) = event.target.position, event.target.wxyz
                driving.obstacles.put(name, float(x), float(y), float(2.0 * np.arctan2(z, w)))
                driving.update_obstacles()
                if event.phase == "end":
                    event.target.position = (x, y, driving.ground_height(float(x), float(y)) + 0.05)
                    self._show_obstacle_text()
                self._viewer.loop.touch()

        gizmo.on_update(dragged)
        return gizmo

    def _show_obstacle_text(self) -> None:
        text = self._driving.obstacles.toml()
        note = "Drag an obstacle by its arrows, turn it by its ring."
        keep = f" To keep them, copy this into `scene.toml`:\n```toml\n{text}\n```" if text else ""
        self._obstacle_text.content = note + keep


def _plot(torques: Iterable[tuple[float, float, float]]) -> Image:
    """Plots torques of the last control steps, given as (time [s], left, right [N m])."""
    width, height = _PLOT_SIZE
    canvas = np.zeros((height, width, 3), np.uint8)
    times, left, right = np.array(list(torques) or [(0.0, 0.0, 0.0)]).T
    rows = [("left", left, AMBER), ("right", right, ACCENT)]
    draw_curves(canvas, (0, 0, width, height), rows, times, len(times) - 1, 13)
    return canvas


def drive_table(facts: DriveFacts) -> str:
    """The state of a drive as a Markdown table."""
    (v, yaw), (left, right), (amps_left, amps_right) = facts.command, facts.torque, facts.current
    rows = [
        ("time", f"{facts.time:.1f} s, {facts.rate:.1f}× real time"),
        ("command", f"{v:+.2f} m/s, {yaw:+.2f} rad/s"),
        ("actual", f"{facts.speed:+.2f} m/s, {facts.yaw_rate:+.2f} rad/s"),
        ("torque left, right", f"{left:+.1f}, {right:+.1f} N m"),
        ("current left, right", f"{amps_left:+.1f}, {amps_right:+.1f} A"),
        ("progress, cross-track error", f"{facts.progress:.1f} m, {facts.cross_track:+.2f} m"),
        ("trust, 0 to 1", f"{facts.trust:.2f}"),
        ("contacts", join_names(facts.touched, 2) if facts.touched else "none"),
    ]
    return "| | |\n|---|---|\n" + "\n".join(f"| {name} | {value} |" for name, value in rows)
