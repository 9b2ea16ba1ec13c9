"""A training run: SAC in many worlds at once, in a folder that holds all that is known of it.

    runs/<name>/
      config.json                what was asked for
      policy.json .safetensors .onnx     the newest policy (see `policy.py`); in the end the chosen one
      choice.json                which that is (see `policy_evaluation.py`)
      checkpoints/<steps>/       policies along the way, of varied quality
      episodes.csv               every episode driven in training
      log.csv                    speed, memory and losses at every save
      tensorboard/
      state/                     what the training goes on from (see `checkpoint.py`), and its pictures

*Steps* are control steps of all worlds together. *Updates* are steps of the optimisers.
"""

import csv
import dataclasses
import json
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnvWrapper

from twin.cli import StopNotice, Stopped, stop_noted
from twin.config import RANDOMISED
from twin.env.suite import fingerprint
from twin.errors import InputError
from twin.evaluation.training_curves import CHOICE
from twin.evaluation.trials import RECENT, csv_text
from twin.files import damaged, read_json, write_json, write_text
from twin.learn.checkpoint import has_state, load_state, save_state
from twin.learn.policy import save_policy
from twin.learn.policy_network import prepared
from twin.learn.replay_buffer import FrameReplayBuffer
from twin.learn.sac import DrivePolicy, Encoder, PixelSAC, actor_weights
from twin.learn.sb3_env import DriveVecEnv
from twin.learn.train_config import TrainConfig
from twin.loading import Twin
from twin.runtime import resident

EPISODE_COLUMNS = ("step", "wall_s", "seed", "lighting", "success", "cause", "progress_m", "steps", "reward", "start_m")
LOG_COLUMNS = ("step", "wall_s", "updates", "steps_per_s", "updates_per_s", "memory_mb", "ent_coef", "value")
_LEAST_RATE = 0.1  # of the learning rate, at the end
_SEEDS = 6  # with a run's seed and its resumptions so far, what worlds draw from; none drives what another drove


