"""Nerfacto of `nerfacto_reference.py`, optimized for one core in plain torch: same weights, same image.

Optimizations: chunks of few rays, which fit the cache; samples are columns, so a layer is one matrix product; coarse
levels are stored densely; both features of a vertex are gathered as one number; terms that are constant along a ray or
over a frame are computed once. Shapes: n samples in all, r rays.
"""

from typing import Any

import torch
from nerfacto_reference import FEATURES, GEOMETRY, HARMONICS, Field, HashGrid, Nerfacto, Proposal, harmonics
from nerfacto_reference import spatial_hash as hashed
from torch import Tensor

CHUNK = 512
"""Rays per chunk: 256 to 1024 are equally fast on the machine in `docs/benchmarks.md`, more are slower."""
_PRIMES = (1, 2654435761 - 2**32, 805459861)  # as signed 32-bit numbers; only the low bits count


def tuned(proposals: tuple[Proposal, ...], field: Field) -> Nerfacto:
    """The optimized renderer; call its method `frame` with `CHUNK`."""
    return Nerfacto(tuple(TunedProposal(proposal) for proposal in proposals), TunedField(field))


class TunedGrid:
    """Optimized `HashGrid`."""

    def __init__(self, grid: HashGrid):
        self.levels = []  # (resolution, True if dense, both features of each entry as one number)
        for table, resolution in zip(grid.table, grid.resolutions, strict=True):
            dense = (resolution + 1) ** 3 <= len(table)
            if dense:
                vertices = torch.cartesian_prod(*[torch.arange(resolution + 1)] * 3)
                table = table[hashed(vertices, len(table))]
            self.levels.append((resolution, dense, table.contiguous().view(torch.float64).squeeze(-1)))

    def __call__(self, points: Tensor) -> Tensor:
        """Features (levels × 2, n) at points (3, n) in [0, 1)."""
        out = torch.zeros(FEATURES * len(self.levels), points.shape[1])
        for (resolution, dense, pairs), (first, second) in zip(self.levels, out.split(FEATURES), strict=True):
            strides = ((resolution + 1) ** 2, resolution + 1, 1) if dense else _PRIMES
            scaled = points * resolution
            low = scaled.floor()
            share = scaled.sub_(low)
            shares = (1.0 - share, share)
            corner = low.int()
            at = []
            for axis in range(3):
                corner[axis] *= strides[axis]
                at.append((corner[axis], corner[axis] + strides[axis]))
            for i in (0, 1):
                for j in (0, 1):
                    plane = at[0][i] + at[1][j] if dense else at[0][i] ^ at[1][j]
                    weight = shares[i][0] * shares[j][1]
                    for k in (0, 1):
                        index = plane + at[2][k] if dense else (plane ^ at[2][k]).bitwise_and_(len(pairs) - 1)
                        value = pairs.index_select(0, index).view(torch.float32).view(-1, FEATURES)
                        whole = weight * shares[k][2]
                        first.addcmul_(value[:, 0], whole)
                        second.addcmul_(value[:, 1], whole)
        return out


class TunedProposal:
    """Optimized `Proposal`."""

    def __init__(self, plain: Proposal):
        self.grid = TunedGrid(plain.grid)
        self.first, self.second = plain.mlp[0], plain.mlp[2]

    def __call__(self, points: Tensor) -> Tensor:
        """Density (r, s) at points (r, s, 3)."""
        hidden = columns(self.first, self.grid(cube_columns(points))).relu_()
        return columns(self.second, hidden).exp_().view(points.shape[:-1])


class TunedField:
    """Optimized `Field`."""

    def __init__(self, plain: Field):
        self.grid = TunedGrid(plain.grid)
        self.base, self.head, self.appearance = plain.base, plain.head, plain.appearance

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density (r, s) and color (r, s, 3) at points (r, s, 3) of rays with unit directions (r, 3)."""
        samples = points.shape[:-1]
        out = columns(self.base[2], columns(self.base[0], self.grid(cube_columns(points))).relu_())
        # Direction and appearance are constant along a ray: their part of the first layer acts as a bias.
        first: Any = self.head[0]
        w_geometry, w_direction, w_appearance = first.weight.split([GEOMETRY, HARMONICS, len(self.appearance)], 1)
        ray_bias = w_direction @ harmonics(directions).T + (first.bias + w_appearance @ self.appearance)[:, None]
        hidden = (w_geometry @ out[1:]).view(-1, *samples).add_(ray_bias[:, :, None]).relu_().flatten(1)
        color = columns(self.head[4], columns(self.head[2], hidden).relu_()).sigmoid_()
        return out[0].exp().view(samples), color.view(3, *samples).permute(1, 2, 0)


def columns(layer: Any, x: Tensor) -> Tensor:
    """A linear layer on columns (inputs, n): shape (outputs, n)."""
    return torch.addmm(layer.bias[:, None], layer.weight, x)


def cube_columns(points: Tensor) -> Tensor:
    """`unit_cube` with samples as columns: (r, s, 3) → (3, n)."""
    points = points.reshape(-1, 3).T.contiguous()
    norm = points.abs().amax(0).clamp_(min=1.0)
    return points.mul_((2.0 - 1.0 / norm) / norm).mul_(0.25).add_(0.5)
