"""`twin trial`: evaluates a robot's recording of a trial: counts it in `real.csv`, and compares it with the twin.

    python -m twin.trial scenes/my_road monday_1.mcap --policy first --task straight --lighting monday

The bag has the front camera's pictures and camera_info, commands, and poses (RTK, LiDAR or filtered odometry). Pictures
are localized in the scene, and the poses are fitted to their positions. Then the trial is judged by the twin's rules of
success and failure. Poses do not show collisions; `--cause collision` states that the recording ends with one.

Two files are written to `<scene>/trials/<bag>/`: `trial.mp4` shows the robot's pictures beside the twin's. `trial.json`
has the outcome, the distance between the final positions of the twin's robot and the real one under the same commands,
the similarity of the pictures, and the fraction of the recorded commands that the policy gives again for the recorded
pictures. The trial is counted in `real.csv`, and listed with its cause in `real_trials.csv` beside it.

    python -m twin.trial scenes/my_road monday_1.mcap monday_2.mcap --task straight --lerobot drives

With `--lerobot`, recordings are instead written as a dataset for learning; they may also be of drives by hand. See
`record_dataset`.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin import commands, runtime
from twin.assets.ground import Ground
from twin.capture.camera_models import Lens
from twin.capture.localize import register_film
from twin.config import TWIST, Condition
from twin.env.episode import Episode
from twin.env.suite import EnvFactory
from twin.errors import InputError
from twin.evaluation.trial_judge import JudgedTrial, TrialViews, judge, replay, view
from twin.evaluation.trials import Trial, read_counts, read_trials, tally, write_real_trials
from twin.files import new_folder, require_absent, write_json
from twin.learn.policy import Policy, find_policy, load_policy
from twin.loading import Twin, load_scene
from twin.robot import PixelCamera
from twin.scene import require_stage
from twin.sysid.camera_extrinsics import base_below_camera
from twin.sysid.trial_recording import FrameFit, TrialRecording, fit_frame, read_trial
from twin.types import Array, Image
from twin_policy import Camera, Limits, PictureError, Pilot, Rectifier

SCENE_FRAME, FIT = "scene", "pictures"
_LOCATED = 24  # number of pictures that are localized in the scene
_MOVING = 0.02  # [m/s], [rad/s]; the trial starts with the first command that exceeds this
_ANSWER = 300_000_000  # [ns] longest time from a picture to the command that follows from it
_SAME = 1e-3  # [m/s], [rad/s]; commands that differ by less count as equal
_SPEED_SPAN = (
    0.2  # [s] before an instant over which speed is measured from poses; later poses would show later commands
)
_MAX_GAP = 0.5  # [s] longest time without a picture in a dataset, and time for which a command is in force (ROS 2)
_START_OFFSET, _START_HEADING = 0.3, 10.0  # [m], [°] largest deviations from the route at a trial's start in the twin


def record_trial(
    root: Path,
    bag: Path,
    policy_name: str,
    task: str,
    lighting: str,
    out: Path | None = None,
    twin_lighting: str | None = None,
    cause: str | None = None,
    frame: str = FIT,
    topics: dict[str, str] | None = None,
) -> tuple[Trial, dict[str, Any], Path]:
    """Judges a trial, and writes its results. Returns its table row, its figures and its folder.

    Args:
        root: A built scene.
        bag: See `twin.sysid.trial_recording`.
        policy_name: The policy that drove: a run's name, or a source of `twin.learn.policy.load_policy`.
        task: See `twin.load`.
        lighting: Name of the day or light in `real.csv`.
        out: `real.csv`; by default the scene's.
        twin_lighting: The twin's lighting to compare with; by default the one named `lighting`.
        cause: The cause of the recording's end, as stated by the operator.
        frame: `SCENE_FRAME` if the poses are in the scene's frame; `FIT` if their frame is to be fitted to localized
            pictures.
        topics: Topics of the bag; see `read_trial`.

    Raises:
        InputError: scene, policy, bag or table is unusable, or the trial has no outcome.
    """
    scene = load_scene(root)
    policy = load_policy(find_policy(root, policy_name))
    recording = read_trial(bag, topics)
    out = out or root / "real.csv"
    table = out.with_name(f"{out.stem}_trials.csv")
    known = _known_trials(table, out)
    compared = twin_lighting or lighting
    factory = EnvFactory.open(scene, task, policy.options())
    if factory.field is None:
        raise InputError(f"{root}: has no field to compare pictures with; build it")
    name = Condition.parse(compared).lighting
    chosen = name if name in factory.field.lightings else None
    rectify = _rectifier(recording, policy, factory)
    begin = _begin(recording)
    fit = _frame(recording, scene, factory, begin) if frame == FIT else FrameFit(0.0, np.zeros(2))
    trial = _with_cause(_judge(recording, factory, fit, begin), cause, bag)
    end = begin + round(float(trial.times[-1]) * 1e9)

    since = np.asarray((recording.command_times - begin) * 1e-9, np.float64)
    replayed = replay(factory, trial.poses[0], trial.times, since, recording.commands)
    used, pictures, apart = _pictures(recording, rectify, policy, begin, end)
    width, height = rectify.pinhole.size
    camera = PixelCamera(rectify.pinhole.intrinsics, (width, height))
    views = view(factory, fit(recording.poses_at(used)), pictures, camera, chosen)

    folder = root / "trials" / bag.stem
    folder.mkdir(parents=True, exist_ok=True)
    steps = len(trial.times) - 1
    row = Trial(
        *(policy.name, factory.segment.name, lighting, begin // 10**6, trial.cause, float(trial.progress[-1]), steps),
        float(views.trust.mean()),
    )
    head = {"bag": str(bag), "name": row.policy, "task": row.task, "lighting": lighting, "twin_lighting": compared}
    figures = head | _figures(recording, trial, replayed, fit, views, apart)
    from twin.report.review_video import load_ground_and_parts
    from twin.report.trial_video import write_trial_video

    write_trial_video(
        folder / "trial.mp4",
        trial,
        replayed,
        pictures,
        np.asarray((used - begin) * 1e-9, np.float64),
        views,
        factory.world,
        factory.options.half_width or factory.world.half_width,
        (factory.segment.start, factory.segment.end),
        load_ground_and_parts(scene.scene),
        f"{bag.stem}: {row.policy}, {row.task.replace('_', ' ')}",
    )
    write_json(folder / "trial.json", figures)
    write_real_trials([*(one for one in known if _key(one) != _key(row)), row], table, out, compared)
    return row, figures, folder


def record_dataset(
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
    """Writes drives on the road as a LeRobot dataset, see `twin.report.drive_dataset`; returns them as episodes.

    A frame has the newest picture, as a policy would see it; speed and yaw rate from the poses before it; and the mean
    of the commands until the next frame. The other data come from the poses and the twin's rules.

    Args:
        root, task, frame, topics: See `record_trial`.
        bags: One drive each, by a policy or by hand.
        out: The dataset's folder; must not exist.
        policy_name: The policy that determines the frames' camera and period; None: those of the scene's environments.
        lighting: Name of the day or light in the dataset's table of drives.
        cause: The cause of the recording's end, as stated by the operator; only allowed with a single bag.

    Raises:
        InputError: an error of `record_trial`, except that a drive needs no outcome; `out` exists, or pyarrow is not
            installed.
    """
    from twin.report.drive_dataset import DriveDataset, drive_instruction, require_pyarrow

    if cause and len(bags) > 1:
        raise InputError(f"--cause {cause} is of one bag; there are {len(bags)}")
    require_pyarrow()
    require_absent(out)
    scene = load_scene(root)
    policy = load_policy(find_policy(root, policy_name)) if policy_name else None
    seen = policy.options() if policy else {}
    factory = EnvFactory.open(scene, task, {**seen, "action": TWIST, "pixels": False})
    options = factory.options
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
            rectify, begin = _rectifier(recording, policy, factory), _begin(recording)
            fit = _frame(recording, scene, factory, begin) if frame == FIT else FrameFit(0.0, np.zeros(2))
            trial = _judge(recording, factory, fit, begin)
            rewards = trial.rewards.copy()
            if cause:
                trial = _with_cause(trial, cause, bag)
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


def _begin(recording: TrialRecording) -> int:
    """Start of the trial [ns]: the time of the first command that moves the robot."""
    moving = np.flatnonzero(np.abs(recording.commands).max(1, initial=0.0) > _MOVING)
    if not len(moving):
        topic = recording.topics["commands"]
        raise InputError(f"{recording.path}: no command on {topic} moves the robot; record the whole trial")
    return int(recording.command_times[moving[0]])


def _motion(recording: TrialRecording, stamps: NDArray[np.int64]) -> Array:
    """Speed along the heading [m/s] and yaw rate [rad/s] over the last `_SPEED_SPAN`, shape (k, 2)."""
    now, before = (recording.poses_at(one) for one in (stamps, stamps - round(_SPEED_SPAN * 1e9)))
    (x, y, turn), yaw = ((now - before) / _SPEED_SPAN).T, (now[:, 2] + before[:, 2]) / 2.0
    return np.column_stack([x * np.cos(yaw) + y * np.sin(yaw), turn])


def _actions(recording: TrialRecording, stamps: NDArray[np.int64], period: float) -> Array:
    """Action in the step after each instant, v [m/s] and ω [rad/s], shape (k, 2); the last one is zero.

    It is the mean of the commands in the step. If there are none, it is the last command before, or zero if that is too
    old, since the robot has then stopped.
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
        for stamp, picture in recording.pictures(recording.shutter[np.unique(newest)]):
            try:
                pictures[stamp] = rectify(picture.decode())
            except PictureError as error:
                raise InputError(f"{recording.path}: {recording.topics['pictures']}: {error}") from None
            progress.update()
    return [pictures[int(stamp)] for stamp in recording.shutter[newest]]


