"""The radiance field: density and colour of a place, under every lighting it was filmed in.

Hash grid → trunk → density and features per sample; features are composited along the ray; the head turns them into
colour (see `network.py`). Points and distances are in metres, in the world of the cameras; for other vocabulary see
`kernels/space.py`.
"""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from safetensors.torch import load_file
from safetensors.torch import save as to_bytes

from twin.errors import InputError, shown
from twin.files import checked_text, damaged, read_json, regular, write_json
from twin.geometry.cameras import Posed, resized
from twin.nerf import network
from twin.nerf.appearance import Appearance
from twin.nerf.buffers import (
    CameraArrays,
    Layout,
    Workspace,
    device,
    level_cells,
    level_shapes,
    load_training_kernels,
    opacity_grids,
    parallel,
    single_threaded_torch,
    view,
)
from twin.nerf.kernels import composite as volume
from twin.nerf.kernels import hashgrid, sampler, space
from twin.nerf.rendering import FAR, Rendering

_FORMAT = 1
_RENDER_RAYS = 4096  # per batch
_RENDER_SAMPLES = 24
_HEAD_RAYS = 8192  # per batch of the head
_RENDER_FLOOR = 0.02  # weight of unlikely places when rendering
_QUERY_POINTS = 65536  # per batch of density queries
_MOST_SEED = 2**31 - 1  # of a kernel, which counts in 32 bits with a sign


