"""Poses that contradict the relative poses of near frames are told, step by step."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_pair_geometry import FRAMES, ONE_FILM, ROW, Film, simulated_film

from twin.capture.pair_geometry import PairGeometry, pair_geometries
from twin.capture.pose_averaging import averaged_poses
from twin.capture.pose_check import PoseCheck, check_poses
from twin.types import Array

TORN = 8  # frame at which the film is torn apart


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Film:
    return simulated_film(tmp_path_factory.mktemp("film") / "database.db")


@pytest.fixture(scope="module")
def pairs(film: Film) -> list[PairGeometry]:
    return pair_geometries(film.database, 0)


def _check(pairs: list[PairGeometry], poses: Array) -> PoseCheck:
    return check_poses(pairs, ROW, ONE_FILM, np.arange(FRAMES), poses)


def test_true_and_averaged_poses_are_supported(film: Film, pairs: list[PairGeometry]) -> None:
    assert _check(pairs, film.poses) == PoseCheck(FRAMES - 1, [])
    frames, poses = averaged_poses(pairs, ROW, ONE_FILM, 0)
    assert check_poses(pairs, ROW, ONE_FILM, frames, poses).contradicted == []
    shrunk = film.poses.copy()
    shrunk[:, :3, 3] *= 1e-4  # the unit of length does not matter
    assert _check(pairs, shrunk).contradicted == []


@pytest.mark.parametrize("scale", [1e-3, 0.5, 0.7, 1.5])
def test_a_piece_of_another_scale_is_told_where_it_begins(film: Film, pairs: list[PairGeometry], scale: float) -> None:
    poses = film.poses.copy()
    poses[TORN:, :3, 3] = poses[TORN, :3, 3] + scale * (poses[TORN:, :3, 3] - poses[TORN, :3, 3])
    torn = _check(pairs, poses).contradicted
    assert (TORN, TORN + 1) in torn and all(abs(i - TORN) <= 3 for i, _ in torn)


@pytest.mark.parametrize("degrees", [1.5, 5.0, 30.0])
def test_a_bend_that_is_not_there_is_told(film: Film, pairs: list[PairGeometry], degrees: float) -> None:
    poses, pivot = film.poses.copy(), film.poses[TORN, :3, 3].copy()
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    poses[TORN:, :3, :3] = turn @ poses[TORN:, :3, :3]
    poses[TORN:, :3, 3] = pivot + (poses[TORN:, :3, 3] - pivot) @ turn.T
    assert _check(pairs, poses).contradicted == [(TORN - 1, TORN)]


@pytest.mark.parametrize("offset", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (3.0, 0.0, 0.0)])
def test_a_gap_is_told(film: Film, pairs: list[PairGeometry], offset: tuple[float, float, float]) -> None:
    poses = film.poses.copy()
    poses[TORN:, :3, 3] += offset
    torn = _check(pairs, poses).contradicted
    assert (TORN - 1, TORN) in torn and all(abs(i - TORN) <= 3 for i, _ in torn)


def test_pairs_without_near_points_tell_turns_alone(film: Film, pairs: list[PairGeometry]) -> None:
    far = [
        replace(pair, features=pair.features[:0], depths=pair.depths[:0], depth_error=pair.depth_error[:0])
        for pair in pairs
    ]
    poses = film.poses.copy()
    poses[TORN:, :3, 3] += (0.0, 3.0, 0.0)
    assert _check(far, poses) == PoseCheck(FRAMES - 1, [])
    assert _check(far[:3] + pairs[3:], film.poses).contradicted == []
    poses[TORN:, :3, :3] = Rotation.from_euler("z", 5, degrees=True).as_matrix() @ poses[TORN:, :3, :3]
    assert _check(far, poses).contradicted == [(TORN - 1, TORN)]


def test_steps_between_films_are_not_checked(film: Film, pairs: list[PairGeometry]) -> None:
    poses = film.poses.copy()
    poses[TORN:, :3, 3] += (0.0, 5.0, 0.0)
    two = np.repeat([0, 1], [TORN, FRAMES - TORN])
    assert check_poses(pairs, ROW, two, np.arange(FRAMES), poses) == PoseCheck(FRAMES - 2, [])


def test_without_pairs_nothing_is_checked(film: Film, pairs: list[PairGeometry]) -> None:
    assert check_poses([], ROW, ONE_FILM, np.arange(FRAMES), film.poses) == PoseCheck(0, [])
    assert check_poses(pairs, ROW, ONE_FILM, np.arange(1), film.poses[:1]) == PoseCheck(0, [])


def test_a_frame_without_a_pose_is_stepped_over(film: Film, pairs: list[PairGeometry]) -> None:
    posed = np.delete(np.arange(FRAMES), 5)
    assert check_poses(pairs, ROW, ONE_FILM, posed, film.poses[posed]) == PoseCheck(FRAMES - 2, [])
    poses = film.poses[posed]
    poses[5:, :3, 3] += (0.0, 3.0, 0.0)
    assert (4, 6) in check_poses(pairs, ROW, ONE_FILM, posed, poses).contradicted


def test_cameras_on_one_spot_have_no_direction(film: Film, pairs: list[PairGeometry]) -> None:
    """If all cameras stand on one spot, turns alone are compared; if one does, the pairs tell that it moved."""
    still = film.poses.copy()
    still[:, :3, 3] = 0.0
    assert _check(pairs, still).contradicted == []
    poses = film.poses.copy()
    poses[TORN, :3, 3] = poses[TORN - 1, :3, 3] + 1e-6
    assert (TORN, TORN + 1) in _check(pairs, poses).contradicted


@pytest.mark.parametrize(
    ("degrees", "offset"), [(2.0, (0, 0, 0)), (180.0, (0, 0, 0)), (0.0, (0, 1, 0)), (0.0, (0, 0, 1)), (0.0, (0, 30, 0))]
)
def test_a_single_misplaced_frame_is_told(film: Film, pairs: list[PairGeometry], degrees: float, offset: tuple) -> None:
    poses = film.poses.copy()
    poses[TORN, :3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix() @ poses[TORN, :3, :3]
    poses[TORN, :3, 3] += offset
    torn = _check(pairs, poses).contradicted
    assert {(TORN - 1, TORN), (TORN, TORN + 1)} <= set(torn) and all(abs(i - TORN) <= 3 for i, _ in torn)


def test_many_misplaced_frames_are_told(film: Film, pairs: list[PairGeometry]) -> None:
    poses = film.poses.copy()
    poses[3:-1:4, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix() @ poses[3:-1:4, :3, :3]
    torn = set(_check(pairs, poses).contradicted)
    assert all({(k - 1, k), (k, k + 1)} <= torn for k in range(3, FRAMES - 1, 4))
