"""Benchmark records do not lose entries, and the figures of Table 1 follow from its record."""

import copy
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from place_intervals import rate_over_days

from twin.errors import InputError
from twin.evaluation.statistics import wilson

ROOT = Path(__file__).parents[1]
TABLE1 = ROOT / "benchmarks" / "table1"


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.syspath_prepend(str(TABLE1))


@pytest.fixture
def results() -> dict:
    return json.loads((TABLE1 / "results.json").read_text(encoding="utf-8"))


# ---- records


def test_a_record_with_more_entries_is_kept(scripts, tmp_path):
    from record import write_record

    file = tmp_path / "figures.json"
    full = {"a": 1.0, "rows": [{"id": "B5", "value": 1.0}, {"id": "B5", "value": 2.0}, {"id": "C1", "value": 3.0}]}
    write_record(file, full)
    write_record(file, full | {"a": 2.0, "b": 3.0})  # other values, and more of them
    kept = file.read_bytes()
    assert json.loads(kept)["a"] == 2.0
    fewer = copy.deepcopy(full) | {"b": 3.0}
    fewer["rows"].pop(1)
    for less, name in (({"a": 1.0, "b": 3.0}, "rows"), (fewer, "rows[B5 #2]"), (full, "b")):
        with pytest.raises(InputError) as refused:
            write_record(file, less)
        assert f"({name})" in str(refused.value) and "--replace-record" in str(refused.value)
        assert file.read_bytes() == kept
        assert json.loads((tmp_path / "figures.json.partial").read_text()) == less  # the new figures are kept, too
    write_record(file, {"b": 3.0}, replace=True)
    assert json.loads(file.read_text()) == {"b": 3.0} and [path.name for path in tmp_path.iterdir()] == [file.name]


def test_fewer_trials_and_null_figures_count_as_lost(scripts):
    from record import lost

    old = {"policies": [{"policy": "p", "real": {"trials": 10, "successes": 3}}], "mmrv": 0.1}
    assert lost(old, copy.deepcopy(old)) == []
    assert lost(old, {"policies": [{"policy": "p", "real": {"trials": 20, "successes": 3}}], "mmrv": 0.0}) == []
    new = {"policies": [{"policy": "p", "real": {"trials": 5, "successes": 3}}], "mmrv": None}
    assert lost(old, new) == ["policies[p].real.trials (5 instead of 10)", "mmrv"]
    assert lost({"worlds": 1000, "quick": False}, {"worlds": 10, "quick": True}) == [
        "worlds (10 instead of 1000)",
        "quick (True instead of False)",
    ]
    assert lost({"worlds": 10, "quick": True}, {"worlds": 1000, "quick": False}) == []
    assert lost(old, {"policies": [], "mmrv": 0.1}) == ["policies[p]"]
    assert lost(old, []) == ["all of it"]


def test_other_files_are_kept_and_non_finite_figures_become_null(scripts, tmp_path, capsys):
    from record import save, write_so_far

    file = tmp_path / "notes.json"
    file.write_text("my notes")
    assert save(file, {"a": 1.0}) == 2
    err = capsys.readouterr().err
    assert "is not a record of figures" in err and err.count("\n") == 1 and file.read_text() == "my notes"
    other = tmp_path / "other.json"
    write_so_far(other, {"a": 1.0})
    assert not other.exists()
    assert save(other, {"a": float("nan"), "b": [float("inf")]}) == 0
    assert json.loads(other.read_text()) == {"a": None, "b": [None]}
    assert save(None, {}) == 0


