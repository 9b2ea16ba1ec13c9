"""Radiance field: density and color of a place under every lighting it was filmed in.

The hash grid and the trunk network give density and features per sample; the features are composited along the ray, and
the head network maps them to a color (`network.py`). Points and distances are in meters, in the world frame of the
cameras; `kernels/space.py` defines the other terms.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from safetensors.torch import save as to_bytes

from twin.files import check_shapes, regular_file, wrap_read_errors
from twin.geometry.cameras import FAR, PosedCameras, Rendering, intrinsics_for_size, pixel_grid
from twin.nerf import network
from twin.nerf.appearance import Appearance
from twin.nerf.baked_arrays import check_networks
from twin.nerf.buffers import (
    CameraArrays,
    Layout,
    Workspace,
    in_batches,
    load_training_kernels,
    resolve_device,
    warp_view,
)
from twin.nerf.kernels import hashgrid, space, volume
from twin.nerf.kernels.color_head import HARMONICS
from twin.nerf.road import RoadSections, read_head, undivided_road, write_head
from twin.warp_runtime import wp

_HEAD = "field.json"
_FORMATS = 1, 2  # format of a field with one section, and of one with several
QUERY_POINTS = 65536
"""Points per batch of `FieldSection.query`."""
_RENDER_RAYS = 4096  # rays per batch when rendering
_RENDER_SAMPLES = 24  # samples per ray when rendering
_HEAD_RAYS = 8192  # rays per batch of the head
_RENDER_UNIFORM_WEIGHT = 0.02  # `floor` of `volume.sample_rays` when rendering
_MAX_SEED = 2**31 - 1  # kernels take 32-bit signed seeds


Traced = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def _prefix(k: int) -> str:
    """Prefix of the names of section k's tensors in `field.safetensors`."""
    return f"{k}." if k else ""


