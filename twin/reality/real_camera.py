"""The real test's robot cameras, by number: extrinsics, and all effects between light and picture.

The light comes from `rasterizer.py`. *Haze* depends on the length of a ray and on height (`sky.py`). *Shutter*:
rows are read one after another while the robot moves, and each is exposed for some time. *Lens*: dirt, vignetting, and
bloom around light beyond the sensor's range. *Exposure*: a second-order automatic exposure, which lags behind the
brightness of the pictures and overshoots. *White balance*: drifts over seconds. *Sensor*: noise and a response curve.
*Compression*: JPEG.
"""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import expit

from twin.errors import InputError
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.poses import pose_of
from twin.ranges import Range, setting_ranges
from twin.reality import SEED
from twin.reality.filming import FilmingPlan, motion_between, read_rows, smooth_noise
from twin.reality.lighting import Lighting
from twin.reality.rasterizer import PlaceRenderer
from twin.reality.real_robot import RealRobot
from twin.reality.sky import apply_haze
from twin.types import Array, Array32, Image

# ---- one camera's numbers

_SEAT = (0.36, 0.0, 0.6)  # [m] nominal position: forward, left and up from the base on the ground
_PITCH = 5.0  # [°] nominal pitch, downwards


@dataclass(frozen=True)
class HiddenCamera:
    """The parameters of one camera."""

    number: int

    # Extrinsics and intrinsics.
    shift_forward: Annotated[float, Range(-0.028, 0.028)]
    """Forward offset of the lens from its nominal position [m]."""
    shift_left: Annotated[float, Range(-0.028, 0.028)]
    """Offset to the left [m]."""
    shift_up: Annotated[float, Range(-0.028, 0.028)]
    """Upward offset [m]."""
    turn_right: Annotated[float, Range(-1.4, 1.4)]
    """Rotation about the camera's rightward axis, in addition to the nominal pitch [°]."""
    turn_up: Annotated[float, Range(-1.4, 1.4)]
    """Rotation about the camera's upward axis [°]."""
    turn_back: Annotated[float, Range(-1.4, 1.4)]
    """Rotation about the camera's backward axis [°]."""
    zoom: Annotated[float, Range(0.98, 1.02)]
    """Focal length relative to the nominal one."""
    center_x: Annotated[float, Range(-0.008, 0.008)]
    """Offset of the principal point to the right, as a fraction of the width."""
    center_y: Annotated[float, Range(-0.008, 0.008)]
    """Offset of the principal point downwards, also as a fraction of the width."""

    # Time.
    latency: Annotated[float, Range(0.03, 0.10)]
    """Time from the middle of the readout until the policy receives the picture [s]."""
    readout: Annotated[float, Range(0.010, 0.033)]
    """Time from the readout of the first row to that of the last one [s]."""
    shutter: Annotated[float, Range(0.002, 0.016)]
    """Time for which a row is exposed by day [s]."""

    # Exposure and color.
    exposure_target: Annotated[float, Range(0.36, 0.48)]
    """Mean brightness at which automatic exposure aims, as a fraction of the sensor's range."""
    exposure_range: Annotated[float, Range(0.25, 0.5)]
    """Largest deviation of the logarithm of the exposure from that of `Lighting.exposure`."""
    exposure_rate: Annotated[float, Range(2.0, 5.0)]
    """Natural frequency of automatic exposure [rad/s]."""
    exposure_damping: Annotated[float, Range(0.35, 0.8)]
    """Damping ratio of automatic exposure; below 1 the exposure overshoots."""
    white_drift: Annotated[float, Range(0.015, 0.05)]
    """Standard deviation of the logarithms of the gains of red and blue."""
    gamma: Annotated[float, Range(0.85, 1.18)]
    """Exponent of the response curve."""
    contrast: Annotated[float, Range(-0.1, 0.35)]
    """Strength of the S shape of the response curve around middle gray."""

    # Lens and sensor.
    vignetting: Annotated[float, Range(0.08, 0.3)]
    """Fraction of light lost at half a width from the center."""
    bloom: Annotated[float, Range(0.1, 0.4)]
    """Factor on the light beyond the sensor's range, which spreads around bright spots."""
    dirt: Annotated[float, Range(0.1, 0.45)]
    """Largest opacity of the spots on the lens."""
    spots: Annotated[float, Range(0.0, 7.0)]
    """Number of spots, rounded down."""
    noise: Annotated[float, Range(0.4, 1.2)]
    """Noise relative to `Lighting.noise`."""
    quality: Annotated[float, Range(45.0, 90.0)]
    """JPEG quality, rounded down."""


RANGES = {name: (one.low, one.high) for name, one in setting_ranges(HiddenCamera).items()}
"""Ranges from which `draw_camera` samples uniformly."""

TRAINED: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("shift_forward", "shift_left", "shift_up"), (-0.02, 0.02)),
    **dict.fromkeys(("turn_right", "turn_up", "turn_back"), (-1.0, 1.0)),
}
"""Ranges that training randomizes by default; a test compares them with the twin's values."""


