"""The real test: a policy file drives reality's Husky on reality's road, in weather that nobody filmed.

A policy gets nothing but pictures; its file is all that a test takes from the training side. A test returns rows of
trials, and films of them where asked. The model of the robot, its controller, the effects of the camera and the judge
are those of the twin. Two of the twin's constants were set with this world's pictures in view
(`twin.env.domain_randomization.UNTOLD`, `twin.env.irradiance.GROUND_ALBEDO`).

Trials have seeds: the k-th trial in a weather starts from the same place with the same shaking camera for every policy,
so that policies can be compared pair by pair.
"""

import csv
import io
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from twin.config import HELD_OUT, RANDOMISED
from twin.env.options import STEERING, control, parse_options
from twin.env.task import CAMERA
from twin.errors import InputError
from twin.evaluation.trials import (
    EPISODE_COLUMNS,
    OPTIONAL_RESULT_COLUMNS,
    RESULT_COLUMNS,
    Trial,
    csv_text,
    read_trials,
    tally,
)
from twin.files import damaged, digest_file, read_json, read_text, write_json, write_text
from twin.learn.policy import JSON, Policy, load_policy
from twin.reality import true_world as worlds
from twin.reality.filming import FilmingPlan, encode
from twin.reality.lighting import WEATHER
from twin.reality.rasterizer import Raster
from twin.reality.real_robot import RealCamera, TrueRoad, place_robot, robot
from twin.runtime import alone, bar
from twin.types import Image

TASKS = ("straight", "right_turn")

_FIRST_SEED = 7_000_000  # of the first trial
_PER_WEATHER = 10_000  # seeds, and most trials of a policy
_ENLARGED = 4  # times, in a film
_COLUMNS = (*RESULT_COLUMNS, *OPTIONAL_RESULT_COLUMNS)


def policy_file(path: Path) -> Policy:
    """The policy in a file.

    Raises:
        InputError: none there, or something that could run code here, such as a Python callable.
    """
    if not path.exists():
        raise InputError(f"{path}: no such policy file; reality is driven by a policy folder or an .onnx file only")
    return load_policy(path)


@cache
def _raster(lighting: str, intrinsics: tuple[float, ...], size: tuple[int, int]) -> Raster:
    return Raster(worlds.spec(WEATHER[lighting], place_robot()).compile(), np.array(intrinsics), size)


class RealTest:
    """One policy on one task."""

    __test__ = False  # none of pytest's

    def __init__(self, policy: Policy, task: str) -> None:
        """Raises InputError: no such task, or a policy that asks for what the robot cannot do."""
        self.policy, self._robot = policy, robot()
        options = {key: value for key, value in policy.options().items() if key not in ("size", "stack")}
        self.road = TrueRoad(task, self._robot, parse_options({**options, "pixels": False}))
        self._environment = control.Environment(
            self.road.physics, self.road.drive, control_timestep=policy.control.control_timestep
        )

    def begin(self, lighting: str, seed: int) -> RealCamera:
        """Puts the robot to the start; returns its camera. Arguments: see `trial`."""
        self.road.drive.seed(seed)
        self._environment.reset()
        size = self.policy.size
        intrinsics = self.road.intrinsics(size)
        raster = _raster(lighting, tuple(intrinsics.tolist()), size)
        return RealCamera(raster, WEATHER[lighting], self._robot, intrinsics, size, self.road.drive.rng(CAMERA))

    def trial(self, lighting: str, seed: int, watch: Callable[[Image], None] | None = None) -> Trial:
        """Drives once.

        Args:
            lighting: One of `WEATHER`.
            seed: Of everything random in the trial.
            watch: Is shown every picture (h, w, 3).
        """
        policy, drive, physics = self.policy, self.road.drive, self.road.physics
        eye = self.begin(lighting, seed)
        width, height = policy.size
        stack, steps, ended = np.zeros((policy.stack, 3, height, width), np.uint8), 0, False
        while not ended:
            picture = eye.look(physics.camera_to_world, physics.time())
            if watch:
                watch(picture)
            newest = picture.transpose(2, 0, 1)
            stack = np.concatenate([stack[1:], newest[None]]) if steps else np.repeat(newest[None], policy.stack, 0)
            v, yaw_rate = policy.command(policy(stack.reshape(3 * policy.stack, height, width)))
            action = [yaw_rate] if policy.control.action == STEERING else [v, yaw_rate]
            ended, steps = self._environment.step(np.array(action)).last(), steps + 1
        return Trial(policy.name, drive.stretch.name, lighting, seed, drive.cause, drive.progress, steps)


