"""A renderer of Nerfacto's size in plain torch: what a frame costs without this project's march and bricks.

Sizes as published with Nerfacto (Tancik et al. 2023, "Nerfstudio"; see the constants); weights are random, for timing
only. Written from those sizes with what plain torch offers: columns are samples, so that every network is one product
of matrices; what is the same for all samples of a ray or a frame is computed once. *Spacing* is the coordinate s in
[0, 1] along a ray: uniform in distance up to one unit, in inverse distance beyond. *Edges* bound the samples of a ray.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_PROPOSALS = ((256, 128), (96, 256))  # samples and finest resolution of each proposal network
_PROPOSAL_LEVELS, _PROPOSAL_LOG2, _PROPOSAL_HIDDEN = 5, 17, 16
_SAMPLES = 48
_LEVELS, _LOG2, _FINEST, _HIDDEN = 16, 19, 2048, 64
_COARSEST = 16
_FEATURES = 2  # per level
_GEOMETRY, _APPEARANCE, _HARMONICS = 15, 32, 16
_NEAR, _FAR = 0.05, 1000.0  # [half sides of the near box]
_PADDING = 0.01  # added to every weight before resampling, so that no place is ruled out
_PRIMES = (1, 2654435761 - 2**32, 805459861)  # of the spatial hash (Müller et al. 2022), as signed 32-bit numbers


class HashGrid:
    """A multiresolution hash encoding, `_FEATURES` features per level."""

    def __init__(self, levels: int, log2_table: int, finest: int, generator: torch.Generator):
        growth = (finest / _COARSEST) ** (1 / (levels - 1))
        self.resolutions = [int(_COARSEST * growth**level + 1e-6) for level in range(levels)]
        self.table = (torch.rand(levels, 2**log2_table, _FEATURES, generator=generator) - 0.5) * 2e-4

    def __call__(self, points: Tensor) -> Tensor:
        """Features (levels × 2, n) at points (3, n) in [0, 1)."""
        out = torch.zeros(_FEATURES * len(self.resolutions), points.shape[1])
        size = self.table.shape[1]
        # Both features of an entry are gathered as one number of twice the width.
        pairs = self.table.view(torch.float64).squeeze(-1)
        for level, resolution in enumerate(self.resolutions):
            # Levels that fit are dense, the others hashed.
            dense = (resolution + 1) ** 3 <= size
            strides = (1, resolution + 1, (resolution + 1) ** 2) if dense else _PRIMES
            scaled = points * resolution
            low = scaled.floor()
            share = scaled.sub_(low)
            shares = (1.0 - share, share)
            corner = low.int()
            for axis in (1, 2):
                corner[axis] *= strides[axis]
            at = [(corner[axis], corner[axis] + strides[axis]) for axis in range(3)]
            first, second = out[2 * level], out[2 * level + 1]
            for i in (0, 1):
                for j in (0, 1):
                    plane = at[0][i] + at[1][j] if dense else at[0][i] ^ at[1][j]
                    weight = shares[i][0] * shares[j][1]
                    for k in (0, 1):
                        index = plane + at[2][k] if dense else (plane ^ at[2][k]).bitwise_and_(size - 1)
                        value = pairs[level].index_select(0, index).view(torch.float32).view(-1, _FEATURES)
                        whole = weight * shares[k][2]
                        first.addcmul_(value[:, 0], whole)
                        second.addcmul_(value[:, 1], whole)
        return out


class Linear:
    """A layer on columns."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator):
        self.weight = torch.randn(outputs, inputs, generator=generator) * (2.0 / inputs) ** 0.5
        self.bias = torch.zeros(outputs, 1)

    def __call__(self, x: Tensor) -> Tensor:
        return torch.addmm(self.bias, self.weight, x)


class Proposal:
    """A proposal network: density alone."""

    def __init__(self, finest: int, generator: torch.Generator):
        self.grid = HashGrid(_PROPOSAL_LEVELS, _PROPOSAL_LOG2, finest, generator)
        self.first = Linear(_FEATURES * _PROPOSAL_LEVELS, _PROPOSAL_HIDDEN, generator)
        self.second = Linear(_PROPOSAL_HIDDEN, 1, generator)

    def density(self, points: Tensor) -> Tensor:
        """Shape (3, n) → (n,)."""
        return self.second(self.first(self.grid(unit_cube(points))).relu_())[0].exp_()


