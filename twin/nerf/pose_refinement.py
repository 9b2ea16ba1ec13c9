"""Camera pose refinement during field training.

A frame's *correction* is a translation [m] and a rotation vector about the camera center [rad], both in world axes.
The samples of a ray keep their distances from the camera. Let gᵢ be the gradient of the loss with respect to the
position of sample i, and tᵢ its distance along the unit direction d. Then the gradient with respect to the translation
is Σ gᵢ, and with respect to the rotation d × Σ tᵢ·gᵢ. The dependence of color on the viewing direction is ignored. The
mean of the corrections is kept at zero, as a common motion of all cameras would move the whole place.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from twin.geometry.cameras import Cameras
from twin.nerf.buffers import CameraArrays, Workspace, warp_view
from twin.nerf.field import FieldSection
from twin.nerf.kernels import hashgrid, space
from twin.types import Array
from twin.warp_runtime import wp

_STEP_PIXELS = 0.05  # [px of a training frame] initial image motion per step
_NEIGHBORS = 2  # number of training frames whose mean correction is applied to a held-out frame


class PoseRefinement:
    """Corrections of n training frames, their optimizer, and the corrected cameras (`arrays`)."""

    def __init__(self, camera_to_world: Array, intrinsics: Array, near: float, ws: Workspace) -> None:
        """Starts at poses (n, 4, 4) with intrinsics (n, 4) [px of a training frame].

        `near`, the distance of near surfaces [m], converts pixels to translations. `ws` is the workspace of training.
        """
        n, device = len(camera_to_world), ws.device
        self.rotation = torch.zeros(n, 3, device=device, requires_grad=True)
        """Rotation vectors [rad], shape (n, 3)."""
        self.translation = torch.zeros(n, 3, device=device, requires_grad=True)
        """Translations [m], shape (n, 3)."""
        self._initial = torch.as_tensor(camera_to_world, device=device, dtype=torch.float64)
        self.arrays = CameraArrays(camera_to_world, intrinsics, device)
        angle = _STEP_PIXELS / float(np.median(intrinsics[:, 0]))
        self._rates = angle, angle * near
        groups = [{"params": [self.rotation]}, {"params": [self.translation]}]
        self._optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12)
        self._ws = ws
        self._positions_grad = torch.zeros(ws.rays * ws.samples, 3, device=device)
        self._ray_grad = torch.zeros(2, ws.rays, 3, device=device)
        on_rays = self._positions_grad.view(ws.rays, ws.samples, 3)
        self._w_positions_grad = warp_view(self._positions_grad, wp.vec3f)
        self._w_ray_positions_grad = warp_view(on_rays, wp.vec3f)
        self._w_ray_grad: list[Any] = [warp_view(part, wp.vec3f) for part in self._ray_grad]

    def backward(self, section: FieldSection, start: int, count: int) -> None:
        """Computes gradients of the rays [start, start + count) from the gradients of their samples' features."""
        ws = self._ws
        samples = [ws.w_positions, section.w_table, section.w_levels, start * ws.samples, ws.w_features_grad]
        outputs = [self._w_positions_grad]
        wp.launch(hashgrid.encode_positions_backward, count * ws.samples, samples, outputs, device=section.device)
        rays = [ws.w_rays, ws.w_strata.distances, section.contraction, start, self._w_ray_positions_grad]
        wp.launch(space.rays_backward, count, rays, self._w_ray_grad, device=section.device)

    def step(self, rate: float) -> None:
        """Takes an optimizer step; `rate` scales the learning rates."""
        frame = self._ws.camera.long()
        origin, direction = self._ray_grad
        torque = torch.linalg.cross(self._ws.directions, direction)
        self.translation.grad = torch.zeros_like(self.translation).index_add_(0, frame, origin)
        self.rotation.grad = torch.zeros_like(self.rotation).index_add_(0, frame, torque)
        for group, base in zip(self._optimizer.param_groups, self._rates, strict=True):
            group["lr"] = base * rate
        self._optimizer.step()
        with torch.no_grad():
            for part in (self.rotation, self.translation):
                part -= part.mean(0)
            pose = apply_corrections(self._initial, self.rotation.double(), self.translation.double()).cpu().numpy()
        self.arrays.set_poses(pose)

    def refined_cameras(self, cameras: Cameras) -> tuple[Cameras, dict[str, float]]:
        """Cameras with corrected poses of all frames, and a summary of the motions of the training frames [m], [°].

        A held-out frame gets the mean correction of the `_NEIGHBORS` training frames of its film that are nearest in
        time.
        """
        rotation, translation = (part.detach().cpu().double().numpy() for part in (self.rotation, self.translation))
        every = np.zeros((len(cameras), 6))
        trained, sources = np.flatnonzero(~cameras.held_out), np.array(cameras.sources)
        every[trained] = np.concatenate([rotation, translation], 1)
        for i in np.flatnonzero(cameras.held_out):
            mine = trained[sources[trained] == sources[i]]
            if len(mine):
                near = mine[np.argsort(np.abs(cameras.times[mine] - cameras.times[i]), kind="stable")[:_NEIGHBORS]]
                every[i] = every[near].mean(0)
        moved = torch.as_tensor(every)
        pose = apply_corrections(torch.as_tensor(cameras.camera_to_world), moved[:, :3], moved[:, 3:]).numpy()
        meters, degrees = np.linalg.norm(translation, axis=1), np.rad2deg(np.linalg.norm(rotation, axis=1))
        summary = {"median_m": float(np.median(meters)), "most_m": float(meters.max())}
        summary |= {"median_deg": float(np.median(degrees)), "most_deg": float(degrees.max())}
        return replace(cameras, camera_to_world=pose), summary


def apply_corrections(camera_to_world: torch.Tensor, rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Poses (n, 4, 4), rotated about their centers by rotation vectors (n, 3) [rad] and translated by (n, 3) [m]."""
    x, y, z = rotation.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    out = camera_to_world.clone()
    out[:, :3, :3] = torch.linalg.matrix_exp(skew) @ camera_to_world[:, :3, :3]
    out[:, :3, 3] += translation
    return out
