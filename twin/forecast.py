"""`twin forecast`: forecasts success on the real road from success in the twin.

This reads `validation/episodes.csv`, which `twin.validate` writes, and the user's tables of real trials. It writes
`forecast.json`, `forecast.csv` and `forecast.html` to `<SCENE>/forecast`. Without real trials, it only ranks the
policies in the twin.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from twin import commands
from twin.errors import InputError
from twin.evaluation.agreement import Estimate
from twin.evaluation.forecasting import Forecast, make_forecast
from twin.evaluation.training_curves import training_summaries, validated_digests
from twin.evaluation.trials import read_results, read_trials, tally
from twin.files import read_json, wrap_read_errors, write_text
from twin.report.forecast_report import write_forecast_page
from twin.report.forecast_text import candidates_csv, summary_text
from twin.report.policy_card import write_policy_cards
from twin.scene import SceneDir


def forecast(root: Path, real: Sequence[Path] = (), seed: int = 0) -> Forecast:
    """Computes and writes the forecast of a scene.

    Args:
        root: The scene folder.
        real: Results tables of real trials, if any.
        seed: Seed of the sampling from posteriors.

    Raises:
        InputError: nothing has been validated, a table is invalid, or another policy than the validated one drove a
            recorded trial; then nothing is written.
    """
    scene = SceneDir(root)
    if not root.is_dir():
        raise InputError(f"{root} is not a folder; give the scene's folder, such as scenes/demo")
    twin = tally(read_trials(scene.episodes_csv))
    cells = read_results(real, twin)
    _check_policies(root, {cell.policy for cell in cells})
    trained = {
        (policy, row["task"]): Estimate(test["rate"], test["low"], test["high"], test["trials"])
        for policy, row in training_summaries(root, {cell.policy for cell in twin}).items()
        if (test := row["test"])
    }
    result = make_forecast(root.resolve().name, twin, cells, seed, trained)
    result.save(scene.forecast)
    write_text(scene.forecast / "forecast.csv", candidates_csv(result))
    write_forecast_page(result, scene.forecast)
    write_policy_cards(scene, [cell.policy for cell in twin])
    return result


def _check_policies(root: Path, driven: set[str]) -> None:
    """Raises InputError: by its digest, another policy than the validated one drove a recorded trial under its name."""
    validated = validated_digests(root)
    for path in sorted((root / "trials").glob("*/trial.json")):
        with wrap_read_errors(path, "delete it"):
            trial = read_json(path)
            name, digest = trial["name"], trial.get("policy_digest")
        if name in driven and digest and validated.get(name, digest) != digest:
            raise InputError(
                f"{path}: {name} was trained further since this trial; validate the policy that drove, under a name of "
                "its own, or delete this folder, and the trial in the results table"
            )


def command(options: argparse.Namespace) -> None:
    """Runs `twin forecast` with the options parsed by `twin.commands`."""
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: expected 0 or more")
    result = forecast(options.scene, options.real, options.seed)
    if not options.quiet:
        print(summary_text(result))
        print(f"look at {SceneDir(options.scene).forecast / 'forecast.html'}")


if __name__ == "__main__":
    sys.exit(commands.main("forecast"))
