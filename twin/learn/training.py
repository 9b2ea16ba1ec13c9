"""A training run: SAC in many environments, then selection of the best policy.

runs/<name>/
  config.json                             the configuration
  policy.json .safetensors .onnx          the newest policy (`policy.py`); after the training the selected one
  choice.json                             the selection
  checkpoints/<steps>/                    policies saved during the training
  episodes.csv, log.csv, tensorboard/     episodes driven in training; speed, memory and losses at every save
  state/                                  the saved state (`sac.py`) and the replay buffer's pictures
"""

import csv
import dataclasses
import json
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnvWrapper

from twin import runtime
from twin.config import Condition
from twin.env.suite import fingerprint
from twin.env.vector_env import make_vector_env
from twin.errors import InputError
from twin.evaluation.training_curves import CHOICE_FILE
from twin.evaluation.trials import RECENT_EPISODES, csv_text
from twin.files import read_json, wrap_read_errors, write_json, write_text
from twin.learn.policy import copy_policy, load_policy, save_policy
from twin.learn.policy_evaluation import run_episodes
from twin.learn.policy_network import preprocess
from twin.learn.replay_buffer import FrameReplayBuffer
from twin.learn.sac import (
    DrivePolicy,
    Encoder,
    PixelSAC,
    actor_weights,
    has_state,
    load_state,
    save_state,
    saved_steps,
)
from twin.learn.sb3_env import DriveVecEnv
from twin.learn.train_config import TrainConfig
from twin.loading import Twin
from twin.runtime import StopNotice, Stopped, stop_noted

TRAINING_EPISODE_COLUMNS = (
    *("step", "wall_s", "seed", "lighting", "success", "cause", "progress_m", "steps", "reward", "start_m"),
)
LOG_COLUMNS = ("step", "wall_s", "updates", "steps_per_s", "updates_per_s", "memory_mb", "ent_coef", "value")
FRESH_EPISODES = 20
"""Number of fresh episodes from which the selected policy's success rate is reported."""

Watch = Callable[[int, Sequence[bool]], None]
"""Receives the steps done, and the success of the last `RECENT_EPISODES` that started at the segment's beginning."""

_FINAL_RATE = 0.1  # of the learning rate, at the end
_CANDIDATES = 4  # policies that the best one is selected from
# A seed derives from the run's seed, one of these numbers and, in training, the number of resumptions, so that no
# random stream is used twice.
_TRAINING_STREAM, _SELECTION_STREAM = 6, 7


