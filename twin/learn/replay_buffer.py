"""The pictures that a training has seen, with the robot's states, and color augmentation of samples.

Each environment has a *ring* buffer in a file, to which its pictures are written in order, across episodes. The stack
that ends with a picture has the pictures before it; if its episode has too few, its first one is repeated. A buffer
that stores stacks of four pictures would take four times the memory.
"""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
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


class PictureBuffer:
    """Pictures (3, height, width) and states (k,) of n environments.

    The rings are longer than `capacity`, by a length that `slack` sets. So pictures written after a save do not
    overwrite the saved ones, and a killed training resumes with all of them.
    """

    def __init__(
        self,
        capacity: int,
        n_envs: int,
        size: tuple[int, int],
        stack: int,
        state_size: int,
        file: Path | None = None,
        slack: int = 0,
        shift: int = 0,
        color_strength: float = 0.0,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """
        Args:
            capacity: Number of pictures that are sampled, of all environments together: the newest ones.
            size: Height and width of the pictures.
            stack: Number of pictures in a stack.
            file: File of the pictures; None: they are in memory. An existing file is kept, see `set_state`.
            slack: Largest number of pictures, of all environments together, added between two saves.
            shift: Samples are shifted at random, by at most this in each direction [px]; edge pixels are repeated
                (DrQ, Kostrikov et al. 2020).
            color_strength: Strength of `draw_color_changes`, for half of the samples.
            device: On a GPU, it holds a second copy of all pictures.

        Raises:
            InputError: an existing file has another size.
            OSError: the disk has no room for the whole file.
        """
        self.n_envs, self.size, self.stack = n_envs, size, stack
        self.shift, self.color_strength, self.device = shift, color_strength, torch.device(device)
        self.rng = np.random.default_rng(seed)
        self.capacity = max(capacity // n_envs, 1)
        """Number of pictures of one environment that are sampled."""
        self.length = self.capacity + stack - 1 + -(-slack // n_envs)
        """Number of pictures in a ring."""
        self.ages = np.zeros((n_envs, self.length), np.int64)
        """Number of earlier pictures in each picture's episode."""
        self.states = np.zeros((n_envs, self.length, state_size), np.float32)
        shape = (n_envs, self.length, 3, *size)
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
        self.written = 0
        """Number of pictures written to each ring so far."""

    def add(self, pictures: NDArray[np.uint8], states: Array32, first: NDArray[np.bool_]) -> None:
        """Adds each environment's newest picture, shape (n, 3, height, width), and its state, shape (n, k).

        `first`: whether the picture is the first of an episode, shape (n,).
        """
        at, before = self.written % self.length, (self.written - 1) % self.length
        self.frames[:, at], self.states[:, at] = pictures, states
        self.ages[:, at] = np.where(first, 0, self.ages[:, before] + 1)
        if self._on_gpu is not None:
            self._on_gpu[:, at] = torch.as_tensor(np.ascontiguousarray(pictures), device=self.device)
        self.written += 1

    def sample(self, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Samples uniformly; returns stacks, uint8 (count, 3 · stack, height, width), and states (count, k).

        The stacks are shifted, and half of them have other colors.
        """
        newest = self.written - 1 - self.rng.integers(min(self.written, self.capacity), size=count)
        env_index = self.rng.integers(self.n_envs, size=count)
        stacks = self.stacks(newest, env_index)
        if self.shift:
            stacks = self._shifted(stacks)
        if self.color_strength:
            half = count // 2
            changes = draw_color_changes(half, self.size, self.color_strength, self.rng)
            stacks[:half] = (changes.applied if self._on_gpu is None else changes.applied_on_gpu)(stacks[:half])
        states = self.states[env_index, newest % self.length]
        return torch.as_tensor(stacks, device=self.device), torch.as_tensor(states, device=self.device)

    def stacks(self, newest: NDArray, env_index: NDArray) -> Any:
        """Stacks of k environments that end with their picture number `newest`, counted over the whole training.

        The result, shape (k, 3 · stack, height, width), is a tensor on the buffer's device if that is a GPU, else an
        array.
        """
        back = np.minimum(np.arange(self.stack - 1, -1, -1), self.ages[env_index, newest % self.length][:, None])
        frames = self.frames if self._on_gpu is None else self._on_gpu
        stacks = frames[env_index[:, None], (newest[:, None] - back) % self.length]
        return stacks.reshape(len(newest), 3 * self.stack, *self.size)

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Returns the buffer's state except for the pictures: arrays, and JSON-able values.

        The pictures are flushed to their file.
        """
        if isinstance(self.frames, np.memmap):
            self.frames.flush()
        return {"ages": self.ages, "states": self.states}, {
            "written": self.written,
            "rng": self.rng.bit_generator.state,
        }

    def set_state(self, arrays: dict[str, NDArray], rest: dict[str, Any]) -> None:
        """Restores a state; the pictures are already in the file. The next pictures must be the first of episodes."""
        self.ages[:], self.states[:] = arrays["ages"], arrays["states"]
        self.written = int(rest["written"])
        self.rng.bit_generator.state = rest["rng"]

    def _shifted(self, stacks: Any) -> Any:
        """Randomly shifted copies of stacks; edge pixels are repeated."""
        p, (height, width) = self.shift, self.size
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
