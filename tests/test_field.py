"""Radiance field: kernels against slow references, analytic scenes, files, names of lightings."""

import json

import numpy as np
import pytest
import torch
import warp as wp

from twin.errors import InputError
from twin.geometry.cameras import FAR, Viewpoints
from twin.geometry.poses import look_at
from twin.nerf import network
from twin.nerf.buffers import CameraArrays, Layout, Workspace, near_box
from twin.nerf.field import FieldSection, RadianceField, untrained_field
from twin.nerf.kernels import hashgrid, volume

LAYOUT = Layout(
    (1.0, -2.0, 0.5), (8.0, 6.0, 2.0), 0.3, levels=3, growth=2.0, log2_table=11, hidden=16, appearance_dim=32
)


@pytest.fixture
def field() -> RadianceField:
    frames = ("day/000000", "day/000001", "night/000000")
    field = untrained_field([LAYOUT], ("day", "night"), frames, np.array([0, 0, 1]), seed=1, device="cpu")
    field.appearance.residuals.normal_(generator=torch.Generator().manual_seed(0))
    return field


@pytest.fixture
def section(field) -> FieldSection:
    return field.sections[0]


def random_samples(section: FieldSection, rays: int, samples: int, seed: int = 0) -> Workspace:
    """A workspace with random but sorted samples and random network outputs."""
    rng = np.random.default_rng(seed)
    ws = Workspace(section.layout, rays, samples, "cpu", training=True)
    edges = np.sort(rng.uniform(0.5, 20.0, (rays, samples + 1)), 1)
    ws.edges.copy_(torch.from_numpy(edges))
    ws.distances.copy_(torch.from_numpy(edges[:, :-1] + rng.random((rays, samples)) * np.diff(edges)))
    ws.lengths.copy_(torch.from_numpy(np.diff(edges, axis=1) * rng.uniform(0.1, 1.0, (rays, samples))))
    ws.positions.copy_(torch.from_numpy(rng.random((rays * samples, 3))))
    ws.outputs.copy_(torch.from_numpy(rng.normal(0.0, 1.5, (rays * samples, volume.CHANNELS))))
    return ws


