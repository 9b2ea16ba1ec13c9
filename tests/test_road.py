"""Roads of several sections: division, blending at borders, training, files."""

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_baked import LAYOUT, SIZE, K, baked, wall
from test_fit import CONFIG, HEIGHT, WIDTH, floor_points, make_cameras
from test_fit import K as FIT_K

from twin.errors import InputError
from twin.geometry.cameras import SparsePoints, Viewpoints
from twin.geometry.poses import look_at
from twin.nerf import baked as baked_module
from twin.nerf import road as road_module
from twin.nerf.bake import bake
from twin.nerf.baked import BakedField
from twin.nerf.baked_arrays import BakedSection
from twin.nerf.dataset import TrainingPixels, join_depths
from twin.nerf.detail import fit_detail
from twin.nerf.evaluate import evaluate
from twin.nerf.field import RadianceField
from twin.nerf.road import OVERLAP, RoadSections, divide_road, undivided_road
from twin.nerf.trainer import Trainer, train_field

pytestmark = pytest.mark.usefixtures("quiet")


def line(length: float, step: float = 0.7) -> np.ndarray:
    x = np.arange(0.0, length, step)
    return np.stack([x, np.zeros_like(x), np.full_like(x, 1.2)], 1)


# ---- division


def test_short_road_is_one_section():
    assert divide_road(line(60.0), 65.0).count == 1
    assert divide_road(line(5000.0, 5.0), 0.0).count == 1
    assert divide_road(np.zeros((3, 3)), 65.0).count == 1


def test_straight_road_is_divided_evenly_however_often_it_was_filmed():
    once = line(300.0)
    for positions in (once, np.concatenate([once, once[::-1] + np.array([0.0, 2.0, 0.0]), once])):
        road = divide_road(positions, 65.0)
        assert road.count == 5
        spans = [np.ptp(positions[road.section == k, 0]) for k in range(5)]
        assert min(spans) > 50.0 and max(spans) < 70.0


def test_sections_of_a_loop_are_arcs():
    angle = np.arange(0.0, 2 * np.pi, 0.01)
    loop = 60.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    road = divide_road(loop, 65.0)
    assert road.count == 6
    changes = (np.diff(road.section, append=road.section[0]) != 0).sum()
    assert changes == 6


def test_frames_placed_far_off_the_road_do_not_divide_it():
    positions = line(300.0)
    wrong = positions + 0.0
    wrong[[50, 200]] += [[3e7, 0.0, 1e6], [-400.0, 900.0, 0.0]]
    road = divide_road(wrong, 65.0)
    right = np.delete(np.arange(len(positions)), [50, 200])
    spans = [np.ptp(positions[right][road.section[right] == k, 0]) for k in range(road.count)]
    assert len(spans) == 5 and min(spans) > 50.0 and max(spans) < 70.0


def test_section_has_enough_frames():
    assert divide_road(line(300.0, 20.0), 65.0).count == 1
    road = divide_road(line(300.0, 6.0), 65.0)
    assert road.count >= 3 and min(np.bincount(road.section)) >= 10


def test_training_frames_overlap():
    positions = line(130.0)
    road = divide_road(positions, 65.0)
    first, second = (positions[frames, 0] for frames in road.frames(positions))
    low, high = sorted((first, second), key=lambda x: x.min())
    assert low.max() - high.min() == pytest.approx(2 * OVERLAP, abs=2.0)


def test_share_of_the_second_section_changes_without_a_jump():
    positions = line(130.0, 0.25)
    road = divide_road(positions, 65.0)
    x = np.arange(10.0, 120.0, 0.01)
    at = np.stack([x, np.full_like(x, 0.3), np.full_like(x, 0.5)], 1)
    share = road.shares(at)
    assert np.array_equal(share.argmax(1), road.nearest(at))
    np.testing.assert_allclose(share.sum(1), 1.0)
    weight = share[:, road.nearest(at[:1])[0]]
    assert weight[0] == 1.0 and weight[-1] == 0.0
    assert np.abs(np.diff(weight)).max() < 0.01
    blended = x[(weight > 0.0) & (weight < 1.0)]
    assert 1.0 < np.ptp(blended) < 6.0


