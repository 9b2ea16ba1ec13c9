"""Stage `cameras` on a small rendered street, its errors, and how its worker ends."""

import contextlib
import copy
import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pycolmap
import pytest

from twin import runtime
from twin.capture import mapping, sfm, worker
from twin.capture.capture_data import Capture, SourceInfo
from twin.capture.matching import Matcher, open_database
from twin.config import CamerasConfig, SceneConfig
from twin.errors import InputError
from twin.geometry.cameras import Cameras, SparsePoints, pixel_grid, unproject
from twin.geometry.images import write_image
from twin.geometry.poses import inverse_pose, look_at, rotation_angle, umeyama
from twin.scene import SceneDir

SIZE = (320, 240)
INTRINSICS = np.array([260.0, 260.0, 160.0, 120.0])
TURN_ROUND = np.diag([-1.0, -1.0, 1.0, 1.0]) + np.outer([12.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
"""Turns a drive of 12 m around, so that it ends at its start."""


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


def _drive(count: int, phase: float, length: float = 6.0) -> np.ndarray:
    """A slightly winding drive at 1 m height, shape (count, 4, 4)."""
    s = np.linspace(0.0, length / 6.0, count)
    eyes = np.stack([6 * s, 0.6 * np.sin(3 * s + phase), 1.0 + 0.05 * np.sin(9 * s)], 1)
    ahead = np.stack([6 * s + 4, 0.6 * np.sin(3 * s + phase + 0.6), 0.8 + 0 * s], 1)
    return np.array([look_at(e, a) for e, a in zip(eyes, ahead, strict=True)])


@dataclasses.dataclass
class Street:
    scene: SceneDir
    config: SceneConfig
    truth: dict[str, np.ndarray]


FILMS = (("bright", 12, 1.0), ("dim", 9, 0.5))
FEWER = (("bright", 9, 1.0), ("dim", 5, 0.5))


def _film(
    root: Path,
    posed: bool = False,
    there_and_back: bool = False,
    same_road: bool = True,
    films: tuple[tuple[str, int, float], ...] = FILMS,
) -> Street:
    """Two films of the street; one is dark, or goes in the opposite direction, on this road or, half as far, on another
    one. `films` are the name, number of frames and brightness of each.
    """
    rng = np.random.default_rng(3)
    textures = [_texture(rng) for _ in range(4)]
    stage = SceneDir(root).stage("capture")
    names, index, times, truth = [], [], [], {}
    infos = []
    if there_and_back:
        films = (("out", 25, 1.0), ("back", 25 if same_road else 13, 1.0))
    for s, (source, count, brightness) in enumerate(films):
        poses = _drive(count, 0.1 * s, 0.5 * (count - 1) if there_and_back else 6.0)
        if source == "back":
            poses = np.array([TURN_ROUND @ pose for pose in poses])
            textures = textures if same_road else [_texture(rng) for _ in range(4)]
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
        lighting = "day" if there_and_back else source
        infos.append(SourceInfo(source, lighting, "video", *SIZE, "PINHOLE", tuple(INTRINSICS), True, 0.0))
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


def test_there_are_no_more_threads_than_cores(street: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A container may allow few of a machine's cores, and each process for relative poses takes memory."""
    jobs = []

    def stop(_: object, job: dict, __: Path) -> None:
        jobs.append(job)
        raise InterruptedError

    monkeypatch.setattr(sfm, "run_worker", stop)
    monkeypatch.setattr(runtime, "available_cores", lambda: 1)
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    with pytest.raises(InterruptedError):
        _run(street, tmp_path / "out")
    assert jobs[0]["threads"] == 1


def test_street_is_solved(street: Street, tmp_path: Path) -> None:
    metrics = _run(street, tmp_path / "out")
    cameras, points = Cameras.load(tmp_path / "out"), SparsePoints.load(tmp_path / "out")
    assert metrics["registered"] == metrics["total"] == len(cameras) == 21
    assert metrics["outliers"] == []
    assert metrics["checked_steps"] == 19 and metrics["contradicted_steps"] == []
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


@pytest.mark.slow
def test_films_in_opposite_directions_are_joined_by_the_ground(tmp_path: Path) -> None:
    street = _film(tmp_path / "there_and_back", there_and_back=True)
    metrics = _run(street, tmp_path / "out")
    cameras, points = Cameras.load(tmp_path / "out"), SparsePoints.load(tmp_path / "out")
    assert metrics["joined"] == ["back"] and metrics["apart"] == []
    assert metrics["registered"] == len(cameras) == 50
    true = np.array([street.truth[name] for name in cameras.names])
    fit = umeyama(cameras.positions, true[:, :3, 3])
    assert np.linalg.norm(fit.points(cameras.positions) - true[:, :3, 3], axis=1).max() < 0.08  # [m] of 12 m
    turned = fit.poses(cameras.camera_to_world)[:, :3, :3]
    assert (
        np.degrees(rotation_angle(np.swapaxes(turned, 1, 2) @ true[:, :3, :3])).max() < 2.0
    )  # the tilt is weakly determined by 6 m of road
    # Every observation names a point that its frame sees.
    seen = inverse_pose(cameras.camera_to_world[points.frame])
    local = (seen[:, :3, :3] @ points.xyz[points.point][..., None])[..., 0] + seen[:, :3, 3]
    assert (local[:, 2] > 0.0).all()


@pytest.mark.slow
def test_a_film_of_another_road_is_left_out(tmp_path: Path) -> None:
    """Another film has its lighting, so the build goes on; the metrics name the film that was left out."""
    street = _film(tmp_path / "s", there_and_back=True, same_road=False)
    metrics = _run(street, tmp_path / "out")
    assert metrics["joined"] == [] and metrics["apart"] == ["back"]
    assert metrics["registered"] == 25 and metrics["registered_per_source"]["back"] == [0, 13]
    json.dumps(metrics, allow_nan=False)
    cameras = Cameras.load(tmp_path / "out")
    assert set(cameras.sources) == {"out"}
    true = np.array([street.truth[name] for name in cameras.names])
    fit = umeyama(cameras.positions, true[:, :3, 3])
    assert np.linalg.norm(fit.points(cameras.positions) - true[:, :3, 3], axis=1).max() < 0.03


def test_a_lighting_without_any_placed_film_is_refused(street: Street) -> None:
    capture = Capture.load(street.scene.stage("capture"))
    frames = np.flatnonzero(capture.source_index == 0)
    with pytest.raises(InputError, match="source 'dim': none of its 9 frames connects"):
        sfm._check_registered(capture, frames, CamerasConfig())
    same = dataclasses.replace(capture.sources[1], lighting="bright")
    sfm._check_registered(dataclasses.replace(capture, sources=(capture.sources[0], same)), frames, CamerasConfig())


def _model(
    street: Street,
    places: list[float],
    groups: list[tuple[int, ...]],
    at: dict[tuple[int, ...], list[float]] | None = None,
) -> tuple[pycolmap.Reconstruction, Any]:
    """A model of frames at places x along a line, with one point for each group of frames; and its matcher.

    The points of a group are 5 m before the line unless `at` says where they are.
    """
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 260.0, *SIZE))
    points = pycolmap.Point2DList([pycolmap.Point2D(np.array([float(k), 1.0])) for k in range(len(groups))])
    for k, x in enumerate(places):
        image = pycolmap.Image(f"{k}", points, 1, k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x, 0.0, 0.0])))
    for k, group in enumerate(groups):
        track = pycolmap.Track()
        for frame in group:
            track.add_element(frame + 1, k)
        model.add_point3D(np.array((at or {}).get(group, [3.0, 0.0, 5.0])), track)
    capture = Capture.load(street.scene.stage("capture"))
    ids = {k + 1: k for k in range(len(places))}
    matcher = SimpleNamespace(
        frame_of=lambda: ids,
        image_ids=np.arange(1, len(places) + 1),
        capture=capture,
        verified=lambda: {(k, k + 1): 60 for k in range(len(places) - 1)},
    )
    return model, matcher


