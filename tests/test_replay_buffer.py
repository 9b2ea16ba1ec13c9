"""The buffer of single pictures returns the stacks that were added, also across episodes and the ring's end."""

import numpy as np
import pytest
import torch
from devices import DEVICES

from twin.errors import InputError
from twin.learn.replay_buffer import PictureBuffer

ENVS, STACK, SIZE, STATES = 3, 4, (5, 7), 2


class NaiveEnvs:
    """Environments with random pictures and episodes of random length, which keep every stack whole."""

    def __init__(self, seed: int, longest: int) -> None:
        self.rng, self.longest = np.random.default_rng(seed), longest
        self.begin()
        self.seen: list[list[tuple]] = [[] for _ in range(ENVS)]

    def begin(self) -> None:
        self.left = np.zeros(ENVS, int)
        self.stacks = np.zeros((ENVS, 3 * STACK, *SIZE), np.uint8)

    def step(self, buffer: PictureBuffer) -> None:
        pictures = self.rng.integers(0, 256, (ENVS, 3, *SIZE), np.uint8)
        states = self.rng.normal(size=(ENVS, STATES)).astype(np.float32)
        first = self.left == 0
        self.left = np.where(first, self.rng.integers(1, self.longest + 1, ENVS), self.left) - 1
        for i in range(ENVS):
            kept = np.tile(pictures[i], (STACK - 1, 1, 1)) if first[i] else self.stacks[i, 3:]
            self.stacks[i] = np.concatenate([kept, pictures[i]])
            self.seen[i].append((self.stacks[i].copy(), states[i]))
        buffer.add(pictures, states, first)


def check(buffer: PictureBuffer, worlds: NaiveEnvs) -> None:
    """Compares all stacks that may be sampled with those that were added."""
    for i in range(ENVS):
        for newest in range(max(0, buffer.written - buffer.capacity), buffer.written):
            stack, state = worlds.seen[i][newest]
            np.testing.assert_array_equal(buffer.stacks(np.array([newest]), np.array([i]))[0], stack)
            np.testing.assert_array_equal(buffer.states[i, newest % buffer.length], state)


@pytest.mark.parametrize("longest", [1, 2, 6, 1000])
@pytest.mark.parametrize("steps", [3, 40, 41, 137])
def test_stacks_are_those_added(longest, steps):
    buffer = PictureBuffer(40 * ENVS, ENVS, SIZE, STACK, STATES)
    worlds = NaiveEnvs(longest, longest)
    for _ in range(steps):
        worlds.step(buffer)
    check(buffer, worlds)


def test_all_of_the_newest_pictures_are_sampled_and_no_others():
    buffer = PictureBuffer(10 * ENVS, ENVS, SIZE, STACK, STATES, seed=5)
    worlds = NaiveEnvs(0, 4)
    for steps, kept in ((6, 6), (27, 10)):
        for _ in range(steps):
            worlds.step(buffer)
        there = {state.tobytes(): stack for seen in worlds.seen for stack, state in seen[-kept:]}
        stacks, states = buffer.sample(2000)
        drawn = set()
        for stack, state in zip(stacks.numpy(), states.numpy(), strict=True):
            np.testing.assert_array_equal(stack, there[state.tobytes()])
            drawn.add(state.tobytes())
        assert drawn == set(there)


def test_shifts_stay_within_their_limit_and_repeat_edges():
    buffer = PictureBuffer(40, ENVS, SIZE, STACK, STATES, shift=2)
    stacks = np.random.default_rng(0).integers(0, 256, (60, 12, *SIZE), np.uint8)
    shifts = set()
    for before, after in zip(stacks, buffer._shifted(stacks), strict=True):
        found = [
            (y, x)
            for y in range(-2, 3)
            for x in range(-2, 3)
            if np.array_equal(before[:, np.clip(np.arange(5) + y, 0, 4)][:, :, np.clip(np.arange(7) + x, 0, 6)], after)
        ]
        assert len(found) == 1
        shifts.add(found[0])
    assert len(shifts) > 15


@pytest.mark.parametrize("device", ["cpu", *(name for name in DEVICES if name != "cpu")])
def test_samples_on_a_gpu_equal_those_on_the_host(device):
    """Without a GPU, its code runs on the CPU."""
    buffers = [
        PictureBuffer(20 * ENVS, ENVS, SIZE, STACK, STATES, shift=2, color_strength=1.0, device=one)
        for one in ("cpu", device)
    ]
    if device == "cpu":
        buffers[1]._on_gpu = torch.as_tensor(buffers[1].frames).clone()
    for buffer in buffers:
        worlds = NaiveEnvs(3, 3)
        for _ in range(50):
            worlds.step(buffer)
    for _ in range(3):
        (plain, states), (other, same) = (buffer.sample(40) for buffer in buffers)
        np.testing.assert_array_equal(states, same.cpu())
        off = np.abs(plain.numpy().astype(int) - other.cpu().numpy())
        assert off.max() <= 3 and off.mean() < 0.1 and off[20:].max() == 0


def test_saved_pictures_survive_later_writes(tmp_path):
    slack = 7 * ENVS
    settings = (20 * ENVS, ENVS, SIZE, STACK, STATES)
    buffer = PictureBuffer(*settings, file=tmp_path / "pictures.bin", slack=slack)
    worlds = NaiveEnvs(3, 3)
    for _ in range(50):
        worlds.step(buffer)
    arrays, rest = buffer.state()
    arrays = {name: array.copy() for name, array in arrays.items()}
    saved = [list(seen) for seen in worlds.seen]
    for _ in range(7):  # as many as the slack allows, and then it is killed
        worlds.step(buffer)
    again = PictureBuffer(*settings, file=tmp_path / "pictures.bin", slack=slack)
    again.set_state(arrays, rest)
    worlds.seen = saved
    check(again, worlds)
    worlds.begin()  # it goes on with new episodes
    for _ in range(30):
        worlds.step(again)
    check(again, worlds)


def test_pictures_of_another_size_are_refused(tmp_path):
    (tmp_path / "pictures.bin").write_bytes(b"123")
    with pytest.raises(InputError, match="3 bytes"):
        PictureBuffer(40, ENVS, SIZE, STACK, STATES, file=tmp_path / "pictures.bin")


def test_half_of_the_stacks_are_augmented():
    def drawn(colours: float) -> torch.Tensor:
        buffer = PictureBuffer(60, ENVS, SIZE, STACK, STATES, color_strength=colours, seed=4)
        worlds = NaiveEnvs(2, 6)
        for _ in range(15):
            worlds.step(buffer)
        return buffer.sample(12)[0]

    plain, weather = drawn(0.0), drawn(1.0)
    np.testing.assert_array_equal(plain[6:], weather[6:])
    assert all((a != b).any() for a, b in zip(plain[:6], weather[:6], strict=True))
