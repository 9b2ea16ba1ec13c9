"""COLMAP workspace of a built scene: images, cameras and sparse points, for programs that train radiance fields.

    DIR/images/<source>/<number>.png     undistorted frames
    DIR/masks/<source>/<number>.png.png  for frames with a mask; 0 = ignore
    DIR/sparse/0/cameras.txt, images.txt, points3D.txt

Coordinates are the scene's: meters, z up. The 2D points are projected 3D points, as the detected features are not kept.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from twin.files import write_text
from twin.geometry.cameras import Cameras, SparsePoints, project
from twin.geometry.poses import inverse_pose


def write_colmap(folder: Path, cameras: Cameras, points: SparsePoints) -> None:
    """Writes COLMAP's text files to `folder/sparse/0`; `points.frame` are indices into `cameras`."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    keys = [(*size.tolist(), *k.tolist()) for size, k in zip(cameras.sizes, cameras.intrinsics, strict=True)]
    camera_ids = {key: i + 1 for i, key in enumerate(dict.fromkeys(keys))}
    write_text(
        model / "cameras.txt",
        _lines(
            "CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy",
            ((number, "PINHOLE", *key) for key, number in camera_ids.items()),
        ),
    )
    rows: list[tuple] = []
    tracks: list[list[int]] = [[] for _ in range(len(points))]
    for i, name in enumerate(cameras.names):
        world_to_camera = inverse_pose(cameras.camera_to_world[i])
        x, y, z, w = Rotation.from_matrix(world_to_camera[:3, :3]).as_quat().tolist()
        file = f"{name}.png"
        rows.append((i + 1, w, x, y, z, *world_to_camera[:3, 3].tolist(), camera_ids[keys[i]], file))
        seen = np.unique(points.point[points.frame == i])
        pixels, depth = project(points.xyz[seen], cameras.camera_to_world[i], cameras.intrinsics[i])
        inside = (depth > 0.0) & (pixels >= 0.0).all(1) & (pixels <= cameras.sizes[i]).all(1)
        seen, pixels = seen[inside], pixels[inside]
        for k, point in enumerate(seen.tolist()):
            tracks[point] += [i + 1, k]
        rows.append(tuple(v for p, n in zip(pixels.tolist(), seen.tolist(), strict=True) for v in (*p, n + 1)))
    write_text(
        model / "images.txt", _lines("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; then X Y POINT3D_ID ...", rows)
    )
    records = zip(points.xyz.tolist(), points.rgb.tolist(), points.error.tolist(), tracks, strict=True)
    write_text(
        model / "points3D.txt",
        _lines(
            "POINT3D_ID X Y Z R G B ERROR, then IMAGE_ID POINT2D_INDEX ...",
            ((k + 1, *xyz, *rgb, error, *track) for k, (xyz, rgb, error, track) in enumerate(records) if track),
        ),
    )


def _lines(head: str, rows: Iterable[tuple]) -> str:
    """Text: a comment `head`, then one line per row; floating-point numbers keep all digits."""
    return "\n".join([f"# {head}", *(" ".join(map(str, row)) for row in rows), ""])
