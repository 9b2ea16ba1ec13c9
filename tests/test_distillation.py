"""Distillation on pictures of a spot: the updates, the policy's file, and resumption from saved states."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

import torch

from twin.errors import InputError
from twin.learn.distillation import Distillation, Encoder, load_state, save_state
from twin.learn.policy import load_policy, save_policy
from twin.learn.policy_network import Architecture, normalize_colors, preprocess
from twin.learn.replay_buffer import PictureBuffer
from twin.learn.teacher import STATE_SCALES, Teacher
from twin.learn.train_config import TrainConfig

SIZE = (32, 18)
TINY = Architecture(SIZE, 2, 2, ((8, 5, 3),), 16, (32, 32), 1)
ENVS = 2


def steering_teacher() -> Teacher:
    """A teacher that steers against the cross-track error, by 0.8 at 1 m."""
    torch.manual_seed(0)
    teacher = Teacher(1)
    for parameter in teacher.parameters():
        parameter.zero_()
    # The error's positive and negative part pass through one unit of each hidden layer.
    for unit, sign in enumerate((1.0, -1.0)):
        teacher.hidden[0].weight[unit, 2] = sign
        teacher.hidden[2].weight[unit, unit] = 1.0
        teacher.mean.weight[0, unit] = -sign
    return teacher


def spot(error: float) -> np.ndarray:
    """A raw stack (6, 18, 32) whose bright spot shows a cross-track error of -1 to 1 m."""
    picture = np.zeros((6, 18, 32), np.uint8)
    column = 2 * round((error + 1.0) * 7)
    picture[:, :, column : column + 4] = 255
    return picture


def state_of(error: float) -> np.ndarray:
    return np.array([1.0, 0.0, error, *[0.0] * 7], np.float32)


def learner(folder: Path | None = None, seed: int = 0) -> Distillation:
    torch.set_num_threads(1)
    file = folder / "pictures.bin" if folder else None
    buffer = PictureBuffer(200, ENVS, (9, 16), 2, len(STATE_SCALES), file, slack=100, seed=seed)
    return Distillation(TINY, steering_teacher(), buffer, seed)


def show(model: Distillation, count: int = 100, seed: int = 5) -> None:
    """Adds pictures of spots to the buffer; each is the first of an episode."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        errors = rng.uniform(-1.0, 1.0, ENVS)
        pictures = np.stack([preprocess(spot(error), 2)[-3:] for error in errors])
        model.buffer.add(pictures, np.stack([state_of(error) for error in errors]), np.ones(ENVS, bool))
        model.steps += ENVS


def test_the_policy_learns_the_teachers_actions_and_its_file_acts_alike(tmp_path):
    model = learner()
    show(model)
    first = model.update(64, 3e-3)
    for _ in range(400):
        last = model.update(64, 3e-3)
    assert last[0] < 0.25 * first[0] and last[1] < 0.8 * first[1]
    save_policy(tmp_path, TINY, TrainConfig().control, model.averaged.weights(TINY), {})
    policy = load_policy(tmp_path)
    for error in np.linspace(-0.9, 0.9, 13):
        action, wanted = policy(spot(error)), model.teacher(torch.as_tensor(state_of(error))[None])
        steady, told = model.averaged(torch.as_tensor(preprocess(spot(error), 2)[None]))
        np.testing.assert_allclose(action, steady[0].detach().numpy(), atol=1e-5)
        assert abs(action.item() - wanted.item()) < 0.15
        assert abs(told[0, 2].item() - error) < 0.3


def test_actions_in_training_are_noisy_and_valid():
    model = learner()
    stacks = np.repeat(normalize_colors(np.zeros((1, 6, 9, 16), np.uint8)), 400, 0)
    actions = model.act(stacks)
    assert actions.shape == (400, 1) and 0.1 < actions.std() < 0.2 and np.abs(actions).max() <= 1.0


def test_the_teacher_is_not_trained_by_the_policy():
    model = learner()
    show(model)
    before = {name: value.clone() for name, value in model.teacher.state_dict().items()}
    for _ in range(5):
        model.update(16, 1e-2)
    assert all(torch.equal(before[name], value) for name, value in model.teacher.state_dict().items())


def test_the_averaged_network_follows_the_network():
    model = learner()
    show(model)
    model.update(16, 1e-2)
    for mean, new in zip(model.averaged.parameters(), model.network.parameters(), strict=True):
        assert torch.equal(mean, new)  # the first update is the mean so far
    for _ in range(3):
        model.update(16, 1e-2)
    off = [(a - b).abs().max() for a, b in zip(model.averaged.parameters(), model.network.parameters(), strict=True)]
    assert max(off) > 1e-3


def test_scaled_weights_equal_scaled_pictures():
    encoder = Encoder(TINY)
    pictures = torch.randint(0, 256, (3, 6, 9, 16))
    plain = encoder.further(encoder.first(pictures / 255.0 - 0.5))
    expected = torch.tanh(encoder.norm(encoder.linear(plain)))
    torch.testing.assert_close(encoder(pictures.to(torch.uint8)), expected, atol=1e-5, rtol=1e-4)


def test_a_saved_training_resumes_exactly(tmp_path):
    """Updates and actions after loading are, number for number, those of the learner that was saved."""
    (tmp_path / "a").mkdir()
    model = learner(tmp_path / "a")
    show(model)
    for _ in range(5):
        model.update(16, 1e-3)
    save_state(tmp_path / "a", model, {"wall": 3.0})
    at_saving = torch.get_rng_state()
    again = learner(tmp_path / "a", seed=77)
    assert load_state(tmp_path / "a", again) == {"wall": 3.0}
    assert (again.steps, again.updates) == (model.steps, model.updates) == (100 * ENVS, 5)
    stacks = np.zeros((3, 6, 9, 16), np.uint8)
    seen = []
    for one in (again, model):
        torch.set_rng_state(at_saving)
        seen.append([*(one.update(16, 1e-3) for _ in range(5)), *one.act(stacks).ravel().tolist()])
    assert seen[0] == seen[1]
    for (name, a), b in zip(model.averaged.state_dict().items(), again.averaged.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_a_damaged_state_is_refused(tmp_path):
    model = learner(tmp_path)
    show(model)
    model.update(16, 1e-3)
    save_state(tmp_path, model, {})
    (file,) = tmp_path.glob("state_*/tensors.safetensors")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        load_state(tmp_path, learner(tmp_path))
    file.write_bytes(whole)
    load_state(tmp_path, learner(tmp_path))
