"""Transients: movers and objects that left are found, and static places are left alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import AnalyticField, Box
from test_stereo import HEIGHT, PLACE, WIDTH, K, pattern, points_of, poses

from twin.config import NerfConfig, SceneConfig, SourceConfig
from twin.files import write_json
from twin.geometry.cameras import Cameras, SparsePoints, Viewpoints, pixel_grid, unproject
from twin.geometry.images import write_image
from twin.nerf import trainer as training
from twin.nerf import transients
from twin.nerf.dataset import DepthSupervision, TrainingPixels, join_depths
from twin.nerf.trainer import Trainer
from twin.scene import SceneDir

CAR = Box(7.0, -2.0, 3.6, 1.7, 1.4)
MOVING = slice(30, 66)  # rows of a mover


pytestmark = pytest.mark.usefixtures("quiet")


def columns(i: int) -> slice:
    """Columns of the mover in frame i: it crosses the picture."""
    return slice(20 + 9 * i, 38 + 9 * i)


def film(folder: Path, lighting: str, place: AnalyticField, n: int = 12, mover: bool = False, gain: float = 1.0):
    """Cameras of a drive through a place, and the true depths of its frames, shape (n, height, width)."""
    pose = poses(n)
    depth = place.render(Viewpoints.of(pose, K, (WIDTH, HEIGHT)), "day").depth
    names = tuple(f"{lighting}/{i:06d}" for i in range(n))
    (folder / lighting).mkdir(parents=True, exist_ok=True)
    rays = unproject(pixel_grid(WIDTH, HEIGHT), K)
    for i, name in enumerate(names):
        gray = pattern((rays * depth[i][..., None]) @ pose[i, :3, :3].T + pose[i, :3, 3])
        gray[depth[i] > 100.0] = 0.8
        picture = np.repeat(gray[..., None], 3, -1)
        if mover:
            picture[MOVING, columns(i)] = [0.9, 0.2, 0.1]
        picture *= gain * (1.0 + 0.05 * np.sin(i))
        write_image(folder / f"{name}.png", (np.clip(picture, 0.0, 1.0) * 255).astype(np.uint8))
    cameras = Cameras(
        *(names, pose, np.tile(K, (n, 1)), np.tile([WIDTH, HEIGHT], (n, 1)), (lighting,) * n, (lighting,) * n),
        *(np.arange(n) / 2.0, np.zeros(n, bool), folder),
    )
    return cameras, depth


def cell_depths(pixels: TrainingPixels, depth: np.ndarray) -> list[np.ndarray]:
    """True depths at the centers of the frames' cells."""
    centers = transients.cell_centers(WIDTH, HEIGHT, transients.cell_size(pixels)).astype(int)
    return [frame[centers[..., 1], centers[..., 0]].astype(np.float32) for frame in depth]


def supervision(pixels: TrainingPixels, depth: np.ndarray) -> DepthSupervision:
    """True depths of the pixels nearer than 25 m."""
    v, u = (k.ravel() for k in np.mgrid[1 : HEIGHT - 1, 1 : WIDTH - 1])
    parts = []
    for i, frame in enumerate(depth):
        z = frame[v, u]
        near = z < 25.0
        pixel = np.stack([u, v], 1)[near] + 0.5
        distance = z[near] * np.linalg.norm(unproject(pixel, K), axis=1)
        parts.append(DepthSupervision(np.full(near.sum(), i, np.int32), pixel, distance.astype(np.float32)))
    return join_depths(parts)


def joined(one: Cameras, other: Cameras) -> Cameras:
    arrays = ("camera_to_world", "intrinsics", "sizes", "times", "held_out")
    texts = ("names", "lightings", "sources")
    return replace(
        one,
        **{name: np.concatenate([getattr(one, name), getattr(other, name)]) for name in arrays},
        **{name: getattr(one, name) + getattr(other, name) for name in texts},
    )


