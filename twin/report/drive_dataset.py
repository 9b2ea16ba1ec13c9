"""Writes drives as a LeRobot dataset (version 3.0), for imitation learning and offline reinforcement learning.

Drives are episodes in the twin, or a robot's ROS bags of drives by a policy or by hand.

Each drive has one video and one row in `meta/episodes`; one table contains the frames of all drives. A frame has the
robot's picture, motion and pose; the action that followed; and the reward and outcome of that action. The format is
described at huggingface.co/docs/lerobot under "LeRobotDataset v3.0".

In a bag, a frame has the newest picture, as a policy would see it; speed and yaw rate from the poses before it; and
the mean of the commands until the next frame. Rewards and outcome follow from the poses by the twin's rules.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin import runtime
from twin.assets.ground import Ground
from twin.config import TWIST
from twin.env.env_factory import EnvFactory
from twin.env.episode import Episode
from twin.errors import InputError
from twin.evaluation.trial_judge import judge
from twin.files import new_folder, read_json, require_absent, wrap_read_errors, write_json
from twin.geometry.poses import pose_of
from twin.learn.policy import find_policy, load_policy
from twin.loading import load_scene
from twin.report.video_writer import VideoWriter, read_frames
from twin.scene import require_stage
from twin.types import Array, Image
from twin_policy import Rectifier

if TYPE_CHECKING:
    import pyarrow

    from twin.sysid.trial_recording import TrialRecording

VERSION = "v3.0"
CAMERA = "observation.images.front"
"""Key of the robot's pictures."""

_QUANTILES = {f"q{percent:02d}": percent / 100.0 for percent in (1, 10, 50, 90, 99)}
"""Name in LeRobot's statistics → probability; some of its policies are normalized by them."""
_CRF = 18
_CHUNK = 1000  # videos per folder
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_MOTION = ("linear_velocity", "angular_velocity")
_PLACE = ("x", "y", "yaw", "cross_track", "progress")
_INDICES = ("frame_index", "episode_index", "index", "task_index")