def test_a_torn_model_is_recognized(street: Street) -> None:
    """Two pieces without enough common points that fix their scale are not coherent; the larger one is kept."""
    places, pieces, link = [0.0, 1, 2, 3, 4, 5, 6, 7], [tuple(range(5))] * 20 + [(5, 6, 7)] * 20, (4, 5, 6)
    assert mapping.coherent_frames(*_model(street, places, [*pieces, *[link] * 5])) == set(range(5))
    assert mapping.coherent_frames(*_model(street, places, [*pieces, *[link] * 8])) == set(range(8))
    # Points seen by two frames alone fix no scale, nor do points on the skyline.
    assert mapping.coherent_frames(*_model(street, places, [*pieces, *[(4, 5)] * 15])) == set(range(5))
    far = {link: [0.0, 0.0, 300.0]}
    assert mapping.coherent_frames(*_model(street, places, [*pieces, *[link] * 15], far)) == set(range(5))


def test_a_frame_thrown_far_off_is_not_coherent_although_it_shares_points(street: Street) -> None:
    groups = [tuple(range(8))] * 20
    assert mapping.coherent_frames(*_model(street, [0.0, 1, 2, 3, 4, 5, 6, 1000], groups)) == set(range(7))
    assert mapping.coherent_frames(*_model(street, [0.0, 1, 2, 3, 4, 5, 6, 16], groups)) == set(range(8))  # a gap


