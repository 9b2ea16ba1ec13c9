"""The real test: a policy file drives the hidden robot on the true road, in weather that was never filmed.

A policy receives images only, and its file is the only input from the training side. The robot model, its controller,
the camera effects and the termination rules are those of the twin. Two constants of the twin were measured on images of
this world (`twin.env.domain_randomization.KNOWN_WEATHER_FRACTION`, `twin.env.irradiance.GROUND_ALBEDO`).

The k-th trial in a weather has the same seed for every policy, hence the same start and camera vibration, so that
policies can be compared in pairs.
"""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from twin.config import HELD_OUT, Condition
from twin.env.options import STEERING, parse_options
from twin.env.task import CAMERA, control
from twin.errors import InputError
from twin.evaluation.trials import Trial, read_trials, write_real_trials
from twin.files import digest_file, read_json, wrap_read_errors, write_json
from twin.learn.policy import JSON, Policy, load_policy
from twin.reality import true_world
from twin.reality.filming import FilmingPlan, write_video
from twin.reality.lighting import WEATHER
from twin.reality.rasterizer import Rasterizer
from twin.reality.real_robot import RealCamera, TrueRoad, hidden_robot, place_on_test_day, shadow_range
from twin.runtime import bar, exclusive_lock
from twin.types import Image

TASKS = ("straight", "right_turn")

_FIRST_SEED = 7_000_000  # of the first trial
_SEEDS_PER_LIGHTING = 10_000  # upper bound of trials per policy and lighting
_FILM_SCALE = 4  # enlargement of images in a film


def load_policy_file(path: Path) -> Policy:
    """Loads a policy folder or `.onnx` file.

    Raises:
        InputError: no such file, or a policy that could run code here, such as a Python callable.
    """
    if not path.exists():
        raise InputError(f"{path}: no such policy file; the real test accepts only a policy folder or an .onnx file")
    return load_policy(path)


@cache
def _rasterizer(lighting: str, intrinsics: tuple[float, ...], size: tuple[int, int], number: int) -> Rasterizer:
    place = place_on_test_day(number)
    model = true_world.world_spec(WEATHER[lighting], place).compile()
    return Rasterizer(model, np.array(intrinsics), size, shadow_range(place))


class RealTest:
    """One policy on one task of the real test."""

    __test__ = False  # not a pytest class

    def __init__(self, policy: Policy, task: str, number: int = 0) -> None:
        """Raises InputError for an unknown task or a policy with options that the robot does not support."""
        self.policy, self._robot = policy, hidden_robot()
        options = {key: value for key, value in policy.options().items() if key not in ("size", "stack")}
        self.road = TrueRoad(task, self._robot, parse_options({**options, "pixels": False}), number)
        self._environment = control.Environment(
            self.road.physics, self.road.drive, control_timestep=policy.control.control_timestep
        )

    def reset(self, lighting: str, seed: int) -> RealCamera:
        """Starts a trial and returns its camera; arguments as in `run_trial`."""
        self.road.drive.seed(seed)
        self._environment.reset()
        size = self.policy.size
        intrinsics = self.road.intrinsics(size)
        raster = _rasterizer(lighting, tuple(intrinsics.tolist()), size, self.road.place.number)
        return RealCamera(raster, WEATHER[lighting], self._robot, intrinsics, size, self.road.drive.rng(CAMERA))

    def run_trial(self, lighting: str, seed: int, on_image: Callable[[Image], None] | None = None) -> Trial:
        """Drives one trial.

        Args:
            lighting: One of `WEATHER`.
            seed: Seed of all randomness in the trial.
            on_image: Called with every image (h, w, 3).
        """
        policy, drive, physics = self.policy, self.road.drive, self.road.physics
        camera = self.reset(lighting, seed)
        width, height = policy.size
        stack, steps, ended = np.zeros((policy.stack, 3, height, width), np.uint8), 0, False
        while not ended:
            image = camera.capture(physics.camera_to_world, physics.time())
            if on_image:
                on_image(image)
            newest = image.transpose(2, 0, 1)
            stack = np.concatenate([stack[1:], newest[None]]) if steps else np.repeat(newest[None], policy.stack, 0)
            v, yaw_rate = policy.command(policy(stack.reshape(3 * policy.stack, height, width)))
            action = [yaw_rate] if policy.control.action == STEERING else [v, yaw_rate]
            ended, steps = self._environment.step(np.array(action)).last(), steps + 1
        return Trial(policy.name, drive.segment.name, lighting, seed, drive.cause, drive.progress, steps)


