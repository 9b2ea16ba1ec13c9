"""A training run: first a teacher (`teacher.py`), then a policy that learns from it in many environments
(`distillation.py`). `selection.py` decides when the training ends and which policy is kept.

runs/<name>/
  config.json                             the configuration
  policy.json .safetensors .onnx          the newest policy (`policy.py`); after the training, the selected one
  tests.json, choice.json                 tests of policies, and the selection (`selection.py`)
  checkpoints/<steps>/                    policies saved during the training
  episodes.csv                            episodes driven in training
  log.csv                                 speed, memory, and the policy's errors in training, at every save
  tensorboard/                            the curves of episodes.csv and log.csv
  state/                                  the teacher, the saved state (`distillation.py`) and the pictures seen
"""

import csv
import dataclasses
import io
import json
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import compress, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.logger import KVWriter, TensorBoardOutputFormat

from twin import runtime
from twin.config import Condition
from twin.env.env_factory import fingerprint
from twin.env.options import CUDA
from twin.env.task import EPISODE_VERSION
from twin.env.vector_env import default_processes
from twin.errors import InputError
from twin.evaluation.training_curves import CHOICE_FILE
from twin.evaluation.trials import csv_text
from twin.files import digest_json, read_json, read_text, wrap_read_errors, write_json, write_text
from twin.learn.distillation import Distillation, has_state, load_state, save_state
from twin.learn.policy import load_policy, save_policy
from twin.learn.policy_evaluation import EpisodeResult, run_episodes
from twin.learn.policy_network import preprocess
from twin.learn.replay_buffer import PictureBuffer
from twin.learn.sb3_env import DriveVecEnv
from twin.learn.teacher import STATE_SCALES, Teacher, load_teacher, save_teacher, train_teacher
from twin.learn.train_config import TrainConfig
from twin.loading import Twin
from twin.runtime import StopNotice, Stopped, stop_noted

TRAINING_EPISODE_COLUMNS = (
    *("step", "wall_s", "seed", "lighting", "success", "cause", "progress_m", "steps", "reward", "start_m"),
)
LOG_COLUMNS = ("step", "wall_s", "updates", "steps_per_s", "updates_per_s", "memory_mb", "action_error", "state_error")
Watch = Callable[[int], object]
"""Receives the number of steps done."""

Drive = Callable[[Path, Sequence[int], Callable[[], object]], list[EpisodeResult]]
"""Drives the policy of a folder in whole episodes in the training's conditions, one per seed; see `run_episodes`."""


@dataclass(frozen=True)
class Segment:
    """A part of a training."""

    until: int
    """Number of steps done at its end, where a checkpoint is saved."""
    settle_from: int | None
    """From this step, the learning rate falls to its lowest value at the segment's end; None: it follows its cycle."""
    why: str = ""
    """Reason to end the training after this segment; empty: the training continues."""


Referee = Callable[[int, Drive], Segment | None]
"""Receives the number of steps done and a function that drives policies. Returns the next segment, or None to end the
training."""

_MEAN_ERRORS = 200  # number of the newest updates whose mean errors are logged
_MAX_TABLE = 2**32  # [bytes] largest table of a run
_NO_CURVES = ("step", "seed", "lighting", "cause")  # columns that are not sent to the writers as curves
_FINAL_RATE = 0.1  # lowest learning rate / `config.learning_rate`
# Seeds derive from the run's seed, the number of resumptions and this number. It differs from `selection._STREAM`, so
# that no random stream is used twice.
_TRAINING_STREAM = 6