def test_a_mover_is_found_in_every_frame_and_little_else(tmp_path):
    cameras, depth = film(tmp_path, "day", PLACE, mover=True)
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    masks = np.array(transients.mover_masks(pixels, cell_depths(pixels, depth)))
    mover, around = (np.zeros((len(depth), HEIGHT, WIDTH), bool) for _ in range(2))
    for i in range(len(depth)):
        mover[i, MOVING, columns(i)] = True
        around[i, 22:74, max(0, columns(i).start - 8) : columns(i).stop + 8] = True
    # At the ends of the film, surfaces near the border of a frame are seen in too few others.
    assert (masks & mover)[1:-1].sum() > 0.9 * mover[1:-1].sum()
    assert (masks & ~around).mean() < 0.005
    shown = transients.picture(pixels, list(masks)).astype(int)
    assert shown.shape == (180, 2 * 320, 3) and (shown[..., 0] - shown[..., 1] > 60).any()


def test_nothing_is_left_out_of_a_static_film(tmp_path):
    cameras, depth = film(tmp_path, "day", PLACE)
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    pixels.stereo = supervision(pixels, depth)
    assert np.array(transients.mover_masks(pixels, cell_depths(pixels, depth))).mean() < 0.003
    assert not transients.left_objects(pixels)


def test_what_darkens_the_same_place_of_every_frame_is_no_mover(tmp_path):
    cameras, depth = film(tmp_path, "day", PLACE, n=20)
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    frames = pixels.colors.reshape(-1, HEIGHT, WIDTH, 3)
    frames[:, 70:, 40:120] //= 2
    masks = np.array(transients.mover_masks(pixels, cell_depths(pixels, depth)))
    assert masks[:, 70:, 40:120].mean() < 0.05  # 0.6 if such cells were not dropped


def test_a_car_that_left_is_found_and_excluded_where_it_stands(tmp_path):
    with_car = AnalyticField(boxes=(*PLACE.boxes, CAR), amplitude=0.0)
    day, day_depth = film(tmp_path, "day", with_car)
    night, night_depth = film(tmp_path, "night", PLACE, gain=0.3)
    cameras, depth = joined(day, night), np.concatenate([day_depth, night_depth])
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    pixels.stereo = supervision(pixels, depth)
    (car,) = transients.left_objects(pixels)
    assert car.present == ("day",) and car.absent == ("night",)
    half = 0.5 * np.array([CAR.length, CAR.width, CAR.top])
    assert (np.abs(car.voxels - [CAR.x, CAR.y, half[2]]) < half + 0.4).all()
    assert car.size[0] > 0.8 * CAR.length and car.size[2] > 0.7 * CAR.top  # its far side is not seen
    shows = day_depth < night_depth - 0.01
    masks = np.array(transients.object_masks(pixels, [car]))
    assert (masks[: len(day)] & shows).sum() > 0.97 * shows.sum()
    assert not masks[len(day) :].any()
    assert masks[: len(day)].sum() < 2.5 * shows.sum()
    assert car.to_json()["present"] == ["day"]


