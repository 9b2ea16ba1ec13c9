"""Textured triangle meshes of simple shapes, in world coordinates [m].

A *part* is a surface with one texture; `uv` is (column, row) in [0, 1] of that texture, row 0 at the top.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.types import Array

_LEAF_WINDOW = 0.08  # width of the window of its texture that a leaf shows


@dataclass(frozen=True)
class MeshPart:
    """A textured mesh of n vertices and m triangles."""

    vertices: Array
    """Shape (n, 3) [m]."""
    faces: NDArray[np.int32]
    """Shape (m, 3)."""
    uv: Array
    """Shape (n, 2)."""

    def moved(self, origin: Array, yaw: float = 0.0) -> "MeshPart":
        """The mesh rotated about z by `yaw` [rad], then translated by `origin` [m]."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, vertices=self.vertices @ turn.T + origin)


def join(parts: list[MeshPart]) -> MeshPart:
    """Joins meshes into one."""
    starts = np.cumsum([0] + [len(p.vertices) for p in parts])
    return MeshPart(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)]).astype(np.int32),
        np.concatenate([p.uv for p in parts]),
    )


def share(values: Array) -> Array:
    """Distances of rising or falling values from the first, as fractions of that of the last; shape (n,)."""
    return np.abs(values - values[0]) / np.ptp(values)


def grid(xy: Array, z: Array, u: Array, v: Array) -> MeshPart:
    """A surface through a lattice of points: xy (rows, columns, 2) and z (rows, columns) [m].

    Its texture coordinates are u and v, which broadcast to (rows, columns). It faces up if the row index increases from
    a road's left to its right, and the column index along the road.
    """
    rows, columns = z.shape
    points = np.concatenate([xy, z[..., None]], -1)
    uv = np.stack(np.broadcast_arrays(u, v), -1)
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return MeshPart(points.reshape(-1, 3), faces.astype(np.int32), uv.reshape(-1, 2))


def triangle(corners: ArrayLike, uv: ArrayLike) -> MeshPart:
    """A triangle from its corners (3, 3) and their texture coordinates (3, 2)."""
    return MeshPart(np.asarray(corners, float), np.array([[0, 1, 2]], np.int32), np.asarray(uv, float))


def quad(corners: ArrayLike) -> MeshPart:
    """A rectangle from its corners top left, bottom left, bottom right, top right; shape (4, 3)."""
    uv = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])
    return MeshPart(np.asarray(corners, float), np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv)


def box(size: tuple[float, float, float], base: float = 0.0) -> MeshPart:
    """A box with full sizes (x, y, z), its bottom at z = `base`; each face shows the whole texture."""
    x, y, z0, z1 = size[0] / 2, size[1] / 2, base, base + size[2]
    ring = [(-x, -y), (x, -y), (x, y), (-x, y)]
    sides = []
    for (ax, ay), (bx, by) in zip(ring, ring[1:] + ring[:1], strict=True):
        sides.append(quad([[ax, ay, z1], [ax, ay, z0], [bx, by, z0], [bx, by, z1]]))
    top = quad([[-x, y, z1], [-x, -y, z1], [x, -y, z1], [x, y, z1]])
    bottom = quad([[-x, -y, z0], [-x, y, z0], [x, y, z0], [x, -y, z0]])
    return join([*sides, top, bottom])


def walls(width: float, depth: float, low: float, high: float) -> MeshPart:
    """Four walls around a rectangle of x `width` and y `depth`; the texture wraps once, from corner (−x, −y)."""
    x, y = width / 2, depth / 2
    ring = np.array([(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)])
    along = np.cumsum([0.0, width, depth, width, depth]) / (2 * (width + depth))
    parts = []
    for k in range(4):
        (ax, ay), (bx, by) = ring[k], ring[k + 1]
        part = quad([[ax, ay, high], [ax, ay, low], [bx, by, low], [bx, by, high]])
        u = np.where(part.uv[:, 0] > 0, along[k + 1], along[k])
        parts.append(replace(part, uv=np.stack([u, part.uv[:, 1]], 1)))
    return join(parts)


