"""The reference renderer of the benchmarks: its samples and its compositing are those of a radiance field."""

import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import nerfacto_reference as reference
import nerfacto_tuned

sys.path.pop(0)

RAYS = 32
COLOR = torch.tensor([0.2, 0.5, 0.9])
POSE, INTRINSICS, SIZE = torch.eye(4), torch.tensor([10.0, 10.0, 4.0, 3.0]), (8, 6)


def rays() -> tuple[torch.Tensor, torch.Tensor]:
    directions = torch.randn(RAYS, 3, generator=torch.Generator().manual_seed(1))
    return torch.zeros(RAYS, 3), directions / directions.norm(dim=-1, keepdim=True)


def renderer(density) -> reference.Nerfacto:
    """A renderer with a density by formula of points (r, s, 3), and one color everywhere."""
    return reference.Nerfacto((density, density), lambda points, _: (density(points), COLOR.expand(points.shape)))


def vivid_networks():
    """Networks with weights so large that the picture has contrast; the initial features (±1e-4) give an even fog."""
    proposals, field = reference.networks()
    with torch.no_grad():
        for network in (*proposals, field):
            network.grid.table *= 1e5
        for mlp in (*(proposal.mlp for proposal in proposals), field.base, field.head):
            mlp[-1].weight *= 3
    return proposals, field


# The farther, the coarser: 256 samples are uniform in inverse distance beyond one unit.
@pytest.mark.parametrize(("radius", "tolerance"), [(0.3, 0.01), (2.0, 0.02), (40.0, 0.08)])
def test_opaque_shell_renders_at_its_distance(radius, tolerance):
    rgb, distance, opacity = renderer(lambda points: 1e4 * (points.norm(dim=-1) > radius)).rays(*rays())
    assert torch.allclose(distance, torch.full((RAYS,), radius), rtol=tolerance)
    assert torch.allclose(opacity, torch.ones(RAYS), atol=1e-4)
    assert torch.allclose(rgb, COLOR.expand(RAYS, 3), atol=1e-3)


def test_opacity_of_thin_fog_follows_beer_lambert():
    fog = 0.7
    density = lambda points: fog * ((points.norm(dim=-1) > 1.0) & (points.norm(dim=-1) < 2.0))  # noqa: E731
    rgb, _, opacity = renderer(density).rays(*rays())
    assert torch.allclose(opacity, torch.full((RAYS,), 1 - math.exp(-fog)), atol=0.02)
    assert torch.allclose(rgb[:, 1], 0.5 * opacity)


def test_empty_space_is_transparent():
    _, _, opacity = renderer(lambda points: torch.zeros(points.shape[:-1])).rays(*rays())
    assert not opacity.any()


def test_frame_of_random_weights():
    nerfacto = reference.Nerfacto(*reference.networks())
    rgb, depth, opacity = nerfacto.frame(POSE, INTRINSICS, SIZE)
    assert rgb.shape == (6, 8, 3) and depth.shape == opacity.shape == (6, 8)
    assert (opacity >= 0).all() and (opacity <= 1 + 1e-5).all() and (rgb >= 0).all() and (rgb <= 1 + 1e-5).all()
    assert torch.allclose(nerfacto.frame(POSE, INTRINSICS, SIZE, chunk=7)[0], rgb, atol=1e-5)


def test_tuned_renderer_renders_the_same_image():
    networks = vivid_networks()
    plain = reference.Nerfacto(*networks).frame(POSE, INTRINSICS, SIZE)
    tuned = nerfacto_tuned.tuned(*networks).frame(POSE, INTRINSICS, SIZE, chunk=20)
    assert plain[0].std(dim=(0, 1)).min() > 0.01 and plain[1].std() > 0.1  # there is something to see
    assert torch.allclose(plain[0], tuned[0], atol=5e-4) and torch.allclose(plain[2], tuned[2], atol=5e-4)
    # A median jumps to the next sample where a rounding decides.
    assert (torch.isclose(plain[1], tuned[1], atol=5e-4)).float().mean() > 0.9


def test_tuned_grid_has_the_same_features():
    proposals, field = vivid_networks()
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(2))
    for network in (*proposals, field):
        plain, tuned = network.grid(points), nerfacto_tuned.TunedGrid(network.grid)(points.T.contiguous())
        assert torch.allclose(plain, tuned.T, rtol=1e-4, atol=1e-4)


def test_depth_is_along_the_axis():
    nerfacto = renderer(lambda points: 1e4 * (points[..., 2] > 1.5))
    _, depth, _ = nerfacto.frame(POSE, INTRINSICS, SIZE, chunk=16)
    assert torch.allclose(depth, torch.full((6, 8), 1.5), rtol=0.02)


def test_hash_grid_is_trilinear():
    """A vertex has its stored features; the middle of an edge has the mean of its two ends."""
    grid = reference.HashGrid(2, 17, 32)
    corner = torch.tensor([3.0, 5.0, 7.0])
    step = torch.tensor([0.0, 0.0, 1.0])
    for level, resolution in enumerate(grid.resolutions):
        ends = torch.stack([corner, corner + step / 2, corner + step]) / resolution
        a, middle, b = grid(ends)[:, 2 * level : 2 * level + 2]
        assert torch.allclose(middle, (a + b) / 2, atol=1e-8)
        index = (3 ^ (5 * 2654435761) ^ (7 * 805459861)) % 2**17
        assert torch.allclose(a, grid.table[level, index], atol=1e-8)


def test_spacing_and_distance_are_inverse():
    distance = torch.tensor([reference.NEAR, 0.3, 0.99, 1.01, 7.0, reference.FAR])
    low, high = reference.spacing_of(distance[[0, -1]])
    s = (reference.spacing_of(distance) - low) / (high - low)
    assert torch.allclose(reference.distance_of(s), distance, rtol=2e-3)
