"""Films as phones and camcorders make them: HDR, interlaced, HEIC; and what `twin new` says of films."""

import gc
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from films import HLG, PQ, street, write_film, write_hdr_film

from twin import commands
from twin.capture.film_check import check_film
from twin.capture.formats import image_files
from twin.capture.photos import load_photo
from twin.capture.video import FilmStatistics, damage_note, decode, format_note, read_film, upright, video_film
from twin.config import CaptureConfig
from twin.errors import InputError
from twin.geometry.images import read_image


def read(path: Path) -> tuple[list[np.ndarray], FilmStatistics, list[float]]:
    count = FilmStatistics()
    config = CaptureConfig(frames=100, min_motion=0.0)
    frames = list(read_film(video_film(path), config, count, lambda *_: None))
    return [one.image for one in frames], count, [one.time for one in frames]


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize(("transfer", "name"), [(HLG, "HLG"), (PQ, "PQ")])
def test_an_hdr_film_comes_back_as_the_sdr_pictures_it_was_made_of(tmp_path, transfer, name):
    pictures = street(4)
    write_hdr_film(tmp_path / "phone.mp4", pictures, transfer)
    got, count, _ = read(tmp_path / "phone.mp4")
    assert count.hdr == name and len(got) == 4
    for image, picture in zip(got, pictures, strict=True):
        difference = image.astype(int) - picture
        assert (
            np.abs(difference).mean() < 3.5 and np.abs(difference.mean((0, 1))).max() < 0.5
        )  # codec and halved chroma
    taken = decoded(tmp_path / "phone.mp4")[0]
    assert np.abs(taken.astype(int) - pictures[0]).mean() > 9.0  # as it is without the conversion
    assert format_note(tmp_path / "phone.mp4", count) == (
        f"phone.mp4: HDR ({name}), converted to SDR; film without it if you can"
    )


def test_highlights_of_hdr_are_compressed_and_keep_their_order(tmp_path):
    ramp = np.repeat(np.linspace(0, 255 * 2.0, 160)[None, :, None], 96, 0).repeat(3, 2)  # to 5 times white
    write_hdr_film(tmp_path / "phone.mp4", [ramp] * 2, HLG)
    row = read(tmp_path / "phone.mp4")[0][0][48, :, 1].astype(int)
    assert row[-1] >= 254 and (np.diff(cv2.blur(row.astype(np.float32)[None], (9, 1))[0]) > -0.2).all()
    assert abs(row[40] - 127) < 3 and 235 < row[80] < 252  # half of the signal's range is not touched; white is


def test_an_interlaced_film_is_deinterlaced(tmp_path):
    fields = street(24, step=5)
    woven = []
    for even, odd in zip(fields[::2], fields[1::2], strict=True):
        picture = even.copy()
        picture[1::2] = odd[1::2]
        woven.append(picture)
    write_film(tmp_path / "cam.mpg", woven, codec="mpeg2video", flags="+ildct+ilme")
    got, count, times = read(tmp_path / "cam.mpg")
    assert count.interlaced and len(got) == 12
    np.testing.assert_allclose(np.diff(times), 0.04, atol=1e-6)

    def combing(picture):
        rows = picture.astype(float)
        return np.abs(rows[1:-1] - (rows[:-2] + rows[2:]) / 2).mean()

    assert combing(got[5]) < 0.3 * combing(decoded(tmp_path / "cam.mpg")[5])
    assert "deinterlaced" in (format_note(tmp_path / "cam.mpg", count) or "")


def test_frames_of_a_varying_rate_are_taken_by_their_times(tmp_path):
    times = [0, 40, 80, 120, 1000, 2000, 2040, 3000]
    write_film(tmp_path / "phone.mp4", street(8), times)
    count = FilmStatistics()
    config = CaptureConfig(fps=1.0, min_motion=0.0)
    kept = [one.time for one in read_film(video_film(tmp_path / "phone.mp4"), config, count, lambda *_: None)]
    assert len(kept) == 3 and kept[0] <= 0.12 and kept[1:] == [1.0, 3.0]  # by index they would be 0.04, 1 and 2.04 s


@pytest.mark.parametrize("height", [96, 720])
def test_colors_of_an_untagged_film_are_those_that_players_show(height):
    """A decoder gives no color matrix; players take BT.709 for HD."""
    red = av.VideoFrame.from_ndarray(np.full((height, 64, 3), (200, 30, 20), np.uint8), format="rgb24")
    coded = red.reformat(format="yuv420p", dst_colorspace="ITU709" if height >= 720 else "ITU601")
    coded.colorspace = 2  # unknown
    assert np.abs(upright(coded)[5, 5].astype(int) - (200, 30, 20)).max() <= 3


@pytest.mark.parametrize("suffix", ["h264", "avi"])
def test_frames_without_presentation_times_are_numbered_in_order(tmp_path, suffix):
    write_film(tmp_path / f"robot.{suffix}", street(8), bf="2")
    film = video_film(tmp_path / f"robot.{suffix}")
    assert len(film.timing.times) == 8 and np.ptp(np.diff(film.timing.times)) < 1e-9
    kept = list(read_film(film, CaptureConfig(frames=8, min_motion=0.0), FilmStatistics(), lambda *_: None))
    assert [one.index for one in kept] == list(range(8))
    for one, picture in zip(kept, street(8), strict=True):
        assert np.abs(one.image.astype(int) - picture).mean() < 6.0


def test_a_trimmed_film_is_not_called_damaged(tmp_path):
    for keyframes in ("4", "40"):  # whole groups of pictures before the cut are no packets of the film
        write_film(tmp_path / "phone.mp4", street(20), [100 * k - 900 for k in range(20)], bf="0", g=keyframes)
        got, count, times = read(tmp_path / "phone.mp4")
        assert len(got) == count.declared == 11 and times[0] == 0.0
        assert damage_note(tmp_path / "phone.mp4", count) is None


