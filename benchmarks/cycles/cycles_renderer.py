"""A second renderer of the generated places: path tracing by Blender's Cycles, with the same meshes and textures.

It replaces `twin.reality.rasterizer.Rasterizer` in a trial. Its light differs on purpose: every part of the sky lights
the surfaces from its own direction; surfaces reflect light onto each other; the sun is a disc, so its shadows have
penumbrae; the light of lamps falls with the square of the distance; no precomputed occlusion darkens the ground. Sky
and sun are as bright as `Lighting` says: an unoccluded horizontal surface receives the same light in both renderers.
"""

import os
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.reality import true_world
from twin.reality.lighting import Lighting
from twin.reality.place_objects import KnownPlace
from twin.reality.rasterizer import FlatScene, Rasterizer, flatten
from twin.types import Array, Array32

SAMPLES = 8
"""Paths per pixel; the picture is denoised."""

_SKY_ROWS = 512
_NO_SHADOWS = ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))  # the rasterizer renders depth only
_ENVIRONMENT = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}  # not twin's packages


def sky_picture(cube: NDArray[np.uint8]) -> Array32:
    """Converts a cube map (6 n, n, 3), see `sky.sky_cube_map`, to an equirectangular picture (rows, 2 rows, 3).

    Row 0 is the zenith. Column 0 is the direction −x; azimuth, counterclockwise from +x, decreases with the column.
    """
    rows, columns = _SKY_ROWS, 2 * _SKY_ROWS
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    azimuth = 2.0 * np.pi * (0.5 - (np.arange(columns) + 0.5) / columns)[None]
    x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    x, y, z = np.broadcast_arrays(x, y, z)
    x, y, z = x, z, -y  # OpenGL's axes: y up
    size = np.stack([np.abs(x), np.abs(y), np.abs(z)])
    axis = size.argmax(0)
    face = 2 * axis + (np.choose(axis, (x, y, z)) < 0.0)
    s = np.choose(face, (-z, z, x, x, x, -x)) / size.max(0)
    t = np.choose(face, (-y, -y, z, -z, -y, -y)) / size.max(0)
    side = cube.shape[1]
    column = np.clip(((s + 1.0) / 2.0 * side).astype(int), 0, side - 1)
    row = np.clip(((t + 1.0) / 2.0 * side).astype(int), 0, side - 1)
    return cube[face * side + row, column].astype(np.float32) / 255.0


def light_from_above(sky: Array32) -> Array:
    """Radiance of a white horizontal surface under a sky (rows, columns, 3), shape (3,)."""
    rows, columns = sky.shape[:2]
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)
    solid_angle = np.cos(elevation) * (np.pi / rows) * (2.0 * np.pi / columns)
    weight = np.clip(np.sin(elevation), 0.0, None) * solid_angle / np.pi
    return (sky.sum(1) * weight[:, None]).sum(0)


def _scene(flat: FlatScene, model: mujoco.MjModel) -> dict[str, NDArray]:
    """Arrays of a scene for `worker.py`."""
    images = {}
    for texture in range(model.ntex):
        width, height, begin = model.tex_width[texture], model.tex_height[texture], model.tex_adr[texture]
        images[texture] = model.tex_data[begin : begin + 3 * width * height].reshape(height, width, 3)
    sky = sky_picture(images.pop(flat.sky))
    casts = flat.sun_shadows
    # Lights without shadows stand for the sky's own directions, so the sky gets their light.
    dome = flat.ambient + (flat.sun_colors * np.clip(-flat.sun_directions[:, 2:], 0.0, None))[~casts].sum(0)
    constant, quadratic, _ = flat.lamp_falloff
    # Below a lamp, on the ground, both renderers have the same light.
    height = flat.lamps[:, 0, 2] - flat.corners[..., 2].min() if len(flat.lamps) else np.zeros(0)
    below = flat.lamps[:, 1] / (constant + quadratic * height**2)[:, None]
    return {
        "corners": flat.corners,
        "normals": flat.normals,
        "uvs": flat.uvs,
        "textures": flat.textures,
        "emissions": flat.emissions,
        **{f"texture_{k}": image for k, image in images.items()},
        "sky": sky,
        "sky_gain": dome / np.maximum(light_from_above(sky), 1e-6),
        "sun_directions": flat.sun_directions[casts],
        "sun_colors": flat.sun_colors[casts],
        "lamp_positions": flat.lamps[:, 0],
        "lamp_intensities": np.pi * below * (height**2)[:, None],
    }


class CyclesRenderer:
    """Renders one place under one lighting from any pose: a `twin.reality.rasterizer.PlaceRenderer`."""

    def __init__(
        self,
        python: Path,
        lighting: Lighting,
        place: KnownPlace,
        intrinsics: Array,
        size: tuple[int, int],
        samples: int = SAMPLES,
        threads: int = 1,
    ) -> None:
        """
        Args:
            python: Python interpreter of an environment that has `bpy`.
            intrinsics: fx, fy, cx, cy [px], shape (4,), with fx = fy.
            size: Width, height [px].
            samples: Paths per pixel.
            threads: Threads of Cycles.

        Raises:
            InputError: the interpreter does not start.
        """
        model = true_world.world_spec(replace(lighting, occlusion=0.0), place).compile()
        self._rasterizer, self._size = Rasterizer(model, intrinsics, size, _NO_SHADOWS), size
        self._folder = tempfile.TemporaryDirectory()
        scene = Path(self._folder.name) / "scene.npz"
        settings = {"intrinsics": intrinsics, "size": size, "samples": samples, "threads": threads}
        arrays = {**_scene(flatten(model), model), **{name: np.asarray(value) for name, value in settings.items()}}
        np.savez(scene, **arrays)
        self._messages = Path(self._folder.name) / "messages.txt"
        command = [str(python), str(Path(__file__).with_name("worker.py")), str(scene)]
        try:
            with self._messages.open("wb") as messages:
                self._worker = subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=messages, env=_ENVIRONMENT
                )
        except OSError as error:
            raise InputError(f"{python}: {error.strerror}; give a Python interpreter that can import bpy") from None

    def __call__(self, camera_to_world: Array) -> tuple[Array32, Array32]:
        """Linear RGB (h, w, 3) and z-depth (h, w) [m], 0 for the sky, from an OpenCV pose (4, 4).

        The depth is that of the rasterizer, which has the same triangles.

        Raises:
            InputError: the worker has ended.
        """
        worker, (width, height) = self._worker, self._size
        assert worker.stdin and worker.stdout
        try:
            worker.stdin.write(np.ascontiguousarray(camera_to_world, np.float64).tobytes())
            worker.stdin.flush()
            data = worker.stdout.read(12 * width * height)
        except OSError:
            data = b""
        if len(data) < 12 * width * height:
            lines = self._messages.read_text(errors="replace").strip().splitlines()
            raise InputError(f"Cycles ended with status {worker.wait()}: {lines[-1] if lines else 'no message'}")
        light = np.frombuffer(data, np.float32).reshape(height, width, 3)
        return light, self._rasterizer(camera_to_world)[1]

    def close(self) -> None:
        """Ends the worker."""
        if self._worker.stdin:
            self._worker.stdin.close()
        self._worker.wait()
        self._folder.cleanup()
