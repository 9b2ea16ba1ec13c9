"""Stage `metric`: a reconstruction in a random frame is transformed back to the level, metric world."""

import dataclasses
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from twin.capture import metric, sfm
from twin.capture.capture_data import Capture, SourceInfo
from twin.capture.gravity import find_road, up_from_ground
from twin.capture.scale import (
    Scale,
    combine_scales,
    fit_square,
    local_east_north_up,
    scale_from_gps,
    scale_from_marker,
)
from twin.config import DistanceConfig, MarkerConfig, MetricConfig, SceneConfig
from twin.errors import InputError
from twin.files import read_json
from twin.geometry.cameras import Cameras, SparsePoints, pixel_grid, project, unproject
from twin.geometry.images import write_image
from twin.geometry.poses import Similarity, inverse_pose, look_at, umeyama
from twin.scene import SceneDir

SIZE = (320, 240)
INTRINSICS = np.array([260.0, 260.0, 160.0, 120.0])
HEIGHT = 1.3
"""Lens above the road [m]."""


def _similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Similarity(float(np.exp(rng.normal())), q * np.sign(np.linalg.det(q)), rng.normal(size=3) * 5)


def _path(turn: bool = True, count: int = 60, height: float = HEIGHT, pitch: float = 0.2) -> np.ndarray:
    """A drive along x, then (with `turn`) to the right; cameras pitched down. World: meters, z up, road z = 0."""
    s = np.linspace(0.0, 40.0, count)
    angle = np.clip((s - 20.0) / 6.0, 0.0, np.pi / 2) if turn else 0 * s
    past = np.maximum(s - 20.0 - 3.0 * np.pi, 0.0) if turn else 0 * s
    x = np.minimum(s, 20.0) + 6.0 * np.sin(angle) if turn else s
    eyes = np.stack([x, -6.0 * (1 - np.cos(angle)) - past, height + 0.01 * np.sin(2 * s)], 1)
    ahead = np.stack([np.cos(angle), -np.sin(angle), 0 * s - np.tan(pitch)], 1)
    return np.array([look_at(e, e + a) for e, a in zip(eyes, ahead, strict=True)])


def _points(poses: np.ndarray, rng: np.random.Generator, on_road: int = 300) -> np.ndarray:
    """Few points on the road near the path, many above and beside it, a few mismatches below it."""
    centres = poses[:, :3, 3]
    road = centres[rng.integers(0, len(poses), on_road)] + rng.normal(0, 0.7, (on_road, 3))
    road[:, 2] = rng.normal(0, 0.01, on_road)
    clutter = centres[rng.integers(0, len(poses), 2000)] + rng.uniform(-15, 15, (2000, 3))
    clutter[:, 2] = rng.uniform(0.3, 12.0, 2000)
    wrong = centres[rng.integers(0, len(poses), 20)] + rng.uniform(-3, 3, (20, 3))
    wrong[:, 2] = rng.uniform(-6.0, -0.5, 20)
    return np.concatenate([road, clutter, wrong])


@dataclasses.dataclass
class World:
    """A scene whose `cameras` stage is written; `truth` are its level, metric poses."""

    scene: SceneDir
    truth: np.ndarray

    def run(self, out: Path, **changes: object) -> dict:
        out.mkdir(exist_ok=True)
        return metric.run(self.scene, SceneConfig(metric=MetricConfig(**changes)), out)  # type: ignore[arg-type]


