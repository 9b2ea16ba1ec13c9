"""Configuration of a training, with presets for a CPU and for a GPU.

*Steps* are control steps, counted over all environments together; *updates* are steps of the optimizers.
"""

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any

from twin.config import ANY, HELD_OUT, STEERING, TRAINING, TWIST, Condition
from twin.env.domain_randomization import Ranges
from twin.env.options import CPU, CUDA, NERF, SIMULATOR, Rewards
from twin.errors import InputError, short_repr
from twin.learn.policy import Control
from twin.learn.policy_network import Architecture
from twin.ranges import Range, check_ranges

_CHOICES = {"observe": (NERF, SIMULATOR), "action": (STEERING, TWIST), "device": (CPU, CUDA)}

_PER_CYCLE = 20.0  # [m] of a task per cycle of the learning rate

_ROBOT_ONLY = Ranges(extinction=(0.0, 0.0), sunlight=(0.0, 0.0), shade=(0.0, 0.0), bystanders=(0, 0))
"""Randomizes only the robot; the place looks as filmed."""


def steps_for(length: float) -> int:
    """Largest number of steps that `twin train` allows by default on a CPU, for a task of `length` [m].

    They are whole cycles of the learning rate. On 73 m, tests were still improving after 24,000 steps, the number for
    up to 50 m.
    """
    return TrainConfig.cycle * max(2, round(length / _PER_CYCLE))