def test_shares_are_continuous_where_three_sections_meet():
    x, _, z = line(40.0).T
    arms = [np.stack([np.cos(angle) * x, np.sin(angle) * x, z], 1) for angle in (0.0, 2.0, 4.0)]
    road = RoadSections(np.concatenate(arms), np.repeat([0, 1, 2], len(x)))
    turn, radius = np.linspace(0.0, 6.0 * np.pi, 20_000), np.linspace(3.0, 0.1, 20_000)
    spiral = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, 1.2)], 1)
    share = road.shares(spiral)
    assert np.abs(np.diff(share, axis=0)).max() < 0.01
    assert ((share > 0.0).sum(1) == 3).any() and len(set(share.argmax(1))) == 3


# ---- rendering


def two_sections() -> tuple[BakedField, BakedField, BakedField]:
    """Walls at x = 1 and at x = 2; a field that has the first for cameras at y < 0 and the second for others."""
    near, far = baked(wall(1.0, 11.0)), baked(wall(2.0, 11.0))
    y = np.arange(-20.0, 20.0, 0.5) + 0.25
    points = np.stack([np.full_like(y, -3.0), y, np.zeros_like(y)], 1)
    road = RoadSections(points, (y > 0.0).astype(np.int64))
    both = BakedField(
        [near.sections[0], far.sections[0]], near.lightings_by_name, near.networks, near.device, road=road
    )
    return near, far, both


def views(*ys: float) -> Viewpoints:
    poses = [look_at(np.array([-3.0, y, 0.0]), np.array([3.0, y, 0.0])) for y in ys]
    return Viewpoints.of(np.array(poses), np.tile(K, (len(ys), 1)), SIZE)


def test_cameras_are_rendered_by_their_section_and_blended_at_the_border():
    near, far, both = two_sections()
    out = both.render(views(-2.9, 0.0, 2.9), ["day", "night", "day"])
    for k, (alone, y) in enumerate(((near, -2.9), (None, 0.0), (far, 2.9))):
        if alone:
            one = alone.render(views(y), "day")
            for name in ("rgb", "depth", "opacity"):
                assert np.array_equal(getattr(out, name)[k], getattr(one, name)[0])
    a, b = (field.render(views(0.0), "night") for field in (near, far))
    assert np.abs(a.rgb - b.rgb).max() > 0.01
    assert np.abs(out.rgb[1] - 0.5 * (a.rgb + b.rgb)[0]).max() < 1e-6
    # A depth between those of two surfaces would be that of neither.
    assert np.array_equal(out.depth[1], a.depth[0]) or np.array_equal(out.depth[1], b.depth[0])


def test_pictures_change_steadily_across_the_border():
    near, far, both = two_sections()
    ys = np.arange(-3.0, 3.0, 0.05)
    pictures = both.render(views(*ys), "day").rgb
    steps = np.abs(np.diff(pictures, axis=0)).mean((1, 2, 3))
    limit = 0.1 * np.abs(near.render(views(0.0), "day").rgb - far.render(views(0.0), "day").rgb).mean()
    alone = np.concatenate([(near if y < 0.0 else far).render(views(y), "day").rgb for y in ys])
    step_without_blending = np.abs(np.diff(alone, axis=0)).mean((1, 2, 3)).max()
    assert steps.max() < np.median(steps) + limit < step_without_blending


def test_device_features_stop_and_copies_agree_with_render():
    near, _, both = two_sections()
    shown = views(-2.9, 0.0, 2.9)
    out, got = both.render(shown, "day"), {}
    both.render_on_device(shown, "day", lambda rgb, opacity: got.update(rgb=rgb.numpy(), opacity=opacity.numpy()))
    assert np.array_equal(got["rgb"].reshape(out.rgb.shape), out.rgb)
    assert np.array_equal(got["opacity"].reshape(out.opacity.shape), out.opacity)
    assert np.array_equal(both.single_threaded().render(shown, "day").rgb, out.rgb)
    rendering, features = both.render_features(shown, "day")
    assert np.array_equal(features[0], near.render_features(views(-2.9), "day")[1][0])
    assert np.array_equal(rendering.rgb[[0, 2]], out.rgb[[0, 2]])
    stop = np.full((3, SIZE[1], SIZE[0]), 2.0)
    assert both.render(shown, "day", stop=stop).opacity.max() < 0.05