@dataclass
class DriveDataset:
    """Collects drives in a folder; `finish` completes the dataset.

    Raises:
        InputError: The frame rate [1/s] is not a whole number, or the width or height of the pictures is odd (the video
            format needs even ones).
    """

    folder: Path
    size: tuple[int, int]
    """Width, height of the pictures [px]."""
    timestep: float
    """Time between two pictures [s]."""
    actions: Mapping[str, tuple[float, float]]
    """Component of an action → its lowest and highest value in the environment."""
    instruction: str
    """The task in words, for language-conditioned policies."""
    _rows: list[dict[str, NDArray]] = field(default_factory=list)
    _episodes: list[dict[str, Any]] = field(default_factory=list)
    _stats: list[dict[str, dict[str, Array]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.fps = round(1.0 / self.timestep)
        if abs(self.fps * self.timestep - 1.0) > 1e-6:
            raise InputError(
                f"control_timestep = {self.timestep:g} s is {1.0 / self.timestep:g} pictures a second: a LeRobot "
                "dataset needs a whole number; set another control_timestep, for instance 0.1 s"
            )
        if self.size[0] % 2 or self.size[1] % 2:
            raise InputError(
                f"pictures of {self.size[0]}×{self.size[1]} px: a LeRobot dataset needs an even width and height; set "
                "another size, for instance 160×90"
            )

    def add(self, episode: Episode, pictures: Sequence[NDArray[np.uint8]], motion: Array) -> None:
        """Adds a drive that was recorded at k instants.

        Args:
            episode: The drive. Its last instant has no action, so the dataset gets k − 1 frames.
            pictures: The robot's picture at each instant, k arrays of shape (height, width, 3).
            motion: Speed [m/s] and yaw rate [rad/s] at each instant, shape (k, 2).
        """
        number, count = len(self._episodes), len(episode.times) - 1
        start = self._episodes[-1]["dataset_to_index"] if self._episodes else 0
        file = {"chunk_index": number // _CHUNK, "file_index": number % _CHUNK}
        film = self.folder / "videos" / CAMERA / f"{_FILE.format(**file)}.mp4"
        film.parent.mkdir(parents=True, exist_ok=True)
        with VideoWriter(film, self.size, self.fps, _CRF) as writer:
            for picture in pictures[:count]:
                writer.write(picture)
        last = np.arange(count) == count - 1
        poses = episode.base_to_world[:count]
        place = (*poses[:, :2, 3].T, np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
        frames = {
            "observation.state": motion[:count],
            "observation.environment_state": np.stack(
                [*place, episode.cross_track[:count], episode.progress[:count]], -1
            ),
            "action": episode.actions[:count],
            "next.reward": episode.rewards[1:],
            "next.done": last,
            "next.success": last & episode.success,
            "timestamp": np.arange(count) / self.fps,
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": start + np.arange(count),
            "task_index": np.zeros(count, np.int64),
        }
        rows = {name: values.astype(self.features[name]["dtype"]) for name, values in frames.items()}
        self._rows.append(rows)
        self._stats.append(
            {name: _statistics(values) for name, values in rows.items()} | {CAMERA: _colors(pictures[:count])}
        )
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [self.instruction],
                "length": count,
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": start,
                "dataset_to_index": start + count,
                **{f"videos/{CAMERA}/{name}": value for name, value in file.items()},
                f"videos/{CAMERA}/from_timestamp": 0.0,
                f"videos/{CAMERA}/to_timestamp": count / self.fps,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "twin.cause": episode.cause,
                "twin.lighting": episode.lighting,
                "twin.seed": episode.seed,
            }
        )

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """Name of each of the dataset's columns → its type, its shape, and the names of its components."""
        width, height = self.size
        video = {
            "video.height": height,
            "video.width": width,
            "video.channels": 3,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": self.fps,
            "has_audio": False,
        }
        shapes = {
            "observation.state": ("float32", _MOTION),
            "observation.environment_state": ("float32", _PLACE),
            "action": ("float32", tuple(self.actions)),
            **dict.fromkeys(("next.reward", "timestamp"), ("float32", ())),
            **dict.fromkeys(("next.done", "next.success"), ("bool", ())),
            **dict.fromkeys(_INDICES, ("int64", ())),
        }
        columns = {
            name: {"dtype": kind, "shape": [max(1, len(names))], "names": list(names) or None}
            for name, (kind, names) in shapes.items()
        }
        picture = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": video,
        }
        return {CAMERA: picture, **columns}

    def finish(self) -> None:
        """Writes the tables; `add` must have been called at least once."""
        import pyarrow as pa
        from pyarrow import parquet

        def write(name: str, table: "pyarrow.Table") -> None:
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            parquet.write_table(table, self.folder / name)

        first = _FILE.format(chunk_index=0, file_index=0)
        columns = {}
        for name in self._rows[0]:
            values = np.concatenate([rows[name] for rows in self._rows])
            flat = pa.array(values.ravel())
            columns[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.ndim == 2 else flat
        write(f"data/{first}.parquet", pa.table(columns))
        stats = [
            {f"stats/{name}/{kind}": value.tolist() for name, one in stats.items() for kind, value in one.items()}
            for stats in self._stats
        ]
        rows = [episode | numbers for episode, numbers in zip(self._episodes, stats, strict=True)]
        write(f"meta/episodes/{first}.parquet", pa.Table.from_pylist(rows))
        write("meta/tasks.parquet", _task_table([self.instruction]))
        merged = {name: _merged([one[name] for one in self._stats]) for name in self._stats[0]}
        write_json(
            self.folder / "meta" / "stats.json",
            {name: {kind: value.tolist() for kind, value in one.items()} for name, one in merged.items()},
        )
        frames = self._episodes[-1]["dataset_to_index"]
        write_json(
            self.folder / "meta" / "info.json",
            {
                "codebase_version": VERSION,
                "robot_type": "husky",
                "total_episodes": len(self._episodes),
                "total_frames": frames,
                "total_tasks": 1,
                "chunks_size": _CHUNK,
                "data_files_size_in_mb": 100,
                "video_files_size_in_mb": 200,
                "fps": self.fps,
                "splits": {"train": f"0:{len(self._episodes)}"},
                "data_path": f"data/{_FILE}.parquet",
                "video_path": f"videos/{{video_key}}/{_FILE}.mp4",
                "features": self.features,
                "twin": {"action_range": {name: list(ends) for name, ends in self.actions.items()}},
            },
        )


def read_drives(folder: Path) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]:
    """Reads the n frames of a dataset that `DriveDataset` wrote, with speed and yaw rate as actions.

    Returns:
        Pictures (n, h, w, 3).
        The actions that followed, (n, 2), scaled to [-1, 1], as an environment takes them.
        Index of each frame within its drive, (n,).

    Raises:
        InputError: the folder is not such a dataset, is incomplete, or has other actions.
    """
    require_pyarrow()
    from pyarrow import parquet

    cure = "expected a dataset of twin film --lerobot or twin trial --lerobot with speed and yaw rate as actions"
    info = read_json(folder / "meta" / "info.json")
    with wrap_read_errors(folder, cure):
        ranges = np.array(list(info["twin"]["action_range"].values()), np.float32)
        frames = int(info["total_frames"])
    if ranges.shape != (2, 2) or not (ranges[:, 0] < ranges[:, 1]).all():
        raise InputError(f"{folder}: {len(ranges)} actions with ranges {ranges.tolist()}; {cure}")
    with wrap_read_errors(folder, "record the drives again"):
        tables = [parquet.read_table(path) for path in sorted(folder.glob("data/*/*.parquet"))]
        films = sorted(folder.glob(f"videos/{CAMERA}/*/*.mp4"))
        pictures = np.concatenate([list(read_frames(film)) for film in films])
        action = np.concatenate([np.array(table["action"].to_pylist(), np.float32) for table in tables])
        frame = np.concatenate([table["frame_index"].to_numpy() for table in tables])
    if not len(pictures) == len(action) == len(frame) == frames:
        counts = f"{len(pictures)} pictures and {len(action)} actions; expected {frames} of each"
        raise InputError(f"{folder}: {counts}; copy the dataset again")
    low, high = ranges.T
    return pictures, 2.0 * (action - low) / (high - low) - 1.0, frame


def drive_instruction(scene: Path, task: str) -> str:
    """Instruction in words for a task in a scene; `scene` is the scene's folder."""
    return f"Drive along the road of {scene.resolve().name}: {task.replace('_', ' ')}."


def drives_summary(drives: Sequence[Episode], folder: Path) -> str:
    """Summary of a dataset's drives in one line."""
    frames, goals = sum(len(one.times) - 1 for one in drives), sum(one.success for one in drives)
    return f"{len(drives)} drives, {goals} to the goal, {frames} frames: {folder}"


def require_pyarrow() -> None:
    """Raises InputError if pyarrow, which writes the tables, is not installed."""
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError:
        raise InputError("a LeRobot dataset needs the missing package pyarrow: pip install 'twin[lerobot]'") from None


def _statistics(values: NDArray) -> dict[str, Array]:
    """LeRobot's statistics of a column (k, n) or (k,). All but `count` have shape (n,), or (1,) for a column (k,)."""
    table = values.reshape(len(values), -1).astype(np.float64)
    quantiles = {name: np.quantile(table, share, 0) for name, share in _QUANTILES.items()}
    return _summary(table.min(0), table.max(0), table.mean(0), table.std(0), len(table)) | quantiles


def _colors(pictures: Sequence[NDArray[np.uint8]]) -> dict[str, Array]:
    """LeRobot's statistics of the pictures' colors, scaled to [0, 1]; all but `count` have shape (3, 1, 1)."""
    counts = np.array([[np.bincount(one[..., c].ravel(), minlength=256) for c in range(3)] for one in pictures]).sum(0)
    levels, share = np.arange(256) / 255.0, counts / counts.sum(1, keepdims=True)
    mean = share @ levels
    deviation = np.sqrt(share @ levels**2 - mean**2)
    low, high = (levels[[np.flatnonzero(one)[end] for one in counts]] for end in (0, -1))
    below = share.cumsum(1)
    values = {"min": low, "max": high, "mean": mean, "std": deviation}
    values |= {name: levels[(below < part - 1e-9).sum(1)] for name, part in _QUANTILES.items()}
    return {name: one[:, None, None] for name, one in values.items()} | {"count": np.array([len(pictures)])}


def _summary(low: Array, high: Array, mean: Array, deviation: Array, count: int) -> dict[str, Array]:
    return {"min": low, "max": high, "mean": mean, "std": deviation, "count": np.array([count])}


def _merged(stats: list[dict[str, Array]]) -> dict[str, Array]:
    """Combines the statistics of several drives; quantiles are averaged, as LeRobot does."""
    counts = np.array([one["count"][0] for one in stats], float)
    means, deviations = (np.stack([one[kind] for one in stats]) for kind in ("mean", "std"))
    weights = (counts / counts.sum()).reshape(-1, *[1] * (means.ndim - 1))
    mean = (weights * means).sum(0)
    variance = (weights * (deviations**2 + (means - mean) ** 2)).sum(0)
    low, high = np.min([one["min"] for one in stats], 0), np.max([one["max"] for one in stats], 0)
    quantiles = {name: (weights * np.stack([one[name] for one in stats])).sum(0) for name in _QUANTILES}
    return _summary(low, high, mean, np.sqrt(variance), int(counts.sum())) | quantiles


def _task_table(tasks: list[str]) -> "pyarrow.Table":
    """Table of tasks. LeRobot reads it with pandas; the metadata make the text of the task the index."""
    import pyarrow as pa

    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    column = {"field_name": "task_index", "name": "task_index", "pandas_type": "int64", "numpy_type": "int64"}
    index = {"field_name": "task", "name": "task", "pandas_type": "unicode", "numpy_type": "object"}
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [one | {"metadata": None} for one in (column, index)],
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


# ---- bags

_SPEED_SPAN = 0.2  # [s] time before an instant over which speed is measured; poses after it show later commands
_MAX_GAP = 0.5  # [s] longest time without a picture; also the time after which the robot stops without a command


def write_bag_dataset(
    root: Path,
    bags: Sequence[Path],
    out: Path,
    task: str,
    policy_name: str | None = None,
    lighting: str = "",
    cause: str | None = None,
    frame: Literal["scene", "pictures"] = "pictures",
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
        frame: See `twin.sysid.trial_recording.PosesFrame`.
        topics: Topics of the bags; see `read_trial`.

    Raises:
        InputError: scene, policy or a bag is unusable, `out` exists, or pyarrow is not installed.
    """
    if cause and len(bags) > 1:
        raise InputError(f"--cause {cause} applies to one bag; there are {len(bags)}")
    from twin.sysid.trial_recording import read_trial, scene_frame  # loads pycolmap

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
            xy = trial.poses[:, :2]
            rotations = Rotation.from_euler("z", trial.poses[:, 2:]).as_matrix()
            base_to_world = pose_of(rotations, np.column_stack([xy, ground.at(xy)]))
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


def _motion(recording: "TrialRecording", stamps: NDArray[np.int64]) -> Array:
    """Speed along the heading [m/s] and yaw rate [rad/s] over the last `_SPEED_SPAN`, shape (k, 2)."""
    now, before = (recording.poses_at(one) for one in (stamps, stamps - round(_SPEED_SPAN * 1e9)))
    (x, y, turn), yaw = ((now - before) / _SPEED_SPAN).T, (now[:, 2] + before[:, 2]) / 2.0
    return np.column_stack([x * np.cos(yaw) + y * np.sin(yaw), turn])


def _actions(recording: "TrialRecording", stamps: NDArray[np.int64], period: float) -> Array:
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


def _pictures_at(recording: "TrialRecording", rectify: Rectifier, stamps: NDArray[np.int64]) -> list[Image]:
    """The newest picture (h, w, 3) that had arrived at each instant; the first one before any had.

    Raises InputError: at an instant there is no recent picture.
    """
    arrived = np.maximum.accumulate(recording.arrival)
    newest = np.maximum(0, np.searchsorted(arrived, stamps, side="right") - 1)
    ages = np.abs(stamps - recording.shutter[newest]) * 1e-9
    if ages.max() > _MAX_GAP:
        at = float((stamps[ages.argmax()] - stamps[0]) * 1e-9)
        raise InputError(
            f"{recording.path}: {at:.1f} s after the first command, the nearest picture on "
            f"{recording.topics['pictures']} is {ages.max():.1f} s away; expected at most {_MAX_GAP:g} s"
        )
    pictures: dict[int, Image] = {}
    with runtime.bar("pictures", len(np.unique(newest)), "picture") as progress:
        for stamp, picture in recording.rectified(recording.shutter[np.unique(newest)], rectify):
            pictures[stamp] = picture
            progress.update()
    return [pictures[int(stamp)] for stamp in recording.shutter[newest]]
