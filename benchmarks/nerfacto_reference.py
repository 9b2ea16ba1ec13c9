"""Nerfacto in plain torch, the baseline for the renderer's speed.

Nerfacto is described in Tancik et al. 2023, "Nerfstudio" (arXiv 2302.04264), its hash grid in Müller et al. 2022,
"Instant NGP", its proposal networks and contraction of space in Barron et al. 2022, "Mip-NeRF 360". The sizes are the
published ones; the weights are random, as only time is measured. The code follows the papers without optimization:
every sample passes through every network on concatenated inputs, as in nerfstudio's torch implementation.
`nerfacto_tuned.py` renders the same image with optimized torch code.

Shapes: r rays, s samples on each, s + 1 *edges* that bound the samples. The *near box* is [-1, 1]³, where space is not
contracted; half its side is the unit of length. *Spacing* is a coordinate in [0, 1] along a ray: uniform in distance up
to one unit, and in inverse distance beyond.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

PROPOSAL_SAMPLES = (256, 96)
SAMPLES = 48
CHUNK = 1 << 15
"""Rays per chunk: nerfstudio's `eval_num_rays_per_chunk` for Nerfacto. A 160×90 image is a single chunk."""
_PROPOSAL_FINEST = (128, 256)
_PROPOSAL_LEVELS, _PROPOSAL_LOG2, _PROPOSAL_HIDDEN = 5, 17, 16
_LEVELS, _LOG2, _FINEST, _HIDDEN = 16, 19, 2048, 64
_COARSEST = 16
FEATURES = 2  # per level of a hash grid
GEOMETRY, _APPEARANCE, HARMONICS = 15, 32, 16
NEAR, FAR = 0.05, 1000.0  # [half sides of the near box]
_PADDING = 0.01  # added to every weight before resampling, so that no interval has probability zero
_PRIMES = torch.tensor([1, 2654435761, 805459861])
_CORNERS = torch.tensor(list(itertools.product((0, 1), repeat=3)))  # (8, 3)


class HashGrid:
    """A multiresolution hash encoding (Müller et al. 2022, section 3): features at the vertices of grids."""

    def __init__(self, levels: int, log2_table: int, finest: int):
        growth = (finest / _COARSEST) ** (1 / (levels - 1))
        self.resolutions = [int(_COARSEST * growth**level + 1e-6) for level in range(levels)]
        self.table = (torch.rand(levels, 2**log2_table, FEATURES) - 0.5) * 2e-4

    def __call__(self, points: Tensor) -> Tensor:
        """Features (..., levels × 2) at points (..., 3) in [0, 1): trilinear on each level, then concatenated."""
        features = []
        for table, resolution in zip(self.table, self.resolutions, strict=True):
            scaled = points * resolution
            low = scaled.floor().long()
            share = scaled - low
            level = torch.zeros(*points.shape[:-1], FEATURES)
            for corner in _CORNERS:
                x, y, z = torch.where(corner == 1, share, 1.0 - share).unbind(-1)
                level = level + (x * y * z)[..., None] * table[spatial_hash(low + corner, len(table))]
            features.append(level)
        return torch.cat(features, -1)


class Proposal:
    """A proposal network, which returns density only."""

    def __init__(self, finest: int):
        self.grid = HashGrid(_PROPOSAL_LEVELS, _PROPOSAL_LOG2, finest)
        self.mlp = mlp(FEATURES * _PROPOSAL_LEVELS, _PROPOSAL_HIDDEN, 1)

    def __call__(self, points: Tensor) -> Tensor:
        """Density (r, s) at points (r, s, 3)."""
        return self.mlp(self.grid(unit_cube(points)))[..., 0].exp()


