"""Baked field: the march against formulas and against a slow reference, batches, sizes, files."""

import subprocess
import sys

import numpy as np
import pytest
from devices import DEVICES

from twin.errors import InputError
from twin.geometry.cameras import FAR, Viewpoints, intrinsics_for_size, pixel_grid, unproject
from twin.geometry.poses import look_at
from twin.nerf.baked import BakedField
from twin.nerf.baked_arrays import BakedSection, BrickLayout, brick_indices, skip_distances
from twin.nerf.kernels import bricks
from twin.nerf.lightings import Lightings

SIZE = (40, 24)
K = np.array([30.0, 30.0, 20.0, 12.0])
LAYOUT = BrickLayout((0.0, 0.0, 0.0), (4.0, 4.0, 2.0), 0.05, 0.5, (10, 10, 5), (8, 8, 4))
LOW, STEP = -6.0, 18.0 / 255.0


pytestmark = pytest.mark.usefixtures("quiet")


def places(layout: BrickLayout, near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Positions of the bricks' samples [m], shape (s, 729, 3)."""
    grid = np.stack(np.meshgrid(*[np.arange(bricks.CORNERS)] * 3, indexing="ij"), -1).reshape(-1, 3) / bricks.CELLS
    unit = [((near[:, None] + grid) / layout.near_shape * 2 - 1), ((far[:, None] + grid) / layout.far_shape * 4 - 2)]
    out = np.concatenate(unit)
    m = np.abs(out).max(-1, keepdims=True)
    # The contraction's inverse: |u| = 1 / (2 − |c|).
    out = np.where(m > 1, out / np.maximum(m, 1e-9) / np.maximum(2 - m, 0.05), out)
    return out * layout.half + layout.centre


def networks(dim: int = 4) -> dict[str, np.ndarray]:
    """Networks that map the first three features to color and ignore the `dim` numbers of the appearance."""

    def zeros(*shape: int) -> np.ndarray:
        return np.zeros(shape, np.float32)

    p = {"head.0": zeros(15 + 16 + dim, 8), "head.1": np.eye(8, dtype=np.float32), "head.2": zeros(8, 3)}
    p["head.0"][:3, :3] = np.eye(3)
    p["head.2"][:3] = np.eye(3) * 4.0
    p |= {"head.0.bias": zeros(8), "head.1.bias": zeros(8), "head.2.bias": np.full(3, -2.0, np.float32)}
    p |= {"backdrop.0": zeros(16, 4), "backdrop.0.bias": zeros(4), "backdrop.1": zeros(4, 15)}
    return {f"network.{name}": value for name, value in p.items()}


def baked(raw, layout: BrickLayout = LAYOUT) -> BakedField:
    """A field with all bricks stored: raw density by a formula of positions (..., 3) [m], features of waves."""
    near = np.argwhere(np.ones(layout.near_shape, bool)).astype(np.int32)
    far = np.argwhere(np.ones(layout.far_shape, bool)).astype(np.int32)
    inside = ((far / layout.far_shape >= 0.25) & ((far + 1) / layout.far_shape <= 0.75)).all(1)
    far = far[~inside]
    at = places(layout, near, far)
    values = np.empty((*at.shape[:2], 16))
    values[..., 0] = np.clip(raw(at), LOW, LOW + 255 * STEP)
    for c in range(15):
        values[..., c + 1] = np.sin(at @ np.array([1.0 + 0.2 * c, 0.7 - 0.1 * c, 0.5]))
    low, step = np.r_[LOW, np.full(15, -1.0)], np.r_[STEP, np.full(15, 2.0 / 255)]
    codes = np.rint((values - low) / step).astype(np.uint8)
    arrays = {
        "near": near,
        "far": far,
        "features": codes,
        "low": low.astype(np.float32),
        "step": step.astype(np.float32),
        **networks(),
    }
    names = Lightings(("day", "night"), np.eye(2, 4, dtype=np.float32), ("day/0",), np.ones((1, 4), np.float32))
    return baked_of_arrays(layout, names, arrays | skip_distances(layout, arrays))


def baked_of_arrays(layout: BrickLayout, lightings: Lightings, arrays) -> BakedField:
    """A baked field of one section from all its arrays, those of the networks included."""
    shared = {name: array for name, array in arrays.items() if name.startswith(("network.", "probes."))}
    section = {name: array for name, array in arrays.items() if name not in shared}
    return BakedField([BakedSection(layout, section)], lightings, shared)


def camera_at(eye=(-3.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)) -> np.ndarray:
    return look_at(np.array(eye), np.array(at))[None]


def wall(x: float, raw: float):
    """Raw density `raw` beyond x [m], none before."""
    return lambda p: np.where(p[..., 0] >= x, raw, LOW)


def test_opaque_wall_renders_at_its_distance():
    out = baked(wall(1.0, 11.0)).render(Viewpoints.of(camera_at(), K[None], SIZE), "day")
    cell = LAYOUT.near_side[0] / bricks.CELLS
    assert out.opacity.min() > 0.98
    assert np.abs(out.depth - 4.0).max() < 1.5 * cell


@pytest.mark.parametrize("x", [-3.0, 0.0, 3.5])
def test_a_wall_just_beyond_an_empty_near_box_blocks_every_ray(x):
    field = baked(lambda p: np.where((p[..., 0] >= 4.3) & (p[..., 0] < 5.5), 11.0, LOW))
    out = field.render(Viewpoints.of(camera_at((x, 0.0, 0.0), (8.0, 0.0, 0.0)), K[None], SIZE), "day")
    assert out.opacity.min() > 0.98
    assert np.abs(out.depth - (4.3 - x)).max() < 0.3


def test_empty_space_is_transparent_and_far():
    out = baked(lambda p: np.full(p.shape[:-1], LOW)).render(Viewpoints.of(camera_at(), K[None], SIZE), "day")
    assert out.opacity.max() < 0.05
    assert (out.depth == FAR).all()


def test_opacity_of_a_slab_follows_its_thickness():
    raw = 1.0
    out = baked(lambda p: np.where(np.abs(p[..., 0]) < 0.501, raw, LOW)).render(
        Viewpoints.of(camera_at(), K[None], SIZE), "day"
    )
    middle = out.opacity[0, SIZE[1] // 2, SIZE[0] // 2]
    thickness = 1.0  # [m]; the rims of trilinear log density add little
    assert middle == pytest.approx(1 - np.exp(-LAYOUT.density_unit * np.exp(raw) * thickness), abs=0.06)


@pytest.mark.parametrize(("distance", "opacity"), [(2.0, 0.0), (6.0, 1.0)])
def test_march_stops_at_given_depths(distance, opacity):
    stop = np.full((1, SIZE[1], SIZE[0]), distance)
    out = baked(wall(1.0, 11.0)).render(Viewpoints.of(camera_at(), K[None], SIZE), "day", stop=stop)
    assert np.abs(out.opacity - opacity).max() < 0.05


@pytest.mark.parametrize(("number", "at"), [(np.nan, 0), (np.inf, 0), (np.nan, 1), (0.0, 1)])
def test_invalid_cameras_are_refused_before_a_kernel_reads_them(number, at):
    pose, lens = camera_at(), K[None].copy()
    (pose[:, :3, 3], lens)[at][0, 0] = number
    with pytest.raises(InputError, match="not finite"):
        intrinsics_for_size(Viewpoints.of(pose, lens, SIZE), None)


@pytest.mark.parametrize("logit", [-90.0, -100.0, -200.0, 200.0])
def test_a_color_far_beyond_black_or_white_is_black_or_white(logit):
    field = baked(wall(1.0, 11.0))
    field.networks["network.head.2.bias"][:] = logit
    dark = BakedField(field.sections, field.lightings_by_name, field.networks)
    out = dark.render(Viewpoints.of(camera_at(), K[None], SIZE), "day")
    assert np.abs(out.rgb - (logit > 0.0)).max() < 1e-6


def slow_march(field: BakedField, eye: np.ndarray, directions: np.ndarray, step: float) -> np.ndarray:
    """Opacity and features along rays (k, 3) by small equal steps through the near box, shape (k, 16)."""
    layout, arrays = field.sections[0].layout, field.sections[0].arrays
    near = brick_indices(layout, arrays["near"], arrays["far"])[0]
    low, scale = arrays["low"].astype(float), arrays["step"].astype(float)
    total, transmittance = np.zeros((len(directions), 16)), np.ones(len(directions))
    for t in np.arange(layout.near_plane + step / 2, 12.0, step):
        b = ((eye + directions * t - layout.centre) / layout.half + 1) / 2
        inside = ((b >= 0) & (b < 1)).all(1)
        p = b.clip(0, 1 - 1e-9) * layout.near_shape
        slot = near[tuple(np.floor(p).astype(int).T)]
        c = (p - np.floor(p)) * bricks.CELLS
        cell = np.minimum(np.floor(c).astype(int), bricks.CELLS - 1)
        value = np.zeros((len(p), 16))
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (cell + corner).T
            weight = np.prod(np.where(np.array(corner) == 1, c - cell, 1 - (c - cell)), axis=1)
            code = arrays["features"][slot, (x * bricks.CORNERS + y) * bricks.CORNERS + z]
            value += weight[:, None] * (low + scale * code)
        optical = np.where(inside, layout.density_unit * np.exp(value[:, 0]) * step, 0.0)
        weight = transmittance * -np.expm1(-optical)
        total += weight[:, None] * value
        transmittance *= np.exp(-optical)
    total[:, 0] = 1 - transmittance
    return total


def test_march_equals_the_reference():
    rng = np.random.default_rng(1)
    centers, radii = rng.uniform([-1, -2, -1], [3, 2, 1], (9, 3)), rng.uniform(0.3, 0.7, 9)

    def blobs(p):
        near = np.min([np.linalg.norm(p - c, axis=-1) - r for c, r in zip(centers, radii, strict=True)], axis=0)
        return np.clip(4.0 - 12.0 * near, LOW, 5.0) - 100.0 * (np.abs(p) > np.array([3.9, 3.9, 1.9])).any(-1)

    field = baked(blobs)
    pose = camera_at((-3.5, 0.5, 0.3))
    out, features = field.render_features(Viewpoints.of(pose, K[None], SIZE), "day")
    features = features[0].reshape(16, -1).T
    directions = unproject(pixel_grid(*SIZE), K).reshape(-1, 3)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True) @ pose[0, :3, :3].T
    slow = slow_march(field, pose[0, :3, 3], directions, 0.005)
    assert 0.2 < slow[:, 0].mean() < 0.95
    assert np.abs(features[:, 0] - slow[:, 0]).mean() < 0.01
    assert np.abs(features - slow).mean() < 0.025  # a ray ends where 6 % of it is left
    assert np.abs(out.opacity.ravel() - slow[:, 0]).max() < 0.3  # at a rim the two may differ


def test_skip_distances_never_pass_an_occupied_block():
    rng = np.random.default_rng(2)
    sparse = dict(baked(wall(1.0, 11.0)).sections[0].arrays)
    sparse["features"] = np.zeros_like(sparse["features"])
    for _ in range(6):
        sparse["features"][rng.integers(len(sparse["near"])), rng.integers(729), 0] = 255
    near, far = skip_distances(LAYOUT, sparse).values()
    filled = np.argwhere(near == 0)
    assert len(filled) > 0
    for block in np.argwhere(near > 1)[::97]:
        assert np.abs(filled - block).max(1).min() >= near[tuple(block)]
    assert far.shape == tuple(np.multiply(LAYOUT.far_shape, bricks.BLOCKS))
    assert (far == 255).all()  # nothing there


def test_batched_cameras_equal_single_ones(monkeypatch):
    field = baked(wall(1.0, 2.0))
    poses = np.concatenate([camera_at(), camera_at((-3.0, 1.0, 0.5)), camera_at((-2.0, -1.0, 0.0))])
    intrinsics = np.tile(K, (3, 1))
    together = field.render(Viewpoints.of(poses, intrinsics, SIZE), "day:night:0.3")
    for i in range(3):
        alone = field.render(Viewpoints.of(poses[i : i + 1], intrinsics[:1], SIZE), "day:night:0.3")
        assert np.array_equal(alone.depth[0], together.depth[i])
        assert np.allclose(alone.rgb[0], together.rgb[i], atol=1e-5)


def test_image_does_not_depend_on_other_lightings_of_the_batch():
    """Equal bit for bit; otherwise an episode would depend on the other environments of its batch."""
    bare, rng, dim = baked(wall(1.0, 2.0)), np.random.default_rng(0), 32  # as in real fields
    head = networks(dim)
    head["network.head.0"][-dim:] = rng.normal(0, 0.1, (dim, 8))
    names = Lightings(("day",), np.zeros((1, dim), np.float32), (), np.zeros((0, dim), np.float32))
    field = baked_of_arrays(LAYOUT, names, bare.sections[0].arrays | head)
    lights = rng.normal(0, 1, (16, 32)).astype(np.float32)
    for n in (2, 3, 8, 16):
        together = field.render(Viewpoints.of(np.tile(camera_at(), (n, 1, 1)), K, SIZE), lights[:n])
        for i in range(n):
            alone = field.render(Viewpoints.of(camera_at(), K, SIZE), lights[i : i + 1])
            assert np.array_equal(alone.rgb[0], together.rgb[i])


def test_a_gpu_renders_what_a_cpu_renders():
    if "cuda" not in DEVICES:
        pytest.skip("no CUDA device")
    field = baked(wall(1.0, 2.0))
    poses = np.concatenate([camera_at(), camera_at((-3.0, 1.0, 0.5)), camera_at((-2.0, -1.0, 0.0))])
    views = Viewpoints.of(poses, np.tile(K, (3, 1)), SIZE)
    on_gpu = BakedField(field.sections, field.lightings_by_name, field.networks, "cuda")
    a, b = field.render(views, "day"), on_gpu.render(views, "day")
    for one, other in ((a.rgb, b.rgb), (a.opacity, b.opacity)):
        assert np.abs(one - other).mean() < 1e-3
    assert np.median(np.abs(a.depth / b.depth - 1.0)) < 1e-3
    assert np.array_equal(on_gpu.render(views, "day").rgb, b.rgb)


def test_each_camera_can_have_its_own_lighting():
    field = baked(wall(1.0, 2.0))
    cameras = Viewpoints.of(np.concatenate([camera_at(), camera_at()]), K, SIZE)
    together = field.render(cameras, ["day", field.embedding("night")])
    for i, name in enumerate(("day", "night")):
        alone = field.render(Viewpoints.of(camera_at(), K, SIZE), name)
        assert np.array_equal(alone.rgb[0], together.rgb[i])
    assert np.array_equal(
        together.rgb, field.render(cameras, np.stack([field.embedding(n) for n in ("day", "night")])).rgb
    )
    with pytest.raises(InputError, match="3 lightings for 2 cameras"):
        field.render(cameras, ["day"] * 3)


@pytest.mark.parametrize("size", [(5, 3), (1, 41), (33, 17)])
def test_image_of_any_size_equals_a_crop_of_a_larger_one(size):
    field, rim = baked(wall(1.0, 11.0)), 10
    middle = np.array([30.0, 30.0, size[0] / 2, size[1] / 2])
    small = field.render(Viewpoints.of(camera_at(), middle, size), "day")
    wide = size[0] + 2 * rim, size[1] + 2 * rim
    large = field.render(Viewpoints.of(camera_at(), middle + np.array([0, 0, rim, rim]), wide), "day")
    inner = np.s_[0, rim:-rim, rim:-rim]
    assert small.depth.shape == (1, size[1], size[0])
    assert np.abs(small.depth[0] - large.depth[inner]).max() < 0.1
    assert np.abs(small.rgb[0] - large.rgb[inner]).max() < 0.05


def test_save_and_load_are_the_identity_without_torch(tmp_path):
    field = baked(wall(1.0, 3.0))
    field.save(tmp_path)
    before = field.render(Viewpoints.of(camera_at(), K[None], SIZE), "night")
    after = BakedField.load(tmp_path).render(Viewpoints.of(camera_at(), K[None], SIZE), "night")
    assert np.array_equal(before.depth, after.depth)
    assert np.array_equal(before.rgb, after.rgb)
    code = (
        "import sys; from pathlib import Path; from twin.nerf.baked import BakedField;"
        f"BakedField.load(Path({str(tmp_path)!r})); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_random_lightings_are_equal_after_loading(tmp_path):
    bare = baked(wall(1.0, 3.0))
    with pytest.raises(InputError, match="no probes"):
        bare.sample_lighting(np.random.default_rng(0))
    rng = np.random.default_rng(3)
    rays = rng.normal(size=(50, 15)).astype(np.float32), rng.normal(size=(50, 16)).astype(np.float32)
    arrays = {**bare.sections[0].arrays, **bare.networks, "probes.features": rays[0], "probes.harmonics": rays[1]}
    field = baked_of_arrays(LAYOUT, bare.lightings_by_name, arrays)
    field.save(tmp_path)
    again = BakedField.load(tmp_path)
    drawn = field.sample_lighting(np.random.default_rng(0))
    assert np.array_equal(drawn, again.sample_lighting(np.random.default_rng(0)))
    again.add_lightings({"photo": np.full_like(drawn, 0.5)})  # photos change no random lighting
    assert np.array_equal(drawn, again.sample_lighting(np.random.default_rng(0)))
    assert again.render(Viewpoints.of(camera_at(), K, SIZE), drawn).rgb.shape == (1, SIZE[1], SIZE[0], 3)


def test_probes_that_do_not_fit_each_other_are_refused(tmp_path):
    bare = baked(wall(1.0, 3.0))
    probes = {"probes.features": np.zeros((5, 15), np.float32), "probes.harmonics": np.zeros((4, 16), np.float32)}
    baked_of_arrays(LAYOUT, bare.lightings_by_name, {**bare.sections[0].arrays, **bare.networks, **probes}).save(
        tmp_path
    )
    with pytest.raises(InputError, match=r"probes\.harmonics"):
        BakedField.load(tmp_path)


def test_unreadable_baked_field_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match=r"no baked\.json"):
        BakedField.load(tmp_path)
    (tmp_path / "baked.json").write_text('{"format": 99}')
    with pytest.raises(InputError, match="format 99"):
        BakedField.load(tmp_path)
    with pytest.raises(InputError, match="unknown"):
        baked(wall(1.0, 3.0)).render(Viewpoints.of(camera_at(), K[None], SIZE), "dawn")
