"""The real test: a policy file drives a robot on the true road, in weather that was never filmed.

A policy receives images only. The training side supplies only the policy's file and, optionally, a task as JSON. Robot,
camera, haze and judge are implemented independently of the twin (`real_robot.py`, `real_camera.py`, `sky.py`,
`road_task.py`); the renderer is `rasterizer.py`. The code of the twin loads policy files and defines the format of
tables. Places, days, robots and cameras have numbers. The results list the values of the robot and the camera that lie
outside the ranges of training (`outside_training`).

The k-th trial in a weather has the same seed for every policy, hence the same start, shake and noise, so that policies
can be compared in pairs.

Tables of earlier versions can be read and reported on, but not continued (`REALITY_VERSION`). Two constants of the
twin were measured on images of this world (`twin.env.domain_randomization.KNOWN_WEATHER_FRACTION`,
`twin.env.irradiance.GROUND_ALBEDO`).
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from twin.config import HELD_OUT, Condition
from twin.errors import InputError, name_hint
from twin.evaluation.trials import Trial, check_twin_lighting, read_real_trials, write_real_trials
from twin.files import digest_file, read_json, wrap_read_errors, write_json
from twin.learn.policy import JSON, Policy, load_policy
from twin.reality import REALITY_VERSION
from twin.reality.filming import FilmingPlan, write_video
from twin.reality.lighting import day_number, weather, weather_index
from twin.reality.place_sampling import check_length, sample_place
from twin.reality.rasterizer import PlaceRenderer
from twin.reality.real_camera import TRAINED as camera_ranges
from twin.reality.real_camera import RealCamera, draw_camera, intrinsics_of
from twin.reality.real_robot import TRAINED as robot_ranges
from twin.reality.real_robot import RealRobot, draw_robot
from twin.reality.road_task import RealJudge, RoadTask, place_on_test_day, task_of_place
from twin.reality.true_world import rasterizer_of
from twin.runtime import bar, exclusive_lock
from twin.types import Image

_FIRST_SEED = 7_000_000  # seed of the first trial
_SEEDS_PER_LIGHTING = 10_000  # upper bound of trials per policy and lighting
_FILM_SCALE = 4  # enlargement of images in a film
_START, _ROBOT, _CAMERA = range(3)  # random streams of a trial


@dataclass(frozen=True)
class Setup:
    """Numbers of the place, the robot and the camera of trials."""

    place: int = 0
    robot: int = 0
    camera: int = 0
    length: float = 0.0
    """Length to which the place's road is lengthened [m], see `place_sampling.sample_place`."""

    def __post_init__(self) -> None:
        """Raises InputError: no such place, robot or camera, or a length below that of the place's road."""
        draw_robot(self.robot), draw_camera(self.camera)
        if self.place:
            sample_place(self.place)
        if self.length and self.place:
            check_length(self.place, self.length)

    @property
    def outside(self) -> list[str]:
        """Values of robot and camera outside the ranges of training, each as a text: name, value and range."""
        drawn = ((draw_robot(self.robot), robot_ranges), (draw_camera(self.camera), camera_ranges))
        return [
            f"{name} {getattr(one, name):.4g} ({low:.4g} to {high:.4g})"
            for one, ranges in drawn
            for name, (low, high) in ranges.items()
            if not low <= getattr(one, name) <= high
        ]

    def columns(self, lighting: str) -> tuple[str, ...]:
        """Values of `twin.evaluation.trials.SETUP_COLUMNS` in a weather."""
        outside = " ".join(text.split()[0] for text in self.outside)
        return str(self.place), day_number(lighting), str(self.robot), str(self.camera), outside

    def __str__(self) -> str:
        said = f"outside training's ranges: {', '.join(self.outside)}" if self.outside else "inside training's ranges"
        place = f"place {self.place}" + (f" of {self.length:g} m" if self.length else "")
        return f"{place}, robot {self.robot}, camera {self.camera}; {said}"