class FieldSection:
    """Density and features of one section of the road (`road.py`): hash grid, opacity grids and trunk network."""

    def __init__(
        self,
        layout: Layout,
        table: torch.Tensor,
        grids: tuple[torch.Tensor, torch.Tensor],
        parameters: dict[str, torch.Tensor],
    ):
        """
        Args:
            layout: Sizes and bounds.
            table: Hash tables, shape (levels, 2**log2_table, FEATURES).
            grids: Near and far opacity grid, see `kernels/volume.py`.
            parameters: Weights of the networks, which all sections share; see `network.initial_parameters`.
        """
        self.layout, self.table, self.grids, self.parameters = layout, table, grids, parameters
        self.device = "cpu" if table.device.type == "cpu" else "cuda"
        load_training_kernels(self.device)
        self.w_table = warp_view(table, hashgrid.Feature)
        self.w_levels: Any = hashgrid.Levels()
        self.w_levels.cells = wp.array(layout.level_cells(), dtype=wp.vec3f, device=self.device)
        self.w_levels.shapes = wp.array(layout.level_shapes(), dtype=wp.vec4i, device=self.device)
        self.w_levels.mask = wp.uint32(2**layout.log2_table - 1)
        self.w_grids: Any = volume.OpacityGrids()
        self.w_grids.near, self.w_grids.far = (warp_view(grid, wp.float32) for grid in grids)
        sizes: Any = layout.opacity_grids()
        (_, self.w_grids.near_cell), (_, self.w_grids.far_cell) = sizes
        self.contraction: Any = space.Contraction()
        self.contraction.center = wp.vec3f(*layout.centre)
        self.contraction.inverse_half = wp.vec3f(*(1.0 / np.array(layout.half)))
        self.spare: dict[tuple[int, int, int], list[Workspace]] = {}

    # ---- passes of a batch, each on rays [start, start + count) of a workspace

    def cast(self, ws: Workspace, cameras: CameraArrays, start: int, count: int) -> None:
        """Pixels → rays."""
        inputs = [ws.w_camera, ws.w_pixel, cameras.rotation, cameras.position, cameras.intrinsics, start]
        wp.launch(space.pixel_rays, count, inputs, [ws.w_rays], device=self.device)

    def sample(
        self, ws: Workspace, start: int, count: int, floor: float, target_mass: float = 0.0, seed: int | None = None
    ) -> None:
        """Rays → samples, see `volume.sample_rays`: jittered, or at the middles of the strata if `seed` is None."""
        jitter = -1 if seed is None else seed & _MAX_SEED
        inputs = [ws.w_rays, ws.w_targets, self.contraction, self.w_grids]
        inputs += [self.layout.near_plane, floor, target_mass, jitter, start]
        wp.launch(volume.sample_rays, count, inputs, [ws.w_strata, ws.w_ray_positions], device=self.device)

    def query(self, ws: Workspace, start: int, count: int) -> None:
        """Grid positions → network outputs, for rows (samples, not rays) [start, start + count)."""
        inputs = [ws.w_positions, self.w_table, self.w_levels, start]
        wp.launch(hashgrid.encode, count, inputs, [ws.w_features], device=self.device)
        rows = slice(start, start + count)
        network.trunk(self.parameters, ws.features[rows], ws.hidden[rows], ws.outputs[rows])

    def composite(self, ws: Workspace, start: int, count: int) -> None:
        """Network outputs → opacity and features per ray."""
        inputs = [ws.w_ray_outputs, ws.w_strata, self.layout.density_unit, start]
        outputs = [ws.w_weights, ws.w_composited, ws.w_inverse, ws.w_median]
        wp.launch(volume.composite, count, inputs, outputs, device=self.device)

    def composite_backward(
        self,
        ws: Workspace,
        start: int,
        count: int,
        distortion: float = 0.0,
        depth: float = 0.0,
        depth_reach: float = 1.0,
        log_offset: float = 1.0,
    ) -> None:
        """Loss gradients of opacity, features and Σwᵢ/tᵢ per ray → loss gradients of network outputs.

        The samples of a ray have weights wᵢ and distances tᵢ [m]. The last four arguments are weights and scales of two
        regularizers, see `volume.composite_backward`.
        """
        inputs = [ws.w_ray_outputs, ws.w_strata, ws.w_weights, ws.w_targets, ws.w_composited_grad, ws.w_inverse_grad]
        inputs += [self.layout.density_unit, distortion, depth, depth_reach, log_offset, start]
        wp.launch(volume.composite_backward, count, inputs, [ws.w_ray_outputs_grad], device=self.device)

    def trace(
        self, cameras: CameraArrays, camera: NDArray, pixel: NDArray, rays: NDArray[np.int64], out: Traced
    ) -> None:
        """Traces the rays with the indices `rays` and writes their results into `out`, see `RadianceField.trace`."""

        def march(rows: slice) -> None:
            index = rays[rows]
            k = len(index)
            with self.workspace(_RENDER_RAYS, _RENDER_SAMPLES) as ws:
                ws.camera[:k] = torch.as_tensor(camera[index].astype(np.int32), device=self.device)
                ws.pixel[:k] = torch.as_tensor(pixel[index].astype(np.float32), device=self.device)
                self.cast(ws, cameras, 0, k)
                self.sample(ws, 0, k, _RENDER_UNIFORM_WEIGHT)
                self.query(ws, 0, k * _RENDER_SAMPLES)
                self.composite(ws, 0, k)
                at = torch.as_tensor(index, device=self.device)
                features, harmonics, depth, opacity = out
                harmonics[at] = network.spherical_harmonics(ws.directions[:k])
                features[at] = network.ray_features(self.parameters, ws.composited[:k], harmonics[at])
                median = ws.median_distance[:k]
                depth[at] = torch.where(median > 0.0, median * ws.cosines[:k], FAR).clamp(max=FAR)
                opacity[at] = ws.composited[:k, 0]

        in_batches(march, len(rays), _RENDER_RAYS, self.device)

    @contextmanager
    def workspace(self, rays: int, samples: int, extra: int = 0) -> Iterator[Workspace]:
        """Lends a spare or new workspace of this size.

        Several threads may call this at the same time, since each dict and list operation is atomic.
        """
        spares = self.spare.setdefault((rays, samples, extra), [])
        try:
            ws = spares.pop()
        except IndexError:
            ws = Workspace(self.layout, rays, samples, self.device, extra)
        yield ws
        spares.append(ws)

    def tensors(self) -> dict[str, torch.Tensor]:
        """The learned tensors by their names in `field.safetensors`, except the networks."""
        return {"table": self.table, "grid.near": self.grids[0], "grid.far": self.grids[1]}


