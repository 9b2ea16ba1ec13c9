"""Which of a training's policies is its best; the last need not be.

When all steps are done, *candidates*, policies saved in the second half, drive the same episodes without exploring.
These are whole episodes of the kind that was trained on, in its lights and with its robots, of seeds of their own. The
one that arrives most often is the run's policy; of those alike, the one that earns most. Because the best of several
was lucky, too, it drives *fresh* episodes at the end, and its rate in training is told of these alone.
"""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from twin import progress
from twin.env.batch import worlds_of
from twin.files import damaged, read_json, write_json
from twin.learn.judging import Driven, episodes
from twin.learn.policy import copy_policy, load_policy
from twin.learn.state import saved_steps
from twin.learn.train_config import TrainConfig
from twin.loading import Twin
from twin.report.training import CHOICE

FRESH = 20
"""Episodes that the chosen one drives at the end."""

_CANDIDATES = 4
_STREAM = 7  # with a run's seed, what the seeds of these episodes are drawn from


def choose(twin: Twin, folder: Path, config: TrainConfig, processes: int | None = None) -> dict[str, Any]:
    """Makes the best policy of a finished training the run's; does nothing where that is done.

    Args:
        twin: What was trained in.
        folder: Of the run.
        config: Of the run; `trials` is the number of episodes each candidate drives.
        processes: See `worlds_of`.

    Returns:
        What `choice.json` holds: steps that were trained; for every candidate its step, trials, successes and mean
        reward; step, trials and successes of the chosen one, of fresh episodes.
    """
    trained = saved_steps(folder / "state")
    if (folder / CHOICE).exists():
        with damaged(folder / CHOICE, "delete it, and the best policy is chosen again"):
            before = read_json(folder / CHOICE)
            if before["steps"] == trained:
                _ = [before["chosen"][name] + 0 for name in ("step", "trials", "successes")]
                return before
    candidates = _candidates(folder / "checkpoints", trained)
    drawn = np.random.SeedSequence([config.seed, _STREAM]).generate_state(config.trials + FRESH)
    seeds = tuple(int(seed) for seed in drawn)
    shared, fresh = seeds[: config.trials], seeds[config.trials :]
    options = {**config.options(), "start_along": 0.0}
    tried = []
    bar = progress.bar("choose", len(candidates) * len(shared) + len(fresh), "episode")
    with closing(worlds_of(twin, config.task, options, [None] * config.worlds, processes)) as worlds, bar:

        def told(path: Path, which: tuple[int, ...]) -> dict[str, Any]:
            return {"step": int(path.name)} | _summed(episodes(load_policy(path), worlds, which, bar.update))

        for path in candidates:
            tried.append(told(path, shared))
        best = max(range(len(tried)), key=lambda i: (tried[i]["successes"], tried[i]["reward"]))
        last = told(candidates[best], fresh)
    copy_policy(candidates[best], folder)
    out = {"steps": trained, "candidates": tried, "chosen": last}
    write_json(folder / CHOICE, out)
    return out


def _candidates(folder: Path, steps: int) -> list[Path]:
    """Of the second half, as far apart as gives few enough; the last one always."""
    late = sorted(path for path in folder.iterdir() if steps / 2 < int(path.name))
    return late[:: -max(1, -(-len(late) // _CANDIDATES))][::-1]


def _summed(driven: list[Driven]) -> dict[str, Any]:
    won = sum(one.cause == "goal" for one in driven)
    return {"trials": len(driven), "successes": won, "reward": round(float(np.mean([d.reward for d in driven])), 3)}