def load_policy_file(path: Path) -> Policy:
    """Loads a policy folder or `.onnx` file.

    Raises:
        InputError: no such file, or a policy that could run code here, such as a Python callable.
    """
    if not path.exists():
        beside = [one.name for one in path.parent.iterdir()] if path.parent.is_dir() else []
        hint = name_hint(path.name, beside, "the real test accepts only a policy folder or an .onnx file")
        raise InputError(f"{path}: no such policy file; {hint}")
    return load_policy(path)


@lru_cache(maxsize=1)  # all policies drive in one weather before the next
def rasterizer(
    lighting: str, intrinsics: tuple[float, ...], size: tuple[int, int], number: int, length: float = 0.0
) -> PlaceRenderer:
    """The rasterizer of a place in a weather of the real test."""
    return rasterizer_of(place_on_test_day(number, length), weather(lighting), np.array(intrinsics), size)


class RealTest:
    """A robot with its camera and judge on one task."""

    __test__ = False  # not a pytest class

    def __init__(
        self,
        task: RoadTask,
        setup: Setup | None = None,
        size: tuple[int, int] = (160, 90),
        renderer_of: Callable[[str, tuple[float, ...], tuple[int, int], int], PlaceRenderer] | None = None,
    ) -> None:
        """
        Args:
            task: The task.
            setup: Place, robot and camera.
            size: Width, height of pictures [px].
            renderer_of: Returns the renderer for a weather, intrinsics fx, fy, cx, cy [px], a size (width, height) [px]
                and a place's number.

        Raises:
            InputError: no such place, robot or camera.
        """
        self.task, self.setup, self.size = task, setup or Setup(), size
        self._renderer_of = renderer_of or (lambda *given: rasterizer(*given, self.setup.length))
        place = place_on_test_day(self.setup.place, self.setup.length)
        self.robot = RealRobot(draw_robot(self.setup.robot), place)
        self.camera = draw_camera(self.setup.camera)
        self.judge = RealJudge(task)

    def reset(self, lighting: str, seed: int) -> RealCamera:
        """Puts the robot at the start of a trial and returns its camera; arguments as in `run_trial`."""
        start = self.task.sample_start(np.random.default_rng([seed, _START]))
        self.robot.set_pose(*start, np.random.default_rng([seed, _ROBOT]))
        self.judge.begin(*start[:2])
        intrinsics = tuple(intrinsics_of(self.camera, self.size).tolist())
        renderer = self._renderer_of(lighting, intrinsics, self.size, self.setup.place)
        return RealCamera(renderer, weather(lighting), self.camera, self.size, np.random.default_rng([seed, _CAMERA]))

    def step(self, v: float, yaw_rate: float) -> None:
        """Drives one control step under a command [m/s], [rad/s], clipped to the task's limits, and asks the judge."""
        robot, task = self.robot, self.task
        robot.command(min(max(v, 0.0), task.speed), min(max(yaw_rate, -task.yaw_rate), task.yaw_rate))
        robot.step(task.control_timestep)
        self.judge.see(robot.pose[0], robot.pose[1], robot.tilt, robot.touched, robot.time)

    def run_trial(
        self, policy: Policy, lighting: str, seed: int, on_image: Callable[[Image], None] | None = None
    ) -> Trial:
        """Drives one trial.

        Args:
            policy: Takes pictures of this test's size.
            lighting: See `twin.reality.lighting.weather`.
            seed: Seed of all randomness in the trial.
            on_image: Called with every image (h, w, 3).
        """
        camera, judge = self.reset(lighting, seed), self.judge
        width, height = self.size
        stack, steps = np.zeros((policy.stack, 3, height, width), np.uint8), 0
        while not judge.cause:
            image = camera.capture(self.robot)
            if on_image:
                on_image(image)
            newest = image.transpose(2, 0, 1)
            stack = np.concatenate([stack[1:], newest[None]]) if steps else np.repeat(newest[None], policy.stack, 0)
            self.step(*policy.command(policy(stack.reshape(3 * policy.stack, height, width))))
            steps += 1
        return Trial(policy.name, self.task.name, lighting, seed, judge.cause, judge.progress, steps)


