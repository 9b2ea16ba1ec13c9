"""Training: contents of a batch, convergence, repeatability, baking, evaluation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from devices import DEVICES

from twin.config import NerfConfig, SceneConfig, SourceConfig
from twin.errors import InputError
from twin.files import write_json
from twin.geometry.cameras import Cameras, SparsePoints, Viewpoints, project
from twin.geometry.images import psnr, write_image
from twin.geometry.poses import look_at
from twin.nerf import buffers
from twin.nerf.appearance import fit_appearance
from twin.nerf.bake import bake
from twin.nerf.baked import BakedField
from twin.nerf.buffers import CameraArrays, Workspace, single_threaded_torch
from twin.nerf.dataset import DepthSupervision, TrainingPixels, constant_height, free_segments, join_depths, load_frame
from twin.nerf.evaluate import evaluate
from twin.nerf.field import RadianceField
from twin.nerf.poles import Poles
from twin.nerf.trainer import Trainer, plane_loss, run, train_field
from twin.scene import SceneDir

WIDTH, HEIGHT = 32, 24
K = np.array([24.0, 24.0, 16.0, 12.0])
CONFIG = NerfConfig(steps=6, rays=128, samples=8, levels=3, log2_table=10, max_width=WIDTH)


pytestmark = pytest.mark.usefixtures("quiet")


def ground_image(pose: np.ndarray, brightness: float) -> np.ndarray:
    """A checkered floor at z = 0 under a blue sky."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ray = np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones_like(u)], -1) @ pose[:3, :3].T
    down = ray[..., 2] < -1e-3
    t = np.where(down, -pose[2, 3] / np.where(down, ray[..., 2], -1.0), 0.0)
    x = pose[:3, 3] + t[..., None] * ray
    checks = (np.floor(x[..., 0]) + np.floor(x[..., 1])) % 2
    floor = np.stack([0.3 + 0.4 * checks, 0.5 - 0.2 * checks, np.full_like(checks, 0.3)], -1)
    return np.where(down[..., None], floor, [0.4, 0.6, 0.9]) * brightness


def make_cameras(folder: Path, n: int = 8) -> Cameras:
    """A drive along x at 1.5 m, once by day and once by night."""
    names, poses = [], []
    for source, brightness in (("day", 1.0), ("night", 0.4)):
        for k in range(n):
            pose = look_at(np.array([0.5 * k, 0.0, 1.5]), np.array([0.5 * k + 4.0, 0.3, 0.0]))
            write_image(folder / "images" / source / f"{k:06d}.png", ground_image(pose, brightness))
            names.append(f"{source}/{k:06d}")
            poses.append(pose)
    lightings = tuple(name.split("/")[0] for name in names)
    held_out = np.arange(2 * n) % n == n // 2
    times = np.tile(np.arange(n, dtype=float), 2)
    sizes = np.tile([WIDTH, HEIGHT], (2 * n, 1))
    return Cameras(
        tuple(names), np.array(poses), np.tile(K, (2 * n, 1)), sizes, lightings, lightings, times, held_out,
        folder / "images",
    )  # fmt: skip


def floor_points(cameras: Cameras, m: int = 200) -> SparsePoints:
    """Points on the floor, each seen by every frame whose image contains it."""
    rng = np.random.default_rng(1)
    xyz = np.stack([rng.uniform(0.0, 9.0, m), rng.uniform(-3.0, 3.0, m), np.zeros(m)], -1)
    point, frame = [], []
    for i in range(len(cameras)):
        pixel, depth = project(xyz, cameras.camera_to_world[i], K)
        seen = np.flatnonzero((depth > 0) & (pixel > 0).all(1) & (pixel < [WIDTH, HEIGHT]).all(1))
        point.append(seen)
        frame.append(np.full(len(seen), i))
    none = np.zeros((m, 3), np.uint8)
    return SparsePoints(xyz, none, np.full(m, 0.5), np.concatenate(point), np.concatenate(frame))


@pytest.fixture
def cameras(tmp_path) -> Cameras:
    return make_cameras(tmp_path)


def test_held_out_frames_are_not_among_the_training_pixels(cameras):
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    assert set(pixels.cameras.names) == {n for n, h in zip(cameras.names, cameras.held_out, strict=True) if not h}
    assert len(pixels.colors) == (~cameras.held_out).sum() * WIDTH * HEIGHT


