"""The verb that tells what success in the twin says about success on the road.

    python -m twin.forecast SCENE [--real results.csv]

reads `validation/episodes.csv`, which `twin.validate` wrote, and the user's real trials, and writes `forecast.json`,
`forecast.csv` and `forecast.html` to `<SCENE>/forecast`. Without real trials it ranks the policies in the twin, and
says what that leaves open.
"""

import argparse
import sys
from pathlib import Path

from twin import cli
from twin.errors import InputError
from twin.evaluation.forecasting import Estimate, Forecast
from twin.evaluation.trials import RESULT_COLUMNS, read_results, read_trials, tally
from twin.files import write_text
from twin.scene import SceneDir


def forecast(root: Path, real: Path | None = None, seed: int = 0) -> Forecast:
    """Computes and writes the forecast of the scene at `root`; see the module.

    Args:
        root: The scene folder.
        real: `results.csv`; None: no real trials.
        seed: Of the resampling; the same seed gives the same forecast.

    Raises:
        InputError: nothing validated, or a table that is wrong; nothing is written then.
    """
    from twin.evaluation.forecasting import make_forecast
    from twin.evaluation.training_curves import trainings
    from twin.report.forecast_report import write_forecast_page
    from twin.report.forecast_summary import candidates_csv

    scene = SceneDir(root)
    if not root.is_dir():
        raise InputError(f"{root} is no folder; give the scene's folder, such as scenes/demo")
    twin = tally(read_trials(scene.episodes_csv))
    cells = read_results(real, twin) if real else []
    trained = {
        (policy, told["task"]): Estimate(told["rate"], told["low"], told["high"], told["trials"])
        for policy, told in trainings(root, {cell.policy for cell in twin}).items()
        if told["trials"]
    }
    out = make_forecast(root.resolve().name, twin, cells, seed, trained)
    out.save(scene.forecast)
    write_text(scene.forecast / "forecast.csv", candidates_csv(out))
    write_forecast_page(out, scene.forecast)
    return out


_EPILOG = f"""\
results.csv, one line per policy and lighting:

  {",".join(RESULT_COLUMNS)}
  first,morning,10,8
  first,dusk,10,6

Names are those of validation/episodes.csv. Where a policy was validated on several tasks, add a column task. Light that
the twin does not know by name is compared with one that it does, named in a column twin_lighting, such as
held-out+randomised.
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    parser = cli.Parser(
        prog="python -m twin.forecast",
        description="What success in the twin says about success on the road.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", type=Path, help="folder of a scene with validated policies")
    parser.add_argument("--real", type=Path, metavar="CSV", help="trials on the road; see below")
    parser.add_argument("--seed", type=int, default=0, help="of the resampling (default 0)")
    parser.add_argument("--quiet", action="store_true", help="no summary")
    return cli.run(parser, _main, argv)


def _main(options: argparse.Namespace) -> None:
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: expected 0 or more")
    out = forecast(options.scene, options.real, options.seed)
    if not options.quiet:
        from twin.report.forecast_summary import summary

        print(summary(out))
        print(f"look at {SceneDir(options.scene).forecast / 'forecast.html'}")


if __name__ == "__main__":
    sys.exit(main())
