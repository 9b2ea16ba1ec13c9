"""Asset files as MuJoCo reads them: height fields, OBJ meshes, and textures that stand in for vertex colours."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_CHUNK = 50_000  # lines formatted at once


def write_hfield(path: Path, height: NDArray) -> None:
    """MuJoCo's binary height field: int32 rows, int32 columns, then float32 row by row from the low-y edge."""
    rows, columns = height.shape
    path.write_bytes(np.array([rows, columns], np.int32).tobytes() + height.astype(np.float32).tobytes())


def write_obj(path: Path, vertices: NDArray, faces: NDArray, texcoords: NDArray | None = None) -> None:
    """A Wavefront OBJ.

    Args:
        path: File to write.
        vertices: Shape (v, 3) [m].
        faces: Shape (f, 3), counter-clockwise seen from outside.
        texcoords: Per face and corner, u from the left and v from the top of the picture, shape (f, 3, 2).
    """
    with path.open("w", encoding="ascii") as file:
        _write_lines(file, "v %.5f %.5f %.5f\n", vertices)
        if texcoords is None:
            _write_lines(file, "f %d %d %d\n", faces + 1)
            return
        flipped = texcoords.reshape(-1, 2) * [1.0, -1.0] + [0.0, 1.0]  # OBJ counts v from the bottom
        _write_lines(file, "vt %.6f %.6f\n", flipped)
        corner = np.arange(1, 3 * len(faces) + 1).reshape(-1, 3)
        _write_lines(file, "f %d/%d %d/%d %d/%d\n", np.stack([faces + 1, corner], -1).reshape(-1, 6))


def _write_lines(file, line: str, rows: NDArray) -> None:
    for start in range(0, len(rows), _CHUNK):
        part = rows[start : start + _CHUNK]
        file.write(line * len(part) % tuple(part.ravel().tolist()))


def face_tiles(colors: NDArray) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A texture that gives every face its own three corner colours, as MuJoCo knows no vertex colours.

    Each face owns 2 × 2 texels: corners 0, 1, 2 at the centres of three of them and c₁ + c₂ − c₀ in the fourth, which
    makes bilinear filtering exactly the linear interpolation across the triangle (but where the fourth is clamped).

    Args:
        colors: Per face and corner, shape (f, 3, 3) uint8.

    Returns:
        The texture, shape (h, w, 3), and texture coordinates per face and corner, shape (f, 3, 2), u from the left and
        v from the top.
    """
    count = len(colors)
    across = max(1, int(np.ceil(np.sqrt(count))))
    down = -(-count // across)
    c = colors.astype(np.int16)
    fourth = np.clip(c[:, 1] + c[:, 2] - c[:, 0], 0, 255)
    tiles = np.zeros((down * across, 2, 2, 3), np.uint8)
    tiles[:count] = np.stack([c[:, 0], c[:, 1], c[:, 2], fourth], 1).reshape(-1, 2, 2, 3)
    texture = tiles.reshape(down, across, 2, 2, 3).swapaxes(1, 2).reshape(2 * down, 2 * across, 3)
    corner = np.stack(np.divmod(np.arange(count), across)[::-1], 1)[:, None] * 2 + [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]]
    return texture, corner / [2 * across, 2 * down]
