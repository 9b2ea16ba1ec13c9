"""Films of the simulated reality: trajectory of the camera, traffic, exposure, sensor noise and video encoding.

A *film* is a sequence of frames at a fixed rate under one lighting; the true pose of every frame is known. Every film
has its own speed, lateral wander and shake, so that no two films share a viewpoint.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import av
import cv2
import mujoco
import mujoco_warp
import numpy as np
from av.video.reformatter import Colorspace
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.files import atomic_path
from twin.geometry.cameras import evenly_spaced, opencv_to_mujoco, pixel_grid, unproject
from twin.geometry.mesh_rays import Surface
from twin.geometry.poses import pose_of
from twin.reality import SEED, primitives, true_world
from twin.reality.lighting import Lighting
from twin.reality.place_objects import DrivenLine, KnownPlace, PlaceObject
from twin.reality.place_spec import PassSpec, PlaceSpec
from twin.reality.primitives import MeshPart
from twin.reality.rasterizer import PlaceRenderer
from twin.reality.sky import apply_haze
from twin.reality.street_furniture import VEHICLES, add_vehicle, vehicle_size
from twin.reality.true_world import StretchRenderer, is_long
from twin.runtime import track
from twin.types import Array, Array32
from twin.warp_runtime import wp

CAMERA_HEIGHT = 1.2  # [m] mean height of the lens above the ground, from which it deviates by less than 1 cm
OUT = PassSpec("out", 0.0, False)
_SIDE_SPEED = 1.0  # [m/s] highest speed in films of side roads
_SIDE_SPACING = 0.5  # [m] largest distance between frames there
_SKY_DISTANCE = 1.0e4  # [m] assumed depth of the sky, for the motion of its pixels
_BT709 = 1  # FFmpeg's AVCOL_SPC_BT709
_HD_HEIGHT = 720  # [px] films of at least this height are written as BT.709, as which they are played
_OPEN_SAMPLES = 3  # instants over which a row's exposure is averaged


@dataclass(frozen=True)
class FilmingPlan:
    """Segment of the road to film, and the camera's settings."""

    lightings: tuple[str, ...] = ("sun", "overcast", "night")
    start: float = 0.0
    """Station where the segment begins [m]."""
    length: float = 60.0
    """Length of the segment along the center line [m]."""
    speed: float = 2.0
    """Mean speed [m/s]."""
    fps: int = 4
    width: int = 640
    height: int = 360
    samples: int = 2
    """Rays per pixel along each axis of the image."""
    oversize: float = 1.0
    """Ratio of the size at which a frame is rendered to the film's size; the frame is then shrunk."""
    crf: int = 29
    """Constant rate factor of H.264; less is better quality."""
    camera_height: float = CAMERA_HEIGHT
    """Mean height of the lens above the ground [m]."""
    pitch: float = float(np.deg2rad(8.0))
    """Mean pitch of the camera, downwards [rad]."""
    fov: float = float(np.deg2rad(85.0))
    """Horizontal field of view [rad]."""
    shake: float = 1.0
    """Amplitude of the camera's rotations and vertical motion; 1 is the amplitude on a cart."""
    readout: float = 0.0
    """Time from the readout of a frame's first row to that of its last one [s]; 0 for a global shutter."""
    passes: tuple[PassSpec, ...] = (OUT,)
    """Passes along the road; each is filmed under every lighting."""

    @staticmethod
    def of(spec: PlaceSpec) -> "FilmingPlan":
        """The plan of a sampled place's films, from its description."""
        film = spec.film
        return FilmingPlan(
            lightings=tuple(light.name for light in spec.lights),
            length=spec.line.length,
            speed=film.speed,
            fps=film.fps,
            width=film.size[0],
            height=film.size[1],
            samples=1,  # 1.5² = 2.25 rays per pixel of the film with this oversize; the campus road's films have 4
            oversize=1.5,
            crf=24,
            camera_height=film.camera_height,
            pitch=film.pitch,
            fov=film.fov,
            shake=film.shake,
            passes=film.passes,
        )

    def side(self, name: str, length: float) -> "FilmingPlan":
        """The plan of the films of a side road, along `length` [m] of its `side_roads.SideLine`.

        At a turn of a few meters' radius, a camera has to be slow.
        """
        speed = min(self.speed, _SIDE_SPEED)
        fps = int(np.ceil(speed / _SIDE_SPACING))
        return replace(self, start=0.0, length=length, speed=speed, fps=fps, passes=(PassSpec(name, 0.0, False),))

    @property
    def intrinsics(self) -> Array:
        """fx, fy, cx, cy [px], shape (4,)."""
        focal = self.width / 2 / np.tan(self.fov / 2)
        return np.array([focal, focal, self.width / 2, self.height / 2])


