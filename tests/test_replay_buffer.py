"""The replay buffer of single pictures returns the stacks that were added, also across episodes and the ring's end."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

import torch
from devices import DEVICES
from gymnasium import spaces

from twin.errors import InputError
from twin.learn.replay_buffer import FrameReplayBuffer

ENVS, STACK, SIZE, STATES = 3, 4, (5, 7), 2
SPACE = spaces.Box(0, 255, (3 * STACK, *SIZE), np.uint8)
ACTION = spaces.Box(-1, 1, (2,), np.float32)


class NaiveEnvs:
    """Environments with random pictures and episodes of random length, which store every transition as whole stacks."""

    def __init__(self, seed: int, longest: int) -> None:
        self.rng, self.longest = np.random.default_rng(seed), longest
        self.observation = np.stack([self.first() for _ in range(ENVS)])
        self.left = self.rng.integers(1, longest + 1, ENVS)
        self.seen: list[list[tuple]] = [[] for _ in range(ENVS)]
        self.state = np.full((ENVS, STATES), np.nan, np.float32)

    def first(self) -> np.ndarray:
        return np.tile(self.rng.integers(0, 256, (3, *SIZE), np.uint8), (STACK, 1, 1))

    def step(self, buffer: FrameReplayBuffer) -> None:
        before = self.observation.copy()
        new = self.rng.integers(0, 256, (ENVS, 3, *SIZE), np.uint8)
        after = np.concatenate([before[:, 3:], new], 1)
        action, reward = self.rng.uniform(-1, 1, (ENVS, 2)).astype(np.float32), self.rng.normal(size=ENVS)
        self.left -= 1
        done, cut = self.left == 0, self.rng.random(ENVS) < 0.5
        arrived = self.rng.random(ENVS) < 0.3  # which is no end, either
        infos = [
            {"TimeLimit.truncated": bool(d and c), "cause": ("goal" if a else "out_of_bounds") if d else ""}
            for d, c, a in zip(done, cut, arrived, strict=True)
        ]
        states, firsts = self.rng.normal(size=(2, ENVS, STATES)).astype(np.float32)
        for info, state, first in zip(infos, states, firsts, strict=True):
            info |= {"state": state, "first_state": first}
        buffer.add(before, after, action, reward, done, infos)
        for i in range(ENVS):
            end = done[i] and not cut[i] and not arrived[i]
            told = self.state[i].copy(), states[i]
            self.seen[i].append((before[i], after[i], action[i], np.float32(reward[i]), end, told))
        self.state = np.where(done[:, None], firsts, states)
        self.observation = after.copy()
        for i in np.flatnonzero(done):
            self.observation[i], self.left[i] = self.first(), self.rng.integers(1, self.longest + 1)


def check(buffer: FrameReplayBuffer, worlds: NaiveEnvs) -> int:
    """Compares every whole transition with the one that was added; returns their number."""
    filled = buffer.buffer_size if buffer.full else buffer.pos
    total, count = len(worlds.seen[0]), 0
    for world in range(ENVS):
        for age in range(filled):  # 0: the newest
            row = np.array([(buffer.pos - 1 - age) % buffer.buffer_size])
            if not buffer.is_complete(row, np.array([world]))[0]:
                continue
            before, after, action, reward, end, state = worlds.seen[world][total - 1 - age]
            stacks = buffer.stacks(row, np.array([world]))
            np.testing.assert_array_equal(stacks[0][0], before)
            np.testing.assert_array_equal(stacks[1][0], after)
            np.testing.assert_array_equal(buffer.actions[row[0], world], action)
            assert buffer.rewards[row[0], world] == reward and buffer.ends[row[0], world] == end
            np.testing.assert_array_equal(buffer.states[row[0], world], state[0])
            np.testing.assert_array_equal(buffer.states_after[row[0], world], state[1])
            count += 1
    return count


@pytest.mark.parametrize("longest", [1, 2, 6, 1000])
@pytest.mark.parametrize("steps", [3, 40, 41, 137])
def test_stacks_are_those_added(longest, steps):
    buffer = FrameReplayBuffer(40 * ENVS, SPACE, ACTION, "cpu", ENVS, state_size=STATES)
    worlds = NaiveEnvs(longest, longest)
    for _ in range(steps):
        worlds.step(buffer)
    count = check(buffer, worlds)
    # Only episodes of less than 8 steps may cost room, and then half of it at most.
    assert count == min(steps, 40) * ENVS or (longest < 16 and count > min(steps, 40) * ENVS // 2)


def test_every_transition_is_sampled(tmp_path):
    buffer = FrameReplayBuffer(10 * ENVS, SPACE, ACTION, "cpu", ENVS, seed=5, state_size=STATES)
    worlds = NaiveEnvs(0, 4)
    for _ in range(33):
        worlds.step(buffer)
    there = {}
    for seen in worlds.seen:
        there |= {one[2].tobytes(): one for one in seen}
    sample = buffer.sample(2000)
    drawn = set()
    for k in range(2000):
        before, after, action, reward, end, state = there[sample.actions[k].numpy().tobytes()]
        np.testing.assert_array_equal(sample.observations[k], before)
        np.testing.assert_array_equal(sample.next_observations[k], after)
        assert sample.rewards[k].item() == reward and sample.dones[k].item() == end
        np.testing.assert_array_equal(sample.states[k], state[0])
        np.testing.assert_array_equal(sample.next_states[k], state[1])
        drawn.add(action.tobytes())
    assert len(drawn) == check(buffer, worlds)


def test_shifts_stay_within_their_limit_and_repeat_edges():
    buffer = FrameReplayBuffer(40, SPACE, ACTION, "cpu", ENVS, shift=2)
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
def test_samples_on_a_gpu_equal_those_on_the_host(device, monkeypatch):
    """Without a GPU, its code runs on the CPU."""
    buffers = [
        FrameReplayBuffer(20 * ENVS, SPACE, ACTION, one, ENVS, shift=2, color_strength=1.0, state_size=STATES)
        for one in ("cpu", device)
    ]
    if device == "cpu":
        buffers[1]._on_gpu = torch.as_tensor(buffers[1].frames).clone()
    for buffer in buffers:
        worlds = NaiveEnvs(3, 3)
        for _ in range(50):
            worlds.step(buffer)
    for _ in range(3):
        plain, other = (buffer.sample(40) for buffer in buffers)
        for name in ("actions", "next_observations", "dones", "rewards", "states", "next_states"):
            np.testing.assert_array_equal(getattr(plain, name), getattr(other, name).cpu(), err_msg=name)
        off = np.abs(plain.observations.numpy().astype(int) - other.observations.cpu().numpy())
        assert off.max() <= 3 and off.mean() < 0.1 and off[20:].max() == 0
        assert not np.array_equal(plain.observations[:20], plain.next_observations[:20])


def test_saved_transitions_survive_later_writes(tmp_path):
    slack = 7 * ENVS
    settings = (20 * ENVS, SPACE, ACTION, "cpu", ENVS)
    buffer = FrameReplayBuffer(*settings, file=tmp_path / "pictures.bin", slack=slack, state_size=STATES)
    worlds = NaiveEnvs(3, 3)
    for _ in range(50):
        worlds.step(buffer)
    arrays, rest = buffer.state()
    arrays = {name: array.copy() for name, array in arrays.items()}
    count = check(buffer, worlds)
    saved = [list(seen) for seen in worlds.seen]
    for _ in range(7):  # as many as the slack allows, and then it is killed
        worlds.step(buffer)
    again = FrameReplayBuffer(*settings, file=tmp_path / "pictures.bin", slack=slack, state_size=STATES)
    again.set_state(arrays, rest)
    worlds.seen = saved
    assert check(again, worlds) == count
    # It goes on with new episodes.
    worlds.observation = np.stack([worlds.first() for _ in range(ENVS)])
    worlds.state[:] = np.nan
    for _ in range(30):
        worlds.step(again)
    check(again, worlds)


def test_pictures_of_another_size_are_refused(tmp_path):
    (tmp_path / "pictures.bin").write_bytes(b"123")
    with pytest.raises(InputError, match="3 bytes"):
        FrameReplayBuffer(40, SPACE, ACTION, "cpu", ENVS, file=tmp_path / "pictures.bin")


def test_half_of_the_stacks_but_no_target_are_augmented():
    def drawn(colours: float):
        buffer = FrameReplayBuffer(60, SPACE, ACTION, "cpu", ENVS, color_strength=colours, seed=4)
        worlds = NaiveEnvs(2, 6)
        for _ in range(15):
            worlds.step(buffer)
        return buffer.sample(12)

    plain, weather = drawn(0.0), drawn(1.0)
    np.testing.assert_array_equal(plain.next_observations, weather.next_observations)
    np.testing.assert_array_equal(plain.observations[6:], weather.observations[6:])
    assert all((a != b).any() for a, b in zip(plain.observations[:6], weather.observations[:6], strict=True))