def _key(trial: Trial) -> tuple[str, str, str, int]:
    return trial.policy, trial.task, trial.lighting, trial.seed


def _known_trials(table: Path, out: Path) -> list[Trial]:
    """The trials recorded so far. Raises InputError: `out` has further trials, which would be lost."""
    known = read_trials(table) if table.exists() else []
    explained = {cell.key: cell for cell in tally(known)}
    for key, (trials, _) in (read_counts(out) if out.exists() else {}).items():
        mine = explained[key].trials if key in explained else 0
        if trials > mine:
            raise InputError(
                f"{out}: {trials} trials of {key[0]} under {key[2]}, of which {table.name} has {mine}; give another "
                "--out, and join the two by hand"
            )
    return known


def _rectifier(recording: TrialRecording, policy: Policy | None, factory: EnvFactory) -> Rectifier:
    """Rectifier from the robot's camera to the policy's camera, or else to that of the scene's environments."""
    size = factory.options.size
    own = (policy and policy.trained.get("camera")) or factory.world.camera.resized(size).intrinsics
    try:
        fx, fy, cx, cy = map(float, own)
        return Rectifier(recording.camera, Camera(size, (fx, fy, cx, cy)))
    except (PictureError, TypeError, ValueError) as error:
        raise InputError(f"{recording.path}: {error}") from None


