"""Relative poses of pairs, focal lengths, and camera poses averaged from or checked by pairs, on a simulated film."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from twin.capture import pair_geometry
from twin.capture.pair_geometry import (
    PairGeometry,
    _is_near,
    estimate_focal_lengths,
    pair_geometries,
    with_rotation,
)
from twin.capture.pose_averaging import (
    Differences,
    PoseCheck,
    _goes_along,
    averaged_poses,
    check_poses,
    consistent_pairs,
    solve_differences,
)
from twin.errors import InputError
from twin.geometry.poses import umeyama
from twin.types import Array

FRAMES, FOCAL, WIDTH, HEIGHT = 16, 525.0, 640, 360
NOISE = 0.3  # [px]
FEATURES = 1000  # keypoints per frame of the first kind; wrong ones follow them


@dataclass(frozen=True)
class Film:
    database: Path
    poses: Array  # (n, 4, 4) camera_to_world
    pixels: Array  # (n, m, 2), NaN if not seen

    def relative(self, i: int, j: int) -> tuple[Array, Array]:
        """Rotation and direction of translation of frame j relative to frame i."""
        change = np.linalg.inv(self.poses[j]) @ self.poses[i]
        return change[:3, :3], change[:3, 3] / np.linalg.norm(change[:3, 3])

    def error(self, frames: np.ndarray, poses: Array) -> float:
        """Largest distance [m] from the true positions."""
        found, true = poses[:, :3, 3], self.poses[frames, :3, 3]
        return float(np.linalg.norm(umeyama(found, true).points(found) - true, axis=1).max())


def _film(path: Path, wrong: bool = False, bend: float = 0.04, shake: float = 0.03) -> Film:
    """A camera that shakes [rad] goes 1 m per frame round a bend [rad per frame] over a plane, with a skyline.

    A tenth of all matches are wrong. If `wrong`, frames 2 and 13 share 120 matches of a repeated pattern, too.
    """
    rng = np.random.default_rng(3)
    ground = np.stack([rng.uniform(-6, 30, 6000), rng.uniform(-10, 12, 6000), np.zeros(6000)], 1)
    bearing = rng.uniform(-np.pi, np.pi, 1500)
    far = 400 * np.stack([np.cos(bearing), np.sin(bearing), rng.uniform(0.01, 0.15, 1500)], 1)
    points = np.concatenate([ground, far])
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    heading, at = 0.0, np.array([0.0, 0.0, 1.0])
    for k in range(FRAMES):
        forward = np.array([np.cos(heading), np.sin(heading), -0.15])
        axes = np.stack([np.cross(forward, [0, 0, 1]), [0.0, 0, 0], forward / np.linalg.norm(forward)], 1)
        axes[:, 0] /= np.linalg.norm(axes[:, 0])
        axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
        poses[k, :3, :3] = axes @ Rotation.from_rotvec(rng.normal(0, shake, 3)).as_matrix()
        poses[k, :3, 3] = at
        at = at + np.array([np.cos(heading), np.sin(heading), 0.0])
        heading += bend
    pixels = np.full((FRAMES, len(points), 2), np.nan)
    for k, pose in enumerate(poses):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        xy = local[:, :2] / local[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2] + rng.normal(0, NOISE, (len(points), 2))
        seen = (local[:, 2] > 1) & (xy >= 0).all(1) & (xy < [WIDTH, HEIGHT]).all(1)
        seen[: len(ground)] &= local[: len(ground), 2] < 8
        pixels[k, seen] = xy[seen]
    _write(path, pixels, rng, wrong)
    return Film(path, poses, pixels)


def _write(path: Path, pixels: Array, rng: np.random.Generator, wrong: bool) -> None:
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
        database.write_camera(camera, use_camera_id=True)
        pattern = rng.uniform([0, 0], [WIDTH, HEIGHT], (120, 2))
        for k, xy in enumerate(pixels):
            image = pycolmap.Image(f"{k}.png", pycolmap.Point2DList(), 1, k + 1)
            database.write_image(image, use_image_id=True)
            extra = pattern + np.array([5.0 * (k == 13), 0.0])
            database.write_keypoints(k + 1, np.concatenate([np.nan_to_num(xy), extra]).astype(np.float32))
        for i in range(FRAMES):
            for j in range(i + 1, min(i + 4, FRAMES)):
                _match(database, i, j, np.flatnonzero(np.isfinite(pixels[[i, j], :, 0]).all(0)), rng)
        if wrong:
            both = np.arange(pixels.shape[1], pixels.shape[1] + len(pattern), dtype=np.uint32)
            database.write_two_view_geometry(3, 14, _geometry(np.stack([both, both], 1)))


def _match(database: pycolmap.Database, i: int, j: int, seen: np.ndarray, rng: np.random.Generator) -> None:
    matches = np.stack([seen, seen], 1).astype(np.uint32)
    bad = rng.permutation(len(seen))[: len(seen) // 10]
    matches[bad, 1] = rng.permutation(matches[bad, 1])
    database.write_two_view_geometry(i + 1, j + 1, _geometry(matches))


def _geometry(matches: np.ndarray) -> pycolmap.TwoViewGeometry:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.UNDEFINED
    geometry.inlier_matches = matches
    return geometry


ROW = {k + 1: k for k in range(FRAMES)}
ONE_FILM = np.zeros(FRAMES, np.int64)


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Film:
    return _film(tmp_path_factory.mktemp("film") / "database.db")


@pytest.fixture(scope="module")
def pairs(film: Film) -> list[PairGeometry]:
    return pair_geometries(film.database, 0)


def test_relative_poses_are_right_in_spite_of_wrong_matches(film: Film, pairs: list[PairGeometry]) -> None:
    assert len(pairs) == 3 * FRAMES - 6
    for pair in pairs:
        rotation, direction = film.relative(pair.matches.first - 1, pair.matches.second - 1)
        assert np.degrees(Rotation.from_matrix(pair.rotation @ rotation.T).magnitude()) < 0.1
        assert np.degrees(np.arccos(np.clip(pair.translation @ direction, -1, 1))) < 1.5
        assert 0.8 < pair.agreeing < 0.95


def test_depths_are_those_of_near_points_in_units_of_the_pair(film: Film, pairs: list[PairGeometry]) -> None:
    pair = pairs[0]
    i, j = pair.matches.first - 1, pair.matches.second - 1
    unit = np.linalg.norm(film.poses[i, :3, 3] - film.poses[j, :3, 3])
    ground = pair.features[:, 0] < 6000
    assert ground.mean() > 0.95  # the skyline has no depth
    depth = pair.depths[ground, 0] * unit
    assert 1.0 < np.median(depth) < 8.0
    pixel = film.pixels[i, pair.features[ground, 0]]
    ray = np.c_[(pixel - [WIDTH / 2, HEIGHT / 2]) / FOCAL, np.ones(len(pixel))]
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) @ film.poses[i, :3, :3].T
    height = film.poses[i, 2, 3] + ray[:, 2] * depth
    assert np.median(np.abs(height)) < 0.03


def test_poses_averaged_from_pairs_are_those_of_the_film(film: Film, pairs: list[PairGeometry]) -> None:
    frames, poses = averaged_poses(pairs, ROW, ONE_FILM, 0)
    assert frames.tolist() == list(range(FRAMES))
    assert film.error(frames, poses) < 0.1


def test_a_pair_of_a_repeated_pattern_does_not_bend_the_path(tmp_path: Path) -> None:
    film = _film(tmp_path / "database.db", wrong=True)
    pairs = pair_geometries(film.database, 0)
    assert (3, 14) in {(pair.matches.first, pair.matches.second) for pair in pairs}
    frames, poses = averaged_poses(pairs, ROW, ONE_FILM, 0)
    assert film.error(frames, poses) < 0.1
    assert (2, 13) not in consistent_pairs(pairs, ROW, ONE_FILM)


def test_pairs_whose_rotation_contradicts_the_others_do_not_bend_the_path(
    film: Film, pairs: list[PairGeometry]
) -> None:
    """As where another pose explains the matches of a plane better than the true one. Such pairs link no films."""
    turn = Rotation.from_rotvec([0.0, np.radians(8.0), 0.0]).as_matrix()
    bent = [
        replace(pair, rotation=turn @ pair.rotation, translation=turn @ pair.translation, cost=0.0)
        if pair.matches.second - pair.matches.first == 3
        else pair
        for pair in pairs
    ]
    frames, poses = averaged_poses(bent, ROW, ONE_FILM, 0)
    assert frames.tolist() == list(range(FRAMES)) and film.error(frames, poses) < 0.02
    kept = consistent_pairs(bent, ROW, ONE_FILM)
    assert {j - i for i, j in kept} == {1, 2} and len(kept) == 2 * FRAMES - 3


def test_refined_cameras_replace_those_of_the_database(film: Film, pairs: list[PairGeometry]) -> None:
    known = {(pair.matches.first, pair.matches.second): pair for pair in pairs}
    same = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
    assert pair_geometries(film.database, 0, known, {(1, 2)}, {1: same})[0] is known[1, 2]
    other = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1.3 * FOCAL, WIDTH, HEIGHT)
    (refined,) = pair_geometries(film.database, 0, known, {(1, 2)}, {1: other})
    assert refined.matches.first_rays[0, 2] > pairs[0].matches.first_rays[0, 2]  # nearer to the axis
    assert len(known) == len(pairs) and known[1, 2] is pairs[0]


def test_known_pairs_are_not_computed_again(film: Film, pairs: list[PairGeometry]) -> None:
    known = {(pair.matches.first, pair.matches.second): pair for pair in pairs[:-1]}
    again = pair_geometries(film.database, 0, known)
    assert all(one is other for one, other in zip(again[:-1], pairs[:-1], strict=True))
    assert len(known) == len(pairs)
    np.testing.assert_array_equal(again[-1].rotation, pairs[-1].rotation)


def test_another_pose_is_taken_only_if_it_explains_the_matches(film: Film, pairs: list[PairGeometry]) -> None:
    near = with_rotation(pairs[0], pairs[0].rotation @ Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix(), 0)
    assert near is not None
    np.testing.assert_allclose(near.rotation, pairs[0].rotation, atol=1e-3)
    assert with_rotation(pairs[0], pairs[0].rotation @ Rotation.from_rotvec([0.0, 2.5, 0.0]).as_matrix(), 0) is None


def test_starts_are_the_same_only_with_rotation_and_direction() -> None:
    def pose(turn: float, bend: float, sign: float = 1.0) -> tuple[Array, Array, float]:
        """Turned about x, with a direction turned about y [°]."""
        angle = np.radians(bend)
        rotation = Rotation.from_euler("x", turn, degrees=True).as_matrix()
        return rotation, sign * np.array([np.sin(angle), 0.0, np.cos(angle)]), 0.0

    assert _is_near(pose(0, 0), pose(0.2, 0.2)) and _is_near(pose(0, 0), pose(0, 0, -1.0))
    assert not _is_near(pose(0, 0), pose(0.4, 0)) and not _is_near(pose(0, 0), pose(0, 0.4))


@pytest.mark.parametrize(("model", "guess"), [("SIMPLE_RADIAL", 250.0), ("SIMPLE_RADIAL", 768.0), ("PINHOLE", 768.0)])
def test_the_focal_length_is_found_from_matches(film: Film, tmp_path: Path, model: str, guess: float) -> None:
    found = _fitted(film, tmp_path / "database.db", model, guess)
    assert 0.925 * FOCAL < found[0] < 1.06 * FOCAL  # the nearest first guesses are 8 % shorter and 7 % longer
    assert len(found) == 4 and (model == "PINHOLE" or abs(found[3]) < 0.05)


def test_a_focal_length_that_the_matches_do_not_tell_stays_near_the_guess(tmp_path: Path) -> None:
    """A camera that goes straight ahead and does not turn: a longer focal length looks like longer steps."""
    film = _film(tmp_path / "straight.db", bend=0.0, shake=0.0)
    assert 0.5 * FOCAL < _fitted(film, tmp_path / "database.db", "SIMPLE_RADIAL", 600.0)[0] < 2.0 * FOCAL


def _fitted(film: Film, path: Path, model: str, guess: float) -> list[float]:
    """Parameters of the film's camera, fitted in a copy of its database."""
    path.write_bytes(film.database.read_bytes())
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, model, guess, WIDTH, HEIGHT)
        camera.has_prior_focal_length = False
        database.update_camera(camera)
    estimate_focal_lengths(path, 0)
    with pycolmap.Database.open(path) as database:
        return list(database.read_all_cameras()[0].params)


