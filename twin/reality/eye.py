"""What the robot's camera makes of the world: it shakes, its shutter smears, haze dims, the sensor develops and adds
noise. Numbers: `robot.py` and the lighting."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.env.camera_effects import CameraEffects
from twin.geometry.cameras import pixel_grid, unproject
from twin.reality.film import develop, smooth_noise
from twin.reality.lighting import Lighting, hazed
from twin.reality.raster import Raster
from twin.reality.robot import Robot

Array = NDArray[np.float64]

_SKY = 1.0e4  # [m] away, where smearing is concerned
_DRIFT_TIME = 9.0  # [s] of the exposure
_TICK = 0.1  # [s] between two values of it
_NOISE = 0.5  # of a film frame's, whose pixels are a quarter as wide; a resized picture has less


class Eye:
    """One camera in one trial; the same generator and the same poses give the same pictures."""

    def __init__(
        self,
        raster: Raster,
        lighting: Lighting,
        robot: Robot,
        intrinsics: Array,
        size: tuple[int, int],
        rng: np.random.Generator,
    ) -> None:
        """
        Args:
            raster: Of the place under the lighting, with these intrinsics and this size.
            lighting: Exposure, noise, haze.
            robot: Whose camera it is.
            intrinsics: fx, fy, cx, cy [px], shape (4,).
            size: Width, height [px].
            rng: Of the trial.
        """
        self._raster, self._robot, self._intrinsics, self._rng = raster, robot, intrinsics, rng
        self._lighting = replace(lighting, noise=_NOISE * lighting.noise)
        self._rays = unproject(pixel_grid(*size), intrinsics)
        self._effects = CameraEffects(robot.camera, rng)
        self._times = np.arange(0.0, 600.0, _TICK)
        self._gains = np.exp(robot.exposure_drift * smooth_noise(rng, self._times, _DRIFT_TIME))

    def look(self, camera_to_world: Array, time: float) -> NDArray[np.uint8]:
        """The picture (h, w, 3) of a camera that would be at a pose (4, 4) if it did not shake, at a time [s]."""
        pose = self._effects.shaken(camera_to_world, time)
        light, depth = self._raster(pose)
        light = hazed(light, depth, self._lighting)
        far = np.where(depth > 0.0, depth, np.float32(_SKY))
        light = self._effects.exposed(light, far, pose, time, self._rays, self._intrinsics)
        return develop(self._rng, light, self._lighting, float(np.interp(time, self._times, self._gains)))