def smooth_noise(rng: np.random.Generator, times: Array, period: float) -> Array:
    """Sum of three sines with periods around `period` [s] and unit standard deviation; shape as `times`."""
    rates = 2 * np.pi / (period * rng.uniform(0.6, 1.7, 3))
    return np.sin(times[:, None] * rates + rng.uniform(0, 2 * np.pi, 3)).sum(1) / np.sqrt(1.5)


def film_name(lighting: str, one: PassSpec) -> str:
    """The name of the film of a pass under a lighting."""
    return lighting if one.name == OUT.name else f"{lighting}_{one.name}"


def trajectory(
    plan: FilmingPlan, route: DrivenLine, film: str, one: PassSpec = OUT, later: float = 0.0
) -> tuple[Array, Array]:
    """Times [s], shape (n,), of the film named `film`, and camera_to_world (OpenCV axes), shape (n, 4, 4).

    The poses are those at a time `later` [s] than the times.
    """
    rng = np.random.default_rng([SEED, 11, sum(map(ord, film))])
    speed = plan.speed * rng.uniform(0.93, 1.07)
    frames = round(plan.length / speed * plan.fps) + 1
    times = np.arange(frames) / plan.fps
    duration = times[-1]
    times = times + later
    progress = times / duration
    station = plan.start + plan.length * progress + 0.18 * smooth_noise(rng, times, 6.0) * np.sin(np.pi * progress)
    lateral = np.clip(rng.uniform(-0.12, 0.12) + 0.12 * smooth_noise(rng, times, 9.0), -0.3, 0.3)
    if one.backwards:
        station = 2 * plan.start + plan.length - station
    lateral = lateral + one.lateral
    xy = route.at(station, lateral)
    lift = 0.004 * plan.shake * smooth_noise(rng, times, 1.1)
    position = np.concatenate([xy, (route.ground_height(xy) + plan.camera_height + lift)[:, None]], 1)
    # Heading: direction of the center line 0.6 m ahead plus the slope of the lateral wander.
    drift = np.gradient(lateral, station)
    ahead, turned = (-0.6, np.pi) if one.backwards else (0.6, 0.0)
    yaw = route.heading(station + ahead) + turned + np.arctan(drift)
    yaw = yaw + np.deg2rad(0.9) * plan.shake * smooth_noise(rng, times, 2.3)
    pitch = plan.pitch + np.deg2rad(0.5) * plan.shake * smooth_noise(rng, times, 1.3)
    roll = np.deg2rad(0.6) * plan.shake * smooth_noise(rng, times, 1.7)
    poses = np.stack([_pose(p, a, b, c) for p, a, b, c in zip(position, yaw, pitch, roll, strict=True)])
    return times - later, poses