def _world(
    root: Path,
    films: list[np.ndarray],
    points: np.ndarray,
    moved: Similarity,
    gps: np.ndarray | None = None,
    heights: tuple[float, ...] = (),
    posed: bool = False,
) -> World:
    poses = np.concatenate(films)
    source = np.repeat(np.arange(len(films)), [len(f) for f in films])
    names = tuple(f"film{s}/{i:06d}" for s, film in enumerate(films) for i in range(len(film)))
    n = len(names)
    times = np.concatenate([np.arange(len(f)) * 0.5 for f in films])
    infos = tuple(
        SourceInfo(
            f"film{s}", f"light{s}", "video", *SIZE, "PINHOLE", tuple(INTRINSICS), True, (heights or (0.0,) * 9)[s]
        )
        for s in range(len(films))
    )
    scene = SceneDir(root)
    for stage in ("capture", "cameras"):
        scene.stage(stage).mkdir(parents=True)
    nowhere = np.full((n, 3), np.nan)
    given = (moved.poses(poses), np.tile(INTRINSICS, (n, 1))) if posed else (None, None)
    Capture(infos, names, source, times, np.zeros(n, bool), nowhere if gps is None else gps, *given).save(
        scene.stage("capture")
    )
    Cameras(
        names,
        moved.poses(poses),
        np.tile(INTRINSICS, (n, 1)),
        np.tile(np.array(SIZE), (n, 1)),
        tuple(f"light{s}" for s in source),
        tuple(f"film{s}" for s in source),
        times,
        np.zeros(n, bool),
        scene.stage("cameras") / "images",
    ).save(scene.stage("cameras"))
    m = len(points)
    seen = np.arange(m)
    SparsePoints(moved.points(points), np.zeros((m, 3), np.uint8), np.ones(m), seen, np.zeros(m, np.int64)).save(
        scene.stage("cameras")
    )
    return World(scene, poses)


def _check_level(world: World, out: Path, tilt_deg: float, scale: float, floor: float) -> None:
    """The result equals the truth up to a turn about z and a shift along the ground."""
    cameras, points = Cameras.load(out), SparsePoints.load(out)
    fit = umeyama(cameras.positions, world.truth[:, :3, 3])
    assert fit.scale == pytest.approx(1.0, abs=scale)
    turned = world.truth[0, :3, :3] @ cameras.camera_to_world[0, :3, :3].T
    assert np.degrees(np.arccos(turned[2, 2])) < tilt_deg
    assert cameras.positions[:, 2].mean() == pytest.approx(world.truth[:, 2, 3].mean(), abs=floor)
    assert np.abs(cameras.positions[0, :2]).max() < 1e-9  # the origin is under the first camera
    way = cameras.positions[3] - cameras.positions[0]
    assert way[0] > 0 and abs(way[1]) < 0.05 * way[0]  # x is the way driven first
    assert len(points) and cameras.images == world.scene.stage("cameras") / "images"


# --- camera height ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("turn", [True, False])
def test_camera_height_gives_metres_and_up(tmp_path: Path, seed: int, turn: bool) -> None:
    rng = np.random.default_rng(seed)
    film = _path(turn)
    world = _world(tmp_path / "s", [film], _points(film, rng), _similarity(seed))
    metrics = world.run(tmp_path / "out", camera_height=HEIGHT)
    _check_level(world, tmp_path / "out", tilt_deg=0.7, scale=0.01, floor=0.02)
    assert metrics == read_json(tmp_path / "out" / "metric.json")
    assert metrics["scale_source"] == "camera_height" and metrics["road_reliable"]
    assert metrics["scale_uncertainty"] < 0.02
    assert metrics["camera_height_median_m"] == pytest.approx(HEIGHT, abs=0.01)
    assert metrics["path_length_m"] == pytest.approx(40.0, rel=0.02)
    back = np.array(metrics["similarity"]["rotation"])
    np.testing.assert_allclose(back @ back.T, np.eye(3), atol=1e-9)


def test_sources_carried_at_different_heights_agree(tmp_path: Path) -> None:
    low, high = _path(height=0.6), _path(height=1.5)
    points = _points(high, np.random.default_rng(0), on_road=800)
    world = _world(tmp_path / "s", [low, high], points, _similarity(1), heights=(0.6, 1.5))
    metrics = world.run(tmp_path / "out")
    _check_level(world, tmp_path / "out", tilt_deg=0.5, scale=0.01, floor=0.02)
    assert metrics["scale_per_source_relative"] == pytest.approx([1.0, 1.0], abs=0.02)
    assert metrics["camera_height_m_of"] == pytest.approx({"film0": 0.6, "film1": 1.5}, abs=0.03)
    few = _points(high, np.random.default_rng(0), on_road=12)[:12]  # heights cannot be measured; the given ones differ
    sparse = _world(tmp_path / "few", [low, high], few, _similarity(1), heights=(0.6, 1.5)).run(tmp_path / "out_few")
    assert not sparse["road_reliable"] and sparse["camera_height_m_of"] == {"film0": 0.6, "film1": 1.5}
    half = _world(tmp_path / "half", [low, high], few, _similarity(1), heights=(0.0, 1.5)).run(tmp_path / "out_half")
    assert "camera_height_m_of" not in half  # that of the first film is not known


