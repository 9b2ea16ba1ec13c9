"""The video writer: decoded frames equal the written ones, and an error leaves no partial file."""

from pathlib import Path

import numpy as np
import pytest
from films import video_info

from twin.report.video_writer import VideoWriter, even, read_frames


def _gradient(i: int, width: int = 64, height: int = 48) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return (np.stack([u, v, np.full_like(u, i / 10)], -1) * 255).astype(np.uint8)


def test_a_film_is_h264_yuv420p_and_keeps_its_pictures(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    frames = [_gradient(i) for i in range(10)]
    with VideoWriter(path, (64, 48), fps=5, crf=12) as film:
        for frame in frames:
            film.write(frame)
    about = video_info(path)
    assert (about["codec"], about["pixel_format"]) == ("h264", "yuv420p")
    assert (about["width"], about["height"], about["fps"], about["frames"]) == (64, 48, 5.0, 10)
    read = list(read_frames(path))
    assert len(read) == 10
    for got, expected in zip(read, frames, strict=True):
        # Colors survive the way through YUV: a wrong matrix or range is off by ten levels or more.
        assert np.abs(got.astype(int) - expected).mean() < 4.0


@pytest.mark.parametrize("colour", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0), (40, 200, 120)])
def test_flat_colors_survive_encoding(tmp_path: Path, colour: tuple[int, int, int]) -> None:
    frame = np.broadcast_to(np.array(colour, np.uint8), (32, 32, 3)).copy()
    with VideoWriter(tmp_path / "flat.mp4", (32, 32), fps=2, crf=5) as film:
        film.write(frame, count=2)
    read = next(read_frames(tmp_path / "flat.mp4"))
    assert np.abs(read.reshape(-1, 3).astype(int) - colour).max() <= 4


def test_the_index_precedes_the_frames(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    with VideoWriter(path, (32, 32), fps=5) as film:
        film.write(np.zeros((32, 32, 3), np.uint8), count=3)
    data = path.read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        with VideoWriter(tmp_path / name, (64, 48), fps=5) as film:
            for i in range(5):
                film.write(_gradient(i))
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_an_error_leaves_no_partial_film_and_keeps_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(b"the old film")
    with pytest.raises(RuntimeError, match="stop"), VideoWriter(path, (32, 32), fps=5) as film:
        film.write(np.zeros((32, 32, 3), np.uint8))
        raise RuntimeError("stop")
    assert path.read_bytes() == b"the old film"
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]


def test_wrong_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="even"):
        VideoWriter(tmp_path / "film.mp4", (33, 32), fps=5)
    with VideoWriter(tmp_path / "film.mp4", (32, 32), fps=5) as film:
        film.write(np.zeros((32, 32, 3), np.uint8))
        with pytest.raises(ValueError, match="expected uint8"):
            film.write(np.zeros((30, 32, 3), np.uint8))


def test_even_rounds_down_to_even_sides() -> None:
    assert [even(n) for n in (0, 2, 3, 719, 720)] == [2, 2, 2, 718, 720]