def prism(outline: Array, width: float) -> MeshPart:
    """A convex outline in the x–z plane, shape (n, 2), extruded along y by `width` [m], centered on y = 0.

    Each side face shows the whole texture; on the caps, the texture fills the outline's bounding box.
    """
    n = len(outline)
    low, size = outline.min(0), np.ptp(outline, axis=0)
    parts = []
    for y, order in ((-width / 2, 1), (width / 2, -1)):
        cap = np.stack([outline[:, 0], np.full(n, y), outline[:, 1]], 1)
        fan = np.array([[0, k, k + 1][::order] for k in range(1, n - 1)], np.int32)
        uv = (outline - low) / size
        parts.append(MeshPart(cap, fan, np.stack([uv[:, 0], 1.0 - uv[:, 1]], 1)))
    for (ax, az), (bx, bz) in zip(outline, np.roll(outline, -1, 0), strict=True):
        y = width / 2
        parts.append(quad([[ax, y, az], [ax, -y, az], [bx, -y, bz], [bx, y, bz]]))
    return join(parts)


def tube(
    bottom: Array, top: Array, radius_bottom: float, radius_top: float, sides: int = 10, capped: bool = True
) -> MeshPart:
    """A truncated cone between two points [m]; the texture wraps once around it."""
    axis = np.asarray(top, float) - bottom
    length = np.linalg.norm(axis)
    axis = axis / length
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    e1 = np.cross(axis, helper)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(axis, e1)
    angle = np.linspace(0.0, 2 * np.pi, sides + 1)
    ring = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    points = np.stack([top + radius_top * ring, bottom + radius_bottom * ring])
    side = grid(points[..., :2], points[..., 2], np.linspace(0, 1, sides + 1)[None], np.array([[0.0], [1.0]]))
    if not capped:
        return side
    lids = []
    for center, radius in ((np.asarray(top, float), radius_top), (np.asarray(bottom, float), radius_bottom)):
        rim = center + radius * ring[:-1]
        fan = np.array([[0, 1 + k, 1 + (k + 1) % sides] for k in range(sides)], np.int32)
        rim_uv = 0.5 + 0.5 * np.stack([np.cos(angle[:-1]), np.sin(angle[:-1])], 1)
        lids.append(MeshPart(np.vstack([center, rim]), fan, np.vstack([[0.5, 0.5], rim_uv])))
    return join([side, *lids])


def leaves(rng: np.random.Generator, centers: Array, size: tuple[float, float], light: Array) -> MeshPart:
    """Leaves: small bent rhombi around centers, shape (n, 3).

    Each leaf shows a window of the texture. `light`, shape (n,), is the window's horizontal position, from 0 (left
    edge) to 1 (right edge); a random shift is added.
    """
    n = len(centers)
    long, short = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    long[:, 2] *= 0.6  # most leaves are closer to horizontal than to vertical
    long /= np.linalg.norm(long, axis=1, keepdims=True)
    short -= (short * long).sum(1, keepdims=True) * long
    short /= np.linalg.norm(short, axis=1, keepdims=True)
    half = 0.5 * rng.uniform(*size, (n, 1))
    droop = np.cross(long, short) * half * 0.25
    tips = [centers - half * long, centers + 0.55 * half * short + droop, centers + half * long]
    tips.append(centers - 0.55 * half * short + droop)
    corner = rng.uniform(0.0, 1.0 - _LEAF_WINDOW, (n, 1, 2))
    corner[:, 0, 0] = np.clip(light + rng.normal(0.0, 0.1, n), 0.0, 1.0) * (1.0 - _LEAF_WINDOW)
    window = corner + _LEAF_WINDOW * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    base = 4 * np.arange(n)[:, None]
    faces = (base[:, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3).astype(np.int32)
    return MeshPart(np.stack(tips, 1).reshape(-1, 3), faces, window.reshape(-1, 2))