def test_a_height_of_a_film_that_was_not_placed_is_refused(tmp_path: Path) -> None:
    film = _path()
    points = _points(film, np.random.default_rng(2))
    world = _world(tmp_path / "s", [film, film], points, _similarity(8), heights=(0.0, 1.3))
    cameras = Cameras.load(world.scene.stage("cameras"))
    cameras.select(np.array(cameras.sources) == "film0").save(world.scene.stage("cameras"))
    with pytest.raises(InputError, match=r"no frame was registered of the sources with a camera_height \(film1\)"):
        world.run(tmp_path / "out")


def test_few_road_points_are_reported(tmp_path: Path) -> None:
    film = _path()
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0), on_road=8)[:8], _similarity(0))
    metrics = world.run(tmp_path / "out", camera_height=HEIGHT)
    assert not metrics["road_reliable"] and metrics["road_points"] <= 8
    assert metrics["scale_uncertainty"] >= 0.05


def test_no_point_below_the_path_is_an_error(tmp_path: Path) -> None:
    film = _path()
    world = _world(tmp_path / "s", [film], film[:, :3, 3] + [0, 0, 2.0], _similarity(0))
    with pytest.raises(InputError, match="no reconstructed point lies below the path"):
        world.run(tmp_path / "out", camera_height=HEIGHT)


# --- gravity ----------------------------------------------------------------------------------------------------------


def test_a_pitched_camera_does_not_tilt_the_world() -> None:
    film = _path(turn=False, pitch=0.35)
    up, road = up_from_ground(film, np.zeros((0, 3)))
    assert road is None
    assert np.degrees(np.arccos(up.direction[2])) < 0.1  # the path gives the pitch, the level right axes the roll
    assert up.uncertainty < np.radians(2.0)


def test_films_at_two_heights_do_not_tilt_the_world() -> None:
    """A low camera films only the end of the road: without its film's name, the path seems to slope."""
    high, low = _path(turn=False), _path(turn=False, height=0.5)[30:]
    both = np.concatenate([high, low])
    tilts = []
    for sources in ((), ("high",) * len(high) + ("low",) * len(low)):
        up, _ = up_from_ground(both, np.zeros((0, 3)), sources)
        tilts.append(np.degrees(np.arccos(up.direction[2])))
    assert tilts[0] > 0.5 and tilts[1] < 0.05


def test_up_is_signed_by_the_cameras() -> None:
    film = _path()
    mirrored = np.array(film)
    flip = np.diag([1.0, -1.0, -1.0])
    mirrored[:, :3, :3] = flip @ film[:, :3, :3]
    mirrored[:, :3, 3] = film[:, :3, 3] @ flip
    up, _ = up_from_ground(mirrored, np.zeros((0, 3)))
    assert up.direction[2] < -0.99


def test_the_road_is_found_below_curbs_and_above_mismatches() -> None:
    rng = np.random.default_rng(5)
    film = _path()
    centres = film[:, :3, 3]
    curb = centres[rng.integers(0, 60, 200)] + rng.normal(0, 0.8, (200, 3))
    curb[:, 2] = 0.35
    points = np.concatenate([_points(film, rng, on_road=150), curb])
    road = find_road(points, centres, np.array([0.0, 0.0, 1.0]))
    assert road is not None and road.reliable
    assert road.drop == pytest.approx(HEIGHT, abs=0.02)
    assert np.mean(np.abs(points[road.points, 2]) < 0.1) > 0.95


def test_the_road_of_many_points_takes_little_memory() -> None:
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(0, 300, 50_000), rng.normal(0, 1, 50_000), rng.normal(0, 0.02, 50_000)], 1)
    centers = np.stack([np.linspace(0, 300, 300), np.zeros(300), np.full(300, HEIGHT)], 1)
    tracemalloc.start()
    try:
        road = find_road(points, centers, np.array([0.0, 0.0, 1.0]))
        assert road is not None and len(road.points) > 30_000
        assert tracemalloc.get_traced_memory()[1] < 30e6
    finally:
        tracemalloc.stop()