def test_masked_parts_of_held_out_frames_are_not_scored(cameras, tmp_path):
    first, second = np.flatnonzero(cameras.held_out)
    lower = np.full((HEIGHT, WIDTH), 255, np.uint8)
    lower[HEIGHT // 2 :] = 0
    for i, mask in ((first, np.zeros_like(lower)), (second, lower)):
        write_image(tmp_path / "masks" / f"{cameras.names[i]}.png", mask)
    field = train_field(cameras, SparsePoints.empty(), CONFIG)[0]
    baked = bake(field, TrainingPixels(cameras, SparsePoints.empty(), WIDTH), steps=1, max_bricks=200)[0]
    scores = evaluate(field, replace(cameras, masks=tmp_path / "masks"), WIDTH, baked=baked)
    assert scores["n"] == {"day": 0, "night": 1}
    assert not scores["ssim_small_lower"] and not scores["psnr_small_lower"]


def test_no_training_frame_is_an_input_error(cameras):
    with pytest.raises(InputError, match="held out"):
        TrainingPixels(replace(cameras, held_out=np.ones(len(cameras), bool)), SparsePoints.empty(), WIDTH)


def test_masked_pixels_are_never_sampled(cameras, tmp_path):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :20] = 0
    for name in cameras.names:
        write_image(tmp_path / "masks" / f"{name}.png", mask)
    masked = replace(cameras, masks=tmp_path / "masks")
    pixels = TrainingPixels(masked, floor_points(cameras), WIDTH, camera_height=1.5)
    batch = pixels.batch(np.random.default_rng(0), 2, 20, 100, 40)
    assert batch.pixel[:, 0].min() > 20.0
    write_image(tmp_path / "none.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    for name in cameras.names:
        write_image(tmp_path / "masks" / f"{name}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="masked"):
        TrainingPixels(masked, SparsePoints.empty(), WIDTH)


def test_batch_colors_equal_the_images(cameras):
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    batch = pixels.batch(np.random.default_rng(0), 4, 3, 16, 0)
    assert len(batch.frame) == 4 * (3 * 3 + 16)
    for f, (u, v), color in zip(batch.frame, batch.pixel, batch.color, strict=True):
        image, _, _ = load_frame(pixels.cameras, int(f), WIDTH)
        np.testing.assert_allclose(color, image[int(v), int(u)] / 255.0, atol=1e-6)
    triples = batch.pixel.reshape(4, 25, 2)[:, :9].reshape(-1, 3, 2)
    np.testing.assert_allclose(triples[:, 0] + triples[:, 2], 2.0 * triples[:, 1], atol=1e-5)


def test_depth_supervision_lies_on_the_floor(cameras):
    pixels = TrainingPixels(cameras, floor_points(cameras), WIDTH, camera_height=1.5)
    for pool in (pixels.points, pixels.path):
        assert len(pool.frame) > 50
        pose = pixels.cameras.camera_to_world[pool.frame]
        ray = np.stack([*((pool.pixel - K[2:]) / K[:2]).T, np.ones(len(pool.frame))], -1)
        ray = np.einsum("nij,nj->ni", pose[:, :3, :3], ray / np.linalg.norm(ray, axis=1, keepdims=True))
        height = pose[:, 2, 3] + ray[:, 2] * pool.distance
        np.testing.assert_allclose(height, 0.0, atol=1e-4)


def test_plane_loss_is_zero_on_planes_and_small_at_color_edges():
    pixel = np.random.default_rng(0).uniform(0.0, 1.0, (10, 2))
    step = np.random.default_rng(1).uniform(-0.1, 0.1, (10, 2))
    line = np.stack([pixel - step, pixel, pixel + step], 1)
    inverse = torch.from_numpy((0.3 * line[..., 0] + 0.7 * line[..., 1] + 0.2).ravel()).float()
    gray = torch.full((30, 3), 0.5)
    assert plane_loss(inverse, gray) < 1e-6
    bent = inverse.clone()
    bent[1::3] += 0.05
    striped = gray.clone()
    striped[1::3] = 1.0
    assert plane_loss(bent, striped) < 0.01 * plane_loss(bent, gray)


def test_free_segments_follow_the_path_without_jumps(cameras):
    segments = free_segments(cameras, 0.3)
    assert len(segments) == 16 + 14
    jumped = cameras.camera_to_world.copy()
    jumped[4:8, 0, 3] += 100.0
    segments = free_segments(replace(cameras, camera_to_world=jumped), 0.3)
    assert len(segments) == 16 + 13 and np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).max() < 1.0
    assert len(free_segments(cameras, 0.0)) == 0


@pytest.mark.parametrize("half_extent", [0.0, 0.5])
def test_free_points_are_near_the_path_also_outside_the_near_box(cameras, half_extent):
    trainer = Trainer(cameras, SparsePoints.empty(), replace(CONFIG, near_half_extent=half_extent), 0, "cpu")
    position = 4.0 * trainer._free_points(0, 1000).numpy() - 2.0
    m = np.maximum(np.abs(position).max(1, keepdims=True), 1.0)
    layout = trainer.field.sections[0].layout
    points = position / m / (2.0 - m) * layout.half + layout.centre  # |position| = 2 − 1/|u| outside the near box
    nearest = cameras.positions[0] + np.clip(points[:, :1] - cameras.positions[0, 0], 0.0, 3.5) * [1.0, 0.0, 0.0]
    assert np.linalg.norm(points - nearest, axis=1).max() < CONFIG.near_plane + 1e-3


def test_no_sample_is_at_the_camera(cameras):
    trainer = Trainer(cameras, SparsePoints.empty(), replace(CONFIG, near_plane=0.0), 0, "cpu")
    ws = Workspace(trainer.field.sections[0].layout, 2808, CONFIG.samples, "cpu")
    trainer.field.sections[0].cast(ws, trainer.arrays, 0, 2808)
    trainer.field.sections[0].sample(ws, 2807, 1, 0.1, seed=6763)  # the first random number is 0
    assert ws.distances[2807].min() > 0.0


def test_camera_height_is_used_only_if_known_and_constant():
    metric = {"camera_height_median_m": 1.2, "local_height_spread_m": 0.01, "road_reliable": True}
    assert constant_height(metric) == 1.2
    assert constant_height(metric | {"local_height_spread_m": 0.5}) == 0.0
    assert constant_height(metric | {"road_reliable": False, "scale_source": "gps"}) == 0.0
    assert constant_height(metric | {"camera_height_m_of": {"low": 0.6, "high": 1.2}}) == 0.0
    by_gps = {"camera_height_median_m": 1.2, "road_reliable": True, "scale_source": "gps"}
    assert constant_height(by_gps | {"camera_height_spread_m": 0.02}) == 1.2
    assert constant_height(by_gps | {"camera_height_spread_m": 0.5}) == 0.0
    assert constant_height({}) == 0.0


def trained(cameras: Cameras, config: NerfConfig) -> RadianceField:
    trainer = Trainer(cameras, floor_points(cameras), config, seed=5, device="cpu", camera_height=1.5)
    with single_threaded_torch():
        while not trainer.done:
            trainer.step()
    return trainer.finish()


def test_rays_are_drawn_in_the_memory_of_the_host(cameras):
    """They are drawn while a GPU trains; a copy to its memory would wait for it."""
    trainer = Trainer(cameras, floor_points(cameras), CONFIG, 0, "cpu", camera_height=1.5)
    trainer.device = "meta"
    _, free = trainer._draw(0)
    assert free is not None and free.device.type == "cpu"


def test_training_is_bit_equal_on_any_number_of_cores(cameras, monkeypatch):
    first = trained(cameras, CONFIG)
    monkeypatch.setattr(buffers, "available_cores", lambda: 1)
    second = trained(cameras, CONFIG)
    assert torch.equal(first.sections[0].table, second.sections[0].table)
    assert all(torch.equal(a, b) for a, b in zip(first.sections[0].grids, second.sections[0].grids, strict=True))
    assert all(torch.equal(first.parameters[name], second.parameters[name]) for name in first.parameters)
    assert torch.equal(first.appearance.residuals, second.appearance.residuals)
    assert first.sections[0].table.abs().max() > 0.011  # it did move


@pytest.mark.parametrize("device", DEVICES)
def test_a_training_that_diverges_is_one_line_before_the_field_is_used(cameras, device, monkeypatch):
    """Movers are searched at step 9, between two reports of the error."""
    step = Trainer.step

    def poisoned(self):
        if self.steps_done == 5:
            self.field.parameters["trunk.0"].fill_(float("nan"))
        return step(self)

    monkeypatch.setattr(Trainer, "step", poisoned)
    config = replace(CONFIG, steps=30, transients=True, refine_cameras=True)
    with pytest.raises(InputError, match=r"diverged at step [67]; lower nerf\.learning_rate"):
        train_field(cameras, SparsePoints.empty(), config, device=device)


def test_poles_supervise_the_field_if_the_camera_has_a_constant_height(cameras, monkeypatch):
    pole = Poles(cameras.positions[:1] + cameras.camera_to_world[:1, :3, 2] * 4.0, np.array([0.05]), np.array([2.0]))
    pole.foot[:, 2] = 0.0
    shown = DepthSupervision(np.zeros(3, np.int32), np.full((3, 2), 5.5), np.full(3, 4.0, np.float32))
    monkeypatch.setattr("twin.nerf.trainer.find_poles", lambda *_: pole)
    monkeypatch.setattr("twin.nerf.trainer.pole_depths", lambda _, poles: shown if len(poles) else join_depths([]))

    def known(height, **settings):
        trainer = Trainer(cameras, SparsePoints.empty(), replace(CONFIG, **settings), 0, "cpu", camera_height=height)
        trainer._exclude(
            [np.zeros((h, w), bool) for h, w in zip(trainer.pixels.height, trainer.pixels.width, strict=True)]
        )
        return len(trainer.poles), sum(len(part.points.frame) for part in trainer.parts)

    assert known(1.5) == (1, 3)
    assert known(0.0) == known(1.5, poles=False) == (0, 0)


def test_another_seed_gives_another_field(cameras):
    a = Trainer(cameras, SparsePoints.empty(), CONFIG, 1, "cpu")
    b = Trainer(cameras, SparsePoints.empty(), CONFIG, 2, "cpu")
    assert not torch.equal(a.field.sections[0].table, b.field.sections[0].table)


@pytest.mark.parametrize("device", DEVICES)
def test_training_learns_the_floor_and_both_lightings(cameras, device):
    config = replace(CONFIG, steps=120, rays=512, samples=12, levels=4, log2_table=12)
    field, metrics, *_ = train_field(cameras, floor_points(cameras), config, seed=0, camera_height=1.5, device=device)
    metrics |= evaluate(field, cameras, WIDTH)
    assert metrics["n"] == {"day": 1, "night": 1}
    assert metrics["train_psnr"] > 17.0
    for name in ("day", "night"):
        assert metrics["psnr"][name] > 17.0
        assert metrics["psnr"][name] > metrics["psnr_wrong_lighting"][name] + 3.0
    small = evaluate(field, cameras, 16)  # too small for SSIM's window
    assert small["ssim"] == {} and small["psnr"].keys() == {"day", "night"}
    i = int(np.flatnonzero(cameras.held_out)[0])
    result = field.render(Viewpoints.of(cameras.camera_to_world[i : i + 1], K, (WIDTH, HEIGHT)), "day")
    lower = slice(HEIGHT // 2, None)
    v, u = np.mgrid[:HEIGHT, :WIDTH][:, lower] + 0.5
    ray = np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones_like(u)], -1)
    floor_depth = -1.5 / (ray @ cameras.camera_to_world[i, :3, :3].T)[..., 2]
    assert np.median(np.abs(result.depth[0, lower] / floor_depth - 1.0)) < 0.2

    picture = ground_image(cameras.camera_to_world[i], 0.7)
    one = CameraArrays(cameras.camera_to_world[i : i + 1], K[None], field.device)
    pixels = np.stack([column.ravel() + 0.5 for column in np.mgrid[:HEIGHT, :WIDTH][::-1]], -1)
    features, harmonics, _, _ = field.trace(one, np.zeros(len(pixels), int), pixels)
    colors = torch.as_tensor(picture.reshape(-1, 3).astype(np.float32), device=device)
    fitted, _ = fit_appearance(field.parameters, features, harmonics, colors, field.embedding("day"))
    seen = field.render(Viewpoints.of(cameras.camera_to_world[i : i + 1], K, (WIDTH, HEIGHT)), fitted).rgb[0]
    assert abs(seen.mean() - picture.mean()) < 0.25 * abs(result.rgb[0].mean() - picture.mean())


