"""Sections of a long road. Each has its own hash grid and bricks, so that the road's length does not coarsen them.

A section is the part of the filmed path that is nearer to its center than to those of the other sections. A camera is
rendered by the section that has the nearest filmed position. Close to a border it is rendered by all sections that meet
there, and the pictures are blended, so that there is no visible seam when a robot drives across.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as to_bytes

from twin.errors import InputError, short_repr
from twin.files import check_shapes, load_tensors, read_json, require_text, wrap_read_errors, write_json
from twin.types import Array

T = TypeVar("T")

ROAD_FILE = "road.safetensors"
"""File of a road of several sections."""
OVERLAP = 12.0
"""Distance [m] from a section's own cameras up to which other cameras train it, too."""
# [m] The road's length is that of the minimum spanning tree of filmed positions at least this far apart. So a road that
# is filmed twice, or in another lane, is no longer than one that is filmed once.
_ANCHOR_SPACING = 5.0
_JUMP = 25.0  # [m] a longer step of this tree does not count: it leads to a frame that was placed wrong
_CENTER_SPACING = 1.0  # [m] least spacing of the filmed positions that k-medians clusters
_MIN_FRAMES = 10  # least number of frames of a section
_ROUNDS = 100  # greatest number of rounds in which centers move
_BLEND = 2.0  # [m] sections are blended if their distances exceed that of the nearest section by less than this


@dataclass(frozen=True)
class RoadSections:
    """Filmed positions, and the section of each."""

    points: Array
    """[m], shape (m, 3)."""
    section: NDArray[np.int64]
    """Shape (m,), from 0 to `count` − 1, each of which occurs."""

    def save(self, folder: Path) -> None:
        """Writes `road.safetensors` if there are several sections."""
        if self.count > 1:
            arrays = {"points": self.points, "section": self.section}
            (folder / ROAD_FILE).write_bytes(to_bytes({k: np.ascontiguousarray(v) for k, v in arrays.items()}))

    @staticmethod
    def load(folder: Path, count: int) -> "RoadSections":
        """Reads the road of a field with `count` sections. Raises InputError for a file that does not fit."""
        if count == 1:
            return undivided_road()
        path = folder / ROAD_FILE
        arrays = load_tensors(path)
        with wrap_read_errors(path, "build the scene again"):
            points, section = arrays["points"], arrays["section"]
            check_shapes({"points": (points, (len(points), 3), "f"), "section": (section, (len(points),), "i")})
            if not np.array_equal(np.unique(section), np.arange(count)) or not np.isfinite(points).all():
                raise ValueError(f"the road does not have the sections 0 to {count - 1}, or a point is not finite")
            return RoadSections(points, section)

    @property
    def count(self) -> int:
        """Number of sections."""
        return int(self.section.max()) + 1

    @cached_property
    def _trees(self) -> list[Any]:
        return [_tree(self.points[self.section == k]) for k in range(self.count)]

    def distances(self, positions: Array) -> Array:
        """Distance of positions (n, 3) [m] from the nearest filmed position of each section, shape (n, count)."""
        return np.stack([tree.query(positions)[0] for tree in self._trees], 1)

    def nearest(self, positions: Array) -> NDArray[np.int64]:
        """The section that renders a camera at each of the positions (n, 3) [m], shape (n,)."""
        return self.distances(positions).argmin(1)

    def shares(self, positions: Array) -> Array:
        """Shares of the sections in pictures from positions (n, 3) [m], shape (n, count); each row sums to 1.

        They are continuous, also where three sections meet. Only sections that are less than `_BLEND` farther than the
        nearest one have a share.
        """
        distance = self.distances(positions)
        share = np.maximum(0.0, 1.0 - (distance - distance.min(1, keepdims=True)) / _BLEND)
        return share / share.sum(1, keepdims=True)

    def frames(self, positions: Array) -> list[NDArray[np.int64]]:
        """For each section, the indices of the cameras that train it, given their positions (n, 3) [m]."""
        if self.count == 1:
            return [np.arange(len(positions))]
        near = self.distances(positions) <= OVERLAP
        return [np.flatnonzero(column) for column in near.T]

    def segments(self, segments: Array) -> list[Array]:
        """For each section, the segments that have both ends near it, of segments (n, 2, 3) [m] of the filmed path."""
        start, end = self.frames(segments[:, 0]), self.frames(segments[:, 1])
        return [segments[np.intersect1d(a, b)] for a, b in zip(start, end, strict=True)]