def test_a_camera_led_around_an_object_has_no_road() -> None:
    rng = np.random.default_rng(3)
    angle = np.linspace(0, 5, 50)
    eyes = np.stack([3 * np.cos(angle), 3 * np.sin(angle), 2.0 + 1.5 * np.sin(3 * angle)], 1)
    points = rng.normal(0, 2, (3000, 3))
    assert find_road(points, eyes, np.array([0.0, 0.0, 1.0])) is None


def test_a_road_without_texture_is_found_beside_the_path() -> None:
    rng = np.random.default_rng(2)
    film = _path(turn=False)
    verge = film[rng.integers(0, 60, 200), :3, 3] + np.stack(
        [rng.normal(0, 1, 200), rng.choice([-1, 1], 200) * rng.uniform(3, 5, 200), 0 * rng.random(200)], 1
    )
    verge[:, 2] = rng.normal(0.05, 0.02, 200)
    road = find_road(verge, film[:, :3, 3], np.array([0.0, 0.0, 1.0]))
    assert road is not None and not road.reliable and road.reach > 1.0
    assert road.drop == pytest.approx(HEIGHT, abs=0.1)


# --- the other scales -------------------------------------------------------------------------------------------------


def _to_gps(enu: np.ndarray) -> np.ndarray:
    """East, north, up [m] near Lund as latitude, longitude, altitude; accurate to millimeters over 100 m."""
    lat0, lon0, eps = 55.7, 13.2, 1e-4
    origin = np.array([[lat0, lon0, 50.0]])
    north = np.diff(local_east_north_up(np.concatenate([origin, origin + np.array([[eps, 0, 0]])])), axis=0)[0, 1] / eps
    east = np.diff(local_east_north_up(np.concatenate([origin, origin + np.array([[0, eps, 0]])])), axis=0)[0, 0] / eps
    return np.stack([lat0 + enu[:, 1] / north, lon0 + enu[:, 0] / east, 50.0 + enu[:, 2]], 1)


def test_east_north_up_of_a_known_place() -> None:
    # One minute of latitude is a nautical mile (1852 m by definition; 1855.8 m at 55.7° on WGS 84).
    enu = local_east_north_up(np.array([[55.7, 13.2, 10.0], [55.7 + 1 / 60, 13.2, 10.0], [55.7, 13.2, 17.0]]))
    np.testing.assert_allclose(enu[1, :2] - enu[0, :2], [0.0, 1855.8], atol=0.6)
    np.testing.assert_allclose(enu[2] - enu[0], [0.0, 0.0, 7.0], atol=1e-6)
    across = local_east_north_up(np.array([[0.0, 180.0 - 5e-5, 0.0], [0.0, 5e-5 - 180.0, 0.0]]))
    np.testing.assert_allclose(across[1, :2] - across[0, :2], [11.132, 0.0], atol=1e-3)  # no jump at ±180°


def test_a_wrong_first_position_distorts_no_other() -> None:
    right = _to_gps(np.array([[0.0, 0.0, 0.0], [0.0, 90.0, 0.0], [60.0, 90.0, 0.0], [60.0, 0.0, 0.0]]))
    wrong = local_east_north_up(np.concatenate([[[0.0, 0.0, 0.0]], right]))[1:]
    np.testing.assert_allclose(np.diff(wrong, axis=0)[:, :2], [[0, 90], [60, 0], [0, -90]], atol=0.02)


