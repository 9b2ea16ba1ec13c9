"""The forecast: its numbers follow from the tables, and statistics that the data do not determine are refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_text import Text
from scipy import stats
from scipy.special import expit

from twin import commands
from twin.config import CAUSES
from twin.errors import InputError
from twin.evaluation.agreement import OTHERS, SHUFFLED, TWIN, Estimate
from twin.evaluation.agreement_intervals import STATISTICS as WITH_INTERVAL
from twin.evaluation.agreement_intervals import jackknife_interval, pair_cells
from twin.evaluation.forecasting import ALL_TASKS, Forecast, make_forecast
from twin.evaluation.rate_model import RateModel, rank_probabilities
from twin.evaluation.statistics import (
    MIN_POLICIES,
    mean_rate,
    mmrv,
    pearson,
    prediction_powered_mean,
    rate_difference,
    spearman,
)
from twin.evaluation.trials import EPISODE_COLUMNS, Cell, Trial, csv_text
from twin.forecast import forecast
from twin.report import forecast_report
from twin.report.figures import lighting_labels
from twin.report.forecast_report import forecast_page
from twin.report.forecast_text import (
    CSV_COLUMNS,
    INTERVALS_NOTE,
    STATISTICS,
    candidates_csv,
    format_estimate,
    format_probability,
    limitations,
    next_trials,
    summary_text,
    verdicts,
)
from twin.report.html import MAX_TABLE_ROWS

LIGHTS = ("held-out", "sun")


def days(n: int = 9, k: int = 5, seed: int = 0, trials: int = 5) -> tuple[list[Cell], list[Cell]]:
    """Cells of the twin and of the road on k days; the twin has a lighting from a photo of each."""
    rng = np.random.default_rng(seed)
    twin, real = [], []
    for i in range(n):
        for day in range(k):
            quality = 6.0 * (i + 0.5) / n - 3.0 + rng.normal(0.0, 1.5)
            twin.append(Cell(f"p{i}", "straight", f"photo{day}", 20, int(rng.binomial(20, expit(quality)))))
            won = int(rng.binomial(trials, expit(2 * quality)))
            real.append(Cell(f"p{i}", "straight", f"day{day}", trials, won, f"photo{day}"))
    return twin, real


def cells(
    n: int = 7, driven: int = 7, tasks: tuple[str, ...] = ("straight",), trials: int = 20, seed: int = 0
) -> tuple[list[Cell], list[Cell]]:
    """Cells of the twin and of the road; the road's dusk is compared with the twin's held-out light."""
    rng = np.random.default_rng(seed)
    twin, real = [], []
    for task in tasks:
        for i in range(n):
            quality = 4.0 * (i + 0.5) / n - 2.0
            for light in LIGHTS:
                twin.append(Cell(f"p{i}", task, light, 50, int(rng.binomial(50, expit(quality + 0.5)))))
                if i < driven:
                    name = "dusk" if light == "held-out" else light
                    won = int(rng.binomial(trials, expit(quality)))
                    real.append(Cell(f"p{i}", task, name, trials, won, light))
    return twin, real


def scene(root: Path, twin: list[Cell]) -> Path:
    """A scene folder with validated policies."""
    trials = [
        Trial(c.policy, c.task, c.lighting, k, "goal" if k < c.successes else CAUSES[1 + k % 5], 10.0, 100, 0.9)
        for c in twin
        for k in range(c.trials)
    ]
    (root / "validation").mkdir(parents=True)
    (root / "validation" / "episodes.csv").write_text(csv_text(EPISODE_COLUMNS, [t.row() for t in trials]))
    return root


def results(path: Path, real: list[Cell]) -> Path:
    rows = [(c.policy, c.lighting, str(c.trials), str(c.successes), c.task, c.twin_lighting) for c in real]
    path.write_text(csv_text(("policy", "lighting", "trials", "successes", "task", "twin_lighting"), rows))
    return path


def test_ranks_in_the_twin_are_by_the_twins_own_prior() -> None:
    """On the road, trials of a day are expected to end alike; in the twin, they are not."""
    rng = np.random.default_rng(1)
    twin = [
        Cell(f"p{i}", "straight", light, 20, int(rng.binomial(20, 0.3 + 0.12 * i)))
        for i in range(6)
        for light in LIGHTS
    ]
    made = make_forecast("road", twin, [replace(c, trials=5, successes=c.successes // 4) for c in twin])
    won = np.array([[c.successes for c in twin if c.policy == f"p{i}"] for i in range(6)])
    model = RateModel.fit(won, np.full(won.shape, 20), shared_days=False)
    expected = rank_probabilities(model.sample(np.random.default_rng(7), 20_000))
    for one in made.candidates:
        assert one.twin_ranks == pytest.approx(expected[int(one.policy[1:])], abs=0.02)


def test_rates_are_those_of_the_tables() -> None:
    twin, real = cells()
    made = make_forecast("road", twin, real)
    found = {c.key: c for c in twin}
    by_twin = [np.mean([found[(f"p{i}", "straight", light)].rate for light in LIGHTS]) for i in range(7)]
    by_real = [np.mean([c.rate for c in real if c.policy == f"p{i}"]) for i in range(7)]
    (group,) = made.groups
    assert (group.policies, group.cells, group.missing) == (7, 14, ())
    assert group.pearson.value == pytest.approx(pearson(twin=by_twin, real=by_real))
    assert group.spearman.value == pytest.approx(spearman(twin=by_twin, real=by_real))
    assert group.mmrv.value == pytest.approx(mmrv(twin=by_twin, real=by_real))
    biases = [c.rate - found[c.twin_key].rate for c in real]
    assert group.bias.value == pytest.approx(np.mean(biases))
    assert [pair.bias.value for pair in made.pairs] == pytest.approx(biases)
    for name, _, _ in STATISTICS[:-1]:
        estimate = getattr(group, name)
        if name == "corrected_coverage":
            assert "policies of 7 other trainings on its task" in estimate.missing
            continue
        assert estimate.value is not None and estimate.n > 0
        assert estimate.low is estimate.high is None  # seven trainings on two days
    assert group.spearman.no_interval == "too few for an interval: 7 trainings, 8 are needed; 2 days, 4 are needed"
    assert (group.trainings, group.days) == (7, 2)
    assert group.twin_error.value == pytest.approx(np.mean(np.abs(np.subtract(by_twin, by_real))))
    first = made.pairs[0]
    assert (first.lighting, first.twin_lighting) == ("dusk", "held-out")
    assert first.real.value == real[0].rate and first.real.low is None
    _, low, high = rate_difference(
        twin_successes=found[real[0].twin_key].successes,
        twin_trials=50,
        real_successes=real[0].successes,
        real_trials=20,
    )
    assert first.within_chance == (low <= 0.0 <= high)


def test_policies_not_driven_are_predicted_from_the_others() -> None:
    twin, real = cells(n=9, driven=7)
    made = make_forecast("road", twin, real)
    further = [c for c in made.candidates if not c.driven]
    assert {c.policy for c in further} == {"p7", "p8"}
    for c in further:
        assert c.corrected.value is not None and c.corrected.n == 7
        # The twin's rates are too high; the correction lowers them.
        assert c.corrected.value < (c.twin.value or 0.0)
    driven = [c for c in made.candidates if c.driven]
    assert all(c.corrected.n == 6 for c in driven)
    (group,) = made.groups
    assert group.mean_real.n == 9 and group.corrected_coverage.missing  # six others are too few for intervals


def test_a_lighting_compared_with_more_days_counts_more_for_policies_not_driven_too() -> None:
    """Three sunny days and one night, on which the road equals the twin: the line is the diagonal."""
    won = {"sun": (20, 24, 30, 34, 38, 44, 48), "night": (2, 10, 4, 16, 8, 12, 20)}
    twin = [Cell(f"p{i}", "straight", light, 50, won[light][i]) for i in range(7) for light in won]
    twin += [Cell(name, "straight", light, 50, won[light][3]) for name in ("new", "other") for light in won]
    days = {"monday": "sun", "tuesday": "sun", "friday": "sun", "friday night": "night"}
    real = [Cell(f"p{i}", "straight", d, 50, won[of][i], of) for i in range(7) for d, of in days.items()]
    made = make_forecast("road", twin, real)
    new = next(c for c in made.candidates if c.policy == "new")
    assert new.twin.value == new.corrected.value == pytest.approx((3 * 34 + 16) / 200)
    over_days = [(3 * won["sun"][i] + won["night"][i]) / 200 for i in range(7)]
    twin_only = [over_days[3]] * 2
    expected = prediction_powered_mean(twin=over_days, real=over_days, twin_only=twin_only).value
    assert made.groups[0].mean_real.value == pytest.approx(expected)


def test_the_table_and_the_verdict_agree_on_the_twins_best_policy() -> None:
    """Three days are compared with held-out lightings, one with its photo: each day counts once, in ranks, too."""
    twin = [Cell("a", "straight", "held-out", 40, 36), Cell("a", "straight", "photo", 40, 4)]
    twin += [Cell("b", "straight", light, 40, 24) for light in ("held-out", "photo")]
    days = {"monday": "held-out", "tuesday": "held-out", "friday": "held-out", "sunday": "photo"}
    real = [Cell(p, "straight", day, 20, won, of) for day, of in days.items() for p, won in (("a", 6), ("b", 12))]
    first, second = make_forecast("road", twin, real).candidates
    assert (first.policy, first.twin.value, second.twin.value) == ("a", pytest.approx(0.7), pytest.approx(0.6))
    assert first.twin_ranks[0] > 0.5
    # The interval knows that only two lightings were seen, although one counts three times.
    two = RateModel.fit(np.array([[36, 4], [24, 24]]), np.full((2, 2), 40)).interval()
    assert (first.twin.low, first.twin.high) == (pytest.approx(two[0][0]), pytest.approx(max(two[1][0], 0.7)))


def two_tasks(hard: tuple[float, ...]) -> tuple[list[Cell], list[Cell]]:
    """Cells of 20 trials of a policy, six policies on four days: all pass the easy task, the hard one as given."""
    twin, real = [], []
    for task, rates in (("easy", (0.9, 0.8, 0.85, 0.95, 1.0, 0.75)), ("hard", (0.3, 0.25, 0.2, 0.15, 0.1, 0.05))):
        order = rates if task == "easy" else hard
        for i in range(6):
            for day in "abcd":
                twin.append(Cell(f"p{i}", task, day, 20, round(20 * rates[i])))
                real.append(Cell(f"p{i}", task, day, 20, round(20 * order[i])))
    return twin, real


def test_the_headline_is_of_the_task_that_the_twin_ranks_worst() -> None:
    """With the hard task's order reversed, ranks of both tasks together still look fair."""
    made = make_forecast("road", *two_tasks((0.05, 0.1, 0.15, 0.2, 0.25, 0.3)))
    assert made.groups[-1].spearman.value > 0.6 and made.groups[1].spearman.value == pytest.approx(-1.0)
    (verdict,) = [v.text for v in verdicts(made) if "Spearman" in v.text]
    assert "does not rank" in verdict and "on hard, the task on which it ranks worst" in verdict
    assert "on the road does: Spearman" not in " ".join(v.text for v in verdicts(made) if v.mood == "good")


