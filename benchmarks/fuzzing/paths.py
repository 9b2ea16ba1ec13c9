"""Fuzz target of paths that are not regular, readable files: pipes, devices, loops, sockets, odd names."""

import contextlib
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fuzzing.cases import Case
from fuzzing.samples import Samples


def odd_path(case: Case) -> None:
    rng = case.rng
    name, read = rng.choice(_readers(case.samples))
    folder, suffix = case.folder, Path(name).suffix
    path = folder / name
    what = rng.randrange(14)
    if what == 0:
        os.mkfifo(path)
    elif what in (1, 2):
        path.symlink_to("/dev/null" if what == 1 else "/dev/zero")
    elif what == 3:
        path.mkdir()
    elif what == 4:
        path.symlink_to(folder / "nothing")
    elif what == 5:
        path.symlink_to(path)
    elif what == 6:
        # The name of a socket is limited to about 100 bytes, so it is relative.
        with contextlib.chdir(folder), socket.socket(socket.AF_UNIX) as one:
            one.bind(name)
    elif what == 7:
        path = folder / ("x" * 300 + suffix)
    elif what == 8:
        path = folder / f"a\nb\x1b[31m{suffix}"
        path.write_bytes(b"a\nb")
    elif what == 9:
        path = folder / f"a\x00b{suffix}"
    elif what == 10:
        path = folder / os.fsdecode(b"\xff\xfe" + suffix.encode())
        path.write_bytes(b"\xff")
    elif what == 11:
        path.write_bytes(b"")
    elif what == 12:
        path = Path("/dev/zero") if rng.random() < 0.5 else Path()
    else:
        path = folder / "file" / name
        (folder / "file").write_bytes(b"")
    read(path)


def _readers(samples: Samples) -> list[tuple[str, Callable[[Path], Any]]]:
    """A file name and its reader, for every reader of a path."""
    from twin.assets.ground import Ground
    from twin.capture import formats, frames
    from twin.capture.capture_data import Capture, read_mask
    from twin.capture.photos import load_photo
    from twin.capture.video import probe
    from twin.config_file import load_config, read_robot
    from twin.evaluation.forecasting import Forecast
    from twin.evaluation.training_curves import read_test_counts
    from twin.evaluation.trials import read_results, read_trials
    from twin.geometry.cameras import Cameras, SparsePoints
    from twin.geometry.images import read_image
    from twin.learn.policy import load_policy
    from twin.mjcf.world import World
    from twin.nerf.baked import BakedField
    from twin.scene import Stamp
    from twin.sysid.log_files import read_log

    return [
        ("scene.toml", load_config),
        ("robot.toml", read_robot),
        ("transforms.json", formats.read_transforms),
        ("cameras.txt", lambda p: formats.read_colmap(p.parent)),
        ("cameras.bin", lambda p: formats.read_colmap(p.parent)),
        ("photo.png", lambda p: load_photo(p, None)),
        ("photo.jpg", formats.image_size),
        ("image.png", read_image),
        ("mask.png", lambda p: read_mask(p, 8, 8)),
        ("film.mp4", probe),
        ("any.mp4", frames.detect_kind),
        ("results.csv", lambda p: read_results([p], samples.cells)),
        ("table.csv", read_trials),
        ("tests.json", lambda p: read_test_counts(p.parent)),
        ("log.csv", read_log),
        ("log.npz", read_log),
        ("policy.json", load_policy),
        ("policy.onnx", load_policy),
        ("policy.zip", load_policy),
        ("forecast.json", lambda p: Forecast.load(p.parent)),
        ("ground.npz", lambda p: Ground.load(p.parent)),
        ("points.npz", lambda p: SparsePoints.load(p.parent)),
        ("capture.json", lambda p: Capture.load(p.parent)),
        ("cameras.json", lambda p: Cameras.load(p.parent)),
        ("world.json", lambda p: World.load(p.parent)),
        ("baked.json", lambda p: BakedField.load(p.parent)),
        ("stamp.json", lambda p: Stamp.verified(p.parent)),
    ]
