"""Rolling shutter and stabilization: found in reconstructions of known cameras, and taken out of pictures."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from twin import commands
from twin.build import build
from twin.capture import rolling_shutter
from twin.capture.camera_models import Lens, raw_pixels, undistortion
from twin.capture.rolling_shutter import RollingShutter, correct_model, corrected_map, corrected_pinhole
from twin.files import read_json
from twin.geometry.cameras import Cameras
from twin.reality.__main__ import film as film_place
from twin.reality.filming import FilmingPlan
from twin.reality.place_sampling import sample_place
from twin.reality.truth import align_poses, matched_poses
from twin.scene import SceneDir
from twin.types import Array

LENS = Lens("SIMPLE_RADIAL", (420.0, 320.0, 180.0, -0.03), 640, 360)
FRAMES, POINTS = 24, 900


@pytest.fixture(autouse=True)
def _silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rolling_shutter, "send_message", lambda **_: None)


def poses(rng: np.random.Generator) -> list[pycolmap.Rigid3d]:
    """A walk along z that looks ahead and shakes."""
    out = []
    for k in range(FRAMES):
        turn = Rotation.from_rotvec(rng.normal(0.0, 0.03, 3)).as_matrix()
        center = np.array([0.1 * rng.normal(), 0.05 * rng.normal(), 0.8 * k])
        out.append(pycolmap.Rigid3d(np.column_stack([turn, -turn @ center])))
    return out


def seen(lens: Lens, x: Array, skew: Array, shift: Array, axis: int) -> Array:
    """Pixels (n, 2) at which points x (n, 3) in the camera's axes are read, by iterating to convergence."""
    size = (lens.width, lens.height)
    xy = raw_pixels(lens, x) + shift
    for _ in range(20):
        share = xy[:, axis] / size[axis] - 0.5
        xy = raw_pixels(lens, Rotation.from_rotvec(-share[:, None] * skew).apply(x)) + shift
    return xy


def film(
    skews: Array, shifts: Array, axis: int = 1, lens: Lens | list[Lens] = LENS, noise: float = 0.3
) -> tuple[pycolmap.Reconstruction, SimpleNamespace, list[pycolmap.Rigid3d]]:
    """The reconstruction of a film by bundle adjustment, its matcher, and the true poses."""
    rng = np.random.default_rng(3)
    truth = poses(rng)
    points = np.column_stack([rng.uniform(-9, 9, POINTS), rng.uniform(-4, 1.6, POINTS), rng.uniform(3, 30, POINTS)])
    points[:, 2] += rng.uniform(0.0, 0.8 * FRAMES, POINTS)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=LENS.model, params=list(LENS.params), width=640, height=360, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    for k, pose in enumerate(truth):
        x = points @ pose.rotation.matrix().T + pose.translation
        front = np.flatnonzero((x[:, 2] > 1.0) & (x[:, 2] < 25.0))
        xy = seen(lens if isinstance(lens, Lens) else lens[k], x[front], skews[k], shifts[k], axis)
        inside = np.all((xy > 0) & (xy < [640, 360]), axis=1)
        xy = xy[inside] + rng.normal(0.0, noise, (int(inside.sum()), 2))
        image = pycolmap.Image(f"film/{k:06d}.png", pycolmap.Point2DList([pycolmap.Point2D(p) for p in xy]), 1, k + 1)
        model.add_image_with_trivial_frame(image, pose)
        for n, point in enumerate(front[inside]):
            tracks[point].append((k + 1, n))
    for point, track in zip(points, tracks, strict=True):
        if len(track) > 1:
            elements = [pycolmap.TrackElement(image, n) for image, n in track]
            model.add_point3D(point, pycolmap.Track(elements), np.zeros(3, np.uint8))
    source = SimpleNamespace(name="film")
    capture = SimpleNamespace(sources=(source,), source_index=np.zeros(FRAMES, int))
    matcher = SimpleNamespace(
        capture=capture, image_ids=np.arange(1, FRAMES + 1), frame_of=lambda: {k + 1: k for k in range(FRAMES)}
    )
    refine(model)
    return model, matcher, truth