def test_a_given_focal_length_is_kept(film: Film, tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    path.write_bytes(film.database.read_bytes())
    with pycolmap.Database.open(path) as database:
        (camera,) = database.read_all_cameras()
        camera.params, camera.has_prior_focal_length = [700.0, WIDTH / 2, HEIGHT / 2, 0.0], True
        database.update_camera(camera)
    estimate_focal_lengths(path, 0)
    with pycolmap.Database.open(path) as database:
        assert database.read_all_cameras()[0].params[0] == 700.0


def test_differences_are_solved_for_the_largest_part_and_outliers_have_no_effect() -> None:
    first, second = np.array([1, 2, 3, 3, 5]), np.array([0, 1, 2, 0, 4])
    value = np.array([[1.0], [1.0], [1.0], [50.0], [7.0]])
    cost = np.array([1.0, 1.0, 1.0, 9.0, 1.0])
    part, solution, residual = solve_differences(Differences(first, second, value, np.full(5, 0.1), cost), 6)
    assert part.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(solution[1:4, 0] - solution[0, 0], [1.0, 2.0, 3.0], atol=0.02)
    assert residual[3] == pytest.approx(47.0, abs=0.1) and np.isnan(residual[4])


def test_without_pairs_no_frame_has_a_pose() -> None:
    frames, poses = averaged_poses([], ROW, ONE_FILM, 0)
    assert len(frames) == len(poses) == 0 and consistent_pairs([], ROW, ONE_FILM) == []


def test_a_pair_whose_direction_contradicts_the_steps_between_is_told() -> None:
    """A film along x, and one pair of two films, of which nothing is known."""
    first, second = np.array([0, 1, 2, 3, 0, 0, 2]), np.array([1, 2, 3, 4, 3, 4, 5])
    directions = np.array([[1.0, 0, 0]] * 4 + [[1.0, 0.1, 0], [0, 1.0, 0], [0, 1.0, 0]])
    film = np.array([0, 0, 0, 0, 0, 1])
    assert _goes_along(first, second, directions, film).tolist() == [True] * 5 + [False, True]


def test_a_pair_where_the_lens_cannot_be_inverted_is_left_out(film: Film, tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    path.write_bytes(film.database.read_bytes())
    with pycolmap.Database.open(path) as database:
        (camera,) = database.read_all_cameras()
        camera.params = [FOCAL / 8, WIDTH / 2, HEIGHT / 2, -0.5]
        database.update_camera(camera)
        corner = np.flatnonzero((np.abs(film.pixels[:2, :, 0] - WIDTH / 2) > 0.3 * WIDTH).all(0))[:20].astype(np.uint32)
        database.delete_two_view_geometry(1, 2)
        database.write_two_view_geometry(1, 2, _geometry(np.stack([corner, corner], 1)))
    assert len(corner) == 20
    assert (1, 2) not in {(pair.matches.first, pair.matches.second) for pair in pair_geometries(path, 0)}


# ---- poses checked by pairs


TORN = 8  # frame at which the film is torn apart


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


def _deflected(pair: PairGeometry, **changes: object) -> PairGeometry:
    """The pair with a wrong direction of the translation."""
    turn = Rotation.from_euler("y", 120, degrees=True).as_matrix()
    return replace(pair, translation=turn @ pair.translation, **changes)


def test_pairs_that_contradict_those_between_their_frames_do_not_count(film: Film, pairs: list[PairGeometry]) -> None:
    """Frames that are some steps apart may match by a repeated pattern."""
    near = [pair if pair.matches.second == pair.matches.first + 1 else _deflected(pair) for pair in pairs]
    assert _check(near, film.poses) == PoseCheck(FRAMES - 1, [])
    assert len(_check([_deflected(pair) for pair in pairs], film.poses).contradicted) == FRAMES - 1


def test_directions_with_little_parallax_do_not_count(film: Film, pairs: list[PairGeometry]) -> None:
    far = [_deflected(pair, depths=100.0 * pair.depths) for pair in pairs]
    assert _check(far, film.poses) == PoseCheck(FRAMES - 1, [])


def test_several_processes_give_the_same_pairs(
    film: Film, pairs: list[PairGeometry], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pair_geometry, "_MIN_PARALLEL", 1)
    for one, other in zip(pair_geometries(film.database, 0, processes=2), pairs, strict=True):
        assert one.matches is not other.matches  # it came from another process
        np.testing.assert_equal(vars(one.matches), vars(other.matches))
        np.testing.assert_equal(vars(one) | {"matches": 0}, vars(other) | {"matches": 0})


def _abort(_: object) -> None:
    os.abort()


def test_a_killed_process_is_bad_input(film: Film, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pair_geometry, "_MIN_PARALLEL", 1)
    monkeypatch.setattr(pair_geometry, "_geometry", _abort)
    with pytest.raises(InputError, match="processes that compute relative poses was killed"):
        pair_geometries(film.database, 0, processes=2)
