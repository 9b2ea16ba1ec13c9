"""Which frames are kept, how they are turned, scaled, masked and split, and which input is refused."""

import json
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from twin.capture.frames import held_out_frames, run, source_names
from twin.capture.motion import median_motion, sharpness, stands_still
from twin.capture.photos import photo_times, regular_choice
from twin.capture.types import Capture
from twin.capture.video import FilmCount, FilmFacts, decode, index_of, oriented, probe, slot_of, upright
from twin.config import CalibrationConfig, CaptureConfig, SceneConfig, SourceConfig
from twin.config_file import load_config
from twin.errors import InputError
from twin.geometry.images import read_image, write_image
from twin.new import main as new_main
from twin.scene import SceneDir

_W, _H = 160, 120


def _wall(seed: int = 0, size: tuple[int, int] = (200, 900)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    # Grey, since a film halves the resolution of colour; 2 px smooth, so that a film keeps it.
    smooth = cv2.GaussianBlur(rng.integers(0, 256, (*size, 1)).repeat(3, 2).astype(np.float32), (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]


def _drive(shifts: list[int]) -> list[np.ndarray]:
    """A textured wall seen from a camera that stands at these places [px]."""
    wall = _wall()
    return [np.ascontiguousarray(wall[40 : 40 + _H, s : s + _W]) for s in shifts]


def _film(
    path: Path, frames: list[np.ndarray], times_ms: list[int] | None = None, gop: str = "250", **options: str
) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("libx264", rate=15, options={"crf": "12", "g": gop})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        if times_ms is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for i, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, "rgb24")
            if times_ms is not None:
                frame.pts, frame.time_base = times_ms[i], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def _capture(tmp_path: Path, sources: list[SourceConfig], **capture: Any) -> tuple[Capture, dict[str, Any], Path]:
    out = tmp_path / "out"
    out.mkdir(exist_ok=True)
    metrics = run(SceneDir(tmp_path), SceneConfig(source=tuple(sources), capture=CaptureConfig(**capture)), out)
    json.dumps(metrics, allow_nan=False)
    return Capture.load(out), metrics, out


def _refused(tmp_path: Path, source: SourceConfig, words: str, **capture: Any) -> None:
    with pytest.raises(InputError, match=words) as caught:
        _capture(tmp_path, [source], **capture)
    assert "\n" not in str(caught.value)


def test_as_many_slots_as_frames_keeps_every_frame_of_every_film(tmp_path: Path) -> None:
    frames = _drive([4 * i for i in range(24)])
    _film(tmp_path / "day.mp4", frames)
    _film(tmp_path / "night.mp4", [frame // 6 for frame in frames])
    capture, metrics, out = _capture(
        tmp_path, [SourceConfig(path="day.mp4"), SourceConfig(path="night.mp4")], frames=24
    )
    assert capture.names == tuple(f"{name}/{i:06d}" for name in ("day", "night") for i in range(24))
    np.testing.assert_allclose(capture.times[:24], np.arange(24) / 15.0, atol=1e-3)
    assert [source.lighting for source in capture.sources] == ["day", "night"]
    assert metrics["sources"]["day"]["kept"] == metrics["sources"]["night"]["decoded"] == 24
    assert metrics["train"] + metrics["held_out"] == metrics["frames"] == 48
    assert np.abs(read_image(out / "images/day/000007.png").astype(int) - frames[7]).mean() < 3.0


def test_the_sharpest_frame_of_each_slot_is_kept(tmp_path: Path) -> None:
    sharp = [2, 4, 11, 12]
    frames = _drive([5 * i for i in range(16)])
    frames = [frame if i in sharp else cv2.GaussianBlur(frame, (0, 0), 3.0) for i, frame in enumerate(frames)]
    _film(tmp_path / "a.mp4", frames)
    capture, _, _ = _capture(tmp_path, [SourceConfig(path="a.mp4")], frames=4)
    assert capture.names == tuple(f"a/{i:06d}" for i in sharp)


def test_frames_of_a_standing_camera_are_dropped(tmp_path: Path) -> None:
    shifts = [6 * i for i in range(6)] + [30] * 8 + [30 + 6 * i for i in range(1, 6)]
    _film(tmp_path / "a.mp4", _drive(shifts))
    capture, metrics, _ = _capture(tmp_path, [SourceConfig(path="a.mp4")], frames=len(shifts))
    assert metrics["sources"]["a"]["duplicates"] == 8 and len(capture.names) == len(shifts) - 8
    capture, metrics, _ = _capture(tmp_path, [SourceConfig(path="a.mp4")], frames=len(shifts), min_motion=0.0)
    assert len(capture.names) == len(shifts)


def test_frames_per_second_and_the_upper_bound(tmp_path: Path) -> None:
    _film(tmp_path / "a.mp4", _drive([4 * i for i in range(60)]))
    assert len(_capture(tmp_path, [SourceConfig(path="a.mp4")], fps=3.0)[0].names) == 12  # 4 s
    assert len(_capture(tmp_path, [SourceConfig(path="a.mp4")], fps=15.0, max_frames=7)[0].names) == 7


def test_slots_follow_the_clock_of_a_film_with_a_variable_rate(tmp_path: Path) -> None:
    # Ten frames in the first second, then one each second: equal slots in time are not equal counts.
    times = [100 * i for i in range(10)] + [1000 * i for i in range(1, 8)]
    _film(tmp_path / "a.mkv", _drive([6 * i for i in range(len(times))]), times)
    facts = probe(tmp_path / "a.mkv")
    np.testing.assert_allclose(facts.times, np.array(times) / 1000.0, atol=2e-3)
    capture, _, _ = _capture(tmp_path, [SourceConfig(path="a.mkv")], frames=7)
    assert (capture.times < 0.95).sum() == 1 and len(capture.names) == 7


@pytest.mark.parametrize("slots", [1, 3, 7, 20, 80])
def test_every_frame_has_one_slot_and_slots_are_in_order(slots: int) -> None:
    facts = FilmFacts(np.round(np.arange(80) / 15.0, 3), 0.0, 80)  # millisecond stamps, as Matroska has them
    found = [slot_of(i, float(t), facts, slots) for i, t in enumerate(facts.times)]
    assert found == sorted(found) and set(found) == set(range(slots))
    counts = np.bincount(found)
    assert counts.max() - counts.min() <= 1


def test_damaged_frames_leave_gaps_in_the_index() -> None:
    facts = FilmFacts(np.arange(10) / 10.0, 0.0, 10)
    assert [index_of(t, facts, last) for t, last in ((0.0, -1), (0.301, 0), (0.5, 3), (None, 5))] == [0, 3, 5, 6]
    assert index_of(0.5, facts, 7) == 8  # a clock that stutters never gives an index twice


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        ([[1, 0], [0, 1]], lambda image: image),
        ([[0, 1], [-1, 0]], lambda image: np.rot90(image, -1)),  # FFmpeg: a quarter turn clockwise
        ([[-1, 0], [0, -1]], lambda image: np.rot90(image, 2)),
        ([[0, -1], [1, 0]], lambda image: np.rot90(image, 1)),
        ([[-1, 0], [0, 1]], np.fliplr),
        ([[1, 0], [0, -1]], np.flipud),
        ([[0, 1], [1, 0]], lambda image: image.swapaxes(0, 1)),
    ],
)
def test_a_display_matrix_turns_the_picture(matrix: list, expected: Any) -> None:
    image = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    np.testing.assert_array_equal(oriented(image, np.array(matrix, float)), expected(image))


def test_a_film_held_upright_comes_out_upright(tmp_path: Path) -> None:
    frames = _drive([5 * i for i in range(6)])
    path = _film(tmp_path / "a.mp4", frames)
    data = bytearray(path.read_bytes())
    place = data.index(b"tkhd") + 4 + 40  # version and flags, times, id, duration, layer, volume: then the matrix
    quarter = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, _H << 16, 0, 1 << 30)  # as a phone writes 90°
    assert data[place : place + 4] == struct.pack(">i", 1 << 16)
    data[place : place + 36] = quarter
    path.write_bytes(data)
    capture, _, out = _capture(tmp_path, [SourceConfig(path="a.mp4")], frames=6)
    assert (capture.sources[0].width, capture.sources[0].height) == (_H, _W)
    kept = read_image(out / "images/a/000002.png").astype(int)
    assert np.abs(kept - np.rot90(frames[2], -1)).mean() < 3.0 < np.abs(kept - np.rot90(frames[2], 1)).mean()


