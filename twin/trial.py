"""`twin trial`: evaluates a robot's recording of a trial: counts it in `real.csv`, and compares it with the twin.

    twin trial scenes/my_road monday_1.mcap --policy first --task straight --lighting monday

Pictures of the bag are localized in the scene, and its poses are fitted to their positions. Then the twin's rules of
success and failure are applied. Poses do not show collisions; `--cause collision` states that the recording ends with
one. `<scene>/trials/<bag>/` has a film (`trial.mp4`) and the figures (`trial.json`): the outcome, a replay of the
commands in the twin, the similarity of the pictures, and the commands that the policy gives for the recorded pictures.
The trial is counted in `real.csv`, and listed with its cause in `real_trials.csv` beside it.

With `--lerobot`, recordings are written as a dataset for learning instead; see `twin/report/drive_dataset.py`.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin import commands, runtime
from twin.config import Condition
from twin.env.env_factory import EnvFactory
from twin.env.episode_lighting import check_lighting_names
from twin.errors import InputError
from twin.evaluation.trial_judge import JudgedTrial, TrialViews, judge, replay, view
from twin.evaluation.trials import REAL_CSV, Trial, check_twin_lighting, read_real_trials, write_real_trials
from twin.files import read_json, wrap_read_errors, write_json
from twin.geometry.poses import wrap_angle
from twin.learn.policy import Policy, find_policy, load_policy, policy_digest
from twin.loading import load_writable
from twin.report.drive_dataset import drives_summary, write_bag_dataset
from twin.report.drive_video import write_trial_video
from twin.report.review_video import load_ground_and_parts
from twin.robot import PixelCamera
from twin.runtime import exclusive_lock
from twin.sysid.trial_recording import FrameFit, PosesFrame, TrialRecording, read_trial, scene_frame
from twin.types import Array, Image
from twin_policy import Limits, Pilot, Rectifier

_ANSWER = 300_000_000  # [ns] longest time from a picture to the command that follows from it
_SAME = 1e-3  # [m/s], [rad/s]; commands that differ by less count as equal
_OWN = 0.5  # if the policy repeats a smaller share of the commands, another one or a person may have driven
_START_ALONG = 0.5  # [m] largest distance along the route from the task's start at which no caution is printed
_START_OFFSET, _START_HEADING = 0.3, 10.0  # [m], [°] largest deviations from the route at a trial's start in the twin


def evaluate_trial(
    root: Path,
    bag: Path,
    policy_name: str,
    task: str,
    lighting: str,
    out: Path | None = None,
    twin_lighting: str | None = None,
    cause: str | None = None,
    frame: PosesFrame = "pictures",
    topics: dict[str, str] | None = None,
) -> tuple[Trial, dict[str, Any], Path]:
    """Evaluates a trial and writes its results. Returns its row of `real_trials.csv`, its figures and its folder.

    Args:
        root: A built scene.
        bag: See `twin.sysid.trial_recording`.
        policy_name: The policy that drove: a run's name, or a source of `twin.learn.policy.load_policy`.
        task: See `twin.load`.
        lighting: Name of the day or light in `real.csv`.
        out: Path of `real.csv`; by default in the scene's folder.
        twin_lighting: The lighting of the twin that the trial is counted under, by default that of the same cell in
            `out`, or `lighting`. Pictures are compared with it or, if it is a set or the default is not the name of
            a lighting of the field, with the lighting that matches them best.
        cause: The cause of the recording's end, as stated by the operator.
        frame: See `twin.sysid.trial_recording.PosesFrame`.
        topics: Topics of the bag; see `read_trial`.

    Raises:
        InputError: scene, policy, bag or table is unusable, or the trial has no outcome.
    """
    scene = load_writable(root)
    policy = load_policy(find_policy(root, policy_name))
    out = out or root / REAL_CSV
    factory = EnvFactory.open(scene, task, policy.options())
    if factory.field is None:
        raise InputError(f"{root}: has no field to compare pictures with; build it")
    if twin_lighting:
        check_lighting_names(Condition.parse(twin_lighting).lighting, factory.field)
    with exclusive_lock(out.with_name(f".{out.stem}.lock"), f"{out} is being written"):
        recording = read_trial(bag, topics)
        table = out.with_name(f"{out.stem}_trials.csv")
        known = read_real_trials(table, out)
        cell = policy.name, factory.segment.name, lighting
        compared = check_twin_lighting(out, cell, twin_lighting) or lighting
        name = Condition.parse(compared).lighting
        chosen = name if name in factory.field.lightings else None
        own = policy.trained.get("camera") or factory.world.camera.resized(factory.options.size).intrinsics
        rectify = recording.rectifier(factory.options.size, own)
        begin = recording.start()
        fit = scene_frame(recording, frame, begin, scene.scene, factory.world.robot)
        times, poses, upright = recording.motion_at_steps(begin, factory.options.control_timestep)
        trial = judge(factory, times, fit(poses), upright).with_cause(cause, bag)
        end = begin + round(float(trial.times[-1]) * 1e9)

        since = np.asarray((recording.command_times - begin) * 1e-9, np.float64)
        replayed = replay(factory, trial.poses[0], trial.times, since, recording.commands)
        used, pictures, apart = _pictures(recording, rectify, policy, begin, end)
        width, height = rectify.pinhole.size
        camera = PixelCamera(rectify.pinhole.intrinsics, (width, height))
        views = view(factory, fit(recording.poses_at(used)), pictures, camera, chosen)

        steps = len(trial.times) - 1
        row = Trial(*cell, begin // 10**6, trial.cause, float(trial.progress[-1]), steps, float(views.trust.mean()))
        folder, before = _folder(root, bag, row.seed)
        folder.mkdir(parents=True, exist_ok=True)
        head = {
            "bag": str(bag),
            "started_ms": row.seed,
            "name": row.policy,
            "task": row.task,
            "lighting": lighting,
            "twin_lighting": compared,
            "policy_digest": policy_digest(find_policy(root, policy_name)),
        }
        figures = head | _figures(recording, trial, replayed, fit, views, apart)
        half_width = factory.options.half_width or factory.world.half_width
        limits = factory.segment.start, factory.segment.end
        place = factory.world, half_width, limits, load_ground_and_parts(scene.scene)
        seconds = np.asarray((used - begin) * 1e-9, np.float64)
        title = f"{bag.stem}: {row.policy}, {row.task.replace('_', ' ')}"
        if before and before != row.cell and any(one.key == (*before, row.seed) for one in known):
            was, now = ", ".join(before), ", ".join(row.cell)
            runtime.log_line(f"this trial was counted as {was}; now it is counted as {now}")
        again = row.key, (*(before or row.cell), row.seed)
        write_real_trials([*(one for one in known if one.key not in again), row], table, out, compared)
        # After the table, so that a killed command does not forget the cell from which the trial must be taken.
        write_json(folder / "trial.json", figures)
        write_trial_video(folder / "trial.mp4", trial, replayed, pictures, seconds, views, place, title)
        return row, figures, folder


def _folder(root: Path, bag: Path, started: int) -> tuple[Path, tuple[str, str, str] | None]:
    """Folder for the results of a trial that started at a time [ms], and the cell as which its bag was counted before.

    A bag is known by its name and the trial's start, wherever it lies. The folder's name ends with this time if another
    trial, of a bag of the same name, has the usual one.
    """
    usual = root / "trials" / (bag.name if bag.is_dir() else bag.stem)
    for folder in (usual, usual.with_name(f"{usual.name}_{started}")):
        path = folder / "trial.json"
        if not path.exists():
            return folder, None
        with wrap_read_errors(path, "delete it"):
            old = read_json(path)
            if Path(old["bag"]).name == bag.name and old.get("started_ms", started) == started:
                return folder, (old["name"], old["task"], old["lighting"])
    return folder, None


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
    """Feeds the pictures between start and end to `Pilot`, the code that runs policies on the robot.

    Returns:
        Stamps [ns] (n,) of the pictures that the policy used; these pictures (h, w, 3); and the policy's commands minus
        the recorded ones, v [m/s] and ω [rad/s], shape (m, 2), for the m ≤ n pictures that a recorded command follows
        within `_ANSWER`.
    """
    first = max(0, int(np.searchsorted(recording.shutter, begin, side="right")) - 1)
    which = slice(first, int(np.searchsorted(recording.shutter, end, side="right")))
    arrival = dict(zip(recording.shutter[which].tolist(), recording.arrival[which].tolist(), strict=True))
    now = 0  # [ns] time of the pilot's clocks, at which the present picture was recorded

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
    recording: TrialRecording, trial: JudgedTrial, replayed: Array, fit: FrameFit, views: TrialViews, apart: Array
) -> dict[str, Any]:
    """The contents of `trial.json`, except for its head."""
    off = np.linalg.norm(trial.poses[:, :2] - replayed[:, :2], axis=1)

    def at(seconds: float) -> float | None:
        return float(np.interp(seconds, trial.times, off)) if trial.times[-1] >= seconds else None

    turned = wrap_angle(trial.poses[-1, 2] - replayed[-1, 2])
    same = np.abs(apart).max(1, initial=0.0) < _SAME
    return {
        "cause": trial.cause,
        "success": trial.cause == "goal",
        "progress_m": float(trial.progress[-1]),
        "seconds": float(trial.times[-1]),
        "start": {
            "along_m": float(trial.progress[0]),
            "cross_track_m": float(trial.cross_track[0]),
            "heading_deg": float(np.degrees(trial.start_heading)),
        },
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
    """The printed summary of a trial; `figures` are those of `evaluate_trial`."""
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
    if abs(figures["start"]["along_m"]) > _START_ALONG:
        lines.append(
            f"caution: it started {figures['start']['along_m']:+.1f} m along the task, which trials in the twin drive "
            "from its start"
        )
    if frame["located"]:
        lines.append(
            f"{frame['located']} pictures located; poses fit their positions to {frame['residual_m']:.2f} m rms, "
            f"{(frame['scale'] - 1.0):+.1%} in scale"
        )
    early = "" if replayed["after_2_s_m"] is None else f"{replayed['after_2_s_m']:.2f} m after 2 s, "
    lines.append(
        f"the twin's robot under the same commands: {early}{replayed['end_m']:.2f} m and {replayed['end_deg']:+.0f}° "
        "off at the end"
    )
    lines.append(
        f"PSNR of the pictures against the twin under {seen['lighting']}: {seen['psnr_median']:.1f} dB, "
        f"{seen['psnr_matched_median']:.1f} dB with colors matched, trust {seen['trust_mean']:.2f}"
    )
    if policy["commands"]:
        lines.append(
            f"the policy repeats {policy['same']:.0%} of {policy['commands']} recorded commands; yaw rates differ "
            f"by {policy['yaw_rate_rms']:.3f} rad/s rms"
        )
        if policy["same"] < _OWN:
            lines.append(f"caution: was it {row.policy} that drove? The trial is counted as its own")
    return "\n".join(lines)


def command(options: argparse.Namespace) -> None:
    """Runs `twin trial` with the options parsed by `twin.commands`."""
    names = {"pictures": options.image, "camera": options.camera_info}
    names |= {"poses": options.poses, "commands": options.commands}
    topics = {kind: topic for kind, topic in names.items() if topic}
    if options.lerobot:
        if options.out or options.twin_lighting:
            raise InputError("--out and --twin-lighting are for real.csv, and --lerobot writes none; leave them out")
        drives = write_bag_dataset(
            *(options.scene, options.bag, options.lerobot, options.task, options.policy, options.lighting or ""),
            *(options.cause, options.frame, topics),
        )
        if not options.quiet:
            print(drives_summary(drives, options.lerobot))
        return
    if len(options.bag) > 1:
        raise InputError(f"{len(options.bag)} bags: expected the bag of one trial; for several, use --lerobot DIR")
    for name in ("policy", "lighting"):
        if not getattr(options, name):
            raise InputError(f"a trial needs --{name}; without a policy, --lerobot DIR records drives to learn from")
    row, figures, folder = evaluate_trial(
        *(options.scene, options.bag[0], options.policy, options.task, options.lighting, options.out),
        *(options.twin_lighting, options.cause, options.frame, topics),
    )
    if not options.quiet:
        print(summary(row, figures))
        print(f"counted in {options.out or options.scene / REAL_CSV}")
        print(f"look at {folder / 'trial.mp4'}")


if __name__ == "__main__":
    sys.exit(commands.main("trial"))