def draw_camera(number: int) -> HiddenCamera:
    """The camera with a number, which determines it. Camera 0 takes the demo's pictures; it lies within `TRAINED`.

    Raises:
        InputError: a negative number.
    """
    if number < 0:
        raise InputError(f"camera {number}: expected 0 or more")
    rng = np.random.default_rng([SEED, 201, number])
    values = {}
    for name, (low, high) in RANGES.items():
        if number == 0 and name in TRAINED:
            low, high = TRAINED[name]
        values[name] = float(rng.uniform(low, high))
    return HiddenCamera(number, **values)


def native_size() -> tuple[int, int]:
    """Width, height of the camera's own pictures [px]."""
    film = FilmingPlan()
    return film.width, film.height


def intrinsics_of(camera: HiddenCamera, size: tuple[int, int]) -> Array:
    """fx, fy, cx, cy of the camera for pictures of a size (width, height) [px], shape (4,).

    If the aspect ratio is not the native one, the height is cropped or extended about its middle.
    """
    film = FilmingPlan()
    scale = size[0] / film.width
    fx, fy, cx, cy = film.intrinsics.tolist()
    cut = (film.height * scale - size[1]) / 2
    cx, cy = cx + camera.center_x * film.width, cy + camera.center_y * film.width
    return np.array([scale * camera.zoom * fx, scale * camera.zoom * fy, scale * cx, scale * cy - cut])


def camera_to_base(camera: HiddenCamera) -> Array:
    """Pose of the camera (OpenCV axes) in the frame of the base on the ground (forward, left, up), shape (4, 4)."""
    pitch = np.deg2rad(_PITCH)
    # Columns: right, down, forward.
    nominal = np.array([[0.0, -np.sin(pitch), np.cos(pitch)], [-1.0, 0.0, 0.0], [0.0, -np.cos(pitch), -np.sin(pitch)]])
    flip = np.diag([1.0, -1.0, -1.0])  # between axes right, up, back and right, down, forward
    angles = (camera.turn_right, camera.turn_up, camera.turn_back)
    turn = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    shift = (camera.shift_forward, camera.shift_left, camera.shift_up)
    return pose_of(nominal @ flip @ turn @ flip, np.add(_SEAT, shift))


# ---- lens, exposure and sensor

_DRIFT_TIME, _DRIFT_STEP, _DRIFT_END = 14.0, 0.2, 900.0  # [s] drift of the white balance: period, step, end
_FULL = 0.92  # fraction of the sensor's range; brighter light blooms
_DARK = 1.5  # lightings with a larger `exposure` double the time for which a row is exposed


def response(signal: Array32, gamma: float, contrast: float) -> Array32:
    """The response curve from light to values in [0, 1]: soft shoulder, exponent, and an S shape around middle gray.

    It rises strictly, and maps 0 to 0.
    """
    knee = 0.8
    over = np.maximum(signal - knee, 0.0)
    signal = np.minimum(signal, knee) + (1.0 - knee) * (1.0 - np.exp(-over / (1.0 - knee)))
    raised = np.clip(signal, 0.0, 1.0) ** gamma
    return (raised + contrast * raised * (1.0 - raised) * (2.0 * raised - 1.0)).astype(np.float32)


class AutoExposure:
    """A second-order loop on the logarithm of the exposure: e'' = ω² (target − e) − 2 ζ ω e'."""

    def __init__(self, camera: HiddenCamera, start: float) -> None:
        """`start` is the mean brightness of the first picture at `Lighting.exposure`."""
        self._camera = camera
        self.value = float(np.clip(self._wanted(start), -camera.exposure_range, camera.exposure_range))
        """Logarithm of the exposure relative to `Lighting.exposure`."""
        self._rate, self._time = 0.0, 0.0

    def _wanted(self, brightness: float) -> float:
        return float(np.log(self._camera.exposure_target / max(brightness, 1e-3)))

    def see(self, brightness: float, time: float) -> None:
        """Updates the exposure after a picture at a time [s], whose mean at `Lighting.exposure` is `brightness`."""
        c, steps = self._camera, max(1, round((time - self._time) / 0.01))
        dt, self._time = (time - self._time) / steps, time
        wanted = float(np.clip(self._wanted(brightness), -c.exposure_range, c.exposure_range))
        for _ in range(steps):
            push = c.exposure_rate**2 * (wanted - self.value) - 2.0 * c.exposure_damping * c.exposure_rate * self._rate
            self._rate += dt * push
            self.value += dt * self._rate