class MainField:
    """The field that is shown: density, and colour by direction and appearance."""

    def __init__(self, generator: torch.Generator):
        self.grid = HashGrid(_LEVELS, _LOG2, _FINEST, generator)
        self.first = Linear(_FEATURES * _LEVELS, _HIDDEN, generator)
        self.second = Linear(_HIDDEN, 1 + _GEOMETRY, generator)
        self.head = [
            Linear(_GEOMETRY + _HARMONICS + _APPEARANCE, _HIDDEN, generator),
            Linear(_HIDDEN, _HIDDEN, generator),
            Linear(_HIDDEN, 3, generator),
        ]
        self.appearance = torch.randn(_APPEARANCE, 1, generator=generator)

    def density_and_colour(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density (r × s,) and colour (3, r × s) at points (3, r × s) of r rays with unit directions (3, r)."""
        rays = directions.shape[1]
        out = self.second(self.first(self.grid(unit_cube(points))).relu_())
        weight = self.head[0].weight
        # Direction and appearance are those of the ray: their part of the first layer is its bias.
        split = (_GEOMETRY, _GEOMETRY + _HARMONICS)
        of_ray = weight[:, split[0] : split[1]] @ harmonics(directions)
        of_ray += self.head[0].bias + weight[:, split[1] :] @ self.appearance
        hidden = (weight[:, : split[0]] @ out[1:]).view(_HIDDEN, rays, -1)
        hidden = hidden.add_(of_ray[:, :, None]).relu_().view(_HIDDEN, -1)
        return out[0].exp(), self.head[2](self.head[1](hidden).relu_()).sigmoid_()


@dataclass(frozen=True)
class Nerfacto:
    """The functions a frame is made of; distances in half sides of the near box."""

    proposals: tuple[Callable[[Tensor], Tensor], ...]
    """Each: points (3, n) → density (n,)."""
    proposal_samples: tuple[int, ...]
    field: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    """Points (3, r × s), directions (3, r) → density (r × s,), colour (3, r × s)."""
    samples: int = _SAMPLES

    @staticmethod
    def random(seed: int = 0) -> "Nerfacto":
        """With random weights."""
        generator = torch.Generator().manual_seed(seed)
        proposals = tuple(Proposal(finest, generator).density for _, finest in _PROPOSALS)
        counts = tuple(samples for samples, _ in _PROPOSALS)
        return Nerfacto(proposals, counts, MainField(generator).density_and_colour)

    @torch.no_grad()
    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Colour (3, r), median distance (r,) and opacity (r,) of rays; origins and unit directions (3, r)."""
        spacing = torch.linspace(0.0, 1.0, self.proposal_samples[0] + 1).expand(origins.shape[1], -1)
        following = (*self.proposal_samples[1:], self.samples)
        for density, count in zip(self.proposals, following, strict=True):
            edges = distance_of(spacing)
            weights = weights_of(density(points_on(origins, directions, edges)).view(len(edges), -1), edges)
            spacing = resampled(spacing, weights, count)
        edges = distance_of(spacing)
        density, colour = self.field(points_on(origins, directions, edges), directions)
        weights = weights_of(density.view(len(edges), -1), edges)
        rgb = (colour.view(3, *weights.shape) * weights).sum(-1)
        reached = weights.cumsum(-1)
        middle = (edges[:, 1:] + edges[:, :-1]) / 2
        half = torch.searchsorted(reached, torch.full((len(edges), 1), 0.5)).clamp_(max=middle.shape[1] - 1)
        return rgb, middle.gather(1, half)[:, 0], reached[:, -1]

    def frame(
        self, camera_to_world: Tensor, intrinsics: Tensor, size: tuple[int, int], chunk: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colour (h, w, 3), z-depth (h, w) and opacity (h, w) of one view.

        Args:
            camera_to_world: OpenCV axes, shape (4, 4).
            intrinsics: fx, fy, cx, cy [px] at `size`, shape (4,).
            size: Width, height [px].
            chunk: Rays at a time.
        """
        width, height = size
        v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        fx, fy, cx, cy = intrinsics.tolist()
        local = torch.stack([(u.reshape(-1) - cx) / fx, (v.reshape(-1) - cy) / fy, torch.ones(width * height)])
        cosine = 1.0 / local.norm(dim=0)
        directions = camera_to_world[:3, :3] @ (local * cosine)
        origins = camera_to_world[:3, 3:].expand(3, chunk)
        parts = [self.rays(origins[:, : d.shape[1]], d) for d in directions.split(chunk, 1)]
        rgb, distance, opacity = (torch.cat(column, -1) for column in zip(*parts, strict=True))
        return rgb.T.reshape(height, width, 3), (distance * cosine).view(height, width), opacity.view(height, width)


def spacing_of(distance: Tensor) -> Tensor:
    """s of distances, up to scale: half of [0, 1] for the first unit, the other half for all that is beyond."""
    return torch.where(distance < 1.0, distance / 2, 1.0 - 0.5 / distance)


def distance_of(spacing: Tensor) -> Tensor:
    """Distances of s in [0, 1], from `_NEAR` to `_FAR`."""
    near, far = spacing_of(torch.tensor([_NEAR, _FAR])).tolist()
    s = near + (far - near) * spacing
    return torch.where(s < 0.5, 2.0 * s, 0.5 / (1.0 - s))


def points_on(origins: Tensor, directions: Tensor, edges: Tensor) -> Tensor:
    """The middles between edges (r, s + 1) on rays (3, r): shape (3, r × s)."""
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    return (origins[:, :, None] + directions[:, :, None] * middle).view(3, -1)


def unit_cube(points: Tensor) -> Tensor:
    """Space contracted to a cube (in the maximum norm, after Barron et al. 2022, eq. 10), scaled to [0, 1)."""
    norm = points.abs().amax(0).clamp_(min=1.0)
    return points.mul((2.0 - 1.0 / norm) / norm).mul_(0.25).add_(0.5).clamp_(0.0, 1.0 - 1e-6)


def weights_of(density: Tensor, edges: Tensor) -> Tensor:
    """Share of the light that each sample stops (Mildenhall et al. 2020, eq. 3); (r, s) and (r, s + 1) → (r, s)."""
    depth = density * (edges[:, 1:] - edges[:, :-1])
    before = torch.nn.functional.pad(depth[:, :-1], (1, 0)).cumsum_(-1)  # no difference of sums: those may be huge
    return depth.neg_().expm1_().neg_().mul_(before.neg_().exp_())


def resampled(spacing: Tensor, weights: Tensor, count: int) -> Tensor:
    """Edges (r, count + 1) at equal shares of the weight between edges (r, s + 1); all in s."""
    padded = weights + _PADDING
    share = torch.nn.functional.pad(padded.cumsum(-1) / padded.sum(-1, keepdim=True), (1, 0)).clamp_(max=1.0)
    wanted = ((torch.arange(count + 1) + 0.5) / (count + 1)).expand(len(weights), -1).contiguous()
    above = torch.searchsorted(share, wanted, right=True).clamp_(1, share.shape[1] - 1)
    below = above - 1
    low, high = share.gather(1, below), share.gather(1, above)
    at = ((wanted - low) / (high - low).clamp_(min=1e-9)).clamp_(0.0, 1.0)
    start = spacing.gather(1, below)
    return start + at * (spacing.gather(1, above) - start)


def harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 3 (4 bands) of unit vectors, up to constant factors: (3, n) → (16, n)."""
    x, y, z = d
    xx, yy, zz = x * x, y * y, z * z
    rows = [torch.ones_like(x), x, y, z, x * y, y * z, 3.0 * zz - 1.0, x * z, xx - yy, y * (3.0 * xx - yy)]
    rows += [x * y * z, y * (5.0 * zz - 1.0), z * (5.0 * zz - 3.0), x * (5.0 * zz - 1.0), z * (xx - yy)]
    return torch.stack([*rows, x * (xx - 3.0 * yy)])
