"""Image sets of every format become files, lenses and OpenCV poses; an error is one line."""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from twin.capture.camera_models import Lens, checked_lens, same_aspect
from twin.capture.formats import (
    natural_key,
    read_colmap,
    read_image_folder,
    read_model,
    read_transforms,
    rotation_from_quaternion,
)
from twin.capture.frames import detect_kind
from twin.capture.photos import focal_from_exif, read_exif
from twin.errors import InputError
from twin.geometry.images import write_image
from twin.geometry.poses import inverse_pose, look_at

_SIZE = (64, 48)


def _poses(n: int = 4) -> np.ndarray:
    return np.stack([look_at(np.array([i, -3.0, 1.5 + 0.1 * i]), np.array([0.3 * i, 4.0, 1.0])) for i in range(n)])


def _to_opengl(pose: np.ndarray) -> np.ndarray:
    out = pose.copy()
    out[:, 1:3] *= -1.0  # written out here on purpose: y up, looking along −z
    return out


def _images(folder: Path, n: int = 4, suffix: str = ".png") -> list[str]:
    rng = np.random.default_rng(0)
    names = [f"im{i}{suffix}" for i in range(n)]
    for name in names:
        write_image(folder / name, rng.integers(0, 256, (_SIZE[1], _SIZE[0], 3), dtype=np.uint8))
    return names


def _transforms(folder: Path, names: list[str], **top: Any) -> Path:
    frames = [
        {"file_path": name, "transform_matrix": _to_opengl(pose).tolist()}
        for name, pose in zip(names, _poses(len(names)), strict=True)
    ]
    path = folder / "transforms.json"
    path.write_text(json.dumps({"frames": frames, **top}))
    return path


def _colmap(folder: Path, binary: bool, models: tuple[str, ...] = ("OPENCV",)) -> pycolmap.Reconstruction:
    reconstruction = pycolmap.Reconstruction()
    for i, (name, pose) in enumerate(zip(_images(folder / "images"), _poses(), strict=True)):
        if i < len(models):
            camera = pycolmap.Camera.create_from_model_name(i + 1, models[i], 50.0 + i, *_SIZE)
            camera.params = np.array(camera.params) + np.arange(len(camera.params)) * 1e-3
            reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=name, camera_id=min(i + 1, len(models)), image_id=i + 1)
        cam_from_world = pycolmap.Rigid3d(inverse_pose(pose)[:3])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([3.0, 4.0]))] * (i % 2))
        reconstruction.add_image_with_trivial_frame(image, cam_from_world)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (reconstruction.write_binary if binary else reconstruction.write_text)(str(model))
    return reconstruction


@pytest.mark.parametrize("binary", [True, False])
def test_a_colmap_model_gives_back_its_cameras_and_poses(tmp_path: Path, binary: bool) -> None:
    truth = _colmap(tmp_path, binary, ("OPENCV", "SIMPLE_RADIAL", "OPENCV_FISHEYE"))
    images = read_colmap(tmp_path)
    assert [path.name for path in images.paths] == ["im0.png", "im1.png", "im2.png", "im3.png"]
    assert images.camera_to_world is not None and images.lenses is not None
    np.testing.assert_allclose(images.camera_to_world, _poses(), atol=1e-9)
    for lens, camera_id in zip(images.lenses, (1, 2, 3, 3), strict=True):
        assert lens.model == truth.cameras[camera_id].model_name and (lens.width, lens.height) == _SIZE
        np.testing.assert_allclose(lens.params, truth.cameras[camera_id].params)


def test_a_colmap_model_whose_images_are_partly_gone(tmp_path: Path) -> None:
    _colmap(tmp_path, True)
    (tmp_path / "images/im1.png").unlink()
    images = read_colmap(tmp_path / "sparse/0")
    assert (len(images.paths), images.missing) == (3, 1)
    np.testing.assert_allclose(images.camera_to_world, _poses()[[0, 2, 3]], atol=1e-9)  # type: ignore[arg-type]
    (tmp_path / "images").rename(tmp_path / "elsewhere")
    assert len(read_colmap(tmp_path, tmp_path / "elsewhere").paths) == 3
    with pytest.raises(InputError, match="`images`"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_a_binary_model_cut_anywhere_is_refused(tmp_path: Path, file: str) -> None:
    _colmap(tmp_path, True)
    path = tmp_path / "sparse/0" / file
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=file):
            read_model(path.parent)