def run(
    policies: Sequence[Path],
    task: str,
    lightings: Sequence[str],
    trials: int,
    out: Path,
    twin_lighting: str = str(Condition(HELD_OUT, True)),
    films: Path | None = None,
    number: int = 0,
) -> list[Trial]:
    """Drives the trials that are not in the table yet, and writes the table and its summary.

    Args:
        policies: Policy files.
        task: One of `TASKS`, on a drawn place one of `place_spec.tasks`.
        lightings: Names from `WEATHER`.
        trials: Trials per policy and lighting.
        out: Results file as read by `twin.forecast`. `<name>_trials.csv` beside it has a row per trial,
            `<name>_policies.json` the digests of the policy files.
        twin_lighting: Value of the column of this name in new rows.
        films: Folder for a film of every trial, by the robot's camera.
        number: Number of the place; a table is of one place.

    Returns:
        All trials of the table, including those of earlier calls.

    Raises:
        InputError: unknown names, unusable policy files, a different file under a known policy name, or another process
            that writes the same table.
    """
    for name in lightings:
        if name not in WEATHER:
            raise InputError(f"unknown lighting {name!r}; the real test offers {', '.join(WEATHER)}")
    if not 1 <= trials <= _SEEDS_PER_LIGHTING:
        raise InputError(f"trials = {trials}; expected 1 to {_SEEDS_PER_LIGHTING}")
    table = out.with_name(f"{out.stem}_trials.csv")
    loaded = [load_policy_file(path) for path in policies]
    with exclusive_lock(out.with_name(f".{out.stem}.lock"), f"{out} is being written"):
        _check_policy_digests(loaded, policies, out.with_name(f"{out.stem}_policies.json"))
        done = read_trials(table) if table.exists() else []
        known = {(*_key(one), one.seed) for one in done}
        for policy in {one.name: one for one in loaded}.values():
            test = RealTest(policy, task, number)
            for lighting in dict.fromkeys(lightings):
                # Each weather has its own seeds; shared ones would repeat the same ten starts in every weather.
                first = _FIRST_SEED + _SEEDS_PER_LIGHTING * list(WEATHER).index(lighting)
                seeds = [first + k for k in range(trials)]
                missing = [seed for seed in seeds if (policy.name, task, lighting, seed) not in known]
                with bar(f"{policy.name}, {task}, {lighting}", len(missing), "trial") as progress:
                    for seed in missing:
                        done.append(_run_trial(test, lighting, seed, films))
                        write_real_trials(done, table, out, twin_lighting)
                        progress.set_postfix_str(f"{done[-1].cause} at {done[-1].progress:.1f} m")
                        progress.update()
        write_real_trials(done, table, out, twin_lighting)
    return done


def _run_trial(test: RealTest, lighting: str, seed: int, films: Path | None) -> Trial:
    """Drives one trial and films it if `films` is given."""
    frames: list[Image] = []
    trial = test.run_trial(lighting, seed, frames.append if films else None)
    if films:
        _write_film(frames, films / f"{trial.policy.replace('/', '_')}_{trial.task}_{lighting}_{seed}.mp4")
    return trial


def _write_film(frames: Sequence[Image], path: Path) -> None:
    """Writes a film of the enlarged images at 10 Hz."""
    height, width = (_FILM_SCALE * side for side in frames[0].shape[:2])
    plan = FilmingPlan(width=width, height=height, fps=10, crf=23)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_video((one.repeat(_FILM_SCALE, 0).repeat(_FILM_SCALE, 1) for one in frames), plan, path)


def _key(trial: Trial) -> tuple[str, str, str]:
    return trial.policy, trial.task, trial.lighting


def _check_policy_digests(policies: Sequence[Policy], paths: Sequence[Path], record: Path) -> None:
    """Records the digest of each policy's file. Raises InputError if a recorded name has another digest."""
    sums: dict[str, str] = {}
    if record.exists():
        with wrap_read_errors(record, "give another --out"):
            sums = dict(read_json(record))
    for policy, path in zip(policies, paths, strict=True):
        folder = path.parent if path.name == JSON else path
        digest = digest_file(folder / JSON if folder.is_dir() else folder)  # it contains the digest of the weights
        if sums.setdefault(policy.name, digest) != digest:
            raise InputError(
                f"{path}: {record} has another file under the name {policy.name!r}; give another --out, or rename "
                "the policy"
            )
    record.parent.mkdir(parents=True, exist_ok=True)
    write_json(record, sums)