def _frame(recording: TrialRecording, scene: Twin, factory: EnvFactory, begin: int) -> FrameFit:
    """Localizes pictures, evenly spaced along the drive, in the scene, and fits the frame of the poses to them."""
    ground = Ground.load(require_stage(scene.scene, "mesh"))
    stamps = recording.shutter[recording.shutter >= begin]
    xy = recording.poses_at(stamps)[:, :2]
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))) if len(xy) else np.zeros(0)
    some = np.unique(np.searchsorted(way, np.linspace(0.0, way[-1], _LOCATED))) if len(way) else np.zeros(0, int)
    native = recording.camera.without_distortion()
    rectify = Rectifier(recording.camera, native, max_outside=1.0)
    frames, shown = [], []
    for stamp, picture in recording.pictures(stamps[some]):
        try:
            frames.append(rectify(picture.decode()))
        except PictureError as error:
            raise InputError(f"{recording.path}: {recording.topics['pictures']}: {error}") from None
        shown.append(stamp)
    if not frames:
        raise InputError(f"{recording.path}: no picture after the first command; record pictures throughout")
    found = register_film(frames, Lens("PINHOLE", native.intrinsics, *native.size), scene.scene)
    located = [base_below_camera(factory.world.robot, pose, ground.at) for pose in found.camera_to_world]
    times = np.array(shown, np.int64)[found.frames]
    return fit_frame(recording.poses_at(times), np.array(located).reshape(-1, 3), str(recording.path))


def _judge(recording: TrialRecording, factory: EnvFactory, fit: FrameFit, begin: int) -> JudgedTrial:
    """The trial from its first command to its outcome or the recording's end."""
    period = factory.options.control_timestep
    left = (int(recording.pose_times[-1]) - begin) * 1e-9
    steps = int(left / period + 1e-6)
    if begin < recording.pose_times[0] or steps < 1:
        raise InputError(
            f"{recording.path}: {recording.topics['poses']} has poses from "
            f"{(int(recording.pose_times[0]) - begin) * 1e-9:.1f} to {left:.1f} s after the first "
            "command; expected the whole trial"
        )
    times = np.arange(steps + 1) * np.float64(period)
    stamps = begin + np.round(times * 1e9).astype(np.int64)
    upright = np.interp(stamps - begin, recording.pose_times - begin, recording.uprightness)
    return judge(factory, times, fit(recording.poses_at(stamps)), upright)