def test_gps_gives_metres_and_east(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    film = _path(count=40)
    gps = _to_gps(film[:, :3, 3] + rng.normal(0, 0.3, (40, 3)) * [1, 1, 5])
    gps[5] += [0.001, 0, 0]  # a hundred meters off
    gps[9] = np.nan
    world = _world(tmp_path / "s", [film], _points(film, rng), _similarity(7), gps=gps)
    metrics = world.run(tmp_path / "out", gps=True)
    cameras = Cameras.load(tmp_path / "out")
    shift = cameras.positions - film[:, :3, 3]
    assert np.abs(shift - shift.mean(0)).max() < 0.8  # not turned: x is east
    assert metrics["gps_inliers"] <= metrics["gps_frames"] - 1 == 38
    fit = umeyama(cameras.positions, film[:, :3, 3])
    assert abs(fit.scale - 1) < 0.02 and abs(fit.scale - 1) < 4 * metrics["scale_uncertainty"]


@pytest.mark.parametrize(("kept", "films"), [(0.0, 1), (0.97, 1), (0.97, 3)])
def test_the_stated_uncertainty_of_drifting_gps_holds(kept: float, films: int) -> None:
    """`kept` is the correlation of the errors of neighboring frames; with 0.97, a third of the film is alike."""
    rng, inside, sigmas = np.random.default_rng(5), 0, []
    film = _path(count=40)
    cameras = Cameras(
        *(tuple(f"{k:03d}" for k in range(40 * films)), np.tile(film, (films, 1, 1)), np.ones((40 * films, 4))),
        *(np.ones((40 * films, 2), int), ("day",) * (40 * films), tuple(np.repeat(list("abc")[:films], 40))),
        *(np.arange(40.0 * films), np.zeros(40 * films, bool), Path()),
    )
    count = 40 if films == 1 else 14
    for _ in range(count):
        errors = rng.normal(0, 1, (films, 40, 3))
        for k in range(1, 40):
            errors[:, k] = kept * errors[:, k - 1] + np.sqrt(1 - kept**2) * errors[:, k]
        gps = _to_gps(cameras.positions + errors.reshape(-1, 3))
        scale, _ = scale_from_gps(cameras, np.array([0.0, 0.0, 1.0]), gps, rng)
        inside += abs(scale.value - 1.0) < scale.uncertainty
        sigmas.append(scale.uncertainty)
    assert 0.5 * count <= inside <= (1.0 if not kept else 0.93) * count
    assert np.median(sigmas) < 0.12


def test_gps_that_does_not_spread_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    film = _path(count=20)
    world = _world(tmp_path / "s", [film], _points(film, rng), _similarity(2), gps=_to_gps(rng.normal(0, 5, (20, 3))))
    with pytest.raises(InputError, match=r"metric.gps: positions fit within"):
        world.run(tmp_path / "out", gps=True)
    two = np.full((20, 3), np.nan)
    two[:2] = 47.0
    few = _world(tmp_path / "few", [film], _points(film, rng), _similarity(2), gps=two)
    with pytest.raises(InputError, match=r"2 frames have a position \(need 3\)"):
        few.run(tmp_path / "out", gps=True)


@pytest.mark.parametrize("on_ground", [True, False])
def test_distance_between_marked_points(tmp_path: Path, on_ground: bool) -> None:
    film = _path(turn=False, pitch=0.3)
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0)), _similarity(3))
    ends = np.array([[4.0, 1.0, 0.0], [4.5, -1.2, 0.0]]) if on_ground else np.array([[9.0, 1.5, 0.4], [9.5, -1.2, 1.9]])
    (a, b), _ = project(ends, film[0], INTRINSICS)
    (a2, b2), _ = project(ends, film[4], INTRINSICS)
    distance = DistanceConfig(float(np.linalg.norm(ends[0] - ends[1])), "film0/000000", tuple(a), tuple(b))
    if not on_ground:
        distance = dataclasses.replace(distance, frame_b="film0/000004", a2=tuple(a2), b2=tuple(b2))
    metrics = world.run(tmp_path / "out", distance=distance)
    _check_level(world, tmp_path / "out", tilt_deg=0.7, scale=0.02, floor=0.03)
    assert 0 < metrics["scale_uncertainty"] < 0.1


def _hollow(x: np.ndarray) -> np.ndarray:
    """Ground that is 0.6 m lower around x = 20 m than the median of the road."""
    return -0.6 * np.exp(-(((x - 20.0) / 6.0) ** 2))


def _ramp(x: np.ndarray) -> np.ndarray:
    """Ground that rises nearly as steeply as the ray to the mark falls."""
    return 0.12 * np.clip(x - 17.0, 0.0, 5.0)