class RadianceField:
    """A radiance field on one device, trained or in training."""

    def __init__(
        self,
        sections: Sequence[FieldSection],
        road: RoadSections,
        appearance: Appearance,
        parameters: dict[str, torch.Tensor],
    ):
        """
        Args:
            sections: Sections in the order of `road`.
            road: Determines the section that renders a camera.
            appearance: Embeddings, on the device of the tensors.
            parameters: Weights of the networks, see `network.initial_parameters`.
        """
        self.sections, self.road = tuple(sections), road
        self.appearance, self.parameters = appearance, parameters
        self._added: tuple[dict[str, NDArray[np.float32]], tuple[str, ...]] = {}, ()
        self.device = self.sections[0].device
        for section in self.sections[1:]:  # spare workspaces fit all sections
            section.spare = self.sections[0].spare

    @property
    def lightings(self) -> tuple[str, ...]:
        """Names of the filmed lightings, then of the added ones."""
        return *self.appearance.lightings, *self._added[0]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the near boxes [m], shape (2, 3)."""
        low, high = np.stack([section.layout.bounds for section in self.sections], 1)
        return np.stack([low.min(0), high.max(0)])

    def embedding(self, lighting: str) -> NDArray[np.float32]:
        """See `Lightings.embedding`."""
        return self.appearance.named().added(*self._added).embedding(lighting)

    def add_lightings(self, more: dict[str, NDArray[np.float32]], stale: tuple[str, ...] = ()) -> None:
        """See `Lightings.added`."""
        self._added = self._added[0] | more, (*self._added[1], *stale)

    def trace(self, cameras: CameraArrays, camera: NDArray, pixel: NDArray) -> Traced:
        """Traces n rays, given by camera index (n,) and pixel (n, 2) [px]; the result does not depend on the lighting.

        Every camera is rendered by its nearest section alone.

        Returns:
            Features (n, CHANNELS − 1), spherical harmonics of the directions (n, 16), z-depth [m] (n,), opacity (n,).
        """
        n = len(camera)
        out = (
            torch.empty(n, volume.CHANNELS - 1, device=self.device),
            torch.empty(n, HARMONICS, device=self.device),
            torch.empty(n, device=self.device),
            torch.empty(n, device=self.device),
        )
        mine = self.road.nearest(cameras.position.numpy().astype(np.float64))[camera]
        for k, section in enumerate(self.sections):
            section.trace(cameras, camera, pixel, np.flatnonzero(mine == k), out)
        return out

    def color(self, features: torch.Tensor, harmonics: torch.Tensor, embedding: NDArray) -> NDArray[np.float32]:
        """Colors in [0, 1], shape (n, 3), of traced rays under one embedding (dim,)."""
        rgb = torch.empty(len(features), 3, device=self.device)
        vector = torch.as_tensor(np.asarray(embedding, np.float32), device=self.device)

        def head(rows: slice) -> None:
            rgb[rows] = network.head(self.parameters, features[rows], harmonics[rows], vector)

        in_batches(head, len(features), _HEAD_RAYS, self.device)
        return rgb.cpu().numpy()

    def render(self, cameras: PosedCameras, lighting: str | NDArray, size: tuple[int, int] | None = None) -> Rendering:
        """Renders n cameras under one lighting; `BakedField.render` is much faster and explains the arguments."""
        vector = self.embedding(lighting) if isinstance(lighting, str) else np.asarray(lighting, np.float32)
        intrinsics, (width, height) = intrinsics_for_size(cameras, size)
        n = len(intrinsics)
        arrays = CameraArrays(cameras.camera_to_world, intrinsics, self.device)
        pixel = np.tile(pixel_grid(width, height).reshape(-1, 2), (n, 1))
        features, harmonics, depth, opacity = self.trace(arrays, np.repeat(np.arange(n), width * height), pixel)
        return Rendering(
            self.color(features, harmonics, vector).reshape(n, height, width, 3),
            depth.cpu().numpy().reshape(n, height, width),
            opacity.cpu().numpy().reshape(n, height, width),
        )

    # ---- files

    def save(self, folder: Path, about: dict[str, Any] | None = None) -> None:
        """Writes `field.json` with the metadata `about`, `field.safetensors`, and with several sections the road."""
        tensors: dict[str, torch.Tensor] = {}
        for k, section in enumerate(self.sections):
            tensors |= {f"{_prefix(k)}{name}": tensor for name, tensor in section.tensors().items()}
        tensors |= {"appearance.vectors": self.appearance.vectors, "appearance.residuals": self.appearance.residuals}
        tensors |= {f"network.{name}": value for name, value in self.parameters.items()}
        stored = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        (folder / "field.safetensors").write_bytes(to_bytes(stored))
        self.road.save(folder)
        layouts, a = [section.layout for section in self.sections], self.appearance
        more = {"frame_lighting": a.frame_lighting.tolist(), "about": about or {}}
        write_head(folder / _HEAD, _FORMATS, layouts, a.lightings, a.frames, more)

    @staticmethod
    def load(folder: Path, device: str | None = None) -> "RadianceField":
        """Loads a field to a device, see `buffers.resolve_device`.

        Raises InputError if the folder has no field, or its files are damaged or of another format.
        """
        device = resolve_device(device)
        layouts, names, frames, head = read_head(folder / _HEAD, _FORMATS, Layout)
        with wrap_read_errors(folder / _HEAD, "build the scene again"):
            frame_lighting = np.array(head["frame_lighting"], np.int64)
        path = regular_file(folder / "field.safetensors")
        with wrap_read_errors(path, "build the scene again"):
            tensors = load_file(str(path), device=device)
            _check_tensors(tensors, layouts, len(names), len(frames), frame_lighting)
            appearance = Appearance(
                names, frames, frame_lighting, tensors["appearance.vectors"], tensors["appearance.residuals"]
            )
            parameters = {k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")}
            sections = [
                FieldSection(
                    layout,
                    tensors[f"{_prefix(k)}table"],
                    (tensors[f"{_prefix(k)}grid.near"], tensors[f"{_prefix(k)}grid.far"]),
                    parameters,
                )
                for k, layout in enumerate(layouts)
            ]
        return RadianceField(sections, RoadSections.load(folder, len(sections)), appearance, parameters)


def _check_tensors(
    tensors: dict[str, torch.Tensor], layouts: Sequence[Layout], lightings: int, frames: int, frame_lighting: NDArray
) -> None:
    """Raises ValueError if tensors do not fit the layouts, as a kernel would read beyond them."""
    first, arrays = layouts[0], {name: tensor.cpu().numpy() for name, tensor in tensors.items()}
    if len({(layout.levels, layout.hidden) for layout in layouts}) > 1:
        raise ValueError("the sections have different numbers of levels or hidden units")
    check_networks(arrays, first.appearance_dim)
    shapes: dict[str, tuple[int, ...]] = {
        "network.trunk.0": (first.levels * hashgrid.FEATURES, first.hidden),
        "network.trunk.1": (first.hidden, volume.CHANNELS),
        "appearance.vectors": (lightings, first.appearance_dim),
        "appearance.residuals": (frames, first.appearance_dim),
    }
    for k, layout in enumerate(layouts):
        shapes[f"{_prefix(k)}table"] = (first.levels, 2**layout.log2_table, hashgrid.FEATURES)
        for name, (shape, _) in zip(("near", "far"), layout.opacity_grids(), strict=True):
            shapes[f"{_prefix(k)}grid.{name}"] = shape
    check_shapes({name: (arrays[name], shape, "f") for name, shape in shapes.items()})
    if frame_lighting.shape != (frames,) or not np.isin(frame_lighting, np.arange(lightings)).all():
        raise ValueError(f"frame_lighting: expected {frames} numbers from 0 to {lightings - 1}, one for each frame")


def untrained_field(
    layouts: Sequence[Layout],
    lightings: tuple[str, ...],
    frames: tuple[str, ...],
    frame_lighting: NDArray[np.int64],
    seed: int,
    device: str,
    road: RoadSections | None = None,
) -> RadianceField:
    """The field before its first training step; its density is low and almost uniform.

    `layouts` has one layout per section of `road`; None is a road of one section. For the lightings and frames see
    `Appearance`.
    """
    generator = torch.Generator().manual_seed(seed)
    first = layouts[0]
    initial = network.initial_parameters(first.levels * hashgrid.FEATURES, first.hidden, first.appearance_dim, seed)
    parameters = {name: value.to(device) for name, value in initial.items()}
    sections = []
    for layout in layouts:
        table = (torch.rand(layout.levels, 2**layout.log2_table, hashgrid.FEATURES, generator=generator) - 0.5) * 2e-2
        near, far = (
            torch.full(shape, -math.expm1(-layout.density_unit * cell), device=device)
            for shape, cell in layout.opacity_grids()
        )
        sections.append(FieldSection(layout, table.to(device), (near, far), parameters))
    vectors = np.random.default_rng([seed, 1]).normal(0.0, 0.3, (len(lightings), first.appearance_dim))
    residuals = torch.zeros(len(frames), first.appearance_dim, device=device)
    appearance = Appearance(
        lightings, frames, frame_lighting, torch.as_tensor(vectors.astype(np.float32), device=device), residuals
    )
    return RadianceField(sections, road or undivided_road(), appearance, parameters)