def slow_encode(section: FieldSection, table: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
    """Trilinear hash features, differentiable, shape (n, levels · FEATURES)."""
    cells, shapes = section.layout.level_cells(), section.layout.level_shapes()
    columns = []
    for level in range(section.layout.levels):
        s = (positions.numpy() * cells[level]).astype(np.float32)
        base = np.floor(s).astype(np.int64)
        b = torch.from_numpy(s - base)
        total = torch.zeros(len(positions), hashgrid.FEATURES, dtype=table.dtype)
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (base + corner).T
            nx, ny, _, dense = shapes[level]
            if dense:
                index = x + nx * (y + ny * z)
            else:
                index = (x ^ (y * 2654435761) ^ (z * 805459861)) & (2**section.layout.log2_table - 1)
            weight = torch.stack([b[:, k] if corner[k] else 1 - b[:, k] for k in range(3)], -1).prod(-1)
            total = total + weight[:, None] * table[level, torch.from_numpy(index)]
        columns.append(total)
    return torch.cat(columns, 1)


def test_levels_include_dense_and_hashed_ones(field):
    assert set(LAYOUT.level_shapes()[:, 3]) == {0, 1}


def test_encoding_and_its_gradient_equal_the_reference(section):
    ws = random_samples(section, 20, 5)
    section.query(ws, 0, 100)
    table = section.table.clone().double().requires_grad_(True)
    expected = slow_encode(section, table, ws.positions)
    torch.testing.assert_close(ws.features.double(), expected.detach(), atol=1e-6, rtol=1e-4)

    gradient = torch.randn(expected.shape, generator=torch.Generator().manual_seed(2))
    expected.backward(gradient.double())
    ws.features_grad.copy_(gradient)
    got = torch.zeros_like(section.table)
    for level in range(LAYOUT.levels):
        wp.launch(
            hashgrid.encode_backward,
            (1, 100),
            [ws.w_positions, section.w_levels, level, ws.w_features_grad, wp.from_torch(got, dtype=hashgrid.Feature)],
            device="cpu",
        )
    torch.testing.assert_close(got.double(), table.grad, atol=1e-5, rtol=1e-4)


def slow_composite(raw: torch.Tensor, ws: Workspace, unit: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Weights (n, K), composited output (n, CHANNELS) and Σw/t (n,), differentiable."""
    sigma = unit * torch.exp(raw[..., 0])
    optical = sigma * ws.lengths.double()
    before = torch.cumsum(optical, 1) - optical
    w = torch.exp(-before) * (1 - torch.exp(-optical))
    out = (w[..., None] * raw).sum(1)
    return w, torch.cat([w.sum(1, keepdim=True), out[:, 1:]], 1), (w / ws.distances.double()).sum(1)


def test_compositing_and_its_gradient_equal_the_reference(section):
    rays, samples = 12, 7
    ws = random_samples(section, rays, samples)
    ws.targets[::2] = 6.0
    section.composite(ws, 0, rays)
    raw = ws.outputs.view(rays, samples, -1).double().requires_grad_(True)
    w, composited, inverse = slow_composite(raw, ws, LAYOUT.density_unit)
    torch.testing.assert_close(ws.composited.double(), composited.detach(), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(ws.weights.double(), w.detach(), atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(ws.inverse_distance.double(), inverse.detach(), atol=1e-6, rtol=1e-4)

    distortion, depth, reach, offset = 0.7, 0.9, 0.4, 1.5
    generator = torch.Generator().manual_seed(5)
    g = torch.randn(composited.shape, generator=generator, dtype=torch.float64)
    gi = torch.randn(rays, generator=generator, dtype=torch.float64)
    t = ws.distances.double()
    s = torch.log(t + offset)
    pairs = (w[:, :, None] * w[:, None, :] * (s[:, :, None] - s[:, None, :]).abs()).sum((1, 2))
    own = (w**2 * torch.diff(torch.log(ws.edges.double() + offset), dim=1)).sum(1) / 3.0
    target = ws.targets.double()[:, None]
    away = torch.where(target > 0, torch.clamp((t / target.clamp(min=1e-9) - 1).abs(), max=reach) - reach, 0.0)
    loss = (composited * g).sum() + (inverse * gi).sum()
    loss = loss + distortion * (pairs + own).sum() + depth * (w * away).sum()
    loss.backward()

    ws.composited_grad.copy_(g)
    ws.inverse_grad.copy_(gi)
    section.composite_backward(ws, 0, rays, distortion, depth, reach, offset)
    torch.testing.assert_close(ws.outputs_grad.view_as(raw).double(), raw.grad, atol=2e-5, rtol=1e-3)


def test_trunk_gradient_equals_autograd(section):
    generator = torch.Generator().manual_seed(4)
    features = torch.randn(50, 12, generator=generator)
    weights = {k: v.clone().requires_grad_(True) for k, v in section.parameters.items() if k.startswith("trunk")}
    features_ = features.clone().requires_grad_(True)
    g = torch.randn(50, volume.CHANNELS, generator=generator)
    (torch.relu(features_ @ weights["trunk.0"]) @ weights["trunk.1"] * g).sum().backward()

    hidden, out, hidden_grad, features_grad = (torch.empty(50, n) for n in (16, volume.CHANNELS, 16, 12))
    network.trunk(section.parameters, features, hidden, out)
    first, second = network.trunk_backward(section.parameters, features, hidden, g, hidden_grad, features_grad)
    torch.testing.assert_close(first, weights["trunk.0"].grad)
    torch.testing.assert_close(second, weights["trunk.1"].grad)
    torch.testing.assert_close(features_grad, features_.grad)


def test_contraction_is_affine_in_the_near_box_and_bounded():
    points = np.array([[1.0, -2.0, 0.5], [9.0, -2.0, 0.5], [1.0 + 16.0, -2.0, 0.5], [1e9, -2.0, 0.5]])
    out = LAYOUT.grid_positions(points)
    # (2 − 1/2)/4 + 1/2 at two half sides; the horizon is mapped to the faces of the cube.
    np.testing.assert_allclose(out[:, 0], [0.5, 0.75, 0.875, 1.0], atol=1e-5)
    np.testing.assert_allclose(out[:, 1:], 0.5, atol=1e-6)


def make_opaque_below(section: FieldSection, height: float) -> None:
    """Makes everything below z = height [m] opaque for sampling."""
    near, far = section.grids
    low, high = section.layout.bounds[:, 2]
    z = low + (np.arange(near.shape[2]) + 0.5) / near.shape[2] * (high - low)
    near[:] = torch.from_numpy(np.where(z < height, 0.99, 0.0).astype(np.float32))
    far.zero_()


def test_samples_are_sorted_and_concentrate_at_the_surface(section):
    make_opaque_below(section, 0.0)
    ws = Workspace(section.layout, 64, 16, "cpu")
    rng = np.random.default_rng(0)
    directions = np.stack([np.full(64, 0.6), rng.uniform(-0.3, 0.3, 64), np.full(64, -0.5)], -1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ws.origins[:] = torch.tensor([-2.0, -2.0, 1.5])
    ws.directions.copy_(torch.from_numpy(directions))
    section.sample(ws, 0, 64, 0.05, seed=7)
    edges, t = ws.edges.numpy(), ws.distances.numpy()
    assert (np.diff(edges, axis=1) > 0).all()
    assert (t >= edges[:, :-1]).all() and (t <= edges[:, 1:]).all()
    np.testing.assert_allclose(edges[:, 0], LAYOUT.near_plane)
    points = np.array([-2.0, -2.0, 1.5]) + t[..., None] * directions[:, None]
    expected = LAYOUT.grid_positions(points.reshape(-1, 3))
    np.testing.assert_allclose(ws.positions.numpy(), expected, atol=1e-6)
    hit = 1.5 / -directions[:, 2]
    assert (np.abs(t - hit[:, None]) < 0.5).mean() > 0.7


@pytest.mark.parametrize("seed", [0, 3, 2147, 2148, 12345, 2**31 - 1])
def test_samples_are_jittered_for_every_seed(section, seed):
    """The seeds are those that training and baking derive from a scene's seed and a step."""
    make_opaque_below(section, 0.0)
    ws = Workspace(section.layout, 64, 16, "cpu")
    ws.origins[:] = torch.tensor([-2.0, -2.0, 1.5])
    ws.directions[:] = torch.tensor([0.6, 0.0, -0.8])

    def distances(step: int | None) -> np.ndarray:
        section.sample(ws, 0, 64, 0.05, seed=None if step is None else seed * 1_000_003 + step)
        return ws.distances.numpy().copy()

    middles, one, again, other = distances(None), distances(5), distances(5), distances(6)
    assert np.array_equal(one, again)
    assert (one != middles).mean() > 0.9 and (one != other).mean() > 0.9
    assert np.ptp(one, axis=0).max() > 0.1  # every ray has its own


def test_samples_concentrate_at_a_known_distance(section):
    ws = Workspace(section.layout, 8, 16, "cpu")
    ws.origins[:] = torch.tensor([0.0, -2.0, 0.5])
    ws.directions[:] = torch.tensor([1.0, 0.0, 0.0])
    ws.targets[:4] = 5.0
    section.sample(ws, 0, 8, 0.1, target_mass=0.5)
    near = (np.abs(ws.distances.numpy() - 5.0) < 0.3).sum(1)
    assert (near[:4] >= 4).all() and (near[4:] <= 3).all()


def make_ground(section: FieldSection, height: float) -> None:
    """A field that is opaque below z = height and empty above: feature 0 of the dense level is the depth below it."""
    make_opaque_below(section, height)
    cells, n = section.layout.level_cells()[0], section.layout.level_shapes()[0]
    vertex = np.arange(n[0] * n[1] * n[2]) // (n[0] * n[1])
    z = section.layout.centre[2] + (vertex / cells[2] - 0.5) * 4.0 * section.layout.half[2]
    section.table.zero_()
    section.table[0, : len(z), 0] = torch.from_numpy(height - z)
    section.table[0, : len(z), 1] = 1.0
    for name in ("trunk.0", "trunk.1"):
        section.parameters[name].zero_()
    section.parameters["trunk.0"][0, 0] = section.parameters["trunk.0"][1, 1] = 1.0
    section.parameters["trunk.1"][0, 0] = 2000.0  # raw output: 2000 per meter of depth, from −12 on
    section.parameters["trunk.1"][1, 0] = -12.0


def test_ground_renders_at_its_depth_and_sky_is_transparent(field):
    make_ground(field.sections[0], 0.0)
    pose = look_at(np.array([0.0, -2.0, 1.5]), np.array([4.0, -2.0, 0.0]))
    result = field.render(Viewpoints.of(pose[None], np.array([[20.0, 20.0, 16.0, 9.0]]), (32, 18)), "day")
    assert result.rgb.shape == (1, 18, 32, 3) and result.depth.shape == result.opacity.shape == (1, 18, 32)
    assert result.rgb.dtype == result.depth.dtype == np.float32
    centre = result.depth[0, 8:10, 15:17].mean()
    assert centre == pytest.approx(np.hypot(4.0, 1.5), rel=0.03)
    up = look_at(np.array([0.0, -2.0, 1.5]), np.array([1.0, -2.0, 4.0]))
    sky = field.render(Viewpoints.of(up[None], np.array([[20.0, 20.0, 16.0, 9.0]]), (32, 18)), "night")
    assert (sky.depth == FAR).all() and sky.opacity.max() < 0.05 and result.opacity.max() > 0.99


def test_rendering_does_not_depend_on_the_batches(field):
    pose = look_at(np.array([0.0, -2.0, 1.5]), np.array([4.0, -2.0, 0.0]))
    k = np.array([[60.0, 60.0, 48.0, 32.0]])
    one = field.render(Viewpoints.of(pose[None], k, (96, 64)), "day")
    three = field.render(Viewpoints.of(np.repeat(pose[None], 3, 0), np.repeat(k, 3, 0), (96, 64)), "day")
    np.testing.assert_array_equal(np.repeat(one.rgb, 3, 0), three.rgb)


def test_lighting_changes_color_but_not_geometry(field):
    pose = look_at(np.array([0.0, -2.0, 1.5]), np.array([4.0, -2.0, 0.0]))
    k = np.array([[20.0, 20.0, 16.0, 9.0]])
    day, night = (field.render(Viewpoints.of(pose[None], k, (32, 18)), name) for name in ("day", "night"))
    np.testing.assert_array_equal(day.depth, night.depth)
    np.testing.assert_array_equal(day.opacity, night.opacity)
    assert np.abs(day.rgb - night.rgb).mean() > 1e-3


def test_save_and_load_are_the_identity(field, tmp_path):
    field.save(tmp_path, {"scene": "x"})
    assert json.loads((tmp_path / "field.json").read_text())["about"] == {"scene": "x"}
    loaded = RadianceField.load(tmp_path, "cpu")
    assert loaded.sections[0].layout == field.sections[0].layout
    assert loaded.lightings == ("day", "night")
    np.testing.assert_array_equal(loaded.embedding("day"), field.embedding("day"))
    pose = look_at(np.array([0.0, -2.0, 1.5]), np.array([4.0, -2.0, 0.0]))[None]
    k = np.array([[20.0, 20.0, 16.0, 9.0]])
    a, b = (f.render(Viewpoints.of(pose, k, (32, 18)), "night") for f in (field, loaded))
    np.testing.assert_array_equal(a.rgb, b.rgb)
    np.testing.assert_array_equal(a.depth, b.depth)


def test_loading_from_an_empty_folder_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match=r"field\.json"):
        RadianceField.load(tmp_path, "cpu")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("layout", {"log2_table": 20}),
        ("layout", {"levels": 9}),
        ("layout", {"hidden": 32}),
        ("lightings", ["day"]),
        ("frame_lighting", [0, 0, 2]),
        ("more_layouts", [{"levels": 9}]),
    ],
)
def test_tensors_that_do_not_fit_the_layout_are_refused(field, tmp_path, key, value):
    """Kernels would read beyond them."""
    field.save(tmp_path)
    head = json.loads((tmp_path / "field.json").read_text())
    layout = head["layout"]
    head[key] = {**layout, **value} if key == "layout" else value
    if key == "more_layouts":
        head[key] = [{**layout, **value[0]}]
    (tmp_path / "field.json").write_text(json.dumps(head))
    with pytest.raises(InputError, match=r"field\.safetensors is damaged"):
        RadianceField.load(tmp_path, "cpu")