class RealCamera:
    """The robot's camera in one trial; the same random generator and drive give the same pictures."""

    def __init__(
        self,
        renderer: PlaceRenderer,
        lighting: Lighting,
        camera: HiddenCamera,
        size: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        """
        Args:
            renderer: Renders the place under the lighting, with `intrinsics_of(camera, size)`.
            lighting: Gives exposure, white balance, noise and haze.
            camera: The camera.
            size: Width, height [px].
            rng: Random generator of the trial.
        """
        self.camera, self._lighting, self._renderer, self._rng = camera, lighting, renderer, rng
        self._size, self._intrinsics = size, intrinsics_of(camera, size)
        self._rays = unproject(pixel_grid(*size), self._intrinsics).astype(np.float32)
        self._seat = camera_to_base(camera)
        self._shutter = camera.shutter * (2.0 if lighting.exposure > _DARK else 1.0)
        times = np.arange(0.0, _DRIFT_END, _DRIFT_STEP)
        self._drift_times = times
        self._drift = [camera.white_drift * smooth_noise(rng, times, _DRIFT_TIME) for _ in range(2)]
        self._exposure: AutoExposure | None = None
        width, height = size
        y, x = np.mgrid[:height, :width].astype(np.float32)
        radius2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width / 2) ** 2
        self._falloff = (1.0 - camera.vignetting * radius2)[..., None].astype(np.float32)
        self._dirt = dirt_mask(camera, size)

    def pose(self, robot: RealRobot, at: float) -> Array:
        """camera_to_world at a past time [s], OpenCV axes, shape (4, 4)."""
        return robot.base_to_world(at) @ self._seat

    def capture(self, robot: RealRobot) -> Image:
        """The picture (h, w, 3) that has just arrived; it was taken `latency` ago."""
        middle = robot.time - self.camera.latency
        half = 0.5 * self.camera.readout
        pose = self.pose(robot, middle)
        motion = motion_between(self.pose(robot, middle - half), self.pose(robot, middle + half), pose)
        ground = float(robot.base_to_world(middle)[2, 3])
        return self.develop(*self._renderer(pose), pose, motion, ground, robot.time)

    def develop(self, light: Array32, depth: Array32, pose: Array, motion: Array, ground: float, time: float) -> Image:
        """A picture (h, w, 3) of the light (h, w, 3) and z-depth (h, w) [m] at a pose (4, 4).

        Args:
            light: Linear RGB.
            depth: 0 = sky.
            pose: camera_to_world in the middle of the readout.
            motion: Rotation vector [rad] and translation [m] of the camera over the readout, in its axes, shape (6,).
            ground: Height of the ground below [m].
            time: Time since the start of the trial [s].
        """
        camera, lighting = self.camera, self._lighting
        light = apply_haze(light, depth, self._rays, pose, lighting, ground)
        if np.any(motion):
            light = read_rows(light, depth, self._rays, self._intrinsics, motion, self._shutter / camera.readout)
        light = light * (self._falloff * np.float32(lighting.exposure))
        brightness = float(light.mean())
        if self._exposure is None:
            self._exposure = AutoExposure(camera, brightness)
        else:
            self._exposure.see(brightness, time)
        light = light * np.float32(np.exp(self._exposure.value))
        light = light + self._dirt * (0.7 * light.mean((0, 1)) - light)
        red, blue = (float(np.exp(np.interp(time, self._drift_times, one))) for one in self._drift)
        light = light * (np.asarray(lighting.gain, np.float32) * np.array([red, 1.0, blue], np.float32))
        if camera.bloom > 0.0:
            light = light + np.float32(camera.bloom) * self._glare(light)
        sigma = camera.noise * lighting.noise * np.sqrt(0.35 + 1.3 * np.clip(light, 0.0, 1.0))
        light = light + sigma * self._rng.standard_normal(light.shape).astype(np.float32)
        out = (response(light.astype(np.float32), camera.gamma, camera.contrast) * 255.0 + 0.5).astype(np.uint8)
        return compressed(out, int(camera.quality))

    def _glare(self, light: Array32) -> Array32:
        """The light beyond the sensor's range, spread by a narrow and a wide Gaussian."""
        over = np.maximum(light - _FULL, 0.0) * 3.0
        near, far = (0.012 * self._size[0], 0.05 * self._size[0])
        return np.asarray(0.6 * cv2.GaussianBlur(over, (0, 0), near) + 0.4 * cv2.GaussianBlur(over, (0, 0), far))


def dirt_mask(camera: HiddenCamera, size: tuple[int, int]) -> NDArray[np.float32]:
    """Opacity of the dirt on the lens, shape (h, w, 1); the spots scale with the size of the picture."""
    width, height = size
    rng = np.random.default_rng([SEED, 202, camera.number])
    y, x = np.mgrid[:height, :width].astype(np.float32) / width
    clear = np.ones((height, width), np.float32)
    for _ in range(int(camera.spots)):
        at = rng.uniform(0.0, (1.0, height / width))
        radius, opacity = rng.uniform(0.02, 0.09), rng.uniform(0.3, 1.0) * camera.dirt
        stretch, angle = rng.uniform(0.5, 1.0), rng.uniform(0.0, np.pi)
        u = (x - at[0]) * np.cos(angle) + (y - at[1]) * np.sin(angle)
        v = (y - at[1]) * np.cos(angle) - (x - at[0]) * np.sin(angle)
        distance = np.sqrt(u**2 + (v / stretch) ** 2) / radius
        clear *= (1.0 - opacity * expit(6.0 * (1.0 - distance))).astype(np.float32)
    return (1.0 - clear)[..., None]


def compressed(picture: Image, quality: int) -> Image:
    """A picture (h, w, 3) after JPEG compression at a quality."""
    data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    back = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert back is not None
    return np.ascontiguousarray(back[..., ::-1], np.uint8)
