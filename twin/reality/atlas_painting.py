"""Paints an atlas: one texture image with a square cell for each small surface, from bark to windows."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from twin.reality import textures
from twin.reality.place_objects import ATLAS_CELL
from twin.types import Array32

_Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class AtlasColors:
    """Colors and styles that differ between the atlases of places; the defaults are those of the campus road."""

    metals: Mapping[str, _Rgb] = field(
        default_factory=lambda: {
            "zinc": (0.55, 0.57, 0.58),
            "dark": (0.16, 0.17, 0.18),
            "green": (0.12, 0.30, 0.18),
            "red": (0.58, 0.12, 0.10),
            "blue": (0.13, 0.24, 0.46),
            "white": (0.78, 0.78, 0.76),
            "rubber": (0.09, 0.09, 0.09),
            "tank": (0.34, 0.33, 0.33),
            "glass": (0.16, 0.2, 0.24),
        }
    )
    woods: Mapping[str, _Rgb] = field(
        default_factory=lambda: {"planks": (0.50, 0.37, 0.24), "crate": (0.50, 0.37, 0.24)}
    )
    masonry: Mapping[str, _Rgb] = field(default_factory=dict)
    doors: tuple[_Rgb, _Rgb] = ((0.50, 0.37, 0.24), (0.50, 0.37, 0.24))
    greens: tuple[_Rgb, ...] = ((0.26, 0.37, 0.12), (0.33, 0.42, 0.13), (0.40, 0.40, 0.14), (0.22, 0.33, 0.14))
    hedge: _Rgb = (0.10, 0.16, 0.06)
    barks: tuple[_Rgb, ...] = ((0.34, 0.27, 0.20),) * 3
    lamp: _Rgb = (1.0, 0.93, 0.76)
    signs: tuple[tuple[_Rgb, str], ...] = (
        *(((0.10, 0.22, 0.55), "LIBRARY"), ((0.85, 0.85, 0.82), "SLOW"), ((0.9, 0.75, 0.1), "WORKS")),
        *(((0.12, 0.4, 0.2), "HALL B"), ((0.75, 0.1, 0.1), "STOP"), ((0.92, 0.9, 0.85), "MAP")),
        *(((0.95, 0.95, 0.9), "KA 214"), ((0.93, 0.8, 0.2), "RX 730")),
    )
    window: str = "cross"
    frames: NDArray[np.float64] = field(
        default_factory=lambda: np.array([[0.86, 0.86, 0.84], [0.32, 0.22, 0.15], [0.25, 0.3, 0.27]])
    )


def to_uint8(image: NDArray) -> NDArray[np.uint8]:
    """Converts an image in [0, 1] to 8 bits."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def paint_atlas(
    rng: Callable[[int], np.random.Generator], names: tuple[str, ...], colors: AtlasColors
) -> NDArray[np.float32]:
    """The image of an atlas in [0, 1]; `rng(k)` is the random generator of cell k."""
    rows = max(8, -(-len(names) // 8))
    image = np.zeros((rows * ATLAS_CELL, 8 * ATLAS_CELL, 3), np.float32)
    for k, name in enumerate(names):
        row, column = divmod(k, 8)
        tile = _cell(rng(k), name, colors)
        image[row * ATLAS_CELL : (row + 1) * ATLAS_CELL, column * ATLAS_CELL : (column + 1) * ATLAS_CELL] = tile
    return image


def _cell(rng: np.random.Generator, name: str, colors: AtlasColors) -> Array32 | NDArray[np.float32]:
    square = (ATLAS_CELL, ATLAS_CELL)
    if name.startswith("bark"):
        return textures.bark(rng, square, colors.barks[int(name[-1])])
    if name.startswith("leaf"):
        return textures.leaf(rng, square, colors.greens[int(name[-1])])
    if name == "hedge":
        return textures.leaf(rng, square, colors.hedge)
    if name in colors.metals:
        return textures.metal(rng, square, colors.metals[name])
    if name in colors.masonry:
        return textures.bricks(rng, square, 0.02, colors.masonry[name])
    if name == "birch":
        return textures.bark(rng, square, (0.72, 0.71, 0.67))
    if name in colors.woods:
        return textures.wood(rng, square, colors.woods[name])
    if name == "cone":
        return textures.stripes(rng, square, (0.85, 0.30, 0.08), (0.88, 0.88, 0.85), 5)
    if name == "barrier":
        return np.rot90(textures.stripes(rng, square, (0.75, 0.1, 0.08), (0.9, 0.9, 0.88), 7)).copy()
    if name.startswith("door"):
        return textures.wood(rng, square, colors.doors[int(name[-1])]) * np.float32(0.55)
    if name == "lamp":
        return np.full((*square, 3), colors.lamp, np.float32)
    if name.startswith("sign"):
        return textures.notice(rng, square, *colors.signs[int(name[-1])])
    return textures.resized(textures.window(rng, name.startswith("lit"), colors.window, colors.frames), square)