def test_colors_before_a_stop_count_by_opacity():
    """Between the walls, one section is opaque; the other is transparent and may have any color."""
    near, far, both = two_sections()
    stop = np.full((1, SIZE[1], SIZE[0]), 4.6)
    out = both.render(views(0.0), "day", stop=stop)
    a, b = (field.render(views(0.0), "day", stop=stop) for field in (near, far))
    assert a.opacity.min() > 0.9 and b.opacity.max() < 0.1
    expected = 0.5 * (a.opacity[..., None] * a.rgb + b.opacity[..., None] * b.rgb)
    np.testing.assert_allclose(out.opacity[..., None] * out.rgb, expected, atol=1e-5)
    assert np.abs(out.rgb - a.rgb).max() < 0.1


def test_sections_are_read_on_demand_and_dropped(tmp_path, monkeypatch):
    near, far, both = two_sections()
    both.save(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {
        *("baked.json", "baked.safetensors", "baked_1.safetensors", "road.safetensors")
    }
    loaded = BakedField.load(tmp_path)
    assert np.array_equal(loaded.bounds, both.bounds) and not loaded._resident
    loaded.render(views(-2.9), "day")
    assert list(loaded._resident) == [0]
    monkeypatch.setattr(baked_module, "_MAX_RESIDENT", 1)
    copy, gone = loaded.single_threaded(), []
    gc.disable()  # dropped sections leave memory at once, not with the next collection
    for y, alone in ((2.9, far), (-2.9, near), (2.9, far)):
        for field in (loaded, copy):  # the second one reads nothing
            assert np.array_equal(field.render(views(y), "day").rgb, alone.render(views(y), "day").rgb)
        assert len(loaded._resident) == 1
        gone.append(weakref.ref(next(iter(loaded._resident.values()))))
    freed = [one() is None for one in gone]
    gc.enable()
    assert freed == [True, True, False]
    # Sections that one call needs do not replace each other.
    out = loaded.render(views(-2.9, 2.9), "day")
    assert np.array_equal(out.rgb[1], far.render(views(2.9), "day").rgb[0]) and len(loaded._resident) == 2


def test_sections_render_in_several_threads(monkeypatch):
    near, far, both = two_sections()
    monkeypatch.setattr(baked_module, "_MAX_RESIDENT", 1)
    wanted = {y: field.render(views(y), "day").rgb for y, field in ((-2.9, near), (2.9, far))}

    def drive(field: BakedField) -> bool:
        return all(np.array_equal(field.render(views(y), "day").rgb, wanted[y]) for y in (-2.9, 2.9) * 5)

    with ThreadPoolExecutor(3) as pool:
        assert all(pool.map(drive, [both.single_threaded() for _ in range(3)]))


@pytest.mark.parametrize("name", ["baked_1.safetensors", "road.safetensors"])
def test_damaged_section_is_an_input_error(name, tmp_path):
    _, _, both = two_sections()
    both.save(tmp_path)
    (tmp_path / name).write_bytes(b"broken")
    with pytest.raises(InputError, match=name):
        BakedField.load(tmp_path).render(views(2.9), "day")


def test_section_with_indices_out_of_range_is_refused(tmp_path):
    near, far, both = two_sections()
    arrays = far.sections[0].arrays
    bad = BakedSection(LAYOUT, arrays | {"near": arrays["near"] + 1000})
    BakedField([near.sections[0], bad], near.lightings_by_name, near.networks, road=both.road).save(tmp_path)
    with pytest.raises(InputError, match=r"baked_1\.safetensors"):
        BakedField.load(tmp_path).render(views(2.9), "day")


def test_damaged_detail_is_refused_before_rendering(tmp_path):
    near, _, both = two_sections()
    bad = BakedSection(LAYOUT, near.sections[0].arrays | {"detail.sides": np.zeros(3)})
    BakedField([bad, near.sections[0]], near.lightings_by_name, near.networks, road=both.road).save(tmp_path)
    with pytest.raises(InputError, match=r"baked\.safetensors"):
        BakedField.load(tmp_path)


# ---- training


@pytest.mark.slow
def test_field_of_two_sections_learns_renders_and_survives_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(road_module, "OVERLAP", 2.0)
    cameras = make_cameras(tmp_path, 28)
    config = replace(
        CONFIG, steps=80, rays=512, samples=12, levels=4, log2_table=12, section_length=5.0, transients=False
    )
    field, metrics, *_ = train_field(cameras, floor_points(cameras), config, camera_height=1.5, device="cpu")
    assert metrics["sections"] == field.road.count == 2 and metrics["steps"] == 160
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    baked, facts = bake(field, pixels, steps=30, max_bricks=1500)
    assert facts["bricks_near"] + facts["bricks_far"] <= 3000
    assert fit_detail(baked, field.appearance, pixels, join_depths([]), seed=0, passes=2.0)["pixels"] > 0
    scores = evaluate(field, cameras, WIDTH, baked=baked)
    for name in ("day", "night"):
        assert scores["psnr"][name] > 16.0
        assert scores["psnr"][name] > scores["psnr_wrong_lighting"][name] + 3.0
    field.save(tmp_path)
    baked.save(tmp_path)
    shown = Viewpoints.of(cameras.camera_to_world[[1, 13, 14, 26]], FIT_K, (WIDTH, HEIGHT))
    for kind, before in ((RadianceField, field), (BakedField, baked)):
        after = kind.load(tmp_path)
        assert np.array_equal(after.render(shown, "day").rgb, before.render(shown, "day").rgb)
        assert np.array_equal(after.bounds, before.bounds)
    # Far from the border, a camera sees what its own section alone shows.
    section = int(field.road.nearest(cameras.positions[[1]])[0])
    one = Viewpoints.of(shown.camera_to_world[:1], FIT_K, (WIDTH, HEIGHT))
    alone = baked.alone(section).render(one, "day")
    assert np.array_equal(alone.rgb[0], baked.render(shown, "day").rgb[0])


def test_sections_train_on_their_own_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(road_module, "OVERLAP", 1.0)
    cameras = make_cameras(tmp_path, 28)
    trainer = Trainer(cameras, floor_points(cameras), replace(CONFIG, section_length=5.0), 0, "cpu", camera_height=1.5)
    rng = np.random.default_rng(0)
    for part, frames in zip(trainer.parts, trainer.frames, strict=True):
        batch = part.batch(rng, 4, 5, 60, 20)
        assert set(batch.frame) <= set(frames.tolist()) and len(set(batch.frame)) > len(frames) / 2
        for name in ("points", "path"):
            assert set(getattr(part, name).frame) <= set(frames.tolist())
    before = [section.table.clone() for section in trainer.field.sections]
    trainer.step()
    first, second = (torch.equal(a, b.table) for a, b in zip(before, trainer.field.sections, strict=True))
    assert second and not first
    marked = [np.zeros((HEIGHT, WIDTH), bool) for _ in trainer.pixels.width]
    one = int(trainer.frames[0][0])
    marked[one][: HEIGHT // 2] = True
    trainer._exclude(marked)
    row = trainer.parts[0].batch(rng, 4, 0, 400, 0)
    assert (row.frame == one).any() and (row.pixel[row.frame == one, 1] > HEIGHT // 2).all()


def test_road_of_one_section_needs_no_file(tmp_path):
    undivided_road().save(tmp_path)
    assert not list(tmp_path.iterdir()) and RoadSections.load(tmp_path, 1).count == 1
    with pytest.raises(InputError, match=r"road\.safetensors"):
        RoadSections.load(tmp_path, 2)
