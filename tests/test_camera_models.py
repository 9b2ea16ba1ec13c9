"""Undistortion of images to a pinhole."""

from pathlib import Path

import numpy as np
import pytest

from twin.capture.camera_models import Lens, undistortion, write_pinhole_image
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.images import psnr, read_image, write_image


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [300.0, 160.0, 120.0, -0.15]),
        ("OPENCV", [300.0, 290.0, 165.0, 118.0, 0.08, -0.02, 0.002, -0.001]),
        ("OPENCV_FISHEYE", [200.0, 200.0, 160.0, 120.0, 0.01, 0.0, 0.0, 0.0]),
    ],
)
def test_undistorted_pixels_see_along_the_same_ray(model: str, params: list[float]) -> None:
    lens = Lens(model, tuple(params), 320, 240)
    pinhole, mapping = undistortion(lens)
    assert mapping is not None and mapping.shape == (240, 320, 2)
    assert mapping.min() >= -0.51 and (mapping.reshape(-1, 2).max(0) <= [319.51, 239.51]).all()  # nothing to fill in
    rays = np.asarray(lens.camera.cam_from_img(mapping.reshape(-1, 2).astype(np.float64) + 0.5))
    wanted = unproject(pixel_grid(320, 240), pinhole.intrinsics).reshape(-1, 3)[:, :2]
    np.testing.assert_allclose(rays, wanted, atol=2e-4)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [640.0, 640.0, 360.0, -0.28]),
        ("OPENCV", [640.0, 640.0, 640.0, 360.0, -0.35, 0.0, 0.0, 0.0]),
    ],
)
def test_no_pixel_lies_where_the_distortion_runs_back(model: str, params: list[float]) -> None:
    """Beyond a radius of 1 / √(−3 k) a larger angle is nearer to the center, where other things are seen."""
    lens = Lens(model, tuple(params), 1280, 720)
    pinhole, mapping = undistortion(lens)
    assert mapping is not None
    corner = unproject(np.array([[0.5, 0.5]]), pinhole.intrinsics)[0, :2]
    assert np.linalg.norm(corner) < 1.0 / np.sqrt(-3.0 * params[4 if model == "OPENCV" else 3])
    assert (np.diff(mapping[0, :640, 0]) > 0.0).all() and (np.diff(mapping[:360, 0, 1]) > 0.0).all()


def test_undistortion_undoes_distortion(tmp_path: Path) -> None:
    lens = Lens("SIMPLE_RADIAL", (300.0, 160.0, 120.0, 0.1), 320, 240)

    def picture(rays: np.ndarray) -> np.ndarray:
        return (127 + 60 * np.sin(9 * rays[..., 0]) + 60 * np.cos(7 * rays[..., 1])).astype(np.uint8)

    raw_rays = np.asarray(lens.camera.cam_from_img(pixel_grid(320, 240).reshape(-1, 2))).reshape(240, 320, 2)
    write_image(tmp_path / "raw.png", picture(raw_rays))
    pinhole, mapping = undistortion(lens)
    write_pinhole_image(tmp_path / "raw.png", tmp_path / "a" / "flat.png", mapping)
    expected = picture(unproject(pixel_grid(320, 240), pinhole.intrinsics)[..., :2])
    flat = read_image(tmp_path / "a" / "flat.png")[..., 0]
    assert psnr(flat / 255.0, expected / 255.0) > 45.0


def test_a_pinhole_image_is_left_alone(tmp_path: Path) -> None:
    lens = Lens("PINHOLE", (300.0, 301.0, 160.0, 120.0), 320, 240)
    assert undistortion(lens) == (lens, None)
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    write_image(tmp_path / "raw.png", image)
    write_pinhole_image(tmp_path / "raw.png", tmp_path / "flat.png", None)
    np.testing.assert_array_equal(read_image(tmp_path / "flat.png"), image)