class Field:
    """The main field: density, and color that depends on direction and appearance."""

    def __init__(self) -> None:
        self.grid = HashGrid(_LEVELS, _LOG2, _FINEST)
        self.base = mlp(FEATURES * _LEVELS, _HIDDEN, 1 + GEOMETRY)
        self.head = mlp(GEOMETRY + HARMONICS + _APPEARANCE, _HIDDEN, _HIDDEN, 3)
        self.appearance = torch.randn(_APPEARANCE)

    def __call__(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Density (r, s) and color (r, s, 3) at points (r, s, 3) of rays with unit directions (r, 3)."""
        density, geometry = self.base(self.grid(unit_cube(points))).split([1, GEOMETRY], -1)
        samples = points.shape[:-1]
        seen_from = harmonics(directions)[:, None].expand(*samples, -1)
        color = self.head(torch.cat([geometry, seen_from, self.appearance.expand(*samples, -1)], -1)).sigmoid()
        return density[..., 0].exp(), color


@dataclass(frozen=True)
class Nerfacto:
    """The renderer: proposal sampling and compositing; distances in half sides of the near box."""

    proposals: tuple[Callable[[Tensor], Tensor], ...]
    """Same arguments and result as `Proposal`."""
    field: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    """Same arguments and result as `Field`."""

    @torch.no_grad()
    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Color (r, 3), median distance (r,) and opacity (r,) of rays; origins and unit directions (r, 3)."""
        spacing = torch.linspace(0.0, 1.0, PROPOSAL_SAMPLES[0] + 1).expand(len(origins), -1)
        for density_of, following in zip(self.proposals, (*PROPOSAL_SAMPLES[1:], SAMPLES), strict=True):
            edges = distance_of(spacing)
            weights = weights_of(density_of(points_on(origins, directions, edges)), edges)
            spacing = resampled(spacing, weights, following)
        edges = distance_of(spacing)
        density, color = self.field(points_on(origins, directions, edges), directions)
        weights = weights_of(density, edges)
        rgb = (weights[..., None] * color).sum(1)
        reached = weights.cumsum(-1)
        middle = (edges[:, 1:] + edges[:, :-1]) / 2
        half = torch.searchsorted(reached, torch.full((len(edges), 1), 0.5)).clamp(max=middle.shape[1] - 1)
        return rgb, middle.gather(1, half)[:, 0], weights.sum(-1)

    def frame(
        self, camera_to_world: Tensor, intrinsics: Tensor, size: tuple[int, int], chunk: int = CHUNK
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Color (h, w, 3), z-depth (h, w) and opacity (h, w) of one view.

        Args:
            camera_to_world: OpenCV axes, shape (4, 4).
            intrinsics: fx, fy, cx, cy [px] at `size`, shape (4,).
            size: Width, height [px].
            chunk: Rays per chunk.
        """
        width, height = size
        v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        fx, fy, cx, cy = intrinsics.tolist()
        local = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones(height, width)], -1).view(-1, 3)
        cosine = 1.0 / local.norm(dim=-1)
        directions = (local * cosine[:, None]) @ camera_to_world[:3, :3].T
        origins = camera_to_world[:3, 3].expand(len(directions), 3)
        parts = [self.rays(*some) for some in zip(origins.split(chunk), directions.split(chunk), strict=True)]
        rgb, distance, opacity = (torch.cat(column) for column in zip(*parts, strict=True))
        return rgb.view(height, width, 3), (distance * cosine).view(height, width), opacity.view(height, width)


def networks(seed: int = 0) -> tuple[tuple[Proposal, ...], Field]:
    """Proposal networks and field of the published sizes, with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return tuple(Proposal(finest) for finest in _PROPOSAL_FINEST), Field()


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers with rectifiers between them: shape (..., first width) → (..., last width)."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def spatial_hash(vertices: Tensor, size: int) -> Tensor:
    """Index of vertices (..., 3) in a table (Müller et al. 2022, eq. 4): shape (...)."""
    x, y, z = (vertices * _PRIMES).unbind(-1)
    return (x ^ y ^ z) % size


def spacing_of(distance: Tensor) -> Tensor:
    """Unscaled spacing of distances: in [0, 0.5] up to one unit, in [0.5, 1] beyond."""
    return torch.where(distance < 1.0, distance / 2, 1.0 - 0.5 / distance)


def distance_of(spacing: Tensor) -> Tensor:
    """Distances of a spacing in [0, 1], from `NEAR` to `FAR`."""
    near, far = spacing_of(torch.tensor([NEAR, FAR]))
    s = near + (far - near) * spacing
    return torch.where(s < 0.5, 2.0 * s, 0.5 / (1.0 - s))


def points_on(origins: Tensor, directions: Tensor, edges: Tensor) -> Tensor:
    """Midpoints (r, s, 3) between edges (r, s + 1) on rays (r, 3)."""
    middle = (edges[:, 1:] + edges[:, :-1]) / 2
    return origins[:, None] + directions[:, None] * middle[..., None]


def unit_cube(points: Tensor) -> Tensor:
    """Points (..., 3) contracted to a cube and scaled to [0, 1): Barron et al. 2022, eq. 10, in the maximum norm."""
    norm = points.abs().amax(-1, keepdim=True).clamp(min=1.0)
    return ((2.0 - 1.0 / norm) * points / norm + 2.0) / 4.0


def weights_of(density: Tensor, edges: Tensor) -> Tensor:
    """Compositing weights of samples (Mildenhall et al. 2020, eq. 3): (r, s) and (r, s + 1) → (r, s)."""
    depth = density * (edges[:, 1:] - edges[:, :-1])
    before = torch.cat([torch.zeros(len(depth), 1), depth[:, :-1].cumsum(-1)], -1)
    return (1.0 - torch.exp(-depth)) * torch.exp(-before)


def resampled(spacing: Tensor, weights: Tensor, count: int) -> Tensor:
    """New edges (r, count + 1) at equal quantiles of the weights (r, s) between the edges `spacing` (r, s + 1).

    Barron et al. 2022, section 3, with nerfstudio's padding of the weights.
    """
    padded = weights + _PADDING
    share = torch.cat([torch.zeros(len(padded), 1), (padded / padded.sum(-1, keepdim=True)).cumsum(-1)], -1)
    wanted = ((torch.arange(count + 1) + 0.5) / (count + 1)).repeat(len(weights), 1)
    above = torch.searchsorted(share, wanted, right=True).clamp(1, share.shape[1] - 1)
    low, high = share.gather(1, above - 1), share.gather(1, above)
    start, end = spacing.gather(1, above - 1), spacing.gather(1, above)
    return start + (wanted - low) / (high - low) * (end - start)


def harmonics(d: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 3 of unit vectors, up to constant factors: (n, 3) → (n, 16)."""
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    bands = [torch.ones_like(x), x, y, z, x * y, y * z, 3.0 * zz - 1.0, x * z, xx - yy, y * (3.0 * xx - yy)]
    bands += [x * y * z, y * (5.0 * zz - 1.0), z * (5.0 * zz - 3.0), x * (5.0 * zz - 1.0), z * (xx - yy)]
    return torch.stack([*bands, x * (xx - 3.0 * yy)], -1)
