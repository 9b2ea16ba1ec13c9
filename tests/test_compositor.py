"""The compositor against exact cases: walls before and behind, half-transparent layers, edges, depth, batches."""

import mujoco
import numpy as np
import pytest
from test_baked import LOW, baked, wall

from twin.config import ObstacleConfig
from twin.env.compositor import Compositor, ObjectRenderer
from twin.env.mujoco_renderer import camera_intrinsics
from twin.env.obstacles import add_obstacles
from twin.env.physics import camera_pose
from twin.env.picture_effects import CameraNoise, CameraOptions, soft_clip
from twin.errors import InputError
from twin.geometry.cameras import Viewpoints
from twin.mjcf.husky import ZED2, PixelCamera, add_husky
from twin.mjcf.world import World

SIZE = (64, 36)
FOCAL = 40.0
COLOR = (0.6, 0.3, 0.1)
K = np.array([FOCAL, FOCAL, 32.0, 18.0])
BEHIND = wall(1.0, 11.0)
BEFORE = wall(-2.0, 11.0)


def hall(p):
    """Ground at z = −1 and a wall at x = 2."""
    return np.where((p[..., 2] < -1.0) | (p[..., 0] > 2.0), 9.0, LOW)


def nothing(p):
    return np.full(p.shape[:-1], LOW)


