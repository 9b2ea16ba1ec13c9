"""Detail: where rays meet the ground, interpolation and its gradient, the mipmap, the fit, and files."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from devices import DEVICES
from test_fit import CONFIG, HEIGHT, WIDTH, K, floor_points, make_cameras

from twin.errors import InputError
from twin.geometry.cameras import SparsePoints, Viewpoints, pixel_grid, unproject
from twin.geometry.poses import look_at
from twin.nerf import detail
from twin.nerf.bake import bake
from twin.nerf.baked import BakedField
from twin.nerf.baked_arrays import BakedSection, Detail, detail_grid
from twin.nerf.dataset import DepthSupervision, TrainingPixels, join_depths
from twin.nerf.detail import fit_detail
from twin.nerf.kernels import surface_detail as kernels
from twin.nerf.kernels.volume import CHANNELS, Channels
from twin.nerf.trainer import train_field
from twin.warp_runtime import wp

ORIGIN = np.array([-3.0, -2.0])
CELL = 0.25


pytestmark = pytest.mark.usefixtures("quiet")


def slope(x, y):
    return 0.1 + 0.04 * x - 0.03 * y


def sloping_ground(tiles: np.ndarray | None = None, texel: float = 0.05) -> Detail:
    """Ground on a plane, unknown for x > 5 m."""
    x, y = np.meshgrid(np.arange(41) * CELL, np.arange(33) * CELL, indexing="ij")
    heights = np.where(x + ORIGIN[0] > 5.0, kernels.NO_GROUND, slope(x + ORIGIN[0], y + ORIGIN[1]))
    ground = Detail.without_features(heights.astype(np.float32), ORIGIN, CELL)
    if tiles is None:
        return ground
    return replace(ground, tiles=tiles.astype(np.int32), texel=texel, cell=0.1, vertices=np.zeros((256, 0), np.uint8))


def hits_of(detail: Detail, pose: np.ndarray, depth: np.ndarray) -> np.ndarray:
    hits = wp.empty(depth.size, dtype=kernels.Hit, device="cpu")
    wp.launch(
        kernels.find_surface,
        depth.size,
        [
            *(detail_grid(detail, "cpu"), wp.mat33f(*pose[:3, :3].ravel()), wp.vec3f(*pose[:3, 3]), wp.vec4f(*K)),
            *(WIDTH, wp.array(depth.ravel().astype(np.float32), dtype=wp.float32, device="cpu")),
        ],
        [hits],
        device="cpu",
    )
    return hits.numpy()


def rays_of(pose: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones_like(u)], -1) @ pose[:3, :3].T).reshape(-1, 3)


def test_rays_meet_the_ground_where_the_height_map_says_not_where_the_depth_says():
    pose = look_at(np.array([0.0, 0.0, 1.5]), np.array([3.0, 0.5, 0.2]))
    o, ray = pose[:3, 3], rays_of(pose)
    # o + t·ray lies on the plane z = slope(x, y).
    exact = (slope(o[0], o[1]) - o[2]) / (ray[:, 2] - 0.04 * ray[:, 0] + 0.03 * ray[:, 1])
    point = o + exact[:, None] * ray
    inside = (exact > 0) & (np.abs(point[:, :2]) < [2.9, 1.9]).all(1)
    assert inside.sum() > 100
    noisy = exact * np.where(np.arange(len(exact)) % 2, 1.02, 0.98)
    hits = hits_of(sloping_ground(), pose, noisy)
    near = inside & (np.abs((o + noisy[:, None] * ray)[:, 2] - slope(*(o + noisy[:, None] * ray)[:, :2].T)) < 0.08)
    assert near.sum() > 100 and (hits[near, 3] > 0).all()
    assert np.abs(hits[near, :2] + ORIGIN - point[near, :2]).max() < 0.02
    assert np.abs(noisy[near] - exact[near]).max() > 0.05
    # A surface well above the ground is found where it is.
    above = hits_of(sloping_ground(), pose, 0.6 * exact)
    assert (above[inside, 3] < 0).all()
    assert np.allclose(above[inside, :3], (o + 0.6 * exact[:, None] * ray)[inside] - [*ORIGIN, 0.0], atol=1e-4)
    assert not hits_of(sloping_ground(), pose, -np.ones_like(exact))[:, 3].any()


def test_rays_meet_a_curb_at_its_face():
    """A ray that meets the face of a curb neither passes it nor stops before it, even if its depth is imprecise."""
    cell, low, high = 0.1, 0.0, 0.12
    y = np.tile(np.arange(81) * cell - 4.0, (81, 1))
    curb = Detail.without_features(np.where(y < 1.0, low, high).astype(np.float32), np.array([-4.0, -4.0]), cell)

    def height(at):  # what the map's bilinear interpolation gives
        return low + (high - low) * np.clip((at - 0.9) / cell, 0.0, 1.0)

    pose = look_at(np.array([-2.0, 0.0, 0.45]), np.array([1.5, 1.2, 0.05]))
    o, ray = pose[:3, 3], rays_of(pose)
    t = np.linspace(0.5, 6.0, 20_000)
    z, y = o[2] + np.outer(ray[:, 2], t), o[1] + np.outer(ray[:, 1], t)
    below = z < height(y)
    exact = np.where(below.any(1), t[below.argmax(1)], -1.0)
    point = o + exact[:, None] * ray
    face = (exact > 0) & (np.abs(point[:, 1] - 0.95) < 0.05) & (np.abs(point[:, 0]) < 3.5)
    assert face.sum() > 20
    for factor in (0.97, 1.0, 1.03):
        hits = hits_of(curb, pose, factor * exact)
        assert (hits[face, 3] > 0).all()
        assert np.abs(hits[face, :2] - 4.0 - point[face, :2]).max() < 0.08
        assert np.abs(hits[face, 2] - height(hits[face, 1] - 4.0)).max() < 0.02


class Floor:
    """Stands for a baked field that shows a level floor at z = 0, smooth where there is a curb."""

    lightings = ("day",)

    def render(self, cameras, lighting, size):
        k = cameras.intrinsics * (np.array([*size, *size]) / np.tile(cameras.sizes, 2))
        rays = unproject(pixel_grid(*size), k[0]) @ cameras.camera_to_world[0, :3, :3].T
        depth = cameras.camera_to_world[0, 2, 3] / np.maximum(-rays[..., 2], 1e-3)
        return SimpleNamespace(depth=np.minimum(depth, 100.0)[None])


def test_stereo_makes_the_height_map_sharp_where_it_sees_the_ground(tmp_path):
    cameras = make_cameras(tmp_path)
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    smooth, origin = detail._height_map(Floor(), pixels, join_depths([]))
    known = smooth < kernels.NO_GROUND
    assert known.sum() > 500 and np.abs(smooth[known]).max() < 1e-6
    # The floor is 0.1 m higher where y > 0.2 m; a bin, 0.5 m high, stands on it.
    rng = np.random.default_rng(0)
    parts = []
    for i in range(len(pixels.cameras)):
        pixel = rng.uniform(0.0, [WIDTH, HEIGHT], (500, 2))  # so few that the height map has gaps to fill
        ray = unproject(pixel, pixels.intrinsics[i])
        pose = pixels.cameras.camera_to_world[i]
        world = ray @ pose[:3, :3].T
        t = (pose[2, 3] - 0.1) / np.maximum(-world[:, 2], 1e-3)
        raised = pose[1, 3] + t * world[:, 1] > 0.2
        t = np.where(raised, t, pose[2, 3] / np.maximum(-world[:, 2], 1e-3))
        bin_there = (np.abs(pose[:2, 3] + t[:, None] * world[:, :2] - [4.0, -0.5]) < 0.2).all(1)
        t = np.where(bin_there, (pose[2, 3] - 0.5) / np.maximum(-world[:, 2], 1e-3), t)
        far = np.full(len(t), i, np.int32), pixel, (t * np.linalg.norm(ray, axis=1)).astype(np.float32)
        parts.append(DepthSupervision(*far).select(world[:, 2] < -0.1))
    stereo = join_depths(parts)
    sharp, same = detail._height_map(Floor(), pixels, stereo)
    assert np.array_equal(same, origin) and np.array_equal(sharp < kernels.NO_GROUND, known)
    x, y = np.moveaxis(np.indices(sharp.shape), 0, -1).reshape(-1, 2).T * detail._HEIGHT_CELL + origin[:, None]
    near = known.ravel() & (np.abs(x - 4.0) < 1.5) & (np.abs(y) < 1.0)
    z = sharp.ravel()
    assert np.abs(z[near & (y > 0.32)] - 0.1).max() < 0.01
    assert np.abs(z[near & (y < 0.08)]).max() < 0.01  # and where the bin stands
    # Frames of another section do not count.
    few = pixels.of_frames(np.arange(7))
    alone, _ = detail._height_map(Floor(), few, stereo.select(stereo.frame > 6))
    assert np.abs(alone[alone < kernels.NO_GROUND]).max() < 1e-6


def random_hits(rng: np.random.Generator, n: int) -> np.ndarray:
    xyz = rng.uniform([0.1, 0.1, 0.0], [6.0, 6.0, 2.0], (n, 3))
    footprint = rng.uniform(0.01, 0.14, n) * np.where(rng.random(n) < 0.6, 1.0, -1.0)
    return np.concatenate([xyz, footprint[:, None]], 1).astype(np.float32)


def as_channels(values: np.ndarray) -> wp.array:
    return wp.array(values.astype(np.float32), dtype=Channels, device="cpu")


def interpolate(detail: Detail, hits: np.ndarray, texels: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    out = wp.zeros(len(hits), dtype=Channels, device="cpu")
    given = [wp.array(hits, dtype=kernels.Hit, device="cpu"), detail_grid(detail, "cpu")]
    wp.launch(
        kernels.interpolate_detail,
        len(hits),
        [*given, as_channels(texels), as_channels(vertices), 0],
        [out],
        device="cpu",
    )
    return out.numpy()


@pytest.fixture(scope="module")
def tables():
    rng = np.random.default_rng(3)
    tiles = np.argwhere(rng.random((8, 8)) < 0.8)
    detail = sloping_ground(tiles)
    texels = rng.normal(size=(len(tiles) * kernels.TEXELS, CHANNELS))
    vertices = rng.normal(size=(len(detail.vertices), CHANNELS))
    return detail, texels, vertices


def test_the_gradient_is_the_transpose_of_the_interpolation(tables):
    detail, texels, vertices = tables
    rng = np.random.default_rng(4)
    hits = random_hits(rng, 300)
    out = interpolate(detail, hits, texels, vertices)
    assert (np.abs(out).sum(1) > 0).mean() > 0.5
    cotangent = rng.normal(size=out.shape).astype(np.float32)
    by_texel, by_vertex = as_channels(np.zeros_like(texels)), as_channels(np.zeros_like(vertices))
    given = [wp.array(hits, dtype=kernels.Hit, device="cpu"), detail_grid(detail, "cpu"), as_channels(cotangent)]
    for part in range(4):
        wp.launch(
            kernels.interpolate_detail_backward, len(hits), [*given, part, 4], [by_texel, by_vertex], device="cpu"
        )
    backward = (by_texel.numpy() * texels).sum() + (by_vertex.numpy() * vertices).sum()
    assert backward == pytest.approx((out * cotangent).sum(), rel=1e-4)


def test_the_renderer_adds_what_the_fit_interpolates(tables):
    detail, texels, vertices = tables
    total = wp.zeros(len(texels), dtype=Channels, device="cpu")
    wp.launch(
        kernels.sum_levels,
        len(texels),
        [
            *(wp.array(detail.tiles, dtype=wp.vec2i, device="cpu"), detail_grid(detail, "cpu")),
            as_channels(np.round(10.0 * texels)),
        ],
        [total],
        device="cpu",
    )
    one, none = np.ones(CHANNELS, np.float32), np.zeros_like(vertices)
    hits = random_hits(np.random.default_rng(5), 300)
    hits = hits[hits[:, 3] > 0]
    # All corners of a hit's cells must be stored: beside missing tiles coarse levels fade within their own cells.
    full = interpolate(detail, hits, np.ones_like(texels), none)
    coarse_sum = np.array([sum(h[3] < 1.5 * 0.05 * 2**k for k in range(kernels.LEVELS)) for h in hits])
    whole = np.isclose(full[:, 1], coarse_sum, atol=1e-4)
    assert whole.sum() > 20
    wanted = interpolate(detail, hits, np.round(10.0 * texels), none)
    stored = replace(detail, texels=total.numpy(), texel_step=one)
    finest = np.array([next((k for k in range(kernels.LEVELS) if h[3] < 1.5 * 0.05 * 2**k), -1) for h in hits])
    for k in range(kernels.LEVELS):
        mine = whole & (finest == k)
        # One level of the sums, found by giving the hit a footprint that only this level of the sums may show.
        shown = _level_of(stored, hits[mine], k)
        assert np.allclose(shown[:, 1:], wanted[mine][:, 1:], atol=1e-2)


def _level_of(detail: Detail, hits: np.ndarray, level: int) -> np.ndarray:
    """Interpolated texels of one level, by a slow reference."""
    out = np.zeros((len(hits), CHANNELS))
    side = detail.texel * 2**level
    first = sum((kernels.TILE >> k) ** 2 for k in range(level))
    width = kernels.TILE >> level
    for h, hit in enumerate(hits):
        p = hit[:2] / np.float32(side)
        low = np.floor(p).astype(int)
        a = p - low
        for n in np.ndindex(2, 2):
            node = low + n
            tile, inside = node // width, node % width
            slot = detail.tile_index[tuple(tile)]
            row = slot * kernels.TEXELS + first + inside[0] * width + inside[1]
            out[h] += detail.texels[row] * np.prod(np.where(n, a, 1.0 - a))
    return out


def test_a_ray_shows_detail_by_its_opacity():
    """The features of a ray are those of its surface times its opacity, so the detail must be, too."""
    one, pixels = np.ones(CHANNELS, np.float32), WIDTH * HEIGHT
    detail = replace(sloping_ground(), cell=10.0, vertices=np.full((8, CHANNELS), 138, np.uint8), vertex_step=one)
    stored, image = kernels.DetailBytes(), kernels.ImageBuffers()
    stored.texels = wp.zeros(0, dtype=kernels.Bytes, device="cpu")
    stored.vertices = wp.array(detail.vertices, dtype=kernels.Bytes, device="cpu")
    stored.vertex_step = Channels(*one.tolist())
    pose = look_at(np.array([0.0, 0.0, 5.0]), np.array([1.0, 0.0, 5.0])).astype(np.float32)
    image.rotation = wp.array(pose[None, :3, :3], dtype=wp.mat33f, device="cpu")
    image.position = wp.array(pose[None, :3, 3], dtype=wp.vec3f, device="cpu")
    image.intrinsics = wp.array(K[None].astype(np.float32), dtype=wp.vec4f, device="cpu")
    image.width, image.height = WIDTH, HEIGHT
    opacity = np.linspace(0.5, 1.0, pixels, dtype=np.float32)
    features = wp.array(np.stack([opacity, *[np.zeros_like(opacity)] * 15])[None], dtype=wp.float32, device="cpu")
    depth = wp.full((1, pixels), 2.0, dtype=wp.float32, device="cpu")
    inputs = [detail_grid(detail, "cpu"), stored, image, 0, pixels, pixels, depth]
    wp.launch(kernels.add_detail, (1, 1), inputs, [features], device="cpu")
    assert np.allclose(features.numpy()[0, 1:], 10.0 * opacity, atol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
def test_detail_sharpens_repeats_and_survives_the_disk(tmp_path, device):
    cameras = make_cameras(tmp_path)
    config = replace(CONFIG, steps=120, rays=512, samples=12, levels=4, log2_table=12)
    field, *_, stereo = train_field(cameras, floor_points(cameras), config, seed=0, camera_height=1.5, device=device)
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    plain, _ = bake(field, pixels, seed=1, steps=60, max_bricks=1500)
    view = Viewpoints.of(cameras.camera_to_world[2:3], K, (WIDTH, HEIGHT))
    before = plain.render(view, "day")
    fields = []
    for _ in range(2):
        fields.append(plain.alone(0))
        facts = fit_detail(fields[-1], field.appearance, pixels, stereo, seed=0, passes=30.0)
        assert facts["pixels"] > 100 and facts["psnr_after"] > facts["psnr_before"] + 0.2
    after, again = (f.render(view, "day") for f in fields)
    # On a GPU, the order of sums changes from run to run.
    assert np.array_equal(after.rgb, again.rgb) if device == "cpu" else np.abs(after.rgb - again.rgb).max() < 0.05
    assert np.array_equal(after.depth, before.depth) and np.array_equal(after.opacity, before.opacity)
    assert np.abs(after.rgb - before.rgb).max() > 0.02
    # Where rays end before the ground nothing is added.
    stop = np.full(before.depth.shape, 0.6)
    assert np.array_equal(fields[0].render(view, "day", stop=stop).rgb, plain.render(view, "day", stop=stop).rgb)
    fields[0].save(tmp_path)
    assert np.array_equal(BakedField.load(tmp_path, device).render(view, "day").rgb, after.rgb)
    # A file that a kernel would read beyond its ends is refused.
    texels, tiles = fields[0].sections[0].arrays["detail.texels"], fields[0].sections[0].arrays["detail.tiles"]
    for name, value in (
        ("texels", texels[:-1]),
        ("tiles", tiles - 10**6),
        ("tiles", tiles + 10**6),
        ("vertices", fields[0].sections[0].arrays["detail.vertices"][:12]),
        ("sides", np.zeros(3)),
        ("origin", np.array([np.nan, 0.0])),
        ("heights", np.zeros((2, 2, 2), np.float32)),
    ):
        section = BakedSection(fields[0].sections[0].layout, fields[0].sections[0].arrays | {f"detail.{name}": value})
        fields[1].sections = (section,)
        fields[1].save(tmp_path)
        with pytest.raises(InputError, match="build the scene again"):
            BakedField.load(tmp_path)
    plain.save(tmp_path)  # as earlier versions wrote them, without detail
    assert np.array_equal(BakedField.load(tmp_path, device).render(view, "day").rgb, before.rgb)
