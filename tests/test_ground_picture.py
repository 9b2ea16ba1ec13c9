"""The picture of the ground: colors where they are filmed, from above, and mean colors elsewhere."""

import numpy as np
from test_fit import HEIGHT, WIDTH, K

from twin.assets.ground import Ground
from twin.assets.mesh import ground_picture
from twin.geometry.cameras import Cameras, Rendering
from twin.geometry.poses import look_at
from twin.runtime import set_quiet


class Checks:
    """A renderer of the checkered floor of `test_fit`, with a box on it that hides some."""

    lightings = ("day",)

    def render(self, cameras, lighting, size):
        assert lighting == "day" and size[0] == 640
        pose, scale = cameras.camera_to_world[0], size[0] / WIDTH
        v, u = np.mgrid[: size[1], : size[0]] + 0.5
        ray = np.stack([(u / scale - K[2]) / K[0], (v / scale - K[3]) / K[1], np.ones_like(u)], -1) @ pose[:3, :3].T
        down = ray[..., 2] < -1e-3
        t = np.where(down, -pose[2, 3] / np.where(down, ray[..., 2], -1.0), 1e4)
        x = pose[:3, 3] + t[..., None] * ray
        checks = (np.floor(x[..., 0]) + np.floor(x[..., 1])) % 2
        box = (x[..., 0] > 6.0) & (x[..., 0] < 7.0)
        depth = np.where(box, 0.5 * t, t)
        rgb = np.where(box[..., None], [0.9, 0.0, 0.0], np.repeat(checks[..., None], 3, -1))
        return Rendering(rgb[None].astype("f4"), depth[None].astype("f4"), np.ones((1, *depth.shape), "f4"))


def test_texels_show_what_is_filmed_there_and_nothing_that_stands_before_it(tmp_path):
    set_quiet(True)
    poses = np.array([look_at(np.array([x, 0.0, 1.5]), np.array([x + 4.0, 0.0, 0.0])) for x in (0.0, 1.0, 2.0, 3.0)])
    n = len(poses)
    names = tuple(f"day/{k}" for k in range(n))
    cameras = Cameras(
        names, poses, np.tile(K, (n, 1)), np.tile([WIDTH, HEIGHT], (n, 1)), ("day",) * n, ("day",) * n,
        np.arange(n, dtype=float), np.zeros(n, bool), tmp_path,
    )  # fmt: skip
    shape = 61, 141
    gray = np.full((*shape, 3), 100, np.uint8)
    ground = Ground(np.zeros(shape), np.array([-3.0, -3.0]), 0.1, np.ones(shape, bool), gray)
    picture = ground_picture(Checks(), cameras, ground, "day")
    assert picture.shape == (240, 560, 3)
    row, column = np.indices(picture.shape[:2])
    x, y = -3.0 + (column + 0.5) * 0.025, -3.0 + (row + 0.5) * 0.025
    shown = (picture != 100).any(-1)
    assert not shown[x < 1.0].any()
    inner = shown & (np.abs(x - np.round(x)) > 0.1) & (np.abs(y - np.round(y)) > 0.1)
    wanted = 255 * ((np.floor(x) + np.floor(y)) % 2)
    assert inner.sum() > 20_000 and np.abs(picture[inner][:, 0] - wanted[inner]).max() < 60
    assert not shown[(x > 6.1) & (x < 6.9)].any()
