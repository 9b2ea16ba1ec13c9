"""`twin train`: trains a policy from pixels on a task of a built scene.

    twin train scenes/demo --task straight --run first

First a teacher learns to drive by the robot's state; from pictures, the policy learns to act like it. A training ends
when the success rate in tests without exploration reaches `--success`, when tests no longer improve, or at `--steps`.
If a run was stopped or killed, the same command continues it. The policy is saved in `runs/<name>` of the scene's
folder.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin import commands, runtime
from twin.config_file import load_config
from twin.env.domain_randomization import condition_options
from twin.env.route_segments import find_task
from twin.errors import InputError
from twin.evaluation.statistics import wilson
from twin.evaluation.training_curves import write_success_curve
from twin.film import film
from twin.loading import Twin, load_writable
from twin.runtime import exclusive_lock
from twin.scene import require_stage, run_folder

if TYPE_CHECKING:
    from twin.learn.selection import PolicyTest
    from twin.learn.train_config import TrainConfig


def command(given: argparse.Namespace) -> None:
    """Runs `twin train` with the options parsed by `twin.commands`."""
    from twin.learn.train_config import PRESETS, TrainConfig, steps_for
    from twin.report.policy_card import write_policy_cards

    names = {field.name for field in dataclasses.fields(TrainConfig)}
    settings = {k: v for k, v in vars(given).items() if k in names and v is not None}
    config = TrainConfig(**{**PRESETS[given.preset], **settings})
    twin = load_writable(given.scene)
    folder = run_folder(twin.scene, given.run)
    require_stage(twin.scene, "mjcf")  # checked before the run's folder is created
    if "steps" not in {**PRESETS[given.preset], **settings}:
        task = find_task(config.task, twin.world(), load_config(twin.scene.config_file).task)
        config = dataclasses.replace(config, steps=steps_for(task.length))
    with exclusive_lock(folder.with_name(f".{folder.name}.lock"), f"{folder} is being trained"):
        choice = _train(twin, folder, config, given.processes, given.wandb)
    picture = write_success_curve(folder)
    write_policy_cards(twin.scene, [given.run])
    if not given.quiet:
        print("\n".join(_summary(folder, choice, picture)))


def _summary(folder: Path, choice: dict[str, Any], picture: Path) -> list[str]:
    from twin.learn.teacher import teacher_result

    chosen = choice["chosen"]
    won, trials = chosen["successes"], chosen["trials"]
    low, high = wilson(won, trials)
    asked = f"required success rate of {choice['success']:.0%}"
    ends = {
        "reached": f"a test reached the {asked}",
        "no better": f"tests got no better, and stayed below the {asked}; more --steps may help",
        "steps": f"tests stayed below the {asked}; give more --steps",
    }
    lines = [
        f"{folder}: trained for {choice['steps']:,} steps: {ends['reached' if choice['reached'] else choice['why']]}",
        f"The policy of step {chosen['step']:,} is kept. In {trials} fresh episodes ({chosen['condition']}) it arrives "
        f"{won} times (rate {won / trials:.2f}, 90 % interval {low:.2f} to {high:.2f}).",
    ]
    taught = teacher_result(folder / "state")
    if taught["successes"] < taught["trials"]:
        lines.append(
            f"Its teacher, which knows where the robot is, arrives only {taught['successes']} times in "
            f"{taught['trials']} episodes; train under another name with more --teacher-steps, or on an easier task."
        )
    if choice["failures"]:
        lines.append(f"Where the kept policy fails: {choice['failures']}.")
    return [*lines, f"Success during the training: {picture}"]


def _train(
    twin: Twin, folder: Path, config: "TrainConfig", processes: int | None, project: str | None
) -> dict[str, Any]:
    """Trains with progress bars; returns the contents of `choice.json`. `project`: name in Weights & Biases."""
    try:
        from twin.learn.selection import earlier_choice, train_until_learnt
        from twin.learn.training import check_device, prepare_folder
        from twin.learn.wandb_run import wandb_run
    except ImportError as error:
        raise InputError(f"training needs further packages: pip install 'twin[learn]' ({error})") from None

    if choice := earlier_choice(twin, folder, config):
        return choice
    check_device(config)
    if project:
        prepare_folder(folder)
    settings = {"scene": twin.scene.root.resolve().name, **dataclasses.asdict(config)}
    logging = wandb_run(project, folder, settings) if project else nullcontext()
    with logging as log, runtime.bar("train (may end earlier)", config.steps, "step") as bar:

        def watch(steps: int, tests: "Sequence[PolicyTest]") -> None:
            if not bar.n:  # the bar's speed must not include the steps of earlier calls
                bar.initial = bar.n = bar.last_print_n = steps
                bar.start_t = bar.last_print_t = time.time()  # nor its time that of the teacher
            bar.update(steps - bar.n)
            if tests:
                bar.set_postfix_str(f"last test {tests[-1].successes}/{tests[-1].trials}", refresh=False)

        choice = train_until_learnt(twin, folder, config, watch, processes, [log] if log else [])
        if log:
            chosen, path = choice["chosen"], folder / "drive.mp4"
            options = condition_options(config.shown_condition)
            _, episode = film(twin.scene.root, config.task, folder.name, config.seed, path, **options)
            caption = f"step {chosen['step']:,}, {episode.lighting}: {episode.cause or 'cut off'}"
            log.show(choice["steps"], write_success_curve(folder), path, caption)
        return choice


if __name__ == "__main__":
    sys.exit(commands.main("train"))
