"""Camera refinement: while the field is trained, frames move a little until what each saw lines up with the others.

A frame's *correction* is a translation [m] and a rotation vector about its centre [rad], both in the world's axes.
Along a ray the samples keep their distances from the camera, so with the gradient gᵢ of the loss at sample i, at
distance tᵢ along the unit direction d, the gradient of the translation is Σ gᵢ and that of the rotation d × Σ tᵢ·gᵢ.
How colours change with the direction they are seen from pulls at no camera. Corrections have no mean: where all frames
move alike, the place does.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
import warp as wp

from twin.geometry.cameras import Cameras
from twin.nerf.buffers import CameraArrays, Workspace, view
from twin.nerf.field import RadianceField
from twin.nerf.kernels import rays
from twin.types import Array

_STEP = 0.05  # [px] of a training frame, by which a step moves a picture at first
_NEIGHBOURS = 2  # training frames whose corrections a frame that was not trained on gets the mean of


class Refinement:
    """The corrections of n frames under training, and the cameras with them."""

    def __init__(self, camera_to_world: Array, intrinsics: Array, near: float, ws: Workspace) -> None:
        """
        Args:
            camera_to_world: Of the frames as given, shape (n, 4, 4).
            intrinsics: fx, fy, cx, cy [px of a training frame], shape (n, 4).
            near: How far what is near is from the cameras [m]; what a translation is worth in pixels.
            ws: Of the training.
        """
        wp.load_module(rays.__name__, device=ws.where)  # two threads that first need it would each compile it
        n, where = len(camera_to_world), ws.where
        self.turn = torch.zeros(n, 3, device=where, requires_grad=True)
        """Rotation vectors [rad], shape (n, 3)."""
        self.shift = torch.zeros(n, 3, device=where, requires_grad=True)
        """Translations [m], shape (n, 3)."""
        self._given = torch.as_tensor(camera_to_world, device=where, dtype=torch.float64)
        self.arrays = CameraArrays(camera_to_world, intrinsics, where)
        angle = _STEP / float(np.median(intrinsics[:, 0]))
        self._rates = angle, angle * near
        groups = [{"params": [self.turn]}, {"params": [self.shift]}]
        self._optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12)
        self._ws = ws
        self._positions_grad = torch.zeros(ws.rays * ws.samples, 3, device=where)
        self._ray_grad = torch.zeros(2, ws.rays, 3, device=where)
        on_rays = self._positions_grad.view(ws.rays, ws.samples, 3)
        self._w_positions_grad, self._w_ray_positions_grad = (
            view(self._positions_grad, wp.vec3f),
            view(on_rays, wp.vec3f),
        )
        self._w_ray_grad: list[Any] = [view(part, wp.vec3f) for part in self._ray_grad]

    def backward(self, field: RadianceField, start: int, count: int) -> None:
        """Gradients of rays [start, start + count), after those of their samples' features."""
        ws = self._ws
        wp.launch(
            rays.encode_positions_backward,
            count * ws.samples,
            [
                *(ws.w_positions, field.w_table, field.w_cells, field.w_shapes, field.mask, start * ws.samples),
                ws.w_features_grad,
            ],
            [self._w_positions_grad],
            device=field.where,
        )
        wp.launch(
            rays.rays_backward,
            count,
            [
                *(ws.w_origins, ws.w_directions, ws.w_distances, field.centre, field.inverse_half, start),
                self._w_ray_positions_grad,
            ],
            self._w_ray_grad,
            device=field.where,
        )

    def step(self, rate: float) -> None:
        """Moves the cameras; `rate` is a share of the learning rate."""
        frame = self._ws.camera.long()
        origin, direction = self._ray_grad
        turning = torch.linalg.cross(self._ws.directions, direction)
        self.shift.grad = torch.zeros_like(self.shift).index_add_(0, frame, origin)
        self.turn.grad = torch.zeros_like(self.turn).index_add_(0, frame, turning)
        for group, most in zip(self._optimiser.param_groups, self._rates, strict=True):
            group["lr"] = most * rate
        self._optimiser.step()
        with torch.no_grad():
            for part in (self.turn, self.shift):
                part -= part.mean(0)
            pose = corrected(self._given, self.turn.double(), self.shift.double()).cpu().numpy()
        self.arrays.set_poses(pose)

    def refined(self, cameras: Cameras) -> tuple[Cameras, dict[str, float]]:
        """All frames of a training with the corrections of those trained on, and how far these moved [m], [°].

        A frame that was not trained on gets the mean correction of the `_NEIGHBOURS` of its source next to it in time.
        """
        turn, shift = (part.detach().cpu().double().numpy() for part in (self.turn, self.shift))
        every = np.zeros((len(cameras), 6))
        trained, sources = np.flatnonzero(~cameras.held_out), np.array(cameras.sources)
        every[trained] = np.concatenate([turn, shift], 1)
        for i in np.flatnonzero(cameras.held_out):
            mine = trained[sources[trained] == sources[i]]
            if len(mine):
                near = mine[np.argsort(np.abs(cameras.times[mine] - cameras.times[i]), kind="stable")[:_NEIGHBOURS]]
                every[i] = every[near].mean(0)
        moved = torch.as_tensor(every)
        pose = corrected(torch.as_tensor(cameras.camera_to_world), moved[:, :3], moved[:, 3:]).numpy()
        metres, degrees = np.linalg.norm(shift, axis=1), np.rad2deg(np.linalg.norm(turn, axis=1))
        said = {"median_m": float(np.median(metres)), "most_m": float(metres.max())}
        said |= {"median_deg": float(np.median(degrees)), "most_deg": float(degrees.max())}
        return replace(cameras, camera_to_world=pose), said


def corrected(camera_to_world: torch.Tensor, turn: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """Poses (n, 4, 4) turned by rotation vectors (n, 3) [rad] about their centres and shifted by (n, 3) [m]."""
    x, y, z = turn.unbind(-1)
    none = torch.zeros_like(x)
    skew = torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).reshape(-1, 3, 3)
    out = camera_to_world.clone()
    out[:, :3, :3] = torch.linalg.matrix_exp(skew) @ camera_to_world[:, :3, :3]
    out[:, :3, 3] += shift
    return out