def train(
    twin: Twin,
    folder: Path,
    config: TrainConfig,
    watch: Watch | None = None,
    processes: int | None = None,
    referee: Referee | None = None,
    writers: Sequence[KVWriter] = (),
) -> None:
    """Trains a policy, or resumes a training that was stopped or killed.

    On SIGINT, SIGTERM and SIGHUP, it saves the state and raises `Stopped`, a KeyboardInterrupt. A teacher that is still
    in training is not saved.

    Args:
        config: Must equal that of an existing run, except for `steps`, `success` and `device`.
        processes: See `make_vector_env`, by default for `config.worlds`; the number does not change the result.
        referee: Plans the training; by default, the training is one segment of `config.steps`. With a referee, there
            are as many environments again for its tests.
        writers: Also receive the numbers that are written to `tensorboard/`: those of `episodes.csv` and `log.csv`.

    Raises:
        InputError: there is no CUDA device and the configuration needs one, an existing run has another configuration
            or is damaged, the folder is neither empty nor a run, or an error of `twin.load`.
        OSError: the disk is full; the last saved state is intact.
    """
    check_device(config)
    settings = run_settings(twin, config)
    pictures = folder / "state" / "pictures.bin"
    resume = has_state(folder / "state")
    if resume:
        check_same(folder, settings)
        if not pictures.exists():
            raise InputError(f"{pictures} is missing; train again under another name")
    else:
        prepare_folder(folder)
        for stale in (folder / "episodes.csv", folder / "log.csv", pictures):
            stale.unlink(missing_ok=True)
        shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    with stop_noted() as stop:
        # Tests have separate environments: in shared ones, a test would break off training episodes. The two sets of
        # environments never step at the same time, so they share the processes.
        spare = range(config.worlds, 2 * config.worlds) if referee else range(0)
        processes = default_processes(config.worlds) if processes is None else processes
        envs = DriveVecEnv(twin, config.task, config.worlds, config.seed, processes, len(spare), **config.options())
        with closing(envs), ThreadPoolExecutor(1) as thread, ExitStack() as opened:
            # Environments and buffer come before the teacher's training, which takes minutes: a lighting may be
            # unknown, or the disk too full.
            buffer = _buffer(config, pictures)
            teacher = load_teacher(folder / "state", config.control.actions) if resume else None
            if teacher is None:
                teacher = _new_teacher(twin, folder, config, processes, stop)
            for i in (*range(min(config.whole_worlds, config.worlds - 1)), *spare):
                envs.vector_env.set(i, "options", dataclasses.replace(envs.vector_env.options, start_along=0.0))
            board = opened.enter_context(closing(TensorBoardOutputFormat(str(folder / "tensorboard"))))
            learner = Distillation(config.architecture, teacher, buffer, config.seed, config.device)
            before: dict[str, Any] = load_state(folder / "state", learner) if resume else {"wall": 0.0, "resumed": -1}
            resumed = before["resumed"] + 1
            seeds = np.random.SeedSequence([config.seed, resumed, _TRAINING_STREAM])
            envs.seed(int(seeds.generate_state(1, np.uint64)[0]))
            camera = twin.world().camera.resized(config.architecture.size)
            origin = {"scene": twin.scene.root.resolve().name, "camera": list(camera.intrinsics)}
            recorder = _RunRecorder(
                folder, config, settings, origin, learner, before["wall"], resumed, watch, stop, [board, *writers]
            )
            if not resume:  # from now on, a stopped training need not train its teacher again
                recorder.begin()
                save_state(folder / "state", learner, {"wall": recorder.wall, "resumed": resumed})

            def drive(policy: Path, seeds: Sequence[int], on_episode: Callable[[], object]) -> list[EpisodeResult]:
                if stop.number:
                    raise Stopped(stop.number)
                return run_episodes(load_policy(policy), envs.vector_env, seeds, on_episode, spare)

            plan: Referee = referee or (lambda step, _: None if step >= whole.until else whole)
            whole = Segment(config.steps, None)
            drives = _Drives(envs, config, learner, thread)
            while segment := plan(learner.steps, drive):
                if learner.steps >= segment.until:  # a resumed training may already be at or beyond the segment's end
                    recorder.save_checkpoint()
                    continue
                (folder / CHOICE_FILE).unlink(missing_ok=True)  # more steps invalidate the selection
                recorder.begin()
                while learner.steps < segment.until:
                    recorder.before_step()
                    infos, errors = drives.step(_learning_rate(config, learner.steps, segment))
                    recorder.after_step(infos, errors)
                recorder.end()
                if stop.number:
                    raise Stopped(stop.number)


