"""Whatever a user may get wrong: one clear line, exit status 2, earlier results intact."""

import json

import av
import numpy as np
import pytest

from twin import build as verb
from twin.geometry.images import write_image

_METRIC = "[metric]\ncamera_height = 1.2\n"


def _scene(tmp_path, text):
    root = tmp_path / "scene"
    (root / "input").mkdir(parents=True, exist_ok=True)
    (root / "scene.toml").write_text(text)
    return root


def _source(path):
    return f'[[source]]\npath = "input/{path}"\n'


def _noise(i, size=(180, 320)):
    """A textured wall that moves sideways by 4 px a frame."""
    wall = np.random.default_rng(0).integers(0, 256, (size[0] // 4, 300, 3), dtype=np.uint8)
    return np.repeat(np.repeat(wall[:, i : i + size[1] // 4], 4, 0), 4, 1)


def _film(path, frames):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))


def _fails(capsys, root, *words, until="metric"):
    capsys.readouterr()
    assert verb.main([str(root), "--until", until, "--quiet"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("error: ") and all(word in lines[-1] for word in words), lines
    assert "Traceback" not in "".join(lines)
    assert not list((root / "build").glob("*.old"))


def test_video_that_is_no_video(tmp_path, capsys):
    root = _scene(tmp_path, _source("a.mp4") + _METRIC)
    (root / "input/a.mp4").write_bytes(b"")
    _fails(capsys, root, "a.mp4")
    (root / "input/a.mp4").write_bytes(b"not a film" * 100)
    _fails(capsys, root, "a.mp4")


def test_truncated_video(tmp_path, capsys):
    root = _scene(tmp_path, _source("a.mp4") + _METRIC)
    _film(root / "input/a.mp4", [_noise(i) for i in range(20)])
    whole = (root / "input/a.mp4").read_bytes()
    (root / "input/a.mp4").write_bytes(whole[: len(whole) // 2])  # the index at its end is gone
    _fails(capsys, root, "a.mp4")


def test_one_frame_only(tmp_path, capsys):
    root = _scene(tmp_path, _source("a.mp4") + _METRIC)
    _film(root / "input/a.mp4", [_noise(0)])
    _fails(capsys, root, "frame")


def test_one_photo_and_an_empty_one(tmp_path, capsys):
    root = _scene(tmp_path, _source("photos") + _METRIC)
    write_image(root / "input/photos/a.png", _noise(0))
    _fails(capsys, root, "photos")
    (root / "input/photos/b.png").touch()
    _fails(capsys, root, "b.png")


def test_frames_without_texture(tmp_path, capsys):
    root = _scene(tmp_path, _source("photos") + _METRIC)
    for i in range(6):
        # Smooth gradients that differ: nothing to match, and not exact duplicates either.
        image = np.tile(np.linspace(0, 200 + 5 * i, 320)[None, :, None], (180, 1, 3)).astype(np.uint8)
        write_image(root / f"input/photos/{i}.png", image)
    _fails(capsys, root)


def test_wrong_json_and_nan_pose(tmp_path, capsys):
    root = _scene(tmp_path, _source("transforms.json") + "[metric]\nposes_are_metric = true\n")
    (root / "input/transforms.json").write_text('{"frames": [')
    _fails(capsys, root, "transforms.json")
    frames = []
    for i in range(3):
        write_image(root / f"input/{i}.png", _noise(i))
        pose = np.eye(4).tolist()
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose})
    frames[1]["transform_matrix"][0][3] = float("nan")
    (root / "input/transforms.json").write_text(json.dumps({"fl_x": 300.0, "w": 320, "h": 180, "frames": frames}))
    _fails(capsys, root, "transforms.json")


def test_unknown_key_and_no_scale(tmp_path, capsys):
    root = _scene(tmp_path, _source("a.mp4") + "[metric]\ncamera_hight = 1.2\n")
    assert verb.main([str(root)]) == 2
    assert "did you mean 'camera_height'" in capsys.readouterr().err
    _film(root / "input/a.mp4", [_noise(i) for i in range(4)])
    _scene(tmp_path, _source("a.mp4"))
    _fails(capsys, root, "camera_height", "distance", "gps", "marker", "poses_are_metric")


@pytest.mark.parametrize("keep", ["capture"])
def test_a_failure_keeps_what_was_built(tmp_path, capsys, keep):
    root = _scene(tmp_path, _source("a.mp4") + _METRIC)
    _film(root / "input/a.mp4", [_noise(i) for i in range(20)])
    assert verb.main([str(root), "--until", keep, "--quiet"]) == 0
    before = (root / "build/1_capture/stamp.json").read_text()
    (root / "input/a.mp4").write_bytes(b"gone")
    _fails(capsys, root, "a.mp4", until=keep)
    assert (root / "build/1_capture/stamp.json").read_text() == before
