"""What a training is asked for: `TrainConfig`, and the presets for a CPU and for a GPU.

*Steps* are control steps of all worlds together. *Updates* are steps of the optimisers.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

from twin.config import ANY, HELD_OUT, TRAINING
from twin.env.domain_randomization import Ranges
from twin.env.options import CPU, CUDA, NERF, SIMULATOR, STEERING, TWIST, Rewards
from twin.errors import InputError, shown
from twin.learn.policy import Control
from twin.learn.policy_network import Architecture

_STATES = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 0.3)
"""Speed [m/s], yaw rate [rad/s], cross-track [m], heading error and turns 1, 2 and 4 m ahead [rad]."""

_RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**63 - 1),
    "steps": (1, 10**10),
    "worlds": (1, 4096),
    "speed": (0.01, 10),
    "yaw_rate": (0.01, 10),
    "centring": (0, 1e3),
    "steering": (0, 1e3),
    "entropy": (-1e3, 1e3),
    "start_along": (0, 0.999),
    "pool": (1, 16),
    "convolutions": (1, 4096),
    "features": (1, 65_536),
    "hidden": (1, 65_536),
    "batch": (1, 65_536),
    "buffer": (1, 10**8),
    "starts": (0, 10**10),
    "updates": (1e-6, 1e3),
    "gamma": (0, 0.999999),
    "learning_rate": (1e-9, 1),
    "tau": (1e-9, 1),
    "shift": (0, 64),
    "colours": (0, 100),
    "checkpoints": (1, 10**6),
    "trials": (1, 10**6),
    "save_every": (1, 10**10),
}
"""What each number may be. Beyond these a training ends in an error of arithmetic, for want of memory, or never."""
_WORDS = {"observe": (NERF, SIMULATOR), "action": (STEERING, TWIST), "device": (CPU, CUDA)}

_CLEAR = Ranges(extinction=(0.0, 0.0), sunlight=(0.0, 0.0), shade=(0.0, 0.0), bystanders=(0, 0))
"""The place as filmed; only the robot differs."""


def _numbers(value: Any) -> list[Any]:
    """What is in a number, in several, or in groups of several."""
    groups = value if isinstance(value, tuple | list) else (value,)
    return [number for group in groups for number in (group if isinstance(group, tuple | list) else (group,))]


@dataclass(frozen=True)
class TrainConfig:
    """What a training is. The defaults are the preset for a CPU."""

    task: str = "straight"
    observe: str = NERF
    """nerf, or simulator: MuJoCo's own picture of the extracted mesh."""
    lighting: str = TRAINING
    """See `env/episode_lighting.py`; the default varies between episodes."""
    seed: int = 0
    steps: int = 12_000
    worlds: int = 8
    action: str = STEERING
    """steering (at `speed`) or twist."""
    speed: float = 1.0
    """[m/s]"""
    yaw_rate: float = 1.0
    """[rad/s]"""
    centring: float = 1.0
    """Share of what a step is worth that is lost at the corridor's edge; none on the route."""
    steering: float = 0.5
    """Share of what a step is worth that is lost by steering as hard as can be."""
    entropy: float = -0.5
    """Of each number of an action, that is aimed at [nat]; -0.5 is a spread of 0.15 of the largest, -1 of 0.09."""
    start_along: float = 0.9
    """Every second episode starts on the way, beside the route and askew, up to this share of the stretch: else a
    policy that has learnt to stay in the middle never sees again how to get back there."""
    randomise: bool = True
    """Another robot in every episode; and where the lighting varies, weather and bystanders, too."""
    privileged: bool = True
    """The critics take where the robot is, too, and the encoder learns to tell it; see `sac.py`. Never the policy."""
    pool: int = 2
    convolutions: tuple[tuple[int, int, int], ...] = ((16, 5, 3), (32, 3, 2), (32, 3, 1))
    """Channels, kernel, stride."""
    features: int = 64
    hidden: tuple[int, ...] = (256, 256)
    batch: int = 128
    buffer: int = 50_000
    """Transitions."""
    starts: int = 1_000
    """Steps at random before learning begins."""
    updates: float = 0.5
    """Per step."""
    gamma: float = 0.97
    """Discount per step: what is 33 steps (3 s) away counts a third."""
    learning_rate: float = 5e-4
    """In the first half of the training; see `_model`."""
    tau: float = 0.01
    """Share by which the target critics follow, per update."""
    shift: int = 2
    """Random shift of pictures in updates [px of the small ones]."""
    colours: float = 1.0
    """Strength of the random weather laid over pictures in updates (see `replay_buffer.py`) where the lighting varies. One
    lighting and the simulator's pictures are learnt as they are."""
    checkpoints: int = 20
    """Policies kept along the way."""
    trials: int = 8
    """Episodes that each of the last policies drives without exploring, to choose the best; see `policy_evaluation.py`."""
    save_every: int = 4_000
    """Steps between two saves of everything."""
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Raises InputError: a number out of range, or lights that are kept for validation."""
        for name, (low, high) in _RANGES.items():
            for value in _numbers(getattr(self, name)):
                if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                    raise InputError(f"{name} = {shown(getattr(self, name))}; expected {low:,.10g} to {high:,.10g}")
        for name, valid in _WORDS.items():
            if getattr(self, name) not in valid:
                raise InputError(f"{name} = {shown(getattr(self, name))}; expected {' or '.join(map(repr, valid))}")
        if self.lighting in (HELD_OUT, ANY):
            raise InputError(
                f"lighting = {self.lighting!r}: held-out lights are kept for python -m twin.validate; "
                f"expected {TRAINING!r} or a name"
            )

    @property
    def architecture(self) -> Architecture:
        actions = Control(self.action).actions
        return Architecture((160, 90), 4, self.pool, self.convolutions, self.features, self.hidden, actions)

    @property
    def control(self) -> Control:
        return Control(self.action, self.speed, self.yaw_rate)

    @property
    def states(self) -> tuple[float, ...]:
        """How far each number of `Drive.get_observation` usually goes; none where nothing is privileged."""
        return _STATES if self.privileged else ()

    @property
    def varies(self) -> bool:
        """Whether the lighting does, between episodes."""
        return self.observe == NERF and self.lighting == TRAINING

    def options(self) -> dict[str, Any]:
        """Of the environment."""
        # Worth what surviving for ever would be. With nothing to be had behind it, a policy that is paid by the step
        # learns to linger before the goal, and rather leaves the road there than to arrive.
        # And where only leaving the road costs, it drives anywhere on it: beside the kerb one surprise is enough.
        goal = Rewards.step * self.gamma / (1.0 - self.gamma)
        rewards = Rewards(goal=goal, cross_track=-self.centring * Rewards.step, steering=-self.steering * Rewards.step)
        ranges = Ranges() if self.varies else _CLEAR
        lit = {"lighting": self.lighting, "observe": self.observe, "randomise": ranges if self.randomise else None}
        rest = {"rewards": rewards, "start_along": self.start_along, "device": self.device}
        return dataclasses.asdict(self.control) | lit | rest


PRESETS: dict[str, dict[str, Any]] = {
    "cpu": {},
    # The paper's input at full resolution. Not measured on a GPU yet.
    "gpu": {
        "pool": 1,
        "convolutions": ((32, 8, 4), (64, 4, 2), (64, 3, 1)),
        "features": 100,
        "hidden": (512, 512),
        "worlds": 32,
        "batch": 256,
        "buffer": 100_000,
        "steps": 120_000,
        "updates": 0.5,
        "shift": 4,
        "device": "cuda",
    },
}