def test_stage_writes_fields_that_load(cameras, tmp_path):
    scene = SceneDir(tmp_path / "scene")
    scene.stage("metric").mkdir(parents=True)
    cameras.save(scene.stage("metric"))
    floor_points(cameras).save(scene.stage("metric"))
    write_json(scene.stage("metric") / "metric.json", {"camera_height_median_m": 1.5, "road_reliable": True})
    out = tmp_path / "out"
    out.mkdir()
    nerf = replace(CONFIG, bake_steps=20, max_bricks=1500)
    metrics = run(scene, SceneConfig(name="x", source=(SourceConfig(path="a"),), nerf=nerf), out)
    assert metrics["steps"] == 6 and metrics["parameters"] > 0 and metrics["sightings_path"] > 0
    names = ["baked.json", "baked.safetensors", "field.json", "field.safetensors", "poles.npz"]
    assert sorted(p.name for p in out.iterdir()) == names
    assert metrics["cross_lighting"]["poses"] == 14 and metrics["cross_lighting"]["depth_moves_m"] == 0.0
    assert metrics["bake"]["bytes"] > 0 and set(metrics["baking_gain"]) == {"day", "night"}
    assert BakedField.load(out).lightings == RadianceField.load(out).lightings == ("day", "night")


def bricks(facts) -> int:
    return facts["bricks_near"] + facts["bricks_far"]


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_baked_field_renders_like_the_field(cameras, device, monkeypatch):
    config = replace(CONFIG, steps=120, rays=512, samples=12, levels=4, log2_table=12)
    field, *_ = train_field(cameras, floor_points(cameras), config, seed=0, camera_height=1.5, device=device)
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    baked, facts = bake(field, pixels, seed=1, steps=60, max_bricks=1500)
    again, _ = bake(field, pixels, seed=1, steps=60, max_bricks=1500)
    assert 100 < bricks(facts) <= 1500
    # Where cells come out large there may be more of them.
    _, coarse = bake(field, pixels, seed=1, steps=1, max_bricks=150)
    monkeypatch.setattr("twin.nerf.bake._LARGE_CELL", 0.0)
    _, finer = bake(field, pixels, seed=1, steps=1, max_bricks=150)
    assert finer["cell_m"] < coarse["cell_m"] and bricks(coarse) < bricks(finer) <= 209
    assert facts["bytes"] < 30e6
    held_out = cameras.select(np.flatnonzero(cameras.held_out))
    for i, name in enumerate(held_out.lightings):
        pose = held_out.camera_to_world[i : i + 1]
        one = field.render(Viewpoints.of(pose, K, (WIDTH, HEIGHT)), name)
        other = baked.render(Viewpoints.of(pose, K, (WIDTH, HEIGHT)), name)
        assert psnr(other.rgb[0], one.rgb[0]) > 25.0
        lower = (one.depth < 20.0) & (one.opacity > 0.9)
        assert np.median(np.abs(other.depth / one.depth - 1.0)[lower]) < 0.05
        repeated = again.render(Viewpoints.of(pose, K, (WIDTH, HEIGHT)), name)
        # On a GPU, the order of sums changes from run to run.
        assert np.array_equal(other.rgb, repeated.rgb) if device == "cpu" else psnr(other.rgb, repeated.rgb) > 30.0
    probes, day = baked.lightings_by_name.probes, field.embedding("day")
    rays = [torch.from_numpy(array).to(device) for array in (probes.features, probes.harmonics)]
    assert np.allclose(probes.picture(day), field.color(*rays, day), atol=1e-5)
    assert np.ptp(probes.picture(day).mean(1)) > 0.1
    drawn = baked.sample_lighting(np.random.default_rng(0))
    assert not baked.lightings_by_name.prior.violations(drawn)
    scores = evaluate(field, cameras, WIDTH, baked=baked)
    assert all(scores["baking_gain"][name] > -1.0 for name in ("day", "night"))


@pytest.mark.parametrize(("value", "message"), [("tpu", "cpu or cuda"), ("cuda", "no CUDA device")])
def test_unavailable_device_is_an_input_error(monkeypatch, value, message):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match=message):
        buffers.resolve_device(value)


def test_field_without_visible_surface_is_not_baked(cameras):
    config = replace(CONFIG, steps=2, near_plane=100.0)  # [m] everything is nearer
    field, *_ = train_field(cameras, floor_points(cameras), config, device="cpu")
    with pytest.raises(InputError, match=r"nothing to bake.*near_plane"):
        bake(field, TrainingPixels(cameras, SparsePoints.empty(), WIDTH), steps=1)
