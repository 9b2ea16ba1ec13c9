"""Baked field: density and features of a trained radiance field in sparse 8-bit bricks. Renders without torch.

`kernels/bricks.py` defines the bricks, `baked_arrays.py` all arrays. The two per-ray networks, head and background
(`network.py`), are stored beside them. A lighting is one vector, so one baked field renders the place under every
lighting. A long road has several sections (`road.py`), which are read from disk when a camera needs them. A *render
target* has the buffers of images, and the launches that render a section into them.
"""

import copy
import itertools
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as to_bytes

from twin.errors import InputError
from twin.files import check_shapes, load_tensors, wrap_read_errors
from twin.geometry.cameras import PosedCameras, Rendering, intrinsics_for_size
from twin.nerf.baked_arrays import (
    BAKED_FORMATS,
    BAKED_HEAD,
    BLOCK_DIM,
    BakedSection,
    BrickLayout,
    Detail,
    RenderKernels,
    SectionOnDevice,
    check_arrays,
    check_networks,
    section_file,
)
from twin.nerf.kernels import march as kernels
from twin.nerf.kernels import surface_detail as detail_kernels
from twin.nerf.kernels.color_head import LANES as HEAD_LANES
from twin.nerf.kernels.color_head import Vec8
from twin.nerf.kernels.volume import CHANNELS
from twin.nerf.lightings import Fog, Lightings, Probes
from twin.nerf.road import RoadSections, read_head, undivided_road, write_head
from twin.nerf.sun import Sun, Sunlight
from twin.runtime import available_cores
from twin.types import Array32
from twin.warp_runtime import wp

# Largest number of render targets that are kept per section, one per number of cameras and image size; the least
# recently used one is dropped. A vector env renders either all its envs or those that reset, whose number varies.
_MAX_TARGETS = 4
_MAX_RESIDENT = 8  # sections that are kept in memory, about 150 MB each
_COPIED = 8  # images that are copied together


# ---- render targets


@dataclass(frozen=True)
class CameraBatch:
    """n cameras to render."""

    pose: NDArray[np.float64]
    """Camera to world, shape (n, 4, 4)."""
    intrinsics: NDArray[np.float64]
    """Shape (n, 4)."""
    size: tuple[int, int]
    """Width, height [px]."""
    bias: Array32
    """See `BakedField.head_biases`."""
    stop: NDArray | None
    """See `BakedField.render`."""

    def subset(self, rows: NDArray[np.int64]) -> "CameraBatch":
        """Some of the cameras."""
        stop = None if self.stop is None else self.stop[rows]
        return CameraBatch(self.pose[rows], self.intrinsics[rows], self.size, self.bias[rows], stop)


