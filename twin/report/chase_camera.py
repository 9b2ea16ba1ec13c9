"""Pictures of a drive from a chase camera behind the robot. No OpenGL and no display.

`mujoco_warp`'s ray caster draws the scene twice: as it looks (ground, visual mesh, robot), and the convex collision
parts alone with their identities. The parts are blended over the picture, half transparent and with outlines, wherever
they are not hidden behind what is seen.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.config import ObstacleConfig
from twin.env.drivers import FollowedDrive
from twin.env.obstacle_models import OBSTACLE_GROUP
from twin.env.obstacles import add_obstacles, place
from twin.geometry.cameras import Cameras, opencv_to_mujoco
from twin.geometry.poses import look_at
from twin.mjcf.world import World, arc_lengths, point_at
from twin.types import Array, Image

_FOVY = 50.0  # [°]
_BEHIND, _ABOVE, _AHEAD = 3.0, 1.6, 2.0  # [m] of the chase camera, and of the point it looks at
_SMOOTHING = 0.15  # share of the way the camera turns after the robot per 0.1 s
_LOOK_GROUPS = [0, 1, 2, OBSTACLE_GROUP]
_PART_GROUPS = [3]
_PART_ALPHA = 0.45
_EDGE_RGB = (20, 20, 30)
# A part hugs the visual mesh: what lies this far behind the visible surface still counts as seen [m].
_SKIN = 0.6


class SceneCamera:
    """Renders a world from free camera poses."""

    def __init__(
        self,
        world: World,
        size: tuple[int, int],
        obstacles: Sequence[ObstacleConfig] = (),
    ) -> None:
        """
        Args:
            world: The scene.
            size: Width, height of the pictures [px].
            obstacles: What stands or moves in it besides.
        """
        import mujoco_warp as mjw  # slow to import, and only needed where pictures are made
        import warp as wp

        self._mjw, self._wp = mjw, wp
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
        self._looks = mjw.create_render_context(
            self.model,
            enabled_geom_groups=_LOOK_GROUPS,
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
        # Warp builds a pass's kernel at its first launch, and two built at once in two threads of one process mix up
        # (seen as pictures without any ground); so each pass runs once here, one after the other.
        for context in (self._looks, self._parts):
            if context is not None:
                self._draw(context)

    def render(self, qpos: Array, camera_to_world: Array, time: float = 0.0) -> Image:
        """One picture of the world with the robot at `qpos` at a time [s], from an OpenCV pose. Shape (h, w, 3)."""
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
            return self._draw(self._looks)[0]
        # Warp's CPU kernels run on one thread each and release the GIL.
        with ThreadPoolExecutor(2) as pool:
            (rgb, depth, _), (part_rgb, part_depth, identity) = pool.map(self._draw, (self._looks, self._parts))
        return overlay(rgb, depth, part_rgb, part_depth, identity)

    def _draw(self, context) -> tuple[Image, Array, NDArray[np.int32]]:
        self._mjw.refit_bvh(self._device_model, self._device_data, context)
        self._mjw.render(self._device_model, self._device_data, context)
        width, height = self.size
        packed = context.rgb_data.numpy()[0].reshape(height, width)
        rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(np.uint8)
        depth = context.depth_data.numpy()[0].reshape(height, width)
        identity = context.seg_data.numpy()[0, : 1 if context.seg_data.shape[1] == 1 else None, 0]
        return rgb, depth, identity.reshape(height, width) if identity.size > 1 else np.full((height, width), -1)


def overlay(rgb: Image, depth: Array, part_rgb: Image, part_depth: Array, identity: NDArray) -> Image:
    """Blends collision parts over a picture, with outlines, where they are not hidden.

    Args:
        rgb: Shape (h, w, 3).
        depth: z-depth of the picture [m], 0 where nothing is; shape (h, w).
        part_rgb: The parts alone, shape (h, w, 3).
        part_depth: Their z-depth [m], shape (h, w).
        identity: Which part is seen, −1 for none, shape (h, w).
    """
    seen = (identity >= 0) & ((depth <= 0) | (part_depth <= depth + _SKIN))
    edge = np.zeros_like(seen)
    edge[:, 1:] |= identity[:, 1:] != identity[:, :-1]
    edge[1:] |= identity[1:] != identity[:-1]
    out = rgb.astype(np.float32)
    out[seen] = (1 - _PART_ALPHA) * out[seen] + _PART_ALPHA * part_rgb[seen]
    line = edge & seen
    out[line] = 0.4 * out[line] + 0.6 * np.array(_EDGE_RGB)
    return out.astype(np.uint8)


def chase_poses(base_to_world: Array) -> Array:
    """Camera poses (OpenCV) behind and above a moving robot, shapes (k, 4, 4); its heading is low-passed."""
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
    """0, every, 2·every, ... and count − 1."""
    indices = list(range(0, count, every))
    return indices if indices[-1] == count - 1 else [*indices, count - 1]


# ---- Pictures of what MuJoCo loads: a bird's eye view of the place, and the drive from behind.
#
# A *shot* is the robot's configuration (MuJoCo's qpos) and the pose of the camera that sees it.

Shot = tuple[Array | None, Array]

_BACK, _UP, _OVERVIEW_AHEAD = (
    9.0,
    7.0,
    10.0,
)  # [m] behind and above the place looked from, and ahead of it where we look
_STATIONS = (0.0, 0.45)  # shares of the route where the bird is


def bird_pose(route: Array, s: float) -> Array:
    """camera_to_world behind and above the point at arc length s [m] of a route (m, 3), looking along it."""
    ahead, here = point_at(route, s + _OVERVIEW_AHEAD), point_at(route, s)
    if np.linalg.norm((ahead - here)[:2]) < 1e-6:  # at the end of the route: look as the last piece goes
        here = point_at(route, s - 1.0)
    along = (ahead - here) * [1.0, 1.0, 0.0]
    along /= np.linalg.norm(along)
    return look_at(here - _BACK * along + [0.0, 0.0, _UP], here + _OVERVIEW_AHEAD * along)


def route_shots(route: Array) -> list[Shot]:
    """The place from above its start and from further along, the robot where the scene puts it."""
    length = float(arc_lengths(route)[-1])
    return [(None, bird_pose(route, share * length)) for share in _STATIONS]


def camera_shots(cameras: Cameras) -> list[Shot]:
    """The place as two of the cameras saw it, for a scene without a route."""
    n = len(cameras)
    return [(None, cameras.camera_to_world[i]) for i in dict.fromkeys((n // 4, 3 * n // 4))]


def chase_shots(drive: FollowedDrive, every: int) -> list[Shot]:
    """The drive from behind, every few control steps and at its last instant."""
    poses = chase_poses(drive.base_to_world)
    return [(drive.qpos[i], poses[i]) for i in frame_indices(len(drive.times), every)]


def pictures_of(world: World, shots: list[Shot], size: tuple[int, int]) -> Iterator[Image]:
    """Draws shots in order, solid parts over what is seen. One camera serves all: building it takes seconds."""
    if not shots:
        return
    camera = SceneCamera(world, size)
    data = mujoco.MjData(camera.model)
    if camera.model.nkey:
        mujoco.mj_resetDataKeyframe(camera.model, data, 0)
    for qpos, pose in shots:
        yield camera.render(data.qpos if qpos is None else qpos, pose)
