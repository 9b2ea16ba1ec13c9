"""A replay buffer that stores single pictures instead of stacks, and color augmentation of its samples.

Each environment has a *ring* buffer in a file, to which its pictures are written once, in order, across episodes. A
*transition* stores its *age*, the number of steps since its episode began, and the index of the newest picture before
it. The stack before the transition ends with this picture, the stack after it with the next picture of the ring. If the
episode has too few pictures for a stack, its first one is repeated. A buffer that stores both stacks, of four pictures
each, would take eight times the memory.
"""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from twin.env.options import CUDA
from twin.errors import InputError
from twin.files import allocate
from twin.types import Array32

# ---- color augmentation

_GAMMA, _CONTRAST, _TINT = 0.25, 0.25, 0.08  # standard deviations of the logarithms of the random factors
_SHARPNESS = 1.0, 2.0  # strongest blur (1: to the mean of 3 × 3 pixels) and strongest sharpening
_KNOTS, _SHADING = (3, 5), 0.4  # brightness pattern: knots down and across; standard deviation of the logarithm
_MAX_COVERS, _COVER_SIDES = 3, (0.1, 0.5)  # rectangles: largest number; range of sides / the picture's
_LEVELS = np.arange(256) / 255.0
_IDENTITY = np.pad(np.ones((1, 1), np.float32), 1)  # the kernel that changes nothing


