"""Real captures, with settings small enough to run on every change; the full figures are in docs/benchmarks.md."""

import json
import shutil

import numpy as np
import pytest

from twin import build as verb
from twin.geometry.cameras import Cameras
from twin.geometry.poses import rotation_angle, umeyama

pytestmark = [pytest.mark.realdata, pytest.mark.slow]


@pytest.fixture
def place(real_data, tmp_path):
    """Makes a scene folder: place(scene_toml, *paths under the real data to copy into input/)."""

    def make(text, *paths):
        root = tmp_path / "scene"
        (root / "input").mkdir(parents=True)
        (root / "scene.toml").write_text(text)
        for path in paths:
            source = real_data / path
            if source.is_dir():
                shutil.copytree(source, root / "input" / source.name)
            else:
                shutil.copy(source, root / "input")
        return root

    return make


def test_lund_street_is_metric_by_gps(place):
    root = place('[[source]]\npath = "input/images"\nlighting = "day"\n[metric]\ngps = true\n', "lund_street/images")
    report = verb.build(root, until="metric")
    assert report["cameras"]["total"] == 29 and report["cameras"]["registered"] >= 28
    assert report["cameras"]["checked_steps"] >= 27 and report["cameras"]["contradicted_steps"] == []
    assert report["metric"]["scale_source"] == "gps"
    # The walk is 197 m by GPS, whose fixes scatter by 3 to 4 m.
    assert report["metric"]["path_length_m"] == pytest.approx(197, rel=0.08)


def test_kitti_straight_with_its_calibration_held(place, real_data):
    text = (
        '[[source]]\npath = "input/image_l"\nlighting = "day"\n'
        'camera = { model = "SIMPLE_PINHOLE", params = [707.0912, 601.8873, 183.1104], width = 1226, height = 370 }\n'
        "[metric]\ncamera_height = 1.65\n"
    )
    root = place(text, "kitti_straight/image_l")
    report = verb.build(root, until="metric")
    assert report["cameras"]["registered"] == 51
    assert report["cameras"]["checked_steps"] == 50 and report["cameras"]["contradicted_steps"] == []
    cameras = Cameras.load(root / "build/2_metric")
    assert cameras.intrinsics[0, 0] == pytest.approx(707.0912, abs=1e-6)
    truth = np.loadtxt(real_data / "kitti_straight/poses.txt").reshape(-1, 3, 4)[:, :, 3]
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    aligned = umeyama(cameras.positions, truth).points(cameras.positions)
    error = np.sqrt(((aligned - truth) ** 2).sum(1).mean())
    assert error <= 0.01 * path


def test_paper_road_two_lightings_agree(place):
    text = (
        '[[source]]\npath = "input/cloudy2sunny.mp4"\n[[source]]\npath = "input/day2night.mp4"\n'
        "[capture]\nframes = 50\nmin_motion = 0.0\nmax_size = 640\n"
        "[cameras]\nfeatures = 2000\n[metric]\ncamera_height = 1.8\n"
    )
    root = place(text, "driveenv_paper_road/cloudy2sunny.mp4", "driveenv_paper_road/day2night.mp4")
    report = verb.build(root, until="metric")
    assert report["cameras"]["total"] == 100 and report["cameras"]["registered"] >= 94
    assert report["cameras"]["checked_steps"] >= 92 and report["cameras"]["contradicted_steps"] == []
    cameras = Cameras.load(root / "build/2_metric")
    frame = {name: i for i, name in enumerate(cameras.names)}
    pairs = [
        (i, frame[name.replace("cloudy2sunny", "day2night")])
        for name, i in frame.items()
        if name.startswith("cloudy2sunny") and name.replace("cloudy2sunny", "day2night") in frame
    ]
    a, b = np.array(pairs).T
    apart = np.linalg.norm(cameras.positions[a] - cameras.positions[b], axis=1)
    turned = np.rad2deg(
        rotation_angle(np.swapaxes(cameras.camera_to_world[a, :3, :3], 1, 2) @ cameras.camera_to_world[b, :3, :3])
    )
    # At half the resolution of the recorded figures (0.1 %, 0.1°), so twice their bound.
    assert np.median(apart) <= 0.002 * report["metric"]["path_length_m"]
    assert np.median(turned) <= 0.2


def test_real_film_with_the_robot_masked(place):
    import cv2

    text = (
        '[[source]]\npath = "input/sim2real_day.mp4"\nlighting = "day"\nmask = "input/mask.png"\n'
        "[capture]\nframes = 60\nmax_size = 960\n[metric]\ncamera_height = 1.7\n"
    )
    root = place(text, "driveenv_paper_road/sim2real_day.mp4")
    mask = np.full((720, 1280), 255, np.uint8)
    cv2.rectangle(mask, (360, 90), (900, 600), 0, -1)  # the robot ahead, wherever it goes
    cv2.imwrite(str(root / "input/mask.png"), mask)
    report = verb.build(root, until="metric")
    assert report["cameras"]["registered"] >= 0.9 * report["cameras"]["total"] >= 40
    assert len(report["cameras"]["contradicted_steps"]) <= 2  # of 56; the robot and walkers move


def test_the_fox_capture_has_no_route(place):
    """The film goes around an object: field and mesh are built, and the report says that the stages about driving do
    not apply.
    """
    text = (
        '[[source]]\npath = "input/transforms_orig_1080x1920.json"\nimages = "input/images"\nlighting = "indoor"\n'
        '[metric]\nposes_are_metric = true\nup = "cameras"\n[mjcf]\nroute = false\n'
        "[nerf]\nsteps = 150\nrays = 2048\nmax_width = 240\nlog2_table = 16\nbake_steps = 20\nmax_bricks = 1500\n"
        "detail_passes = 0.25\n[mesh]\nviews = 30\nview_width = 120\n[review]\nfps = 3\nwidth = 240\nrenders = 12\n"
    )
    root = place(text, "fox/transforms_orig_1080x1920.json", "fox/images")
    report = verb.build(root)
    assert report["cameras"]["registered"] == 50
    assert report["field"]["psnr"]["indoor"] > 20
    assert report["review"]["follower"] is None and report["review"]["not_applicable"]
    assert json.loads((root / "build/report.json").read_text())["metric"]["scale_source"] == "poses_are_metric"