@pytest.mark.parametrize(
    ("ground", "pitch", "mark", "count", "largest", "sigmas", "spread"),
    [(_hollow, 0.3, 20.0, 1500, 0.02, 2.0, 0.1), (_ramp, 0.2, 22.0, 3000, 0.08, 2.5, 0.25)],
)
def test_a_distance_on_uneven_ground(
    tmp_path: Path,
    ground: Callable[[np.ndarray], np.ndarray],
    pitch: float,
    mark: float,
    count: int,
    largest: float,
    sigmas: float,
    spread: float,
) -> None:
    film = _path(turn=False, pitch=pitch)
    film[:, 2, 3] += ground(film[:, 0, 3])
    points = _points(film, np.random.default_rng(0), on_road=count)
    points[:count, 2] = ground(points[:count, 0])
    at = int(np.argmin(np.abs(film[:, 0, 3] - 16.0)))
    ends = np.array([[mark, 1.0, ground(np.array(mark))], [mark + 0.5, -1.2, ground(np.array(mark + 0.5))]])
    (a, b), _ = project(ends, film[at], INTRINSICS)
    metres = float(np.linalg.norm(ends[0] - ends[1]))
    world = _world(tmp_path / "s", [film], points, _similarity(3))
    metrics = world.run(tmp_path / "out", distance=DistanceConfig(metres, f"film0/{at:06d}", tuple(a), tuple(b)))
    error = umeyama(Cameras.load(tmp_path / "out").positions, film[:, :3, 3]).scale - 1.0
    assert abs(error) < largest and abs(error) < sigmas * metrics["scale_uncertainty"] < spread


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"frame_a": "film0/999999"}, "no registered frame 'film0/999999'"),
        ({"a": (400.0, 10.0)}, r"metric.distance.a = \[400.0, 10.0\]; expected .* 320×240"),
        ({"b": (100.0, 200.0)}, "coincide"),
        ({"a": (100.0, 5.0)}, "above the horizon"),
    ],
)
def test_wrong_distances_are_refused(tmp_path: Path, changes: dict, text: str) -> None:
    film = _path(turn=False)
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0)), _similarity(3))
    right = DistanceConfig(2.0, "film0/000000", (100.0, 200.0), (220.0, 200.0))
    with pytest.raises(InputError, match=text):
        world.run(tmp_path / "out", distance=dataclasses.replace(right, **changes))


def _paint_marker(pose: np.ndarray, corner: np.ndarray, side: float, pattern: np.ndarray) -> np.ndarray:
    """A marker that faces −x with its top-left corner at `corner`, on white, seen from `pose`; supersampled twice."""
    grid = pixel_grid(2 * SIZE[0], 2 * SIZE[1]) / 2
    rays = unproject(grid, INTRINSICS) @ pose[:3, :3].T
    along = (corner[0] - pose[0, 3]) / rays[..., 0]
    hit = pose[:3, 3] + along[..., None] * rays
    u, v = -(hit[..., 1] - corner[1]) / side, -(hit[..., 2] - corner[2]) / side
    cell = len(pattern)
    inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1) & (along > 0)
    at = np.clip((np.stack([v, u]) * cell).astype(int), 0, cell - 1)
    image = np.where(inside, pattern[at[0], at[1]], 220).astype(np.uint8)
    return cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)


def test_a_marker_gives_metres(tmp_path: Path) -> None:
    side = 0.4
    film = _path(turn=False, count=12, pitch=0.05)
    film[:, 0, 3] *= 0.05  # twelve frames within two meters
    film[:, 1, 3] += np.linspace(-0.5, 0.5, 12)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    pattern = cv2.aruco.generateImageMarker(dictionary, 7, 48)
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0)), _similarity(4))
    for i, pose in enumerate(film):
        image = _paint_marker(pose, np.array([4.0, 0.3, 1.4]), side, pattern)
        write_image(world.scene.stage("cameras") / "images" / f"film0/{i:06d}.png", image)
    metrics = world.run(tmp_path / "out", marker=MarkerConfig("DICT_4X4_50", 7, side))
    fit = umeyama(Cameras.load(tmp_path / "out").positions, film[:, :3, 3])
    assert fit.scale == pytest.approx(1.0, abs=0.01)
    assert metrics["marker_frames"] >= 10 and 0.0001 < metrics["scale_uncertainty"] < 0.01
    with pytest.raises(InputError, match="number 8 was found in 0 frames"):
        world.run(tmp_path / "out", marker=MarkerConfig("DICT_4X4_50", 8, side))