def test_a_colon_in_a_films_name_is_no_protocol(tmp_path, monkeypatch):
    write_film(tmp_path / "a.mp4", street(4))
    monkeypatch.chdir(tmp_path)
    path = (tmp_path / "a.mp4").rename("2026-06-01T17:30:00.mp4")
    assert len(read(path)[0]) == 4 and check_film(path).notes


def test_a_film_of_an_unknown_codec_is_refused(tmp_path):
    path = tmp_path / "a.mp4"
    write_film(path, street(4))
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))
    for look in (read, check_film):
        with pytest.raises(InputError, match=r"a\.mp4: FFmpeg does not know this film's codec; convert it"):
            look(path)


def test_a_frame_is_freed_without_a_garbage_collection(tmp_path):
    """The collector hardly runs while films are decoded, and a frame of 4K takes 12 MB."""
    write_film(tmp_path / "a.mp4", street(30))
    gc.collect()
    gc.disable()
    try:
        for _, frame in decode(tmp_path / "a.mp4", FilmStatistics()):
            upright(frame)
        assert sum(isinstance(one, av.VideoFrame) for one in gc.get_objects()) < 10
    finally:
        gc.enable()


# ---- HEIC


def test_heic_photos_are_read_as_other_photos_are(tmp_path):
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    from PIL import Image

    heif.register_heif_opener()
    (picture,) = street(1)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26  # the focal length on film of 35 mm
    Image.fromarray(picture).save(tmp_path / "IMG_1.HEIC", exif=exif, quality=95)
    assert image_files(tmp_path) == [tmp_path / "IMG_1.HEIC"]
    image, header = load_photo(tmp_path / "IMG_1.HEIC", None)
    assert np.abs(image.astype(int) - picture).mean() < 4.0
    assert header.focal == pytest.approx(26 / np.hypot(36, 24) * np.hypot(160, 96) / 160)
    np.testing.assert_array_equal(read_image(tmp_path / "IMG_1.HEIC"), image)
    (tmp_path / "IMG_2.heic").write_bytes((tmp_path / "IMG_1.HEIC").read_bytes()[:900])
    with pytest.raises(InputError, match=r"IMG_2\.heic: not a readable image"):
        read_image(tmp_path / "IMG_2.heic")


def test_without_the_package_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "IMG_1.heic").write_bytes(b"x")
    with pytest.raises(InputError, match=r"HEIC needs pillow-heif: pip install 'twin\[heif\]'"):
        read_image(tmp_path / "IMG_1.heic")


# ---- what `twin new` says


def check(path: Path, pictures, **more) -> str:
    write_film(path, pictures, g="1", **more)
    return "; ".join(check_film(path).notes)


def test_a_good_film_is_passed_without_a_word(tmp_path):
    assert check(tmp_path / "a.mp4", street(20, (640, 384))) == ""


def test_what_is_wrong_with_a_film_is_named_with_a_cure(tmp_path):
    good = street(20, (640, 384))
    assert "320x192: small pictures" in check(tmp_path / "a.mp4", street(20, (320, 192)))
    assert check(tmp_path / "b.mp4", [one // 6 for one in good]).startswith("dark: ")
    bright = [np.where(one > 90, 255, one).astype(np.uint8) for one in good]
    assert "overexposed" in check(tmp_path / "c.mp4", bright)
    soft = [cv2.GaussianBlur(one, (0, 0), 6) if k % 2 else one for k, one in enumerate(good)]
    assert "50% of the frames are far softer than the sharpest" in check(tmp_path / "d.mp4", soft)
    drift = [(one * np.linspace(0.35, 1.0, 20)[k]).astype(np.uint8) for k, one in enumerate(good)]
    assert "lock the exposure" in check(tmp_path / "e.mp4", drift)
    tint = [(one * np.array([np.linspace(0.6, 1.0, 20)[k], 1, 1])).astype(np.uint8) for k, one in enumerate(good)]
    assert "lock the white balance" in check(tmp_path / "f.mp4", tint)
    times = [100 * k + (2000 if k > 9 else 0) for k in range(20)]
    assert "no picture for 2.1 s from 0.9 s on" in check(tmp_path / "g.mp4", good, times=times)
    times = [100 * k + 60 * (k // 2 * 2) for k in range(20)]
    assert "varying frame rate" in check(tmp_path / "h.mp4", good, times=times)
    write_hdr_film(tmp_path / "i.mp4", street(10, (640, 384)), HLG)
    assert check_film(tmp_path / "i.mp4").notes == [
        "HDR (HLG): converted to SDR by a fixed curve; turn HDR off for the next film"
    ]
    assert check(tmp_path / "k.mp4", good, side=Fraction(4, 3)).startswith("pixels are 1.33 times as wide as high")
    write_film(tmp_path / "j.mpg", good, codec="mpeg2video", flags="+ildct+ilme")
    assert any(note.startswith("interlaced: ") for note in check_film(tmp_path / "j.mpg").notes)


def test_new_says_it_and_makes_the_scene_all_the_same(tmp_path, capsys):
    write_film(tmp_path / "night.mp4", [one // 8 for one in street(20, (640, 384))], g="1")
    assert commands.main("new", [str(tmp_path / "road"), str(tmp_path / "night.mp4"), "--camera-height", "1.2"]) == 0
    out, error = capsys.readouterr()
    assert "night.mp4: dark: " in out + error and (tmp_path / "road" / "scene.toml").exists()