def test_a_smaller_frame_has_smaller_intrinsics(tmp_path: Path) -> None:
    _film(tmp_path / "a.mp4", _drive([5 * i for i in range(6)]))
    camera = CalibrationConfig("OPENCV", (300.0, 302.0, 158.0, 122.0, 0.1, 0.0, 0.0, 0.0), 320, 240)
    capture, _, out = _capture(tmp_path, [SourceConfig(path="a.mp4", camera=camera)], frames=6, max_size=80)
    source = capture.sources[0]
    assert source.calibrated and source.camera_model == "OPENCV" and (source.width, source.height) == (80, 60)
    np.testing.assert_allclose(source.camera_params, (75.0, 75.5, 39.5, 30.5, 0.1, 0.0, 0.0, 0.0))
    assert read_image(out / "images/a/000000.png").shape == (60, 80, 3)
    sideways = SourceConfig(path="a.mp4", camera=CalibrationConfig("PINHOLE", (150.0, 150.0, 60.0, 80.0), _H, _W))
    _refused(tmp_path, sideways, "upright")


def test_a_mask_hides_what_moves_with_the_camera(tmp_path: Path) -> None:
    """A camera that drives behind a bonnet filling most of the picture: still, unless the bonnet is masked."""
    frames = _drive([5 * i for i in range(8)])
    for frame in frames:
        frame[30:] = _wall(1)[30:_H, :_W]
    _film(tmp_path / "a.mp4", frames)
    _refused(tmp_path, SourceConfig(path="a.mp4"), "1 usable frame", frames=8)
    write_image(tmp_path / "mask.png", np.repeat(np.arange(_H // 2)[:, None] < 15, _W // 2, 1) * np.uint8(255))
    capture, _, out = _capture(tmp_path, [SourceConfig(path="a.mp4", mask="mask.png")], frames=8)
    assert len(capture.names) == 8
    mask = read_image(out / "masks/a/000003.png")[..., 0]
    assert mask.shape == (_H, _W) and (mask[:30] == 255).all() and (mask[30:] == 0).all()


def test_masks_in_a_folder_are_named_like_the_frames(tmp_path: Path) -> None:
    _film(tmp_path / "a.mp4", _drive([5 * i for i in range(6)]))
    for i in range(5):
        write_image(tmp_path / f"masks/{i:06d}.png", np.full((_H, _W), 1, np.uint8))
    _, _, out = _capture(tmp_path, [SourceConfig(path="a.mp4", mask="masks")], frames=6)
    assert sorted(path.stem for path in (out / "masks/a").iterdir()) == [f"{i:06d}" for i in range(5)]
    for i, frame in enumerate(_drive([5 * i for i in range(3)])):
        write_image(tmp_path / f"photos/p{i}.png", frame)
        name = "p0.png" if i == 0 else f"p{i}.png.png"  # by its stem, or as COLMAP has it
        write_image(tmp_path / f"others/{name}", np.full((_H, _W), 255, np.uint8))
    _, _, out = _capture(tmp_path, [SourceConfig(path="photos", mask="others")])
    assert len(list((out / "masks/photos").iterdir())) == 3
    _refused(tmp_path, SourceConfig(path="a.mp4", mask="others"), "named like a frame", frames=6)


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.zeros((_H, _W), np.uint8), "ignores the whole"),
        (np.ones((_W, _W), np.uint8), "aspect"),
        (None, "no such mask"),
    ],
)
def test_a_wrong_mask_is_refused(tmp_path: Path, mask: np.ndarray | None, words: str) -> None:
    _film(tmp_path / "a.mp4", _drive([5 * i for i in range(6)]))
    if mask is not None:
        write_image(tmp_path / "mask.png", mask)
    _refused(tmp_path, SourceConfig(path="a.mp4", mask="mask.png"), words)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda data: b"", "not a readable film"),
        (lambda data: b"not a film" * 50, "not a readable film"),
        (lambda data: data[: len(data) // 2], "not a readable film"),  # the index at the end is gone
    ],
)
def test_a_film_that_cannot_be_opened_is_refused(tmp_path: Path, spoil: Any, words: str) -> None:
    path = _film(tmp_path / "a.mp4", _drive([5 * i for i in range(20)]))
    path.write_bytes(spoil(path.read_bytes()))
    _refused(tmp_path, SourceConfig(path="a.mp4"), words)


