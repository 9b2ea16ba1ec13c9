"""Tests of a training's policies, from the run's files: the curve of their success, and each policy's result."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.evaluation.statistics import rate_summary, wilson
from twin.files import digest_file, is_file, read_json, wrap_read_errors
from twin.scene import SceneDir
from twin.types import Array

TESTS_FILE, CHOICE_FILE = "tests.json", "choice.json"
"""Files of a run: its tests so far; and, once it has ended, the selection of its policy, with all tests. See
`learn/selection.py`."""

TestCount = tuple[int, int, int]
"""A test: the step at which its policy was saved, the number of successes, and that of episodes."""

_CHOOSE_AGAIN = "delete it, and the best policy is selected again"
_MAX_COUNT = 10**12  # largest number of steps or episodes


def training_summaries(root: Path, policies: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Summarizes the trainings of those policies in `runs/` that are unchanged since their validation.

    Args:
        root: The scene folder.
        policies: Names, `run` or `run/checkpoint`.

    Returns:
        A JSON-able dict for each policy: its run; the step at which it was saved; the training's task, observe and
        lighting; and `test`, its result in the training: the `rate_summary` of the run's final test if that tested this
        policy (with `final` true and the episodes' condition), or else of an earlier test of it, or None.
    """
    digests = validated_digests(root)
    out = {}
    for policy in policies:
        run, _, checkpoint = policy.partition("/")
        folder = root / "runs" / run
        head = (folder / "checkpoints" / checkpoint if checkpoint else folder) / "policy.json"
        if not is_file(head) or digest_file(head) != digests.get(policy):
            continue
        with wrap_read_errors(head, "copy the whole run again"):
            trained = dict(read_json(head).get("trained", {}))
            if "step" not in trained:
                continue
            at = int(trained["step"])
        earlier = {
            step: {"final": False, "condition": "", **rate_summary(won, trials)}
            for step, won, trials in read_test_counts(folder)
        }
        final = _final_test(folder)
        out[policy] = {
            "run": run,
            "step": at,
            **{key: trained.get(key, "") for key in ("task", "observe", "lighting")},
            "test": final[1] if final and final[0] == at else earlier.get(at),
        }
    return out


def _final_test(folder: Path) -> tuple[int, dict[str, Any]] | None:
    """A run's final test: step of the policy, and its entry in `training_summaries`; None if there was none."""
    path = folder / CHOICE_FILE
    if not is_file(path):
        return None
    with wrap_read_errors(path, _CHOOSE_AGAIN):
        chosen = dict(read_json(path)["chosen"])
        step, won, trials = _count(chosen)
        condition = str(chosen.get("condition", ""))  # older runs do not store it
        return step, {"final": True, "condition": condition, **rate_summary(won, trials)}


def _count(test: dict[str, Any]) -> TestCount:
    step, won, trials = (test[name] for name in ("step", "successes", "trials"))
    if not all(isinstance(value, int) and 0 <= value <= _MAX_COUNT for value in (step, won, trials)):
        raise ValueError(f"step {step!r}: {won!r} successes in {trials!r} trials; expected whole numbers")
    if won > trials or not trials:
        raise ValueError(f"{won} successes in {trials} trials")
    return step, won, trials


def validated_digests(root: Path) -> dict[str, Any]:
    """Digests of a scene's validated policies by name; empty if nothing was validated yet."""
    record = SceneDir(root).validation / "validated.json"
    if not record.exists():
        return {}
    with wrap_read_errors(record, f"move {record.parent} away and validate again"):
        return dict(read_json(record)["policies"])


def read_test_counts(folder: Path) -> list[TestCount]:
    """The tests of a run so far, by step; empty if it had none yet. Raises InputError: a file is damaged."""
    for name, key, cure in (
        (CHOICE_FILE, "candidates", _CHOOSE_AGAIN),
        (TESTS_FILE, "", "delete it, and the policies are tested again"),
    ):
        path = folder / name
        if is_file(path):
            with wrap_read_errors(path, cure):
                contents = read_json(path)
                tests = contents[key] if key else contents
                if not isinstance(tests, list):
                    raise ValueError("expected a list of tests")
                return sorted(_count(dict(one)) for one in tests)
    return []


def plot_tests(axes: Axes, tests: Sequence[TestCount], color: str) -> None:
    """Plots the success rates of one test or more over steps, with their intervals."""
    steps, won, trials = np.array(sorted(tests), float).T
    _plot_rates(axes, steps, won, trials, fmt="o-", color=color, label=f"tests, {range_text(trials)} episodes each")


def _plot_rates(axes: Axes, steps: Array, won: Array, trials: Array, **look: Any) -> None:
    rates, (low, high) = won / trials, wilson(won, trials)
    lengths = np.maximum(0.0, [rates - low, high - rates])  # rounding could make a length negative
    axes.errorbar(steps, rates, lengths, capsize=3, elinewidth=0.8, markersize=4, **look)


def range_text(counts: Iterable[float]) -> str:
    """Smallest and largest of some whole numbers, as "5 to 6" or "5"."""
    ends = sorted(map(int, counts))
    return " to ".join(map(str, dict.fromkeys((ends[0], ends[-1]))))


def write_success_curve(folder: Path) -> Path:
    """Writes `success.png` to a run's folder: success in its tests with 90 % intervals, and in its final test."""
    path = folder / "success.png"
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    if tests := read_test_counts(folder):
        plot_tests(axes, tests, "#1f77b4")
    if final := _final_test(folder):
        step, test = final
        at = (np.array([value], float) for value in (step, test["successes"], test["trials"]))
        label = f"the kept policy in {test['trials']} new episodes"
        _plot_rates(axes, *at, fmt="s", color="#d95f02", label=label)
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    axes.set(xlabel="steps of all environments", ylabel="success rate, 90 % interval", ylim=(-0.04, 1.04))
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path