def test_the_baseline_without_the_twin_knows_how_hard_a_task_is() -> None:
    twin, real = two_tasks((0.3, 0.25, 0.2, 0.15, 0.1, 0.05))
    everywhere = make_forecast("road", twin, real).groups[-1]
    baseline = next(one.log.value for one in everywhere.scores if one.predictor == OTHERS)
    each = [
        next(one.log.value for one in g.scores if one.predictor == OTHERS)
        for g in make_forecast("road", twin, real).groups[:2]
    ]
    assert baseline == pytest.approx(np.mean(each), rel=0.1) and baseline < 0.6


def test_a_task_with_too_few_trials_leaves_the_verdicts_on_the_others() -> None:
    twin, real = two_tasks((0.3, 0.25, 0.2, 0.15, 0.1, 0.05))
    real = [
        replace(c, trials=3, successes=1) if (c.policy, c.task, c.lighting) == ("p0", "hard", "a") else c for c in real
    ]
    made = make_forecast("road", twin, real)
    assert [g.task for g in made.groups] == ["easy", "hard"]
    said = [v.text for v in verdicts(made)]
    assert "Spearman" in said[1] and "on easy" in said[1]
    assert said[-1].startswith("Too few data to say how well the twin predicts hard: each cell needs 5 real trials")


