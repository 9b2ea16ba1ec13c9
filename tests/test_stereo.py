"""Stereo between the frames of a film: accurate on texture, without depth elsewhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import AnalyticField, Box, waves

from twin.geometry.cameras import Cameras, SparsePoints, Viewpoints, pixel_grid, project, unproject
from twin.geometry.images import write_image
from twin.geometry.poses import look_at
from twin.nerf.dataset import TrainingPixels
from twin.nerf.stereo import choose_sources, stereo_depths

WIDTH, HEIGHT = 160, 90
K = np.array([110.0, 110.0, 80.0, 45.0])
PLACE = AnalyticField(boxes=(Box(9.0, 3.0, 2.0, 2.0, 2.5), Box(14.0, -2.5, 1.0, 3.0, 4.0)), amplitude=0.0)


pytestmark = pytest.mark.usefixtures("quiet")


def pattern(points: np.ndarray) -> np.ndarray:
    """Gray in [0, 1] of places (..., 3)."""
    return 0.5 + waves(points, 40, 0.06)


def poses(n: int, lateral: float = 0.0) -> np.ndarray:
    eyes = np.stack([np.linspace(0.0, 0.6 * (n - 1), n), np.full(n, lateral), np.full(n, 1.2)], 1)
    return np.stack([look_at(eye, eye + np.array([5.0, 0.0, -0.7])) for eye in eyes])


def film(folder: Path, n: int = 8, paint=None) -> Cameras:
    """A drive past two boxes; `paint(i, places)` replaces the pattern's gray in frame i."""
    pose = poses(n)
    depth = PLACE.render(Viewpoints.of(pose, K, (WIDTH, HEIGHT)), "day").depth
    names = tuple(f"day/{i:06d}" for i in range(n))
    (folder / "day").mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        rays = unproject(pixel_grid(WIDTH, HEIGHT), K)
        places = (rays * depth[i][..., None]) @ pose[i, :3, :3].T + pose[i, :3, 3]
        gray = (paint or (lambda i, p: pattern(p)))(i, places)
        picture = np.repeat((np.clip(gray, 0, 1) * 255).astype(np.uint8)[..., None], 3, -1)
        write_image(folder / f"{name}.png", picture)
    return Cameras(
        *(names, pose, np.tile(K, (n, 1)), np.tile([WIDTH, HEIGHT], (n, 1)), ("day",) * n, ("day",) * n),
        *(np.arange(n) / 2.0, np.zeros(n, bool), folder),
    )


def points_of(cameras: Cameras, m: int = 150) -> SparsePoints:
    """Points on the ground, listed for every frame."""
    rng = np.random.default_rng(0)
    xyz = np.stack([rng.uniform(2.0, 14.0, m), rng.uniform(-3.0, 3.0, m), np.zeros(m)], 1)
    point, frame = (k.ravel() for k in np.meshgrid(np.arange(m), np.arange(len(cameras)), indexing="ij"))
    return SparsePoints(xyz, np.zeros((m, 3), np.uint8), np.zeros(m), point, frame)


def true_distance(cameras: Cameras, found) -> np.ndarray:
    """True distance [m] along the rays of depth supervision."""
    out = np.empty(len(found.frame))
    for i in np.unique(found.frame):
        mine = found.frame == i
        pose = cameras.camera_to_world[i]
        rays = unproject(found.pixel[mine], K)
        depth, _ = PLACE._cast(pose[:3, 3], rays @ pose[:3, :3].T)
        out[mine] = depth * np.linalg.norm(rays, axis=1)
    return out


def test_stereo_finds_ground_and_boxes(tmp_path):
    cameras = film(tmp_path)
    pixels = TrainingPixels(cameras, points_of(cameras), WIDTH)
    found, facts = stereo_depths(pixels, 0, "cpu")
    true = true_distance(cameras, found)
    error = np.abs(found.distance / true - 1.0)
    assert facts["frames"] == len(cameras)
    assert facts["share"] > 0.3
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.9) < 0.04
    pose = cameras.camera_to_world[found.frame]
    rays = unproject(found.pixel, K)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    places = pose[:, :3, 3] + np.einsum("nij,nj->ni", pose[:, :3, :3], rays) * found.distance[:, None]
    standing = places[:, 2] > 0.3
    assert standing.sum() > 500
    assert np.median(np.abs(PLACE.distance_to_obstacles(places[standing]))) < 0.05