class _Drives:
    """Environments that the policy in training drives; during their steps, it is updated."""

    def __init__(self, envs: DriveVecEnv, config: TrainConfig, learner: Distillation, thread: Executor) -> None:
        self._envs, self._config, self._learner, self._thread = envs, config, learner, thread
        self._stacks: NDArray[np.uint8] | None = None
        """Preprocessed stacks of the environments; None: no episode has begun."""

    def step(self, rate: float) -> tuple[list[dict[str, Any]], list[tuple[float, float]]]:
        """One step of all environments, and the updates that are due, with this learning rate.

        Returns the infos of the environments, and the errors of the updates, see `Distillation.update`.
        """
        c, learner = self._config, self._learner
        if self._stacks is None:
            self._observe(self._envs.reset(), np.ones(c.worlds, bool))
        assert self._stacks is not None
        self._envs.step_async(learner.act(self._stacks))
        stepped = self._thread.submit(self._envs.step_wait)
        done = learner.steps
        due = int(c.updates * (done + c.worlds) + 1e-9) - int(c.updates * done + 1e-9)
        errors = [learner.update(c.batch, rate) for _ in range(due if done >= c.starts else 0)]
        pictures, _, over, infos = stepped.result()
        self._observe(pictures, over)
        learner.steps += c.worlds
        return infos, errors

    def _observe(self, pictures: Any, first: NDArray[np.bool_]) -> None:
        self._stacks = preprocess(np.asarray(pictures), self._config.pool)
        states = np.stack([self._envs.vector_env.state(i) for i in range(self._config.worlds)])
        self._learner.buffer.add(self._stacks[:, -3:], states, first)


def _new_teacher(twin: Twin, folder: Path, config: TrainConfig, processes: int | None, stop: StopNotice) -> Teacher:
    """Trains and saves a teacher. Raises Stopped if a signal comes."""
    with runtime.bar("teacher, by the robot's state", config.teacher_steps, "step") as bar:

        def watch(steps: int) -> None:
            bar.update(steps - bar.n)
            if stop.number:
                raise Stopped(stop.number)

        teacher, successes = train_teacher(twin, config, processes, watch)
    save_teacher(folder / "state", teacher, successes, config.worlds)
    return teacher


def _buffer(config: TrainConfig, pictures: Path) -> PictureBuffer:
    return PictureBuffer(
        config.buffer,
        config.worlds,
        config.architecture.pooled_size[::-1],
        config.architecture.stack,
        len(STATE_SCALES),
        pictures,
        slack=config.save_every + 2 * config.worlds,
        shift=config.shift,
        color_strength=config.colours if config.lighting_varies else 0.0,
        seed=config.seed,
        device=config.device,
    )


def _learning_rate(config: TrainConfig, step: int, segment: Segment) -> float:
    """Learning rate of the next update; in a settling segment, it falls linearly to its lowest value at the end."""
    lowest = _FINAL_RATE * config.learning_rate
    if segment.settle_from is None or step <= segment.settle_from:
        return cycle_rate(config, step)
    left = max(0.0, (segment.until - step) / (segment.until - segment.settle_from))
    return lowest + left * max(0.0, cycle_rate(config, segment.settle_from) - lowest)


def cycle_rate(config: TrainConfig, step: int) -> float:
    """Learning rate at a step, without settling: constant in the first half of each cycle, then falling linearly.

    Cycles have about `config.cycle` steps and divide `config.steps` evenly; docs/findings.md compares a constant rate.
    """
    length = config.steps / max(1, round(config.steps / config.cycle))
    left = 1.0 - (step % length) / length if step < config.steps else 0.0
    return config.learning_rate * (_FINAL_RATE + (1.0 - _FINAL_RATE) * min(1.0, 2.0 * left))