def scene(size=(1.0, 1.0, 1.0)) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A camera at (−3, 0, 0) that looks along x, and one box."""
    spec = mujoco.MjSpec()
    camera = spec.worldbody.add_camera(name="front", pos=(-3, 0, 0), quat=(0.5, 0.5, -0.5, -0.5))
    camera.resolution, camera.focal_pixel, camera.sensor_size = SIZE, (FOCAL, FOCAL), (SIZE[0] * 1e-5, SIZE[1] * 1e-5)
    route = np.column_stack([np.linspace(-3, 3, 7), np.zeros(7), np.full(7, -1.0)])
    told = (ObstacleConfig("it", "box", color=COLOR, size=size),)
    add_obstacles(spec, told, World(route, 1.0, (0, 0, 0, 0), K, None))
    model = spec.compile()
    return model, mujoco.MjData(model)


def put(model, data, x: float, y: float = 0.0, z: float = 0.0) -> mujoco.MjData:
    """The box with the middle of its base at a place."""
    data.mocap_pos[0] = x, y, z
    mujoco.mj_forward(model, data)
    return data


def view(data) -> Viewpoints:
    return Viewpoints.of(camera_pose(data, 0), camera_intrinsics(data.model, 0, SIZE), SIZE)


@pytest.fixture(scope="module")
def box():
    return scene()


@pytest.mark.parametrize(
    "depth", [2.5, 1.25]
)  # small, sampled in one go; and large, where only edges are sampled again
def test_obstacle_before_an_opaque_wall(box, depth):
    model, data = box
    put(model, data, depth - 2.5, 0.0, -0.5)
    field = baked(BEHIND)
    out, alone = Compositor(model, field, SIZE, shaded=False).render([data], "day"), field.render(view(data), "day")
    reach = round(0.5 * FOCAL / depth)  # of its face from the middle of the picture [px]
    inner = np.s_[0, 18 - reach + 1 : 18 + reach - 1, 32 - reach + 1 : 32 + reach - 1]
    outside = np.ones((1, SIZE[1], SIZE[0]), bool)
    outside[0, 18 - reach - 1 : 18 + reach + 1, 32 - reach - 1 : 32 + reach + 1] = False
    assert np.abs(out.rgb[inner] - COLOR).max() < 0.01
    assert np.abs(out.depth[inner] - depth).max() < 1e-3
    assert out.opacity[inner].min() > 0.999
    assert np.array_equal(out.rgb[outside], alone.rgb[outside])
    assert np.array_equal(out.depth[outside], alone.depth[outside])


def test_obstacle_behind_an_opaque_wall(box):
    model, data = box
    put(model, data, 0.0, 0.0, -0.5)
    field = baked(BEFORE)
    out, alone = Compositor(model, field, SIZE, shaded=False).render([data], "day"), field.render(view(data), "day")
    assert np.abs(out.rgb - alone.rgb).max() < 0.04
    assert np.abs(out.depth - alone.depth).max() < 1e-3


def test_depth_error_at_ten_metres(box):
    model, data = box
    put(model, data, 7.5, 0.3, -0.4)
    out = Compositor(model, baked(nothing), SIZE, shaded=False).render([data], "day")
    hit = out.opacity[0] > 0.999
    assert hit.sum() >= 9
    assert np.abs(out.depth[0][hit] - 10.0).max() < 0.01


@pytest.mark.parametrize("raw", [0.0, 0.7, 1.6])
def test_obstacle_behind_a_half_transparent_layer(box, raw):
    model, data = box
    put(model, data, 1.0, 0.0, -0.5)
    field = baked(lambda p: np.where(np.abs(p[..., 0] + 1.0) < 0.501, raw, LOW))
    out = Compositor(model, field, SIZE, shaded=False).render([data], "day")
    front = field.render(view(data), "day", stop=np.full((1, SIZE[1], SIZE[0]), 3.5))
    middle = np.s_[0, SIZE[1] // 2, SIZE[0] // 2]
    held = 1.0 - np.exp(-field.sections[0].layout.density_unit * np.exp(raw) * 1.0)
    assert front.opacity[middle] == pytest.approx(held, abs=0.06)
    expected = front.opacity[middle] * front.rgb[middle] + (1.0 - front.opacity[middle]) * np.array(COLOR)
    assert np.abs(out.rgb[middle] - expected).max() < 0.01
    assert np.abs(out.rgb[middle] - COLOR).max() > 0.05  # the layer is seen
    assert out.depth[middle] == pytest.approx(3.5 if held < 0.45 else 1.7, abs=0.02 if held < 0.45 else 0.5)


@pytest.mark.parametrize(("share", "covers"), [(0.1, 0.0), (0.5, 0.5), (0.9, 1.0)])
def test_coverage_of_edge_pixels(share, covers):
    # The right edge of a face at depth 2 lies `share` into pixel 37.
    edge = (37.0 + share - 32.0) * 2.0 / FOCAL
    model, data = scene((1.0, 1.0, 1.0))
    put(model, data, -0.5, -edge + 0.5, -0.5)
    field = baked(BEHIND)
    out, alone = Compositor(model, field, SIZE, shaded=False).render([data], "day"), field.render(view(data), "day")
    pixel = np.s_[0, 18, 37]
    covered = (out.rgb[pixel] - alone.rgb[pixel]) / (np.array(COLOR) - alone.rgb[pixel])
    assert covered == pytest.approx(np.full(3, covers), abs=0.02)
    assert np.abs(out.rgb[0, 18, 36] - COLOR).max() < 0.01
    assert np.array_equal(out.rgb[0, 18, 38], alone.rgb[0, 18, 38])


def test_coverage_of_subpixel_sizes():
    """Sums over an edge's row resolve sizes to a quarter of a pixel."""
    field = baked(BEHIND)
    widths = []
    for edge in (0.30, 0.325, 0.35):
        model, data = scene((1.0, 2 * edge, 1.0))
        put(model, data, -0.5, 0.0, -0.5)
        out, alone = Compositor(model, field, SIZE, shaded=False).render([data], "day"), field.render(view(data), "day")
        row = (out.rgb[0, 18] - alone.rgb[0, 18]) / (np.array(COLOR) - alone.rgb[0, 18])
        widths.append(row.mean(1).sum())
    assert widths == pytest.approx([2 * edge * FOCAL / 2.0 for edge in (0.30, 0.325, 0.35)], abs=0.6)


def test_obstacle_out_of_view_changes_nothing(box):
    model, data = box
    field = baked(hall)
    overlay = Compositor(model, field, SIZE)
    for place in ((-6.0, 0.0, 0.0), (0.0, 9.0, 0.0), (0.0, 0.0, -100.0)):
        put(model, data, *place)
        out, alone = overlay.render([data], "night"), field.render(view(data), "night")
        assert np.array_equal(out.rgb, alone.rgb) and np.array_equal(out.depth, alone.depth)


def test_a_shadow_is_drawn_while_its_obstacle_is_out_of_view(box, monkeypatch):
    model, data = box
    overlay = Compositor(model, baked(hall), SIZE)
    put(model, data, 0.0, 9.0)
    darkened = []
    monkeypatch.setattr(overlay, "_irradiance", lambda *_: "light")
    monkeypatch.setattr(overlay._shadows, "darken", lambda *given: darkened.append(given[-1]))
    overlay.render([data], "night")
    assert darkened == ["light"]


