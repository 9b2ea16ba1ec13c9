"""Converts a robot's ROS bags, of drives by a policy or by hand, to a LeRobot dataset.

A frame has the newest picture, as a policy would see it; speed and yaw rate from the poses before it; and the mean of
the commands until the next frame. Rewards and outcome follow from the poses by the twin's rules. `drive_dataset.py`
describes the format.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin import runtime
from twin.assets.ground import Ground
from twin.config import TWIST
from twin.env.episode import Episode
from twin.env.suite import EnvFactory
from twin.errors import InputError
from twin.evaluation.trial_judge import judge
from twin.files import new_folder, require_absent
from twin.learn.policy import find_policy, load_policy
from twin.loading import load_scene
from twin.report.drive_dataset import DriveDataset, drive_instruction, require_pyarrow
from twin.scene import require_stage
from twin.sysid.trial_recording import FIT, TrialRecording, read_trial, scene_frame
from twin.types import Array, Image
from twin_policy import Rectifier

_SPEED_SPAN = 0.2  # [s] before an instant, over which speed is measured; later poses would show later commands
_MAX_GAP = 0.5  # [s] longest time without a picture; also the time after which the robot stops without a command


def write_bag_dataset(
    root: Path,
    bags: Sequence[Path],
    out: Path,
    task: str,
    policy_name: str | None = None,
    lighting: str = "",
    cause: str | None = None,
    frame: str = FIT,
    topics: dict[str, str] | None = None,
) -> list[Episode]:
    """Writes recordings of drives as a LeRobot dataset; returns the drives as episodes.

    Args:
        root: A built scene, or a pack.
        bags: One drive each, by a policy or by hand; see `twin.sysid.trial_recording`.
        out: The dataset's folder; must not exist.
        task: See `twin.load`.
        policy_name: The policy that determines the frames' camera and period; None: those of the scene's environments.
        lighting: Name of the day or light in the dataset's table of drives.
        cause: The cause of the recording's end, as stated by the operator; only allowed with a single bag.
        frame: See `twin.sysid.trial_recording.scene_frame`.
        topics: Topics of the bags; see `read_trial`.

    Raises:
        InputError: scene, policy or a bag is unusable, `out` exists, or pyarrow is not installed.
    """
    if cause and len(bags) > 1:
        raise InputError(f"--cause {cause} applies to one bag; there are {len(bags)}")
    require_pyarrow()
    require_absent(out)
    scene = load_scene(root)
    policy = load_policy(find_policy(scene.scene.root, policy_name)) if policy_name else None
    seen = policy.options() if policy else {}
    factory = EnvFactory.open(scene, task, {**seen, "action": TWIST, "pixels": False})
    options = factory.options
    camera = (policy and policy.trained.get("camera")) or factory.world.camera.resized(options.size).intrinsics
    physics, driving = factory.make_env(0)
    limits, ground = driving.action_spec(physics), Ground.load(require_stage(scene.scene, "mesh"))
    names = ("linear_velocity", "angular_velocity")
    ranges = {n: (float(a), float(b)) for n, a, b in zip(names, limits.minimum, limits.maximum, strict=True)}
    words = drive_instruction(scene.scene.root, task)
    drives = []
    with new_folder(out) as folder:
        dataset = DriveDataset(folder, options.size, options.control_timestep, ranges, words)
        for bag in bags:
            recording = read_trial(bag, topics)
            rectify, begin = recording.rectifier(options.size, camera), recording.start()
            fit = scene_frame(recording, frame, begin, scene.scene, factory.world.robot)
            times, poses, upright = recording.motion_at_steps(begin, options.control_timestep)
            trial = judge(factory, times, fit(poses), upright)
            rewards = trial.rewards.copy()
            if cause:
                trial = trial.with_cause(cause, bag)
                rewards[-1] = getattr(options.rewards, cause)
            stamps = begin + np.round(trial.times * 1e9).astype(np.int64)
            motion = _motion(recording, stamps)
            base_to_world = np.tile(np.eye(4), (len(stamps), 1, 1))
            base_to_world[:, :3, :3] = Rotation.from_euler("z", trial.poses[:, 2:]).as_matrix()
            base_to_world[:, :2, 3] = trial.poses[:, :2]
            base_to_world[:, 2, 3] = ground.at(trial.poses[:, :2])
            drives.append(
                Episode(
                    times=trial.times,
                    base_to_world=base_to_world,
                    qpos=np.zeros((len(stamps), 0)),  # the simulator's state, which a recording does not have
                    actions=_actions(recording, stamps, options.control_timestep),
                    rewards=rewards,
                    speed=motion[:, 0],
                    cross_track=trial.cross_track,
                    progress=trial.progress,
                    trust=np.full(len(stamps), np.nan),
                    cause=trial.cause,
                    touched=(),
                    task=factory.segment.name,
                    lighting=lighting,
                    seed=begin // 10**6,  # as in `real_trials.csv`
                    randomisation={},
                    obstacles=(),
                )
            )
            dataset.add(drives[-1], _pictures_at(recording, rectify, stamps), motion)
        dataset.finish()
    return drives


def _motion(recording: TrialRecording, stamps: NDArray[np.int64]) -> Array:
    """Speed along the heading [m/s] and yaw rate [rad/s] over the last `_SPEED_SPAN`, shape (k, 2)."""
    now, before = (recording.poses_at(one) for one in (stamps, stamps - round(_SPEED_SPAN * 1e9)))
    (x, y, turn), yaw = ((now - before) / _SPEED_SPAN).T, (now[:, 2] + before[:, 2]) / 2.0
    return np.column_stack([x * np.cos(yaw) + y * np.sin(yaw), turn])


def _actions(recording: TrialRecording, stamps: NDArray[np.int64], period: float) -> Array:
    """Action in the step after each instant, v [m/s] and ω [rad/s], shape (k, 2); the last one is zero.

    An action is the mean of the commands in the step. Without commands it is the last earlier command, or zero if that
    is older than `_MAX_GAP`, since the robot has then stopped.
    """
    actions = np.zeros((len(stamps), 2))
    ends = np.searchsorted(recording.command_times, stamps + round(period * 1e9))
    for k, (start, end) in enumerate(zip(np.searchsorted(recording.command_times, stamps), ends, strict=True)):
        if end > start:
            actions[k] = recording.commands[start:end].mean(0)
        elif start and stamps[k] - recording.command_times[start - 1] < _MAX_GAP * 1e9:
            actions[k] = recording.commands[start - 1]
    actions[-1] = 0.0
    return actions


def _pictures_at(recording: TrialRecording, rectify: Rectifier, stamps: NDArray[np.int64]) -> list[Image]:
    """The newest picture (h, w, 3) at each instant. Raises InputError: at an instant there is no recent picture."""
    newest = np.maximum(0, np.searchsorted(recording.shutter, stamps, side="right") - 1)
    ages = np.abs(stamps - recording.shutter[newest]) * 1e-9
    if ages.max() > _MAX_GAP:
        at = float((stamps[ages.argmax()] - stamps[0]) * 1e-9)
        raise InputError(
            f"{recording.path}: {recording.topics['pictures']} has no picture within {ages.max():.1f} s of {at:.1f} s "
            f"after the first command; expected one every {_MAX_GAP:g} s at least"
        )
    pictures: dict[int, Image] = {}
    with runtime.bar("pictures", len(np.unique(newest)), "picture") as progress:
        for stamp, picture in recording.rectified(recording.shutter[np.unique(newest)], rectify):
            pictures[stamp] = picture
            progress.update()
    return [pictures[int(stamp)] for stamp in recording.shutter[newest]]
