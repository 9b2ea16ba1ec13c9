"""Poses, cameras, projection and image files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twin.errors import InputError
from twin.geometry.cameras import Cameras, opencv_to_mujoco, pixel_grid, project, scaled_intrinsics, unproject
from twin.geometry.images import psnr, read_image, ssim, write_image
from twin.geometry.poses import Similarity, inverse_pose, look_at, rotation_angle, umeyama


def _rotation(rng):
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


def _similarity(rng):
    return Similarity(float(rng.uniform(0.2, 5)), _rotation(rng), rng.normal(size=3))


def test_a_similarity_and_its_inverse_cancel():
    rng = np.random.default_rng(0)
    a, x = _similarity(rng), rng.normal(size=(7, 3))
    np.testing.assert_allclose(a.inverse().points(a.points(x)), x, atol=1e-12)


def test_umeyama_recovers_the_similarity_and_never_mirrors():
    rng = np.random.default_rng(1)
    for _ in range(20):
        truth, x = _similarity(rng), rng.normal(size=(9, 3))
        found = umeyama(x, truth.points(x))
        assert found.scale == pytest.approx(truth.scale, rel=1e-9)
        np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
        np.testing.assert_allclose(found.translation, truth.translation, atol=1e-9)
    mirrored = umeyama(x, x * [-1, 1, 1])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1.0)


def test_similarity_moves_poses_with_their_points():
    rng = np.random.default_rng(2)
    pose = look_at(np.array([1.0, 2, 3]), np.array([4.0, 4, 0]))
    similarity, local = _similarity(rng), rng.normal(size=(5, 3))
    world = local @ pose[:3, :3].T + pose[:3, 3]
    moved = similarity.poses(pose)
    np.testing.assert_allclose(
        (similarity.scale * local) @ moved[:3, :3].T + moved[:3, 3], similarity.points(world), atol=1e-12
    )


def test_rotation_angle_is_accurate_near_zero():
    vectors = np.random.default_rng(3).normal(size=(20, 3))
    angles = rotation_angle(Rotation.from_rotvec(vectors).as_matrix())
    np.testing.assert_allclose(np.cos(angles), np.cos(np.linalg.norm(vectors, axis=1)), atol=1e-9)
    tiny = np.array([[1, -1e-9, 0], [1e-9, 1, 0], [0, 0, 1.0]])
    assert rotation_angle(tiny) == pytest.approx(1e-9, rel=1e-6)


def test_project_then_unproject_is_the_identity():
    rng = np.random.default_rng(4)
    pose = look_at(np.array([0.0, 0, 1.5]), np.array([5.0, 1, 1]))
    intrinsics = np.array([210.0, 190, 81, 44])
    pixels, depth = rng.uniform(0, 160, (50, 2)), rng.uniform(0.5, 30, 50)
    local = unproject(pixels, intrinsics) * depth[:, None]
    back, z = project(local @ pose[:3, :3].T + pose[:3, 3], pose, intrinsics)
    np.testing.assert_allclose(back, pixels, atol=1e-9)
    np.testing.assert_allclose(z, depth, atol=1e-9)


def test_look_at_points_the_camera_in_opencv_and_mujoco_axes():
    pose = look_at(np.zeros(3), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(pose[:3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
    mujoco = opencv_to_mujoco(pose)
    np.testing.assert_allclose(mujoco[:3, 2], [-1, 0, 0], atol=1e-12)  # looks along −z
    np.testing.assert_allclose(mujoco[:3, 1], [0, 0, 1], atol=1e-12)  # y is up
    np.testing.assert_allclose(opencv_to_mujoco(mujoco), pose, atol=0)
    np.testing.assert_allclose(inverse_pose(pose) @ pose, np.eye(4), atol=1e-12)


def test_resizing_keeps_rays():
    k = np.array([300.0, 310, 160, 90])
    small = scaled_intrinsics(k, (320, 180), (160, 90))
    np.testing.assert_allclose(unproject(np.array([10.0, 20]), small), unproject(np.array([20.0, 40]), k))
    assert pixel_grid(4, 2).shape == (2, 4, 2)
    np.testing.assert_allclose(pixel_grid(4, 2)[1, 3], [3.5, 1.5])


def _cameras(folder):
    n = 3
    return Cameras(
        names=("a/000000", "a/000001", "b/000000"),
        camera_to_world=np.stack([look_at(np.array([i, 0.0, 1]), np.array([i + 1.0, 0.5, 1])) for i in range(n)]),
        intrinsics=np.tile([100.0, 100, 80, 45], (n, 1)),
        sizes=np.tile([160, 90], (n, 1)),
        lightings=("day", "day", "night"),
        sources=("a", "a", "b"),
        times=np.array([0.0, 0.5, 0.0]),
        held_out=np.array([False, True, False]),
        images=folder / "images",
        masks=None,
    )


def test_cameras_survive_saving_and_renaming(tmp_path):
    partial = tmp_path / "build" / "2_cameras.partial"
    (partial / "images").mkdir(parents=True)
    cameras = _cameras(partial)
    cameras.save(partial)
    partial.rename(tmp_path / "build" / "2_cameras")
    (tmp_path / "build").rename(tmp_path / "moved")
    loaded = Cameras.load(tmp_path / "moved" / "2_cameras")
    assert loaded.images.resolve() == (tmp_path / "moved" / "2_cameras" / "images").resolve()
    assert loaded.names == cameras.names and loaded.lightings == cameras.lightings
    np.testing.assert_array_equal(loaded.camera_to_world, cameras.camera_to_world)
    picked = loaded.select(np.array([False, True, True]))
    assert picked.names == ("a/000001", "b/000000") and picked.held_out.tolist() == [True, False]


def test_masked_pixels_do_not_raise_ssim():
    rng = np.random.default_rng(5)
    reference = rng.random((40, 60, 3))
    image, mask = np.clip(reference + rng.normal(0.0, 0.3, reference.shape), 0.0, 1.0), np.ones((40, 60), bool)
    assert ssim(image, reference, mask) == ssim(image, reference)
    mask[:, :30] = False
    image[~mask] = reference[~mask]
    assert ssim(image, reference, mask) == pytest.approx(ssim(image[:, 30:], reference[:, 30:]), abs=0.05)
    assert np.isnan(ssim(image, reference, np.zeros_like(mask)))


def test_images_round_trip_and_scores(tmp_path):
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    write_image(tmp_path / "x" / "a.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "x" / "a.png"), image)
    reference = np.full((16, 16, 3), 0.5)
    assert psnr(reference + 0.1, reference) == pytest.approx(20.0)
    mask = np.zeros((16, 16), bool)
    mask[0, 0] = True
    assert psnr(np.where(mask[..., None], 0.5, 0.9), reference, mask) == float("inf")
    noisy = np.clip(reference + rng.normal(0, 0.1, reference.shape), 0, 1)
    assert ssim(reference, reference) == pytest.approx(1.0) and ssim(noisy, reference) < 0.9


def test_unreadable_images_are_bad_input(tmp_path):
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.jpg").write_text("no image")
    for name in ("empty.jpg", "text.jpg", "absent.jpg"):
        with pytest.raises(InputError, match=name):
            read_image(tmp_path / name)