def test_a_group_of_all_tasks_combines_those_of_the_tasks() -> None:
    twin, real = cells(tasks=("straight", "right_turn"))
    made = make_forecast("road", twin, real)
    assert [g.task for g in made.groups] == ["straight", "right_turn", ALL_TASKS]
    assert [g.policies for g in made.groups] == [7, 7, 14]
    one, two, both = (g.winner_regret.value or 0.0 for g in made.groups)
    assert both == pytest.approx((one + two) / 2) and made.groups[2].trainings == 7
    assert made.groups[2].bias.value == pytest.approx(np.mean([p.bias.value for p in made.pairs]))


def test_the_candidates_are_ranked() -> None:
    made = make_forecast("road", cells()[0], [])
    rates = [c.twin.value for c in made.candidates]
    assert rates == sorted(rates, reverse=True)
    assert {c.policy for c in made.candidates[:2]} == {"p5", "p6"}
    assert np.allclose(np.sum([c.twin_ranks for c in made.candidates], 0), 1.0)
    assert all(c.real_ranks == () for c in made.candidates)


def test_every_real_lighting_is_left_out_once() -> None:
    twin, real = cells()
    made = make_forecast("road", twin, real)
    assert [(x.lighting, x.cells) for x in made.left_out] == [("dusk", 7), ("sun", 7)]
    found = {c.key: c for c in twin}
    dusk = [abs(c.rate - found[c.twin_key].rate) for c in real if c.lighting == "dusk"]
    assert made.left_out[0].twin_error.value == pytest.approx(np.mean(dusk))
    alone = make_forecast("road", twin, [c for c in real if c.lighting == "dusk"])
    assert "a second real lighting" in alone.left_out[0].coverage.missing


def predicted(twin: np.ndarray, real: np.ndarray, at: float) -> tuple[float, float, float]:
    """Textbook regression: the value at a twin score, and the ends of its 90 % interval."""
    line, n = stats.linregress(twin, real), len(twin)
    value = float(np.clip(line.intercept + line.slope * at, 0.0, 1.0))
    spread = np.sqrt(np.sum((real - line.intercept - line.slope * twin) ** 2) / (n - 2))
    lever = (at - twin.mean()) ** 2 / np.sum((twin - twin.mean()) ** 2)
    half = float(stats.t.ppf(0.95, n - 2) * spread * np.sqrt(1 + 1 / n + lever))
    return value, value - half, value + half


def test_a_lighting_left_out_is_predicted_by_the_others_alone() -> None:
    """Dusk differs from the rest; a line that was fitted to it, too, would be closer."""
    twin, real = cells(n=9, driven=9)
    real = [replace(c, successes=c.trials - c.successes) if c.lighting == "dusk" else c for c in real]
    rates, lights = {c.key: c.rate for c in twin}, np.array([c.lighting for c in real])
    score, rate = np.array([(rates[c.twin_key], c.rate) for c in real]).T
    for out in make_forecast("road", twin, real).left_out:
        mine = lights == out.lighting
        told = np.array([predicted(score[~mine], rate[~mine], at) for at in score[mine]])
        assert out.corrected_error.value == pytest.approx(np.abs(told[:, 0] - rate[mine]).mean())
        inside = (told[:, 1] <= rate[mine]) & (rate[mine] <= told[:, 2])
        assert out.coverage.value == pytest.approx(inside.mean())


