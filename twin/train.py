"""Verb: trains a policy from pixels on a task of a built scene.

    python -m twin.train scenes/demo --task straight --run first
    python -m twin.train scenes/demo --task straight --run plain --observe simulator
    python -m twin.train scenes/demo --task straight --run day --lighting sun

The same command continues a stopped or killed run. The policy is in `runs/<name>` of the scene's folder.
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
        chosen = _train(twin, folder, config, given.processes)
    picture = write_success_curve(folder)
    write_policy_cards(twin.scene, [given.run])
    if not given.quiet:
        won, trials = chosen["successes"], chosen["trials"]
        low, high = wilson(won, trials)
        print(
            f"{folder}: the policy of step {chosen['step']}, which without exploring arrives in {won} of {trials} "
            f"episodes like those of the training ({low:.2f} to {high:.2f}); success during the training: {picture}"
        )


def _train(twin: Twin, folder: Path, config: "TrainConfig", processes: int | None) -> dict[str, Any]:
    """Trains with a progress bar; returns the evaluation of the selected checkpoint."""
    try:
        from twin.learn import training
    except ImportError as error:
        raise InputError(f"training needs more: pip install .[learn] ({error})") from None

    with runtime.bar("train", config.steps, "step") as bar:

        def watch(steps: int, recent: Sequence[bool]) -> None:
            if not bar.n:  # steps of earlier calls do not count in the rate
                bar.initial = bar.n = bar.last_print_n = steps
            bar.update(steps - bar.n)
            if recent:
                low, high = wilson(sum(recent), len(recent))
                bar.set_postfix_str(f"success {sum(recent)}/{len(recent)} ({low:.2f} to {high:.2f})", refresh=False)

        training.train(twin, folder, config, watch, processes)
    return training.select_checkpoint(twin, folder, config, processes)["chosen"]


main = partial(commands.main, "train")

if __name__ == "__main__":
    sys.exit(main())