def refine(model: pycolmap.Reconstruction) -> None:
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images.values():
        config.add_image(image.image_id)
    config.set_constant_cam_intrinsics(1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.solver_options.max_num_iterations = 30
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def rotation_error(model: pycolmap.Reconstruction, truth: list[pycolmap.Rigid3d]) -> float:
    """Median angle between reconstructed and true rotations, up to a common one [°]."""
    pairs = [
        Rotation.from_matrix(model.images[k + 1].cam_from_world().rotation.matrix().T @ pose.rotation.matrix())
        for k, pose in enumerate(truth)
    ]
    common = Rotation.concatenate(pairs).mean().inv()
    return float(np.rad2deg(np.median([(one * common).magnitude() for one in pairs])))


def shaken(size: float, seed: int = 5) -> Array:
    return np.random.default_rng(seed).normal(0.0, size, (FRAMES, 3))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_rolling_shutter_is_found_and_corrected(axis: int) -> None:
    skews = shaken(0.012)  # 5 px
    model, matcher, truth = film(skews, np.zeros((FRAMES, 2)), axis)
    before = rotation_error(model, truth)
    found, stabilized = correct_model(model, matcher, refine)
    assert stabilized == [] and list(found) == ["film"] and found["film"].axis == axis
    error = np.array([found["film"].skews[k] for k in range(FRAMES)]) - skews
    # A skew that all frames have in common changes the reconstructed points instead.
    assert np.sqrt(np.mean((error - error.mean(0)) ** 2)) < 0.3 * 0.012
    assert rotation_error(model, truth) < 0.5 * before


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_frame_that_loses_all_points_has_little_skew() -> None:
    """Bundle adjustment may filter out the last point of a frame."""
    model, matcher, _ = film(shaken(0.012), np.zeros((FRAMES, 2)))

    def refine_without_a_frame(model: pycolmap.Reconstruction) -> None:
        image = model.images[6]
        for k, point in enumerate(image.points2D):
            if point.has_point3D():
                model.delete_observation(6, k)
        refine(model)

    found, _ = correct_model(model, matcher, refine_without_a_frame)
    skews = found["film"].skews
    assert (
        all(np.isfinite(skew).all() for skew in skews.values()) and np.linalg.norm(skews[5]) < 0.006
    )  # half the shake


@pytest.mark.parametrize("skew", [0.0, 0.006])
def test_a_stabilized_film_is_recognized(skew: float) -> None:
    shifts = 6.0 * shaken(1.0, 6)[:, :2]
    model, matcher, _ = film(shaken(skew), shifts)
    found, stabilized = correct_model(model, matcher, refine)
    assert stabilized == ["film"] and list(found) == (["film"] if skew else [])


@pytest.mark.parametrize("lens", [LENS, Lens("SIMPLE_RADIAL", (415.0, 322.0, 179.0, -0.02), 640, 360)])
def test_a_film_without_either_is_left_alone(lens: Lens) -> None:
    """Neither noise nor a wrong calibration passes for rolling shutter or stabilization."""
    model, matcher, _ = film(np.zeros((FRAMES, 3)), np.zeros((FRAMES, 2)), lens=lens)
    kept = {i: np.array([list(p.xy) for p in image.points2D]) for i, image in model.images.items()}
    assert correct_model(model, matcher, refine) == ({}, [])
    for i, image in model.images.items():
        np.testing.assert_array_equal(np.array([list(p.xy) for p in image.points2D]), kept[i])


def test_a_lens_that_breathes_is_no_rolling_shutter() -> None:
    """Autofocus changes the focal length by 2 %, slowly."""
    lenses = [LENS.with_intrinsics(LENS.intrinsics * [s, s, 1, 1]) for s in 1 + 0.02 * np.sin(np.arange(FRAMES) / 3)]
    model, matcher, _ = film(np.zeros((FRAMES, 3)), np.zeros((FRAMES, 2)), lens=lenses)
    assert correct_model(model, matcher, refine) == ({}, [])


@pytest.mark.parametrize("lens", [LENS, Lens("OPENCV", (500.0, 500, 640, 340, -0.3, 0.05, 0, 0), 1280, 720)])
@pytest.mark.parametrize("axis", [0, 1])
def test_corrected_pictures_are_not_extrapolated(lens: Lens, axis: int) -> None:
    shutter = RollingShutter(axis, {0: np.array([0.02, -0.015, 0.03]), 1: np.array([-0.02, 0.015, 0.03])})
    pinhole = corrected_pinhole(lens, undistortion(lens)[0], shutter)
    for skew in shutter.skews.values():
        pixel_map = corrected_map(lens, pinhole, skew, axis)
        assert pixel_map.min() >= -0.55 and np.all(pixel_map.max((0, 1)) <= [lens.width - 0.45, lens.height - 0.45])


@pytest.mark.parametrize("axis", [0, 1])
def test_a_corrected_picture_shows_the_undisturbed_view(axis: int) -> None:
    rng = np.random.default_rng(0)
    skew = np.array([0.02, -0.015, 0.03])
    pinhole = corrected_pinhole(LENS, undistortion(LENS)[0], RollingShutter(axis, {7: skew}))
    pixel_map = corrected_map(LENS, pinhole, skew, axis)
    pixels = rng.integers([0, 0], [640, 360], (200, 2))
    fx, fy, cx, cy = pinhole.intrinsics
    x = np.column_stack([(pixels[:, 0] + 0.5 - cx) / fx, (pixels[:, 1] + 0.5 - cy) / fy, np.ones(200)])
    expected = seen(LENS, x, skew, np.zeros(2), axis)
    np.testing.assert_allclose(pixel_map[pixels[:, 1], pixels[:, 0]] + 0.5, expected, atol=0.05)


def test_a_rolling_shutter_survives_json() -> None:
    one = RollingShutter(0, {3: np.arange(3) / 7.0})
    again = RollingShutter.from_json(one.to_json())
    assert again.axis == 0 and list(again.skews) == [3]
    np.testing.assert_array_equal(again.skews[3], one.skews[3])


@pytest.mark.parametrize(("option", "value"), [("--readout", "-0.1"), ("--readout", "1"), ("--shake", "-1")])
def test_impossible_films_are_refused(option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert commands.main("reality", ["film", "--tiny", "--out", str(tmp_path / "x"), option, value]) == 2
    assert f"{option} {value}" in capsys.readouterr().err and not (tmp_path / "x").exists()


@pytest.mark.slow
def test_a_shaky_film_with_a_rolling_shutter_is_built(tmp_path: Path) -> None:
    """The rotations of the cameras are wrong by 0.44° (median) without the correction."""
    plan = replace(FilmingPlan.of(sample_place(49)), lightings=("sun",), readout=0.03, shake=8.0)
    truth = film_place(plan, tmp_path, 49)
    assert "--place 49 --lightings sun --readout 0.03 --shake 8 --out" in (tmp_path / "scene.toml").read_text()
    build(tmp_path, until="metric")
    scene = SceneDir(tmp_path)
    metrics = read_json(scene.stage("cameras") / "stamp.json")["metrics"]
    assert 0.4 < metrics["rolling_shutter_deg"]["sun"] < 1.6 and metrics["stabilized"] == []
    cameras = Cameras.load(scene.stage("metric"))
    true = matched_poses(truth, cameras)
    aligned = align_poses(cameras.camera_to_world, true)
    turn = Rotation.from_matrix(true[:, :3, :3]).inv() * Rotation.from_matrix(
        aligned.rotation @ cameras.camera_to_world[:, :3, :3]
    )
    assert np.rad2deg(np.median(turn.magnitude())) < 0.33