def test_a_marker_from_one_pose_is_refused(tmp_path: Path) -> None:
    """As when the camera stands still: the corners cannot be triangulated."""
    film = np.tile(_path(turn=False, count=1, pitch=0.05), (3, 1, 1))
    pattern = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 48)
    points = _points(_path(turn=False, count=12, pitch=0.05), np.random.default_rng(0))
    world = _world(tmp_path / "s", [film], points, _similarity(4), posed=True)
    for i, pose in enumerate(film):
        image = _paint_marker(pose, np.array([4.0, 0.3, 1.4]), 0.4, pattern)
        write_image(world.scene.stage("cameras") / "images" / f"film0/{i:06d}.png", image)
    cameras = Cameras.load(world.scene.stage("cameras"))
    cameras = dataclasses.replace(cameras, camera_to_world=np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(InputError, match=r"metric\.marker: seen from one direction only"):
        scale_from_marker(cameras, MarkerConfig("DICT_4X4_50", 7, 0.4))


def test_the_stated_uncertainty_of_a_marker_holds() -> None:
    """Corners with an error of 0.3 px, seen while passing by: the side is unbiased, and its uncertainty is right."""
    rng, views = np.random.default_rng(4), 4
    square = np.array([[6.0, 1.65, 0.15], [6.0, 1.35, 0.15], [6.0, 1.35, -0.15], [6.0, 1.65, -0.15]])
    poses = np.array([look_at(np.array([x, 0.0, 0.0]), np.array([x + 1.0, 0.0, 0.0])) for x in 0.5 * np.arange(views)])
    lenses = np.tile([500.0, 500.0, 320.0, 180.0], (views, 1))
    pixels = np.array([project(square, pose, lens)[0] for pose, lens in zip(poses, lenses, strict=True)])
    assert fit_square(pixels, square + 0.02 * rng.normal(size=(4, 3)), poses, lenses)[0] == pytest.approx(0.3, rel=1e-6)
    errors, sigmas = [], []
    for _ in range(120):
        start = square + 0.02 * rng.normal(size=(4, 3))
        side, sigma = fit_square(pixels + rng.normal(0, 0.3, pixels.shape), start, poses, lenses)
        errors.append(np.log(side / 0.3))
        sigmas.append(sigma)
    assert 0.58 < np.mean(np.abs(errors) < sigmas) < 0.78
    assert abs(np.mean(errors)) < 0.25 * np.median(sigmas) and np.median(sigmas) < 0.01


def test_metric_poses_are_taken_as_they_are(tmp_path: Path) -> None:
    film = _path()
    shift = Similarity(1.0, np.eye(3), np.array([10.0, -4.0, 2.0]))
    points = _points(film, np.random.default_rng(0))
    world = _world(tmp_path / "s", [film], points, shift, posed=True)
    metrics = world.run(tmp_path / "out", poses_are_metric=True, up="poses")
    placed = Cameras.load(tmp_path / "out").positions
    # Turned and shifted along the ground not at all; the floor is at 0.
    np.testing.assert_allclose(placed[:, :2], film[:, :2, 3] + [10.0, -4.0], atol=1e-9)
    np.testing.assert_allclose(placed[:, 2], film[:, 2, 3], atol=0.02)
    assert metrics["scale"] == 1.0 and metrics["gravity_source"] == "poses"


def test_given_poses_that_lie_on_their_side_are_refused(tmp_path: Path) -> None:
    film = _path()
    tilted = Similarity(1.0, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(2)), tilted, posed=True)
    with pytest.raises(
        InputError, match=r"mean up axis is \d\d° off the z axis of the given poses; expected poses with z up"
    ):
        world.run(tmp_path / "out", up="poses", poses_are_metric=True)


def test_georeferenced_poses_are_refused(tmp_path: Path) -> None:
    """With up = "poses" the world would keep them, and single precision rounds 5,400 km to half a meter."""
    film = _path()
    utm = Similarity(1.0, np.eye(3), np.array([5e5, 5.4e6, 0.0]))
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(2)), utm, posed=True)
    with pytest.raises(InputError, match=r"a camera is 5,400,000 m from the origin \(expected at most 10,000 m\)"):
        world.run(tmp_path / "out", up="poses", poses_are_metric=True)
    assert world.run(tmp_path / "out", poses_are_metric=True)["scale"] == 1.0