@dataclass(frozen=True)
class TrainConfig:
    """Configuration of a training. The defaults are the preset for a CPU.

    Each field has a valid `Range`: with values outside it, arithmetic fails, memory runs out, or a training never ends.
    """

    task: str = "straight"
    observe: str = NERF
    """`nerf`: pictures of the radiance field; `simulator`: MuJoCo's pictures of the extracted mesh."""
    lighting: str = TRAINING
    """See `env/episode_lighting.py`; by default, a lighting is sampled for every episode."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    success: Annotated[float, Range(0, 1)] = 0.95
    """Success rate at which the training ends (`selection.py`)."""
    steps: Annotated[int, Range(1, 10**10)] = 24_000
    """Largest number of steps; see `steps_for`."""
    worlds: Annotated[int, Range(1, 4096)] = 8
    """Number of environments."""
    action: str = STEERING
    """See `Control` for `action`, `speed` and `yaw_rate`."""
    speed: Annotated[float, Range(0.01, 10)] = 1.0
    yaw_rate: Annotated[float, Range(0.01, 10)] = 1.0
    centring: Annotated[float, Range(0, 1e3)] = 1.0
    """Fraction of the step reward that is lost at the corridor's edge; on the route, nothing is lost."""
    steering: Annotated[float, Range(0, 1e3)] = 0.5
    """Fraction of the step reward that is lost at full steering."""
    teacher_steps: Annotated[int, Range(1, 10**8)] = 20_000
    """Number of steps of the teacher's training (`teacher.py`)."""
    entropy: Annotated[float, Range(-1e3, 1e3)] = -0.5
    """The teacher's target entropy per component of an action [nat]. For components in [-1, 1], a target of -0.5 means
    a standard deviation of 0.15, and -1 means 0.09."""
    start_along: Annotated[float, Range(0, 0.999)] = 0.999
    """Episodes start at a random point in this first fraction of the route segment, up to 0.8 half widths beside the
    route, and rolling (`Options.start_along`)."""
    along_time: Annotated[float, Range(0.1, 1e4)] = 0.2
    """Length of these episodes [s]. Each has another lighting, weather and robot; short ones, of which there are many,
    teach far more than long ones (docs/findings.md, "Very short episodes that roll")."""
    whole_worlds: Annotated[int, Range(0, 4096)] = 1
    """Number of environments whose episodes begin at the segment's start and are not cut off; at least one is left."""
    randomise: bool = True
    """Randomizes the robot in every episode; if the lighting varies, also the weather and distractor objects."""
    pool: Annotated[int, Range(1, 16)] = 2
    convolutions: Annotated[tuple[tuple[int, int, int], ...], Range(1, 4096)] = ((32, 5, 3), (64, 3, 2), (64, 3, 1))
    """Number of channels, side of the kernel and stride of each convolution."""
    features: Annotated[int, Range(1, 65_536)] = 128
    hidden: Annotated[tuple[int, ...], Range(1, 65_536)] = (256, 256)
    batch: Annotated[int, Range(1, 65_536)] = 128
    buffer: Annotated[int, Range(1, 10**8)] = 50_000
    """Number of pictures from which the policy learns: the newest ones."""
    starts: Annotated[int, Range(0, 10**10)] = 500
    """Number of steps before learning begins."""
    updates: Annotated[float, Range(1e-6, 1e3)] = 0.5
    """Number of updates per step."""
    gamma: Annotated[float, Range(0, 0.999999)] = 0.97
    """The teacher's discount per step; at 0.97, a reward 36 steps (3.6 s) ahead counts a third."""
    learning_rate: Annotated[float, Range(1e-9, 1)] = 5e-4
    """Largest learning rate; see `training.cycle_rate`."""
    cycle: Annotated[int, Range(1, 10**10)] = 12_000
    """Number of steps in a cycle of the learning rate, which falls within each cycle and starts high in the next."""
    tau: Annotated[float, Range(1e-9, 1)] = 0.01
    """Averaging rate of the teacher's target critics, per update."""
    shift: Annotated[int, Range(0, 64)] = 2
    """Largest random shift of preprocessed pictures in updates [px]."""
    colours: Annotated[float, Range(0, 100)] = 1.0
    """Strength of color augmentation in updates (`replay_buffer.py`); applied only if the lighting varies."""
    checkpoints: Annotated[int, Range(1, 10**6)] = 20
    """Number of policies saved in `steps` steps; each test saves one more."""
    test_every: Annotated[int, Range(1, 10**10)] = 3_000
    """Number of steps between two tests of the policy (`selection.py`)."""
    settle: Annotated[int, Range(1, 10**10)] = 2_000
    """Number of further steps, with a falling learning rate, once tests end a training (`selection.py`)."""
    save_every: Annotated[int, Range(1, 10**10)] = 4_000
    """Number of steps between two saved states."""
    device: str = CPU
    """Where the networks are trained; environments run on the CPU."""

    def __post_init__(self) -> None:
        """Raises InputError: a value is out of range, or the lighting is reserved for validation."""
        check_ranges(self)
        for name, valid in _CHOICES.items():
            if getattr(self, name) not in valid:
                choices = " or ".join(map(repr, valid))
                raise InputError(f"{name} = {short_repr(getattr(self, name))}; expected {choices}")
        try:
            _ = self.architecture
        except (TypeError, ValueError) as error:
            raise InputError(f"no network of these sizes: {error}") from None
        if self.lighting in (HELD_OUT, ANY):
            raise InputError(
                f"lighting = {self.lighting!r}: held-out lightings are reserved for twin validate; "
                f"expected {TRAINING!r} or the name of a lighting"
            )

    @property
    def architecture(self) -> Architecture:
        actions = Control(self.action).actions
        return Architecture((160, 90), 4, self.pool, self.convolutions, self.features, self.hidden, actions)

    @property
    def control(self) -> Control:
        return Control(self.action, self.speed, self.yaw_rate)

    @property
    def lighting_varies(self) -> bool:
        return self.observe == NERF and self.lighting == TRAINING

    @property
    def shown_condition(self) -> Condition:
        """Condition in which the trained policy is shown: that of `twin validate`, or the training's one lighting."""
        return Condition(HELD_OUT, True) if self.lighting_varies else Condition(self.lighting)

    def options(self) -> dict[str, Any]:
        # The loss of reward beside the route keeps policies off the curb, where one disturbance ends an episode. The
        # goal needs no reward, since it is no end for the teacher's critics.
        rewards = Rewards(cross_track=-self.centring * Rewards.step, steering=-self.steering * Rewards.step)
        ranges = Ranges() if self.lighting_varies else _ROBOT_ONLY
        return {
            **dataclasses.asdict(self.control),
            "lighting": self.lighting,
            "observe": self.observe,
            "randomise": ranges if self.randomise else None,
            "rewards": rewards,
            "start_along": self.start_along,
            "along_time": self.along_time,
        }

    def teacher_options(self) -> dict[str, Any]:
        """Options of the teacher's environments, which render no pictures."""
        ranges = _ROBOT_ONLY if self.randomise else None
        return {**self.options(), "pixels": False, "lighting": TRAINING, "observe": NERF, "randomise": ranges}


PRESETS: dict[str, dict[str, Any]] = {
    "cpu": {},
    # Pictures have the full resolution, as in arXiv 2403.15791. No training with this preset was run to its end yet.
    "gpu": {
        "pool": 1,
        "convolutions": ((32, 8, 4), (64, 4, 2), (64, 3, 1)),
        "features": 100,
        "hidden": (512, 512),
        "worlds": 32,
        "batch": 256,
        "steps": 60_000,
        "shift": 4,
        "device": CUDA,
    },
}