@pytest.mark.parametrize(
    ("cameras", "images", "words"),
    [
        ("1 PINHOLE 64 48 50 50 32", "", "3 parameters for PINHOLE"),
        ("1 PINHOL 64 48 50 50 32 24", "", "did you mean 'PINHOLE'"),
        ("1 PINHOLE 64 48 nan 50 32 24", "", "finite"),
        ("garbage", "", "line 1"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 nan 0 0 0 1 im0.png\n\n", "im0.png is not finite"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 0 0 0 0 0 0 0 1 im0.png\n\n", "im0.png is not finite"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 0 0 0 0 2 im0.png\n\n", "camera 2"),
        ("1 PINHOLE 64 48 50 50 32 24", "# c\n\nhello\n", "line 3"),
    ],
)
def test_a_wrong_text_model_is_refused_with_its_line(tmp_path: Path, cameras: str, images: str, words: str) -> None:
    (tmp_path / "cameras.txt").write_text(f"# a comment\n{cameras}\n" if cameras != "garbage" else cameras)
    (tmp_path / "images.txt").write_text(images)
    with pytest.raises(InputError, match=words) as caught:
        read_model(tmp_path)
    assert "\n" not in str(caught.value)


def test_an_image_without_points_and_a_name_with_spaces(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 1 2 3 1 my photo.png\n\n2 1 0 0 0 0 0 0 1 b.png\n1 2 -1\n")
    assert [(name, pose[:3, 3].tolist()) for name, _, pose in read_model(tmp_path)] == [
        ("my photo.png", [-1.0, -2.0, -3.0]),
        ("b.png", [0.0, 0.0, 0.0]),
    ]


def test_a_quaternion_turns_as_rodrigues_does() -> None:
    angle = 0.7
    rotation = rotation_from_quaternion(np.array([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]))
    expected = [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    np.testing.assert_allclose(rotation, expected, atol=1e-12)


def test_nerfstudio_format(tmp_path: Path) -> None:
    names = _images(tmp_path / "images")
    top = {"fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 25.0, "w": 64, "h": 48, "k1": 0.1, "p2": 0.01}
    _transforms(tmp_path, [f"images/{name}" for name in names], camera_model="OPENCV", **top)
    images = read_transforms(tmp_path)
    np.testing.assert_allclose(images.camera_to_world, _poses(), atol=1e-12)  # type: ignore[arg-type]
    assert images.lenses == (Lens("OPENCV", (60.0, 61.0, 31.0, 25.0, 0.1, 0.0, 0.0, 0.01), 64, 48),) * 4


def test_a_camera_per_image_overrides_the_shared_one(tmp_path: Path) -> None:
    path = _transforms(tmp_path, _images(tmp_path), fl_x=60.0, w=64, h=48)
    table = json.loads(path.read_text())
    table["frames"][2] |= {"fl_x": 80.0, "cx": 30.0, "cy": None}  # null: not given, so the middle of the image
    path.write_text(json.dumps(table))
    lenses = read_transforms(path).lenses
    assert lenses is not None
    assert lenses[1].params == (60.0, 60.0, 32.0, 24.0) and lenses[2].params == (80.0, 80.0, 30.0, 24.0)


def test_instant_ngp_format(tmp_path: Path) -> None:
    """An angle of view, names without a suffix, an image that does not exist, no image size."""
    _images(tmp_path / "train", 3)
    path = _transforms(tmp_path, [f"./train/im{i}" for i in range(4)], camera_angle_x=0.8, aabb_scale=16)
    images = read_transforms(path)
    assert images.missing == 1 and len(images.paths) == 3 and images.lenses is not None
    focal = 32.0 / math.tan(0.4)
    assert images.lenses[0].model == "PINHOLE"
    np.testing.assert_allclose(images.lenses[0].params, (focal, focal, 32.0, 24.0))


def test_the_world_transform_of_nerfstudio_is_undone(tmp_path: Path) -> None:
    names, scale = _images(tmp_path), 0.25
    applied = np.array([[0.0, 1, 0, 2], [0, 0, -1, 3], [-1, 0, 0, 4]])
    frames = []
    for name, pose in zip(names, _poses(), strict=True):
        moved = np.vstack([applied, [0, 0, 0, 1]]) @ _to_opengl(pose)
        moved[:3, 3] *= scale
        frames.append({"file_path": name, "transform_matrix": moved.tolist()})
    table = {"fl_x": 60.0, "frames": frames, "applied_transform": applied.tolist(), "applied_scale": scale}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    np.testing.assert_allclose(read_transforms(tmp_path).camera_to_world, _poses(), atol=1e-12)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("top", "frame", "words"),
    [
        ({}, {"transform_matrix": np.full((4, 4), np.nan).tolist()}, "transforms.json.*NaN where a finite number"),
        ({}, {"transform_matrix": (2.0 * np.eye(4)).tolist()}, "im1.png.*not rigid"),
        ({}, {"transform_matrix": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "im1.png.*not rigid"),
        ({}, {"transform_matrix": [[1, 2], [3]]}, "im1.png.*not 4x4"),
        ({}, {"transform_matrix": None}, "im1.png.*not 4x4"),
        ({"fl_x": None}, {}, "fl_x"),
        ({"fl_x": "60"}, {}, "fl_x = '60'"),
        ({"fl_x": 0.0}, {}, "fl_x"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, "EQUIRECTANGULAR"),
        ({"frames": []}, {}, "no frames"),
    ],
)
def test_a_wrong_transforms_json_is_refused_in_one_line(tmp_path: Path, top: dict, frame: dict, words: str) -> None:
    path = _transforms(tmp_path, _images(tmp_path), fl_x=60.0)
    table = json.loads(path.read_text())
    table["frames"][1] |= frame
    path.write_text(json.dumps(table | top))
    with pytest.raises(InputError, match=words) as caught:
        read_transforms(path)
    assert "\n" not in str(caught.value)


def test_kinds_of_sources(tmp_path: Path) -> None:
    _colmap(tmp_path / "colmap", False)
    _images(tmp_path / "photos")
    _transforms(tmp_path / "photos", ["im0.png"], fl_x=60.0)
    (tmp_path / "empty").mkdir()
    (tmp_path / "film.mp4").touch()
    assert detect_kind(tmp_path / "colmap") == detect_kind(tmp_path / "colmap/sparse/0") == "colmap"
    assert detect_kind(tmp_path / "photos") == detect_kind(tmp_path / "photos/transforms.json") == "transforms"
    (tmp_path / "photos/transforms.json").unlink()
    assert detect_kind(tmp_path / "photos") == "images" and detect_kind(tmp_path / "film.mp4") == "video"
    for name in ("empty", "absent"):
        with pytest.raises(InputError, match=name):
            detect_kind(tmp_path / name)


def test_photos_come_in_natural_order(tmp_path: Path) -> None:
    for name in ("b10.png", "b9.png", "a.JPG", "notes.txt", ".hidden.png"):
        (tmp_path / name).touch()
    assert [path.name for path in read_image_folder(tmp_path).paths] == ["a.JPG", "b9.png", "b10.png"]
    assert natural_key("1a") < natural_key("a1")
    assert natural_key("5²6.jpg") < natural_key("5²10.jpg")  # `str.isdigit` is true of "²", but `int` refuses it


def test_exif_gives_focal_length_place_and_time(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    photo = exif.get_ifd(ExifTags.IFD.Exif)
    photo[ExifTags.Base.FocalLengthIn35mmFilm] = 28
    photo[ExifTags.Base.DateTimeOriginal] = "2024:05:01 12:00:30"
    photo[ExifTags.Base.SubsecTimeOriginal] = "2534"
    gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
    gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLatitude] = "S", (33.0, 51.0, 36.0)
    gps[ExifTags.GPS.GPSLongitudeRef], gps[ExifTags.GPS.GPSLongitude] = "E", (151.0, 12.0, 0.0)
    gps[ExifTags.GPS.GPSAltitudeRef], gps[ExifTags.GPS.GPSAltitude] = b"\x01", 4.5
    Image.new("RGB", (400, 300)).save(tmp_path / "a.jpg", exif=exif)
    exif_found = read_exif(tmp_path / "a.jpg")
    assert exif_found.orientation == 6
    np.testing.assert_allclose(exif_found.gps, (-33.86, 151.2, -4.5))
    assert exif_found.time is not None and exif_found.time % 60 == pytest.approx(30.2534)
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(data.replace(b"2534\0", b"\xb2534\0"))  # "²", a digit that is no number
    assert read_exif(tmp_path / "a.jpg").time % 60 == 30.0
    # 28 mm of a 43.27 mm diagonal is 323.6 of a 500 px diagonal.
    assert exif_found.focal == pytest.approx(28.0 / math.hypot(36, 24) * 500 / 400)


def test_exif_focal_length_from_the_pitch_of_the_sensor() -> None:
    tag = ExifTags.Base
    photo = {tag.FocalLength: 5.0, tag.FocalPlaneXResolution: 2000.0, tag.FocalPlaneResolutionUnit: 3}
    photo[tag.ExifImageWidth] = 800  # 200 px per mm × 5 mm = 1000 px of 800
    assert focal_from_exif(photo, 400, 300) == pytest.approx(1000 / 800)
    assert focal_from_exif({tag.FocalLength: 5.0}, 400, 300) is None


def test_a_photo_without_a_header(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    exif_found = read_exif(tmp_path / "a.png")
    assert (exif_found.focal, exif_found.time, exif_found.orientation) == (None, None, 1) and all(
        map(math.isnan, exif_found.gps)
    )


def test_scaling_a_lens_scales_what_it_projects() -> None:
    lens = checked_lens("OPENCV", (60.0, 61.0, 31.0, 25.0, 0.1, -0.02, 0.003, 0.004), 64, 48, "test")
    ray = np.array([[0.2, -0.1, 1.0]])
    half = lens.scaled(32, 24)
    np.testing.assert_allclose(half.camera.img_from_cam(ray), lens.camera.img_from_cam(ray) / 2.0)
    np.testing.assert_allclose(half.intrinsics, (30.0, 30.5, 15.5, 12.5))
    assert half.distortion == lens.distortion and lens.is_distorted


@pytest.mark.parametrize(
    ("model", "params", "size", "words"),
    [
        ("OPENCVX", (1.0,), (64, 48), "did you mean 'OPENCV'"),
        ("PINHOLE", (50.0, 50.0), (64, 48), "expected 4: fx, fy, cx, cy"),
        ("PINHOLE", (50.0, 50.0, 32.0, math.inf), (64, 48), "finite"),
        ("PINHOLE", (0.8, 0.8, 32.0, 24.0), (64, 48), "focal length"),
        ("PINHOLE", (640.0, 640.0, 32.0, 24.0), (64, 48), "10 times the longer side"),
        ("PINHOLE", (60.0, 640.0, 32.0, 24.0), (64, 48), "focal length 60, 640 px .*, 10 times the longer side"),
        ("PINHOLE", (50.0, 50.0, 3200.0, 24.0), (64, 48), "principal point"),
        ("PINHOLE", (50.0, 50.0, 32.0, 24.0), (0, 48), "image size"),
    ],
)
def test_an_impossible_calibration_is_refused(model: str, params: tuple, size: tuple[int, int], words: str) -> None:
    with pytest.raises(InputError, match=words):
        checked_lens(model, params, *size, "scene.toml")


def test_aspect_is_compared_to_a_rounded_pixel() -> None:
    assert same_aspect((540, 960), (1080, 1920)) and same_aspect((427, 240), (1920, 1080))
    assert not same_aspect((960, 540), (1080, 1920)) and not same_aspect((640, 480), (640, 360))


def test_an_unknown_camera_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, 99, 64, 48) + bytes(32))
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 0))
    with pytest.raises(InputError, match="camera model number 99"):
        read_model(tmp_path)
