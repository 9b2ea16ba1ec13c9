"""Films: frame selection, rotation, scaling, masks, the held-out split and refused input."""

import contextlib
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
from av.video.frame import PictureType
from filmed_wall import HEIGHT, WIDTH, captured, film, refused, views, wall

from twin.capture import video
from twin.capture.frames import held_out_frames, source_names
from twin.capture.video import (
    FilmStatistics,
    FilmTiming,
    apply_display_matrix,
    decode,
    frame_index,
    is_static,
    median_motion,
    probe,
    sharpness,
    slot_of,
    upright,
)
from twin.config import CalibrationConfig, SourceConfig
from twin.errors import InputError
from twin.geometry.images import read_image, write_image


def test_as_many_slots_as_frames_keeps_every_frame_of_every_film(tmp_path: Path) -> None:
    frames = views([4 * i for i in range(24)])
    film(tmp_path / "day.mp4", frames)
    film(tmp_path / "night.mp4", [frame // 6 for frame in frames])
    capture, metrics, out = captured(
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
    frames = views([5 * i for i in range(16)])
    frames = [frame if i in sharp else cv2.GaussianBlur(frame, (0, 0), 3.0) for i, frame in enumerate(frames)]
    film(tmp_path / "a.mp4", frames)
    capture, _, _ = captured(tmp_path, [SourceConfig(path="a.mp4")], frames=4)
    assert capture.names == tuple(f"a/{i:06d}" for i in sharp)


def test_frames_of_a_standing_camera_are_dropped(tmp_path: Path) -> None:
    shifts = [6 * i for i in range(6)] + [30] * 8 + [30 + 6 * i for i in range(1, 6)]
    film(tmp_path / "a.mp4", views(shifts))
    capture, metrics, _ = captured(tmp_path, [SourceConfig(path="a.mp4")], frames=len(shifts))
    assert metrics["sources"]["a"]["duplicates"] == 8 and len(capture.names) == len(shifts) - 8
    capture, metrics, _ = captured(tmp_path, [SourceConfig(path="a.mp4")], frames=len(shifts), min_motion=0.0)
    assert len(capture.names) == len(shifts)


def test_frames_per_second_and_the_upper_bound(tmp_path: Path, capsys) -> None:
    film(tmp_path / "a.mp4", views([4 * i for i in range(60)]))
    assert len(captured(tmp_path, [SourceConfig(path="a.mp4")], fps=3.0)[0].names) == 12  # 4 s
    assert len(captured(tmp_path, [SourceConfig(path="a.mp4")], fps=15.0, max_frames=7)[0].names) == 7
    assert "a.mp4: 7 of 60 frames are kept, as capture.max_frames = 7; raise it" in capsys.readouterr().err


def test_slots_follow_the_clock_of_a_film_with_a_variable_rate(tmp_path: Path) -> None:
    # Ten frames in the first second, then one each second: equal slots in time are not equal counts.
    times = [100 * i for i in range(10)] + [1000 * i for i in range(1, 8)]
    film(tmp_path / "a.mkv", views([6 * i for i in range(len(times))]), times)
    timing = probe(tmp_path / "a.mkv")
    np.testing.assert_allclose(timing.times, np.array(times) / 1000.0, atol=2e-3)
    capture, _, _ = captured(tmp_path, [SourceConfig(path="a.mkv")], frames=7)
    assert (capture.times < 0.95).sum() == 1 and len(capture.names) == 7


def test_a_pause_takes_no_slots(tmp_path: Path) -> None:
    """Two drives of two seconds, an hour apart: each has half of the frames, at its own times."""
    times = [100 * i for i in range(20)] + [3_600_000 + 100 * i for i in range(20)]
    film(tmp_path / "a.mkv", views([6 * i for i in range(len(times))]), times)
    capture, _, _ = captured(tmp_path, [SourceConfig(path="a.mkv")], frames=10)
    assert len(capture.names) == 10 and (capture.times < 2.0).sum() == 5 and (capture.times >= 3600.0).sum() == 5


def test_sources_without_a_lighting_have_the_names_of_their_films(tmp_path: Path, capsys) -> None:
    for name in ("день.mkv", "ночь.mkv", "a b.mkv", "a/GX01.mkv", "b/GX01.mkv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        film(tmp_path / name, views([0, 6, 12, 18]))
    sources = [SourceConfig(path=name) for name in ("день.mkv", "ночь.mkv", "a b.mkv", "a/GX01.mkv", "b/GX01.mkv")]
    capture, _, _ = captured(tmp_path, sources)
    assert list(dict.fromkeys(source.lighting for source in capture.sources)) == ["день", "ночь", "a_b", "GX01"]
    assert len({source.name for source in capture.sources}) == 5
    told = capsys.readouterr().err
    assert "a/GX01.mkv and b/GX01.mkv count as filmed under one lighting, 'GX01'" in told and "день" not in told


@pytest.mark.parametrize("slots", [1, 3, 7, 20, 80])
def test_every_frame_has_one_slot_and_slots_are_in_order(slots: int) -> None:
    timing = FilmTiming(np.round(np.arange(80) / 15.0, 3), 0.0, 80)  # millisecond stamps, as Matroska has them
    found = [slot_of(i, float(t), timing, slots) for i, t in enumerate(timing.times)]
    assert found == sorted(found) and set(found) == set(range(slots))
    counts = np.bincount(found)
    assert counts.max() - counts.min() <= 1


def test_damaged_frames_leave_gaps_in_the_index() -> None:
    timing = FilmTiming(np.arange(10) / 10.0, 0.0, 10)
    assert [frame_index(t, timing, last) for t, last in ((0.0, -1), (0.301, 0), (0.5, 3), (None, 5))] == [0, 3, 5, 6]
    assert frame_index(0.5, timing, 7) == 8  # a clock that stutters never gives an index twice


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
    np.testing.assert_array_equal(apply_display_matrix(image, np.array(matrix, float)), expected(image))


def test_a_film_held_upright_comes_out_upright(tmp_path: Path) -> None:
    frames = views([5 * i for i in range(6)])
    path = film(tmp_path / "a.mp4", frames)
    data = bytearray(path.read_bytes())
    place = data.index(b"tkhd") + 4 + 40  # version and flags, times, id, duration, layer, volume: then the matrix
    quarter = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, HEIGHT << 16, 0, 1 << 30)  # as a phone writes 90°
    assert data[place : place + 4] == struct.pack(">i", 1 << 16)
    data[place : place + 36] = quarter
    path.write_bytes(data)
    capture, _, out = captured(tmp_path, [SourceConfig(path="a.mp4")], frames=6)
    assert (capture.sources[0].width, capture.sources[0].height) == (HEIGHT, WIDTH)
    kept = read_image(out / "images/a/000002.png").astype(int)
    assert np.abs(kept - np.rot90(frames[2], -1)).mean() < 3.0 < np.abs(kept - np.rot90(frames[2], 1)).mean()


def test_a_smaller_frame_has_smaller_intrinsics(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", views([5 * i for i in range(6)]))
    camera = CalibrationConfig("OPENCV", (300.0, 302.0, 158.0, 122.0, 0.1, 0.0, 0.0, 0.0), 320, 240)
    capture, _, out = captured(tmp_path, [SourceConfig(path="a.mp4", camera=camera)], frames=6, max_size=80)
    source = capture.sources[0]
    assert source.calibrated and source.camera_model == "OPENCV" and (source.width, source.height) == (80, 60)
    np.testing.assert_allclose(source.camera_params, (75.0, 75.5, 39.5, 30.5, 0.1, 0.0, 0.0, 0.0))
    assert read_image(out / "images/a/000000.png").shape == (60, 80, 3)
    sideways = SourceConfig(
        path="a.mp4", camera=CalibrationConfig("PINHOLE", (150.0, 150.0, 60.0, 80.0), HEIGHT, WIDTH)
    )
    refused(tmp_path, sideways, "upright")
    film(tmp_path / "b.mp4", views([5 * i for i in range(6)]))
    with pytest.raises(InputError, match=r"a\.mp4: camera is for"):  # before the other film is read
        captured(tmp_path, [SourceConfig(path="b.mp4"), sideways], frames=6)
    assert not (tmp_path / "out/images/b").exists()


def test_a_mask_hides_what_moves_with_the_camera(tmp_path: Path) -> None:
    """The car's hood fills most of the picture, so the picture seems to stand still unless the hood is masked."""
    frames = views([5 * i for i in range(8)])
    for frame in frames:
        frame[30:] = wall(1)[30:HEIGHT, :WIDTH]
    film(tmp_path / "a.mp4", frames)
    refused(tmp_path, SourceConfig(path="a.mp4"), "1 usable frame", frames=8)
    write_image(tmp_path / "mask.png", np.repeat(np.arange(HEIGHT // 2)[:, None] < 15, WIDTH // 2, 1) * np.uint8(255))
    capture, _, out = captured(tmp_path, [SourceConfig(path="a.mp4", mask="mask.png")], frames=8)
    assert len(capture.names) == 8
    mask = read_image(out / "masks/a/000003.png")[..., 0]
    assert mask.shape == (HEIGHT, WIDTH) and (mask[:30] == 255).all() and (mask[30:] == 0).all()


def test_masks_in_a_folder_are_named_like_the_frames(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", views([5 * i for i in range(6)]))
    for i in range(5):
        write_image(tmp_path / f"masks/{i:06d}.png", np.full((HEIGHT, WIDTH), 1, np.uint8))
    _, _, out = captured(tmp_path, [SourceConfig(path="a.mp4", mask="masks")], frames=6)
    assert sorted(path.stem for path in (out / "masks/a").iterdir()) == [f"{i:06d}" for i in range(5)]
    for i, frame in enumerate(views([5 * i for i in range(3)])):
        write_image(tmp_path / f"photos/p{i}.png", frame)
        name = "p0.png" if i == 0 else f"p{i}.png.png"  # by its stem, or as COLMAP has it
        write_image(tmp_path / f"others/{name}", np.full((HEIGHT, WIDTH), 255, np.uint8))
    _, _, out = captured(tmp_path, [SourceConfig(path="photos", mask="others")])
    assert len(list((out / "masks/photos").iterdir())) == 3
    refused(tmp_path, SourceConfig(path="a.mp4", mask="others"), "named like a frame", frames=6)


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint8), "ignores the whole"),
        (np.ones((WIDTH, WIDTH), np.uint8), "aspect"),
        (None, "No such file.*give as mask"),
    ],
)
def test_a_wrong_mask_is_refused(tmp_path: Path, mask: np.ndarray | None, words: str) -> None:
    film(tmp_path / "a.mp4", views([5 * i for i in range(6)]))
    if mask is not None:
        write_image(tmp_path / "mask.png", mask)
    refused(tmp_path, SourceConfig(path="a.mp4", mask="mask.png"), words)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda data: b"", "not a readable film"),
        (lambda data: b"not a film" * 50, "not a readable film"),
        (lambda data: data[: len(data) // 2], "not a readable film"),  # the index at the end is gone
    ],
)
def test_a_film_that_cannot_be_opened_is_refused(tmp_path: Path, spoil: Any, words: str) -> None:
    path = film(tmp_path / "a.mp4", views([5 * i for i in range(20)]))
    path.write_bytes(spoil(path.read_bytes()))
    refused(tmp_path, SourceConfig(path="a.mp4"), words)


def test_a_film_cut_off_gives_the_frames_it_still_has(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = film(tmp_path / "a.mp4", views([5 * i for i in range(40)]), movflags="faststart")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    capture, metrics, _ = captured(tmp_path, [SourceConfig(path="a.mp4")], frames=40)
    decoded = metrics["sources"]["a"]["decoded"]
    assert 2 <= len(capture.names) == decoded < 40
    assert f"{decoded} of 40 frames could be decoded" in capsys.readouterr().err


def test_a_film_of_b_frames_alone_is_not_held_in_memory(monkeypatch) -> None:
    decoded = 0

    class Packet:
        def decode(self):
            nonlocal decoded
            decoded += 1
            kind = PictureType.B if decoded % 250 != 1 else PictureType.I
            return [SimpleNamespace(time=decoded, is_corrupt=False, key_frame=decoded % 250 == 1, pict_type=kind)]

    monkeypatch.setattr(video, "open_film", lambda _: contextlib.nullcontext((None, SimpleNamespace())))
    monkeypatch.setattr(video, "_packets", lambda *_: iter([Packet() for _ in range(300)]))
    most, times = 0, []
    for time, _ in video._intact_frames(Path("film.mp4"), FilmStatistics()):
        times.append(time)
        most = max(most, decoded - len(times))
    assert times == list(range(1, 301)) and most <= 16


def test_no_frame_predicted_from_a_damaged_one_is_used(tmp_path: Path) -> None:
    path = film(tmp_path / "a.mp4", views([7 * i for i in range(60)]), gop="12")

    def decoded() -> tuple[dict[int, np.ndarray], FilmStatistics]:
        timing, count, index, pictures = probe(path), FilmStatistics(), -1, {}
        for stamp, frame in decode(path, count):
            index = frame_index(None if stamp is None else stamp - timing.start, timing, index)
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


def test_one_frame_or_blank_frames_are_refused(tmp_path: Path) -> None:
    film(tmp_path / "one.mp4", views([0]))
    refused(tmp_path, SourceConfig(path="one.mp4"), r"one\.mp4.*need 2")
    film(tmp_path / "black.mp4", [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 5)
    refused(tmp_path, SourceConfig(path="black.mp4"), "blank")
    film(tmp_path / "still.mp4", views([0] * 6))
    refused(tmp_path, SourceConfig(path="still.mp4"), "still: 1 usable frame")
    refused(tmp_path, SourceConfig(path="absent.mp4"), r"absent\.mp4")
    write_image(tmp_path / "photos/a.png", views([0])[0])
    refused(tmp_path, SourceConfig(path="photos"), "photos: 1 usable frame")


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


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (SourceConfig(path="a.mp4", lighting="training"), "'training' is reserved"),
        (SourceConfig(path="input/held-out.mp4"), "'held-out' is reserved"),
        (SourceConfig(path="any"), "'any' is reserved"),
        (SourceConfig(path="a.mp4", lighting="day:night"), "choose a plain name"),
        (SourceConfig(path="a.mp4", lighting="day+randomised"), "choose a plain name"),
    ],
)
def test_a_reserved_lighting_name_is_refused_before_reading(tmp_path: Path, source: SourceConfig, words: str) -> None:
    refused(tmp_path, source, words)  # none of these files exists


def test_flow_measures_a_known_shift_and_blur_is_not_exposure() -> None:
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in views([0, 3])]
    moved = median_motion(grey[0], grey[1])  # type: ignore[arg-type]
    assert moved is not None and abs(moved - 3.0) < 0.1
    flat = np.full((HEIGHT, WIDTH), 90, np.uint8)
    assert median_motion(flat, flat) is None and is_static(flat, flat, 1.0)
    ramp = np.tile(np.linspace(60, 120, WIDTH), (HEIGHT, 1)).astype(np.uint8)
    assert not is_static(ramp, ramp[:, ::-1].copy(), 1.0)
    dark = (grey[0] * 0.5).astype(np.uint8)
    assert sharpness(dark) == pytest.approx(sharpness(grey[0]), rel=0.1)  # type: ignore[arg-type]
    assert sharpness(cv2.GaussianBlur(grey[0], (0, 0), 2.0)) < 0.5 * sharpness(grey[0])  # type: ignore[arg-type]


def test_a_picture_that_changes_its_size_is_refused(tmp_path: Path) -> None:
    for name, shape in (("a.ts", (HEIGHT, WIDTH)), ("b.ts", (WIDTH, HEIGHT))):
        frames = [np.ascontiguousarray(wall(2)[: shape[0], s : s + shape[1]]) for s in range(0, 60, 6)]
        film(tmp_path / name, frames)
    (tmp_path / "both.ts").write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    refused(tmp_path, SourceConfig(path="both.ts"), "the picture changes from 160x120")


@pytest.mark.realdata
def test_the_paper_films_keep_all_their_frames(tmp_path: Path, real_data: Path) -> None:
    films = real_data / "driveenv_paper_road"
    sources = [SourceConfig(path=str(films / f"{name}.mp4")) for name in ("cloudy2sunny", "day2night")]
    capture, _, _ = captured(tmp_path, sources, frames=80, min_motion=0.0, max_size=160)
    assert len(capture.names) == 160
    assert [n.split("/")[1] for n in capture.names[:80]] == [n.split("/")[1] for n in capture.names[80:]]


def test_only_the_parts_of_a_film_that_are_kept_are_read(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", views([4 * i for i in range(60)]))  # 4 s
    film(tmp_path / "b.mp4", views([4 * i for i in range(60)]))
    sources = [SourceConfig(path="a.mp4"), SourceConfig(path="b.mp4", keep=((3.0, 9.0),))]
    capture, metrics, _ = captured(tmp_path, sources, fps=5.0, keep=((0.0, 1.0), (2.0, 2.6)))
    times = capture.times[capture.source_index == 0]
    assert len(times) in (8, 9) and np.all((times <= 1.001) | ((times >= 1.999) & (times <= 2.601)))
    assert (times < 1.5).sum() in (5, 6)
    assert capture.names[0].startswith("a/0000") and capture.names[len(times) - 1] == f"a/{times[-1] * 15:06.0f}"
    times = capture.times[capture.source_index == 1]
    assert len(times) == 5 and times.min() >= 2.999
    timing = metrics["sources"]["b"]
    assert timing["decoded"] == timing["promised"] == 15 and timing["duration_s"] == 1.0


def test_as_many_slots_as_frames_keeps_every_frame_of_a_part(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", views([4 * i for i in range(30)]))
    capture, _, _ = captured(tmp_path, [SourceConfig(path="a.mp4")], frames=30, keep=((1.0, 1.4),))
    assert capture.names == tuple(f"a/{i:06d}" for i in range(15, 22))


def test_segments_without_frames_are_refused(tmp_path: Path) -> None:
    film(tmp_path / "a.mp4", views([4 * i for i in range(30)]))
    refused(tmp_path, SourceConfig(path="a.mp4", keep=((5.0, 9.0),)), r"leaves 0 of 30 frames.*0 to 1\.93 s")
