"""What a radiance field is computed with: its layout, and the arrays of a batch of rays.

A `Workspace` holds everything between the pixels of a batch and their colours, so that nothing is allocated per batch.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from twin.nerf.compute import view
from twin.nerf.kernels import composite as volume
from twin.nerf.kernels import hashgrid
from twin.nerf.sampling import Space

_START_DENSITY = 1.5  # optical depth of the untrained field across the near box's longest half side


@dataclass(frozen=True)
class Layout:
    """Everything about a field that is no learned number."""

    centre: tuple[float, float, float]
    """Of the near box [m]."""
    half: tuple[float, float, float]
    """Half sides of the near box [m]."""
    near_plane: float
    """Rays begin here [m]."""
    levels: int
    growth: float
    log2_table: int
    hidden: int
    appearance_dim: int

    @property
    def space(self) -> Space:
        return Space(self.centre, self.half)

    @property
    def density_unit(self) -> float:
        """Density at raw output 0, per contracted metre."""
        return _START_DENSITY / self.space.scale


class Workspace:
    """Arrays of a batch of `rays` rays with `samples` samples each, and `extra` single points after them."""

    def __init__(self, layout: Layout, rays: int, samples: int, where: str, extra: int = 0, training: bool = False):
        self.rays, self.samples, self.where = rays, samples, where
        rows, channels = rays * samples + extra, volume.CHANNELS
        width = layout.levels * hashgrid.FEATURES

        def new(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, device=where)

        self.camera = torch.zeros(rays, dtype=torch.int32, device=where)
        self.pixel, self.targets, self.cosines = new(rays, 2), new(rays), new(rays)
        self.origins, self.directions = new(rays, 3), new(rays, 3)
        self.edges, self.distances = new(rays, samples + 1), new(rays, samples)
        self.positions, self.features = new(rows, 3), new(rows, width)
        self.hidden, self.outputs = new(rows, layout.hidden), new(rows, channels)
        self.lengths = new(rays, samples)
        self.weights, self.composited = new(rays, samples), new(rays, channels)
        self.inverse_distance, self.median_distance = new(rays), new(rays)

        on_rays = rays * samples
        self.w_camera = view(self.camera, wp.int32)
        self.w_pixel = view(self.pixel, wp.vec2f)
        self.w_targets, self.w_cosines = view(self.targets, wp.float32), view(self.cosines, wp.float32)
        self.w_origins, self.w_directions = view(self.origins, wp.vec3f), view(self.directions, wp.vec3f)
        self.w_edges, self.w_distances = view(self.edges, wp.float32), view(self.distances, wp.float32)
        self.w_lengths = view(self.lengths, wp.float32)
        self.w_positions = view(self.positions, wp.vec3f)
        self.w_ray_positions = view(self.positions[:on_rays].view(rays, samples, 3), wp.vec3f)
        self.w_features = view(self.features.view(rows, layout.levels, hashgrid.FEATURES), hashgrid.Feature)
        self.w_outputs = view(self.outputs, volume.Channels)
        self.w_ray_outputs = view(self.outputs[:on_rays].view(rays, samples, channels), volume.Channels)
        self.w_weights = view(self.weights, wp.float32)
        self.w_composited = view(self.composited, volume.Channels)
        self.w_inverse = view(self.inverse_distance, wp.float32)
        self.w_median = view(self.median_distance, wp.float32)
        if training:
            self.densities = new(rows)
            self.outputs_grad, self.hidden_grad = new(rows, channels), new(rows, layout.hidden)
            self.features_grad = new(rows, width)
            self.composited_grad, self.inverse_grad = new(rays, channels), new(rays)
            self.w_densities = view(self.densities, wp.float32)
            self.w_ray_outputs_grad = view(self.outputs_grad[:on_rays].view(rays, samples, channels), volume.Channels)
            self.w_features_grad = view(
                self.features_grad.view(rows, layout.levels, hashgrid.FEATURES), hashgrid.Feature
            )
            self.w_composited_grad = view(self.composited_grad, volume.Channels)
            self.w_inverse_grad = view(self.inverse_grad, wp.float32)


class CameraArrays:
    """Cameras as the ray kernel wants them."""

    def __init__(self, camera_to_world: NDArray, intrinsics: NDArray, where: str):
        self._where = where
        self.set_poses(camera_to_world)
        self.intrinsics: Any = wp.array(np.asarray(intrinsics, np.float32), dtype=wp.vec4f, device=where)

    def set_poses(self, camera_to_world: NDArray) -> None:
        """Moves the cameras; shape (n, 4, 4)."""
        pose = np.asarray(camera_to_world, np.float64)
        self.rotation: Any = wp.array(pose[:, :3, :3].astype(np.float32), dtype=wp.mat33f, device=self._where)
        self.position: Any = wp.array(pose[:, :3, 3].astype(np.float32), dtype=wp.vec3f, device=self._where)
