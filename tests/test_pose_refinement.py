"""Pose refinement: gradients against finite differences, and correction of rotated cameras."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_fit import CONFIG, floor_points, make_cameras

from twin.geometry.cameras import Cameras
from twin.nerf.buffers import single_threaded_torch
from twin.nerf.pose_refinement import PoseRefinement, apply_corrections
from twin.nerf.trainer import Trainer, train_field

REFINING = replace(CONFIG, refine_cameras=True)


@pytest.fixture
def cameras(tmp_path) -> Cameras:
    return make_cameras(tmp_path)


def test_correction_rotates_about_the_center_and_translates():
    pose = torch.eye(4, dtype=torch.float64)[None].repeat(2, 1, 1)
    pose[:, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    turn = torch.tensor([[0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0]], dtype=torch.float64)
    shift = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], dtype=torch.float64)
    out = apply_corrections(pose, turn, shift).numpy()
    np.testing.assert_allclose(out[0, :3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(out[:, :3, 3], [[1.0, 2.0, 3.0], [1.1, 2.0, 3.0]])


def test_gradients_equal_finite_differences(cameras):
    """The loss is Σ wᵢ·featureᵢ along rays at fixed sample distances, inside and outside the near box."""
    trainer = Trainer(cameras, floor_points(cameras), REFINING, 0, "cpu")
    ws, section, refinement = trainer.ws, trainer.field.sections[0], trainer.refinement
    assert refinement is not None
    rng = np.random.default_rng(0)
    section.table.copy_(torch.as_tensor(rng.normal(size=section.table.shape)))
    ws.camera.copy_(torch.as_tensor(rng.integers(14, size=ws.rays)))
    ws.pixel.copy_(torch.as_tensor(rng.uniform(2, 22, (ws.rays, 2))))
    rows = ws.rays * ws.samples
    weights = torch.as_tensor(rng.normal(size=(rows, ws.features.shape[1])), dtype=torch.float32)
    section.cast(ws, trainer.arrays, 0, ws.rays)
    ws.distances.copy_(torch.as_tensor(np.sort(rng.uniform(0.2, 6.0, ws.distances.shape), 1)))
    centre, half = torch.tensor(section.layout.centre), torch.tensor(section.layout.half)

    def value(origin: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        """The sum per ray, shape (n,)."""
        meters = (origin[:, None] + ws.distances[..., None] * direction[:, None]).reshape(-1, 3)
        ws.positions[:rows] = torch.from_numpy(section.layout.grid_positions(meters.double().numpy()))
        section.query(ws, 0, rows)
        return (ws.features[:rows].double() * weights).sum(1).view(ws.rays, -1).sum(1)

    value(ws.origins, ws.directions)
    ws.features_grad[:rows].copy_(weights)
    refinement.backward(section, 0, ws.rays)
    meters = ws.origins[:, None] + ws.distances[..., None] * ws.directions[:, None]
    outside = (((meters - centre) / half).abs().amax(-1) > 1.0).sum()
    assert 50 < outside < rows - 50
    for axis in range(3):
        for which, step in ((0, 1e-3), (1, 5e-5)):
            sides = []
            for sign in (1.0, -1.0):
                moved = [ws.origins.clone(), ws.directions.clone()]
                moved[which][:, axis] += sign * step
                sides.append(value(*moved))
            numeric = (sides[0] - sides[1]) / (2.0 * step)
            error = (refinement._ray_grad[which, :, axis] - numeric).abs() / numeric.abs().median()
            # Some samples straddle the border of a cell, where the gradient jumps.
            assert error.median() < 0.02


@pytest.mark.slow
def test_rotated_frames_are_corrected_in_a_trained_field(cameras, monkeypatch):
    config = replace(REFINING, steps=300, rays=512, samples=12, levels=4, log2_table=12, stereo=False, sightings=0.0)
    trainer = Trainer(cameras, floor_points(cameras), config, 0, "cpu", camera_height=1.5)
    refinement, given = trainer.refinement, trainer.pixels.cameras.camera_to_world
    assert refinement is not None
    turn = np.random.default_rng(4).normal(0, 0.05, (len(given), 3))
    turn = torch.as_tensor(turn - turn.mean(0))

    def error() -> float:
        """Median angle [rad] between the cameras and the true ones, after removing the mean rotation."""
        relative = refinement.arrays.rotation.numpy() @ given[:, :3, :3].transpose(0, 2, 1)
        angles = np.stack([relative[:, 2, 1], relative[:, 0, 2], relative[:, 1, 0]], 1)
        return float(np.median(np.linalg.norm(angles - angles.mean(0), axis=1)))

    with single_threaded_torch(), monkeypatch.context() as still:
        still.setattr(Trainer, "_refines", False)
        while not trainer.done:
            trainer.step()
    refinement._initial = apply_corrections(torch.as_tensor(given), turn, torch.zeros_like(turn))
    refinement.arrays.set_poses(refinement._initial.numpy())
    wrong = error()
    for part in ("_update_levels", "_update_grids"):  # the field stays
        monkeypatch.setattr(trainer, part, lambda *_: None)
    monkeypatch.setattr(trainer.optimizer, "step", lambda: None)
    monkeypatch.setattr(trainer, "rate", lambda: 0.5)
    with single_threaded_torch():
        errors = [float(trainer.step().mean()) for _ in range(150)]
    assert error() < 0.6 * wrong
    assert np.mean(errors[-30:]) < 0.8 * np.mean(errors[:30])


def test_cameras_move_only_with_refinement(cameras):
    _, metrics, same, *_ = train_field(cameras, floor_points(cameras), CONFIG, camera_height=1.5, device="cpu")
    assert metrics["cameras_moved"] is None and same is cameras
    _, metrics, moved, *_ = train_field(cameras, floor_points(cameras), REFINING, camera_height=1.5, device="cpu")
    assert metrics["cameras_moved"]["most_m"] > 0.0 and moved.names == cameras.names
    assert not np.array_equal(moved.camera_to_world, cameras.camera_to_world)


def test_held_out_frames_move_with_their_neighbors(cameras):
    refinement = Trainer(cameras, floor_points(cameras), REFINING, 0, "cpu").refinement
    assert isinstance(refinement, PoseRefinement)
    with torch.no_grad():
        refinement.translation[:, 0] = torch.arange(14.0) / 10.0
    found, said = refinement.refined_cameras(cameras)
    shift = (found.camera_to_world - cameras.camera_to_world)[:, 0, 3]
    np.testing.assert_allclose(shift[~cameras.held_out], np.arange(14) / 10.0, atol=1e-6)
    for i in np.flatnonzero(cameras.held_out):
        np.testing.assert_allclose(shift[i], (shift[i - 1] + shift[i + 1]) / 2, atol=1e-6)
    assert said["most_m"] == pytest.approx(1.3) and said["most_deg"] == 0.0


def test_refinement_is_bit_equal(cameras):
    def once() -> tuple[torch.Tensor, torch.Tensor]:
        trainer = Trainer(cameras, floor_points(cameras), REFINING, 5, "cpu")
        with single_threaded_torch():
            while not trainer.done:
                trainer.step()
        assert trainer.refinement is not None
        return trainer.refinement.rotation.detach(), trainer.field.sections[0].table

    first, second = once(), once()
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True)) and first[0].abs().max() > 0.0
