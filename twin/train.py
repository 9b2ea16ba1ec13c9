"""Verb: trains a policy from pixels on a task of a built scene.

    python -m twin.train scenes/demo --task straight --run first
    python -m twin.train scenes/demo --task straight --run plain --observe simulator
    python -m twin.train scenes/demo --task straight --run day --lighting sun

A training ends when tests without exploration arrive often enough (`--success`), when they get no better, or at
`--steps`. The same command continues a stopped or killed run. The policy is in `runs/<name>` of the scene's folder.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin import commands, runtime
from twin.errors import InputError
from twin.evaluation.statistics import wilson
from twin.loading import Twin, load_writable
from twin.runtime import exclusive_lock
from twin.scene import require_stage, run_folder

if TYPE_CHECKING:
    from twin.learn.train_config import TrainConfig


def command(given: argparse.Namespace) -> None:
    """Runs the verb with the options parsed by `twin.commands`."""
    from twin.evaluation.training_curves import write_success_curve
    from twin.learn.train_config import PRESETS, TrainConfig
    from twin.report.policy_card import write_policy_cards

    names = {field.name for field in dataclasses.fields(TrainConfig)}
    settings = {k: v for k, v in vars(given).items() if k in names and v is not None}
    config = TrainConfig(**{**PRESETS[given.preset], **settings})
    twin = load_writable(given.scene)
    folder = run_folder(twin.scene, given.run)
    require_stage(twin.scene, "mjcf")  # before the run's folder is created
    with exclusive_lock(folder.with_name(f".{folder.name}.lock"), f"{folder} is being trained"):
        choice = _train(twin, folder, config, given.processes)
    picture = write_success_curve(folder)
    write_policy_cards(twin.scene, [given.run])
    if not given.quiet:
        print("\n".join(_summary(folder, choice, picture)))


def _summary(folder: Path, choice: dict[str, Any], picture: Path) -> list[str]:
    chosen = choice["chosen"]
    won, trials = chosen["successes"], chosen["trials"]
    low, high = wilson(won, trials)
    asked = f"{choice['success']:.0%} success that was asked"
    ends = {
        "reached": f"a test reached the {asked}",
        "no better": f"tests got no better, and stayed below the {asked}",
        "steps": f"tests stayed below the {asked}; give more --steps",
    }
    lines = [
        f"{folder}: trained for {choice['steps']:,} steps: {ends[choice['why']]}",
        f"The policy of step {chosen['step']:,} is kept. In {trials} fresh episodes ({chosen['condition']}) it arrives "
        f"{won} times ({low:.2f} to {high:.2f}).",
    ]
    if choice["failures"]:
        lines.append(f"Where the kept policy fails: {choice['failures']}.")
    return [*lines, f"Success during the training: {picture}"]


def _train(twin: Twin, folder: Path, config: "TrainConfig", processes: int | None) -> dict[str, Any]:
    """Trains with progress bars; returns the contents of `choice.json`."""
    try:
        from twin.learn.selection import train_until_learnt
    except ImportError as error:
        raise InputError(f"training needs more: pip install .[learn] ({error})") from None

    with runtime.bar("train, at most", config.steps, "step") as bar:

        def watch(steps: int, recent: Sequence[bool]) -> None:
            if not bar.n:  # steps of earlier calls do not count in the rate
                bar.initial = bar.n = bar.last_print_n = steps
            bar.update(steps - bar.n)
            if recent:
                low, high = wilson(sum(recent), len(recent))
                bar.set_postfix_str(f"success {sum(recent)}/{len(recent)} ({low:.2f} to {high:.2f})", refresh=False)

        return train_until_learnt(twin, folder, config, watch, processes)


main = partial(commands.main, "train")

if __name__ == "__main__":
    sys.exit(main())