def run(*arguments: str | Path) -> subprocess.CompletedProcess:
    command = [sys.executable, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def test_table_1_without_runs_keeps_its_record(tmp_path, results):
    record, scene = tmp_path / "results.json", tmp_path / "scene"
    record.write_bytes((TABLE1 / "results.json").read_bytes())
    scene.mkdir()
    done = run(TABLE1, scene, "--steps", "--results", record)
    assert done.returncode == 2 and done.stdout == ""
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "runs[straight simulator 0]" in errors[0] and errors[0].endswith("give another file")
    assert json.loads(record.read_text()) == results
    assert run(TABLE1, scene, "--steps", "--results", record, "--replace-record").returncode == 2  # no such option
    assert json.loads(record.read_text()) == results
    other = tmp_path / "other.json"
    assert run(TABLE1, scene, "--steps", "--results", other).returncode == 0
    assert json.loads(other.read_text())["runs"] == []


def test_a_partial_run_does_not_overwrite_a_record(tmp_path):
    file = tmp_path / "husky.json"
    script = ROOT / "benchmarks" / "husky.py"
    assert run(script, "--only", "A1", "B5", "--json", file).returncode == 0
    kept = file.read_bytes()
    done = run(script, "--only", "A1", "--json", file)
    assert done.returncode == 2 and "rows[B5" in done.stderr and file.read_bytes() == kept


def test_places_and_checks_that_ran_before_stay_in_their_records(scripts, tmp_path, monkeypatch, capsys):
    import cameras
    import robustness

    monkeypatch.setattr(cameras, "_run", lambda *_: "")
    monkeypatch.setattr(cameras, "measure", lambda folder: {"rms_m": 0.01})
    file = tmp_path / "cameras.json"
    for places, status in ((("7", "8"), 0), (("7",), 2)):
        monkeypatch.setattr(sys, "argv", ["cameras", str(tmp_path), "--places", *places, "--json", str(file)])
        assert cameras.main() == status
        assert [row["name"] for row in json.loads(file.read_text())["places"]] == ["place_7", "place_8"]
    assert "has entries that the new record lacks (places[place_8])" in capsys.readouterr().err
    file = tmp_path / "robustness.json"
    for name, status in (("endurance", 0), ("disk", 2)):
        monkeypatch.setattr(robustness, name, lambda *_, name=name: {name: 1, "ok": True})
        monkeypatch.setattr(sys, "argv", ["robustness", name, "--json", str(file)])
        assert robustness.main() == status and "endurance" in json.loads(file.read_text())


# ---- Table 1's scores


def test_days_not_used_during_development_come_first_and_match_the_docs(scripts, results):
    import scores

    (first, unseen), *_ = scores.GROUPS.items()
    assert unseen == tuple(f"day_{k}" for k in range(6, 16)) and "not used during development" in first
    policies = scores.policy_records(results)
    twin, rule = (scores.scores(name, policies, unseen) for name in list(scores.PREDICTORS)[::2])
    assert (round(twin.spearman, 2), round(twin.pearson, 2), round(twin.mmrv, 3)) == (0.78, 0.98, 0.084)
    assert (round(rule.spearman, 2), round(rule.pearson, 2), round(rule.mmrv, 3)) == (0.77, 0.97, 0.143)
    everything = list(scores.GROUPS.values())[-1]
    assert len(everything) == 20
    assert scores.scores("rule without the twin", policies, everything).cells == pytest.approx(694 / 720)
    full = scores.scores("twin, by a photo of each day", policies, everything)
    # As twin.forecast computed them from the same trials when they were driven.
    assert (full.spearman, full.pearson) == pytest.approx((0.9176822780383173, 0.9868110006517439))
    assert (full.mmrv, full.cells, full.regret) == pytest.approx((0.02791666666666667, 0.9375, 0.005))
    assert full.corrected == (32, 36)
    drawn = list(scores.GROUPS.values())[1]
    assert scores.finals(policies, "varied", "straight", drawn) == "1.00 [0.85, 1.00], 150/150"
    assert scores.finals(policies, "varied", "right_turn", drawn) == "0.99 [0.84, 1.00], 149/150"
    text = scores.tables(results)
    assert text.index(first) < text.index("half of them used during development")
    docs = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8").split("## Table 1")[1]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    headline = "| **days 6 to 15: twin, by a photo of each day** | **0.78** (0.51 to 0.95) | **0.98** (0.93 to 0.99) |"
    assert docs.index(headline) < docs.index("0.92 (0.81 to 0.98)")
    ends = {name: tuple(round(end, 2) for end in twin.intervals[name]) for name in ("spearman", "pearson", "mmrv")}
    assert ends == {"spearman": (0.51, 0.95), "pearson": (0.93, 0.99), "mmrv": (0.03, 0.14)}
    page = (ROOT / "docs" / "forecast.md").read_text(encoding="utf-8")
    assert "Spearman of 0.78" in page and "benchmarks/table1/scores.py" in page
    assert "| 0.78 / 0.98 / 0.084 |" in readme and "| 0.77 / 0.97 / 0.143 |" in readme


def test_the_rule_does_not_depend_on_the_twin(scripts, results):
    import scores

    policies = scores.policy_records(results)
    assert {scores.rule(p) for p in policies} == {0.0, 1.0}
    kinds = {(p.setup == "varied", p.trained >= 0.49): scores.rule(p) for p in policies}
    assert kinds == {(True, True): 1.0, (True, False): 0.0, (False, True): 0.0, (False, False): 0.0}
    for run_ in results["runs"]:
        for policy in run_["policies"]:
            for part in ("validate_by_photo", "validate_randomised"):
                policy[part]["successes"] = policy[part]["trials"]
                for cell in policy[part]["by_lighting"].values():
                    cell["successes"] = cell["trials"]
    days = next(iter(scores.GROUPS.values()))
    rule, twin = "rule without the twin", "twin, by a photo of each day"
    changed = scores.policy_records(results)
    assert scores.scores(rule, changed, days) == scores.scores(rule, policies, days)
    assert scores.scores(twin, changed, days).spearman is None  # the twin's rates are all equal


def test_too_few_policies_or_days_have_no_scores(scripts, results):
    import scores

    policies = scores.policy_records(results)
    assert scores.scores("twin, by a photo of each day", policies[:4], ("dawn",)) is None
    assert scores.scores("twin, by a photo of each day", policies, ("dawn", "unknown")) is None
    assert scores.over_days([]) == scores.over_days([{}]) == "–"
    assert "–" in scores.tables({"runs": []})


def test_table_1_s_real_rates_have_intervals_over_days(scripts, results):
    from results import table

    rows = [line for line in table(results).splitlines() if line.startswith("| ours | one_light")]
    assert len(rows) == 1 and "0.05 [0.01, 0.20], 15/250" in rows[0]


# ---- rates over days


def test_trials_of_a_day_count_as_one_sample():
    assert rate_over_days([1.0] * 20) == (1.0, pytest.approx(0.8808, abs=1e-4), 1.0)
    mean, low, high = rate_over_days([1.0] + [0.0] * 19)
    assert (mean, low, high) == pytest.approx((0.05, *wilson(1, 20)))
    assert rate_over_days([0.5, 0.5]) == pytest.approx((0.5, *wilson(1, 2)))
    for wrong in ([], [1.5], [float("nan")], [[0.5]]):
        with pytest.raises(ValueError, match="one in"):
            rate_over_days(wrong)


def test_intervals_over_days_cover_correlated_trials_and_those_over_trials_do_not():
    rng = np.random.default_rng(0)
    rate, days, trials = 0.7, 20, 10
    by_day, by_trial = [], []
    for _ in range(400):
        won = rng.binomial(trials, np.where(rng.random(days) < rate, 1.0, 0.0))
        _, low, high = rate_over_days(won / trials)
        by_day.append(low <= rate <= high)
        low, high = wilson(won.sum(), days * trials)
        by_trial.append(bool(low <= rate <= high))
    assert np.mean(by_day) > 0.86 and np.mean(by_trial) < 0.7


# ---- predictions of single days


def test_on_unseen_days_the_twin_s_log_score_is_better_than_every_baseline(scripts, results):
    import scores

    policies = scores.policy_records(results)
    each = scores.day_scores(policies, next(iter(scores.GROUPS.values())))
    twin = each.pop(scores.TWIN)
    assert (round(twin.brier, 3), round(twin.log, 3)) == (0.035, 0.127)
    corrected = each.pop("the twin, recalibrated on other trainings")
    assert abs(corrected.gain) < 0.01  # it needs no recalibration
    for name, one in each.items():
        assert one.gain == pytest.approx(one.log - twin.log) and one.interval[0] > 0.0, name
    assert round(each["the rule"].gain, 3) == 0.065


def test_baselines_do_not_look_at_the_twin_nor_at_their_own_training(scripts, results):
    import scores

    policies = scores.policy_records(results)
    days = next(iter(scores.GROUPS.values()))
    _, before = scores.probabilities(policies, days)
    mine = [i for i, p in enumerate(policies) if p.name.startswith("straight_varied_0")]
    for i in mine:  # all trials of one training end the other way, and the twin predicts 0
        p = policies[i]
        policies[i] = scores.PolicyRecord(
            p.name,
            p.setup,
            p.task,
            p.trained,
            dict.fromkeys(p.twin, (0, 5)),
            0.0,
            {d: (n - k, n) for d, (k, n) in p.real.items()},
        )
    _, after = scores.probabilities(policies, days)
    for name in before:
        if not name.startswith("the twin"):
            assert np.array_equal(before[name][mine], after[name][mine]), name


# ---- comparison of the aligned model with kinematics


def test_the_first_line_compares_both_on_level_ground(scripts):
    spec = importlib.util.spec_from_file_location("benchmark_align", ROOT / "benchmarks" / "align.py")
    align = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(align)

    def held(position: float, yaw: float) -> dict:
        return {"held_out": {"position_m": position, "yaw_deg": yaw}}

    figures = {
        "scores": {
            "fitted": held(0.113, 4.58),
            "icr_kinematics": held(0.178, 6.86),
            "fitted_on_level_ground": held(0.140, 4.66),
        }
    }
    first, second = align.against_kinematics(figures)
    assert (
        first.startswith("level ground") and "0.140 m against 0.178 m (21% better), 4.66° against 6.86° (32%)" in first
    )
    assert "0.113 m against 0.178 m (37% better)" in second