def run(
    policies: Sequence[Path],
    task: str,
    lightings: Sequence[str],
    trials: int,
    out: Path,
    twin_lighting: str = HELD_OUT + RANDOMISED,
    films: Path | None = None,
) -> list[Trial]:
    """Drives what is not yet in the table of trials, and sums all of it up.

    Args:
        policies: Files.
        task: One of `TASKS`.
        lightings: Some of `WEATHER`.
        trials: Per policy and lighting.
        out: Gets the results as `twin.forecast` reads them; `<name>_trials.csv` beside it gets a row per trial, and
            `<name>_policies.json` the sums of the files that were driven with.
        twin_lighting: Goes into the results' column of this name, in rows that are new.
        films: Gets a film of every trial, of what the robot saw.

    Returns:
        Every trial of the table, those of earlier calls too.

    Raises:
        InputError: unknown names, unusable policy files, another file than before under a policy's name, or another
            process that drives for the same table.
    """
    for name in lightings:
        if name not in WEATHER:
            raise InputError(f"lighting {name!r}: reality's are {', '.join(WEATHER)}")
    if not 1 <= trials <= _PER_WEATHER:
        raise InputError(f"trials = {trials}; expected 1 to {_PER_WEATHER}")
    table = out.with_name(f"{out.stem}_trials.csv")
    loaded = [policy_file(path) for path in policies]
    with alone(out.with_name(f".{out.stem}.lock"), f"{out} is being written"):
        _remember(loaded, policies, out.with_name(f"{out.stem}_policies.json"))
        done = read_trials(table) if table.exists() else []
        known = {(*_key(one), one.seed) for one in done}
        for policy in {one.name: one for one in loaded}.values():
            test = RealTest(policy, task)
            for lighting in dict.fromkeys(lightings):
                # Of each weather its own, or ten starts in five weathers would pass for fifty.
                first = _FIRST_SEED + _PER_WEATHER * list(WEATHER).index(lighting)
                seeds = [first + k for k in range(trials)]
                missing = [seed for seed in seeds if (policy.name, task, lighting, seed) not in known]
                with bar(f"{policy.name}, {task}, {lighting}", len(missing), "trial") as progress:
                    for seed in missing:
                        done.append(_trial(test, lighting, seed, films))
                        _write(done, table, out, twin_lighting)
                        progress.set_postfix_str(f"{done[-1].cause} at {done[-1].progress:.1f} m")
                        progress.update()
        _write(done, table, out, twin_lighting)
    return done


def _trial(test: RealTest, lighting: str, seed: int, films: Path | None) -> Trial:
    """A trial, filmed where it is asked for."""
    frames: list[Image] = []
    trial = test.trial(lighting, seed, frames.append if films else None)
    if films:
        _film(frames, films / f"{trial.policy.replace('/', '_')}_{trial.task}_{lighting}_{seed}.mp4")
    return trial


def _film(frames: Sequence[Image], path: Path) -> None:
    """Ten pictures a second, enlarged."""
    height, width = (_ENLARGED * side for side in frames[0].shape[:2])
    plan = FilmingPlan(width=width, height=height, fps=10, crf=23)
    path.parent.mkdir(parents=True, exist_ok=True)
    encode((one.repeat(_ENLARGED, 0).repeat(_ENLARGED, 1) for one in frames), plan, path)


def _key(trial: Trial) -> tuple[str, str, str]:
    return trial.policy, trial.task, trial.lighting


def _write(trials: Sequence[Trial], table: Path, out: Path, twin_lighting: str) -> None:
    compared: dict[tuple[str, str, str], str] = {}  # what a cell was compared with before, it still is
    if out.exists():
        with damaged(out, "give another --out"):
            for row in csv.DictReader(io.StringIO(read_text(out), newline="")):
                compared[row["policy"], row["task"], row["lighting"]] = row["twin_lighting"]
    rows = [
        (c.policy, c.lighting, str(c.trials), str(c.successes), c.task, compared.get(c.key, twin_lighting))
        for c in tally(trials)
    ]
    for path, text in (
        (table, csv_text(EPISODE_COLUMNS, [trial.row() for trial in trials])),
        (out, csv_text(_COLUMNS, rows)),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)


def _remember(policies: Sequence[Policy], paths: Sequence[Path], record: Path) -> None:
    """Notes which file drove under which name."""
    sums: dict[str, str] = {}
    if record.exists():
        with damaged(record, "give another --out"):
            sums = dict(read_json(record))
    for policy, path in zip(policies, paths, strict=True):
        folder = path.parent if path.name == JSON else path
        digest = digest_file(folder / JSON if folder.is_dir() else folder)  # which has the digest of the weights
        if sums.setdefault(policy.name, digest) != digest:
            raise InputError(
                f"{path}: {record} says that another file drove under the name {policy.name!r}; give another --out, or "
                "rename the policy"
            )
    record.parent.mkdir(parents=True, exist_ok=True)
    write_json(record, sums)