def test_policies_left_out_are_predicted_at_the_stated_confidence() -> None:
    """The coverage equals that of the textbook; the 50 % interval contains fewer."""
    twin, real = cells(n=12, driven=12)
    made = make_forecast("road", twin, real)
    driven = [c for c in made.candidates if c.driven]
    score, rate = np.array([(c.twin.value, c.real.value) for c in driven]).T
    inside, inner = [], []
    for i, c in enumerate(driven):
        value, low, high = predicted(np.delete(score, i), np.delete(rate, i), score[i])
        ends = max(low, 0.0), min(high, 1.0)
        assert (c.corrected.value, c.corrected.low, c.corrected.high) == pytest.approx((value, *ends))
        inside.append(low <= rate[i] <= high)
        inner.append(abs(rate[i] - value) <= (high - value) * stats.t.ppf(0.75, 9) / stats.t.ppf(0.95, 9))
    (group,) = made.groups
    assert made.confidence == 0.9 and sum(inner) < sum(inside)
    assert group.corrected_coverage.value == pytest.approx(np.mean(inside))


# ---- refusals


def refused(made: Forecast) -> str:
    (group,) = made.groups
    for name, _, _ in STATISTICS:
        estimate = getattr(group, name)
        assert estimate.value is estimate.low is estimate.high is None and estimate.missing
    assert all(c.corrected.value is None for c in made.candidates)
    assert not re.search(r"Spearman [−\d]|Spearman +[−\d]", summary_text(made) + Text(forecast_page(made)).text)
    assert any("no correlation is given" in caution.what for caution in limitations(made))
    return "; ".join(group.missing)


@pytest.mark.parametrize("driven", [1, 4])
def test_no_correlation_from_fewer_than_five_policies(driven: int) -> None:
    twin, real = cells(driven=driven)
    told = refused(make_forecast("road", twin, real))
    count = f"{driven} {'policy' if driven == 1 else 'policies'}"
    assert told == f"{count} driven on the road, 5 are needed: drive {5 - driven} more"


def test_no_correlation_from_cells_of_fewer_than_five_trials() -> None:
    twin, real = cells()
    real[3] = Cell("p1", "straight", "sun", 4, 1, "sun")
    told = refused(make_forecast("road", twin, real))
    assert "needs 5 real trials, but p1 under sun has 4" in told and "p2" not in told
    twin, real = cells()
    twin[0] = Cell("p0", "straight", "held-out", 3, 0)
    assert "5 episodes in the twin, but p0 under held-out has 3" in refused(make_forecast("road", twin, real))


def test_rates_that_are_all_the_same_have_no_correlation_but_a_bias() -> None:
    twin, real = cells()
    made = make_forecast("road", twin, [Cell(c.policy, c.task, c.lighting, 10, 10, c.twin_lighting) for c in real])
    (group,) = made.groups
    assert group.spearman.value is None and "all rates on the road are 1" in group.spearman.missing
    assert group.bias.value is not None and group.winner_regret.value == 0.0
    assert verdicts(made)[0].mood == "bad" and "do not differ on the road" in verdicts(made)[0].text
    assert verdicts(made)[1].mood == "bad" and "cannot be compared" in verdicts(made)[1].text
    assert "nan" not in forecast_page(made) + summary_text(made) + candidates_csv(made)


def test_without_real_trials_statistics_are_missing() -> None:
    made = make_forecast("road", cells()[0], [])
    assert made.groups == made.pairs == made.left_out == ()
    text = Text(forecast_page(made)).text
    assert "Nothing is known yet about the road" in text and "Limitations" in text
    assert any("unknown how well the twin ranks" in caution.what for caution in limitations(made))
    (plan,) = made.plans
    assert plan.basis == "twin" and plan.more_for_winner is not None and plan.more_for_winner > 0


def test_days_of_a_single_policy_do_not_change_a_plan_from_the_twin() -> None:
    """With one driven policy, the plan assumes the twin's rates: one lighting, whatever the number of real days."""
    twin = [Cell(f"p{i}", "straight", "held-out", 50, won) for i, won in enumerate((15, 27, 31, 27, 41))]
    days = [Cell("p0", "straight", day, 5, 2, "held-out") for day in ("monday", "tuesday")]
    one, two = (make_forecast("road", twin, days[:k]).plans for k in (1, 2))
    assert one == two and one[0].basis == "twin"


def test_the_next_trials_are_of_policies_that_may_be_best_or_were_not_driven() -> None:
    twin, real = cells(n=9, driven=7)
    made = make_forecast("road", twin, real)
    again, new = next_trials(made)
    for c in made.candidates:
        assert (c.policy in again) == bool(c.real_ranks and c.real_ranks[0] >= 0.05)
        assert (c.policy in new) == (not c.driven)
    (first,) = next_trials(make_forecast("road", twin, []))
    ranked = [c.policy for c in make_forecast("road", twin, []).candidates]
    assert ranked[0] in first and ranked[-1] in first and sum(name in first for name in ranked) == MIN_POLICIES
    html = forecast_page(made)
    assert "twin forecast SCENE --real SCENE/real.csv" in html and again in Text(html).text
    assert html.count("<svg") == html.count('<svg role="img" aria-label="') > 0


