"""Votes of views: surfaces seen edge-on have little weight, and free votes reach further than surface votes."""

import numpy as np
import pytest

from twin.assets import tsdf
from twin.assets.tsdf import FREE_SPACE_REACH, color_points, fuse
from twin.assets.views import Views
from twin.geometry.poses import look_at

BAND, FAR = 0.3, 10.0


def views(depth: list[float], slant: list[float]) -> Views:
    """Views from one place along z, each of a surface at one depth [m]."""
    n, shape = len(depth), (len(depth), 5, 5)
    flat = np.ones(shape, np.float32)
    return Views(
        np.tile(np.eye(4), (n, 1, 1)),
        np.tile([5.0, 5.0, 2.5, 2.5], (n, 1)),
        np.zeros((*shape, 3), np.uint8),
        flat * np.array(depth, np.float32)[:, None, None],
        flat * np.array(slant, np.float32)[:, None, None],
        np.zeros(shape, np.float32),
    )


def vote(z: float, *seen: tuple[float, float]) -> tuple[float, float, float]:
    """Distance, near and free votes at depth z, from views given by (depth, slant)."""
    found = fuse(np.array([[0.0, 0.0, z]]), views(*map(list, zip(*seen, strict=True))), BAND, FAR)
    return tuple(float(values[0]) for values in found)


def test_two_surface_votes_outvote_a_free_vote_unless_edge_on():
    behind = 0.25  # [m] the point lies so far behind the surface
    square = vote(5.0, (5.0 - behind, 1.0), (5.0 - behind, 1.0), (9.0, 1.0))
    lean = 0.12
    edge_on = vote(5.0, (5.0 - behind / lean, lean), (5.0 - behind / lean, lean), (9.0, 1.0))
    assert square[0] < 0.0
    assert edge_on[0] > 0.5 * BAND
    assert edge_on[1] == pytest.approx(lean**2 * square[1], rel=1e-4)


def test_free_votes_reach_further_than_surface_votes():
    assert vote(1.5 * FAR, (1.5 * FAR, 1.0))[1:] == (0.0, 0.0)
    near, free = vote(1.5 * FAR, (3.0 * FAR, 1.0))[1:]
    assert near == 0.0 and free > 0.0
    assert vote(1.5 * FAR, (1.55 * FAR, 1.0))[2] == 0.0  # too near to the surface to be told from it
    assert vote(1.01 * FREE_SPACE_REACH * FAR, (9.0 * FAR, 1.0))[2] == 0.0


def along_a_road(count: int) -> Views:
    """Views of 12×8 px every 2 m along x, each turned a little; depths at random, some unreliable."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        yaw = rng.uniform(-0.6, 0.6)
        ahead = np.array([np.cos(yaw), np.sin(yaw), -0.1])
        poses[i] = look_at(np.array([2.0 * i, 0.0, 1.5]), np.array([2.0 * i, 0.0, 1.5]) + ahead)
    shape = (count, 8, 12)
    depth = rng.uniform(1.0, 12.0, shape).astype(np.float32)
    depth[rng.random(shape) < 0.1] = 0.0
    return Views(
        poses,
        np.tile([6.0, 6.0, 6.0, 4.0], (count, 1)),
        rng.integers(0, 255, (*shape, 3)).astype(np.uint8),
        depth,
        rng.uniform(0.2, 1.0, shape).astype(np.float32),
        np.zeros(shape, np.float32),
    )


def test_leaving_out_views_that_see_nothing_changes_nothing(monkeypatch):
    seen, rng = along_a_road(60), np.random.default_rng(1)
    points = rng.uniform([-5.0, -9.0, -1.0], [125.0, 9.0, 4.0], (20_000, 3))
    normals = rng.standard_normal(points.shape)
    fused, colored = fuse(points, seen, BAND, 4.0), color_points(points, normals, seen, BAND, 14.0)
    most = max(len(chosen) for _, chosen in tsdf._groups(points, seen, FREE_SPACE_REACH * 4.0))
    assert most < 20, "views far away must be left out"
    assert np.isfinite(fused[0]).mean() > 0.01 and 0.01 < colored[1].mean() < 1.0
    everything = np.arange(len(points)), np.arange(len(seen))
    monkeypatch.setattr(tsdf, "_groups", lambda *_: [everything])
    for mine, all_views in zip(
        (*fused, *colored),
        (*fuse(points, seen, BAND, 4.0), *color_points(points, normals, seen, BAND, 14.0)),
        strict=True,
    ):
        np.testing.assert_array_equal(mine, all_views)
