"""Splats lie on the surfaces of the views and render like them in MuJoCo; their files hold what was written."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from twin.assets.gaussians import (
    FAR,
    gaussians_by_lighting,
    gaussians_of_views,
    read_ply,
    select_sharpest,
    sky_on_surfaces,
)
from twin.assets.views import Views
from twin.errors import InputError
from twin.geometry.cameras import opencv_to_mujoco
from twin.geometry.poses import look_at

SIZE = (60, 40)
FOCAL = 40.0


def floor_views(eyes=None) -> Views:
    """Views of the floor z = 0 in quarters of four colors, from above at a slant."""
    poses = np.array([look_at(np.array(eye), np.array([0.0, 0.1, 0.0])) for eye in eyes or EYES])
    k = np.tile([FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2], (len(poses), 1))
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    rays = np.stack([(u - k[0, 2]) / FOCAL, (v - k[0, 3]) / FOCAL, np.ones_like(u)], -1)
    depth, rgb = [], []
    for pose in poses:
        world = rays @ pose[:3, :3].T
        z = -pose[2, 3] / world[..., 2]
        points = pose[:3, 3] + world * z[..., None]
        depth.append(z)
        rgb.append(_colour(points))
    depth = np.array(depth, np.float32)
    return Views(poses, k, np.array(rgb), depth, np.ones_like(depth), np.ones_like(depth))


def _colour(points) -> np.ndarray:
    x, y = points[..., 0] > 0, points[..., 1] > 0
    return np.stack([np.where(x, 220, 40), np.where(y, 200, 60), np.where(x ^ y, 180, 90)], -1).astype(np.uint8)


EYES = [(0.0, -0.8, 2.0), (0.6, -0.5, 1.5)]


def test_gaussians_are_flat_disks_on_the_surface() -> None:
    splats, pixel = gaussians_of_views(floor_views(), 100.0)
    assert np.abs(splats.positions[:, 2]).max() < 1e-4
    w, x, y, z = splats.rotations.T
    normal = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    assert np.abs(np.abs(normal[:, 2]) - 1).max() < 1e-3
    assert (splats.scales[:, 2] < splats.scales[:, 1]).all() and (splats.scales[:, 1] <= splats.scales[:, 0]).all()
    assert (splats.rgb == floor_views().rgb.reshape(-1, 3)[pixel] / np.float32(255.0)).all()
    away = np.abs(splats.positions[:, :2]).min(1) > 0.1  # from where colors change
    assert np.abs(splats.rgb - _colour(splats.positions) / 255.0)[away].max() < 1e-3


def test_the_sharpest_point_of_a_cell_is_kept() -> None:
    points = np.array([[0.001, 0, 0], [0.002, 0, 0], [0.004, 0.001, 0], [0.5, 0, 0]])
    assert select_sharpest(points, np.array([0.009, 0.005, 0.03, 0.03])).tolist() == [1, 3]
    rng = np.random.default_rng(0)
    points, width = rng.uniform(0, 0.3, (3000, 3)), rng.uniform(0.005, 0.08, 3000)
    kept = select_sharpest(points, width)
    level = np.maximum(np.ceil(np.log2(width / 0.01)), 0)
    for n in range(4):
        cells = np.floor((points[kept] - points.min(0)) / (0.01 * 2**n)).astype(int)[level[kept] <= n]
        mine = cells[level[kept][level[kept] <= n] == n]
        assert all((cells == cell).all(1).sum() == 1 for cell in mine)


def test_splats_look_like_the_views_in_mujocos_renderer(tmp_path) -> None:
    views = floor_views()
    (tmp_path / "floor.ply").write_bytes(gaussians_of_views(views, 100.0)[0].to_ply())
    shown = draw(read_ply(tmp_path / "floor.ply"), views.camera_to_world[0])
    error = np.abs(shown - views.rgb[0])[4:-4, 4:-4].mean()
    assert error < 12.0, error


def draw(splats, camera_to_world) -> np.ndarray:
    """The splats in the renderer of mujoco_warp, from the pose of a view of `floor_views`."""
    import mujoco_warp as mjw

    spec = mujoco.MjSpec()
    pose = opencv_to_mujoco(camera_to_world)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, pose[:3, :3].ravel())
    fovy = 2 * np.degrees(np.arctan(SIZE[1] / 2 / FOCAL))
    spec.worldbody.add_camera(name="eye", pos=pose[:3, 3], quat=quaternion, fovy=fovy)
    spec.worldbody.add_body(pos=[0, 0, -30]).add_geom(size=[0.1, 0.1, 0.1])
    spec.stat.extent = 10.0
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    device_model, device_data = mjw.put_model(model), mjw.put_data(model, data)
    context = mjw.create_render_context(model, cam_res=SIZE, render_rgb=True, **splats.render_settings())
    mjw.refit_bvh(device_model, device_data, context)
    mjw.render(device_model, device_data, context)
    packed = context.rgb_data.numpy()[0].reshape(SIZE[::-1])
    return np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(float)


def test_lightings_share_all_but_the_colors() -> None:
    day = floor_views()
    night = Views(**{**vars(day), "rgb": day.rgb // 3})
    splats = gaussians_by_lighting({"day": day, "night": night})
    for name in ("positions", "rotations", "scales", "opacity"):
        assert (getattr(splats["day"], name) == getattr(splats["night"], name)).all()
    assert splats["night"].rgb.max() < 0.35 < splats["day"].rgb.max()


def test_a_ply_is_read_as_it_was_written(tmp_path) -> None:
    path = tmp_path / "floor.ply"
    splats = gaussians_of_views(floor_views(), 100.0)[0]
    path.write_bytes(splats.to_ply())
    again = read_ply(path)
    for name, exact in vars(splats).items():
        assert np.allclose(getattr(again, name), exact, rtol=1e-5, atol=1e-6), name


def _sky_views(gap_rgb) -> list[Views]:
    """Two lightings of one view of a sky, a floor, and a crown; half the crown has the sky's color plus `gap_rgb`."""
    one = floor_views([(0.0, -2.0, 0.3)])
    one.camera_to_world[0] = look_at(np.array([0.0, -2.0, 0.3]), np.array([0.0, 0.0, 0.8]))
    rays = one.points(0, np.ones(SIZE[::-1])) - one.camera_to_world[0, :3, 3]
    up = rays[..., 2] > 0.0
    depth = np.where(up, 10 * FAR, 20.0).astype(np.float32)
    crown = up & (np.arange(SIZE[0]) > 30)
    depth[crown] = 8.0
    out = []
    for sky in ((140, 180, 240), (160, 160, 165)):
        blend = np.array(sky) - 40.0 * np.clip(rays[..., 2:], 0, 1)  # darker towards the zenith
        rgb = np.where(up[..., None], blend, 90.0)
        rgb[crown] = (30, 70, 20)
        gap = crown & (np.arange(SIZE[0]) > 45)
        rgb[gap] = blend[gap] + gap_rgb
        out.append(Views(**{**vars(one), "rgb": rgb.astype(np.uint8)[None], "depth": depth[None]}))
    return out