def task_for(policy: Policy, task: str | RoadTask, place: int, length: float = 0.0) -> RoadTask:
    """The given task, or the place's task of that name, for a policy's speed limits and control step.

    Raises:
        InputError: no such task, or one whose control step is not that of the policy.
    """
    c = policy.control
    if isinstance(task, str):
        return task_of_place(place, task, c.speed, c.yaw_rate, c.control_timestep, length)
    if task.control_timestep != c.control_timestep:
        raise InputError(
            f"task {task.name!r} has a control step of {task.control_timestep:g} s, policy {policy.name} one of "
            f"{c.control_timestep:g} s; change the task's control_timestep, or give another policy"
        )
    return task


def run(
    policies: Sequence[Path],
    task: str | RoadTask,
    lightings: Sequence[str],
    trials: int,
    out: Path,
    twin_lighting: str | None = None,
    films: Path | None = None,
    setup: Setup | None = None,
) -> list[Trial]:
    """Drives the trials that are not in the table yet, and writes the table and its summary.

    Args:
        policies: Policy files.
        task: A task, or the name of one of the place's tasks.
        lightings: See `twin.reality.lighting.weather`.
        trials: Trials per policy and lighting.
        out: Results file as read by `twin.forecast`. `<name>_trials.csv` beside it has a row per trial,
            `<name>_policies.json` the digests of the policy files, `<name>_setup.json` place, robot and camera,
            `<name>_tasks.json` the numbers of the tasks.
        twin_lighting: Value of the column of this name in new rows; None: `held-out+randomised`. Other rows keep
            theirs.
        films: Folder for a film of every trial that is driven now, from the robot's camera.
        setup: Place, robot and camera, the same in all rows of a table.

    Returns:
        All trials of the table, including those of earlier calls.

    Raises:
        InputError: unknown names, `out` is a folder, unusable policy files, a different file under a known policy name,
            a table of another setup, of another task of this name or compared with another lighting, results of trials
            that the table lacks, or another process that writes the same table.
    """
    setup = setup or Setup()
    for name in lightings:
        weather(name)
    if not 1 <= trials <= _SEEDS_PER_LIGHTING:
        raise InputError(f"trials = {trials}; expected 1 to {_SEEDS_PER_LIGHTING}")
    if out.is_dir():
        raise InputError(f"{out} is a folder; give a file to write, such as {out / 'results.csv'}")
    table = out.with_name(f"{out.stem}_trials.csv")
    loaded = [load_policy_file(path) for path in policies]
    with exclusive_lock(out.with_name(f".{out.stem}.lock"), f"{out} is being written"):
        _check_setup(setup, table, out.with_name(f"{out.stem}_setup.json"))
        done = read_real_trials(table, out)
        driven = {one.policy for one in done}
        _check_policy_digests(loaded, policies, driven, out.with_name(f"{out.stem}_policies.json"))
        known = {(one.policy, one.task, one.lighting, one.seed) for one in done}
        by_name = {one.name: one for one in loaded}.values()
        tests = [RealTest(task_for(one, task, setup.place, setup.length), setup, one.size) for one in by_name]
        _check_task(task, done, table, out.with_name(f"{out.stem}_tasks.json"))
        name = task if isinstance(task, str) else task.name
        for cell in ((one.name, name, lighting) for one in by_name for lighting in lightings if twin_lighting):
            check_twin_lighting(out, cell, twin_lighting)
        compared = twin_lighting or str(Condition(HELD_OUT, True))
        if films:
            films.mkdir(parents=True, exist_ok=True)
        for lighting in dict.fromkeys(lightings):
            # Each weather has its own seeds: with shared ones, the starts in all weathers would be the same.
            first = _FIRST_SEED + _SEEDS_PER_LIGHTING * weather_index(lighting)
            seeds = [first + k for k in range(trials)]
            for policy, test in zip(by_name, tests, strict=True):
                missing = [seed for seed in seeds if (policy.name, test.task.name, lighting, seed) not in known]
                with bar(f"{policy.name}, {test.task.name}, {lighting}", len(missing), "trial") as progress:
                    for seed in missing:
                        done.append(_run_trial(test, policy, lighting, seed, films))
                        write_real_trials(done, table, out, compared, setup.columns)
                        progress.set_postfix_str(f"{done[-1].cause} at {done[-1].progress:.1f} m")
                        progress.update()
        write_real_trials(done, table, out, compared, setup.columns)
    return done