def test_a_piece_that_shrank_is_not_coherent_although_it_lies_beside_the_others(street: Street) -> None:
    every, shrunk = tuple(range(8)), (5, 6, 7)
    groups, places = [every] * 20 + [shrunk] * 20, [0.0, 1, 2, 3, 4, 4, 4.001, 4.002]
    assert mapping.coherent_frames(*_model(street, places, groups, {shrunk: [4.001, 0.0, 0.005]})) == set(range(5))
    model, matcher = _model(street, places, groups, {shrunk: [4.001, 0.0, 0.5]})
    assert mapping.coherent_frames(model, matcher) == set(range(8))


def test_a_film_is_cut_where_the_model_contradicts_the_matches_of_successive_frames(street: Street) -> None:
    groups = [tuple(range(5))] * 20 + [(5, 6, 7)] * 20 + [(3, 6, 7)] * 8  # frames 4 and 5 share no point
    model, matcher = _model(street, [0.0, 1, 2, 3, 4, 5, 6, 7], groups)
    assert mapping.coherent_frames(model, matcher) == set(range(5))
    matcher.verified = dict
    assert mapping.coherent_frames(model, matcher) == set(range(8))


def test_masked_parts_have_no_features(tmp_path: Path) -> None:
    street = _film(tmp_path / "street", films=(("bright", 1, 1.0), ("dim", 1, 0.5)))
    capture = Capture.load(street.scene.stage("capture"))
    matcher = open_database(capture, street.scene.stage("capture"), tmp_path, False, 2, 0)
    matcher.extract(500, 1280)
    with pycolmap.Database.open(matcher.database) as database:
        masked = database.read_keypoints(int(matcher.image_ids[0]))[:, 1]
        free = database.read_keypoints(int(matcher.image_ids[-1]))[:, 1]
    assert masked.max() <= SIZE[1] - 20 < free.max()


def test_given_poses_are_kept(tmp_path: Path) -> None:
    street = _film(tmp_path / "posed", posed=True, films=FEWER)
    metrics = _run(street, tmp_path / "out")
    cameras, points = Cameras.load(tmp_path / "out"), SparsePoints.load(tmp_path / "out")
    true = np.array([street.truth[name] for name in cameras.names])
    np.testing.assert_allclose(cameras.camera_to_world, true, atol=1e-9)
    assert metrics["mapper"] == "given poses" and metrics["registered"] == 14
    assert metrics["checked_steps"] == 12 and metrics["contradicted_steps"] == []
    assert len(points) > 200
    assert np.median(np.abs(points.xyz[points.xyz[:, 2] < 0.3, 2])) < 0.05


def test_given_poses_that_contradict_the_pictures_are_told(tmp_path: Path) -> None:
    street = _film(tmp_path / "posed", posed=True, films=FEWER)
    stage = street.scene.stage("capture")
    capture = Capture.load(stage)
    assert capture.camera_to_world is not None
    torn = capture.camera_to_world.copy()
    torn[5:9, 1, 3] += 1.0  # [m] the end of the first film
    dataclasses.replace(capture, camera_to_world=torn).save(stage)
    assert ["bright/000004", "bright/000005"] in _run(street, tmp_path / "out")["contradicted_steps"]


@pytest.fixture(scope="module")
def matcher(street: Street, tmp_path_factory: pytest.TempPathFactory) -> Matcher:
    """The street's database with its matches; mappers only read it, and what adds matches gets a copy."""
    stage = street.scene.stage("capture")
    matcher = open_database(Capture.load(stage), stage, tmp_path_factory.mktemp("matched"), False, 2, 0)
    matcher.extract(1500, 1280)
    sfm._match(matcher, np.random.default_rng(0))
    return matcher


@pytest.fixture
def mapper(matcher: Matcher, tmp_path: Path) -> mapping.Mapper:
    return mapping.Mapper(matcher, {"mapper": "auto", "min_registered": 0.6, "free_focal": False}, tmp_path)


@pytest.fixture(scope="module")
def solved(matcher: Matcher, tmp_path_factory: pytest.TempPathFactory) -> pycolmap.Reconstruction:
    """The street's averaged model; tests change copies of it."""
    folder = tmp_path_factory.mktemp("solved")
    job = {"mapper": "auto", "min_registered": 0.6, "free_focal": False}
    model = mapping.Mapper(matcher, job, folder)._averaging()
    assert model is not None
    return model