def test_uneven_lightings_are_named() -> None:
    twin, real = cells(n=8)
    twin = [c for c in twin if c.key != ("p7", "straight", "sun")]
    told = [caution.what for caution in limitations(make_forecast("road", twin, real[1:]))]
    assert any("validated under the same lightings (p7 differ)" in what for what in told)
    assert any("driven on the road under the same lightings" in what for what in told)


def tile_texts(figure) -> dict[tuple[str, str], str]:
    """Texts of the tiles by row and column."""
    (axes,) = figure.axes
    rows, columns = ([text.get_text() for text in ticks] for ticks in (axes.get_yticklabels(), axes.get_xticklabels()))
    assert len(axes.collections[0].get_paths()) == len(axes.texts)
    return {(rows[round(t.xy[1])], columns[round(t.xy[0])]): t.get_text() for t in axes.texts}


def test_many_cells_are_heatmaps_above_a_collapsed_table() -> None:
    """A lighting of the twin that is compared with several real ones has one column."""
    few, many = (
        make_forecast("road", *cells(n=6, driven=6, tasks=tasks)) for tasks in (("straight",), ("a", "b", "c"))
    )
    assert len(few.pairs) <= MAX_TABLE_ROWS < len(many.pairs)
    short, long = (html[html.index('<section id="cells"') :] for html in map(forecast_page, (few, many)))
    assert "<svg" not in short and "<details" not in short
    assert long.count("<svg") == 3 * len(many.tasks) and long.count("<details") == 1
    candidates, pairs = many.candidates_of("b"), [pair for pair in many.pairs if pair.task == "b"]
    assert {p.lighting for p in pairs} == {"sun", "dusk"} and {p.twin_lighting for p in pairs} == {"sun", "held-out"}
    twin, road, off = (
        {(p.policy, light(p)): value(p) for p in pairs}
        for light, value in (
            (lambda p: p.twin_lighting, lambda p: p.twin.value),
            (lambda p: p.lighting, lambda p: p.real.value),
            (lambda p: p.lighting, lambda p: p.bias.value),
        )
    )
    for field, wanted in (("twin", twin), ("real", road)):
        figure = forecast_report.cell_heatmap(candidates, pairs, field)
        assert tile_texts(figure) == {key: f"{100 * rate:.0f}" for key, rate in wanted.items()}
    figure = forecast_report.difference_heatmap(candidates, pairs)
    told = tile_texts(figure)
    assert {key: int(text.strip("()").replace("−", "-")) for key, text in told.items()} == {
        key: round(100 * bias) for key, bias in off.items()
    }
    alpha = dict(zip(told, figure.axes[0].collections[0].get_facecolor()[:, 3].tolist(), strict=True))
    assert {(p.policy, p.lighting) for p in pairs if p.within_chance} == {k for k, v in alpha.items() if v < 0.1}
    assert {k for k, text in told.items() if text.startswith("(")} == {k for k, v in alpha.items() if v < 0.1}
    assert lighting_labels(["sun+randomised", "any+randomised"]) == (["sun", "any"], "lights, all of them +randomised")
    assert lighting_labels(["sun", "sun+randomised"]) == (["sun", "sun+randomised"], "")


def test_improbable_ranks_have_no_text_in_the_heatmap() -> None:
    made = make_forecast("road", cells(n=8)[0], [])  # episodes count singly where no days are compared
    ranks = np.array([c.twin_ranks for c in made.candidates])
    assert (ranks < 0.005).sum() > 0
    told, names = tile_texts(forecast_report.rank_heatmap(made.candidates)), [c.policy for c in made.candidates]
    assert told == {(names[i], str(k + 1)): f"{100 * ranks[i, k]:.0f}" for i, k in np.argwhere(ranks > 0.005).tolist()}


def test_one_policy_alone_needs_no_ranking() -> None:
    made = make_forecast("road", [Cell("p", "straight", "sun", 10, 5)], [])
    assert "one policy; there is nothing to rank" in summary_text(made)
    assert Text(forecast_page(made)).text


def test_the_papers_table_has_training_twin_and_road_of_every_policy() -> None:
    twin, real = cells(driven=6, tasks=("straight", "bend"))
    trained = {("p0", "straight"): Estimate(0.97, 0.93, 0.99, 100)}
    made = make_forecast("road", twin, real, trained=trained)
    html = forecast_page(made)
    table = html[html.index('<section id="stages"') :]
    parts = [part.split("</h3>") for part in table[: table.index("</section>")].split("<h3>")[1:]]
    assert tuple(task for task, _ in parts) == made.tasks == ("straight", "bend")
    for task, rows in parts:
        told = [row.split("<td>")[1:] for row in rows.split("<tr>")[2:]]
        assert len(told) == 7
        for row, c in zip(told, made.candidates_of(task), strict=True):
            policy, *cells_ = (Text(cell).text.strip() for cell in (part.split("</td>")[0] for part in row))
            assert policy == c.policy and cells_ == [
                format_estimate(e, percent=True) + (f" n = {e.n}" if e.n else "") for e in (c.trained, c.twin, c.real)
            ]
            assert (cells_[0] == "97% (93% to 99%) n = 100") == ((policy, task) == ("p0", "straight"))
            assert (cells_[2] == "–") == (policy == "p6")
    assert candidates_csv(made).count("0.97,0.93,0.99") == 1