class RenderTarget:
    """Buffers for images of one size, and recorded launches that render them in horizontal bands, in parallel."""

    def __init__(
        self,
        compiled: RenderKernels,
        section: SectionOnDevice,
        bands: int,
        n: int,
        width: int,
        height: int,
        stopped: bool,
    ):
        """Allocates buffers for n cameras and at most `bands` bands; with `stopped`, rays end at given depths."""
        self.shape, device = (n, height, width), compiled.device
        # The arrays live as long as the launches that read them. A reference to the section itself would be circular,
        # and a dropped section would stay in memory until the next garbage collection.
        self.arrays = section.bricks, section.detail
        across, down, pixels = -(-width // kernels.TILE), -(-height // kernels.TILE), width * height

        def new(shape: tuple[int, ...], dtype: Any = wp.float32) -> Any:
            return wp.zeros(shape, dtype=dtype, device=device)

        image: Any = kernels.ImageBuffers()
        image.rotation, image.position = new((n,), wp.mat33f), new((n,), wp.vec3f)
        image.intrinsics = new((n,), wp.vec4f)
        image.stop = new((n, pixels) if stopped else (0, 0))
        image.width, image.height, image.across = width, height, across
        self.image, self.bias = image, new((n, len(compiled.first_bias[0]) // 8), Vec8)
        self.depth, self.opacity, self.rgb = new((n, pixels)), new((n, pixels)), new((n, pixels), wp.vec3f)
        self.features = new((n, CHANNELS, pixels))
        self.staging: list[Any] = []
        start = new((n, across * down))
        edges = np.unique(np.linspace(0, down, bands + 1).round().astype(int)).tolist()
        self.bands = range(len(edges) - 1)
        self.launches = []
        for first, last in itertools.pairwise(edges):
            recorded = partial(wp.launch, device=device, record_cmd=True, block_dim=BLOCK_DIM)
            tiles = (last - first) * across
            top, bottom = first * kernels.TILE * width, min(last * kernels.TILE, height) * width
            packets = tiles * kernels.TILE**2 // kernels.LANES[device]
            runs = -(-(bottom - top) // HEAD_LANES[device])
            launches = [
                recorded(kernels.cone_march, (n, tiles), [section.bricks, image, first * across], [start]),
                recorded(
                    *(compiled.march, (n, packets), [section.bricks, image, first * across, start]),
                    [self.features, self.depth],
                ),
            ]
            if section.has_detail:
                run = detail_kernels.RUN[device]
                dim, inputs = (n, -(-(bottom - top) // run)), [image, top, bottom, run, self.depth]
                launches.append(recorded(detail_kernels.add_detail, dim, [*section.detail, *inputs], [self.features]))
            inputs = [compiled.weights, self.bias, image, top, bottom, self.features]
            outputs = [self.depth, self.rgb, self.opacity]
            launches.append(recorded(compiled.color_head, (n, runs), inputs, outputs))
            self.launches.append(launches)

    def set_cameras(self, views: CameraBatch) -> None:
        """Sets the cameras of the next images, as many as the target has."""
        image = self.image
        image.rotation.assign(views.pose[:, :3, :3].astype(np.float32))
        image.position.assign(views.pose[:, :3, 3].astype(np.float32))
        image.intrinsics.assign(views.intrinsics.astype(np.float32))
        self.bias.assign(np.ascontiguousarray(views.bias, np.float32).reshape(len(views.bias), -1, 8))
        if views.stop is not None:
            image.stop.assign(np.asarray(views.stop, np.float32).reshape(image.stop.shape))

    def render_band(self, band: int) -> None:
        """Renders a band of all images; bands may be rendered at the same time."""
        for launch in self.launches[band]:
            launch.launch()

    def images(self, features: bool, pool: ThreadPoolExecutor | None) -> tuple[Rendering, Array32 | None]:
        """Copies of the images, as the buffers are reused, and of the `features`. The threads of `pool` copy."""
        arrays = [self.rgb, self.depth, self.opacity, *([self.features] if features else [])]
        shapes = [(*self.shape, 3), self.shape, self.shape, (self.shape[0], CHANNELS, *self.shape[1:])]
        sources = [array.numpy() for array in (self._staged(arrays) if self.rgb.device.is_cuda else arrays)]
        out = [np.empty(shape, np.float32) for shape, _ in zip(shapes, sources, strict=False)]
        pairs = [(to, source.reshape(to.shape)) for to, source in zip(out, sources, strict=True)]
        # The first write to new memory takes longer than the transfer from a GPU, unless many threads write.
        slices = [slice(i, i + _COPIED) for i in range(0, len(out[0]), _COPIED)]
        parts = [(to[some], source[some]) for to, source in pairs for some in slices]
        copying = pool.map if pool and len(slices) > 1 else map
        list(copying(np.copyto, *zip(*parts, strict=True)))
        return Rendering(*out[:3]), out[3] if features else None

    def _staged(self, arrays: list[Any]) -> list[Any]:
        """Copies on the host of arrays on a GPU, in page-locked memory, where transfers are faster."""
        for array in arrays[len(self.staging) :]:
            self.staging.append(wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=True))
        for staged, array in zip(self.staging, arrays, strict=False):
            wp.copy(staged, array)
        wp.synchronize_device(arrays[0].device)
        return self.staging[: len(arrays)]


# ---- the field


class BakedField:
    """Density and color of a place under every lighting it was filmed in, ready to render."""

    def __init__(
        self,
        sections: Sequence[BakedSection],
        lightings: Lightings,
        networks: dict[str, NDArray],
        device: str = "cpu",
        road: RoadSections | None = None,
    ):
        """
        Args:
            sections: Sections in the order of `road`.
            lightings: Appearance embeddings by name.
            networks: `network.*`, and for random lightings `probes.*` (see `lightings.Probes`).
            device: `cpu` or `cuda`.
            road: Determines the sections that render a camera; None: a road of one section.
        """
        self.sections, self.road = tuple(sections), road or undivided_road()
        self.lightings_by_name, self.networks, self.device = lightings, networks, device
        if "probes.features" in networks:
            probes = Probes(networks["probes.features"], networks["probes.harmonics"], self.network)
            self.lightings_by_name = replace(lightings, probes=probes)
        self._lock = threading.Lock()
        self._resident: OrderedDict[int, SectionOnDevice] = OrderedDict()
        self._resident_lock = threading.Lock()
        if len(self.sections) == 1:
            self._section(0, 1)
        self._kernels = RenderKernels(self.network, device)
        self._threads = available_cores()
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None

    @property
    def lightings(self) -> tuple[str, ...]:
        """Names of the filmed lightings, then of the added ones."""
        return self.lightings_by_name.names

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the near boxes [m], shape (2, 3)."""
        center, half = (np.array([getattr(one.layout, name) for one in self.sections]) for name in ("centre", "half"))
        return np.stack([(center - half).min(0), (center + half).max(0)])

    @property
    def network(self) -> dict[str, NDArray]:
        """Arrays of the color head and the background network, by name."""
        return {k.removeprefix("network."): v for k, v in self.networks.items() if k.startswith("network.")}

    @property
    def bytes(self) -> int:
        """Size of the stored arrays [bytes]."""
        return sum(
            array.nbytes
            for arrays in (self.networks, *(one.arrays for one in self.sections))
            for array in arrays.values()
        )

    def embedding(self, lighting: str) -> Array32:
        """See `Lightings.embedding`."""
        return self.lightings_by_name.embedding(lighting)

    def fog(self, lighting: str) -> Fog | None:
        """See `Lightings.fog`. `render` leaves the fog out; environments apply it to their images."""
        return self.lightings_by_name.fog(lighting)

    def sunlight(self, lighting: str) -> Sunlight:
        """See `Lightings.sunlight`. `render` leaves the sun out; environments apply it to their images."""
        return self.lightings_by_name.sunlight(lighting)

    def sample_lighting(self, rng: np.random.Generator) -> Array32:
        """Embedding (dim,) of a random plausible lighting, see `Lightings.sample`."""
        return self.lightings_by_name.sample(rng)

    def add_lightings(
        self,
        more: Mapping[str, Array32],
        stale: tuple[str, ...] = (),
        fogs: Mapping[str, Fog] | None = None,
        suns: Mapping[str, Sun] | None = None,
    ) -> None:
        """See `Lightings.added`."""
        self.lightings_by_name = self.lightings_by_name.added(more, stale, fogs, suns)

    def render(
        self,
        cameras: PosedCameras,
        lighting: str | NDArray | Sequence[str | NDArray],
        size: tuple[int, int] | None = None,
        stop: NDArray | None = None,
    ) -> Rendering:
        """Renders n cameras, without the fog and the sun of added lightings.

        Args:
            cameras: `Cameras` of a scene, or `Viewpoints`.
            lighting: A name (see `Lightings.embedding`) or an embedding (dim,); or a sequence of these, one per camera.
            size: Image width and height [px]; by default the size of the cameras.
            stop: z-depth of other objects [m], shape (n, height, width), at which the march ends. `opacity` is then the
                fraction of an object's light that the field in front of it blocks, and `rgb` the color of that part
                of the field alone (not premultiplied).

        Raises:
            InputError: unknown lighting, or cameras of several sizes and no size given.
        """
        with self._lock:  # all callers share the render targets
            views = self._views(cameras, lighting, size, stop)
            return self._rendered(views, self._shares(views))[0]

    def render_on_device(
        self,
        cameras: PosedCameras,
        lighting: str | NDArray | Sequence[str | NDArray],
        consume: Callable[[Any, Any], None],
    ) -> None:
        """Renders as `render` does and passes the result to `consume`.

        `consume` receives two Warp arrays on the field's device: colors (n, height · width) of vec3, and opacities
        (n, height · width). Both are valid only until it returns. They are not copied to the host, unless several
        sections have a share in them.
        """
        with self._lock:
            views = self._views(cameras, lighting)
            shares = self._shares(views)
            needed = np.flatnonzero(shares.any(0))
            if len(needed) == 1:
                target = self._render(int(needed[0]), views)
                return consume(target.rgb, target.opacity)
            out = self._rendered(views, shares)[0]
            n = len(out.rgb)
            consume(
                wp.array(out.rgb.reshape(n, -1, 3), dtype=wp.vec3f, device=self.device),
                wp.array(out.opacity.reshape(n, -1), dtype=wp.float32, device=self.device),
            )

    def render_features(
        self, cameras: PosedCameras, lighting: str | NDArray, size: tuple[int, int] | None = None
    ) -> tuple[Rendering, Array32]:
        """Renders every camera by its nearest section alone, and also returns the features before the color head.

        Returns:
            The rendering, and a copy of opacity (channel 0) and features, shape (n, CHANNELS, height, width).
        """
        with self._lock:
            views = self._views(cameras, lighting, size)
            rendering, channels = self._rendered(views, self._shares(views, blended=False), features=True)
            assert channels is not None
            return rendering, channels

    def set_detail(self, section: int, detail: Detail) -> None:
        """Replaces the detail of a section."""
        with self._lock:
            old = self.sections[section]
            new = BakedSection(old.layout, old.arrays | detail.arrays())
            self.sections = (*self.sections[:section], new, *self.sections[section + 1 :])
            with self._resident_lock:
                self._resident.pop(section, None)

    def alone(self, section: int) -> "BakedField":
        """A field of one section, for all cameras."""
        return BakedField([self.sections[section]], self.lightings_by_name, self.networks, self.device)

    def single_threaded(self) -> "BakedField":
        """A field on the same arrays with its own render targets and lock. It renders on the calling thread.

        Several such fields render at the same time, each in a thread of the caller.
        """
        out = copy.copy(self)
        out._lock, out._pool = threading.Lock(), None
        return out

    def _views(
        self,
        cameras: PosedCameras,
        lighting: str | NDArray | Sequence[str | NDArray],
        size: tuple[int, int] | None = None,
        stop: NDArray | None = None,
    ) -> CameraBatch:
        intrinsics, size = intrinsics_for_size(cameras, size)
        pose = np.asarray(cameras.camera_to_world, np.float64)
        return CameraBatch(pose, intrinsics, size, self.head_biases(lighting, len(pose)), stop)

    def _shares(self, views: CameraBatch, blended: bool = True) -> NDArray[np.float64]:
        """Shares of the sections in the pictures, shape (n, sections); if not blended, 1 for the nearest section."""
        if len(self.sections) == 1:
            return np.ones((len(views.pose), 1))
        positions = views.pose[:, :3, 3]
        return self.road.shares(positions) if blended else np.eye(len(self.sections))[self.road.nearest(positions)]

    def _rendered(
        self, views: CameraBatch, shares: NDArray[np.float64], features: bool = False
    ) -> tuple[Rendering, Array32 | None]:
        """Renders views by the sections that have a share in them; `features` needs shares that are 0 or 1."""
        needed = np.flatnonzero(shares.any(0)).tolist()
        if len(needed) == 1:
            return self._render(needed[0], views).images(features, self._pool)
        # Those in memory come first, before others take their place.
        with self._resident_lock:
            resident = set(self._resident)
        parts = {}
        for k in sorted(needed, key=lambda k: k not in resident):
            rows = np.flatnonzero(shares[:, k])
            # The number of views changes at every border; rounded up to a power of two, it has few render targets.
            count = min(1 << (len(rows) - 1).bit_length(), len(shares))
            padded = np.append(rows, np.repeat(rows[-1:], count - len(rows)))
            parts[k] = rows, self._render(k, views.subset(padded), len(needed)).images(features, self._pool)
        n, (width, height) = len(shares), views.size
        total = Rendering(*(np.zeros((n, height, width, *channels), np.float32) for channels in ((3,), (), ())))
        all_channels = np.zeros((n, CHANNELS, height, width), np.float32) if features else None
        for k in needed:
            rows, (one, channels) = parts[k]
            m, share = len(rows), shares[rows, k].astype(np.float32)[:, None, None]
            opacity = share * one.opacity[:m]
            # Colors of rays that stop are those of the field in front alone, so they count by its opacity.
            total.rgb[rows] += (share if views.stop is None else opacity)[..., None] * one.rgb[:m]
            total.opacity[rows] += opacity
            nearest = shares[rows].argmax(1) == k
            total.depth[rows[nearest]] = one.depth[:m][nearest]
            if all_channels is not None and channels is not None:
                all_channels[rows] = channels[:m]
        if views.stop is not None:
            total.rgb[...] /= np.maximum(total.opacity, 1e-6)[..., None]
        return total, all_channels

    def _section(self, k: int, count: int) -> tuple[SectionOnDevice, OrderedDict[tuple, RenderTarget]]:
        """Section k on the device, and this object's render targets of it.

        If more than `_MAX_RESIDENT` sections are in memory, and more than the `count` that this call needs, the least
        recently used one is dropped.
        """
        with self._resident_lock:
            if k not in self._resident:
                self._resident[k] = SectionOnDevice(self.sections[k].layout, self.sections[k].arrays, self.device)
            self._resident.move_to_end(k)
            if len(self._resident) > max(_MAX_RESIDENT, count):
                self._resident.popitem(last=False)
            section = self._resident[k]
            return section, section.targets.setdefault(self, OrderedDict())

    def _render(self, k: int, views: CameraBatch, count: int = 1) -> RenderTarget:
        """Renders views by section k alone; the call needs `count` sections."""
        section, targets = self._section(k, count)
        key = len(views.pose), *views.size, views.stop is not None
        if key not in targets:
            # More bands than cores keep all cores busy, as bands with sky finish sooner.
            bands = 3 * self._threads if self._pool and self.device == "cpu" else 1
            targets[key] = RenderTarget(self._kernels, section, bands, *key)
        targets.move_to_end(key)
        if len(targets) > _MAX_TARGETS:
            targets.popitem(last=False)
        target = targets[key]
        target.set_cameras(views)
        if self._pool and len(target.bands) > 1:
            list(self._pool.map(target.render_band, target.bands))
        else:
            for band in target.bands:
                target.render_band(band)
        return target

    def head_biases(self, lighting: str | NDArray | Sequence[str | NDArray], n: int) -> Array32:
        """Bias of the head's first layer including the appearance, for n cameras, shape (n, hidden)."""
        one = isinstance(lighting, str) or (isinstance(lighting, np.ndarray) and lighting.ndim == 1)
        vectors = np.stack(
            [self.embedding(v) if isinstance(v, str) else np.asarray(v) for v in ([lighting] if one else lighting)]
        ).astype(np.float32)
        if len(vectors) not in (1, n):
            raise InputError(f"{len(vectors)} lightings for {n} cameras; expected one, or one per camera")
        bias, matrix = self._kernels.first_bias
        # One product per vector: BLAS may sum a matrix product in another order for another number of vectors, and an
        # image must not depend on the other images.
        return np.broadcast_to(bias + np.stack([vector @ matrix for vector in vectors]), (n, len(bias)))

    # ---- files

    def save(self, folder: Path, about: dict[str, Any] | None = None) -> None:
        """Writes `baked.json` with the metadata `about`, a file per section, and with several sections the road."""
        names = self.lightings_by_name
        shared = {**self.networks, "lightings.vectors": names.vectors, "lightings.frames": names.frame_vectors}
        for k, section in enumerate(self.sections):
            stored = section.arrays | (shared if k == 0 else {})
            contiguous = {name: np.ascontiguousarray(array) for name, array in stored.items()}
            (folder / section_file(k)).write_bytes(to_bytes(contiguous))
        self.road.save(folder)
        layouts = [section.layout for section in self.sections]
        write_head(folder / BAKED_HEAD, BAKED_FORMATS, layouts, names.names, names.frames, {"about": about or {}})

    @staticmethod
    def load(folder: Path, device: str = "cpu") -> "BakedField":
        """Loads a baked field; raises InputError if it is missing, damaged or of another format.

        Sections from the second on are read, and found damaged, only when a camera needs them.
        """
        layouts, names, frames, _ = read_head(folder / BAKED_HEAD, BAKED_FORMATS, BrickLayout)
        arrays = load_tensors(folder / section_file(0))
        with wrap_read_errors(folder / section_file(0), "build the scene again"):
            vectors, frame_vectors = arrays.pop("lightings.vectors"), arrays.pop("lightings.frames")
            dim = vectors.shape[1]
            shapes = {"lightings.vectors": (vectors, (len(names), dim), "f")}
            check_shapes(shapes | {"lightings.frames": (frame_vectors, (len(frames), dim), "f")})
            networks = {name: arrays.pop(name) for name in list(arrays) if name.startswith(("network.", "probes."))}
            check_arrays(layouts[0], arrays)
            check_networks(networks, dim)
            sections = [
                BakedSection(layout, file=folder / section_file(k)) if k else BakedSection(layout, arrays)
                for k, layout in enumerate(layouts)
            ]
            road = RoadSections.load(folder, len(layouts))
            lightings = Lightings(names, vectors, frames, frame_vectors)
            return BakedField(sections, lightings, networks, device, road)