class PreparedVecEnv(VecEnvWrapper):
    """Worlds whose pictures are prepared as the policy does it; while they are stepped, the networks can learn."""

    def __init__(self, worlds: DriveVecEnv, pool: int) -> None:
        channels, height, width = worlds.observation_space.shape  # type: ignore[misc]
        super().__init__(worlds, spaces.Box(0, 255, (channels, height // pool, width // pool), np.uint8))
        self._pool, self._thread = pool, ThreadPoolExecutor(1)
        self.meanwhile: Callable[[], None] = lambda: None
        """Called while the worlds are stepped. Neither sees anything of the other, so their order does not matter."""

    def reset(self) -> NDArray:
        return prepared(np.asarray(self.venv.reset()), self._pool)

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:
        stepped = self._thread.submit(self.venv.step_wait)
        self.meanwhile()
        pictures, rewards, dones, infos = stepped.result()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = prepared(infos[i]["terminal_observation"], self._pool)
        return prepared(np.asarray(pictures), self._pool), rewards, dones, infos

    def close(self) -> None:
        self._thread.shutdown()
        super().close()


@dataclass(frozen=True)
class Progress:
    """Where a training stands."""

    steps: int
    recent: tuple[bool, ...]
    """Success of the last episodes from the beginning of the stretch, `RECENT` at most."""


def train(
    twin: Twin,
    folder: Path,
    config: TrainConfig,
    watch: Callable[[Progress], None] | None = None,
    processes: int | None = None,
) -> None:
    """Trains a policy, or goes on where it was stopped or killed.

    Args:
        twin: A built scene.
        folder: Of the run.
        config: Of the run; a run that is there must have the same but for `steps`.
        watch: Is told at every step of the worlds.
        processes: That step the worlds; see `worlds_of`. What is learnt is the same.

    SIGINT, SIGTERM and SIGHUP save, and then raise `Stopped`, a KeyboardInterrupt. Nothing is deleted in a folder that
    is not a run: a run has a folder `state`, which is the first thing that a training makes in it.

    Raises:
        InputError: the run is another, or damaged, or the folder is no run; or what `twin.load` raises.
        OSError: the disk is full; what was saved before is whole.
    """
    road = fingerprint(twin, config.task, config.lighting + (RANDOMISED if config.randomise else ""))
    said = _as_json({**dataclasses.asdict(config), "road": road})
    go_on = has_state(folder / "state")
    if go_on:
        _check_same(folder, said)
    else:
        _check_run(folder)
        (folder / "state").mkdir(parents=True, exist_ok=True)
        for stale in ("episodes.csv", "log.csv", "state/pictures.bin"):
            (folder / stale).unlink(missing_ok=True)
        shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    if go_on and not (folder / "state" / "pictures.bin").exists():
        raise InputError(f"{folder}/state/pictures.bin is missing; train anew under another name")
    vectors = DriveVecEnv(twin, config.task, config.worlds, config.seed, processes, **config.options())
    with closing(PreparedVecEnv(vectors, config.pool)) as worlds:
        model = _model(worlds, config, folder / "state" / "pictures.bin")
        before: dict[str, Any] = load_state(folder / "state", model) if go_on else {"wall": 0.0, "resumed": -1}
        resumed = before["resumed"] + 1
        worlds.seed(int(np.random.SeedSequence([config.seed, resumed, _SEEDS]).generate_state(1, np.uint64)[0]))
        updates = max(1, round(config.updates * config.worlds))

        def learn() -> None:
            if model.num_timesteps > config.starts:
                model.train(updates, config.batch)

        worlds.meanwhile = learn
        with stop_noted() as stop:
            keeper = _Keeper(folder, config, said, twin, before["wall"], resumed, watch, stop)
            left = config.steps - model.num_timesteps
            if left > 0:
                (folder / CHOICE).unlink(missing_ok=True)  # what it says will not be so
                model.learn(left, keeper, log_interval=10, reset_num_timesteps=False)
                keeper.end()
                if stop.number:
                    raise Stopped(stop.number)


def _model(worlds: PreparedVecEnv, config: TrainConfig, pictures: Path) -> PixelSAC:
    model = PixelSAC(
        DrivePolicy,
        worlds,
        # Falls over the second half, so that the policy settles.
        learning_rate=lambda left: config.learning_rate * (_LEAST_RATE + (1.0 - _LEAST_RATE) * min(1.0, 2.0 * left)),
        buffer_size=config.buffer,
        learning_starts=config.starts,
        batch_size=config.batch,
        tau=config.tau,
        gamma=config.gamma,
        train_freq=1,
        gradient_steps=0,  # see `meanwhile`
        ent_coef="auto_0.1",
        target_entropy=config.entropy * config.control.actions,
        replay_buffer_class=FrameReplayBuffer,
        replay_buffer_kwargs={
            "file": pictures,
            "slack": config.save_every + config.worlds,
            "shift": config.shift,
            "colours": config.colours if config.varies else 0.0,
            "seed": config.seed,
            "states": len(config.states),
        },
        states=config.states,
        policy_kwargs={
            "features_extractor_class": Encoder,
            "features_extractor_kwargs": {"architecture": config.architecture},
            "net_arch": list(config.hidden),
            "share_features_extractor": True,
            "normalize_images": False,  # the encoder does
            "states": len(config.states),
        },
        seed=config.seed,
        device=config.device,
    )
    model.set_logger(configure(str(pictures.parent.parent / "tensorboard"), ["tensorboard"]))
    return model


def _check_run(folder: Path) -> None:
    """Raises InputError where a folder has something in it and is no run: a training would delete and replace there."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{folder} is no folder; move it away, or give another --run")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "state").is_dir():
        raise InputError(f"{folder} is no training run (it has no folder state); move it away, or give another --run")


def _as_json(said: dict[str, Any]) -> dict[str, Any]:
    """As it is once it has been written and read."""
    return json.loads(json.dumps(said))


def _check_same(folder: Path, said: dict[str, Any]) -> None:
    """Refuses another config for a run that is there."""
    with damaged(folder / "config.json", "train anew under another name"):
        there = dict(read_json(folder / "config.json"))
        there["road"]
    new = [name for name in said if name not in there]
    if new:
        raise InputError(f"{folder} was trained by an earlier version, which had no {new[0]}; give another --run")
    if there["road"] != said["road"]:
        raise InputError(
            f"{folder} was trained before the scene was built anew, its task or obstacles changed, or twin draws "
            "episodes otherwise; give another --run"
        )
    for name in said:
        if name != "steps" and there.get(name) != said[name]:
            raise InputError(
                f"{folder} was trained with {name} = {there.get(name)!r}, not {said[name]!r}; "
                "go on with the same, or give another --run"
            )


class _Keeper(BaseCallback):
    """Writes down what happens, and saves."""

    def __init__(
        self,
        folder: Path,
        config: TrainConfig,
        said: dict[str, Any],
        twin: Twin,
        wall: float,
        resumed: int,
        watch: Callable[[Progress], None] | None,
        stop: StopNotice,
    ) -> None:
        super().__init__()
        self.model: PixelSAC
        self._folder, self._config, self._scene, self._watch = folder, config, twin.scene.root.resolve().name, watch
        self._said = said
        self._wall, self._resumed, self._started = wall, resumed, time.monotonic()
        self._stop = stop

    @property
    def wall(self) -> float:
        """Of the whole training [s]."""
        return self._wall + time.monotonic() - self._started

    def _on_training_start(self) -> None:
        # Not before: by now the worlds have begun, so that all that was asked for is there.
        write_json(self._folder / "config.json", self._said)
        self._saved = self._first = self.model.num_timesteps
        self._first_updates = self.model._n_updates
        self._recent: list[bool] = _keep_rows(self._folder / "episodes.csv", EPISODE_COLUMNS, self._saved)[-RECENT:]
        _keep_rows(self._folder / "log.csv", LOG_COLUMNS, self._saved)

    def _on_rollout_start(self) -> None:
        # Here, and not in _on_step, all that was collected is in the buffer.
        if self._stop.number or self.model.num_timesteps - self._saved >= self._config.save_every:
            self.save()
        if self._stop.number:
            raise Stopped(self._stop.number)
        self._checkpoint()

    def _on_step(self) -> bool:
        rows = []
        for info in (one for one in self.locals["infos"] if "episode" in one):
            if not info["start"]:
                self._recent = [*self._recent, info["is_success"]][-RECENT:]
            rows.append(
                (
                    *(self.model.num_timesteps, f"{self.wall:.1f}", info["episode_seed"], info["lighting"]),
                    *(int(info["is_success"]), info["cause"], f"{info['progress']:.2f}"),
                    *(info["episode"]["l"], f"{info['episode']['r']:.3f}", f"{info['start']:.2f}"),
                )
            )
        _append(self._folder / "episodes.csv", rows)
        if self._watch:
            self._watch(Progress(self.model.num_timesteps, tuple(self._recent)))
        return True

    def end(self) -> None:
        """When all steps are done."""
        self._checkpoint()
        self.save()

    def save(self) -> None:
        """Everything; nothing where nothing was done since."""
        if self.model.num_timesteps == self._saved:
            return
        model, elapsed = self.model, max(time.monotonic() - self._started, 1e-9)
        logged = model.logger.name_to_value
        row = (
            *(model.num_timesteps, f"{self.wall:.1f}", model._n_updates),
            f"{(model.num_timesteps - self._first) / elapsed:.2f}",
            f"{(model._n_updates - self._first_updates) / elapsed:.2f}",
            round(resident() / 2**20),
            *(f"{logged.get(f'train/{name}', float('nan')):.4g}" for name in ("ent_coef", "value")),
        )
        _append(self._folder / "log.csv", [row])
        self._save_policy(self._folder)
        save_state(self._folder / "state", model, {"wall": self.wall, "resumed": self._resumed})
        self._saved = model.num_timesteps

    def _checkpoint(self) -> None:
        """Keeps a policy, if one is due."""
        every = self._config.steps / self._config.checkpoints
        number = int(self.model.num_timesteps / every)
        if number and self.model.num_timesteps - number * every < self._config.worlds:
            self._save_policy(self._folder / "checkpoints" / f"{self.model.num_timesteps:09d}")

    def _save_policy(self, folder: Path) -> None:
        c = self._config
        trained = {
            "scene": self._scene,
            "run": self._folder.name,
            "task": c.task,
            "observe": c.observe,
            "lighting": c.lighting,
            "seed": c.seed,
            "step": self.model.num_timesteps,
        }
        save_policy(folder, c.architecture, c.control, actor_weights(self.model, c.architecture), trained)


def _append(path: Path, rows: list[tuple]) -> None:
    if rows:
        with path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


def _keep_rows(path: Path, columns: tuple[str, ...], steps: int) -> list[bool]:
    """Makes a table, or drops what was written after the save; the successes of whole episodes among what is kept."""
    rows: list[list[str]] = []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            # A line that was being written when the training was killed is not whole.
            rows = [row for row in list(csv.reader(file))[1:] if len(row) == len(columns) and int(row[0]) <= steps]
    write_text(path, csv_text(columns, rows))
    if "success" not in columns:
        return []
    success, start = columns.index("success"), columns.index("start_m")
    return [row[success] == "1" for row in rows if float(row[start]) == 0.0]