def test_embeddings_by_name_frame_and_mixture(field):
    day, night = field.embedding("day"), field.embedding("night")
    np.testing.assert_allclose(field.embedding("day:night:0.25"), 0.75 * day + 0.25 * night, rtol=1e-6)
    residual = field.appearance.residuals[1].numpy()
    np.testing.assert_allclose(field.embedding("day/000001"), day + residual, rtol=1e-6)
    for wrong in ("dusk", "day:night:much", "day:dusk:0.5"):
        with pytest.raises(InputError):
            field.embedding(wrong)


def test_near_box_contains_the_cameras_and_the_space_ahead():
    poses = np.stack([look_at(np.array([x, 0.0, 1.0]), np.array([x + 1.0, 0.0, 1.0])) for x in (0.0, 10.0, 20.0)])
    center, half = near_box(poses, 0.0)
    assert (center - half < [0.0, 0.0, 0.0]).all() and (center + half)[0] > 30.0
    np.testing.assert_allclose(near_box(poses, 50.0), [[10.0, 0.0, 1.0], [50.0, 50.0, 50.0]])


def test_pixel_rays_equal_unprojected_pixels(section):
    from twin.geometry.cameras import unproject

    pose = look_at(np.array([1.0, 2.0, 3.0]), np.array([4.0, -2.0, 0.0]))
    k = np.array([55.0, 50.0, 30.0, 20.0])
    cameras = CameraArrays(pose[None], k[None], "cpu")
    ws = Workspace(section.layout, 2, 4, "cpu")
    pixel = np.array([[3.5, 7.5], [60.0, 1.0]])
    ws.pixel.copy_(torch.from_numpy(pixel))
    section.cast(ws, cameras, 0, 2)
    local = unproject(pixel, k)
    expected = local @ pose[:3, :3].T
    np.testing.assert_allclose(ws.directions.numpy(), expected / np.linalg.norm(expected, axis=1)[:, None], atol=1e-6)
    np.testing.assert_allclose(ws.cosines.numpy(), 1.0 / np.linalg.norm(local, axis=1), rtol=1e-6)
    np.testing.assert_allclose(ws.origins.numpy(), np.repeat(pose[None, :3, 3], 2, 0), rtol=1e-6)
