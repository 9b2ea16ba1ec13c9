"""Convex decomposition of closed meshes, and clearing the corridor of its parts."""

import threading
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from analytic import right_turn

from twin.assets.convex import (
    ConvexPart,
    SolidPiece,
    _run_child,
    decompose,
    inside_hull,
    split_to_bound,
    surface_samples,
    uncovered_fraction,
)
from twin.assets.ground import Ground
from twin.assets.solids import HEADROOM, Corridor, clear_corridor, clip_part
from twin.geometry.route import distance_to_route
from twin.runtime import bar

BOUND = 0.2  # [m]


def _box(low, high):
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    part = ConvexPart.hull(corners)
    assert part is not None
    return part


def _ell_piece():
    """A closed L, 1 m high, its two arms 2 m long and 0.6 m wide."""
    outline = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 0.6], [0.6, 0.6], [0.6, 2.0], [0.0, 2.0]])
    vertices = np.concatenate([np.insert(outline, 2, 0.0, 1), np.insert(outline, 2, 1.0, 1)])
    top = [[6, 6 + k, 7 + k] for k in range(1, 5)]
    bottom = [[0, k + 1, k] for k in range(1, 5)]
    sides = [[[k, (k + 1) % 6, (k + 1) % 6 + 6], [k, (k + 1) % 6 + 6, k + 6]] for k in range(6)]
    faces = np.array([*top, *bottom, *(face for side in sides for face in side)])
    return SolidPiece.from_mesh(vertices, faces, lambda points: _outside_ell(points) == 0.0)


def _outside_ell(points):
    """Distance [m] of points to the L, 0 inside."""
    arms = []
    for high in ((2.0, 0.6, 1.0), (0.6, 2.0, 1.0)):
        arms.append(np.linalg.norm(np.maximum(np.maximum(-points, points - high), 0.0), axis=1))
    return np.minimum(*arms)


def _flat():
    size = (60, 60)
    return Ground(np.zeros(size), np.array([-5.0, -35.0]), 1.0, np.ones(size, bool), np.zeros((*size, 3), np.uint8))


def _volume(part):
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_hull_is_closed_and_faces_outward():
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 2, 0.5]
    part = ConvexPart.hull(points)
    assert part is not None and len(part.vertices) < len(points)
    assert inside_hull(part, points, 1e-9).all() and not inside_hull(part, 1.5 * part.vertices).any()
    edges = np.sort(part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert _volume(_box((0, 0, 0), (1, 2, 3))) == pytest.approx(6.0)
    assert ConvexPart.hull(points * [1, 1, 0]) is None and ConvexPart.hull(points[:3]) is None


def test_samples_are_on_the_surface_and_within_the_spacing():
    part = _box((0, 0, 0), (1, 1, 1))
    samples = surface_samples(part.vertices, part.faces, 0.1)
    assert np.abs(samples - 0.5).max(1) == pytest.approx(0.5)
    wanted = np.insert(np.random.default_rng(2).uniform(0, 1, (200, 2)), 2, 1.0, 1)
    assert np.linalg.norm(wanted[:, None] - samples, axis=-1).min(1).max() < 0.1


def test_hull_of_an_ell_protrudes_by_the_exact_distance():
    piece = _ell_piece()
    hull = ConvexPart.hull(piece.vertices)
    assert hull is not None
    # The middle of the hull's slanted face is 0.7 m from either arm.
    assert piece.protrusion(hull) == pytest.approx(0.7, abs=0.05)
    assert piece.protrusion(_box((0, 0, 0), (2, 0.6, 1))) == 0.0
    assert piece.protrusion(_box((1, 0, 0), (2, 0.9, 1))) == pytest.approx(0.3, abs=0.05)
    assert uncovered_fraction(piece, [hull], 0.01) == 0.0
    assert 0.2 < uncovered_fraction(piece, [_box((0, 0, 0), (2, 0.6, 1))], 0.05) < 0.6


def test_splitting_alone_reduces_and_reports_protrusion():
    piece = _ell_piece()
    hull = ConvexPart.hull(piece.vertices)
    assert hull is not None
    halves = split_to_bound(hull, piece, BOUND)
    assert len(halves) > 1
    for part, protrusion in halves:
        truth = _outside_ell(surface_samples(part.vertices, part.faces, 0.05)).max()
        # Samples do not resolve distances below their spacing.
        assert truth - 0.07 <= protrusion < 0.5 * piece.protrusion(hull)
    assert uncovered_fraction(piece, [part for part, _ in halves], BOUND) < 0.08


def test_decomposition_covers_its_pieces_within_the_bound_and_is_cached(tmp_path: Path):
    crate = _box((5, 5, 0), (6, 6, 1))
    solid = SolidPiece.from_mesh(crate.vertices, crate.faces, lambda points: inside_hull(crate, points))
    pieces = [solid, _ell_piece()]
    made = decompose(pieces, BOUND, tmp_path, seed=0)
    assert made.failed == 0 and made.cached == 0 and made.uncovered < 0.01
    first, *arms = made.parts
    assert first.vertices.min() == 0.0 and first.vertices[:, :2].min() == 5.0 and len(arms) >= 2
    assert made.protrusion.max() <= BOUND
    for part in arms:
        assert _outside_ell(surface_samples(part.vertices, part.faces, 0.05)).max() <= BOUND
    points = np.random.default_rng(3).uniform(0, [2, 2, 1], (2000, 3))
    points = points[_outside_ell(points) == 0.0]
    assert np.any([inside_hull(part, points, 0.02) for part in arms], axis=0).mean() > 0.97
    again = decompose(pieces, BOUND, tmp_path, seed=0)
    assert again.cached == 1
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(made.parts, again.parts, strict=True))
    for file in tmp_path.glob("*.npz"):
        file.write_bytes(file.read_bytes()[:100])
    mended = decompose(pieces, BOUND, tmp_path, seed=0)
    assert mended.cached == 0 and mended.failed == 0
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(made.parts, mended.parts, strict=True))


