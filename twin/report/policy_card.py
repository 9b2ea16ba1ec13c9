"""Policy cards: a `README.md` in the folder of each run, with front matter in the format of model hubs.

A card says how a policy was trained, and how often it reached the goal in the twin under each lighting and on the real
road. Every number comes from the records of `twin train`, `twin validate` and `twin forecast`; each of these commands
rewrites the card. If measurements are missing, the card names them.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from twin import runtime
from twin.errors import InputError
from twin.evaluation.forecasting import Candidate, Forecast
from twin.evaluation.statistics import CONFIDENCE, rate_summary
from twin.evaluation.training_curves import CHOICE_FILE, validated_digests
from twin.evaluation.trials import Cell, tally, trials_so_far
from twin.files import exists, read_json, wrap_read_errors, write_text
from twin.learn.policy import JSON, Policy, load_policy, policy_digest
from twin.report.forecast_text import format_estimate
from twin.scene import SceneDir

CARD = "README.md"


def write_policy_cards(scene: SceneDir, runs: Iterable[str]) -> list[Path]:
    """Writes the cards of runs and returns their paths.

    Names that do not belong to runs of the scene, such as `module:function`, are skipped. A forecast that cannot be
    read, such as one of an earlier version, is left out, and a line says so. Raises InputError if another record is
    damaged.
    """
    cells = tally(trials_so_far(scene.episodes_csv))
    forecast = None
    if exists(scene.forecast / "forecast.json"):
        try:
            forecast = Forecast.load(scene.forecast)
        except InputError as error:
            runtime.log_line(f"the cards of policies lack the forecast: {error}")
    digests = validated_digests(scene.root)
    written = []
    for run in dict.fromkeys(runs):
        folder = scene.root / "runs" / run
        if not exists(folder / JSON):
            continue
        # If the run was trained further after its validation, the results belong to an earlier policy and are left out.
        same = policy_digest(str(folder)) == digests.get(run)
        mine = [cell for cell in cells if same and cell.policy == run]
        known = [one for one in forecast.candidates if same and one.policy == run] if forecast else []
        path = folder / CARD
        write_text(path, card(load_policy(str(folder)), folder, mine, known))
        written.append(path)
    return written


def card(policy: Policy, folder: Path, cells: Sequence[Cell], known: Sequence[Candidate]) -> str:
    """The card's text, made from a policy, its folder, its results in the twin, and its entries in the forecast."""
    trained, (width, height), control = policy.trained, policy.size, policy.control
    facts = {
        "scene": trained.get("scene"),
        "task": trained.get("task"),
        "lightings": trained.get("lighting"),
        "pictures from": trained.get("observe"),
        "environment steps": f"{trained['step']:,}" if "step" in trained else None,
        "seed": trained.get("seed"),
    }
    rows = [_row(name, value) for name, value in facts.items() if value is not None]
    action = "yaw rate at a constant speed" if control.actions == 1 else "speed and yaw rate"
    sees = f"the last {policy.stack} pictures of {width} × {height} px, {1 / control.control_timestep:g} a second"
    return "\n".join(
        [
            _front_matter(policy, cells),
            f"# {policy.name}",
            "",
            f"A driving policy for a Clearpath Husky. It sees {sees}, and chooses {action}: "
            f"up to {control.speed:g} m/s and {control.yaw_rate:g} rad/s.",
            "",
            "## Training",
            "",
            *(["| | |", "|---|---|", *rows] if rows else ["Unknown."]),
            *_selection(folder),
            "",
            "## In the twin",
            "",
            *_twin_table(cells),
            "",
            "## On the road",
            "",
            *_road_table(known),
            "",
            "## Use",
            "",
            f"`twin film SCENE --policy {policy.name}` films a drive, `twin validate SCENE --policy {policy.name}` "
            "measures success. `policy.onnx` runs on the robot, with `twin_policy` of the same project or with any "
            "ONNX runtime.",
            "",
            "## Limits",
            "",
            "Success in the twin forecasts success on the road; it is not a measurement of it. The rates hold for the "
            "place, route, robot and camera of the twin. Nothing here was tested near people or other traffic.",
            "",
        ]
    )


def _front_matter(policy: Policy, cells: Sequence[Cell]) -> str:
    """YAML front matter in the format of model hubs; strings and numbers are written as JSON, which is valid YAML."""
    lines = ["---", "library_name: twin", "pipeline_tag: reinforcement-learning"]
    lines += [f"tags: {json.dumps(['robotics', 'mujoco', 'husky', 'imitation-learning', 'navigation'])}"]
    if cells:
        lines += ["model-index:", f"- name: {json.dumps(policy.name)}", "  results:"]
    for cell in cells:
        told = f"success of {cell.trials} episodes ({_interval(cell.successes, cell.trials)})"
        lines += [
            "  - task: {type: reinforcement-learning, name: driving}",
            f"    dataset: {{type: twin, name: {json.dumps(f'{cell.task}, {cell.lighting}')}}}",
            f"    metrics: [{{type: success_rate, value: {cell.rate:.4f}, name: {json.dumps(told)}}}]",
        ]
    return "\n".join([*lines, "---", ""])


def _selection(folder: Path) -> list[str]:
    """Lines on how the policy was selected, and on its success in fresh episodes."""
    if not exists(folder / CHOICE_FILE):
        return []
    with wrap_read_errors(folder / CHOICE_FILE, "delete it, and the best policy is selected again"):
        choice = read_json(folder / CHOICE_FILE)
        last, count = choice["chosen"], len(choice["candidates"])
        won, trials = int(last["successes"]), int(last["trials"])
        interval = _interval(won, trials)
        under = f" under `{last['condition']}`" if "condition" in last else ""  # older runs store no condition
    return [
        "",
        f"Selected among {count} tested checkpoints. In fresh episodes{under} it reached the goal "
        f"{won} times of {trials} ({interval}).",
    ]


def _twin_table(cells: Sequence[Cell]) -> list[str]:
    if not cells:
        return ["Not validated: run `twin validate`."]
    out = ["| task | lighting | goal reached | rate |", "|---|---|---|---|"]
    for cell in cells:
        rate = f"{cell.rate:.2f} ({_interval(cell.successes, cell.trials)})"
        out.append(_row(cell.task, cell.lighting, f"{cell.successes} of {cell.trials}", rate))
    return [*out, "", f"Intervals contain the rate of further episodes with {CONFIDENCE:.0%} confidence."]


def _road_table(known: Sequence[Candidate]) -> list[str]:
    driven = [one for one in known if one.driven]
    if not driven:
        predicted = [
            f"- {one.task}: {format_estimate(one.corrected)}" for one in known if one.corrected.value is not None
        ]
        told = ["", "Predicted from other policies that were driven there:", "", *predicted] if predicted else []
        return ["Not driven on the real road.", *told]
    rows = [_row(c.task, c.real.n, format_estimate(c.real), format_estimate(c.twin)) for c in driven]
    return ["| task | trials | rate on the road | rate in the twin |", "|---|---|---|---|", *rows]


def _row(*columns: object) -> str:
    """A row of a Markdown table; in a name, `|` would begin another column."""
    return f"| {' | '.join(str(column).replace('|', chr(92) + '|') for column in columns)} |"


def _interval(successes: int, trials: int) -> str:
    """Interval of a rate, as "0.63 to 0.94"."""
    of = rate_summary(successes, trials)
    return f"{of['low']:.2f} to {of['high']:.2f}"