def _pose(position: Array, yaw: float, pitch: float, roll: float) -> Array:
    """camera_to_world for heading `yaw`, downward `pitch` and clockwise `roll` [rad]."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return pose_of(np.stack([c * right + s * down, -s * right + c * down, forward], 1), position)


class Renderer:
    """Renders the place under one lighting from any pose with `mujoco_warp`'s ray tracer."""

    def __init__(self, lighting: str, place: KnownPlace, plan: FilmingPlan, movers: "Sequence[Mover]" = ()) -> None:
        self._movers = movers
        spec = true_world.world_spec(lighting, place, {one.name: one.part for one in movers})
        camera = spec.camera("film")
        camera.fovy = float(np.rad2deg(2 * np.arctan(plan.height / 2 / plan.intrinsics[1])))
        model = spec.compile()
        del spec, camera  # frees the second copy of all meshes and textures
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self._host = model, data
        self._out = (plan.width, plan.height)
        self._size = (round(plan.oversize * plan.width), round(plan.oversize * plan.height))
        with wp.ScopedDevice("cpu"):
            self._model = mujoco_warp.put_model(model)
            self._data = mujoco_warp.put_data(model, data)
            self._context = mujoco_warp.create_render_context(
                model,
                cam_res=self._size,
                render_rgb=True,
                render_depth=True,
                render_seg=False,
                use_shadows=any(shadow for _, _, shadow in place.lightings[lighting].suns),
                enabled_geom_groups=[0, 1],
                render_skybox=True,
                enable_backface_culling=False,
                shadow_light_fraction=0.0,
                samples_per_pixel=plan.samples,
                enable_specular=False,
            )

    def move_to(self, time: float) -> None:
        """Moves the movers to their poses at a time of the film [s]."""
        model, data = self._host
        for mover in self._movers:
            foot, yaw = mover.pose(time)
            body = model.body(mover.name).mocapid[0]
            data.mocap_pos[body] = foot
            data.mocap_quat[body] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        mujoco.mj_kinematics(model, data)
        with wp.ScopedDevice("cpu"):
            self._data.geom_xpos.assign(data.geom_xpos[None].astype(np.float32))
            self._data.geom_xmat.assign(data.geom_xmat.reshape(1, -1, 3, 3).astype(np.float32))
            mujoco_warp.refit_bvh(self._model, self._data, self._context)

    def __call__(self, camera_to_world: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """RGB (h, w, 3) in [0, 1] and z-depth (h, w) [m] for an OpenCV pose (4, 4).

        The depth belongs to the pixel's first ray and is 0 for the sky.
        """
        pose = opencv_to_mujoco(camera_to_world)
        width, height = self._size
        with wp.ScopedDevice("cpu"):
            self._data.cam_xpos.assign(pose[None, None, :3, 3].astype(np.float32))
            self._data.cam_xmat.assign(pose[None, None, :3, :3].astype(np.float32))
            mujoco_warp.render(self._model, self._data, self._context)
            rgb = wp.zeros((1, height, width), dtype=wp.vec3)
            mujoco_warp.get_rgb(self._context, 0, rgb)
            depth = self._context.depth_data.numpy().reshape(height, width).copy()
        light = rgb.numpy()[0].astype(np.float32)
        if self._size != self._out:
            light = cv2.resize(light, self._out, interpolation=cv2.INTER_AREA)
            depth = cv2.resize(depth, self._out, interpolation=cv2.INTER_NEAREST)
        return light, depth


def read_rows(
    light: Array32, depth: Array32, rays: Array32, intrinsics: Array, motion: Array, opened: float = 0.0
) -> Array32:
    """A picture (h, w, 3) by a rolling shutter: every row shows what the camera saw while the row was exposed.

    A point has the camera coordinates X in the middle of the readout, and X − f (ω × X + t) after the camera has moved
    by the fraction f of its motion (ω, t). For a pixel in a row that is read at that time, X is the point on the
    pixel's ray at the pixel's depth. The pixel gets the color of the middle picture at the projection of
    X + f (ω × X + t).

    Args:
        light: The picture in the middle of the readout, shape (h, w, 3).
        depth: z-depth [m], 0 = sky, shape (h, w).
        rays: Directions of the pixels in the camera's axes at depth 1, shape (h, w, 3).
        intrinsics: fx, fy, cx, cy [px].
        motion: Rotation vector [rad] and translation [m] of the camera over the readout, in its axes, shape (6,).
        opened: Time for which a row is exposed, as a share of the readout.
    """
    height = len(light)
    points = rays * np.where(depth > 0.0, depth, np.float32(_SKY_DISTANCE))[..., None]
    flow = np.cross(motion[:3], points) + motion[3:]
    rows = (np.arange(height) + 0.5) / height - 0.5
    fx, fy, cx, cy = intrinsics
    instants = _OPEN_SAMPLES if opened else 1
    total = np.zeros_like(light)
    for k in range(instants):
        share = rows + opened * ((k + 0.5) / instants - 0.5)
        at = points + share[:, None, None] * flow
        z = np.maximum(at[..., 2], 0.05)
        x, y = fx * at[..., 0] / z + cx - 0.5, fy * at[..., 1] / z + cy - 0.5
        total += cv2.remap(
            light, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    return total / np.float32(instants)


def motion_between(before: Array, after: Array, middle: Array) -> Array:
    """Rotation vector [rad] and translation [m] from pose `before` to `after`, in the axes of `middle`, shape (6,)."""
    turn = Rotation.from_matrix(middle[:3, :3].T @ after[:3, :3] @ before[:3, :3].T @ middle[:3, :3]).as_rotvec()
    return np.concatenate([turn, middle[:3, :3].T @ (after[:3, 3] - before[:3, 3])])


def sensor_image(
    rng: np.random.Generator, light: NDArray[np.float32], lighting: Lighting, exposure: float
) -> NDArray[np.uint8]:
    """Converts linear RGB (h, w, 3) to 8 bits: vignetting, exposure, white balance, highlight roll-off, noise."""
    height, width = light.shape[:2]
    y, x = np.mgrid[:height, :width]
    radius2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width / 2) ** 2
    signal = light * (lighting.exposure * exposure * (1.0 - 0.16 * radius2))[..., None] * np.asarray(lighting.gain)
    knee = 0.75  # signals above the knee roll off towards 1
    over = np.maximum(signal - knee, 0.0)
    signal = np.minimum(signal, knee) + (1.0 - knee) * (1.0 - np.exp(-over / (1.0 - knee)))
    sigma = lighting.noise * np.sqrt(0.35 + 1.3 * signal)
    signal = signal + sigma * rng.standard_normal(signal.shape)
    return (np.clip(signal, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def exposures(lighting: Lighting, times: Array) -> Array:
    """Relative exposure of each frame, which drifts slowly, as automatic exposure does."""
    rng = np.random.default_rng([SEED, 12, sum(map(ord, lighting.name))])
    return np.exp(lighting.drift * smooth_noise(rng, times, 11.0))


def film_pass(
    lighting: str,
    place: KnownPlace,
    plan: FilmingPlan,
    path: Path,
    one: PassSpec = OUT,
    traffic: bool = False,
    renderer: PlaceRenderer | None = None,
    line: DrivenLine | None = None,
) -> tuple[Array, Array]:
    """Writes the film of one pass under one lighting; returns its times (n,) [s] and poses (n, 4, 4).

    With `traffic`, walkers and cars move through the film; no other `renderer` than the default one shows them. The
    camera follows `line`, by default the place's driven line.
    """
    name, line = film_name(lighting, one), line or place.route
    times, poses = trajectory(plan, line, name, one)
    light = place.lightings[lighting]
    gains = exposures(light, times)
    rng = np.random.default_rng([SEED, 13, sum(map(ord, name))])
    moving = movers(place, name, times, poses) if traffic else []
    make = partial(Renderer, lighting, plan=plan, movers=moving)
    render: PlaceRenderer = renderer or (StretchRenderer(place, make) if is_long(place) else make(place))
    half = 0.5 * plan.readout
    begun, ended = (trajectory(plan, line, name, one, later)[1] for later in (-half, half))
    steps = track(list(zip(times, poses, gains, begun, ended, strict=True)), f"film {name}", unit="frame")
    rays = unproject(pixel_grid(plan.width, plan.height), plan.intrinsics)

    def frame(time: float, pose: Array, gain: float, before: Array, after: Array) -> NDArray[np.uint8]:
        here = render.at(pose) if isinstance(render, StretchRenderer) else render
        if isinstance(here, Renderer) and moving:
            here.move_to(time)
        ground = float(place.route.ground_height(pose[:2, 3]))
        rgb, depth = here(pose)
        seen = apply_haze(rgb, depth, rays, pose, light, ground)
        if plan.readout:
            seen = read_rows(seen, depth, rays.astype(np.float32), plan.intrinsics, motion_between(before, after, pose))
        return sensor_image(rng, seen, light, gain)

    write_video((frame(float(time), pose, float(gain), *ends) for time, pose, gain, *ends in steps), plan, path)
    return times, poses


def write_video(frames: Iterable[NDArray[np.uint8]], plan: FilmingPlan, path: Path) -> None:
    """Writes RGB frames (h, w, 3) as H.264; equal frames give equal files."""
    # x264's fast paths depend on the processor and on memory alignment; these settings make its output reproducible.
    options = {"crf": str(plan.crf), "preset": "slower", "threads": "1", "x264-params": "cpu-independent=1"}
    with atomic_path(path) as partial, av.open(str(partial), "w") as container:
        stream = container.add_stream("libx264", rate=plan.fps, options=options)
        stream.width, stream.height, stream.pix_fmt = plan.width, plan.height, "yuv420p"
        matrix = Colorspace.ITU709 if plan.height >= _HD_HEIGHT else Colorspace.ITU601
        if matrix == Colorspace.ITU709:
            stream.codec_context.colorspace = _BT709
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            container.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace=matrix)))
        container.mux(stream.encode())