def test_two_scales_are_combined_by_their_uncertainties() -> None:
    a, b = Scale(2.0, 0.01), Scale(2.02, 0.03, {"gps_frames": 7})
    both = combine_scales({"camera_height": a, "gps": b})
    assert both.value == pytest.approx(2.0 * 1.01 ** (0.01**2 / (0.01**2 + 0.03**2)), rel=1e-6)
    assert both.uncertainty == pytest.approx(1 / np.hypot(1 / 0.01, 1 / 0.03), rel=1e-9)
    assert both.notes["gps_frames"] == 7 and both.notes["scale_disagreement"] < 1.0
    # Scales that contradict each other make the result less certain, not more.
    apart = combine_scales({"camera_height": a, "gps": Scale(2.4, 0.01)})
    assert apart.uncertainty > 0.05 and apart.notes["scale_disagreement"] > 10.0
    assert combine_scales({"gps": b}) == b
    exact = combine_scales({"poses_are_metric": Scale(1.0, 0.0), "camera_height": Scale(1.1, 0.02)})
    assert (exact.value, exact.uncertainty) == (1.0, 0.0)
    assert exact.notes["scale_disagreement"] == pytest.approx(np.log(1.1) / 0.02)


def test_an_error_of_the_measured_height_is_in_the_uncertainty(tmp_path: Path) -> None:
    film = _path()
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0)), _similarity(2))
    sure = world.run(tmp_path / "a", camera_height=HEIGHT, camera_height_tolerance=0.0)
    unsure = world.run(tmp_path / "b", camera_height=HEIGHT, camera_height_tolerance=0.05)
    assert sure["scale"] == unsure["scale"]
    added = unsure["scale_uncertainty"] ** 2 - sure["scale_uncertainty"] ** 2
    assert added == pytest.approx((0.05 / HEIGHT) ** 2, rel=1e-6)


def test_a_cross_slope_makes_the_scale_less_certain(tmp_path: Path) -> None:
    film = _path(turn=False)
    points = _points(film, np.random.default_rng(0))
    level = _world(tmp_path / "level", [film], points, _similarity(2)).run(tmp_path / "a", camera_height=HEIGHT)
    curb = points.copy()
    curb[:300, 2] += 0.06 * (points[:300, 1] > 0.0)
    raised = _world(tmp_path / "curb", [film], curb, _similarity(2)).run(tmp_path / "b", camera_height=HEIGHT)
    assert raised["scale_uncertainty_of"]["left_against_right"] > 0.01
    assert level["scale_uncertainty_of"]["left_against_right"] < 0.005


def test_up_from_cameras(tmp_path: Path) -> None:
    film = _path(pitch=0.0)
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0)), _similarity(6))
    metrics = world.run(tmp_path / "out", camera_height=HEIGHT, up="cameras")
    _check_level(world, tmp_path / "out", tilt_deg=1.0, scale=0.02, floor=0.05)
    assert metrics["gravity_source"] == "cameras"


# --- errors -----------------------------------------------------------------------------------------------------------


def test_invalid_settings_are_refused_in_one_line(tmp_path: Path) -> None:
    """Already by the stage before, which takes minutes."""
    film = _path(count=10)
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0)), _similarity(0))
    cases: list[tuple[dict, str]] = [
        ({"poses_are_metric": True}, "the input has no poses"),
        ({"camera_height": 1.0, "up": "poses"}, "the input has no poses"),
        ({"odometry": True}, "no source is a bag with odometry"),
        ({"gps": True}, r"0 frames have a position \(need 3\)"),
    ]
    for changes, text in cases:
        config = SceneConfig(metric=MetricConfig(**changes))
        for run in (sfm.run, metric.run):
            with pytest.raises(InputError, match=text) as error:
                run(world.scene, config, tmp_path)
            assert "\n" not in str(error.value)
    assert not (tmp_path / "work").exists()  # no camera was looked for


def test_poses_stay_rigid(tmp_path: Path) -> None:
    film = _path()
    world = _world(tmp_path / "s", [film], _points(film, np.random.default_rng(0)), _similarity(9))
    world.run(tmp_path / "out", camera_height=HEIGHT)
    poses = Cameras.load(tmp_path / "out").camera_to_world
    np.testing.assert_allclose(poses @ inverse_pose(poses), np.broadcast_to(np.eye(4), poses.shape), atol=1e-9)