def _with_cause(trial: JudgedTrial, cause: str | None, bag: Path) -> JudgedTrial:
    """The trial with the cause stated by the operator, if one is given."""
    if cause == "goal" and trial.cause != "goal":
        raise InputError(
            f"{bag}: the recording ends {trial.progress[-1]:.1f} m along the task ({trial.cause or 'no outcome'}); "
            "expected a cause of failure, as the goal was not reached"
        )
    if not (cause or trial.cause):
        raise InputError(
            f"{bag}: the recording ends after {trial.times[-1]:.1f} s and {trial.progress[-1]:.1f} m without an "
            "outcome; record to the end, or say what ended it, such as --cause collision"
        )
    return replace(trial, cause=cause or trial.cause)


class _PolicyOfPictures:
    """A policy of `twin` with the interface that `twin_policy.pilot.Pilot` expects."""

    camera = None

    def __init__(self, policy: Policy) -> None:
        self._policy, self.size, self.timestep = policy, policy.size, policy.control.control_timestep
        self.stack, self.stack_shape = policy.stack, (3 * policy.stack, policy.size[1], policy.size[0])

    def command(self, stack: Image) -> tuple[float, float]:
        return self._policy.command(self._policy(stack))


def _pictures(
    recording: TrialRecording, rectify: Rectifier, policy: Policy, begin: int, end: int
) -> tuple[NDArray[np.int64], list[Image], Array]:
    """Feeds the pictures between start and end to the pilot that runs policies on the robot.

    Returns:
        Stamps [ns] (n,) of the pictures that the policy used; these pictures (h, w, 3); and for each that is soon
        followed by a recorded command, the policy's command minus the recorded one, v [m/s] and ω [rad/s], shape
        (m, 2), m ≤ n.
    """
    first = max(0, int(np.searchsorted(recording.shutter, begin, side="right")) - 1)
    which = slice(first, int(np.searchsorted(recording.shutter, end, side="right")))
    arrival = dict(zip(recording.shutter[which].tolist(), recording.arrival[which].tolist(), strict=True))
    now = 0  # the pilot's clocks show when each picture was recorded

    def clock() -> int:
        return now

    # On the robot, the pilot stops if pictures are late. Here every picture is evaluated, so the limits are wide.
    loose = Limits(timeout=10.0, inference=10.0, ahead=10.0, clock_jump=10.0, rest=0.0)
    pilot = Pilot(_PolicyOfPictures(policy), loose, rectify.pinhole, clock, clock)  # type: ignore[arg-type]
    pilot.set_camera(recording.camera)
    stamps, pictures, apart = [], [], []
    with runtime.bar("pictures", len(arrival), "picture") as progress:
        for stamp, picture in recording.pictures(recording.shutter[which]):
            now = max(now, arrival[stamp])
            command = pilot.picture(picture, stamp)
            if command.drives and command.stamp == stamp:
                stamps.append(stamp)
                pictures.append(np.ascontiguousarray(pilot.stack[-1].transpose(1, 2, 0)))
                next_one = int(np.searchsorted(recording.command_times, stamp))
                if next_one < len(recording.commands) and recording.command_times[next_one] < stamp + _ANSWER:
                    apart.append(np.subtract((command.v, command.yaw_rate), recording.commands[next_one]))
            progress.update()
    if not stamps:
        cause = pilot.command().cause
        raise InputError(f"{recording.path}: no usable picture of {len(arrival)} during the trial: {cause}")
    return np.array(stamps, np.int64), pictures, np.array(apart).reshape(-1, 2)


