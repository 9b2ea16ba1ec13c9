"""The baked field: what the renderer marches. Loads and renders without torch.

Density and features of a trained radiance field, sampled into sparse bricks of bytes where some camera saw matter (see
`kernels/bricks.py`), and the two small networks that work per ray (see `network.py`). A lighting is one vector, so one
baked field shows its place under every lighting.
"""

import itertools
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from safetensors.numpy import save as to_bytes

from twin.errors import InputError, shown
from twin.files import check_shapes, checked_text, damaged, load_tensors, read_json, write_json
from twin.geometry.cameras import Posed, resized
from twin.nerf.appearance_prior import Probes
from twin.nerf.brick_layout import BrickLayout, brick_indices, brick_leaps, density_codes
from twin.nerf.fog import Fog
from twin.nerf.kernels import march as kernels
from twin.nerf.kernels.bricks import BLOCKS, CELLS, Bytes
from twin.nerf.kernels.color_head import HARMONICS, Eight, shade
from twin.nerf.kernels.color_head import LANES as SHADE_LANES
from twin.nerf.kernels.composite import CHANNELS, Channels
from twin.nerf.kernels.lookup import Bricks
from twin.nerf.lightings import Lightings
from twin.nerf.rendering import Rendering
from twin.runtime import bar, cores
from twin.types import Array32

wp.config.log_level = wp.LOG_ERROR