def test_the_skys_color_on_a_crown_is_found() -> None:
    views = _sky_views(gap_rgb=(6, -4, 5))
    found = sky_on_surfaces(views)[0]
    near = views[0].depth[0] == 8.0
    gap = near & (np.arange(SIZE[0]) > 45)
    assert found[gap].all() and not found[~gap].any()
    assert not sky_on_surfaces(_sky_views(gap_rgb=(-90, -60, -80))).any()
    # A gray wall has the color of an overcast sky, but not of the blue one.
    gray = [views[0], views[1]]
    gray[0].rgb[0][gap] = views[1].rgb[0][gap]
    assert not sky_on_surfaces(gray)[0][gap].any() and sky_on_surfaces(gray[1:])[0][gap].all()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda b: b"solid" + b, "is not a ply file"),
        (lambda b: b[:3000], "is cut off"),
        (lambda b: b.replace(b"binary_little_endian", b"ascii"), "has another format"),
        (lambda b: b.replace(b"float opacity", b"float opakity"), "lacks ['opacity']"),
        (lambda b: b.replace(b"float opacity", b"list uchar int opacity"), "is unknown"),
        (lambda b: b.replace(b"float f_dc_1", b"float f_dc_0"), "lacks"),
        (lambda b: b.replace(b"element vertex ", b"element vertex -"), "does not begin with its vertices"),
        (lambda b: b.replace(b"element vertex ", b"element vertex 9999999999"), "is cut off"),
        (lambda b: b[: b.index(b"end_header\n") + 11] + b"\xff" * (len(b) - b.index(b"end_header\n") - 11), "no splat"),
    ],
)
def test_damaged_files_are_refused(tmp_path, spoil, words) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(spoil(gaussians_of_views(floor_views(), 100.0)[0].to_ply()))
    with pytest.raises(InputError) as raised:
        read_ply(path)
    assert words in str(raised.value)


def test_views_that_show_nothing_are_refused_in_one_line():
    views = floor_views()
    with pytest.raises(InputError, match="no surface in any of the views"):
        gaussians_of_views(replace(views, depth=np.zeros_like(views.depth)), 50.0)