def check_device(config: TrainConfig) -> None:
    """Raises InputError if the configuration needs a GPU and there is none."""
    if config.device == CUDA and not torch.cuda.is_available():
        raise InputError(f"device = {CUDA!r}: no CUDA device is visible to torch; use --device cpu")


def prepare_folder(folder: Path) -> None:
    """Creates a run's folder and in it the folder `state`, which marks it as a run.

    Raises InputError if the folder exists and is neither empty nor a run, since a training deletes and replaces files.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{folder} is not a folder; move it away, or give another --run")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "state").is_dir():
        raise InputError(
            f"{folder} is not a training run (it has no folder state); move it away, or give another --run"
        )
    (folder / "state").mkdir(parents=True, exist_ok=True)


def checkpoint_folder(folder: Path, step: int) -> Path:
    return folder / "checkpoints" / f"{step:09d}"


def run_settings(twin: Twin, config: TrainConfig) -> dict[str, Any]:
    """Settings that `check_same` compares between calls of a run: the configuration, and the road's fingerprint.

    The values are JSON types, as read from `config.json`.
    """
    road = digest_json([fingerprint(twin, config.task, Condition(config.lighting, config.randomise)), EPISODE_VERSION])
    return dict(json.loads(json.dumps({**dataclasses.asdict(config), "road": road})))


def check_same(folder: Path, settings: dict[str, Any]) -> None:
    """Raises InputError if a run has other settings, apart from `steps`, `success` and `device`."""
    with wrap_read_errors(folder / "config.json", "train again under another name"):
        previous = dict(read_json(folder / "config.json"))
        previous["road"]
    new = [name for name in settings if name not in previous]
    if new:
        raise InputError(f"{folder} was trained by an earlier version, which had no {new[0]}; give another --run")
    if previous["road"] != settings["road"]:
        raise InputError(
            f"{folder} was trained before the scene was rebuilt, its task or obstacles were changed, or twin changed "
            "the sampling of episodes; give another --run"
        )
    for name in settings:
        if name not in ("steps", "success", "device") and previous.get(name) != settings[name]:
            raise InputError(
                f"{folder} was trained with {name} = {previous.get(name)!r}, not {settings[name]!r}; "
                "resume with the same, or give another --run"
            )


class _RunRecorder:
    """Writes the tables, checkpoints and states of a run."""

    def __init__(
        self,
        folder: Path,
        config: TrainConfig,
        settings: dict[str, Any],
        origin: dict[str, Any],
        learner: Distillation,
        wall: float,
        resumed: int,
        watch: Watch | None,
        stop: StopNotice,
        writers: Sequence[KVWriter],
    ) -> None:
        """`origin`: name of the scene, and intrinsics fx, fy, cx, cy [px] of the pictures."""
        self._folder, self._config, self._settings, self._origin = folder, config, settings, origin
        self._learner, self._wall, self._resumed, self._started = learner, wall, resumed, time.monotonic()
        self._watch, self._stop, self._writers = watch, stop, writers
        self._errors: list[tuple[float, float]] = []

    @property
    def wall(self) -> float:
        """Wall time of the whole training [s]."""
        return self._wall + time.monotonic() - self._started

    def begin(self) -> None:
        """Call this before the steps of a segment."""
        # Written only now: the environments have started, so the configuration is valid.
        write_json(self._folder / "config.json", self._settings)
        self._saved = self._first = self._learner.steps
        self._first_updates, self._first_time = self._learner.updates, time.monotonic()
        _keep_rows(self._folder / "episodes.csv", TRAINING_EPISODE_COLUMNS, self._saved)
        _keep_rows(self._folder / "log.csv", LOG_COLUMNS, self._saved)

    def before_step(self) -> None:
        """Saves what is due. Raises Stopped if a signal came."""
        if self._stop.number or self._learner.steps - self._saved >= self._config.save_every:
            self.save()
        if self._stop.number:
            raise Stopped(self._stop.number)
        self._checkpoint()

    def after_step(self, infos: list[dict[str, Any]], errors: list[tuple[float, float]]) -> None:
        """Records the environments' infos and the updates' errors."""
        self._errors = (self._errors + errors)[-_MEAN_ERRORS:]
        rows, whole = [], []
        for info in (one for one in infos if "episode" in one):
            episode = info["episode"]
            head = (self._learner.steps, f"{self.wall:.1f}", info["episode_seed"], info["lighting"])
            outcome = (int(info["is_success"]), info["cause"], f"{info['progress']:.2f}", episode["l"])
            rows.append((*head, *outcome, f"{episode['r']:.3f}", f"{info['start']:.2f}"))
            whole.append(not info["start"])
        # Episodes that start along the route are cut off: their curves would say nothing.
        self._append("episodes", TRAINING_EPISODE_COLUMNS, rows, whole)
        if self._watch:
            self._watch(self._learner.steps)

    def end(self) -> None:
        """Saves the last checkpoint and state."""
        self.save_checkpoint()
        self.save()

    def save(self) -> None:
        """Saves the policy, the state and a row of the log, unless no step was done since the last save."""
        learner, elapsed = self._learner, max(time.monotonic() - self._first_time, 1e-9)
        if learner.steps == self._saved:
            return
        errors = np.mean(self._errors, 0) if self._errors else np.full(2, np.nan)
        row = (
            *(learner.steps, f"{self.wall:.1f}", learner.updates),
            f"{(learner.steps - self._first) / elapsed:.2f}",
            f"{(learner.updates - self._first_updates) / elapsed:.2f}",
            round(runtime.resident_memory() / 2**20),
            *(f"{error:.4g}" for error in errors),
        )
        self._append("log", LOG_COLUMNS, [row])
        self._save_policy(self._folder)
        save_state(self._folder / "state", learner, {"wall": self.wall, "resumed": self._resumed})
        self._saved = learner.steps

    def _append(self, table: str, columns: tuple[str, ...], rows: list[tuple], shown: Sequence[bool] = (True,)) -> None:
        """Appends rows to a table of the run; the writers get the numbers of `shown` ones, as `<table>/<column>`."""
        if not rows:
            return
        with (self._folder / f"{table}.csv").open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
        for row, writer in product(compress(rows, shown), self._writers):
            named = dict(zip(columns, row, strict=True))
            numbers = {f"{table}/{name}": float(named[name]) for name in columns if name not in _NO_CURVES}
            writer.write(numbers, dict.fromkeys(numbers, ()), named["step"])

    def _checkpoint(self) -> None:
        every = self._config.steps / self._config.checkpoints
        number = int(self._learner.steps / every)
        if number and self._learner.steps - number * every < self._config.worlds:
            self.save_checkpoint()

    def save_checkpoint(self) -> None:
        self._save_policy(checkpoint_folder(self._folder, self._learner.steps))

    def _save_policy(self, folder: Path) -> None:
        c = self._config
        trained: dict[str, Any] = {**self._origin, "run": self._folder.name}
        trained |= {name: getattr(c, name) for name in ("task", "observe", "lighting", "seed")}
        trained["step"] = self._learner.steps
        save_policy(folder, c.architecture, c.control, self._learner.averaged.weights(c.architecture), trained)


def _keep_rows(path: Path, columns: tuple[str, ...], steps: int) -> None:
    """Creates a table, or drops its rows after `steps`. Raises InputError: the table is damaged."""
    rows: list[list[str]] = []
    if path.exists():
        with wrap_read_errors(path, "delete its damaged lines, or train again under another name"):
            # A killed training may leave the last line incomplete.
            table = list(csv.reader(io.StringIO(read_text(path, _MAX_TABLE))))[1:]
            rows = [row for row in table if len(row) == len(columns) and int(row[0]) <= steps]
    write_text(path, csv_text(columns, rows))
