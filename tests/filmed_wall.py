"""A textured wall filmed from a camera that moves along it, and stage `capture` run on such films."""

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from twin.capture.capture_data import Capture
from twin.capture.frames import run
from twin.config import CaptureConfig, SceneConfig, SourceConfig
from twin.errors import InputError
from twin.scene import SceneDir

WIDTH, HEIGHT = 160, 120


def wall(seed: int = 0, size: tuple[int, int] = (200, 900)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    # Gray, since a film halves the resolution of color; 2 px smooth, so that a film keeps it.
    smooth = cv2.GaussianBlur(rng.integers(0, 256, (*size, 1)).repeat(3, 2).astype(np.float32), (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]


def views(shifts: list[int]) -> list[np.ndarray]:
    """A textured wall seen from a camera that stands at these places [px]."""
    texture = wall()
    return [np.ascontiguousarray(texture[40 : 40 + HEIGHT, s : s + WIDTH]) for s in shifts]


def film(
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


def captured(tmp_path: Path, sources: list[SourceConfig], **capture: Any) -> tuple[Capture, dict[str, Any], Path]:
    out = tmp_path / "out"
    out.mkdir(exist_ok=True)
    metrics = run(SceneDir(tmp_path), SceneConfig(source=tuple(sources), capture=CaptureConfig(**capture)), out)
    json.dumps(metrics, allow_nan=False)
    return Capture.load(out), metrics, out


def refused(tmp_path: Path, source: SourceConfig, words: str, **capture: Any) -> None:
    with pytest.raises(InputError, match=words) as caught:
        captured(tmp_path, [source], **capture)
    assert "\n" not in str(caught.value)