@pytest.mark.parametrize("kind", ["noise", "plain"])
def test_stereo_finds_nothing_without_matching_texture(tmp_path, kind):
    def paint(i, places):
        return np.random.default_rng(i).random(places.shape[:2]) if kind == "noise" else np.full(places.shape[:2], 0.5)

    cameras = film(tmp_path, paint=paint)
    _, facts = stereo_depths(TrainingPixels(cameras, points_of(cameras), WIDTH), 0, "cpu")
    assert facts["share"] < 0.01


def test_stereo_is_equal_on_any_number_of_cores(tmp_path, monkeypatch):
    cameras = film(tmp_path, 5)
    pixels = TrainingPixels(cameras, points_of(cameras), WIDTH)
    first, _ = stereo_depths(pixels, 4, "cpu")
    monkeypatch.setattr("twin.nerf.buffers.available_cores", lambda: 1)
    second, _ = stereo_depths(pixels, 4, "cpu")
    assert np.array_equal(first.distance, second.distance)
    assert np.array_equal(first.pixel, second.pixel)


def test_masked_pixels_get_no_depth(tmp_path):
    cameras = film(tmp_path / "pictures")
    mask = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    for name in cameras.names:
        (tmp_path / "masks" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "masks" / f"{name}.png", mask)
    cameras = replace(cameras, masks=tmp_path / "masks")
    found, facts = stereo_depths(TrainingPixels(cameras, points_of(cameras), WIDTH), 0, "cpu")
    assert facts["sightings"] > 0
    assert found.pixel[:, 0].min() > WIDTH // 2


def test_no_stereo_without_sparse_points(tmp_path):
    cameras = film(tmp_path, 4)
    found, facts = stereo_depths(TrainingPixels(cameras, SparsePoints.empty(), WIDTH), 0, "cpu")
    assert len(found.frame) == 0
    assert facts["sightings"] == 0


def test_sources_are_of_the_same_film_and_degrees_apart(tmp_path):
    cameras = film(tmp_path, 8)
    mixed = replace(cameras, sources=("a", "b") * 4)
    chosen = choose_sources(mixed, mixed.intrinsics, np.full(8, 6.0))
    for i, sources in enumerate(chosen):
        assert len(sources) > 0
        assert all(mixed.sources[j] == mixed.sources[i] and j != i for j in sources)
    # At 60 m, steps of 0.6 m turn the view of a point by less than a degree: the farthest frames are the best.
    far = choose_sources(cameras, cameras.intrinsics, np.full(8, 60.0))
    assert far[0][0] == 7


def test_homography_agrees_with_projection(tmp_path):
    """A pixel's image under the homography is the projection of its point."""
    from twin.nerf.stereo import _mappings

    cameras = film(tmp_path, 4)
    pixels = TrainingPixels(cameras, points_of(cameras), WIDTH)
    there, back = _mappings(pixels, 0, np.array([1, 3], np.int32))
    pixel, depth = np.array([[30.5, 70.5], [120.5, 60.5]]), np.array([3.0, 5.0])
    place = unproject(pixel, K) * depth[:, None] @ cameras.camera_to_world[0, :3, :3].T + cameras.positions[0]
    homogeneous = np.column_stack([pixel, np.ones(2)])
    for k, j in enumerate((1, 3)):
        h = homogeneous @ there[k, :, :3].T + there[k, :, 3] / depth[:, None]
        expected, z = project(place, cameras.camera_to_world[j], K)
        assert np.allclose(h[:, :2] / h[:, 2:], expected)
        assert np.allclose(h[:, 2] * depth, z)
        h = np.column_stack([expected, np.ones(2)]) @ back[k, :, :3].T + back[k, :, 3] / z[:, None]
        assert np.allclose(h[:, :2] / h[:, 2:], pixel)
