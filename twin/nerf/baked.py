"""The baked field: what the renderer marches. Loads and renders without torch.

Density and features of a trained radiance field, sampled into sparse bricks of bytes where some camera saw matter (see
`kernels/bricks.py`), and the two small networks that work per ray (see `network.py`). A lighting is one vector, so one
baked field shows its place under every lighting.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from safetensors.numpy import load_file
from safetensors.numpy import save as to_bytes

from twin.errors import InputError
from twin.nerf.kernels import bricks as kernels
from twin.nerf.kernels.composite import CHANNELS
from twin.nerf.lightings import Lightings
from twin.nerf.plausible import Probes
from twin.nerf.rendering import FAR, Rendering
from twin.scene import read_json, write_json

wp.config.log_level = wp.LOG_ERROR

Floats = NDArray[np.float32]

_FORMAT = 2
_TRACE = 0.01  # share of light that a cell may stop and count as empty
_TASKS = 4  # pieces a picture's pixels are cut into, at least


@dataclass(frozen=True)
class BrickLayout:
    """Everything about a baked field that is no array."""

    centre: tuple[float, float, float]
    """Of the near box [m]."""
    half: tuple[float, float, float]
    """Half sides of the near box [m]."""
    near_plane: float
    """Rays begin here [m]."""
    density_unit: float
    """Density at raw value 0, per contracted metre."""
    near_shape: tuple[int, int, int]
    """Bricks over the near box."""
    far_shape: tuple[int, int, int]
    """Bricks over the contracted cube."""

    @property
    def near_side(self) -> NDArray[np.float64]:
        """Sides of a brick in the near box [m]."""
        return 2.0 * np.array(self.half) / np.array(self.near_shape)

    @property
    def far_cell(self) -> float:
        """Smallest side of a far cell [contracted m]."""
        return float((4.0 * np.array(self.half) / np.array(self.far_shape)).min()) / kernels.CELLS


class BakedField:
    """Density and colour of a place under every lighting it was filmed in, ready to render."""

    def __init__(
        self,
        layout: BrickLayout,
        lightings: Lightings,
        arrays: dict[str, NDArray],
        where: str = "cpu",
        about: dict[str, Any] | None = None,
    ):
        """
        Args:
            layout: Sizes and bounds.
            lightings: The appearance embeddings by name.
            arrays: `near` and `far` (bricks' grid positions of the slots, (s, 3), near ones first), `density` (s, 729)
                and `features` (s, 729, CHANNELS) bytes, `low` and `step` (CHANNELS,), `network.*`, and `probes.*`,
                see `plausible.Probes`, where random lightings are to be had.
            where: Device.
            about: Whatever else is to be kept beside the numbers, JSON-able.
        """
        self.layout, self.lightings_by_name, self.about, self.where = layout, lightings, about or {}, where
        self._arrays = arrays
        self._network = {k.removeprefix("network."): v for k, v in arrays.items() if k.startswith("network.")}
        if "probes.features" in arrays:
            probes = Probes(arrays["probes.features"], arrays["probes.harmonics"], self._network)
            self.lightings_by_name = replace(lightings, probes=probes)
        near, far = brick_indices(layout, arrays["near"], arrays["far"])
        near_leap, far_leap = leaps(layout, arrays)
        b: Any = kernels.Bricks()
        b.near_index = wp.array(near, dtype=wp.int32, device=where)
        b.far_index = wp.array(far, dtype=wp.int32, device=where)
        b.near_leap = wp.array(near_leap, dtype=wp.uint8, device=where)
        b.far_leap = wp.array(far_leap, dtype=wp.uint8, device=where)
        b.density = wp.array(arrays["density"].ravel(), dtype=wp.uint8, device=where)
        b.features = wp.array(arrays["features"].reshape(-1, CHANNELS), dtype=kernels.Bytes, device=where)
        b.low, b.step = kernels.Channels(*arrays["low"].tolist()), kernels.Channels(*arrays["step"].tolist())
        b.centre = wp.vec3f(*layout.centre)
        b.inverse_half = wp.vec3f(*(1.0 / np.array(layout.half)))
        b.near_cell, b.far_cell = float(layout.near_side.min()) / kernels.CELLS, layout.far_cell
        b.unit, b.near_plane = layout.density_unit, layout.near_plane
        self._bricks = b
        self._buffers: dict[tuple[int, int], Any] = {}
        self._no_stop: Any = wp.zeros((0, 0), dtype=wp.float32, device=where)
        wp.load_module("twin.nerf.kernels.bricks", device=where)
        self._threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self._threads) if where == "cpu" and self._threads > 1 else None

    @property
    def lightings(self) -> tuple[str, ...]:
        """Names of the lightings it was filmed under, and of those added to it."""
        return self.lightings_by_name.names

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the near box [m], shape (2, 3)."""
        return np.stack(
            [np.subtract(self.layout.centre, self.layout.half), np.add(self.layout.centre, self.layout.half)]
        )

    @property
    def bytes(self) -> int:
        """Size of the arrays."""
        return sum(array.nbytes for array in self._arrays.values())

    def embedding(self, lighting: str) -> Floats:
        """See `Lightings.embedding`."""
        return self.lightings_by_name.embedding(lighting)

    def sample_lighting(self, rng: np.random.Generator) -> Floats:
        """The embedding of a random lighting that could have been filmed, shape (dim,). See `Lightings.sample`."""
        return self.lightings_by_name.sample(rng)

    def add_lightings(self, more: dict[str, Floats], stale: tuple[str, ...] = ()) -> None:
        """See `Lightings.added`."""
        self.lightings_by_name = self.lightings_by_name.added(more, stale)

    def render(
        self,
        camera_to_world: NDArray,
        intrinsics: NDArray,
        size: tuple[int, int],
        lighting: str | NDArray,
        stop: NDArray | None = None,
    ) -> Rendering:
        """Views of n cameras under one lighting.

        Args:
            camera_to_world: OpenCV axes, shape (n, 4, 4).
            intrinsics: fx, fy, cx, cy [px] at `size`, shape (n, 4).
            size: Width, height [px].
            lighting: A name, see `Lightings.embedding`, or an embedding (dim,).
            stop: z-depth of what else stands there [m], shape (n, height, width): the march ends at it. `opacity` is
                then what the field holds back of it, and `rgb` the colour of the field's own share alone.

        Raises:
            InputError: unknown lighting.
        """
        vector = self.embedding(lighting) if isinstance(lighting, str) else np.asarray(lighting, np.float32)
        pose = np.asarray(camera_to_world, np.float64)
        n, (width, height) = len(pose), size
        pixels = width * height
        features, depth, directions = self._buffer(n, pixels)
        inputs: list[Any] = [
            self._bricks,
            wp.array(pose[:, :3, :3].astype(np.float32), dtype=wp.mat33f, device=self.where),
            wp.array(pose[:, :3, 3].astype(np.float32), dtype=wp.vec3f, device=self.where),
            wp.array(np.asarray(intrinsics, np.float32), dtype=wp.vec4f, device=self.where),
            self._no_stop
            if stop is None
            else wp.array(np.asarray(stop, np.float32).reshape(n, pixels), dtype=wp.float32, device=self.where),
            width,
        ]
        rgb = np.empty((n, pixels, 3), np.float32)
        opacity = np.empty((n, pixels), np.float32)
        bias = self._network["head.0.bias"] + vector @ self._network["head.0"][CHANNELS - 1 + 16 :]
        if self.where != "cpu":
            wp.launch(kernels.march, (n, pixels), [*inputs, 0], [features, depth, directions], device=self.where)
        f, d = features.numpy(), directions.numpy()
        share = -(-pixels // max(_TASKS, self._threads)) if n < self._threads else pixels

        def work(task: tuple[int, int]) -> None:
            camera, first = task
            rows = slice(first, min(first + share, pixels))
            if self.where == "cpu":
                one = [array[camera : camera + 1] for array in (features, depth, directions)]
                mine = [inputs[0], *(array[camera : camera + 1] for array in inputs[1:4])]
                mine += [self._no_stop if stop is None else inputs[4][camera : camera + 1], width, first]
                wp.launch(kernels.march, (1, rows.stop - first), mine, one, device=self.where)
            opacity[camera, rows] = f[camera, rows, 0]
            rgb[camera, rows] = shade(self._network, bias, f[camera, rows], d[camera, rows], backdrop=stop is None)

        tasks = [(camera, first) for camera in range(n) for first in range(0, pixels, share)]
        list(self._pool.map(work, tasks) if self._pool else map(work, tasks))
        z = depth.numpy()
        return Rendering(
            rgb.reshape(n, height, width, 3),
            np.where(z > 0.0, np.minimum(z, FAR), FAR).astype(np.float32).reshape(n, height, width),
            opacity.reshape(n, height, width),
        )

    def _buffer(self, n: int, pixels: int) -> tuple[Any, Any, Any]:
        """Arrays for so many pixels; the last ones are kept, as the next picture is likely of the same size."""
        if (n, pixels) not in self._buffers:
            self._buffers = {
                (n, pixels): (
                    wp.zeros((n, pixels), dtype=kernels.Channels, device=self.where),
                    wp.zeros((n, pixels), dtype=wp.float32, device=self.where),
                    wp.zeros((n, pixels), dtype=wp.vec3f, device=self.where),
                )
            }
        return self._buffers[n, pixels]

    # ---- files

    def save(self, folder: Path) -> None:
        """Writes `baked.safetensors` and `baked.json`."""
        names = self.lightings_by_name
        stored = {**self._arrays, "lightings.vectors": names.vectors, "lightings.frames": names.frame_vectors}
        (folder / "baked.safetensors").write_bytes(to_bytes({k: np.ascontiguousarray(v) for k, v in stored.items()}))
        write_json(
            folder / "baked.json",
            {
                "format": _FORMAT,
                "layout": asdict(self.layout),
                "lightings": names.names,
                "frames": names.frames,
                "about": self.about,
            },
        )

    @staticmethod
    def load(folder: Path, where: str = "cpu") -> "BakedField":
        """Reads a baked field.

        Raises:
            InputError: none there, or one of another format.
        """
        if not (folder / "baked.json").exists():
            raise InputError(f"{folder}: holds no baked.json; build it with --set nerf.bake=true")
        head = read_json(folder / "baked.json")
        if head.get("format") != _FORMAT:
            raise InputError(f"{folder}/baked.json: format {head.get('format')}, expected {_FORMAT}; build it anew")
        arrays = load_file(str(folder / "baked.safetensors"))
        lightings = Lightings(
            tuple(head["lightings"]),
            arrays.pop("lightings.vectors"),
            tuple(head["frames"]),
            arrays.pop("lightings.frames"),
        )
        layout: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in head["layout"].items()}
        return BakedField(BrickLayout(**layout), lightings, arrays, where, head["about"])


def brick_indices(layout: BrickLayout, near: NDArray, far: NDArray) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The near and the far index (see `kernels/bricks.py`) of slots at bricks (s, 3), near ones first."""
    out = []
    for shape, slots, first in ((layout.near_shape, near, 0), (layout.far_shape, far, len(near))):
        index = np.full(shape, -1, np.int32)
        index[tuple(slots.T)] = np.arange(first, first + len(slots))
        out.append(index)
    return out[0], out[1]


def leaps(layout: BrickLayout, arrays: dict[str, NDArray]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """How far rays may leap from every block of the near and the far grid, see `kernels/bricks.py`."""
    from scipy.ndimage import distance_transform_cdt

    n = kernels.BLOCKS
    filled = filled_blocks(layout, arrays)
    split = len(arrays["near"])
    out = []
    for shape, slots, mine in (
        (layout.near_shape, arrays["near"], filled[:split]),
        (layout.far_shape, arrays["far"], filled[split:]),
    ):
        bricks = np.zeros((*shape, n, n, n), bool)
        bricks[tuple(slots.T)] = mine
        blocks = bricks.transpose(0, 3, 1, 4, 2, 5).reshape(np.multiply(shape, n))
        # What lies beyond a grid may be full; so may the near box be, to the far grid.
        whole = np.pad(blocks, 1, constant_values=True)
        if shape is layout.far_shape:
            low = np.floor(0.25 * n * np.array(shape)).astype(int) + 1
            high = np.ceil(0.75 * n * np.array(shape)).astype(int) + 1
            whole[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
        leap = distance_transform_cdt(~whole, "chessboard")[1:-1, 1:-1, 1:-1]
        out.append(np.minimum(leap, 255).astype(np.uint8))
    return out[0], out[1]


def filled_blocks(layout: BrickLayout, arrays: dict[str, NDArray]) -> NDArray[np.bool_]:
    """Whether some corner of a block stops more than a trace of light per cell, shape (slots, 4, 4, 4)."""
    near_cell = float(layout.near_side.min()) / kernels.CELLS
    cell = np.where(np.arange(len(arrays["density"])) < len(arrays["near"]), near_cell, layout.far_cell)
    codes = (np.log(_TRACE / (cell * layout.density_unit)) - arrays["low"][0]) / arrays["step"][0]
    stops = arrays["density"].reshape(-1, *[kernels.CORNERS] * 3) > codes[:, None, None, None]
    for axis in (1, 2, 3):
        first, second, third = (np.take(stops, np.arange(k, k + kernels.CELLS - 1, 2), axis) for k in (0, 1, 2))
        stops = first | second | third
    return stops


def shade(p: dict[str, Floats], bias: Floats, composited: Floats, directions: Floats, backdrop: bool = True) -> Floats:
    """Colour (k, 3) of rays from what was composited along them (k, CHANNELS) and their unit directions (k, 3).

    `bias` is the first layer's with the appearance in it. Without the backdrop, a ray's features are scaled up to a
    full share, so that the colour is that of what was met and its opacity says how much of it.
    """
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    harmonics = np.empty((len(x), 16), np.float32)
    harmonics[:, 0] = 1.0
    harmonics[:, 1:4] = directions
    harmonics[:, 4], harmonics[:, 5], harmonics[:, 6] = x * y, y * z, 3.0 * zz - 1.0
    harmonics[:, 7], harmonics[:, 8], harmonics[:, 9] = x * z, xx - yy, y * (3.0 * xx - yy)
    harmonics[:, 10], harmonics[:, 11], harmonics[:, 12] = x * y * z, y * (5.0 * zz - 1.0), z * (5.0 * zz - 3.0)
    harmonics[:, 13], harmonics[:, 14], harmonics[:, 15] = x * (5.0 * zz - 1.0), z * (xx - yy), x * (xx - 3.0 * yy)
    features = composited[:, 1:].copy()
    if backdrop:
        open_ = np.flatnonzero(composited[:, 0] < 0.999)
        behind = np.maximum(harmonics[open_] @ p["backdrop.0"] + p["backdrop.0.bias"], 0.0) @ p["backdrop.1"]
        features[open_] += (1.0 - composited[open_, :1]) * behind
    else:
        features /= np.maximum(composited[:, :1], 1e-3)
    f = features.shape[1]
    h = features @ p["head.0"][:f]
    h += harmonics @ p["head.0"][f : f + 16]
    h += bias
    np.maximum(h, 0.0, out=h)
    h = h @ p["head.1"]
    h += p["head.1.bias"]
    np.maximum(h, 0.0, out=h)
    out = h @ p["head.2"]
    out += p["head.2.bias"]
    return (1.0 / (1.0 + np.exp(-out))).astype(np.float32)