def test_excluded_pixels_are_neither_sampled_nor_supervised(tmp_path):
    cameras, depth = film(tmp_path, "day", PLACE)
    pixels = TrainingPixels(cameras, points_of(cameras), WIDTH)
    pixels.stereo = supervision(pixels, depth)
    before = len(pixels.stereo.frame)
    mask = np.zeros((len(cameras), HEIGHT, WIDTH), bool)
    mask[:, :, : WIDTH // 2] = True
    mask[3] = True  # a frame would lose everything: it is kept
    pixels.exclude(list(mask))
    batch = pixels.batch(np.random.default_rng(0), 2, 50, 200, 60)
    inside = batch.frame != 3
    assert (batch.pixel[inside, 0] > WIDTH // 2 - 1).all() and (batch.frame == 3).any()
    assert 0 < len(pixels.stereo.frame) < before


def test_training_leaves_out_what_was_found_and_can_be_told_not_to(tmp_path):
    cameras, _ = film(tmp_path, "day", PLACE, mover=True)
    config = NerfConfig(steps=10, rays=256, samples=8, levels=3, log2_table=10, max_width=WIDTH, stereo=False)
    trainer = Trainer(cameras, points_of(cameras), config, 0, "cpu")
    while not trainer.done:
        assert bool(trainer.excluded) == (trainer.steps_done > 3)
        trainer.step()
    excluded = np.concatenate([mask.ravel() for mask in trainer.excluded])
    assert (trainer.pixels.unmasked == ~excluded).all() and trainer.moving == pytest.approx(excluded.mean())
    trainer = Trainer(cameras, points_of(cameras), replace(config, transients=False), 0, "cpu")
    while not trainer.done:
        trainer.step()
    assert not trainer.excluded and trainer.pixels.unmasked.all()


def test_photos_of_many_lightings_have_no_transients(tmp_path):
    cameras, depth = film(tmp_path, "day", PLACE, n=3)
    cameras = replace(cameras, lightings=("a", "b", "c"))
    pixels = TrainingPixels(cameras, SparsePoints.empty(), WIDTH)
    assert not np.array(transients.mover_masks(pixels, cell_depths(pixels, depth))).any()
    assert not transients.left_objects(pixels)


def test_an_object_that_left_is_excluded_before_training_begins(tmp_path, monkeypatch):
    day, day_depth = film(tmp_path, "day", AnalyticField(boxes=(*PLACE.boxes, CAR), amplitude=0.0))
    night, night_depth = film(tmp_path, "night", PLACE, gain=0.3)
    depth = np.concatenate([day_depth, night_depth])
    monkeypatch.setattr(training, "stereo_depths", lambda pixels, *_: (supervision(pixels, depth), {}))
    config = NerfConfig(steps=10, rays=256, samples=8, levels=3, log2_table=10, max_width=WIDTH)
    trainer = Trainer(joined(day, night), SparsePoints.empty(), config, 0, "cpu")
    assert len(trainer.left) == 1 and not trainer.steps_done
    shows = np.concatenate([(day_depth < night_depth - 0.01).ravel(), np.zeros(night_depth.size, bool)])
    assert trainer.pixels.unmasked[shows].mean() < 0.03 and trainer.pixels.unmasked.mean() > 0.6


def test_rays_that_are_drawn_ahead_avoid_the_movers(tmp_path, monkeypatch):
    """Each step draws the rays of the next one, except of that which finds the movers."""
    cameras, _ = film(tmp_path, "day", PLACE, n=3)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :40] = True
    monkeypatch.setattr(training, "mover_masks", lambda pixels, _: [mask] * len(pixels.cameras))
    config = NerfConfig(steps=4, rays=256, samples=8, levels=3, log2_table=10, max_width=WIDTH, stereo=False)
    trainer = Trainer(cameras, SparsePoints.empty(), config, 0, "cpu")
    assert trainer.movers_step == 1
    masked = []
    while not trainer.done:
        trainer.step()
        masked.append(bool((trainer.ws.pixel[:, 0] < 40).any()))
    assert masked == [True, False, False, False]


def test_baking_uses_the_pixels_that_training_used(tmp_path, monkeypatch):
    scene, out = SceneDir(tmp_path / "scene"), tmp_path / "out"
    cameras, _ = film(tmp_path, "day", PLACE)
    for folder in (scene.stage("metric"), out):
        folder.mkdir(parents=True)
    cameras.save(scene.stage("metric"))
    points_of(cameras).save(scene.stage("metric"))
    write_json(scene.stage("metric") / "metric.json", {})
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :40] = True
    monkeypatch.setattr(training, "mover_masks", lambda pixels, _: [mask] * len(pixels.cameras))
    baked_from = []

    def stop(_, pixels: TrainingPixels, *__) -> None:
        baked_from.append(pixels)
        raise InterruptedError

    monkeypatch.setattr(training, "bake", stop)
    nerf = NerfConfig(steps=4, rays=256, samples=8, levels=3, log2_table=10, max_width=WIDTH, stereo=False)
    with pytest.raises(InterruptedError):
        training.run(scene, SceneConfig(name="x", source=(SourceConfig(path="a"),), nerf=nerf), out)
    assert (baked_from[0].unmasked == np.tile(~mask.ravel(), len(cameras))).all()
    assert (out / "excluded.jpg").is_file()