def test_irradiance_without_ground_is_refused(box):
    with pytest.raises(InputError, match="no ground"):
        Compositor(box[0], baked(nothing), SIZE)


def test_batch_equals_single_renderings(box):
    model, _ = box
    datas = [put(model, mujoco.MjData(model), x, y, -0.5) for x, y in ((0.0, 0.0), (1.0, 0.6), (-9.0, 0.0))]
    field = baked(hall)
    lightings = ["day", "night", field.embedding("day:night:0.5")]
    together = Compositor(model, field, SIZE, max_envs=3).render(datas, lightings)
    single = Compositor(model, field, SIZE)
    for k, (data, lighting) in enumerate(zip(datas, lightings, strict=True)):
        alone = single.render([data], lighting)
        for name in ("rgb", "depth", "opacity"):
            assert np.array_equal(getattr(alone, name)[0], getattr(together, name)[k]), name


def test_the_camera_of_the_model_is_that_of_the_pictures():
    for camera in (ZED2, PixelCamera((70.0, 71.0, 78.0, 47.5), (160, 90))):
        spec = mujoco.MjSpec()
        add_husky(spec, camera=camera)
        model = spec.compile()
        index = model.camera("front").id
        for size in (160, 90), (320, 180):
            assert camera_intrinsics(model, index, size) == pytest.approx(camera.resized(size).intrinsics, rel=1e-5)


def test_the_robot_does_not_see_itself_in_its_usual_camera():
    spec = mujoco.MjSpec()
    add_husky(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    index = model.camera("front").id
    view = ObjectRenderer(model, index, (160, 90))
    assert len(view.geoms) > 20
    assert view.visible_mask(data, camera_pose(data, index)) is None


def test_a_perfect_camera_changes_nothing_and_the_same_seed_repeats(box):
    model, data = box
    put(model, data, 0.0, 0.0, -0.5)
    overlay = Compositor(model, baked(hall), SIZE)
    sharp = overlay.render([data], "day")
    perfect = overlay.render([data], "day", [CameraNoise(CameraOptions(), np.random.default_rng(0))])
    assert np.array_equal(sharp.rgb, perfect.rgb)
    options = CameraOptions(vibration=0.5, exposure=0.2, shutter=0.02)
    films = []
    for seed in (1, 1, 2):
        effects = CameraNoise(options, np.random.default_rng(seed))
        film = []
        for step in range(3):
            data.time = 0.1 * step
            film.append(overlay.render([data], "day", [effects]).rgb)
        films.append(np.stack(film))
    data.time = 0.0
    assert np.array_equal(films[0], films[1]) and not np.array_equal(films[0], films[2])


def test_a_turning_camera_smears_along_its_turn():
    from twin.env.picture_effects import motion_blur
    from twin.geometry.cameras import pixel_grid, unproject

    rays = unproject(pixel_grid(*SIZE), K)
    rgb, depth = np.zeros((SIZE[1], SIZE[0], 3), np.float32), np.full((SIZE[1], SIZE[0]), 5.0, np.float32)
    rgb[18, 32] = 1.0
    still = motion_blur(rgb, depth, np.eye(4), np.eye(4), 0.5, rays, K, 5)
    assert np.allclose(still, rgb, atol=1e-5)
    angle = 8.0 / FOCAL  # about 8 px
    before = np.eye(4)
    before[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    out = motion_blur(rgb, depth, np.eye(4), before, 0.5, rays, K, 9)
    lit = np.flatnonzero(out[18, :, 0] > 0.02)
    assert 3 <= np.ptp(lit) <= 6  # half of the way
    assert out.sum() == pytest.approx(rgb.sum(), rel=0.1)
    assert np.abs(out[[16, 20]]).max() < 1e-3


def test_highlights_roll_off_instead_of_being_cut():
    bright = np.array([0.0, 0.5, 0.75, 1.0, 3.0], np.float32)
    out = soft_clip(bright)
    assert np.array_equal(out[:3], bright[:3]) and (np.diff(out) > 0).all() and out[-1] < 1.0