def undivided_road() -> RoadSections:
    """A road of one section."""
    return RoadSections(np.zeros((1, 3)), np.zeros(1, np.int64))


# ---- heads of fields: the layouts of their sections, and the names of lightings and frames


def write_head(
    path: Path,
    formats: tuple[int, int],
    layouts: Sequence[Any],
    lightings: tuple[str, ...],
    frames: tuple[str, ...],
    more: dict[str, Any],
) -> None:
    """Writes the JSON file of a field, with `more` entries. `formats`: that of one section, and that of several."""
    first, *others = map(asdict, layouts)
    head: dict[str, Any] = {"format": formats[bool(others)], "layout": first}
    head |= {"more_layouts": others} if others else {}
    write_json(path, head | {"lightings": lightings, "frames": frames} | more)


def read_head(
    path: Path, formats: tuple[int, int], layout: Callable[..., T]
) -> tuple[list[T], tuple[str, ...], tuple[str, ...], dict[str, Any]]:
    """Reads a file of `write_head`: layouts (of a dataclass), names of the lightings and of the frames, all entries.

    Raises InputError if it is missing, damaged or of another format.
    """
    if not path.exists():
        raise InputError(f"{path.parent}: contains no {path.name}; build the scene (again)")
    head = read_json(path)
    with wrap_read_errors(path, "build the scene again"):
        if (found := head.get("format")) not in formats:
            raise InputError(f"{path}: format {short_repr(found)}, expected one of {formats}; build the scene again")
        layouts = [
            layout(**{key: tuple(value) if isinstance(value, list) else value for key, value in one.items()})
            for one in (head["layout"], *head.get("more_layouts", ()))
        ]
        lightings, frames = (tuple(map(require_text, head[key])) for key in ("lightings", "frames"))
        return layouts, lightings, frames, head


# ---- division


def divide_road(positions: Array, length: float) -> RoadSections:
    """Divides filmed positions (n, 3) [m] into sections of about the same `length` [m]; 0 = one section.

    The centers are those of k-medians: bends, crossings and films in both directions need no special treatment, and
    frames that were placed far off the road move no center.
    """
    from scipy.sparse.csgraph import minimum_spanning_tree  # scipy is slow to import
    from scipy.spatial.distance import pdist, squareform

    anchors = _thinned(positions, _ANCHOR_SPACING)
    steps = minimum_spanning_tree(squareform(pdist(anchors))).data
    filmed = float(steps[steps < _JUMP].sum())
    count = min(round(filmed / length), len(positions) // _MIN_FRAMES) if length > 0.0 else 1
    if count < 2:
        return RoadSections(positions, np.zeros(len(positions), np.int64))
    centers = _centers(_far_apart(anchors, count), _thinned(positions, _CENTER_SPACING))
    section = _tree(centers).query(positions)[1]
    enough = np.bincount(section, minlength=count) >= _MIN_FRAMES
    section = _tree(centers[enough]).query(positions)[1]
    return RoadSections(positions, np.unique(section, return_inverse=True)[1])


def _tree(points: Array) -> Any:
    """A k-d tree of points (n, 3)."""
    from scipy.spatial import cKDTree  # slow to import

    return cKDTree(points)


def _thinned(positions: Array, spacing: float) -> Array:
    """Positions, in their order, that are at least `spacing` [m] from all those kept before."""
    left, kept = positions, []
    while len(left):
        kept.append(left[0])
        left = left[np.linalg.norm(left - left[0], axis=1) >= spacing]
    return np.array(kept)


def _far_apart(points: Array, count: int) -> Array:
    """Chooses `count` points far from each other from points (n, 3), but no isolated ones."""
    points = points[_tree(points).query(points, k=2)[0][:, 1] < _JUMP]
    chosen = [int(np.linalg.norm(points - np.median(points, 0), axis=1).argmax())]
    gap = np.full(len(points), np.inf)
    for _ in range(count - 1):
        gap = np.minimum(gap, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(gap.argmax()))
    return points[chosen]


def _centers(centers: Array, points: Array) -> Array:
    """Centers of k-medians clusters of points (n, 3), from first centers (count, 3)."""
    for _ in range(_ROUNDS):
        nearest = _tree(centers).query(points)[1]
        own = [points[nearest == k] for k in range(len(centers))]
        moved = np.array([np.median(part, 0) if len(part) else old for part, old in zip(own, centers, strict=True)])
        if np.array_equal(moved, centers):
            break
        centers = moved
    return centers
