"""The reference renderer of the benchmarks: its samples and its compositing are those of a radiance field."""

import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import nerfacto_reference as reference

sys.path.pop(0)

RAYS = 32


def rays() -> tuple[torch.Tensor, torch.Tensor]:
    directions = torch.randn(3, RAYS, generator=torch.Generator().manual_seed(1))
    return torch.zeros(3, RAYS), directions / directions.norm(dim=0)


def renderer(density) -> reference.Nerfacto:
    """With a density by formula of points (3, n), and the same colour everywhere."""
    colour = torch.tensor([[0.2], [0.5], [0.9]])
    return reference.Nerfacto(
        (density, density), (256, 96), lambda points, _: (density(points), colour.expand(3, points.shape[1]))
    )


# The farther, the coarser: 256 samples are uniform in inverse distance beyond one unit.
@pytest.mark.parametrize(("radius", "tolerance"), [(0.3, 0.01), (2.0, 0.02), (40.0, 0.08)])
def test_an_opaque_shell_is_seen_at_its_distance(radius, tolerance):
    rgb, distance, opacity = renderer(lambda points: 1e4 * (points.norm(dim=0) > radius)).rays(*rays())
    assert torch.allclose(distance, torch.full((RAYS,), radius), rtol=tolerance)
    assert torch.allclose(opacity, torch.ones(RAYS), atol=1e-4)
    assert torch.allclose(rgb, torch.tensor([[0.2], [0.5], [0.9]]).expand(3, RAYS), atol=1e-3)


def test_a_thin_fog_stops_what_the_law_says():
    fog = 0.7
    rgb, _, opacity = renderer(lambda points: fog * ((points.norm(dim=0) > 1.0) & (points.norm(dim=0) < 2.0))).rays(
        *rays()
    )
    assert torch.allclose(opacity, torch.full((RAYS,), 1 - math.exp(-fog)), atol=0.02)
    assert torch.allclose(rgb[1], 0.5 * opacity)


def test_empty_space_stops_nothing():
    _, _, opacity = renderer(lambda points: torch.zeros(points.shape[1])).rays(*rays())
    assert not opacity.any()


def test_a_frame_of_random_weights():
    pose, intrinsics = torch.eye(4), torch.tensor([10.0, 10.0, 4.0, 3.0])
    nerfacto = reference.Nerfacto.random()
    rgb, depth, opacity = nerfacto.frame(pose, intrinsics, (8, 6), chunk=20)
    assert rgb.shape == (6, 8, 3) and depth.shape == opacity.shape == (6, 8)
    assert (opacity >= 0).all() and (opacity <= 1 + 1e-5).all() and (rgb >= 0).all() and (rgb <= 1 + 1e-5).all()
    assert torch.allclose(nerfacto.frame(pose, intrinsics, (8, 6), chunk=7)[0], rgb, atol=1e-5)


def test_depth_is_along_the_axis():
    nerfacto = renderer(lambda points: 1e4 * (points[2] > 1.5))
    _, depth, _ = nerfacto.frame(torch.eye(4), torch.tensor([10.0, 10.0, 4.0, 3.0]), (8, 6), chunk=16)
    assert torch.allclose(depth, torch.full((6, 8), 1.5), rtol=0.02)


def test_the_hash_grid_is_trilinear():
    """At a vertex the stored features; half way along an edge the mean of its two ends."""
    grid = reference.HashGrid(2, 17, 32, torch.Generator().manual_seed(0))
    corner = torch.tensor([3.0, 5.0, 7.0])
    step = torch.tensor([0.0, 0.0, 1.0])
    for level, resolution in enumerate(grid.resolutions):
        ends = torch.stack([corner, corner + step / 2, corner + step], 1) / resolution
        a, middle, b = grid(ends)[2 * level : 2 * level + 2].T
        assert torch.allclose(middle, (a + b) / 2, atol=1e-8)
        index = int((corner * torch.tensor([1, resolution + 1, (resolution + 1) ** 2])).sum())
        assert torch.allclose(a, grid.table[level, index], atol=1e-8)


def test_spacing_and_distance_are_inverse():
    distance = torch.tensor([reference._NEAR, 0.3, 0.99, 1.01, 7.0, reference._FAR])
    low, high = reference.spacing_of(distance[[0, -1]])
    s = (reference.spacing_of(distance) - low) / (high - low)
    assert torch.allclose(reference.distance_of(s), distance, rtol=2e-3)
