"""Photos and posed image sets: selection, EXIF headers, poses and refused input."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filmed_wall import HEIGHT, WIDTH, captured, film, refused, views
from PIL import ExifTags, Image

from twin.capture.photos import _mask_names, photo_times, read_exif
from twin.config import SourceConfig
from twin.geometry.cameras import evenly_spaced
from twin.geometry.images import read_image, write_image


def test_photos_are_kept_in_order_without_exact_duplicates(tmp_path: Path) -> None:
    for i, frame in enumerate(views([5 * i for i in range(11)])):
        write_image(tmp_path / f"photos/p{i}.png", frame)
    write_image(tmp_path / "photos/p11.png", read_image(tmp_path / "photos/p3.png"))
    capture, metrics, out = captured(tmp_path, [SourceConfig(path="photos")])
    assert metrics["sources"]["photos"]["duplicates"] == 1 and len(capture.names) == 11
    np.testing.assert_array_equal(read_image(out / "images/photos/000010.png"), views([50])[0])
    few = captured(tmp_path, [SourceConfig(path="photos")], frames=4)[0].names
    assert few == ("photos/000000", "photos/000004", "photos/000007", "photos/000011")
    assert not capture.sources[0].calibrated and capture.sources[0].camera_params == ()


def test_a_photo_is_turned_upright_and_its_header_is_used(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for i, frame in enumerate(views([9 * i for i in range(3)])):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6  # turn a quarter clockwise to show it
        photo = exif.get_ifd(ExifTags.IFD.Exif)
        photo[ExifTags.Base.FocalLengthIn35mmFilm] = 26
        photo[ExifTags.Base.DateTimeOriginal] = f"2024:05:01 12:00:{10 + 2 * i}"
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLatitude] = "N", (55.0, 30.0, 0.0)
        gps[ExifTags.GPS.GPSLongitudeRef], gps[ExifTags.GPS.GPSLongitude] = "E", (13.0, 15.0, 0.0)
        Image.fromarray(frame).save(tmp_path / f"photos/{i}.jpg", quality=95, exif=exif)
    capture, metrics, out = captured(tmp_path, [SourceConfig(path="photos")])
    kept = read_image(out / "images/photos/000001.png").astype(int)
    assert np.abs(kept - np.rot90(views([9])[0], -1)).mean() < 6.0
    np.testing.assert_allclose(capture.times, (0.0, 2.0, 4.0))
    np.testing.assert_allclose(capture.gps, [(55.5, 13.25, np.nan)] * 3)
    focal = 26.0 / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT)
    np.testing.assert_allclose(capture.sources[0].camera_params, (focal, HEIGHT / 2, WIDTH / 2, 0.0))
    assert capture.sources[0].camera_model == "SIMPLE_RADIAL" and not capture.sources[0].calibrated
    assert metrics["with_gps"] == 3


def test_a_photo_at_zero_degrees_has_no_position(tmp_path: Path) -> None:
    for east in (0.0, 9.0):
        exif = Image.Exif()
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        gps[ExifTags.GPS.GPSLatitude], gps[ExifTags.GPS.GPSLongitude] = (0.0, 0.0, 0.0), (east, 0.0, 0.0)
        Image.fromarray(views([0])[0]).save(tmp_path / "photo.jpg", exif=exif)
        assert np.isfinite(read_exif(tmp_path / "photo.jpg").gps[:2]).all() == (east > 0.0)


@pytest.mark.parametrize(("keep", "words"), [(0.0, "0 bytes"), (0.5, "cut off")])
def test_a_damaged_photo_is_named(tmp_path: Path, keep: float, words: str) -> None:
    for i, frame in enumerate(views([5 * i for i in range(3)])):
        write_image(tmp_path / f"photos/{i}.jpg", frame)
    path = tmp_path / "photos/1.jpg"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * keep)])
    refused(tmp_path, SourceConfig(path="photos"), rf"1\.jpg.*{words}")


def test_photos_of_two_shapes_are_refused(tmp_path: Path) -> None:
    for i, frame in enumerate(views([0, 9])):
        write_image(tmp_path / f"photos/{i}.png", frame if i else frame.swapaxes(0, 1))
    refused(tmp_path, SourceConfig(path="photos"), "source of their own")


def test_a_small_first_photo_does_not_shrink_the_others_silently(tmp_path: Path, capsys) -> None:
    for i, frame in enumerate(views([0, 9, 18])):
        write_image(tmp_path / f"photos/{i}.png", frame if i else np.ascontiguousarray(frame[::2, ::2]))
    captured(tmp_path, [SourceConfig(path="photos")])
    said = f"photos of up to {WIDTH}x{HEIGHT} are scaled to {WIDTH // 2}x{HEIGHT // 2}"
    assert said in capsys.readouterr().err
    captured(tmp_path, [SourceConfig(path="photos")], max_size=WIDTH // 2)  # nothing is lost
    assert said not in capsys.readouterr().err


def test_a_photo_that_was_cut_by_a_row_does_not_count_as_small(tmp_path: Path, capsys) -> None:
    for i, frame in enumerate(views([0, 9, 18])):
        write_image(tmp_path / f"photos/{i}.png", frame if i else frame[:-1])
    captured(tmp_path, [SourceConfig(path="photos")])
    assert "are scaled to" not in capsys.readouterr().err


def _posed(tmp_path: Path, per_frame: list[dict[str, Any]], **top: Any) -> None:
    frames = []
    for i, extra in enumerate(per_frame):
        write_image(tmp_path / f"posed/{i}.png", views([9 * i])[0])
        frames.append({"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist(), **extra})
    (tmp_path / "posed/transforms.json").write_text(json.dumps({"frames": frames, **top}))


def test_poses_and_intrinsics_of_images_half_their_size(tmp_path: Path) -> None:
    _posed(tmp_path, [{}] * 3, fl_x=300.0, fl_y=310.0, cx=158.0, cy=122.0, w=2 * WIDTH, h=2 * HEIGHT, k1=0.1)
    capture, metrics, _ = captured(tmp_path, [SourceConfig(path="posed")])
    assert metrics["posed"] and capture.camera_to_world is not None
    np.testing.assert_allclose(capture.intrinsics, [(150.0, 155.0, 79.0, 61.0)] * 3)  # type: ignore[arg-type]
    np.testing.assert_allclose(capture.camera_to_world, [np.diag([1.0, -1.0, -1.0, 1.0])] * 3)
    assert capture.sources[0].camera_model == "OPENCV" and capture.sources[0].calibrated
    np.testing.assert_allclose(capture.sources[0].camera_params, (150.0, 155.0, 79.0, 61.0, 0.1, 0.0, 0.0, 0.0))


def test_images_of_different_distortions_are_undistorted(tmp_path: Path) -> None:
    _posed(tmp_path, [{"k1": -0.3}, {"k1": -0.2}, {"k1": 0.0, "k2": 0.0}], fl_x=150.0, w=WIDTH, h=HEIGHT)
    capture, _, out = captured(tmp_path, [SourceConfig(path="posed")])
    assert capture.sources[0].camera_model == "PINHOLE" and capture.intrinsics is not None
    assert len({tuple(k) for k in capture.intrinsics.round(3)}) == 3
    np.testing.assert_array_equal(read_image(out / "images/posed/000002.png"), views([18])[0])
    assert (read_image(out / "images/posed/000000.png") != views([0])[0]).any()


def test_a_listed_mask_that_is_missing_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_image(tmp_path / "posed/there.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    _posed(tmp_path, [{"mask_path": "there.png"}, {"mask_path": "gone.png"}, {}], fl_x=150.0)
    _, _, out = captured(tmp_path, [SourceConfig(path="posed")])
    assert len(list((out / "masks/posed").iterdir())) == 1
    assert "posed: 1 masks are listed but do not exist; these images are used whole" in capsys.readouterr().err


def test_masks_of_images_in_subfolders_are_their_own(tmp_path: Path) -> None:
    frames = []
    for i, name in enumerate(("left/0", "right/0", "left/1")):
        write_image(tmp_path / f"posed/{name}.png", views([9 * i])[0])
        frames.append({"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist()})
        if name != "right/0":
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[: i * HEIGHT // 4] = 0
            write_image(tmp_path / f"masks/{name}.png", mask)
    write_image(tmp_path / "masks/0.png", np.zeros((HEIGHT, WIDTH), np.uint8))  # of which of the two?
    (tmp_path / "posed/transforms.json").write_text(json.dumps({"frames": frames, "fl_x": 150.0}))
    _, _, out = captured(tmp_path, [SourceConfig(path="posed", mask="masks")])
    found = {path.name: read_image(path)[0, 0].max() for path in (out / "masks/posed").iterdir()}
    assert found == {"000000.png": 255, "000001.png": 0}


def test_names_of_masks() -> None:
    two = _mask_names([Path("/a/left/data/0.png"), Path("/a/right/data/0.png"), Path("/a/right/data/1.png")])
    assert two[0] == ("left/data/0", "left/data/0.png") and two[1] == ("right/data/0", "right/data/0.png")
    assert two[2] == ("right/data/1", "right/data/1.png", "1", "1.png")
    one = _mask_names([Path("/a/IMG_1.jpg"), Path("/a/IMG_1.png")])
    assert one == [("IMG_1", "IMG_1.jpg", "IMG_1", "IMG_1.jpg"), ("IMG_1", "IMG_1.png", "IMG_1", "IMG_1.png")]


def test_a_focal_length_that_differs_is_not_held_for_all_images(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    _posed(tmp_path, [{"fl_x": 150.0}, {"fl_x": 300.0}, {"fl_x": 150.0}], w=WIDTH, h=HEIGHT)
    film(tmp_path / "film.mp4", views([5 * i for i in range(6)]))
    capture, _, _ = captured(tmp_path, [SourceConfig(path="posed"), SourceConfig(path="film.mp4")], frames=6)
    assert not capture.sources[0].calibrated
    assert "posed: its focal lengths differ, so one is estimated" in capsys.readouterr().err


def test_photos_that_are_left_out_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    _posed(tmp_path, [{}] * 5, fl_x=150.0)
    captured(tmp_path, [SourceConfig(path="posed")], max_frames=3)
    assert "posed: 3 of 5 images are kept, as capture.max_frames = 3" in capsys.readouterr().err


def test_poses_are_used_only_if_every_source_has_them(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    _posed(tmp_path, [{}] * 3, fl_x=150.0)
    film(tmp_path / "film.mp4", views([5 * i for i in range(6)]))
    capture, metrics, _ = captured(tmp_path, [SourceConfig(path="posed"), SourceConfig(path="film.mp4")], frames=6)
    assert capture.camera_to_world is None and capture.intrinsics is None and not metrics["posed"]
    assert capture.sources[0].calibrated  # its lens is still known
    assert "film has none" in capsys.readouterr().err


def test_photo_times_need_a_clock_that_rises() -> None:
    assert photo_times([10.0, 11.5, 12.0], [0, 1, 2]) == [0.0, 1.5, 2.0]
    for clock in ([10.0, 10.0, 12.0], [10.0, 9.0, 12.0], [10.0, None, 12.0]):
        assert photo_times(clock, [0, 2, 3]) == [0.0, 2.0, 3.0]


def test_evenly_spaced_items_include_both_ends() -> None:
    assert evenly_spaced(10, 4).tolist() == [0, 3, 6, 9] and evenly_spaced(3, 4).tolist() == [0, 1, 2]


@pytest.mark.realdata
def test_photos_with_gps_and_a_posed_set(tmp_path: Path, real_data: Path) -> None:
    capture, _, _ = captured(tmp_path, [SourceConfig(path=str(real_data / "lund_street/images"))], max_size=256)
    assert len(capture.names) == 29 and np.isfinite(capture.gps).all()
    fox = SourceConfig(path=str(real_data / "fox/transforms_orig_1080x1920.json"))
    capture, metrics, _ = captured(tmp_path, [fox])
    source = next(iter(metrics["sources"].values()))
    assert (source["kept"], source["missing"], source["width"]) == (50, 17, 540) and capture.intrinsics is not None
    np.testing.assert_allclose(capture.intrinsics[0], (687.76, 687.245, 277.279, 482.634))


def _clocked(path: Path, image: np.ndarray, second: int) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x9003] = f"2024:05:01 10:00:{second:02d}"
    Image.fromarray(image).save(path, exif=exif)


def test_photos_with_a_clock_are_kept_by_it_and_those_without_are_refused(tmp_path: Path) -> None:
    (tmp_path / "clocked").mkdir()
    for i, view in enumerate(views([9 * i for i in range(8)])):
        _clocked(tmp_path / f"clocked/{i}.jpg", view, 3 * i)
        write_image(tmp_path / f"bare/{i}.png", view)
    capture, _, _ = captured(tmp_path, [SourceConfig(path="clocked")], keep=((3.0, 12.0),))
    assert capture.names == tuple(f"clocked/{i:06d}" for i in range(1, 5))
    refused(tmp_path, SourceConfig(path="bare", keep=((0.0, 3.0),)), "EXIF times are missing.*folder of their own")
    refused(tmp_path, SourceConfig(path="clocked", keep=((40.0, 50.0),)), r"leaves 0 of 8 photos.*0 to 21\.00 s")
