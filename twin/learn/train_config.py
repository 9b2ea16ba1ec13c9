"""What a training is asked for: `TrainConfig`, and the presets for a CPU and for a GPU.

*Steps* are control steps of all worlds together. *Updates* are steps of the optimisers.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

from twin.config import ANY, HELD_OUT, TRAINING
from twin.env.options import NERF, STEERING, Rewards
from twin.env.randomisation import Ranges
from twin.errors import InputError
from twin.learn.architecture import Architecture
from twin.learn.policy import Control

_STATES = (1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 0.3)
"""Speed [m/s], yaw rate [rad/s], cross-track [m], heading error and turns 1, 2 and 4 m ahead [rad]."""

_CLEAR = Ranges(extinction=(0.0, 0.0), sunlight=(0.0, 0.0), shade=(0.0, 0.0), bystanders=(0, 0))
"""The place as filmed; only the robot differs."""


@dataclass(frozen=True)
class TrainConfig:
    """What a training is. The defaults are the preset for a CPU."""

    task: str = "straight"
    observe: str = NERF
    """nerf, or simulator: MuJoCo's own picture of the extracted mesh."""
    lighting: str = TRAINING
    """See `env/lightings.py`; the default varies between episodes."""
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
    """Strength of the random weather laid over pictures in updates (see `colours.py`) where the lighting varies. One
    lighting and the simulator's pictures are learnt as they are."""
    checkpoints: int = 20
    """Policies kept along the way."""
    trials: int = 8
    """Episodes that each of the last policies drives without exploring, to choose the best; see `choosing.py`."""
    save_every: int = 4_000
    """Steps between two saves of everything."""
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Raises InputError: a number out of range, or lights that are kept for validation."""
        for name, least in (("seed", 0), ("steps", 1), ("worlds", 1), ("trials", 1), ("colours", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name} = {getattr(self, name)}; expected {least} or more")
        if self.updates <= 0:
            raise InputError(f"updates = {self.updates}; expected more than 0 per step")
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
