"""Long places, rendered one stretch of road at a time, so that time and memory do not grow with the road's length.

A renderer of a stretch shows the objects within `_SIGHT` of the stretch. Those farther away than `_SHARP` have smaller
textures and fewer, larger leaves. Places whose road was not lengthened are rendered as a whole.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.reality.place_objects import KnownPlace
from twin.reality.place_spec import LONGEST_DRAWN
from twin.reality.primitives import MeshPart
from twin.reality.rasterizer import PlaceRenderer
from twin.types import Array, Array32

_STRETCH = 100.0  # [m] length of a stretch
_SIGHT = 250.0  # [m] a house 8 m high is 11 pixels high there, in a picture 640 pixels and 85° wide
_SHARP = 60.0  # [m] beyond it, `_SHRINK` texels of the road are finer than a pixel, and a leaf is about one pixel
_SHRINK = 4  # ratio of the resolution of near textures to that of far ones, and of the numbers of leaves
_LAMPS = 24  # shining lamps per stretch; renderers loop over all lamps for every pixel
_SHADOWS = (20.0, 60.0)  # [m] of road before and after a stretch on which the rasterizer casts shadows
_SHADOW_MARGIN = 14.0  # [m] from that road to the edges of `GroundLayout.field`


def is_long(place: KnownPlace) -> bool:
    """True for a place that is rendered one stretch at a time."""
    return place.route.length > LONGEST_DRAWN


class StretchRenderer:
    """Renders a long place from poses near its line; its renderer is made anew where the camera enters a stretch."""

    def __init__(self, place: KnownPlace, make: Callable[[KnownPlace], PlaceRenderer]) -> None:
        """`make` returns the renderer of a place, here of the part of `place` near a stretch."""
        self._place, self._make = place, make
        self._stretch: int | None = None
        self._renderer: PlaceRenderer | None = None

    def at(self, camera_to_world: Array) -> PlaceRenderer:
        """The renderer of the stretch that a pose (4, 4) is on."""
        stretch = int(self._place.route.project(camera_to_world[:2, 3])[0] // _STRETCH)
        if self._renderer is None or stretch != self._stretch:
            self._renderer = None  # frees its memory first
            self._renderer = self._make(near_stretch(self._place, stretch * _STRETCH, (stretch + 1) * _STRETCH))
            self._stretch = stretch
        return self._renderer

    def __call__(self, camera_to_world: Array) -> tuple[Array32, Array32]:
        """See `PlaceRenderer`."""
        return self.at(camera_to_world)(camera_to_world)


def near_stretch(place: KnownPlace, first: float, last: float) -> KnownPlace:
    """The part of a place that is in sight of the stretch from station `first` to `last` [m]."""
    line = place.route.at(np.linspace(first, last, 51))
    boxes = np.array([(o.part.vertices[:, :2].min(0), o.part.vertices[:, :2].max(0)) for o in place.objects])
    away = np.maximum(np.maximum(boxes[:, None, 0] - line, line - boxes[:, None, 1]), 0.0)
    distances = np.hypot(away[..., 0], away[..., 1]).min(1)
    objects = [
        replace(one, part=_thinned(one.part)) if one.kind == "foliage" and distance > _SHARP else one
        for one, distance in zip(place.objects, distances, strict=True)
        if distance < _SIGHT
    ]
    used = {one.texture for one in objects} | {"atlas"}
    sharp = {one.texture for one, distance in zip(place.objects, distances, strict=True) if distance < _SHARP}

    def textures() -> dict[str, NDArray[np.uint8]]:
        images = place.textures().items()
        return {name: image if name in sharp | {"atlas"} else _shrunk(image) for name, image in images if name in used}

    layout = place.layout
    shaded = place.route.at(np.linspace(first - _SHADOWS[0], last + _SHADOWS[1], 91))
    (x0, y0), (x1, y1) = (shaded.min(0) - _SHADOW_MARGIN).tolist(), (shaded.max(0) + _SHADOW_MARGIN).tolist()
    middle = np.append(line[len(line) // 2], 0.0)
    return replace(
        place,
        objects=objects,
        textures=textures,
        layout=replace(
            layout,
            bands={name: band for name, band in layout.bands.items() if name in used},
            lands={name: box for name, box in layout.lands.items() if name in used},
            field=((x0, y0), (x1, y1)),
        ),
        lamp_heads=sorted(place.lamp_heads, key=lambda head: float(np.linalg.norm(head - middle)))[:_LAMPS],
    )


def _thinned(leaves: MeshPart) -> MeshPart:
    """One in `_SHRINK` leaves of `primitives.leaves`, enlarged so that their area is that of all."""
    tips = leaves.vertices.reshape(-1, 4, 3)[::_SHRINK]
    middle = tips.mean(1, keepdims=True)
    kept = len(tips)
    return MeshPart(
        (middle + np.sqrt(_SHRINK) * (tips - middle)).reshape(-1, 3),
        leaves.faces[: 2 * kept],
        leaves.uv.reshape(-1, 4, 2)[::_SHRINK].reshape(-1, 2),
    )


def _shrunk(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = max(1, image.shape[1] // _SHRINK), max(1, image.shape[0] // _SHRINK)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
