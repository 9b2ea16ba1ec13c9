"""Small films with known pictures, as phones and camcorders encode them."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

HLG, PQ = 18, 16


def street(count: int = 12, size: tuple[int, int] = (160, 96), step: int = 4) -> list[np.ndarray]:
    """RGB pictures of a moving pattern with smooth and sharp parts."""
    width, height = size
    rng = np.random.default_rng(5)
    rows, columns = -(-height // 8), -(-(width + step * count) // 8)
    pattern = rng.integers(30, 180, (rows, columns, 3)).astype(np.uint8)
    wide = cv2.resize(pattern, (columns * 8, rows * 8), interpolation=cv2.INTER_LINEAR)
    return [np.ascontiguousarray(wide[:height, step * k : step * k + width]) for k in range(count)]


def write_film(
    path: Path,
    pictures: Sequence[np.ndarray],
    times: Sequence[int] | None = None,
    codec: str = "libx264",
    side: Fraction = Fraction(1),
    **options: str,
) -> None:
    """Writes an SDR film; `times` in milliseconds, by default ten pictures a second. Pixels are `side` times as wide as
    high. An MP4 film shows only what is at times of 0 or more, as a film does that a phone has trimmed."""
    height, width = pictures[0].shape[:2]
    with av.open(str(path), "w", options={"avoid_negative_ts": "disabled"}) as container:
        stream = container.add_stream(codec, rate=25 if codec == "mpeg2video" else 10, options=options)
        stream.codec_context.sample_aspect_ratio = side
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        if codec == "mpeg2video":
            stream.bit_rate = 20_000_000
        for k, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            if times is None:
                frame.pts = k
            else:
                frame.pts, frame.time_base = times[k], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_hdr_film(path: Path, pictures: Sequence[np.ndarray], transfer: int) -> None:
    """Writes SDR pictures as a 10-bit HDR film in which diffuse white, 255, has 203 cd/m²."""
    height, width = pictures[0].shape[:2]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=10)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p10le"
        # With B-frames, the packets of a short film sometimes lack time stamps.
        stream.options = {"crf": "8", "x265-params": "log-level=error:bframes=0"}
        _tag(stream.codec_context, transfer)
        for k, picture in enumerate(pictures):
            frame = av.VideoFrame(width, height, "yuv420p10le")
            for plane, values in zip(frame.planes, _planes(_signal(picture, transfer)), strict=True):
                rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
                rows[:, : values.shape[1]] = np.rint(values)
                plane.update(rows.tobytes())
            frame.pts = k
            _tag(frame, transfer)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _tag(target, transfer: int) -> None:
    target.color_trc, target.color_primaries, target.colorspace, target.color_range = transfer, 9, 9, 1


def _signal(picture: np.ndarray, transfer: int) -> np.ndarray:
    """HDR signal (BT.2020) of an SDR picture, by the inverse of the formulas of BT.2100."""
    bt709_to_bt2020 = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
    light = 203.0 * (picture / 255.0) ** 2.4 @ np.transpose(bt709_to_bt2020)
    if transfer == PQ:
        y = (light / 10_000.0) ** 0.1593017578125
        return ((0.8359375 + 18.8515625 * y) / (1.0 + 18.6875 * y)) ** 78.84375
    luminance = np.maximum(light @ [0.2627, 0.6780, 0.0593] / 1000.0, 1e-9)
    scene = light / 1000.0 * luminance[..., None] ** (1.0 / 1.2 - 1.0)
    high = 0.17883277 * np.log(np.maximum(12.0 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1.0 / 12.0, np.sqrt(3.0 * scene), high)


def _planes(signal: np.ndarray) -> list[np.ndarray]:
    """Luma and halved chroma of limited range, 10 bits."""
    luma = signal @ [0.2627, 0.6780, 0.0593]
    half = signal.shape[1] // 2, signal.shape[0] // 2
    chroma = (signal[..., 2] - luma) / 1.8814, (signal[..., 0] - luma) / 1.4746
    small = [512.0 + 896.0 * cv2.resize(one, half, interpolation=cv2.INTER_AREA) for one in chroma]
    return [64.0 + 876.0 * luma, *small]


def video_info(path: Path) -> dict[str, str | int | float]:
    """Returns codec, pixel format, width, height [px], fps and number of frames of a video."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return {
            "codec": stream.codec_context.name,
            "pixel_format": str(stream.codec_context.pix_fmt),
            "width": stream.width,
            "height": stream.height,
            "fps": float(stream.average_rate or 0),
            "frames": stream.frames,
        }
