"""The place seen from above, for the strip of the film: ground colours, corridor, solid parts, and where we are.

The plan is turned so that the path runs from left to right along its longest extent. *Plan pixels* are (column, row).
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from twin.assets.ground import Ground
from twin.report.panels import ACCENT, AMBER, GREEN, INK, RED, SUNKEN, Colour, Picture

Array = NDArray[np.float64]

_SIDE = 5.0  # [m] shown beside the path
_SUPERSAMPLE = 4  # bits of sub-pixel precision for OpenCV's line drawing


def footprints(
    vertices: NDArray, vertex_start: NDArray, above: Ground | None = None, reach: float = 3.0
) -> list[Array]:
    """Outlines from above of convex parts, each shape (k, 2) [m], anticlockwise.

    Args:
        vertices: All parts' vertices [m], shape (v, 3).
        vertex_start: Where each part begins, shape (parts + 1,).
        above: If given, parts that begin more than `reach` above this ground are left out: nothing drives into them.
        reach: See `above` [m].
    """
    outlines = []
    for start, end in pairwise(vertex_start):
        part = np.asarray(vertices[start:end], np.float64)
        if above is not None and (part[:, 2] - above.at(part[:, :2])).min() > reach:
            continue
        try:
            outlines.append(part[ConvexHull(part[:, :2]).vertices, :2])
        except (QhullError, ValueError):  # seen edge on: a line, which covers no ground
            continue
    return outlines


def turn_of(path: Array) -> Array:
    """Rotation, shape (2, 2), that lays the longest extent of a path (n, 2) along +x, its start to the left."""
    centred = path - path.mean(0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0] if len(path) > 1 else np.array([1.0, 0.0])
    if (path[-1] - path[0]) @ axis < 0:
        axis = -axis
    return np.array([axis, [-axis[1], axis[0]]])


@dataclass(frozen=True)
class Plan:
    """A picture of the place from above and the way from metres into it."""

    picture: Picture
    to_pixel: Array
    """Affine map of (x, y, 1) [m] to plan pixels, shape (2, 3)."""

    @staticmethod
    def draw(
        size: tuple[int, int],
        path: Array,
        ground: Ground | None = None,
        parts: list[Array] | None = None,
        half_width: float = 0.0,
    ) -> "Plan":
        """Draws what stays the same throughout the film.

        Args:
            size: Width, height [px].
            path: What the plan is centred on [m], shape (n, 2).
            ground: Colours the plan where it was measured.
            parts: Outlines from `footprints`.
            half_width: Of the drivable corridor around the path [m]; 0 = none is drawn.
        """
        to_pixel = _fit(path, size)
        scale = float(np.hypot(*to_pixel[:, 0]))
        picture: Picture = np.empty((size[1], size[0], 3), np.uint8)
        picture[:] = SUNKEN
        if ground is not None:
            cell = np.array([[ground.cell, 0, ground.origin[0]], [0, ground.cell, ground.origin[1]], [0, 0, 1]])
            warp = to_pixel @ cell
            colours = cv2.warpAffine(ground.rgb, warp, size, flags=cv2.INTER_LINEAR).astype(np.float64)
            seen = cv2.warpAffine(ground.measured.astype(np.uint8) * 255, warp, size)[..., None] / 255.0
            picture = (picture * (1 - seen) + (0.25 * picture + 0.75 * colours) * seen).astype(np.uint8)
        if half_width > 0.0:
            over = picture.copy()
            _line(over, _pixels(to_pixel, path), GREEN, max(1, round(2 * half_width * scale)))
            picture = (picture * 0.7 + over * 0.3).astype(np.uint8)
        for outline in parts or []:
            corners = (_pixels(to_pixel, outline) * 2**_SUPERSAMPLE).round().astype(np.int32)
            cv2.fillPoly(picture, [corners], (120, 74, 70), cv2.LINE_AA, _SUPERSAMPLE)
            cv2.polylines(picture, [corners], True, RED, 1, cv2.LINE_AA, _SUPERSAMPLE)
        _line(picture, _pixels(to_pixel, path), INK, 1)
        return Plan(picture, to_pixel)

    def with_marker(
        self, position: Array, heading: Array, trail: Array | None = None, dots: Array | None = None
    ) -> Picture:
        """A copy with an arrow at a position along a heading.

        Args:
            position: Shape (≥2,) [m].
            heading: Any length, shape (≥2,).
            trail: The way gone so far [m], shape (n, 2), drawn as a line.
            dots: Other places [m], shape (n, 2), drawn as dots.
        """
        out = self.picture.copy()
        if trail is not None and len(trail) > 1:
            _line(out, _pixels(self.to_pixel, trail), AMBER, 2)
        for centre in _pixels(self.to_pixel, dots).round().astype(int) if dots is not None else ():
            cv2.circle(out, (int(centre[0]), int(centre[1])), 1, ACCENT, -1, cv2.LINE_AA)
        at = _pixels(self.to_pixel, position[None, :2])[0]
        ahead = self.to_pixel[:, :2] @ heading[:2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        side = np.array([-ahead[1], ahead[0]])
        length = max(7.0, out.shape[0] / 14)
        arrow = np.array([at + ahead * length, at - ahead * length * 0.7 + side * length * 0.65,
                          at - ahead * length * 0.35, at - ahead * length * 0.7 - side * length * 0.65])  # fmt: skip
        corners = (arrow * 2**_SUPERSAMPLE).round().astype(np.int32)
        cv2.fillPoly(out, [corners], AMBER, cv2.LINE_AA, _SUPERSAMPLE)
        cv2.polylines(out, [corners], True, (0, 0, 0), 1, cv2.LINE_AA, _SUPERSAMPLE)
        return out


def _fit(path: Array, size: tuple[int, int]) -> Array:
    """The affine map that shows the turned path and `_SIDE` metres around it as large as possible."""
    turn = turn_of(path)
    turned = path @ turn.T
    low, high = turned.min(0) - _SIDE, turned.max(0) + _SIDE
    scale = min(size[0] / (high[0] - low[0]), size[1] / (high[1] - low[1]))
    flip = np.diag([1.0, -1.0])  # rows count downwards
    centre = (low + high) / 2
    linear = scale * flip @ turn
    return np.column_stack([linear, np.array(size) / 2 - scale * flip @ centre])


def _pixels(to_pixel: Array, xy: Array) -> Array:
    return xy @ to_pixel[:, :2].T + to_pixel[:, 2]


def _line(picture: Picture, pixels: Array, colour: Colour, thickness: int) -> None:
    points = (pixels * 2**_SUPERSAMPLE).round().astype(np.int32)
    cv2.polylines(picture, [points], False, colour, thickness, cv2.LINE_AA, _SUPERSAMPLE)