class PreprocessedVecEnv(VecEnvWrapper):
    """Environments with the policy's preprocessing, in which networks can learn while the environments step."""

    def __init__(self, envs: DriveVecEnv, pool: int) -> None:
        channels, height, width = envs.observation_space.shape  # type: ignore[misc]
        super().__init__(envs, spaces.Box(0, 255, (channels, height // pool, width // pool), np.uint8))
        self._pool, self._thread = pool, ThreadPoolExecutor(1)
        self.meanwhile: Callable[[], None] = lambda: None
        """Called while the environments step, which must not depend on it: the updates of the networks."""

    def reset(self) -> NDArray:
        return preprocess(np.asarray(self.venv.reset()), self._pool)

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:
        stepped = self._thread.submit(self.venv.step_wait)
        self.meanwhile()
        pictures, rewards, dones, infos = stepped.result()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = preprocess(infos[i]["terminal_observation"], self._pool)
        return preprocess(np.asarray(pictures), self._pool), rewards, dones, infos

    def close(self) -> None:
        self._thread.shutdown()
        super().close()


def train(
    twin: Twin,
    folder: Path,
    config: TrainConfig,
    watch: Watch | None = None,
    processes: int | None = None,
) -> None:
    """Trains a policy, or resumes a training that was stopped or killed.

    SIGINT, SIGTERM and SIGHUP save the state and raise `Stopped`, a KeyboardInterrupt.

    Args:
        config: Must equal that of an existing run, except for `steps`.
        processes: See `make_vector_env`; the number does not change the result.

    Raises:
        InputError: an existing run has another configuration or is damaged, the folder is not empty and not a run, or
            an error of `twin.load`.
        OSError: the disk is full; the last saved state is intact.
    """
    road = fingerprint(twin, config.task, Condition(config.lighting, config.randomise))
    settings = json.loads(json.dumps({**dataclasses.asdict(config), "road": road}))  # as read from a file
    pictures = folder / "state" / "pictures.bin"
    resume = has_state(folder / "state")
    if resume:
        _check_same(folder, settings)
        if not pictures.exists():
            raise InputError(f"{pictures} is missing; train anew under another name")
    else:
        _check_run(folder)
        (folder / "state").mkdir(parents=True, exist_ok=True)
        for stale in (folder / "episodes.csv", folder / "log.csv", pictures):
            stale.unlink(missing_ok=True)
        shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    vec_env = DriveVecEnv(twin, config.task, config.worlds, config.seed, processes, **config.options())
    with closing(PreprocessedVecEnv(vec_env, config.pool)) as envs:
        model = _model(envs, config, pictures)
        before: dict[str, Any] = load_state(folder / "state", model) if resume else {"wall": 0.0, "resumed": -1}
        resumed = before["resumed"] + 1
        seeds = np.random.SeedSequence([config.seed, resumed, _TRAINING_STREAM])
        envs.seed(int(seeds.generate_state(1, np.uint64)[0]))
        updates = max(1, round(config.updates * config.worlds))

        def learn() -> None:
            if model.num_timesteps > config.starts:
                model.train(updates, config.batch)

        envs.meanwhile = learn
        with stop_noted() as stop:
            camera = twin.world().camera.resized(config.architecture.size)
            origin = {"scene": twin.scene.root.resolve().name, "camera": list(camera.intrinsics)}
            recorder = _RunRecorder(folder, config, settings, origin, before["wall"], resumed, watch, stop)
            left = config.steps - model.num_timesteps
            if left > 0:
                (folder / CHOICE_FILE).unlink(missing_ok=True)  # more steps invalidate the selection
                model.learn(left, recorder, log_interval=10, reset_num_timesteps=False)
                recorder.end()
                if stop.number:
                    raise Stopped(stop.number)


def _model(envs: PreprocessedVecEnv, config: TrainConfig, pictures: Path) -> PixelSAC:
    model = PixelSAC(
        DrivePolicy,
        envs,
        # Constant in the first half; decreases in the second, so that the policy converges.
        learning_rate=lambda left: config.learning_rate * (_FINAL_RATE + (1.0 - _FINAL_RATE) * min(1.0, 2.0 * left)),
        buffer_size=config.buffer,
        learning_starts=config.starts,
        batch_size=config.batch,
        tau=config.tau,
        gamma=config.gamma,
        train_freq=1,
        gradient_steps=0,  # updates run in `meanwhile`
        ent_coef="auto_0.1",
        target_entropy=config.entropy * config.control.actions,
        replay_buffer_class=FrameReplayBuffer,
        replay_buffer_kwargs={
            "file": pictures,
            "slack": config.save_every + config.worlds,
            "shift": config.shift,
            "color_strength": config.colours if config.lighting_varies else 0.0,
            "seed": config.seed,
            "state_size": len(config.state_scales),
        },
        state_scales=config.state_scales,
        policy_kwargs={
            "features_extractor_class": Encoder,
            "features_extractor_kwargs": {"architecture": config.architecture},
            "net_arch": list(config.hidden),
            "share_features_extractor": True,
            "normalize_images": False,  # the encoder scales them
            "state_size": len(config.state_scales),
        },
        seed=config.seed,
        device=config.device,
    )
    model.set_logger(configure(str(pictures.parent.parent / "tensorboard"), ["tensorboard"]))
    return model


def _check_run(folder: Path) -> None:
    """Raises InputError if a folder is neither empty nor a run, as a training deletes and replaces files.

    A run has a folder `state`, which a training creates first.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{folder} is not a folder; move it away, or give another --run")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "state").is_dir():
        raise InputError(
            f"{folder} is not a training run (it has no folder state); move it away, or give another --run"
        )


def _check_same(folder: Path, settings: dict[str, Any]) -> None:
    """Raises InputError if an existing run has another configuration."""
    with wrap_read_errors(folder / "config.json", "train anew under another name"):
        previous = dict(read_json(folder / "config.json"))
        previous["road"]
    new = [name for name in settings if name not in previous]
    if new:
        raise InputError(f"{folder} was trained by an earlier version, which had no {new[0]}; give another --run")
    if previous["road"] != settings["road"]:
        raise InputError(
            f"{folder} was trained before the scene was rebuilt, its task or obstacles changed, or twin samples "
            "episodes differently; give another --run"
        )
    for name in settings:
        if name != "steps" and previous.get(name) != settings[name]:
            raise InputError(
                f"{folder} was trained with {name} = {previous.get(name)!r}, not {settings[name]!r}; "
                "resume with the same, or give another --run"
            )


class _RunRecorder(BaseCallback):
    """Writes the tables, checkpoints and states of a run."""

    def __init__(
        self,
        folder: Path,
        config: TrainConfig,
        settings: dict[str, Any],
        origin: dict[str, Any],
        wall: float,
        resumed: int,
        watch: Watch | None,
        stop: StopNotice,
    ) -> None:
        """`origin`: name of the scene, and intrinsics fx, fy, cx, cy [px] of the pictures."""
        super().__init__()
        self.model: PixelSAC
        self._folder, self._config, self._settings, self._origin = folder, config, settings, origin
        self._wall, self._resumed, self._started = wall, resumed, time.monotonic()
        self._watch, self._stop = watch, stop

    @property
    def wall(self) -> float:
        """Wall time of the whole training [s]."""
        return self._wall + time.monotonic() - self._started

    def _on_training_start(self) -> None:
        # Written only now, because a configuration with which no environment starts is not valid.
        write_json(self._folder / "config.json", self._settings)
        self._saved = self._first = self.model.num_timesteps
        self._first_updates = self.model._n_updates
        kept = _keep_rows(self._folder / "episodes.csv", TRAINING_EPISODE_COLUMNS, self._saved)
        self._recent: list[bool] = kept[-RECENT_EPISODES:]
        _keep_rows(self._folder / "log.csv", LOG_COLUMNS, self._saved)

    def _on_rollout_start(self) -> None:
        # Unlike in _on_step, the buffer contains all collected transitions.
        if self._stop.number or self.model.num_timesteps - self._saved >= self._config.save_every:
            self.save()
        if self._stop.number:
            raise Stopped(self._stop.number)
        self._checkpoint()

    def _on_step(self) -> bool:
        rows = []
        for info in (one for one in self.locals["infos"] if "episode" in one):
            if not info["start"]:
                self._recent = [*self._recent, info["is_success"]][-RECENT_EPISODES:]
            episode = info["episode"]
            head = (self.model.num_timesteps, f"{self.wall:.1f}", info["episode_seed"], info["lighting"])
            outcome = (int(info["is_success"]), info["cause"], f"{info['progress']:.2f}", episode["l"])
            rows.append((*head, *outcome, f"{episode['r']:.3f}", f"{info['start']:.2f}"))
        _append(self._folder / "episodes.csv", rows)
        if self._watch:
            self._watch(self.model.num_timesteps, self._recent)
        return True

    def end(self) -> None:
        """Saves the last checkpoint and state."""
        self._checkpoint()
        self.save()

    def save(self) -> None:
        """Saves the policy, the state and a row of the log, unless no step was done since the last save."""
        if self.model.num_timesteps == self._saved:
            return
        model, elapsed = self.model, max(time.monotonic() - self._started, 1e-9)
        logged = model.logger.name_to_value
        row = (
            *(model.num_timesteps, f"{self.wall:.1f}", model._n_updates),
            f"{(model.num_timesteps - self._first) / elapsed:.2f}",
            f"{(model._n_updates - self._first_updates) / elapsed:.2f}",
            round(runtime.resident_memory() / 2**20),
            *(f"{logged.get(f'train/{name}', float('nan')):.4g}" for name in ("ent_coef", "value")),
        )
        _append(self._folder / "log.csv", [row])
        self._save_policy(self._folder)
        save_state(self._folder / "state", model, {"wall": self.wall, "resumed": self._resumed})
        self._saved = model.num_timesteps

    def _checkpoint(self) -> None:
        """Saves a checkpoint if one is due."""
        every = self._config.steps / self._config.checkpoints
        number = int(self.model.num_timesteps / every)
        if number and self.model.num_timesteps - number * every < self._config.worlds:
            self._save_policy(self._folder / "checkpoints" / f"{self.model.num_timesteps:09d}")

    def _save_policy(self, folder: Path) -> None:
        c = self._config
        trained: dict[str, Any] = {**self._origin, "run": self._folder.name}
        trained |= {name: getattr(c, name) for name in ("task", "observe", "lighting", "seed")}
        trained["step"] = self.model.num_timesteps
        save_policy(folder, c.architecture, c.control, actor_weights(self.model, c.architecture), trained)


def _append(path: Path, rows: list[tuple]) -> None:
    if rows:
        with path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


def _keep_rows(path: Path, columns: tuple[str, ...], steps: int) -> list[bool]:
    """Creates a table, or drops its rows after `steps`.

    Returns the success of the kept episodes that started at the segment's beginning; empty for a table without success.
    """
    rows: list[list[str]] = []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            # A killed training may leave the last line incomplete.
            rows = [row for row in list(csv.reader(file))[1:] if len(row) == len(columns) and int(row[0]) <= steps]
    write_text(path, csv_text(columns, rows))
    if "success" not in columns:
        return []
    success, start = columns.index("success"), columns.index("start_m")
    return [row[success] == "1" for row in rows if float(row[start]) == 0.0]


# ---- selection of a checkpoint


def select_checkpoint(twin: Twin, folder: Path, config: TrainConfig, processes: int | None = None) -> dict[str, Any]:
    """Selects the best policy of a finished training as the run's; keeps an earlier selection of the same training.

    *Candidates* are policies saved in the second half of the training. All drive the same `config.trials` whole
    episodes, with the training's lighting and randomization and without exploration. The one with most successes is
    selected, among equals the one with the highest mean reward. The best of several is partly lucky, so its reported
    rate comes from fresh episodes.

    Returns:
        The content of `choice.json`: steps of the training; step, trials, successes and mean reward of every candidate,
        and of the selected one on fresh episodes.
    """
    trained = saved_steps(folder / "state")
    if (folder / CHOICE_FILE).exists():
        with wrap_read_errors(folder / CHOICE_FILE, "delete it, and the best policy is selected again"):
            before = read_json(folder / CHOICE_FILE)
            if before["steps"] == trained:
                _ = [before["chosen"][name] + 0 for name in ("step", "trials", "successes")]  # raises if damaged
                return before
    candidates = _candidates(folder / "checkpoints", trained)
    samples = np.random.SeedSequence([config.seed, _SELECTION_STREAM]).generate_state(config.trials + FRESH_EPISODES)
    seeds = tuple(int(seed) for seed in samples)
    shared, fresh = seeds[: config.trials], seeds[config.trials :]
    options = {**config.options(), "start_along": 0.0}
    results = []
    bar = runtime.bar("choose", len(candidates) * len(shared) + len(fresh), "episode")
    with closing(make_vector_env(twin, config.task, options, [None] * config.worlds, processes)) as envs, bar:

        def evaluate(path: Path, which: tuple[int, ...]) -> dict[str, Any]:
            driven = run_episodes(load_policy(path), envs, which, bar.update)
            reward = round(float(np.mean([one.reward for one in driven])), 3)
            won = sum(one.cause == "goal" for one in driven)
            return {"step": int(path.name), "trials": len(driven), "successes": won, "reward": reward}

        for path in candidates:
            results.append(evaluate(path, shared))
        best = max(range(len(results)), key=lambda i: (results[i]["successes"], results[i]["reward"]))
        last = evaluate(candidates[best], fresh)
    copy_policy(candidates[best], folder)
    out = {"steps": trained, "candidates": results, "chosen": last}
    write_json(folder / CHOICE_FILE, out)
    return out


def _candidates(folder: Path, steps: int) -> list[Path]:
    """At most `_CANDIDATES` evenly spaced policies of the second half, including the last."""
    late = sorted(path for path in folder.iterdir() if steps / 2 < int(path.name))
    return late[:: -max(1, -(-len(late) // _CANDIDATES))][::-1]