def _move(model: pycolmap.Reconstruction, matcher: Matcher, frames: list[int], distance: float) -> None:
    """Moves frames diagonally, and leaves their points where they are."""
    known, poses = mapping.registered_poses(model, matcher)
    for k in frames:
        image = model.images[int(matcher.image_ids[k])]
        pose = poses[known == k][0].copy()
        pose[:3, 3] += pose[:3, :3] @ np.full(3, distance)
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pycolmap.Rigid3d(inverse_pose(pose)[:3]))


def _errors(street: Street, matcher: Matcher, model: pycolmap.Reconstruction) -> np.ndarray:
    """Position errors of the registered frames [m] after alignment by a similarity."""
    frames, poses = mapping.registered_poses(model, matcher)
    true = np.array([street.truth[matcher.capture.names[i]] for i in frames])[:, :3, 3]
    return np.linalg.norm(umeyama(poses[:, :3, 3], true).points(poses[:, :3, 3]) - true, axis=1)


def test_a_torn_averaged_model_is_replaced_by_one_that_agrees_with_its_sound_part(
    street: Street,
    matcher: Matcher,
    mapper: mapping.Mapper,
    solved: pycolmap.Reconstruction,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    averaged = copy.deepcopy(solved)
    assert _errors(street, matcher, averaged).max() < 0.03
    _move(averaged, matcher, list(range(6)), 1000.0)
    monkeypatch.setattr(mapper, "_averaging", lambda: averaged)
    summary: dict = {}
    model = mapper.best(summary)
    assert summary["mapper"] == "global" and summary["may_drift"] == []
    errors = _errors(street, matcher, model)
    assert len(errors) == len(matcher.frames) and errors.max() < 0.03


def test_a_larger_model_that_contradicts_the_averaged_one_is_not_taken(
    matcher: Matcher, mapper: mapping.Mapper, solved: pycolmap.Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, averaged = copy.deepcopy(solved), copy.deepcopy(solved)
    mapping._deregister(averaged, matcher, matcher.frames[-2:].tolist())
    monkeypatch.setattr(mapper, "_averaging", lambda: averaged)
    monkeypatch.setattr(mapper, "_global", lambda _: whole)
    summary: dict = {}
    assert mapper.best(summary) is whole and summary["mapper"] == "global"
    frames, poses = mapping.registered_poses(whole, matcher)
    _move(whole, matcher, frames[::2].tolist(), 1.5 * mapping.median_step(poses, frames, matcher))
    summary = {}
    assert mapper.best(summary) is averaged and summary["mapper"] == "averaging"


def test_films_that_only_incremental_mapping_keeps_together_are_named(
    matcher: Matcher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = {"mapper": "auto", "min_registered": 0.6, "free_focal": False}
    summary = sfm._new_summary()
    for attempt in ("_averaging", "_global"):
        monkeypatch.setattr(mapping.Mapper, attempt, lambda *_: None)
    copied = matcher.restricted(matcher.frames, tmp_path)
    mapping.reconstruct(copied, job | {"max_outlier": 0.3}, tmp_path, summary)
    assert summary["mapper"] == "incremental" and summary["may_drift"] == ["bright", "dim"]


def test_a_misplaced_frame_is_registered_anew(
    street: Street, matcher: Matcher, mapper: mapping.Mapper, solved: pycolmap.Reconstruction
) -> None:
    model = copy.deepcopy(solved)
    frames, poses = mapping.registered_poses(model, matcher)
    _move(model, matcher, [5], 2 * mapping.median_step(poses, frames, matcher))
    summary: dict = {"outliers": [], "registered_anew": []}
    repaired = mapper.without_outliers(model, 0.3, summary)
    assert summary == {"outliers": [], "registered_anew": [matcher.capture.names[5]]}
    assert _errors(street, matcher, repaired)[5] < 0.03


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


def test_frames_without_overlap_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = [np.kron(rng.integers(0, 255, (60, 80, 3)), np.ones((4, 4, 1))).astype(np.uint8) for _ in range(4)]
    with pytest.raises(InputError, match="film slower"):
        _run(_capture_of(tmp_path / "s", noise), tmp_path / "out")


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
    with pytest.raises(InputError, match=rf"ended by SIG{signal} \(Check failed: something\); {cure}") as error:
        worker.run_worker(sfm.solve_mapping, {}, tmp_path)
    assert "\n" not in str(error.value)


def test_a_full_disk_in_the_worker_is_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho 'SQLite error: database or disk is full' >&2\nexit 1\n")
    fake.chmod(0o755)
    monkeypatch.setattr(worker.sys, "executable", str(fake))
    with pytest.raises(OSError, match="No space left"):
        worker.run_worker(sfm.solve_mapping, {}, tmp_path)


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
