"""Verb: a policy that drives a task of a built scene, learned from pixels.

    python -m twin.train scenes/demo --task straight --run first
    python -m twin.train scenes/demo --task straight --run plain --observe simulator
    python -m twin.train scenes/demo --task straight --run day --lighting sun

The same command goes on with a run that was stopped or killed. The policy is in `runs/<name>` of the scene's folder.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin import cli, runtime
from twin.errors import InputError
from twin.evaluation.statistics import wilson
from twin.loading import Twin, load_scene
from twin.runtime import alone
from twin.scene import SceneDir, finished, run_folder

if TYPE_CHECKING:
    from twin.learn.train_config import TrainConfig


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    return cli.run(_parser(), _main, arguments)


def _main(given: argparse.Namespace) -> None:
    from twin.evaluation.training_curves import success_curve
    from twin.learn.train_config import PRESETS, TrainConfig

    names = {field.name for field in dataclasses.fields(TrainConfig)}
    asked = {k: v for k, v in vars(given).items() if k in names and v is not None}
    config = TrainConfig(**{**PRESETS[given.preset], **asked})
    folder = run_folder(SceneDir(given.scene), given.run)
    twin = load_scene(given.scene)
    finished(twin.scene, "mjcf")  # before the run's folder is made
    with alone(folder.with_name(f".{folder.name}.lock"), f"{folder} is being trained"):
        chosen = _trained(twin, folder, config, given.processes)
    picture = success_curve(folder)
    if not given.quiet:
        won, trials = chosen["successes"], chosen["trials"]
        low, high = wilson(won, trials)
        print(
            f"{folder}: the policy of step {chosen['step']}, which without exploring arrives in {won} of {trials} "
            f"episodes like those of the training ({low:.2f} to {high:.2f}); success along it: {picture}"
        )


def _trained(twin: Twin, folder: Path, config: "TrainConfig", processes: int | None) -> dict[str, Any]:
    """Trains under a bar; returns what the best of the late policies did."""
    try:
        from twin.learn import training
        from twin.learn.policy_evaluation import select_checkpoint
    except ImportError as error:
        raise InputError(f"training needs more: pip install .[learn] ({error})") from None

    with runtime.bar("train", config.steps, "step") as bar:

        def watch(now: training.Progress) -> None:
            if not bar.n:  # what was trained before was not trained in this time
                bar.initial = bar.n = bar.last_print_n = now.steps
            bar.update(now.steps - bar.n)
            if now.recent:
                low, high = wilson(sum(now.recent), len(now.recent))
                bar.set_postfix_str(
                    f"success {sum(now.recent)}/{len(now.recent)} ({low:.2f} to {high:.2f})", refresh=False
                )

        training.train(twin, folder, config, watch, processes)
    return select_checkpoint(twin, folder, config, processes)["chosen"]


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(prog="python -m twin.train", description="Train a policy by SAC from pixels.")
    parser.add_argument("scene", type=Path, help="folder of a built scene")
    parser.add_argument("--task", default="straight", help="straight, right_turn, route, or one of scene.toml")
    parser.add_argument("--run", required=True, help="name of the run, a folder in SCENE/runs")
    parser.add_argument("--observe", choices=("nerf", "simulator"), help="what is seen; the field (nerf) unless given")
    parser.add_argument("--lighting", help="one lighting by name; it varies between episodes unless given")
    parser.add_argument("--preset", choices=("cpu", "gpu"), default="cpu", help="sizes; cpu unless given")
    parser.add_argument("--action", choices=("steering", "twist"), help="steering at fixed speed unless given")
    parser.add_argument("--steps", type=int, help="control steps of all worlds together")
    parser.add_argument("--worlds", type=int, help="how many are driven at once")
    parser.add_argument("--processes", type=int, help="that step the worlds; as many as pay unless given")
    parser.add_argument("--updates", type=float, help="of the networks per step")
    parser.add_argument("--steering", type=float, help="share of a step's worth that full steering costs")
    parser.add_argument("--entropy", type=float, help="of each number of an action [nat]; more explores more")
    parser.add_argument("--colours", type=float, help="strength of random weather in updates; 1 where lighting varies")
    parser.add_argument("--seed", type=int, help="of everything drawn")
    parser.add_argument(
        "--randomise",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="another robot in every episode and, where the lighting varies, weather and bystanders (the default)",
    )
    parser.add_argument(
        "--privileged",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="critics are told where the robot is (the default); the policy never is",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    return parser


if __name__ == "__main__":
    sys.exit(main())