class RadianceField:
    """A trained (or training) field on one device."""

    def __init__(
        self,
        layout: Layout,
        appearance: Appearance,
        table: torch.Tensor,
        parameters: dict[str, torch.Tensor],
        grids: tuple[torch.Tensor, torch.Tensor],
        about: dict[str, Any] | None = None,
    ):
        """
        Args:
            layout: Sizes and bounds.
            appearance: The embeddings, on the same device as the rest.
            table: Hash tables, shape (levels, 2**log2_table, FEATURES).
            parameters: Weights, see `network.initial_parameters`.
            grids: Stop grids, near and far, see `kernels/sampler.py`.
            about: Whatever else is to be kept beside the numbers, JSON-able.
        """
        self.layout, self.appearance, self.about = layout, appearance, about or {}
        self.table, self.parameters, self.grids = table, parameters, grids
        self.where = "cpu" if table.device.type == "cpu" else "cuda"
        load_training_kernels(self.where)
        self.w_table = view(table, hashgrid.Feature)
        self.w_near_grid, self.w_far_grid = (view(grid, wp.float32) for grid in grids)
        cells = level_cells(layout.space, layout.levels, layout.growth)
        self.w_cells: Any = wp.array(cells, dtype=wp.vec3f, device=self.where)
        self.w_shapes: Any = wp.array(level_shapes(cells, layout.log2_table), dtype=wp.vec4i, device=self.where)
        self.mask = wp.uint32(2**layout.log2_table - 1)
        self.centre = wp.vec3f(*layout.centre)
        self.inverse_half = wp.vec3f(*(1.0 / np.array(layout.half)))
        self.stop = opacity_grids(layout.space)
        self._spare: list[Workspace] = []

    @property
    def lightings(self) -> tuple[str, ...]:
        return self.appearance.lightings

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the near box [m], shape (2, 3)."""
        return self.layout.space.bounds

    def embedding(self, lighting: str) -> NDArray[np.float32]:
        """See `Appearance.embedding`."""
        return self.appearance.embedding(lighting)

    def add_lightings(self, more: dict[str, NDArray[np.float32]], stale: tuple[str, ...] = ()) -> None:
        """See `Lightings.added`."""
        self.appearance = self.appearance.added(more, stale)

    # ---- the passes of a batch; each works on rays [start, start + count) of a workspace

    def cast(self, ws: Workspace, cameras: CameraArrays, start: int, count: int) -> None:
        """Pixels → rays."""
        wp.launch(
            space.pixel_rays,
            count,
            [ws.w_camera, ws.w_pixel, cameras.rotation, cameras.position, cameras.intrinsics, start],
            [ws.w_origins, ws.w_directions, ws.w_cosines],
            device=self.where,
        )

    def sample(
        self, ws: Workspace, start: int, count: int, floor: float, target_mass: float = 0.0, seed: int | None = None
    ) -> None:
        """Rays → samples. See `kernels/sampler.py`; any seed jitters them, None takes the middles."""
        jitter = -1 if seed is None else seed & _MOST_SEED
        wp.launch(
            sampler.sample_rays,
            count,
            [
                *(ws.w_origins, ws.w_directions, ws.w_targets, self.centre, self.inverse_half),
                *(self.w_near_grid, self.w_far_grid, self.stop.near_cell, self.stop.far_cell),
                *(self.layout.near_plane, floor, target_mass, jitter, start),
            ],
            [ws.w_edges, ws.w_distances, ws.w_lengths, ws.w_ray_positions],
            device=self.where,
        )

    def query(self, ws: Workspace, start: int, count: int) -> None:
        """Grid positions → network outputs, for rows (not rays) [start, start + count)."""
        wp.launch(
            hashgrid.encode,
            count,
            [ws.w_positions, self.w_table, self.w_cells, self.w_shapes, self.mask, start],
            [ws.w_features],
            device=self.where,
        )
        rows = slice(start, start + count)
        network.trunk(self.parameters, ws.features[rows], ws.hidden[rows], ws.outputs[rows])

    def composite(self, ws: Workspace, start: int, count: int) -> None:
        """Network outputs → opacity and features per ray."""
        wp.launch(
            volume.composite,
            count,
            [ws.w_ray_outputs, ws.w_edges, ws.w_distances, ws.w_lengths, self.layout.density_unit, start],
            [ws.w_weights, ws.w_composited, ws.w_inverse, ws.w_median],
            device=self.where,
        )

    # ---- what others ask of it

    def density(self, points: NDArray) -> NDArray[np.float32]:
        """Density [1/m] at points [m], shape (k, 3) → (k,)."""
        points = np.ascontiguousarray(points, np.float32)
        result = np.empty(len(points), np.float32)
        batch = _QUERY_POINTS

        @torch.no_grad()
        def one(start: int) -> None:
            ws = self._borrow(0, 1, batch)
            n = min(batch, len(points) - start)
            metres = torch.as_tensor(points[start : start + n], device=self.where)
            wp.launch(
                space.contract_points,
                n,
                [view(metres, wp.vec3f), self.centre, self.inverse_half, 0],
                [ws.w_positions],
                device=self.where,
            )
            self.query(ws, 0, n)
            raw = ws.outputs[:n, 0].clamp(max=volume.RAW_LIMIT)
            result[start : start + n] = (torch.exp(raw) * self.layout.density_unit).cpu().numpy()
            u = np.abs((points[start : start + n] - self.layout.centre) / self.layout.half).max(1)
            result[start : start + n] /= np.maximum(u, 1.0) ** 2
            self._spare.append(ws)

        with single_threaded_torch():
            parallel(one, range(0, len(points), batch), self.where)
        return result

    def trace(
        self, cameras: CameraArrays, camera: NDArray, pixel: NDArray, samples: int = _RENDER_SAMPLES
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """What does not depend on the lighting, of n rays given by camera index (n,) and pixel (n, 2) [px].

        Returns:
            Features (n, CHANNELS − 1), spherical harmonics of the directions (n, 16), z-depth [m] (n,), opacity (n,).
        """
        n, batch = len(camera), _RENDER_RAYS
        features = torch.empty(n, volume.CHANNELS - 1, device=self.where)
        harmonics = torch.empty(n, 16, device=self.where)
        depth, opacity = torch.empty(n, device=self.where), torch.empty(n, device=self.where)

        @torch.no_grad()
        def one(start: int) -> None:
            ws = self._borrow(batch, samples, 0)
            stop = min(start + batch, n)
            k = stop - start
            ws.camera[:k] = torch.as_tensor(camera[start:stop].astype(np.int32), device=self.where)
            ws.pixel[:k] = torch.as_tensor(pixel[start:stop].astype(np.float32), device=self.where)
            self.cast(ws, cameras, 0, k)
            self.sample(ws, 0, k, _RENDER_FLOOR)
            self.query(ws, 0, k * samples)
            self.composite(ws, 0, k)
            rows = slice(start, stop)
            harmonics[rows] = network.spherical_harmonics(ws.directions[:k])
            features[rows] = network.ray_features(self.parameters, ws.composited[:k], harmonics[rows])
            median = ws.median_distance[:k]
            depth[rows] = torch.where(median > 0.0, median * ws.cosines[:k], FAR).clamp(max=FAR)
            opacity[rows] = ws.composited[:k, 0]
            self._spare.append(ws)

        with single_threaded_torch():
            parallel(one, range(0, n, batch), self.where)
        return features, harmonics, depth, opacity

    def colour(self, features: torch.Tensor, harmonics: torch.Tensor, embedding: NDArray) -> NDArray[np.float32]:
        """Colour of traced rays under one embedding (dim,), shape (n, 3)."""
        n, batch = len(features), _HEAD_RAYS
        rgb = torch.empty(n, 3, device=self.where)
        vector = torch.as_tensor(np.asarray(embedding, np.float32), device=self.where)

        @torch.no_grad()
        def one(start: int) -> None:
            rows = slice(start, start + batch)
            rgb[rows] = network.head(self.parameters, features[rows], harmonics[rows], vector)

        with single_threaded_torch():
            parallel(one, range(0, n, batch), self.where)
        return rgb.cpu().numpy()

    def render(self, cameras: Posed, lighting: str | NDArray, size: tuple[int, int] | None = None) -> Rendering:
        """What n cameras see under one lighting; as `BakedField.render`, which is many times faster.

        Raises:
            InputError: unknown lighting, or cameras of several sizes and none given.
        """
        vector = self.embedding(lighting) if isinstance(lighting, str) else np.asarray(lighting, np.float32)
        intrinsics, (width, height) = resized(cameras, size)
        n = len(intrinsics)
        arrays = CameraArrays(cameras.camera_to_world, intrinsics, self.where)
        v, u = np.mgrid[:height, :width] + 0.5
        pixel = np.tile(np.stack([u.ravel(), v.ravel()], -1), (n, 1))
        features, harmonics, depth, opacity = self.trace(arrays, np.repeat(np.arange(n), width * height), pixel)
        return Rendering(
            self.colour(features, harmonics, vector).reshape(n, height, width, 3),
            depth.cpu().numpy().reshape(n, height, width),
            opacity.cpu().numpy().reshape(n, height, width),
        )

    def _borrow(self, rays: int, samples: int, extra: int) -> Workspace:
        """A workspace of this size from those at hand, or a new one; list operations are atomic between threads."""
        for ws in self._spare:
            if (ws.rays, ws.samples) == (rays, samples):
                try:
                    self._spare.remove(ws)
                    return ws
                except ValueError:  # another thread took it
                    continue
        return Workspace(self.layout, rays, samples, self.where, extra)

    # ---- files

    def save(self, folder: Path) -> None:
        """Writes `field.safetensors` and `field.json`."""
        tensors = {"table": self.table, "grid.near": self.grids[0], "grid.far": self.grids[1]}
        tensors |= {"appearance.vectors": self.appearance.vectors, "appearance.residuals": self.appearance.residuals}
        tensors |= {f"network.{name}": value for name, value in self.parameters.items()}
        stored = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        (folder / "field.safetensors").write_bytes(to_bytes(stored))
        write_json(
            folder / "field.json",
            {
                "format": _FORMAT,
                "layout": asdict(self.layout),
                "lightings": self.appearance.lightings,
                "frames": self.appearance.frames,
                "frame_lighting": self.appearance.frame_lighting.tolist(),
                "about": self.about,
            },
        )

    @staticmethod
    def load(folder: Path, where: str | None = None) -> "RadianceField":
        """Reads a field on to a device (by default `compute.device()`).

        Raises:
            InputError: no field there, or one of another format.
        """
        where = where or device()
        if not (folder / "field.json").exists():
            raise InputError(f"{folder}: holds no field.json; build the scene's field first")
        path = folder / "field.json"
        head = read_json(path)
        with damaged(path, "build the scene again"):
            if head.get("format") != _FORMAT:
                raise InputError(f"{path}: format {shown(head.get('format'))}, expected {_FORMAT}; build it anew")
            layout = Layout(**(head["layout"] | {key: tuple(head["layout"][key]) for key in ("centre", "half")}))
            names, frames = tuple(map(checked_text, head["lightings"])), tuple(map(checked_text, head["frames"]))
            frame_lighting, about = np.array(head["frame_lighting"], np.int64), dict(head["about"])
        path = regular(folder / "field.safetensors")
        with damaged(path, "build the scene again"):
            tensors = load_file(str(path), device=where)
            appearance = Appearance(
                names, frames, frame_lighting, tensors["appearance.vectors"], tensors["appearance.residuals"]
            )
            parameters = {k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")}
            grids = tensors["grid.near"], tensors["grid.far"]
            return RadianceField(layout, appearance, tensors["table"], parameters, grids, about)


def untrained(layout: Layout, appearance: Appearance, seed: int, where: str) -> RadianceField:
    """A field before its first step: nearly transparent everywhere."""
    generator = torch.Generator().manual_seed(seed)
    table = (torch.rand(layout.levels, 2**layout.log2_table, hashgrid.FEATURES, generator=generator) - 0.5) * 2e-2
    parameters = network.initial_parameters(
        layout.levels * hashgrid.FEATURES, layout.hidden, layout.appearance_dim, seed
    )
    stop = opacity_grids(layout.space)
    near = torch.full(stop.near_shape, -math.expm1(-layout.density_unit * stop.near_cell), device=where)
    far = torch.full(stop.far_shape, -math.expm1(-layout.density_unit * stop.far_cell), device=where)
    moved = Appearance(
        appearance.lightings,
        appearance.frames,
        appearance.frame_lighting,
        appearance.vectors.to(where),
        appearance.residuals.to(where),
    )
    on_device = {name: value.to(where) for name, value in parameters.items()}
    return RadianceField(layout, moved, table.to(where), on_device, (near, far))