def _check_setup(setup: Setup, table: Path, record: Path) -> None:
    """Records the setup of a table. Raises InputError if the table has another setup or version of this world.

    A record without a table is that of a run which was stopped before its first trial.
    """
    given = {**asdict(setup), "version": REALITY_VERSION}
    if record.exists() and table.exists():
        with wrap_read_errors(record, "give another --out"):
            found = {"length": 0.0, **read_json(record)}  # earlier records have no length
            known = {name: found[name] for name in given}
        if known != given:
            raise InputError(f"{table} has trials of {known}; this call has {given}; give another --out")
    elif table.exists():
        raise InputError(
            f"{table} has trials of version 1 of the real test; this is version {REALITY_VERSION}; give another --out"
        )
    record.parent.mkdir(parents=True, exist_ok=True)
    robot, camera = asdict(draw_robot(setup.robot)), asdict(draw_camera(setup.camera))
    write_json(record, {**given, "outside_training": setup.outside, "robot_values": robot, "camera_values": camera})


def _check_task(task: str | RoadTask, done: list[Trial], table: Path, record: Path) -> None:
    """Records a task's numbers; none for a task of the place. Raises InputError: trials of this name had others."""
    name, numbers = (task, []) if isinstance(task, str) else (task.name, task.numbers)
    with wrap_read_errors(record, "give another --out"):
        tasks = dict(read_json(record)) if record.exists() else {}
        if name not in {one.task for one in done}:  # a run was stopped before its first trial
            tasks.pop(name, None)
        known = tasks.setdefault(name, numbers)
        if len(known) != len(numbers) or not np.allclose(known, numbers, atol=1e-6):
            raise InputError(f"{table} has trials of another task {name!r}; give another --out, or rename the task")
    write_json(record, tasks)


def _run_trial(test: RealTest, policy: Policy, lighting: str, seed: int, films: Path | None) -> Trial:
    """Drives one trial and writes a film of its enlarged pictures, at 10 Hz, if the folder `films` is given."""
    frames: list[Image] = []
    trial = test.run_trial(policy, lighting, seed, frames.append if films else None)
    if films:
        path = films / f"{trial.policy.replace('/', '_')}_{trial.task}_{lighting}_{seed}.mp4"
        width, height = (_FILM_SCALE * side for side in test.size)
        plan = FilmingPlan(width=width, height=height, fps=10, crf=23)
        write_video((one.repeat(_FILM_SCALE, 0).repeat(_FILM_SCALE, 1) for one in frames), plan, path)
    return trial


def _check_policy_digests(policies: Sequence[Policy], paths: Sequence[Path], driven: set[str], record: Path) -> None:
    """Records the digest of each policy's file. Raises InputError if a name in `driven` has another digest."""
    sums: dict[str, str] = {}
    if record.exists():
        with wrap_read_errors(record, "give another --out"):
            sums = {name: digest for name, digest in read_json(record).items() if name in driven}
    for policy, path in zip(policies, paths, strict=True):
        folder = path.parent if path.name == JSON else path
        # policy.json contains the digest of the weights.
        digest = digest_file(folder / JSON if folder.is_dir() else folder)
        if sums.setdefault(policy.name, digest) != digest:
            raise InputError(
                f"{path}: {record} has another file under the name {policy.name!r}; give another --out, or rename "
                "the policy"
            )
    record.parent.mkdir(parents=True, exist_ok=True)
    write_json(record, sums)