def test_a_film_cut_off_gives_the_frames_it_still_has(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = _film(tmp_path / "a.mp4", _drive([5 * i for i in range(40)]), movflags="faststart")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    capture, metrics, _ = _capture(tmp_path, [SourceConfig(path="a.mp4")], frames=40)
    decoded = metrics["sources"]["a"]["decoded"]
    assert 2 <= len(capture.names) == decoded < 40
    assert f"{decoded} of 40 frames could be decoded" in capsys.readouterr().err


def test_no_frame_predicted_from_a_damaged_one_is_used(tmp_path: Path) -> None:
    path = _film(tmp_path / "a.mp4", _drive([7 * i for i in range(60)]), gop="12")

    def decoded() -> tuple[dict[int, np.ndarray], FilmCount]:
        facts, count, index, pictures = probe(path), FilmCount(), -1, {}
        for stamp, frame in decode(path, count):
            index = index_of(None if stamp is None else stamp - facts.start, facts, index)
            pictures[index] = upright(frame)
        return pictures, count

    sound, count = decoded()
    assert len(sound) == 60 and count.damaged == 0
    with av.open(str(path)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = path.read_bytes()
    for spoil in ([20], [5, 31], [40, 41]):
        spoilt = bytearray(data)
        for number in spoil:
            start, size = places[number]
            spoilt[start + size // 4 : start + size] = bytes(size - size // 4)
        path.write_bytes(spoilt)
        found, count = decoded()
        assert count.damaged >= len(spoil) and 60 - 25 * len(spoil) <= len(found) < 60
        for index, picture in found.items():
            np.testing.assert_array_equal(picture, sound[index])


def test_one_frame_or_nothing_to_see_is_refused(tmp_path: Path) -> None:
    _film(tmp_path / "one.mp4", _drive([0]))
    _refused(tmp_path, SourceConfig(path="one.mp4"), r"one\.mp4.*need 2")
    _film(tmp_path / "black.mp4", [np.zeros((_H, _W, 3), np.uint8)] * 5)
    _refused(tmp_path, SourceConfig(path="black.mp4"), "blank")
    _film(tmp_path / "still.mp4", _drive([0] * 6))
    _refused(tmp_path, SourceConfig(path="still.mp4"), "still: 1 usable frame")
    _refused(tmp_path, SourceConfig(path="absent.mp4"), r"absent\.mp4")
    write_image(tmp_path / "photos/a.png", _drive([0])[0])
    _refused(tmp_path, SourceConfig(path="photos"), "photos: 1 usable frame")


def test_photos_are_kept_in_order_without_exact_duplicates(tmp_path: Path) -> None:
    for i, frame in enumerate(_drive([5 * i for i in range(11)])):
        write_image(tmp_path / f"photos/p{i}.png", frame)
    write_image(tmp_path / "photos/p11.png", read_image(tmp_path / "photos/p3.png"))
    capture, metrics, out = _capture(tmp_path, [SourceConfig(path="photos")])
    assert metrics["sources"]["photos"]["duplicates"] == 1 and len(capture.names) == 11
    np.testing.assert_array_equal(read_image(out / "images/photos/000010.png"), _drive([50])[0])
    few = _capture(tmp_path, [SourceConfig(path="photos")], frames=4)[0].names
    assert few == ("photos/000000", "photos/000004", "photos/000007", "photos/000011")
    assert not capture.sources[0].calibrated and capture.sources[0].camera_params == ()


def test_a_photo_is_turned_upright_and_its_header_is_used(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for i, frame in enumerate(_drive([9 * i for i in range(3)])):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6  # turn a quarter clockwise to show it
        photo = exif.get_ifd(ExifTags.IFD.Exif)
        photo[ExifTags.Base.FocalLengthIn35mmFilm] = 26
        photo[ExifTags.Base.DateTimeOriginal] = f"2024:05:01 12:00:{10 + 2 * i}"
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        gps[ExifTags.GPS.GPSLatitudeRef], gps[ExifTags.GPS.GPSLatitude] = "N", (55.0, 30.0, 0.0)
        gps[ExifTags.GPS.GPSLongitudeRef], gps[ExifTags.GPS.GPSLongitude] = "E", (13.0, 15.0, 0.0)
        Image.fromarray(frame).save(tmp_path / f"photos/{i}.jpg", quality=95, exif=exif)
    capture, metrics, out = _capture(tmp_path, [SourceConfig(path="photos")])
    kept = read_image(out / "images/photos/000001.png").astype(int)
    assert np.abs(kept - np.rot90(_drive([9])[0], -1)).mean() < 6.0
    np.testing.assert_allclose(capture.times, (0.0, 2.0, 4.0))
    np.testing.assert_allclose(capture.gps, [(55.5, 13.25, np.nan)] * 3)
    focal = 26.0 / np.hypot(36, 24) * np.hypot(_W, _H)
    np.testing.assert_allclose(capture.sources[0].camera_params, (focal, _H / 2, _W / 2, 0.0))
    assert capture.sources[0].camera_model == "SIMPLE_RADIAL" and not capture.sources[0].calibrated
    assert metrics["with_gps"] == 3


@pytest.mark.parametrize(("keep", "words"), [(0.0, "0 bytes"), (0.5, "cut off")])
def test_a_damaged_photo_is_named(tmp_path: Path, keep: float, words: str) -> None:
    for i, frame in enumerate(_drive([5 * i for i in range(3)])):
        write_image(tmp_path / f"photos/{i}.jpg", frame)
    path = tmp_path / "photos/1.jpg"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * keep)])
    _refused(tmp_path, SourceConfig(path="photos"), rf"1\.jpg.*{words}")


def test_photos_of_two_shapes_are_refused(tmp_path: Path) -> None:
    for i, frame in enumerate(_drive([0, 9])):
        write_image(tmp_path / f"photos/{i}.png", frame if i else frame.swapaxes(0, 1))
    _refused(tmp_path, SourceConfig(path="photos"), "source of their own")


def _posed(tmp_path: Path, per_frame: list[dict[str, Any]], **top: Any) -> None:
    frames = []
    for i, extra in enumerate(per_frame):
        write_image(tmp_path / f"posed/{i}.png", _drive([9 * i])[0])
        frames.append({"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist(), **extra})
    (tmp_path / "posed/transforms.json").write_text(json.dumps({"frames": frames, **top}))


def test_poses_and_intrinsics_of_images_half_their_size(tmp_path: Path) -> None:
    _posed(tmp_path, [{}] * 3, fl_x=300.0, fl_y=310.0, cx=158.0, cy=122.0, w=2 * _W, h=2 * _H, k1=0.1)
    capture, metrics, _ = _capture(tmp_path, [SourceConfig(path="posed")])
    assert metrics["posed"] and capture.camera_to_world is not None
    np.testing.assert_allclose(capture.intrinsics, [(150.0, 155.0, 79.0, 61.0)] * 3)  # type: ignore[arg-type]
    np.testing.assert_allclose(capture.camera_to_world, [np.diag([1.0, -1.0, -1.0, 1.0])] * 3)
    assert capture.sources[0].camera_model == "OPENCV" and capture.sources[0].calibrated
    np.testing.assert_allclose(capture.sources[0].camera_params, (150.0, 155.0, 79.0, 61.0, 0.1, 0.0, 0.0, 0.0))


def test_lenses_that_differ_in_distortion_are_flattened(tmp_path: Path) -> None:
    _posed(tmp_path, [{"k1": -0.3}, {"k1": -0.2}, {"k1": 0.0, "k2": 0.0}], fl_x=150.0, w=_W, h=_H)
    capture, _, out = _capture(tmp_path, [SourceConfig(path="posed")])
    assert capture.sources[0].camera_model == "PINHOLE" and capture.intrinsics is not None
    assert len({tuple(k) for k in capture.intrinsics.round(3)}) == 3
    np.testing.assert_array_equal(read_image(out / "images/posed/000002.png"), _drive([18])[0])
    assert (read_image(out / "images/posed/000000.png") != _drive([0])[0]).any()


def test_poses_count_only_where_every_source_brings_them(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    _posed(tmp_path, [{}] * 3, fl_x=150.0)
    _film(tmp_path / "film.mp4", _drive([5 * i for i in range(6)]))
    capture, metrics, _ = _capture(tmp_path, [SourceConfig(path="posed"), SourceConfig(path="film.mp4")], frames=6)
    assert capture.camera_to_world is None and capture.intrinsics is None and not metrics["posed"]
    assert capture.sources[0].calibrated  # its lens is still known
    assert "film brings none" in capsys.readouterr().err


def test_held_out_frames_leave_the_ends_and_stagger() -> None:
    for count in range(1, 40):
        for source in range(10):
            held_out = held_out_frames(count, 8, source)
            assert len(held_out) == count and not held_out[0] and not held_out[-1]
            assert held_out.any() == (count >= 3)
    a, b = held_out_frames(80, 8, 0), held_out_frames(80, 8, 1)
    assert a.sum() == b.sum() == 10 and not (a & b).any()
    assert set(np.diff(np.flatnonzero(a))) == {8}


def test_sources_have_unique_plain_names() -> None:
    paths = [
        "input/day.mp4",
        "other/day.mov",
        "input/Day.avi",
        "input/fox/transforms.json",
        "walk/sparse/0",
        "a b/ü.mp4",
    ]
    assert source_names(paths) == ["day", "day_2", "Day_3", "fox", "walk", "_"]
    assert source_names(["input/images", "."]) == ["images", "source"]


def test_photo_times_need_a_clock_that_rises() -> None:
    assert photo_times([10.0, 11.5, 12.0], [0, 1, 2]) == [0.0, 1.5, 2.0]
    for clock in ([10.0, 10.0, 12.0], [10.0, 9.0, 12.0], [10.0, None, 12.0]):
        assert photo_times(clock, [0, 2, 3]) == [0.0, 2.0, 3.0]


def test_a_regular_choice_has_both_ends() -> None:
    assert regular_choice(10, 4).tolist() == [0, 3, 6, 9] and regular_choice(3, 4).tolist() == [0, 1, 2]


def test_flow_measures_a_known_shift_and_blur_is_not_exposure() -> None:
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in _drive([0, 3])]
    moved = median_motion(grey[0], grey[1])  # type: ignore[arg-type]
    assert moved is not None and abs(moved - 3.0) < 0.1
    flat = np.full((_H, _W), 90, np.uint8)
    assert median_motion(flat, flat) is None and stands_still(flat, flat, 1.0)
    ramp = np.tile(np.linspace(60, 120, _W), (_H, 1)).astype(np.uint8)
    assert not stands_still(ramp, ramp[:, ::-1].copy(), 1.0)
    dark = (grey[0] * 0.5).astype(np.uint8)
    assert sharpness(dark) == pytest.approx(sharpness(grey[0]), rel=0.1)  # type: ignore[arg-type]
    assert sharpness(cv2.GaussianBlur(grey[0], (0, 0), 2.0)) < 0.5 * sharpness(grey[0])  # type: ignore[arg-type]


def test_a_picture_that_changes_its_size_is_refused(tmp_path: Path) -> None:
    for name, shape in (("a.ts", (_H, _W)), ("b.ts", (_W, _H))):
        frames = [np.ascontiguousarray(_wall(2)[: shape[0], s : s + shape[1]]) for s in range(0, 60, 6)]
        _film(tmp_path / name, frames)
    (tmp_path / "both.ts").write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    _refused(tmp_path, SourceConfig(path="both.ts"), "the picture changes from 160x120")


def test_new_writes_a_scene_that_loads_and_never_overwrites(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    day = _film(tmp_path / "day.mp4", _drive([5 * i for i in range(4)]))
    dusk = _film(tmp_path / 'other/du"sk.mp4', _drive([5 * i for i in range(4)]))
    root = tmp_path / "scenes" / "road"
    assert new_main([str(root), str(day), str(dusk), "--camera-height", "1.2"]) == 0
    config = load_config(root / "scene.toml")
    assert config.name == "road" and config.metric.camera_height == 1.2
    assert [(s.path, s.lighting) for s in config.source] == [("input/day.mp4", "day"), ('input/du"sk.mp4', 'du"sk')]
    assert (root / "input/day.mp4").read_bytes() == day.read_bytes()
    before = (root / "scene.toml").read_text()
    for line in before.splitlines():  # every commented line is a setting that exists
        if line.startswith("# ") and " = " in line and "[fx" not in line:
            (tmp_path / "one.toml").write_text(_uncommented(before, line))
            load_config(tmp_path / "one.toml")
    capsys.readouterr()
    assert new_main([str(root), str(day)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and "already" in error and (root / "scene.toml").read_text() == before


def _uncommented(text: str, line: str) -> str:
    scales = ("# gps", "# poses", "# marker", "# distance")
    if line.startswith(scales):
        text = text.replace("camera_height = 1.2", "# camera_height = 1.2")
    return text.replace(line, line.removeprefix("# "), 1)


@pytest.mark.parametrize("arguments", [["absent.mp4"], ["text.mp4"], ["day.mp4", "--camera-height", "-1"]])
def test_new_refuses_what_cannot_be_built(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _film(tmp_path / "day.mp4", _drive([0, 5, 10]))
    (tmp_path / "text.mp4").write_text("no film")
    assert new_main(["scene", *arguments]) == 2
    assert capsys.readouterr().err.startswith("error: ") and not (tmp_path / "scene/scene.toml").exists()


@pytest.mark.realdata
def test_the_paper_films_keep_all_their_frames(tmp_path: Path, real_data: Path) -> None:
    films = real_data / "driveenv_paper_road"
    sources = [SourceConfig(path=str(films / f"{name}.mp4")) for name in ("cloudy2sunny", "day2night")]
    capture, _, _ = _capture(tmp_path, sources, frames=80, min_motion=0.0, max_size=160)
    assert len(capture.names) == 160
    assert [n.split("/")[1] for n in capture.names[:80]] == [n.split("/")[1] for n in capture.names[80:]]


@pytest.mark.realdata
def test_photos_with_gps_and_a_posed_set(tmp_path: Path, real_data: Path) -> None:
    capture, _, _ = _capture(tmp_path, [SourceConfig(path=str(real_data / "lund_street/images"))], max_size=256)
    assert len(capture.names) == 29 and np.isfinite(capture.gps).all()
    fox = SourceConfig(path=str(real_data / "fox/transforms_orig_1080x1920.json"))
    capture, metrics, _ = _capture(tmp_path, [fox])
    source = next(iter(metrics["sources"].values()))
    assert (source["kept"], source["missing"], source["width"]) == (50, 17, 540) and capture.intrinsics is not None
    np.testing.assert_allclose(capture.intrinsics[0], (687.76, 687.245, 277.279, 482.634))