def _figures(
    recording: TrialRecording,
    trial: JudgedTrial,
    replayed: Array,
    fit: FrameFit,
    views: TrialViews,
    apart: Array,
) -> dict[str, Any]:
    """All numbers of a trial, for JSON."""
    off = np.linalg.norm(trial.poses[:, :2] - replayed[:, :2], axis=1)

    def at(seconds: float) -> float | None:
        return float(np.interp(seconds, trial.times, off)) if trial.times[-1] >= seconds else None

    turned = (trial.poses[-1, 2] - replayed[-1, 2] + np.pi) % (2 * np.pi) - np.pi
    same = np.abs(apart).max(1, initial=0.0) < _SAME
    return {
        "cause": trial.cause,
        "success": trial.cause == "goal",
        "progress_m": float(trial.progress[-1]),
        "seconds": float(trial.times[-1]),
        "start": {"cross_track_m": float(trial.cross_track[0]), "heading_deg": float(np.degrees(trial.start_heading))},
        "cross_track_max_m": float(np.abs(trial.cross_track).max()),
        "topics": recording.topics,
        "frame": {
            "located": fit.located,
            "residual_m": fit.residual,
            "scale": fit.scale,
            "yaw_deg": float(np.degrees(fit.yaw)),
            "shift_m": fit.shift.tolist(),
        },
        "replay": {
            "after_2_s_m": at(2.0),
            "after_5_s_m": at(5.0),
            "end_m": float(off[-1]),
            "end_deg": float(np.degrees(turned)),
        },
        "pictures": {
            "count": len(views.psnr),
            "lighting": views.lighting,
            "psnr_median": float(np.median(views.psnr)),
            "psnr_matched_median": float(np.median(views.matched_psnr)),
            "trust_mean": float(views.trust.mean()),
        },
        "policy": {
            "commands": len(apart),
            "same": float(same.mean()) if len(apart) else None,
            "v_rms": float(np.sqrt((apart[:, 0] ** 2).mean())) if len(apart) else None,
            "yaw_rate_rms": float(np.sqrt((apart[:, 1] ** 2).mean())) if len(apart) else None,
        },
    }


def summary(row: Trial, figures: dict[str, Any]) -> str:
    """The printed summary."""
    frame, replayed, seen, policy = (figures[name] for name in ("frame", "replay", "pictures", "policy"))
    lines = [
        f"{row.policy}, {row.task}, {row.lighting}: {row.cause} after {row.progress:.1f} m and "
        f"{figures['seconds']:.1f} s, at most {figures['cross_track_max_m']:.2f} m off the route"
    ]
    start, heading = figures["start"]["cross_track_m"], figures["start"]["heading_deg"]
    if abs(start) > _START_OFFSET or abs(heading) > _START_HEADING:
        lines.append(
            f"caution: it started {start:+.2f} m and {heading:+.0f}° off the route; trials in the twin start within "
            f"{_START_OFFSET:g} m and {_START_HEADING:g}°"
        )
    if frame["located"]:
        lines.append(
            f"{frame['located']} pictures located; poses fit them to {frame['residual_m']:.2f} m rms, "
            f"{(frame['scale'] - 1.0):+.1%} in scale"
        )
    early = "" if replayed["after_2_s_m"] is None else f"{replayed['after_2_s_m']:.2f} m after 2 s, "
    lines.append(
        f"the twin's robot under the same commands: {early}{replayed['end_m']:.2f} m and {replayed['end_deg']:+.0f}° "
        "off at the end"
    )
    lines.append(
        f"pictures against the twin under {seen['lighting']}: {seen['psnr_median']:.1f} dB, "
        f"{seen['psnr_matched_median']:.1f} dB with colors matched, trust {seen['trust_mean']:.2f}"
    )
    if policy["commands"]:
        lines.append(
            f"the policy gives {policy['same']:.0%} of {policy['commands']} recorded commands again; yaw rates differ "
            f"by {policy['yaw_rate_rms']:.3f} rad/s rms"
        )
    return "\n".join(lines)


def command(options: argparse.Namespace) -> None:
    """Runs the verb with the options parsed by `twin.commands`."""
    names = {
        "pictures": options.image,
        "camera": options.camera_info,
        "poses": options.poses,
        "commands": options.commands,
    }
    topics = {kind: topic for kind, topic in names.items() if topic}
    if options.lerobot:
        drives = record_dataset(
            *(options.scene, options.bag, options.lerobot, options.task, options.policy, options.lighting or ""),
            *(options.cause, options.frame, topics),
        )
        if not options.quiet:
            from twin.report.drive_dataset import drives_summary

            print(drives_summary(drives, options.lerobot))
        return
    if len(options.bag) > 1:
        raise InputError(f"{len(options.bag)} bags: a bag is a trial; several are for --lerobot DIR")
    for name in ("policy", "lighting"):
        if not getattr(options, name):
            raise InputError(f"a trial needs --{name}; without a policy, --lerobot DIR records drives to learn from")
    row, figures, folder = record_trial(
        *(options.scene, options.bag[0], options.policy, options.task, options.lighting, options.out),
        *(options.twin_lighting, options.cause, options.frame),
        topics,
    )
    if not options.quiet:
        print(summary(row, figures))
        print(f"look at {folder / 'trial.mp4'}")


main = partial(commands.main, "trial")

if __name__ == "__main__":
    sys.exit(main())
