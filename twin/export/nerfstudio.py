"""nerfstudio data set of a built scene: images, cameras and sparse points, for training fields or splats elsewhere.

    DIR/transforms.json                every frame
    DIR/transforms_<lighting>.json     frames of one lighting, if the scene has several, for `ns-train METHOD --data`
    DIR/images/..., DIR/masks/...      undistorted frames; masks, if any frame has one: 0 = ignore
    DIR/points.ply                     sparse points, from which splatfacto starts

Cameras have OpenGL axes (x right, y up, looking along −z). World coordinates are the scene's: meters, z up
(`applied_transform` is the identity). By default, nerfstudio then rotates, centers and scales the poses.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from twin.files import write_bytes, write_json
from twin.geometry.cameras import Cameras, SparsePoints, opencv_to_mujoco

POINTS = "points.ply"


def write_nerfstudio(folder: Path, cameras: Cameras, points: SparsePoints, masked: bool) -> None:
    """Writes `transforms.json`, a file per lighting if there are several, and the points.

    `masked`: every frame has a mask; nerfstudio requires masks for all frames or for none.
    """
    write_bytes(folder / POINTS, _points_ply(points))
    everything = range(len(cameras))
    write_json(folder / "transforms.json", transforms(cameras, everything, masked))
    names = dict.fromkeys(cameras.lightings)
    for lighting in names if len(names) > 1 else ():
        some = [i for i in everything if cameras.lightings[i] == lighting]
        write_json(folder / f"transforms_{lighting}.json", transforms(cameras, some, masked))


def transforms(cameras: Cameras, frames: Sequence[int], masked: bool) -> dict[str, Any]:
    """The contents of a `transforms.json` with these frames; the held-out ones are its validation and test set."""
    poses = opencv_to_mujoco(cameras.camera_to_world)  # MuJoCo's camera axes are OpenGL's
    listed = []
    for i in frames:
        fx, fy, cx, cy = cameras.intrinsics[i].tolist()
        width, height = cameras.sizes[i].tolist()
        listed.append(
            {
                "file_path": f"images/{cameras.names[i]}.png",
                **({"mask_path": f"masks/{cameras.names[i]}.png"} if masked else {}),
                "fl_x": fx,
                "fl_y": fy,
                "cx": cx,
                "cy": cy,
                "w": width,
                "h": height,
                "transform_matrix": poses[i].tolist(),
                "lighting": cameras.lightings[i],
            }
        )
    held_out = [f"images/{cameras.names[i]}.png" for i in frames if cameras.held_out[i]]
    trained = [f"images/{cameras.names[i]}.png" for i in frames if not cameras.held_out[i]]
    # nerfstudio requires all three lists or none.
    split = {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out} if held_out else {}
    return {
        "camera_model": "OPENCV",  # without distortion
        "applied_transform": np.eye(4)[:3].tolist(),
        "applied_scale": 1.0,
        "ply_file_path": POINTS,
        **split,
        "frames": listed,
    }


def _points_ply(points: SparsePoints) -> bytes:
    rows = np.empty(len(points), [(c, "<f4") for c in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    for k, name in enumerate("xyz"):
        rows[name] = points.xyz[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = points.rgb[:, k]
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = "".join(f"property {kinds[rows.dtype[n].str]} {n}\n" for n in rows.dtype.names or ())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    return head.encode() + rows.tobytes()
