"""Export: splats lie on the surfaces of the views and render like them in MuJoCo; colors of the mesh."""

import mujoco
import numpy as np
import pytest

from twin import export
from twin.assets.views import Views
from twin.export import Gaussians, gaussians_of_views, select_sharpest
from twin.geometry.cameras import opencv_to_mujoco
from twin.geometry.poses import look_at

SIZE = (60, 40)
FOCAL = 40.0


def _views(eyes) -> Views:
    """Views of the floor z = 0 in quarters of four colors, from above at a slant."""
    poses = np.array([look_at(np.array(eye), np.array([0.0, 0.1, 0.0])) for eye in eyes])
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
    splats = gaussians_of_views(_views(EYES), 100.0)
    assert np.abs(splats.positions[:, 2]).max() < 1e-4
    w, x, y, z = splats.rotations.T
    normal = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    assert np.abs(np.abs(normal[:, 2]) - 1).max() < 1e-3
    assert (splats.scales[:, 2] < splats.scales[:, 1]).all() and (splats.scales[:, 1] <= splats.scales[:, 0]).all()
    away = np.abs(splats.positions[:, :2]).min(1) > 0.1  # from where colours change
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


def test_splats_look_like_the_views_in_mujocos_renderer() -> None:
    import mujoco_warp as mjw

    views = _views(EYES)
    splats = _read(gaussians_of_views(views, 100.0).to_ply())
    spec = mujoco.MjSpec()
    pose = opencv_to_mujoco(views.camera_to_world[0])
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
    context = mjw.create_render_context(
        model,
        cam_res=SIZE,
        render_rgb=True,
        splat_position=splats.positions,
        splat_rotation=splats.rotations,
        splat_scale=splats.scales,
        splat_rgba=np.concatenate([splats.rgb, splats.opacity[:, None]], 1).astype(np.float32),
    )
    mjw.refit_bvh(device_model, device_data, context)
    mjw.render(device_model, device_data, context)
    packed = context.rgb_data.numpy()[0].reshape(SIZE[::-1])
    shown = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], -1).astype(float)
    error = np.abs(shown - views.rgb[0])[4:-4, 4:-4].mean()
    assert error < 12.0, error


def _read(ply: bytes) -> Gaussians:
    """The file as a viewer reads it."""
    head, _, body = ply.partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in head.splitlines() if line.startswith(b"property")]
    d = np.frombuffer(body, [(name, "<f4") for name in names])
    assert f"element vertex {len(d)}".encode() in head

    def columns(*wanted):
        return np.stack([d[name] for name in wanted], -1)

    return Gaussians(
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        columns("f_dc_0", "f_dc_1", "f_dc_2") * 0.28209479177387814 + 0.5,
        1.0 / (1.0 + np.exp(-d["opacity"])),
    )


def test_vertices_have_the_colors_of_the_views() -> None:
    vertices = np.array([[0.3, 0.3, 0.0], [-0.3, 0.3, 0.0], [0.3, -0.3, 0.0], [0.3, 0.31, -0.5]])
    colours = export.vertex_colors(_views(EYES), vertices)
    assert np.abs(colours[:3].astype(int) - _colour(vertices[:3])).max() <= 1
    assert (colours[3] == colours[0]).all()  # hidden below the floor: as the nearest seen


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "nothing to write"),
        (["--glb", "absent/a.glb"], "there is no folder absent"),
        (["--ply", "a.ply"], "no scene.toml"),
    ],
)
def test_bad_arguments_are_refused(tmp_path, monkeypatch, capsys, arguments, words) -> None:
    monkeypatch.chdir(tmp_path)
    assert export.main(["nowhere", *arguments]) == 2
    assert words in capsys.readouterr().err and not list(tmp_path.iterdir())