_FORMAT = 2
_PIECES = 3  # of a picture, per core
_SIZES_KEPT = 4  # of pictures: a vector of worlds needs all of them, and those that begin anew


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
            arrays: `near` and `far` (bricks' grid positions of the slots, (s, 3), near ones first), `features`
                (s, 729, CHANNELS) bytes, `low` and `step` (CHANNELS,), `near_leap` and `far_leap` (see `leaps`),
                `network.*`, and `probes.*`, see `plausible.Probes`, where random lightings are to be had.
            where: Device.
            about: Whatever else is to be kept beside the numbers, JSON-able.
        """
        self.layout, self.lightings_by_name, self.about, self.where = layout, lightings, about or {}, where
        self._arrays = arrays
        p = {k.removeprefix("network."): v for k, v in arrays.items() if k.startswith("network.")}
        if "probes.features" in arrays:
            probes = Probes(arrays["probes.features"], arrays["probes.harmonics"], p)
            self.lightings_by_name = replace(lightings, probes=probes)
        near, far = brick_indices(layout, arrays["near"], arrays["far"])

        def on_device(array: NDArray, dtype: Any) -> Any:
            if where == "cpu":  # NumPy puts large arrays of its own on huge pages, where random reads cost less
                own = np.empty(array.shape, array.dtype)
                own[...] = array
                return wp.array(own, dtype=dtype, device=where, copy=False)
            return wp.array(np.ascontiguousarray(array), dtype=dtype, device=where)

        b: Any = Bricks()
        near, near_leaps = brick_leaps(near, arrays["near_leap"])
        far, far_leaps = brick_leaps(far, arrays["far_leap"])
        b.near_index, b.far_index = on_device(near.ravel(), wp.int32), on_device(far.ravel(), wp.int32)
        b.leaps = on_device(np.concatenate([near_leaps, far_leaps]).ravel(), wp.uint8)
        b.near_blocks = wp.vec3i(*(BLOCKS * n for n in layout.near_shape))
        b.far_blocks = wp.vec3i(*(BLOCKS * n for n in layout.far_shape))
        b.densities = on_device(density_codes(arrays["features"][..., 0]), wp.uint8)
        b.features = on_device(arrays["features"].reshape(-1, CHANNELS), Bytes)
        b.low, b.step = Channels(*arrays["low"].tolist()), Channels(*arrays["step"].tolist())
        b.centre = wp.vec3f(*layout.centre)
        b.inverse_half = wp.vec3f(*(1.0 / np.array(layout.half)))
        b.near_cell, b.far_cell = float(layout.near_side.min()) / CELLS, layout.far_cell
        b.unit, b.near_plane = layout.density_unit, layout.near_plane
        self._bricks = b
        self._lock = threading.Lock()
        self._pictures: dict[tuple[int, int, int, bool], _Picture] = {}

        hidden, behind = p["head.1"].shape[0], p["backdrop.0"].shape[1]
        self._march = kernels.march(kernels.LANES[where])
        self._shade, weights = shade(SHADE_LANES[where], hidden, behind)
        rows = CHANNELS - 1 + HARMONICS
        w: Any = weights()

        def eights(matrix: NDArray) -> Any:
            """By eight hidden units (the first axis), then by what else they connect."""
            return on_device(matrix.reshape(len(matrix) // 8, 8, -1).transpose(0, 2, 1).reshape(-1, 8), Eight)

        w.head_0, w.head_1, w.head_2 = eights(p["head.0"][:rows].T), eights(p["head.1"].T), eights(p["head.2"])
        w.head_1_bias, w.head_2_bias = eights(p["head.1.bias"]), wp.vec3f(*p["head.2.bias"].tolist())
        for name in ("backdrop.0", "backdrop.0.bias", "backdrop.1"):
            setattr(w, name.replace(".", "_"), on_device(p[name].ravel(), wp.float32))
        self._weights = w
        self._bias_of = p["head.0.bias"], p["head.0"][rows:]
        load_kernels([kernels.approach, self._march, self._shade], where)
        self._threads = cores()
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

    def embedding(self, lighting: str) -> Array32:
        """See `Lightings.embedding`."""
        return self.lightings_by_name.embedding(lighting)

    def air(self, lighting: str) -> Fog | None:
        """See `Lightings.air`. `render` shows the place without it; environments lay it over their pictures."""
        return self.lightings_by_name.air(lighting)

    def sample_lighting(self, rng: np.random.Generator) -> Array32:
        """The embedding of a random lighting that could have been filmed, shape (dim,). See `Lightings.sample`."""
        return self.lightings_by_name.sample(rng)

    def add_lightings(
        self, more: Mapping[str, Array32], stale: tuple[str, ...] = (), airs: Mapping[str, Fog] | None = None
    ) -> None:
        """See `Lightings.added`."""
        self.lightings_by_name = self.lightings_by_name.added(more, stale, airs)

    def render(
        self,
        cameras: Posed,
        lighting: str | NDArray | Sequence[str | NDArray],
        size: tuple[int, int] | None = None,
        stop: NDArray | None = None,
    ) -> Rendering:
        """What n cameras see, in air as clear as the film's.

        Args:
            cameras: `Cameras` of a scene, or `Viewpoints`.
            lighting: A name, see `Lightings.embedding`, or an embedding (dim,); or one of either per camera.
            size: Width, height [px] of the pictures; that of the cameras unless given.
            stop: z-depth of what else stands there [m], shape (n, height, width): the march ends at it. `opacity` is
                then what the field holds back of it, and `rgb` the colour of the field's own share alone.

        Raises:
            InputError: unknown lighting, or cameras of several sizes and none given.
        """
        with self._lock:  # the arrays are shared by all who call
            return self._developed(cameras, lighting, size, stop).rendering()

    def show(
        self,
        cameras: Posed,
        lighting: str | NDArray | Sequence[str | NDArray],
        take: Callable[[Any, Any], None],
    ) -> None:
        """Shows `take` what n cameras see without bringing it to the host.

        Args:
            cameras: As for `render`.
            lighting: As for `render`.
            take: Is given colours, Warp (n, height · width) of vec3, and opacities, (n, height · width), on the
                field's device; they are rendered into again once it returns.
        """
        with self._lock:
            picture = self._developed(cameras, lighting, None, None)
            take(picture.rgb, picture.opacity)

    def _developed(
        self,
        cameras: Posed,
        lighting: str | NDArray | Sequence[str | NDArray],
        size: tuple[int, int] | None,
        stop: NDArray | None,
    ) -> "_Picture":
        intrinsics, (width, height) = resized(cameras, size)
        pose = np.asarray(cameras.camera_to_world, np.float64)
        picture = self._picture(len(pose), width, height, stop is not None)
        picture.aim(pose, intrinsics, self._biases(lighting, len(pose)), stop)
        if self._pool is None:
            for piece in picture.pieces:
                picture.develop(piece)
        else:
            list(self._pool.map(picture.develop, picture.pieces))
        return picture

    def _biases(self, lighting: str | NDArray | Sequence[str | NDArray], n: int) -> Array32:
        """The head's first bias with the appearance in it, shape (n, hidden)."""
        one = isinstance(lighting, str) or (isinstance(lighting, np.ndarray) and lighting.ndim == 1)
        vectors = np.stack(
            [self.embedding(v) if isinstance(v, str) else np.asarray(v) for v in ([lighting] if one else lighting)]
        ).astype(np.float32)
        if len(vectors) not in (1, n):
            raise InputError(f"{len(vectors)} lightings for {n} cameras; expected one, or one per camera")
        bias, matrix = self._bias_of
        # One by one: of a matrix BLAS adds up in another order, and a picture must not depend on those beside it.
        return np.broadcast_to(bias + np.stack([vector @ matrix for vector in vectors]), (n, len(bias)))

    def _picture(self, n: int, width: int, height: int, stopped: bool) -> "_Picture":
        """Arrays for pictures of this size; the last few are kept, as the next is likely of a size there was before."""
        key = n, width, height, stopped
        picture = self._pictures.pop(key, None) or _Picture(self, *key)
        self._pictures[key] = picture
        while len(self._pictures) > _SIZES_KEPT:
            del self._pictures[next(iter(self._pictures))]
        return picture

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
        path = folder / "baked.json"
        if not path.exists():
            raise InputError(f"{folder}: holds no baked.json; build the scene (again)")
        head = read_json(path)
        with damaged(path, "build the scene again"):
            if head.get("format") != _FORMAT:
                raise InputError(f"{path}: format {shown(head.get('format'))}, expected {_FORMAT}; build it anew")
            layout: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in head["layout"].items()}
            bricks = BrickLayout(**layout)
            names, frames = tuple(map(checked_text, head["lightings"])), tuple(map(checked_text, head["frames"]))
            about = dict(head["about"])
        arrays = load_tensors(folder / "baked.safetensors")
        with damaged(folder / "baked.safetensors", "build the scene again"):
            vectors, frame_vectors = arrays.pop("lightings.vectors"), arrays.pop("lightings.frames")
            dim = vectors.shape[1]
            check_shapes(
                {
                    "lightings.vectors": (vectors, (len(names), dim), "f"),
                    "lightings.frames": (frame_vectors, (len(frames), dim), "f"),
                }
            )
            return BakedField(bricks, Lightings(names, vectors, frames, frame_vectors), arrays, where, about)


