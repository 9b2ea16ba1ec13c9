"""A replay buffer that keeps single pictures, not stacks: a quarter of an eighth of what stacks before and after need.

Every world has a *tape*: the pictures that its robot saw, one after the other, each once. A *transition* knows where on
the tape its newest picture is, and its *age*, the steps since its episode began; its stack is that picture and those
before it, back to the episode's first, which fills the rest. The newest picture of the next stack follows it on the
tape, also at an episode's end, after which the next episode's first picture is written.

A tape is a ring in a file. It is longer than the transitions need by a *slack*, so that what was written since the last
save has not run over what the saved transitions refer to: a training that was killed goes on from its last save with
all it held then.
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

from twin.errors import InputError
from twin.files import allocate

# ---- Light as no field knows it: random tones, tints and shades laid over pictures in updates.
#
# A field's lightings are those that the place was filmed in and what lies between them. Other weather has another sky and
# other shadows, and things take another colour in it. Brightness, contrast and tint of the ground as a whole are levelled
# before a policy sees them (`architecture.levelled`); what is left is varied at random here, for every sample anew and
# alike for all pictures of a stack, so that motion stays what it is:
#
#     tone     v → v^gamma, and its contrast about the middle
#     tint     a gain for each colour
#     shade    a smooth pattern of light and dark over the picture
#     covers   rectangles of one colour, so that no one thing in the background is what is steered by
#
# All is drawn around no change at all, and scaled by one *strength*; 1 is what the constants below say.


_GAMMA, _CONTRAST, _TINT = 0.25, 0.25, 0.08  # standard deviations, of logarithms
_SHADE = 0.4  # the same, at the knots
_COVERS, _COVER = 4, (0.1, 0.5)  # fewer than so many; their sides as shares of the picture's
_KNOTS = (3, 5)  # of the pattern, down and across
_LEVELS = np.arange(256) / 255.0


def augmented_colors(stacks: NDArray[np.uint8], strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Stacks as they might look in other weather.

    Args:
        stacks: Shape (k, 3 · stack, height, width), colours of one picture next to each other.
        strength: 0 changes nothing.
        rng: What is drawn from.
    """
    count, channels, height, width = stacks.shape
    curves = _curves(count, strength, rng)
    knots = np.exp(strength * _SHADE * rng.normal(size=(count, *_KNOTS))).astype(np.float32)
    out = np.empty_like(stacks)
    for i in range(count):
        shade = cv2.resize(knots[i], (width, height), interpolation=cv2.INTER_CUBIC)
        for channel in range(channels):
            toned = cv2.LUT(stacks[i, channel], curves[i, channel % 3])
            cv2.multiply(toned, shade, out[i, channel], dtype=cv2.CV_8U)
        for _ in range(rng.integers(_COVERS) if strength else 0):
            sides = (rng.uniform(*_COVER, 2) * (height, width)).astype(int) + 1
            top, left = (rng.uniform(size=2) * ((height, width) - sides)).astype(int)
            colour = np.tile(rng.integers(0, 256, 3, np.uint8), channels // 3)
            out[i, :, top : top + sides[0], left : left + sides[1]] = colour[:, None, None]
    return out


def _curves(count: int, strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A tone curve per sample and colour, shape (count, 3, 256)."""

    def spread(deviation: float, colours: int) -> NDArray[np.float64]:
        return np.exp(strength * deviation * rng.normal(size=(count, colours, 1)))

    toned = 0.5 + (_LEVELS ** spread(_GAMMA, 1) - 0.5) * spread(_CONTRAST, 1)
    return (255.0 * toned * spread(_TINT, 3)).clip(0.0, 255.0).round().astype(np.uint8)


_SHORT = 8  # mean steps of an episode; shorter ones leave less than the whole buffer to draw from
_ROWS = ("actions", "rewards", "ends", "newest", "age", "states", "states_after")


class Samples(NamedTuple):
    """As stable-baselines3 has them, and the states."""

    observations: torch.Tensor
    actions: torch.Tensor
    next_observations: torch.Tensor
    dones: torch.Tensor
    rewards: torch.Tensor
    states: torch.Tensor
    next_states: torch.Tensor


class FrameReplayBuffer(ReplayBuffer):
    """Transitions of n worlds whose observations are stacks (3 · stack, height, width), the newest picture last."""

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
        colours: float = 0.0,
        seed: int = 0,
        states: int = 0,
    ) -> None:
        """
        Args:
            buffer_size: Transitions, of all worlds together.
            observation_space: uint8 (3 · stack, height, width).
            action_space: One-dimensional.
            device: Where samples go.
            n_envs: Number of worlds.
            optimize_memory_usage: As stable-baselines3 passes it; it has no meaning here.
            file: Where the tapes are; in memory where None. One that is there is read, see `set_state`.
            slack: Transitions, of all worlds together, that may be added between two saves.
            shift: Samples are shifted by up to so many pixels each way, edges repeated: Kostrikov et al. 2020 (DrQ).
            colours: Strength of the random weather laid over half of what samples begin with, see `recoloured`.
            seed: Of what is drawn.
            states: Numbers in the `state` of an `info`.

        Raises:
            InputError: a file of another size.
            OSError: the disk has no room for the whole file.
        """
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage, self.handle_timeout_termination = False, True
        channels, height, width = self.obs_shape
        self.stack, self.shift, self.colours, self.rng = channels // 3, shift, colours, np.random.default_rng(seed)
        size = (self.buffer_size, n_envs)
        self.actions = np.zeros((*size, self.action_dim), np.float32)
        self.rewards, self.ends = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self.newest, self.age = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self.states = np.zeros((*size, states), np.float32)
        """Where the robot really was when a transition began; NaN in a world's first of a process."""
        self.states_after = np.zeros((*size, states), np.float32)
        self._state = np.full((n_envs, states), np.nan, np.float32)
        self.length = self.buffer_size + self.buffer_size // _SHORT + -(-2 * slack // n_envs) + self.stack + 2
        """Pictures on a tape."""
        shape = (n_envs, self.length, 3, height, width)
        if file is None:
            self.tapes = np.zeros(shape, np.uint8)
        else:
            there = file.exists()
            if there and file.stat().st_size != int(np.prod(shape)):
                raise InputError(f"{file} has {file.stat().st_size} bytes; expected {int(np.prod(shape))}: damaged")
            allocate(file, int(np.prod(shape)))  # now: a full disk is an error at the start, not a SIGBUS hours later
            self.tapes = np.memmap(file, np.uint8, "r+", shape=shape)
        self._reach = self.length - -(-2 * slack // n_envs)
        self.written = np.zeros(n_envs, np.int64)
        """Pictures ever written on each tape."""
        self._ages = np.full(n_envs, -1)  # of each world's episode; -1: none

    def add(
        self,
        obs: NDArray,
        next_obs: NDArray,
        action: NDArray,
        reward: NDArray,
        done: NDArray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Adds a transition of every world; the observations of a world must follow each other until `done`."""
        for i in range(self.n_envs):
            if self._ages[i] < 0:
                self._write(i, obs[i, -3:])
                self._ages[i] = 0
            self.newest[self.pos, i], self.age[self.pos, i] = self.written[i] - 1, self._ages[i]
            self._write(i, next_obs[i, -3:])
            self._ages[i] = -1 if done[i] else self._ages[i] + 1
            if self._state.shape[1]:
                self.states[self.pos, i] = self._state[i]
                self.states_after[self.pos, i] = infos[i]["state"]
                self._state[i] = infos[i]["first_state" if done[i] else "state"]
        self.actions[self.pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos] = reward
        # What ended by a time limit would have gone on.
        self.ends[self.pos] = [d and not info.get("TimeLimit.truncated") for d, info in zip(done, infos, strict=True)]
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> Samples:  # type: ignore[override]
        """Draws transitions that are wholly there, each alike; stacks are uint8."""
        filled = self.buffer_size if self.full else self.pos
        row, world = np.empty(0, int), np.empty(0, int)
        while len(row) < batch_size:
            more = self.rng.integers(filled, size=batch_size), self.rng.integers(self.n_envs, size=batch_size)
            whole = self.whole(*more)
            row, world = np.append(row, more[0][whole]), np.append(world, more[1][whole])
        row, world = row[:batch_size], world[:batch_size]
        before, after = self.stacks(row, world)
        if self.shift:
            before, after = self._shifted(before), self._shifted(after)
        if self.colours:
            # Half of them, and never what targets are made of: Hansen et al. 2021 (SVEA).
            half = batch_size // 2
            before[:half] = augmented_colors(before[:half], self.colours, self.rng)
        rest = self.actions[row, world], after, self.ends[row, world, None], self.rewards[row, world, None]
        parts = (before, *rest, self.states[row, world], self.states_after[row, world])
        return Samples(*(torch.as_tensor(part, device=self.device) for part in parts))

    def whole(self, row: NDArray, world: NDArray) -> NDArray[np.bool_]:
        """Whether all pictures of transitions are still on their tapes, shapes (k,)."""
        oldest = self.newest[row, world] - np.minimum(self.age[row, world], self.stack - 1)
        return oldest >= self.written[world] - self._reach

    def stacks(self, row: NDArray, world: NDArray) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Stacks before and after transitions, shapes (k,) → (k, 3 · stack, height, width) each."""
        newest, age = self.newest[row, world], self.age[row, world]
        back = np.arange(self.stack - 1, -1, -1)
        first = (newest - age)[:, None]
        out = []
        for at in (newest, newest + 1):
            where = np.maximum(at[:, None] - back, first) % self.length
            out.append(self.tapes[world[:, None], where].reshape(len(row), *self.obs_shape))
        return out[0], out[1]

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays, and what is JSON-able, of all but the tapes; those are on disk when this returns."""
        if isinstance(self.tapes, np.memmap):
            self.tapes.flush()
        arrays = {name: getattr(self, name) for name in _ROWS} | {"written": self.written}
        return arrays, {"pos": self.pos, "full": self.full, "rng": self.rng.bit_generator.state}

    def set_state(self, arrays: dict[str, NDArray], rest: dict[str, Any]) -> None:
        """Goes back to a state, with the tapes as they are; worlds begin new episodes."""
        for name in (*_ROWS, "written"):
            getattr(self, name)[:] = arrays[name]
        self.pos, self.full = rest["pos"], rest["full"]
        self.rng.bit_generator.state = rest["rng"]
        self._ages[:], self._state[:] = -1, np.nan

    def _write(self, world: int, picture: NDArray) -> None:
        self.tapes[world, self.written[world] % self.length] = picture
        self.written[world] += 1

    def _shifted(self, stacks: NDArray[np.uint8]) -> NDArray[np.uint8]:
        p, (height, width) = self.shift, self.obs_shape[1:]
        padded = np.empty((*stacks.shape[:2], height + 2 * p, width + 2 * p), np.uint8)
        padded[..., p:-p, p:-p] = stacks
        padded[..., :p, p:-p], padded[..., -p:, p:-p] = stacks[..., :1, :], stacks[..., -1:, :]
        padded[..., :p], padded[..., -p:] = padded[..., p : p + 1], padded[..., -p - 1 : -p]
        out = np.empty_like(stacks)
        for i, (y, x) in enumerate(self.rng.integers(0, 2 * p + 1, (len(stacks), 2))):
            out[i] = padded[i, :, y : y + height, x : x + width]
        return out
