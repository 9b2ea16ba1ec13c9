"""Stage `cameras`: pairs, outliers and undistortion as laws; the whole stage on a small rendered street."""

import contextlib
import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pycolmap
import pytest

from twin.capture import sfm, worker
from twin.capture.outliers import path_outliers
from twin.capture.pairs import SEQUENCE_STEPS, expanded_pairs, frame_signatures, near_pairs, probe_pairs, sequence_pairs
from twin.capture.types import Capture, SourceInfo
from twin.capture.undistort import pinhole_of, undistortion_map, write_pinhole_image
from twin.config import CamerasConfig, SceneConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras, pixel_grid, unproject
from twin.geometry.images import psnr, read_image, write_image
from twin.geometry.points import SparsePoints
from twin.geometry.poses import look_at, rotation_angle, umeyama
from twin.scene import SceneDir

SIZE = (320, 240)
INTRINSICS = np.array([260.0, 260.0, 160.0, 120.0])


# --- a street to film -------------------------------------------------------------------------------------------------


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Noise at several scales, so that near and far views both have corners, shape (512, 512)."""
    total = np.zeros((512, 512))
    for cells in (16, 32, 64, 128, 256):
        total += np.kron(rng.random((cells, cells)), np.ones((512 // cells, 512 // cells)))
    return (total - total.min()) / np.ptp(total)


def _render(pose: np.ndarray, textures: list[np.ndarray], brightness: float) -> np.ndarray:
    """A corridor: ground z = 0, walls y = ±3, end x = 25; each plane with its own texture at 4 cm per texel."""
    rays = unproject(pixel_grid(*SIZE), INTRINSICS) @ pose[:3, :3].T
    eye = pose[:3, 3]
    image, depth = np.zeros(rays.shape[:2]), np.full(rays.shape[:2], np.inf)
    for (axis, level, u, v), texture in zip(
        ((2, 0, 0, 1), (1, 3, 0, 2), (1, -3, 0, 2), (0, 25, 1, 2)), textures, strict=True
    ):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (level - eye[axis]) / rays[..., axis]
        hit = (distance > 0) & (distance < depth)
        where = eye + np.where(hit, distance, 0.0)[..., None] * rays
        texel = np.floor(where / 0.04).astype(int)
        image = np.where(hit, texture[texel[..., u] % 512, texel[..., v] % 512], image)
        depth = np.where(hit, distance, depth)
    return np.repeat((255 * brightness * image).astype(np.uint8)[..., None], 3, axis=2)


def _drive(count: int, phase: float) -> np.ndarray:
    """A slightly winding drive of 6 m at 1 m height, shape (count, 4, 4)."""
    s = np.linspace(0.0, 1.0, count)
    eyes = np.stack([6 * s, 0.6 * np.sin(3 * s + phase), 1.0 + 0.05 * np.sin(9 * s)], 1)
    ahead = np.stack([6 * s + 4, 0.6 * np.sin(3 * s + phase + 0.6), 0.8 + 0 * s], 1)
    return np.array([look_at(e, a) for e, a in zip(eyes, ahead, strict=True)])


@dataclasses.dataclass
class Street:
    scene: SceneDir
    config: SceneConfig
    truth: dict[str, np.ndarray]


def _film(root: Path, posed: bool = False) -> Street:
    rng = np.random.default_rng(3)
    textures = [_texture(rng) for _ in range(4)]
    stage = SceneDir(root).stage("capture")
    names, index, times, truth = [], [], [], {}
    infos = []
    for s, (source, count, brightness) in enumerate((("bright", 12, 1.0), ("dim", 9, 0.5))):
        poses = _drive(count, 0.1 * s)
        for i, pose in enumerate(poses):
            names.append(f"{source}/{i:06d}")
            truth[names[-1]] = pose
            write_image(stage / "images" / f"{names[-1]}.png", _render(pose, textures, brightness))
        mask = np.full(SIZE[::-1], 255, np.uint8)
        mask[-20:] = 0
        if s == 0:
            for i in range(count):
                write_image(stage / "masks" / f"{source}/{i:06d}.png", mask)
        index += [s] * count
        times += list(np.arange(count) / 2)
        infos.append(SourceInfo(source, source, "video", *SIZE, "PINHOLE", tuple(INTRINSICS), True, 0.0))
    n = len(names)
    capture = Capture(
        tuple(infos),
        tuple(names),
        np.array(index),
        np.array(times),
        np.arange(n) % 4 == 2,
        np.full((n, 3), np.nan),
        np.array([truth[name] for name in names]) if posed else None,
        np.tile(INTRINSICS, (n, 1)) if posed else None,
    )
    capture.save(stage)
    return Street(SceneDir(root), SceneConfig(cameras=CamerasConfig(features=1500)), truth)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    return _film(tmp_path_factory.mktemp("street"))


def _run(street: Street, out: Path, **changes: object) -> dict:
    out.mkdir()
    config = dataclasses.replace(street.config, cameras=dataclasses.replace(street.config.cameras, **changes))
    return sfm.run(street.scene, config, out)


# --- the whole stage --------------------------------------------------------------------------------------------------


def test_street_is_solved(street: Street, tmp_path: Path) -> None:
    metrics = _run(street, tmp_path / "out")
    cameras, points = Cameras.load(tmp_path / "out"), SparsePoints.load(tmp_path / "out")
    assert metrics["registered"] == metrics["total"] == len(cameras) == 21
    assert metrics["outliers"] == []
    assert metrics["reprojection_error_px"] < 1.0
    # The calibration is held: to the last digit, not merely nearly.
    np.testing.assert_array_equal(cameras.intrinsics, np.tile(INTRINSICS, (21, 1)))
    true = np.array([street.truth[name] for name in cameras.names])
    fit = umeyama(cameras.positions, true[:, :3, 3])
    error = np.linalg.norm(fit.points(cameras.positions) - true[:, :3, 3], axis=1)
    assert error.max() < 0.03  # [m] of 6 m; both films in one frame of reference
    turned = fit.poses(cameras.camera_to_world)[:, :3, :3]
    assert np.degrees(rotation_angle(np.swapaxes(turned, 1, 2) @ true[:, :3, :3])).max() < 0.5
    # Points lie on the planes of the street, and every observation names a frame and a point.
    placed = fit.points(points.xyz)
    off = np.min(np.abs(np.stack([placed[:, 2], placed[:, 1] - 3, placed[:, 1] + 3, placed[:, 0] - 25])), axis=0)
    assert np.median(off) < 0.03
    assert points.frame.max() < 21 and points.point.max() == len(points) - 1
    assert cameras.images.name == "images" and all(cameras.image_path(i).exists() for i in range(21))
    assert cameras.mask_path(0) is not None and cameras.mask_path(20) is None
    assert not (tmp_path / "out" / "work").exists()


def test_masked_parts_have_no_features(street: Street, tmp_path: Path) -> None:
    from twin.capture.features import open_database

    capture = Capture.load(street.scene.stage("capture"))
    matcher = open_database(capture, street.scene.stage("capture"), tmp_path, False, 2, 0)
    matcher.extract(500, 1280)
    with pycolmap.Database.open(matcher.database) as database:
        masked = database.read_keypoints(int(matcher.image_ids[0]))[:, 1]
        free = database.read_keypoints(int(matcher.image_ids[-1]))[:, 1]
    assert masked.max() <= SIZE[1] - 20 < free.max()


def test_given_poses_are_kept(tmp_path: Path) -> None:
    street = _film(tmp_path / "posed", posed=True)
    metrics = _run(street, tmp_path / "out")
    cameras, points = Cameras.load(tmp_path / "out"), SparsePoints.load(tmp_path / "out")
    true = np.array([street.truth[name] for name in cameras.names])
    np.testing.assert_allclose(cameras.camera_to_world, true, atol=1e-9)
    assert metrics["mapper"] == "given poses" and metrics["registered"] == 21
    assert len(points) > 200
    assert np.median(np.abs(points.xyz[points.xyz[:, 2] < 0.3, 2])) < 0.05


def test_a_misplaced_frame_is_registered_anew(street: Street, tmp_path: Path) -> None:
    from twin.capture import mapping
    from twin.capture.features import open_database

    stage = street.scene.stage("capture")
    matcher = open_database(Capture.load(stage), stage, tmp_path, False, 2, 0)
    matcher.extract(1500, 1280)
    mapping._match(matcher, np.random.default_rng(0))
    job = {"seed": 0, "threads": 2, "mapper": "global", "min_registered": 0.6}
    mapper = mapping._Mapper(matcher, job, tmp_path, fixed=[0, 1])
    model = mapper.best({})
    frames, poses = mapping._poses(model, matcher)
    step = mapping._median_step(poses, frames, matcher.capture)
    image = model.images[int(matcher.image_ids[5])]
    moved = np.linalg.inv(poses[5] @ np.block([[np.eye(3), np.full((3, 1), 2 * step)], [np.zeros((1, 3)), 1.0]]))
    model.frames[image.frame_id].set_cam_from_world(image.camera_id, pycolmap.Rigid3d(moved[:3]))
    facts: dict = {}
    repaired = mapper.without_outliers(model, 0.3, facts)
    assert facts == {"outliers": [], "registered_anew": [matcher.capture.names[5]]}
    frames, poses = mapping._poses(repaired, matcher)
    true = np.array([street.truth[matcher.capture.names[i]] for i in frames])
    fit = umeyama(poses[:, :3, 3], true[:, :3, 3])
    assert np.linalg.norm(fit.points(poses[5, :3, 3]) - true[5, :3, 3]) < 0.03


def _capture_of(root: Path, images: list[np.ndarray]) -> Street:
    stage = SceneDir(root).stage("capture")
    names = tuple(f"film/{i:06d}" for i in range(len(images)))
    for name, image in zip(names, images, strict=True):
        write_image(stage / "images" / f"{name}.png", image)
    n = len(names)
    source = SourceInfo("film", "day", "video", images[0].shape[1], images[0].shape[0], "PINHOLE", (), False, 0.0)
    zeros = np.zeros(n, np.int64)
    Capture((source,), names, zeros, np.arange(n) * 1.0, zeros > 0, np.full((n, 3), np.nan)).save(stage)
    return Street(SceneDir(root), SceneConfig(), {})


def test_featureless_frames_are_refused(tmp_path: Path) -> None:
    street = _capture_of(tmp_path / "s", [np.full((120, 160, 3), 90 + i, np.uint8) for i in range(4)])
    with pytest.raises(InputError, match=r"0 features per frame .*texture"):
        _run(street, tmp_path / "out")


def test_one_frame_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    with pytest.raises(InputError, match=r"1 frames? \(need 3"):
        _run(_capture_of(tmp_path / "s", [noise]), tmp_path / "out")


def test_frames_of_nothing_in_common_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = [np.kron(rng.integers(0, 255, (60, 80, 3)), np.ones((4, 4, 1))).astype(np.uint8) for _ in range(4)]
    with pytest.raises(InputError, match="film slower"):
        _run(_capture_of(tmp_path / "s", noise), tmp_path / "out")


def test_unknown_mapper_is_refused(street: Street, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected auto, global or incremental"):
        _run(street, tmp_path / "out", mapper="magic")


@pytest.mark.parametrize(
    ("signal", "cure"), [("ABRT", "film slower"), ("KILL", "too little memory"), ("TERM", "stopped from outside")]
)
def test_a_dying_worker_is_an_error_with_a_cure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signal: str, cure: str
) -> None:
    fake = tmp_path / "python"
    fake.write_text(f"#!/bin/sh\necho 'Check failed: something' >&2\nkill -{signal} $$\n")
    fake.chmod(0o755)
    monkeypatch.setattr(worker.sys, "executable", str(fake))
    with pytest.raises(InputError, match=rf"died \(SIG{signal}; Check failed: something\); {cure}") as error:
        worker.run_worker({}, tmp_path)
    assert "\n" not in str(error.value)


def test_a_full_disk_in_the_worker_is_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho 'SQLite error: database or disk is full' >&2\nexit 1\n")
    fake.chmod(0o755)
    monkeypatch.setattr(worker.sys, "executable", str(fake))
    with pytest.raises(OSError, match="No space left"):
        worker.run_worker({}, tmp_path)


def test_the_worker_ends_with_its_parent(street: Street, tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from twin.capture import sfm; from twin.config import SceneConfig;"
        "from twin.scene import SceneDir; sfm.run(SceneDir(Path(sys.argv[1])), SceneConfig(), Path(sys.argv[2]))"
    )
    out = tmp_path / "out"
    out.mkdir()
    parent = subprocess.Popen(
        [sys.executable, "-c", script, str(street.scene.root), str(out)], stderr=subprocess.DEVNULL
    )
    log = out / "work" / "job.json"

    def workers() -> list[psutil.Process]:
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if str(log) in process.cmdline() and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found

    _wait_for(lambda: bool(workers()))
    parent.kill()
    parent.wait()
    _wait_for(lambda: not workers())


def _wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


# --- pairs ------------------------------------------------------------------------------------------------------------


def test_sequence_stays_within_a_source() -> None:
    source = np.array([0] * 5 + [1] * 4)
    pairs = sequence_pairs(source)
    assert (0, 1) in pairs and (0, 4) in pairs and (5, 8) in pairs
    assert all(source[i] == source[j] and i < j and j - i in SEQUENCE_STEPS for i, j in pairs)


def test_films_at_different_speeds_are_tied_where_they_show_the_same() -> None:
    # The second film shows at frame q what the first shows at p = q² / 40: slow first, fast later.
    source = np.array([0] * 40 + [1] * 40)
    same = {int(q * q / 40): q for q in range(40)}
    probes = {(p, 40 + q) for p, q in same.items() if p % 3 == 0} | {(5, 75)}
    inliers = dict.fromkeys(probes, 100) | {(5, 75): 3}
    pairs = expanded_pairs(source, probes, inliers, min_inliers=25)
    for p, q in same.items():
        assert any((p, 40 + q + d) in pairs for d in (-1, 0, 1)), (p, q)
    assert (5, 75) not in pairs


def test_without_anchors_films_are_tied_by_share_of_length() -> None:
    pairs = expanded_pairs(np.array([0] * 10 + [1] * 19), {(0, 20)}, {}, min_inliers=25)
    assert all((i, 10 + 2 * i) in pairs for i in range(10))


def test_near_cameras_that_nothing_ties_are_paired() -> None:
    # Out along x for 30 frames and back beside it, looking the same way: the ends of the film meet its start.
    out = [look_at(np.array([x, 0.0, 1]), np.array([x, 9.0, 1])) for x in range(30)]
    back = [look_at(np.array([x, 0.5, 1]), np.array([x, 9.5, 1])) for x in range(29, -1, -1)]
    away = [look_at(np.array([3.0, 0.1, 1]), np.array([3.0, -9.0, 1]))]
    poses = np.array(out + back + away)
    tried = sequence_pairs(np.zeros(61, np.int64))
    pairs = near_pairs(poses, np.arange(61), tried, reach=1.0, most=2)
    assert (2, 57) in pairs
    assert not pairs & tried
    assert not any(60 in pair for pair in pairs)  # it looks the other way


def test_signatures_find_the_same_place_under_another_light() -> None:
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 200, (80, 128)) for _ in range(8)]
    views = [
        np.clip(place[rng.permutation(80)[:60]] + shift + rng.integers(-9, 9, (60, 128)), 0, 255).astype(np.uint8)
        for shift in (0, 25)
        for place in places
    ]
    source = np.repeat([0, 1], 8)
    signatures = frame_signatures(views, source, rng)
    similarity = signatures[:8] @ signatures[8:].T
    assert np.mean(similarity.argmax(1) == np.arange(8)) >= 0.75
    probes = probe_pairs(source, signatures)
    assert sum((i, 8 + i) in probes for i in range(8)) == 8
    assert frame_signatures([np.zeros((0, 128), np.uint8)] * 3, np.zeros(3, np.int64), rng).max() == 0


# --- outliers ---------------------------------------------------------------------------------------------------------


def _turning_path(count: int = 50) -> np.ndarray:
    """30 m straight, then a right turn of 6 m radius, about a metre per frame, with centimetres of shake."""
    s = np.linspace(0.0, 48.0, count)
    angle = np.clip((s - 30.0) / 6.0, 0.0, np.pi / 2)
    past = np.maximum(s - 30.0 - 3.0 * np.pi, 0.0)
    eyes = np.stack(
        [np.minimum(s, 30.0) + 6.0 * np.sin(angle), -6.0 * (1 - np.cos(angle)) - past, 1.2 + 0.03 * np.sin(3 * s)], 1
    )
    ahead = np.stack([np.cos(angle), -np.sin(angle), 0 * s - 0.1], 1)
    return np.array([look_at(e, e + a) for e, a in zip(eyes, ahead, strict=True)])


def test_a_turning_path_has_no_outliers() -> None:
    assert not path_outliers(_turning_path(), 0.3).any()


def test_a_path_with_stops_and_gaps_has_no_outliers() -> None:
    path = _turning_path(100)
    kept = np.random.default_rng(1).random(100) < 0.6
    assert not path_outliers(path[kept], 0.3).any()


@pytest.mark.parametrize("frame", [0, 7, 33, 49])
def test_a_frame_beside_the_path_is_found_and_no_other(frame: int) -> None:
    path = _turning_path()
    path[frame, :3, 3] += [0.3, -0.9, 0.4]
    assert np.flatnonzero(path_outliers(path, 0.3)).tolist() == [frame]


def test_a_twisted_frame_is_found() -> None:
    path = _turning_path()
    path[20, :3, :3] = path[20, :3, :3] @ look_at(np.zeros(3), np.array([0.3, 1.0, 0.2]))[:3, :3]
    assert np.flatnonzero(path_outliers(path, 0.3)).tolist() == [20]


def test_two_outliers_side_by_side_are_found() -> None:
    path = _turning_path()
    path[20, :3, 3] += [0, 5.0, 0]
    path[21, :3, 3] += [0, -3.0, 1]
    assert np.flatnonzero(path_outliers(path, 0.3)).tolist() == [20, 21]


def test_photos_in_no_order_have_no_outliers() -> None:
    path = _turning_path()
    assert not path_outliers(path[np.random.default_rng(0).permutation(50)], 0.3).any()
    assert not path_outliers(path[:4], 0.3).any()


# --- undistortion -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [300.0, 160.0, 120.0, -0.15]),
        ("OPENCV", [300.0, 290.0, 165.0, 118.0, 0.08, -0.02, 0.002, -0.001]),
        ("OPENCV_FISHEYE", [200.0, 200.0, 160.0, 120.0, 0.01, 0.0, 0.0, 0.0]),
    ],
)
def test_undistorted_pixels_see_along_the_same_ray(model: str, params: list[float]) -> None:
    camera = pycolmap.Camera(model=model, params=params, width=320, height=240)
    pinhole = pinhole_of(camera)
    mapping = undistortion_map(camera, pinhole)
    assert mapping is not None and mapping.shape == (240, 320, 2)
    assert mapping.min() >= -0.51 and (mapping.reshape(-1, 2).max(0) <= [319.51, 239.51]).all()  # nothing to fill in
    rays = np.asarray(camera.cam_from_img(mapping.reshape(-1, 2).astype(np.float64) + 0.5))
    wanted = unproject(pixel_grid(320, 240), np.array(pinhole)).reshape(-1, 3)[:, :2]
    np.testing.assert_allclose(rays, wanted, atol=2e-4)


def test_undistortion_undoes_distortion(tmp_path: Path) -> None:
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", params=[300.0, 160.0, 120.0, 0.1], width=320, height=240)

    def picture(rays: np.ndarray) -> np.ndarray:
        return (127 + 60 * np.sin(9 * rays[..., 0]) + 60 * np.cos(7 * rays[..., 1])).astype(np.uint8)

    raw_rays = np.asarray(camera.cam_from_img(pixel_grid(320, 240).reshape(-1, 2))).reshape(240, 320, 2)
    write_image(tmp_path / "raw.png", picture(raw_rays))
    pinhole = pinhole_of(camera)
    write_pinhole_image(tmp_path / "raw.png", tmp_path / "a" / "flat.png", undistortion_map(camera, pinhole))
    expected = picture(unproject(pixel_grid(320, 240), np.array(pinhole))[..., :2])
    flat = read_image(tmp_path / "a" / "flat.png")[..., 0]
    assert psnr(flat / 255.0, expected / 255.0) > 45.0


def test_a_pinhole_image_is_left_alone(tmp_path: Path) -> None:
    camera = pycolmap.Camera(model="PINHOLE", params=[300.0, 301.0, 160.0, 120.0], width=320, height=240)
    assert pinhole_of(camera) == (300.0, 301.0, 160.0, 120.0)
    assert undistortion_map(camera, pinhole_of(camera)) is None
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    write_image(tmp_path / "raw.png", image)
    write_pinhole_image(tmp_path / "raw.png", tmp_path / "flat.png", None)
    np.testing.assert_array_equal(read_image(tmp_path / "flat.png"), image)