class ColorChanges(NamedTuple):
    """Random changes of the colors of k stacks, see `draw_color_changes`."""

    kernels: Array32
    """Convolution that sharpens or blurs, shape (k, 3, 3)."""
    curves: NDArray[np.uint8]
    """Tone curve of each color, shape (k, 3, 256)."""
    knots: Array32
    """Brightness pattern, shape (k, 3, 5)."""
    covers: NDArray[np.int64]
    """First row, row after the last, first column and column after the last of each rectangle, shape (k, 3, 4). They
    are drawn in this order; those that a stack does not have are empty."""
    cover_colors: NDArray[np.uint8]
    """Shape (k, 3, 3)."""

    def applied(self, stacks: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Changed copies of stacks (k, 3 · stack, height, width)."""
        count, channels, height, width = stacks.shape
        out = np.empty_like(stacks)
        for i in range(count):
            shading = cv2.resize(self.knots[i], (width, height), interpolation=cv2.INTER_CUBIC)
            for channel in range(channels):
                sharp = cv2.filter2D(stacks[i, channel], -1, self.kernels[i], borderType=cv2.BORDER_REPLICATE)
                toned = cv2.LUT(sharp, self.curves[i, channel % 3])
                cv2.multiply(toned, shading, out[i, channel], dtype=cv2.CV_8U)
        for i, n in np.argwhere(self.covers[..., 1]):
            top, bottom, left, right = self.covers[i, n]
            out[i, :, top:bottom, left:right] = np.tile(self.cover_colors[i, n], channels // 3)[:, None, None]
        return out

    def applied_on_gpu(self, stacks: torch.Tensor) -> torch.Tensor:
        """Like `applied`, for a tensor; a few colors differ by up to 3, since OpenCV rounds differently."""
        (channels, height, width), device = stacks.shape[1:], stacks.device
        padded = nn.functional.pad(stacks.float(), (1, 1, 1, 1), mode="replicate").transpose(0, 1)
        kernels = torch.as_tensor(self.kernels, device=device)[:, None]
        sharp = nn.functional.conv2d(padded, kernels, groups=len(stacks)).transpose(0, 1)
        stacks = sharp.round().clamp(0, 255).to(torch.uint8)
        curves = torch.as_tensor(self.curves, device=device).repeat(1, channels // 3, 1)
        toned = curves.gather(2, stacks.flatten(2).long()).reshape(stacks.shape)
        knots = torch.as_tensor(self.knots, device=device)[:, None]
        shading = nn.functional.interpolate(knots, (height, width), mode="bicubic")
        out = (toned * shading).round().clamp(0, 255).to(torch.uint8)
        # One rectangle of all stacks at a time; one launch per rectangle would take longer than all the rest.
        corners = torch.as_tensor(self.covers, device=device)[..., None, None]
        colors = torch.as_tensor(self.cover_colors, device=device).repeat(1, 1, channels // 3)[..., None, None]
        row, column = torch.arange(height, device=device)[:, None], torch.arange(width, device=device)
        for n in range(_MAX_COVERS):
            top, bottom, left, right = corners[:, n].unbind(1)
            inside = (row >= top) & (row < bottom) & (column >= left) & (column < right)
            out = torch.where(inside[:, None], colors[:, n], out)
        return out


def draw_color_changes(count: int, size: tuple[int, ...], strength: float, rng: np.random.Generator) -> ColorChanges:
    """Draws changes of color that prepare policies for skies and shadows that no filmed lighting shows.

    The policy's normalization removes brightness, contrast and tint of the whole ground; the changes randomize what
    remains. Each stack is changed in its own way, but all pictures of a stack alike, which preserves motion:

        sharpness  blur or sharpening, since a field shows edges less sharply than a camera
        tone       v → v^gamma, then a change of contrast about the middle
        tint       one gain per color
        shading    a smooth pattern of brightness
        covers     rectangles in uniform colors, so that steering does not rely on a single object in the background

    Args:
        count: Number of stacks.
        size: Height and width of the pictures.
        strength: Factor by which the standard deviations are multiplied; 0 changes nothing.
    """
    blur, sharpening = min(strength, 1.0) * _SHARPNESS[0], strength * _SHARPNESS[1]
    amount = rng.uniform(-blur, sharpening, (count, 1, 1)).astype(np.float32)
    kernels = (1.0 + amount) * _IDENTITY - amount / np.float32(9.0)
    curves = _curves(count, strength, rng)
    knots = np.exp(strength * _SHADING * rng.normal(size=(count, *_KNOTS))).astype(np.float32)
    covers, colors = np.zeros((count, _MAX_COVERS, 4), np.int64), np.zeros((count, _MAX_COVERS, 3), np.uint8)
    for i in range(count):
        for n in range(rng.integers(_MAX_COVERS + 1) if strength else 0):
            height, width = (rng.uniform(*_COVER_SIDES, 2) * size).astype(int) + 1
            top, left = (rng.uniform(size=2) * (size[0] - height, size[1] - width)).astype(int)
            covers[i, n] = top, top + height, left, left + width
            colors[i, n] = rng.integers(0, 256, 3, np.uint8)
    return ColorChanges(kernels, curves, knots, covers, colors)


def _curves(count: int, strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Tone curves, one per sample and color, shape (count, 3, 256)."""

    def factors(deviation: float, colors: int) -> NDArray[np.float64]:
        return np.exp(strength * deviation * rng.normal(size=(count, colors, 1)))

    toned = 0.5 + (_LEVELS ** factors(_GAMMA, 1) - 0.5) * factors(_CONTRAST, 1)
    return (255.0 * toned * factors(_TINT, 3)).clip(0.0, 255.0).round().astype(np.uint8)


# ---- the buffer

_SHORT = 8  # [steps] the ring has room for all transitions if episodes have on average at least this length
_ROWS = ("actions", "rewards", "ends", "newest", "age", "states", "states_after")


class ReplaySamples(NamedTuple):
    """Samples as in stable-baselines3, and the robot's states before and after, which only the critics receive."""

    observations: torch.Tensor
    actions: torch.Tensor
    next_observations: torch.Tensor
    dones: torch.Tensor
    rewards: torch.Tensor
    states: torch.Tensor
    next_states: torch.Tensor


class FrameReplayBuffer(ReplayBuffer):
    """Transitions of n environments; observations are stacks (3 · stack, height, width), the newest picture last.

    The rings are longer than the transitions need, by a length that `slack` sets. So pictures written after a save do
    not overwrite those of saved transitions, and a killed training resumes with all of them.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        file: Path | None = None,
        slack: int = 0,
        shift: int = 0,
        color_strength: float = 0.0,
        seed: int = 0,
        state_size: int = 0,
    ) -> None:
        """
        Args:
            buffer_size: Number of transitions, of all environments together.
            observation_space: uint8 (3 · stack, height, width).
            file: File of the pictures; None: they are in memory. An existing file is kept, see `set_state`.
            slack: Largest number of transitions, of all environments together, added between two saves.
            shift: Samples are shifted at random, by at most this in each direction [px]; edge pixels are repeated
                (DrQ, Kostrikov et al. 2020).
            color_strength: Strength of `draw_color_changes`, for half of the stacks before transitions.
            device: On a GPU, it holds a second copy of all pictures.
            state_size: Number of components of the `state` in an `info`.

        Raises:
            InputError: an existing file has another size.
            OSError: the disk has no room for the whole file.
        """
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage, self.handle_timeout_termination = False, True
        channels, height, width = self.obs_shape
        self.stack, self.shift, self.color_strength = channels // 3, shift, color_strength
        self.rng = np.random.default_rng(seed)
        size = (self.buffer_size, n_envs)
        self.actions = np.zeros((*size, self.action_dim), np.float32)
        self.rewards, self.ends = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self.newest, self.age = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self.states = np.zeros((*size, state_size), np.float32)
        """The robot's state before each transition; NaN for the first transition after `break_off`."""
        self.states_after = np.zeros((*size, state_size), np.float32)
        self._state = np.full((n_envs, state_size), np.nan, np.float32)
        slack = -(-2 * slack // n_envs)
        self._reach = self.buffer_size + self.buffer_size // _SHORT + self.stack + 2
        self.length = self._reach + slack
        """Number of pictures in a ring."""
        shape = (n_envs, self.length, 3, height, width)
        if file is None:
            self.frames = np.zeros(shape, np.uint8)
        else:
            bytes_needed = int(np.prod(shape))
            if file.exists() and file.stat().st_size != bytes_needed:
                raise InputError(
                    f"{file} has {file.stat().st_size} bytes; expected {bytes_needed}; train again under another name"
                )
            allocate(file, bytes_needed)  # a full disk causes an error now, not a SIGBUS hours later
            self.frames = np.memmap(file, np.uint8, "r+", shape=shape)
        # On a GPU, updates would wait for pictures that the processor gathers and changes.
        self._on_gpu = torch.as_tensor(self.frames, device=self.device) if self.device.type == CUDA else None
        self.written = np.zeros(n_envs, np.int64)
        """Number of pictures written to each ring so far."""
        self._ages = np.full(n_envs, -1)  # steps since each environment's episode began; -1: no episode

    def add(
        self,
        obs: NDArray,
        next_obs: NDArray,
        action: NDArray,
        reward: NDArray,
        done: NDArray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Adds one transition per environment.

        An environment's observations must be consecutive until its episode is `done`, or until `break_off`.
        """
        new = self._ages < 0
        self._write(np.flatnonzero(new), obs[new, -3:])
        self._ages[new] = 0
        self.newest[self.pos], self.age[self.pos] = self.written - 1, self._ages
        self._write(np.arange(self.n_envs), next_obs[:, -3:])
        self._ages = np.where(done, -1, self._ages + 1)
        for i in range(self.n_envs):
            if self._state.shape[1]:
                self.states[self.pos, i] = self._state[i]
                self.states_after[self.pos, i] = infos[i]["state"]
                self._state[i] = infos[i]["first_state" if done[i] else "state"]
        self.actions[self.pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos] = reward
        # An episode cut off by its time limit does not end in a terminal state. Nor does one at the goal: the middle of
        # the corridor is worth as much there as before, as if the road went on. With a reward for the goal instead,
        # however large, a policy steers the less, the nearer the goal is (docs/findings.md, "The end of a task").
        self.ends[self.pos] = [
            d and not (info.get("TimeLimit.truncated") or info.get("cause") == "goal")
            for d, info in zip(done, infos, strict=True)
        ]
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplaySamples:  # type: ignore[override]
        """Samples uniformly from the complete transitions (see `is_complete`); stacks are uint8."""
        filled = self.buffer_size if self.full else self.pos
        row, env_index = np.empty(0, int), np.empty(0, int)
        while len(row) < batch_size:
            more = self.rng.integers(filled, size=batch_size), self.rng.integers(self.n_envs, size=batch_size)
            complete = self.is_complete(*more)
            row, env_index = np.append(row, more[0][complete]), np.append(env_index, more[1][complete])
        row, env_index = row[:batch_size], env_index[:batch_size]
        before, after = self._augmented(*self.stacks(row, env_index))
        rest = self.actions[row, env_index], after, self.ends[row, env_index, None], self.rewards[row, env_index, None]
        parts = (before, *rest, self.states[row, env_index], self.states_after[row, env_index])
        return ReplaySamples(*(torch.as_tensor(part, device=self.device) for part in parts))

    def is_complete(self, row: NDArray, env_index: NDArray) -> NDArray[np.bool_]:
        """True for each transition whose pictures are all among the newest `_reach` of the ring; shapes (k,) → (k,)."""
        oldest = self.newest[row, env_index] - np.minimum(self.age[row, env_index], self.stack - 1)
        return oldest >= self.written[env_index] - self._reach

    def stacks(self, row: NDArray, env_index: NDArray) -> tuple[Any, Any]:
        """The stacks before, and the stacks after, k transitions; each has the shape (k, 3 · stack, height, width).

        They are tensors on the buffer's device if that is a GPU, else arrays.
        """
        newest, age = self.newest[row, env_index], self.age[row, env_index]
        back = np.arange(self.stack - 1, -1, -1)
        first = (newest - age)[:, None]
        frames = self.frames if self._on_gpu is None else self._on_gpu

        def until(last: NDArray) -> Any:
            index = np.maximum(last[:, None] - back, first) % self.length
            return frames[env_index[:, None], index].reshape(len(row), *self.obs_shape)

        return until(newest), until(newest + 1)

    def _augmented(self, before: Any, after: Any) -> tuple[Any, Any]:
        """Stacks as updates see them: all are shifted, and half of those before transitions have other colors."""
        if self.shift:
            before, after = self._shifted(before), self._shifted(after)
        if self.color_strength:
            # Stacks after transitions stay unchanged, since targets are computed from them (SVEA, Hansen et al. 2021).
            half = len(before) // 2
            changes = draw_color_changes(half, self.obs_shape[1:], self.color_strength, self.rng)
            before[:half] = (changes.applied if self._on_gpu is None else changes.applied_on_gpu)(before[:half])
        return before, after

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Returns the buffer's state except for the pictures: arrays, and JSON-able values.

        The pictures are flushed to their file.
        """
        if isinstance(self.frames, np.memmap):
            self.frames.flush()
        arrays = {name: getattr(self, name) for name in _ROWS} | {"written": self.written}
        return arrays, {"pos": self.pos, "full": self.full, "rng": self.rng.bit_generator.state}

    def set_state(self, arrays: dict[str, NDArray], rest: dict[str, Any]) -> None:
        """Restores a state; the pictures are already in the file. All environments begin new episodes."""
        for name in (*_ROWS, "written"):
            getattr(self, name)[:] = arrays[name]
        self.pos, self.full = rest["pos"], rest["full"]
        self.rng.bit_generator.state = rest["rng"]
        self.break_off()

    def break_off(self) -> None:
        """Call this before the next transition if all environments begin new episodes with it."""
        self._ages[:], self._state[:] = -1, np.nan

    def _write(self, env_index: NDArray[np.int64], pictures: NDArray) -> None:
        """Adds a picture to the ring of each of k environments."""
        at = self.written[env_index] % self.length
        self.frames[env_index, at] = pictures
        if self._on_gpu is not None and len(at):
            self._on_gpu[env_index, at] = torch.as_tensor(np.ascontiguousarray(pictures), device=self.device)
        self.written[env_index] += 1

    def _shifted(self, stacks: Any) -> Any:
        """Randomly shifted copies of stacks; edge pixels are repeated."""
        p, (height, width) = self.shift, self.obs_shape[1:]
        shifts = self.rng.integers(0, 2 * p + 1, (len(stacks), 2))  # down and to the right; p leaves a stack in place
        if self._on_gpu is not None:
            y, x = torch.as_tensor(shifts.T - p, device=self.device)[..., None]
            rows = (torch.arange(height, device=self.device) + y).clamp(0, height - 1)[:, None, :, None]
            columns = (torch.arange(width, device=self.device) + x).clamp(0, width - 1)[:, None, None, :]
            k, channel = torch.arange(len(stacks), device=self.device), torch.arange(len(stacks[0]), device=self.device)
            return stacks[k[:, None, None, None], channel[:, None, None], rows, columns]
        padded = np.pad(stacks, ((0, 0), (0, 0), (p, p), (p, p)), "edge")
        out = np.empty_like(stacks)
        for i, (y, x) in enumerate(shifts):
            out[i] = padded[i, :, y : y + height, x : x + width]
        return out
