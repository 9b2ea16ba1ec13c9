"""Pictures of a scene from free camera poses with `mujoco_warp`'s ray caster; needs no OpenGL and no display.

The scene is rendered twice: visual geometry (ground, visual mesh, robot), and the convex collision parts with their
ids. Visible parts are blended over the first picture, half transparent and with outlines. A *shot* is a robot
configuration (MuJoCo's qpos; None for the initial one) and a camera pose.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.config import ObstacleConfig
from twin.env.obstacle_models import OBSTACLE_GROUP
from twin.env.obstacles import add_obstacles, place
from twin.env.route_follower import RecordedDrive
from twin.geometry.cameras import Cameras, opencv_to_mujoco
from twin.geometry.poses import look_at
from twin.mjcf.world import World, arc_lengths, point_at
from twin.types import Array, Image

_FOVY = 50.0  # [°]
_BEHIND, _ABOVE, _AHEAD = 3.0, 1.6, 2.0  # [m] camera position and look-at point relative to the robot
_SMOOTHING = 0.15  # low-pass gain of the camera heading per control step (0.1 s)
_VISUAL_GROUPS = [0, 1, 2, OBSTACLE_GROUP]
_PART_GROUPS = [3]
_PART_ALPHA = 0.45
_EDGE_RGB = (20, 20, 30)
# Parts lie close to the visual mesh; a part up to this far behind the visible surface counts as visible.
_OCCLUSION_TOLERANCE = 0.6  # [m]


class SceneCamera:
    """Renders a world from free camera poses."""

    def __init__(
        self,
        world: World,
        size: tuple[int, int],
        obstacles: Sequence[ObstacleConfig] = (),
    ) -> None:
        """Compiles the scene with obstacles and a free camera for pictures of `size` (width, height) [px]."""
        import mujoco_warp as mjw  # slow to import

        self._mjw = mjw
        spec = mujoco.MjSpec.from_file(str(world.model_path))
        self._obstacles = tuple(obstacles)
        add_obstacles(spec, self._obstacles, world)
        spec.worldbody.add_camera(name="free", fovy=_FOVY)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.size = size
        self._camera = self.model.camera("free").id
        mujoco.mj_forward(self.model, self.data)
        self._device_model = mjw.put_model(self.model)
        self._device_data = mjw.put_data(self.model, self.data)
        common = {"cam_res": size, "cam_active": ["free"], "render_rgb": True, "render_depth": True}
        self._visual = mjw.create_render_context(
            self.model,
            enabled_geom_groups=_VISUAL_GROUPS,
            render_skybox=True,
            use_shadows=True,
            enable_backface_culling=False,
            **common,
        )
        self._parts = None
        if np.isin(self.model.geom_group, _PART_GROUPS).any():
            self._parts = mjw.create_render_context(
                self.model, enabled_geom_groups=_PART_GROUPS, render_seg=True, **common
            )
        # Warp compiles kernels at first launch. Compiling two at once in two threads of a process corrupts them
        # (observed: pictures without ground), so each pass runs once here, in sequence.
        for context in (self._visual, self._parts):
            if context is not None:
                self._render_pass(context)

    def render(self, qpos: Array, camera_to_world: Array, time: float = 0.0) -> Image:
        """Renders the scene with the robot at `qpos` at a time [s] from an OpenCV camera pose, shape (h, w, 3)."""
        self.data.qpos[:] = qpos
        place(self._obstacles, self.data, time)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        pose = opencv_to_mujoco(camera_to_world)
        self.data.cam_xpos[self._camera] = pose[:3, 3]
        self.data.cam_xmat[self._camera] = pose[:3, :3].ravel()
        device = self._device_data
        for name in ("geom_xpos", "cam_xpos", "light_xpos", "light_xdir"):
            getattr(device, name).assign(getattr(self.data, name)[None].astype(np.float32))
        for name in ("geom_xmat", "cam_xmat"):
            getattr(device, name).assign(getattr(self.data, name).reshape(1, -1, 3, 3).astype(np.float32))
        if self._parts is None:
            return self._render_pass(self._visual)[0]
        # Warp's CPU kernels run on one thread each and release the GIL.
        with ThreadPoolExecutor(2) as pool:
            (rgb, depth, _), (part_rgb, part_depth, identity) = pool.map(self._render_pass, (self._visual, self._parts))
        return blend_parts(rgb, depth, part_rgb, part_depth, identity)

    def _render_pass(self, context) -> tuple[Image, Array, NDArray[np.int32]]:
        self._mjw.refit_bvh(self._device_model, self._device_data, context)
        self._mjw.render(self._device_model, self._device_data, context)
        width, height = self.size
        packed = context.rgb_data.numpy()[0].reshape(height, width)
        rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.uint8)
        depth = context.depth_data.numpy()[0].reshape(height, width)
        identity = context.seg_data.numpy()[0, : 1 if context.seg_data.shape[1] == 1 else None, 0]
        return rgb, depth, identity.reshape(height, width) if identity.size > 1 else np.full((height, width), -1)


def blend_parts(rgb: Image, depth: Array, part_rgb: Image, part_depth: Array, identity: NDArray) -> Image:
    """Blends visible collision parts, with outlines, over a picture (h, w, 3); z-depths [m] have shape (h, w).

    `depth` is 0 where nothing is hit; `identity` is the id of the visible part, −1 for none.
    """
    visible = (identity >= 0) & ((depth <= 0) | (part_depth <= depth + _OCCLUSION_TOLERANCE))
    edge = np.zeros_like(visible)
    edge[:, 1:] |= identity[:, 1:] != identity[:, :-1]
    edge[1:] |= identity[1:] != identity[:-1]
    out = rgb.astype(np.float32)
    out[visible] = (1 - _PART_ALPHA) * out[visible] + _PART_ALPHA * part_rgb[visible]
    line = edge & visible
    out[line] = 0.4 * out[line] + 0.6 * np.array(_EDGE_RGB)
    return out.astype(np.uint8)


def chase_poses(base_to_world: Array) -> Array:
    """Camera poses (OpenCV) behind and above a moving robot with low-passed heading, shape (k, 4, 4)."""
    forward = base_to_world[:, :2, 0]
    direction = forward[0] / np.linalg.norm(forward[0])
    poses = []
    for base, ahead in zip(base_to_world, forward, strict=True):
        direction = direction + _SMOOTHING * (ahead - direction)
        direction = direction / np.linalg.norm(direction)
        along = np.array([*direction, 0.0])
        eye = base[:3, 3] - _BEHIND * along + [0.0, 0.0, _ABOVE]
        poses.append(look_at(eye, base[:3, 3] + _AHEAD * along + [0.0, 0.0, 0.2]))
    return np.array(poses)


def frame_indices(count: int, every: int) -> list[int]:
    indices = list(range(0, count, every))
    return indices if indices[-1] == count - 1 else [*indices, count - 1]


# ---- shots

Shot = tuple[Array | None, Array]

_OVERVIEW_BEHIND, _OVERVIEW_ABOVE, _OVERVIEW_AHEAD = 9.0, 7.0, 10.0  # [m] camera position and look-at point
_OVERVIEW_POSITIONS = (0.0, 0.45)  # of the overview, as shares of the route length


def overview_pose(route: Array, s: float) -> Array:
    """Camera pose behind and above the point at arc length s [m] of a route (m, 3), looking along it."""
    ahead, here = point_at(route, s + _OVERVIEW_AHEAD), point_at(route, s)
    if np.linalg.norm((ahead - here)[:2]) < 1e-6:  # at the end of the route: use its last heading
        here = point_at(route, s - 1.0)
    along = (ahead - here) * [1.0, 1.0, 0.0]
    along /= np.linalg.norm(along)
    return look_at(here - _OVERVIEW_BEHIND * along + [0.0, 0.0, _OVERVIEW_ABOVE], here + _OVERVIEW_AHEAD * along)


def route_shots(route: Array) -> list[Shot]:
    """Shots of the scene from above the route's start and from further along; the robot is at its initial pose."""
    length = float(arc_lengths(route)[-1])
    return [(None, overview_pose(route, share * length)) for share in _OVERVIEW_POSITIONS]


def camera_shots(cameras: Cameras) -> list[Shot]:
    """Shots from two of the filmed cameras, for a scene without a route."""
    n = len(cameras)
    return [(None, cameras.camera_to_world[i]) for i in dict.fromkeys((n // 4, 3 * n // 4))]


def chase_shots(drive: RecordedDrive, every: int) -> list[Shot]:
    """Shots of a drive from behind, every `every` control steps and at the last one."""
    poses = chase_poses(drive.base_to_world)
    return [(drive.qpos[i], poses[i]) for i in frame_indices(len(drive.times), every)]


def render_shots(world: World, shots: list[Shot], size: tuple[int, int]) -> Iterator[Image]:
    """Renders shots in order. All share one camera, because building it takes seconds."""
    if not shots:
        return
    camera = SceneCamera(world, size)
    data = mujoco.MjData(camera.model)
    if camera.model.nkey:
        mujoco.mj_resetDataKeyframe(camera.model, data, 0)
    for qpos, pose in shots:
        yield camera.render(data.qpos if qpos is None else qpos, pose)