class _Picture:
    """What pictures of one size are rendered into, and the launches that do it, cut into pieces for the cores."""

    def __init__(self, field: BakedField, n: int, width: int, height: int, stopped: bool):
        self.shape, where = (n, height, width), field.where
        across, down, pixels = -(-width // kernels.TILE), -(-height // kernels.TILE), width * height

        def new(shape: tuple[int, ...], dtype: Any = wp.float32) -> Any:
            return wp.zeros(shape, dtype=dtype, device=where)

        film: Any = kernels.ImageBuffers()
        film.rotation, film.position = new((n,), wp.mat33f), new((n,), wp.vec3f)
        film.intrinsics = new((n,), wp.vec4f)
        film.stop = new((n, pixels) if stopped else (0, 0))
        film.width, film.height, film.across = width, height, across
        self.film, self.bias = film, new((n, len(field._bias_of[0]) // 8), Eight)
        self.depth, self.opacity, self.rgb = new((n, pixels)), new((n, pixels)), new((n, pixels), wp.vec3f)
        self.features = new((n, CHANNELS, pixels))
        start = new((n, across * down))
        # More pieces than cores, as those with sky in them are done sooner.
        pieces = _PIECES * field._threads if field._pool else 1
        edges = np.unique(np.linspace(0, down, pieces + 1).round().astype(int)).tolist()
        self.pieces = range(len(edges) - 1)
        self.launches = []
        for first, last in itertools.pairwise(edges):
            record = partial(wp.launch, device=where, record_cmd=True)
            tiles = (last - first) * across
            top, bottom = first * kernels.TILE * width, min(last * kernels.TILE, height) * width
            packets = tiles * kernels.TILE**2 // kernels.LANES[where]
            runs = -(-(bottom - top) // SHADE_LANES[where])
            self.launches.append(
                [
                    record(kernels.approach, (n, tiles), [field._bricks, film, first * across], [start]),
                    record(
                        *(field._march, (n, packets), [field._bricks, film, first * across, start]),
                        [self.features, self.depth],
                    ),
                    record(
                        *(field._shade, (n, runs), [field._weights, self.bias, film, top, bottom, self.features]),
                        [self.depth, self.rgb, self.opacity],
                    ),
                ]
            )

    def aim(self, pose: NDArray, intrinsics: NDArray, bias: NDArray, stop: NDArray | None) -> None:
        film = self.film
        film.rotation.assign(pose[:, :3, :3].astype(np.float32))
        film.position.assign(pose[:, :3, 3].astype(np.float32))
        film.intrinsics.assign(intrinsics.astype(np.float32))
        self.bias.assign(np.ascontiguousarray(bias, np.float32).reshape(len(bias), -1, 8))
        if stop is not None:
            film.stop.assign(np.asarray(stop, np.float32).reshape(film.stop.shape))

    def develop(self, piece: int) -> None:
        for launch in self.launches[piece]:
            launch.launch()

    def rendering(self) -> Rendering:
        """A copy, as the arrays are rendered into again."""
        return Rendering(
            self.rgb.numpy().reshape(*self.shape, 3).copy(),
            self.depth.numpy().reshape(self.shape).copy(),
            self.opacity.numpy().reshape(self.shape).copy(),
        )


def load_kernels(needed: list[Any], where: str) -> None:
    """Compiles or loads kernels now, so that no two threads compile them."""
    with bar("compiling the renderer, once", len(needed), "part", after=1.0) as progress:
        for kernel in needed:
            kernel.module.load(wp.get_device(where))
            progress.update()
