"""Fuzz targets of captures: transforms.json, COLMAP models, images, EXIF, films, bags."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from fuzzing.cases import Case
from fuzzing.values import corrupted, hostile_literal, hostile_text, mutated_json, mutated_text

_COLMAP_TEXTS = {
    "cameras.txt": "# cameras\n1 PINHOLE 32 24 30 30 16 12\n2 OPENCV 32 24 30 30 16 12 0.1 0 0 0\n",
    "images.txt": "# images\n1 1 0 0 0 0.1 0.2 0.3 1 a.png\n1.0 2.0 -1\n2 0.7 0.7 0 0 1 2 3 2 b.png\n\n",
    "points3D.txt": "",
}


def transforms(case: Case) -> None:
    from twin.capture.formats import listed_files, read_transforms

    pose = np.eye(4).tolist()
    table: dict[str, Any] = {"camera_model": "OPENCV", "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0}
    table |= {"w": 32, "h": 24, "k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_angle_x": 0.9, "scale": 1.0}
    table["applied_transform"] = pose[:3]
    table["frames"] = [{"file_path": f"{k}.png", "transform_matrix": pose, "mask_path": "0.png"} for k in range(3)]
    for k in range(3):
        (case.folder / f"{k}.png").write_bytes(case.samples.images[".png"])
    path = case.folder / "transforms.json"
    path.write_bytes(mutated_json(case.rng, table))
    (listed_files if case.rng.random() < 0.1 else read_transforms)(path)


def colmap_text(case: Case) -> None:
    changed = case.rng.choice(tuple(_COLMAP_TEXTS))
    for name, text in _COLMAP_TEXTS.items():
        if name != changed:
            (case.folder / name).write_text(text)
            continue
        rows = [line.split(" ") for line in text.split("\n")]
        if case.rng.random() < 0.6:
            row = case.rng.choice(rows)
            value = case.rng.choice((hostile_text(case.rng), str(hostile_literal(case.rng))))
            row[case.rng.randrange(len(row))] = value
        (case.folder / name).write_bytes(mutated_text(case.rng, "\n".join(map(" ".join, rows))))
    _read_colmap(case)


def colmap_binary(case: Case) -> None:
    cameras = struct.pack("<Q", 1) + struct.pack("<iiQQ4d", 1, 1, 32, 24, 30.0, 30.0, 16.0, 12.0)
    image = struct.pack("<i7di", 1, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 1) + b"a.png\0" + struct.pack("<Q", 1)
    images = struct.pack("<Q", 1) + image + struct.pack("<ddq", 1.0, 2.0, -1)
    changed = case.rng.choice(("cameras.bin", "images.bin"))
    for name, data in (("cameras.bin", cameras), ("images.bin", images), ("points3D.bin", bytes(8))):
        (case.folder / name).write_bytes(corrupted(case.rng, data) if name == changed else data)
    _read_colmap(case)


def _read_colmap(case: Case) -> None:
    from twin.capture.formats import read_colmap

    for name in ("a.png", "b.png"):
        (case.folder / name).write_bytes(case.samples.images[".png"])
    read_colmap(case.folder)


def image(case: Case) -> None:
    from twin.capture.capture_data import read_mask
    from twin.capture.formats import image_size
    from twin.capture.photos import load_photo
    from twin.geometry.images import read_image

    rng = case.rng
    suffix, data = rng.choice(list(case.samples.images.items()))
    data = _with_forged_size(rng, suffix, data) if rng.random() < 0.4 else corrupted(rng, data)
    path = case.folder / f"image{suffix if rng.random() < 0.9 else '.png'}"
    path.write_bytes(data)
    readers: list[Callable[[Path], Any]] = [
        lambda p: load_photo(p, None),
        read_image,
        lambda p: read_mask(p, 32, 24),
        image_size,
    ]
    rng.choice(readers)(path)


def _with_forged_size(rng: Random, suffix: str, data: bytes) -> bytes:
    """An image whose header states another size, with a valid checksum; for other formats, corrupted bytes."""
    out = bytearray(data)
    sizes = [rng.choice((0, 1, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 30_000)) for _ in range(2)]
    if suffix == ".png":
        out[16:24] = struct.pack(">II", *sizes)
        out[24] = rng.choice((8, 16, out[24], 255))
        out[29:33] = struct.pack(">I", zlib.crc32(bytes(out[12:29])))
    elif suffix == ".bmp":
        out[18:26] = struct.pack("<II", *sizes)
    elif suffix == ".jpg":
        at = out.find(b"\xff\xc0")
        out[at + 5 : at + 9] = struct.pack(">HH", *(size % 2**16 for size in sizes))
    else:
        return corrupted(rng, data)
    return bytes(out)


_EXIF_VALUES: tuple[Any, ...] = (
    *("", "x\x00y", -1, 0, 2**31, 7, 3.5, float("nan"), float("inf"), (1, 2, 3), "2020:13:99 25:61:61"),
    *((1.0, 2.0, 3.0), ((1, 0), (2, 0), (3, 0)), b"\xff\x00", "9" * 5000, (float("nan"),) * 3),
)
_ROTATED_EXIF = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\1\1\x12\0\3\0\0\0\1\0\6\0\0\0\0\0\0"


def exif(case: Case) -> None:
    """A photo with hostile EXIF values, whose header is corrupted in most cases."""
    from PIL import ExifTags, Image

    from twin.capture.photos import load_photo

    rng = case.rng
    header = Image.Exif()
    header[ExifTags.Base.Orientation] = rng.choice((1, 6, 0, 9, 65535))
    header[ExifTags.Base.Model] = "x"
    photo = header.get_ifd(ExifTags.IFD.Exif)
    gps = header.get_ifd(ExifTags.IFD.GPSInfo)
    tags = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DateTimeOriginal)
    tags += (ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneResolutionUnit, ExifTags.Base.SubsecTime)
    for tag in rng.sample(tags, 3):
        photo[tag] = rng.choice(_EXIF_VALUES)
    for tag in rng.sample(range(1, 8), 4):
        gps[tag] = rng.choice([*_EXIF_VALUES, "N", "S", (48, 8, 30)])
    picture, path = Image.new("RGB", (32, 24)), case.folder / "photo.jpg"
    try:
        picture.save(path, "JPEG", exif=header)
    except Exception:  # PIL refuses to write some of the values
        picture.save(path, "JPEG", exif=_ROTATED_EXIF)
    data = path.read_bytes()
    if rng.random() < 0.7:
        data = data[:24] + corrupted(rng, data[24 : 24 + 400]) + data[424:]
    path.write_bytes(data)
    load_photo(path, None)


def bag(case: Case) -> None:
    from twin.capture.bag_film import read_contents
    from twin.capture.video import FilmStatistics

    rng, samples = case.rng, case.samples.bags
    kind = rng.choice((".mcap", ".mcap", ".db3", ".bag", "metadata.yaml"))
    path = case.folder / "drive"
    if kind == "metadata.yaml":
        path.mkdir()
        text = samples[kind].decode()
        (path / kind).write_bytes(mutated_text(rng, text))
        (path / "mcap.mcap").write_bytes(samples[".mcap"])
    else:
        path = path.with_suffix(kind)
        path.write_bytes(corrupted(rng, samples[kind]))
    contents = read_contents(path, rng.choice(("", "", "/camera/image", "/none")))
    contents.fixes_at(np.arange(3.0))
    contents.odometry_at(np.arange(3.0))
    for _ in contents.film().decode(FilmStatistics()):
        pass


def film(case: Case) -> None:
    from twin.capture.video import probe

    path = case.folder / case.rng.choice(("film.mp4", "film.mkv", "film.avi", "film.mov"))
    path.write_bytes(corrupted(case.rng, case.samples.film))
    probe(path)