def depth_maps(
    lighting: str, place: KnownPlace, plan: FilmingPlan, poses: Array
) -> tuple[NDArray[np.int64], NDArray[np.float16]]:
    """Indices (k,) of up to ten frames and their depth maps [m], shape (k, h, w).

    The maps have a quarter of the film's width and height, or a third if its height is not a multiple of four.
    """
    part = 4 if plan.height % 4 == 0 else 3
    small = replace(plan, width=plan.width // part, height=plan.height // part, samples=1, oversize=1.0)
    frames = evenly_spaced(len(poses), 10)
    if is_long(place):
        # One ray per pixel, as in the renderer, but at the mesh of the whole place; a renderer may have a part of it.
        whole = primitives.join([one.part for one in place.objects])
        surface = Surface(whole.vertices, whole.faces)
        rays = unproject(pixel_grid(small.width, small.height), small.intrinsics).reshape(-1, 3)
        maps = [surface.cast(np.tile(pose[:3, 3], (len(rays), 1)), rays @ pose[:3, :3].T) for pose in poses[frames]]
        return frames, np.maximum(np.stack(maps), 0.0).reshape(-1, small.height, small.width).astype(np.float16)
    render = Renderer(lighting, _colorless(place), small)
    return frames, np.stack([render(poses[k])[1] for k in frames]).astype(np.float16)


def _colorless(place: KnownPlace) -> KnownPlace:
    """The place with textures of one pixel, without sky and ambient occlusion: its depth is the same, and it is made
    faster.
    """
    names = {"atlas", *(one.texture for one in place.objects)} - {"lamp_glass", "windows_by_night", "windows_by_day"}
    pixel = np.zeros((1, 1, 3), np.uint8)
    lightings = {name: replace(light, occlusion=0.0, wet=0.0) for name, light in place.lightings.items()}
    return replace(
        place,
        textures=lambda: dict.fromkeys(sorted(names), pixel),
        lightings=lightings,
        sky=lambda _: np.zeros((6, 1, 3), np.uint8),
    )


# ---- traffic
#
# Walkers, moving cars, and parked cars that are absent in the last lighting. Only films have traffic; truth and real
# test have none. A twin should therefore contain none.

_WALKERS, _CARS, _PARKED = 3, 2, 4  # walkers and moving cars per film; parked cars
_WALKING_SPEED, _CAR_SPEED = (1.1, 1.7), (4.0, 8.0)  # ranges [m/s]
_MEETING_DISTANCE = (5.0, 12.0)  # [m] range of the distance ahead of the camera at which a walker crosses the road
_CROSSING = 9.0  # [m] a walker crosses from this lateral to its opposite
_OUT_OF_SIGHT = np.array([0.0, 0.0, -50.0])  # [m] foot of a mover that is not in the place
_CAR_LATERAL = 2.3  # [m] lateral of moving cars to the left of the filmed line; least distance from the camera's track
_PARKED_GAP = 1.6  # [m] from the filmed line to the nearer side of a parked car, on the right
_SKINS = ("red", "blue", "white", "dark", "green")


@dataclass(frozen=True)
class Mover:
    """A rigid object that moves during a film."""

    name: str
    part: MeshPart
    """Mesh with x ahead and z up, its foot at the origin."""
    pose: Callable[[float], tuple[Array, float]]
    """Foot point (3,) [m] and yaw [rad] at a time of the film [s]."""


def movers(place: KnownPlace, film: str, times: Array, cameras: Array) -> list[Mover]:
    """The walkers and cars that move during a film, always the same for a place and a film.

    Every walker crosses the road in front of the camera. The first car is oncoming; the others overtake the camera.
    Cars keep to the left of the line, or to the right of a camera in that lane.

    Args:
        film: Name of the film.
        times: Times of the frames [s], shape (n,).
        cameras: camera_to_world of the frames, shape (n, 4, 4).
    """
    rng = np.random.default_rng([SEED, 51, place.number, sum(map(ord, film))])
    station, lateral = place.route.project(cameras[:, :2, 3])
    beside = float(np.median(lateral))
    lane = _CAR_LATERAL if beside < 0.5 else beside - _CAR_LATERAL
    forward = 1.0 if station[-1] >= station[0] else -1.0
    length = place.route.length

    def camera_station(time: float) -> float:
        return float(np.interp(time, times, station))

    def pose(at: float, lateral: float, turn: float) -> tuple[Array, float]:
        if not 0.0 <= at <= length:
            return _OUT_OF_SIGHT, 0.0
        return place.spot(at, lateral), place.heading(at) + turn

    found = []
    for k in range(_WALKERS):
        meeting = times[0] + (k + rng.uniform(0.3, 0.7)) / _WALKERS * np.ptp(times)
        at = camera_station(meeting) + forward * rng.uniform(*_MEETING_DISTANCE)
        speed, side = rng.uniform(*_WALKING_SPEED), rng.choice([-1.0, 1.0])

        def walk(
            time: float, at: float = at, meeting: float = meeting, speed: float = speed, side: float = side
        ) -> tuple[Array, float]:
            lateral = speed * (time - meeting)
            return pose(at, side * lateral, side * 0.5 * np.pi) if abs(lateral) < _CROSSING else (_OUT_OF_SIGHT, 0.0)

        found.append(Mover(f"walker_{k}", _walker(place, rng), walk))
    for k in range(_CARS):
        meeting = times[0] + (k + rng.uniform(0.3, 0.7)) / _CARS * np.ptp(times)
        oncoming = k == 0
        speed = forward * rng.uniform(*_CAR_SPEED) * (-1.0 if oncoming else 1.0)
        at = camera_station(meeting)
        kind, skin = str(rng.choice(VEHICLES)), str(rng.choice(_SKINS))

        def drive(time: float, at: float = at, meeting: float = meeting, speed: float = speed) -> tuple[Array, float]:
            return pose(at + speed * (time - meeting), lane, 0.0 if speed > 0.0 else np.pi)

        found.append(Mover(f"moving_car_{k}", _vehicle(place, kind, skin), drive))
    return found


def parked_cars(place: KnownPlace, start: float, length: float) -> list[PlaceObject]:
    """Cars parked along `length` [m] of the road from station `start` on; they are not added to the place."""
    rng = np.random.default_rng([SEED, 52, place.number])
    before = len(place.objects)
    for k in range(_PARKED):
        kind, skin = str(rng.choice(VEHICLES)), str(rng.choice(_SKINS))
        station = start + (k + rng.uniform(0.35, 0.75)) / _PARKED * length
        add_vehicle(place, 100 + k, station, -_PARKED_GAP - vehicle_size(kind)[1] / 2, 0.0, kind, skin)
    cars = place.objects[before:]
    del place.objects[before:]
    return cars


def _vehicle(place: KnownPlace, kind: str, skin: str) -> MeshPart:
    """A vehicle's mesh with its foot at the origin."""
    add_vehicle(place, 0, 0.0, 0.0, 0.0, kind, skin)
    part, foot, yaw = place.objects.pop().part, place.spot(0.0, 0.0), place.heading(0.0)
    low = part.vertices[:, 2].min()
    return part.moved(np.array([-foot[0], -foot[1], -low])).moved(np.zeros(3), -yaw)


def _walker(place: KnownPlace, rng: np.random.Generator) -> MeshPart:
    """A walker's mesh in mid-stride, about 1.75 m tall."""
    coat, trousers = (str(rng.choice(_SKINS)) for _ in range(2))
    scale = rng.uniform(0.92, 1.08)

    def limb(skin: str, low: tuple[float, ...], high: tuple[float, ...], radius: float) -> MeshPart:
        return place.cell(skin, primitives.tube(np.array(low), np.array(high), radius, 1.15 * radius, 10))

    parts = [
        limb(trousers, (0.28, 0.1, 0.0), (0.0, 0.09, 0.85), 0.075),
        limb(trousers, (-0.28, -0.1, 0.0), (0.0, -0.09, 0.85), 0.075),
        limb(coat, (0.0, 0.0, 0.8), (0.02, 0.0, 1.45), 0.17),
        limb(coat, (-0.22, 0.24, 0.85), (0.0, 0.2, 1.42), 0.05),
        limb(coat, (0.22, -0.24, 0.85), (0.0, -0.2, 1.42), 0.05),
        limb("planks", (0.02, 0.0, 1.5), (0.03, 0.0, 1.74), 0.09),
    ]
    mesh = primitives.join(parts)
    return MeshPart(scale * mesh.vertices, mesh.faces, mesh.uv)