# ---- files and the verb


def test_a_forecast_survives_saving(tmp_path: Path) -> None:
    for real in ([], cells()[1]):
        made = make_forecast("road", cells()[0], real)
        made.save(tmp_path)
        assert Forecast.load(tmp_path) == made
    json.loads((tmp_path / "forecast.json").read_text())
    (tmp_path / "forecast.json").write_text('{"scene": 3}')
    with pytest.raises(InputError):
        Forecast.load(tmp_path)
    with pytest.raises(InputError, match="does not exist"):
        Forecast.load(tmp_path / "none")


def test_the_same_seed_gives_the_same_forecast() -> None:
    twin, real = cells(n=6, driven=6)
    assert make_forecast("road", twin, real) == make_forecast("road", twin, real)
    assert make_forecast("road", twin, real, seed=1) != make_forecast("road", twin, real)


def test_the_verb_writes_all_files_and_prints_a_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    twin, real = cells(n=8)
    root = scene(tmp_path / "road", twin)
    assert commands.main("forecast", [str(root), "--real", str(results(tmp_path / "results.csv", real))]) == 0
    printed = capsys.readouterr().out
    assert "Spearman" in printed and "not driven" in printed and "forecast.html" in printed
    assert sorted(path.name for path in (root / "forecast").iterdir()) == [
        "forecast.csv",
        "forecast.html",
        "forecast.json",
    ]
    page = Text((root / "forecast" / "forecast.html").read_text(encoding="utf-8"))
    made = Forecast.load(root / "forecast")
    assert all(verdict.text in page.text for verdict in verdicts(made))
    assert f"Spearman {format_estimate(made.groups[0].spearman)}" in page.text and "these 7 policies" in page.text
    assert {link for link in page.links if not link.startswith(("#", "data:"))} == {"forecast.json", "forecast.csv"}
    assert "http" not in (root / "forecast" / "forecast.html").read_text(encoding="utf-8")
    table = (root / "forecast" / "forecast.csv").read_text().splitlines()
    assert table[0] == ",".join(CSV_COLUMNS) and len(table) == 9
    assert made.twin_trials == 8 * 2 * 50 and made.real_trials == 7 * 2 * 20


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere"], "is not a folder"),
        (["road", "--real", "none.csv"], "none.csv does not exist"),
        (["road", "--seed", "-1"], "--seed -1: expected 0 or more"),
        (["empty"], "drive the policies in the twin first"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    scene(tmp_path / "road", cells()[0])
    (tmp_path / "empty").mkdir()
    assert commands.main("forecast", arguments) == 2
    said = capsys.readouterr().err
    assert told in said and said.startswith("error: ") and said.count("\n") == 1
    assert not (tmp_path / "road" / "forecast").exists()


def test_a_wrong_table_leaves_the_last_forecast_alone(tmp_path: Path) -> None:
    twin, real = cells(n=6, driven=6)
    root = scene(tmp_path / "road", twin)
    forecast(root)
    before = (root / "forecast" / "forecast.json").read_bytes()
    table = results(tmp_path / "results.csv", [*real, Cell("p9", "straight", "sun", 5, 5, "sun")])
    with pytest.raises(InputError, match="policy 'p9' was not validated"):
        forecast(root, [table])
    assert (root / "forecast" / "forecast.json").read_bytes() == before


def test_trials_of_a_policy_that_was_trained_further_are_not_its_own(tmp_path: Path) -> None:
    twin, real = cells(n=6, driven=6)
    root = scene(tmp_path / "road", twin)
    table = results(tmp_path / "results.csv", real)
    (root / "validation" / "validated.json").write_text(json.dumps({"policies": {"p0": "new", "p1": "same"}}))
    for name, digest in (("p0", "old"), ("p1", "same"), ("p2", "unknown")):
        (root / "trials" / name).mkdir(parents=True)
        (root / "trials" / name / "trial.json").write_text(json.dumps({"name": name, "policy_digest": digest}))
    with pytest.raises(InputError, match=r"trials/p0/trial.json: p0 was trained further since this trial"):
        forecast(root, [table])
    (root / "trials" / "p0" / "trial.json").write_text(json.dumps({"name": "p0"}))  # of an earlier version
    forecast(root, [table])


def test_names_from_files_are_text() -> None:
    evil = '<script>alert("1")</script>&$x$'
    twin, real = cells(n=6, driven=6)
    twin = [Cell(evil if c.policy == "p0" else c.policy, *c.key[1:], c.trials, c.successes) for c in twin]
    real = [Cell(evil if c.policy == "p0" else c.policy, *c.key[1:], 20, c.successes, c.twin_lighting) for c in real]
    page = Text(forecast_page(make_forecast(evil, twin, real)))
    assert "script" not in page.tags and evil in page.text


def test_every_interval_is_shown_with_what_it_is_about() -> None:
    twin, real = cells()
    made = make_forecast("road", twin, real)
    page = forecast_page(made)
    road = page[page.index('<section id="road"') : page.index('<section id="stages"')]
    assert INTERVALS_NOTE in Text(road).text and INTERVALS_NOTE in " ".join(summary_text(made).split())
    assert "drive more policies" not in page + summary_text(made)
    for alone in (make_forecast("road", twin, []), make_forecast("road", *cells(driven=4))):  # no intervals there
        assert INTERVALS_NOTE not in " ".join((forecast_page(alone) + summary_text(alone)).split())


# ---- intervals, and what may be believed


def test_intervals_leave_trainings_and_days_out() -> None:
    twin, real = days()
    (group,) = make_forecast("road", twin, real).groups
    data = pair_cells(real, {c.key: c for c in twin})
    for name in ("spearman", "mmrv", "bias"):
        low, high = jackknife_interval(WITH_INTERVAL[name], data)
        estimate = getattr(group, name)
        assert (estimate.low, estimate.high) == pytest.approx((float(low), float(high)))
        assert estimate.no_interval == ""
    assert "9 trainings, 12 are needed" in group.pearson.no_interval and group.pearson.value is not None
    page = Text(forecast_page(make_forecast("road", twin, real))).text
    assert "no interval: too few for an interval: 9 trainings, 12 are needed" in page


def test_checkpoints_of_few_trainings_have_no_interval() -> None:
    """The number of policies is the same, but they come from three trainings."""
    twin, real = days()
    names = {f"p{i}": f"run{i // 3}/{i}" for i in range(9)}
    twin, real = ([replace(c, policy=names[c.policy]) for c in some] for some in (twin, real))
    made = make_forecast("road", twin, real)
    assert made.groups[0].spearman.value is not None
    assert "3 trainings, 8 are needed" in made.groups[0].spearman.no_interval
    assert any("5 days and 3 trainings" in caution.what for caution in limitations(made))


def test_rates_have_intervals_over_days_and_none_from_one_day() -> None:
    twin, real = days()
    made = make_forecast("road", twin, real)
    for c in made.candidates:
        own = [cell for cell in real if cell.policy == c.policy]
        _, low, high = mean_rate([cell.successes for cell in own], [cell.trials for cell in own])
        assert c.real.value == pytest.approx(np.mean([cell.rate for cell in own]))
        assert c.real.high - c.real.low > 0.8 * (high - low)
    wide = [c for c in made.candidates if 0.2 < (c.real.value or 0.0) < 0.8]
    assert wide and all(c.real.high - c.real.low > 0.4 for c in wide)  # five days, whatever the number of trials
    one = make_forecast("road", [c for c in twin if c.lighting == "photo0"], [c for c in real if c.lighting == "day0"])
    for c in one.candidates:
        assert c.real.value is not None and c.real.low is None and "1 day, 2 are needed" in c.real.no_interval


def test_the_twin_is_scored_against_guesses_without_it() -> None:
    twin, real = days()
    (group,) = make_forecast("road", twin, real).groups
    scores = {it.predictor: it for it in group.scores}
    own, others, shuffled = scores[TWIN], scores[OTHERS], scores[SHUFFLED]
    assert own.gain.value is None and others.gain.value == pytest.approx(others.log.value - own.log.value)
    assert others.gain.value > 0.0 and shuffled.gain.value > 0.0  # days differ, and the twin predicts how
    assert others.gain.low is None and others.gain.no_interval
    assert sum(it.cells for it in group.calibration) == group.cells == 45
    assert [it.day for it in group.errors] == [f"day{k}" for k in range(5)]
    rates = {c.key: c.rate for c in real}
    wrong = sum(it.misses + it.false_alarms for it in group.errors)
    assert 0 < wrong < 12 and sum((rate >= 0.5) for rate in rates.values()) > 10
    # A twin that does not distinguish days is no better than with shuffled days.
    flat = [replace(c, successes=round(np.mean([o.successes for o in twin if o.policy == c.policy]))) for c in twin]
    (group,) = make_forecast("road", flat, real).groups
    assert {it.predictor: it.gain.value for it in group.scores}[SHUFFLED] == pytest.approx(0.0, abs=1e-9)


def test_the_first_sentence_says_what_may_be_believed() -> None:
    twin, real = days(n=12)
    made = make_forecast("road", twin, real)
    (group,) = made.groups
    first = verdicts(made)[0]
    assert first.text.startswith("What may be believed: the order of two policies that differ")
    assert "5 days and 12 trainings" in first.text
    rates = pair_cells(real, {c.key: c for c in twin}).rates()
    different = sum(abs(a - b) > 1e-9 for i, a in enumerate(rates["real"]) for b in rates["real"][:i])
    assert sum(it.pairs for it in group.ordered) == different
    # Pairs that are tied in the twin are no evidence for an order.
    tied = [replace(c, successes=10) for c in twin]
    group = make_forecast("road", tied, real).groups[0]
    assert [(it.low, it.high, it.right) for it in group.ordered] == [(0.0, 0.0, different / 2)]
    assert verdicts(make_forecast("road", tied, real))[0].mood == "bad"
    # A twin with the reverse order must not be believed, however large its differences.
    worse = [replace(c, successes=c.trials - c.successes) for c in twin]
    first = verdicts(make_forecast("road", worse, real))[0]
    assert first.mood == "bad" and first.text.startswith("No order of two policies in the twin may be believed yet")


def test_numbers_are_shown_with_their_interval() -> None:
    assert format_estimate(Estimate(0.934, 0.81, 0.97, 12)) == "0.93 (0.81 to 0.97)"
    assert format_estimate(Estimate(-0.104, -0.2, 0.001, 12), percent=True) == "−10% (−20% to 0%)"
    assert format_estimate(Estimate(-0.001, None, None, 1), percent=True) == "0%"
    assert format_estimate(Estimate(missing="too few")) == "–"


def test_a_probability_is_never_rounded_to_certainty():
    said = [format_probability(p) for p in (0.0, 0.005, 0.0051, 0.5, 0.9949, 0.995, 1.0)]
    assert said == ["<1%", "<1%", "1%", "50%", "99%", ">99%", ">99%"]


def test_words_in_tables_stay_whole_on_a_narrow_screen():
    """The page breaks long words anywhere, but a column of a table would become one letter wide."""
    assert "th, td { overflow-wrap:normal }" in forecast_page(make_forecast("road", *cells()))


def test_one_is_singular():
    html = forecast_page(make_forecast("road", [Cell("p0", "straight", "sun", 1, 1)], []))
    assert "1 policy on one task: 1 trial in the twin, 0 on the road." in html


# ---- what the words may claim


def on_days(real: dict[str, list[int]], twin: dict[str, int], trials: int = 5) -> tuple[list[Cell], list[Cell]]:
    """Successes of each policy on each day, of `trials`, and in 100 episodes in the twin."""
    road = [
        Cell(p, "straight", f"d{k}", trials, won, "held-out") for p, each in real.items() for k, won in enumerate(each)
    ]
    return [Cell(p, "straight", "held-out", 100, won) for p, won in twin.items()], road


def test_pairs_that_are_equal_on_the_road_are_told_and_not_good_news() -> None:
    """One of twelve policies never arrives, the others always, whatever the twin says of them."""
    real = {f"p{i}": [5 * (i > 0)] * 5 for i in range(12)}
    twin, road = on_days(real, {f"p{i}": 5 + 8 * i for i in range(12)})
    made = make_forecast("road", twin, road)
    assert made.groups[0].tied_pairs == 55
    first = verdicts(made)[0]
    assert "11 of 11 such pairs" in first.text and "55 further pairs had the same rate on the road" in first.text
    assert first.mood == "mixed"
    assert "those of 55 further pairs do not" in Text(forecast_page(made)).text


def test_a_prediction_interval_needs_other_trainings_and_not_more_checkpoints() -> None:
    def made(names: list[str]) -> Forecast:
        rng = np.random.default_rng(0)
        rates = {name: round(5 + 85 * k / len(names)) for k, name in enumerate(names)}
        real = {name: rng.binomial(5, rates[name] / 100, 5).tolist() for name in names}
        return make_forecast("road", *on_days(real, rates))

    few = made([f"r{i % 2}/{i:09d}" for i in range(16)])
    assert all("too few other trainings for an interval: 1, 7" in c.corrected.no_interval for c in few.candidates)
    assert "Without an interval: too few other trainings for an interval: 1, 7 are" in Text(forecast_page(few)).text
    assert few.groups[0].corrected_coverage.missing
    many = made([f"r{i}" for i in range(9)])
    assert all(c.corrected.low is not None for c in many.candidates)
    assert many.groups[0].corrected_coverage.n == 9


def test_a_mean_beyond_one_is_not_printed() -> None:
    real = {f"p{i}": [round(0.1 * (i + 1) * 5)] * 5 for i in range(8)}
    twin, road = on_days(real, {f"p{i}": 5 * (i + 1) for i in range(8)} | {f"n{i}": 95 for i in range(32)})
    assert "are unlike those driven" in make_forecast("road", twin, road).groups[0].mean_real.missing


def test_equal_policies_lead_together() -> None:
    twin = [Cell(f"p{i}", "straight", "sun", 20, 20 if i < 3 else 15) for i in range(4)]
    assert "“p0”, “p1” and “p2” lead with the same rate" in verdicts(make_forecast("road", twin, []))[-1].text


def test_what_to_drive_next_is_named_also_among_many_like_policies() -> None:
    real = {f"p{i}": [5 if k < 4 or i == 0 else 0 for k in range(5)] for i in range(30)}
    (line,) = next_trials(make_forecast("road", *on_days(real, {f"p{i}": 80 for i in range(30)})))
    assert ("probably" not in line and "p0 (" in line and "p1 (" in line) or "each may be the best" in line


def test_missing_episodes_of_the_twin_are_not_missing_trials() -> None:
    twin, road = on_days({f"p{i}": [i % 6] * 4 for i in range(6)}, {f"p{i}": 50 for i in range(6)})
    few = [replace(cell, trials=4, successes=2) for cell in twin]
    text = verdicts(make_forecast("road", few, road))[0].text
    assert "each cell needs 5 episodes in the twin" in text and "validate more episodes" in text
    assert "real trials" not in text