def test_a_crash_costs_one_piece_only(tmp_path: Path):
    piece = _ell_piece()
    np.savez(tmp_path / "ell.npz", vertices=piece.vertices, faces=piece.faces, bound=BOUND, seed=0)
    jobs = [(tmp_path / f"{source}.npz", tmp_path / f"{source}_parts.npz") for source in ("missing", "ell")]
    with bar("pieces", len(jobs), "piece") as progress:
        _run_child(deque(jobs), progress, threading.Event())
        assert progress.n == 2
    assert [target.exists() for _, target in jobs] == [False, True]  # the child ended at the missing file


def test_clipping_keeps_exactly_one_side():
    part = _box((0, 0, 0), (1, 1, 1))
    normal = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    corner = clip_part(part, normal, 0.5 / np.sqrt(2))
    assert corner is not None
    assert _volume(corner) == pytest.approx(0.125)
    assert (corner.vertices @ normal).max() <= 0.5 / np.sqrt(2) + 1e-9
    assert clip_part(part, normal, 2.0) is part
    assert clip_part(part, normal, -0.1) is None


def test_corridor_is_cleared_and_the_rest_stays():
    route = right_turn(length=40.0, straight=15.0, step=0.25)
    corridor = Corridor((route,), 1.0)
    parts = [
        _box((4, -0.3, -0.1), (5, 0.4, 0.8)),  # in the middle
        _box((7, 0.7, -0.1), (9, 3.0, 2.5)),  # a wall whose front is too near
        _box((1, -3.0, 1.7), (2, 3.0, 2.5)),  # a beam over the road
        _box((10, 5.0, -0.1), (12, 6.0, 2.0)),  # far
    ]
    xy = np.random.default_rng(4).uniform([0, -25], [25, 3], (40_000, 2))
    xy = xy[distance_to_route(route, xy) <= corridor.reach]
    inside = np.insert(xy, 2, np.random.default_rng(5).uniform(0.0, HEADROOM, len(xy)), 1)
    assert [bool(inside_hull(part, inside).any()) for part in parts] == [True, True, False, False]
    kept, clipped = clear_corridor(parts, corridor, _flat())
    assert clipped == 2
    assert not any(inside_hull(part, inside).any() for _, part in kept)
    by = {i: [part for k, part in kept if k == i] for i in range(4)}
    assert by[0] == [] and by[2] == [parts[2]] and by[3] == [parts[3]]
    # Of the wall only the strip in front, up to the headroom, is missing.
    assert sum(map(_volume, by[1])) == pytest.approx(_volume(parts[1]) - 2.0 * 0.3 * 1.6, rel=0.04)


@pytest.mark.parametrize("count", [2, 4, 5])
def test_the_corridor_reaches_the_end_of_its_line(count):
    line = np.column_stack([np.arange(float(count)), np.zeros(count)])
    ends = line[[0, -1]] + np.array([[-1.0, 0.0], [1.0, 0.0]])
    np.testing.assert_allclose(Corridor((line,), 1.0).distance(ends, 9.0), 1.0)


def test_a_part_beside_a_bend_loses_only_its_corner():
    route = right_turn(length=40.0, straight=15.0, step=0.25)
    part = _box((15, -3.0, -0.1), (18, -1.6, 1.0))
    kept, clipped = clear_corridor([part], Corridor((route,), 1.0), _flat())
    assert clipped == 1
    # A third of a meter of one corner is in the way.
    assert sum(_volume(rest) for _, rest in kept) > 0.9 * _volume(part)


def test_a_part_inside_a_long_bend_keeps_what_is_free():
    angle = np.arange(0.0, 6.0, 0.25 / 4.0)
    corridor = Corridor((4.0 * np.column_stack([np.cos(angle), np.sin(angle)]),), 2.0)
    ring = 2.3 * np.column_stack([np.cos(angle), np.sin(angle)])  # 0.3 m of it is in the way all around
    part = ConvexPart.hull(np.concatenate([np.insert(ring, 2, z, 1) for z in (-0.1, 1.0)]))
    assert part is not None
    kept, clipped = clear_corridor([part], corridor, _flat())
    assert clipped == 1 and sum(_volume(rest) for _, rest in kept) > 0.7 * _volume(part)
    for _, rest in kept:
        assert corridor.distance(rest.vertices[:, :2], 9.0).min() > 2.0
