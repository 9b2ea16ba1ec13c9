"""Text of a forecast: headlines, limitations, the printed summary, and the CSV."""

import textwrap

import numpy as np

from twin.errors import join_names
from twin.evaluation.forecasting import ALL_TASKS, Agreement, Estimate, Forecast, TrialAllocation
from twin.evaluation.ranking import MAX_TRIALS
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.evaluation.trials import csv_text
from twin.report.html import Caution, Verdict

GOOD_CORRELATION, FAIR_CORRELATION = 0.9, 0.6
"""Rank correlations above which twin and road rank policies alike, or roughly alike."""
SMALL_REGRET = 0.05

STATISTICS = (
    ("spearman", "Spearman", "rank correlation of twin and road: 1 the same order, 0 no relation"),
    ("pearson", "Pearson", "linear correlation of the rates: 1 on a straight line"),
    ("mmrv", "MMRV", "mean maximum rank violation, in real success: 0 is best"),
    ("winner_agreement", "winner agrees", "1 if the twin’s best policy is also the best on the road, else 0"),
    ("winner_regret", "regret", "real success lost by choosing the twin’s best policy"),
    ("bias", "road minus twin", "mean over the cells; below 0 the twin is too optimistic"),
    (
        "coverage",
        "cells agree",
        "share of the cells where twin and road differ by no more than chance; high for any guess if most cells are "
        "all successes or all failures",
    ),
    ("corrected_coverage", "predictions hold", "share of policies within the interval predicted from the others"),
    ("mean_real", "mean on the road", "of policies such as these, driven or not (prediction-powered estimate)"),
)
"""Field of `Group`, its short name, and its meaning."""
PERCENT_STATISTICS = ("winner_regret", "bias", "coverage", "corrected_coverage", "mean_real")
"""Statistics shown in percent."""

NOMINAL_INTERVALS = (
    "These 90% intervals are nominal: in simulated experiments of 36 policies, 20 days and 5 trials per day, most days "
    "all successes or all failures, they contained the true value in only about 60% (Spearman), 70% (Pearson) and 50% "
    "(MMRV) of the cases. They assume that policies of one training, and trials of one day, are independent. More days "
    "and more trainings reduce the uncertainty; more checkpoints and more trials on the same days reduce it less."
)
"""Note wherever intervals of the agreement of twin and road are shown; measured by `benchmarks/intervals.py`."""

CSV_COLUMNS = (
    *("task", "policy", "twin", "twin_low", "twin_high", "twin_trials", "rank", "rank_low", "rank_high"),
    *("best_in_twin", "real", "real_low", "real_high", "real_trials", "best_on_road"),
    *("predicted", "predicted_low", "predicted_high", "trained", "trained_low", "trained_high"),
)


def format_estimate(estimate: Estimate, percent: bool = False, missing: str = "–") -> str:
    """Formats an estimate as "0.93 (0.81 to 0.97)", or returns `missing`."""
    if estimate.value is None:
        return missing
    value = _format_value(estimate.value, percent)
    if estimate.low is None or estimate.high is None:
        return value
    return f"{value} ({_format_value(estimate.low, percent)} to {_format_value(estimate.high, percent)})"


def _format_value(value: float, percent: bool) -> str:
    text = f"{100 * value:.0f}%" if percent else f"{value:.2f}"
    return text.replace("-", "−") if text.strip("-0.%") else text.replace("-", "")


def percentage_points(share: float) -> str:
    return f"{abs(100 * share):.1f} points"


def format_probability(probability: float) -> str:
    """Formats an estimated probability in percent; never as 0% or 100%."""
    if probability > 0.995:
        return ">99%"
    return "<1%" if probability < 0.005 else f"{probability:.0%}"


def verdicts(forecast: Forecast) -> list[Verdict]:
    group = forecast.groups[-1] if forecast.groups else None  # of all tasks, or of the only one
    if group is None:
        return [
            Verdict("Nothing is known yet about the road: no real trials were given.", "mixed"),
            *[_leader(forecast, task) for task in forecast.tasks],
        ]
    if group.missing:
        first = f"Too few real trials to measure how well the twin predicts the road: {group.missing[0]}."
        return [Verdict(first, "bad"), *[_leader(forecast, task) for task in forecast.tasks]]
    return [_agreement(group), *_regret(group), _bias(group), *_predictions(group)]


def _agreement(group: Agreement) -> Verdict:
    rank = group.spearman
    if rank.value is None:
        return Verdict(f"The rankings cannot be compared: {rank.missing}.", "bad")
    how, mood = "does not rank", "bad"
    if rank.value >= FAIR_CORRELATION:
        how, mood = ("ranks", "good") if rank.value >= GOOD_CORRELATION else ("roughly ranks", "mixed")
    where = "on all tasks together" if group.task == ALL_TASKS else f"on {group.task}"
    text = f"The twin {how} these {group.policies} policies as the road does: Spearman {format_estimate(rank)} {where}."
    # A wide interval lowers the mood, whatever its center.
    return Verdict(text, "mixed" if mood == "good" and (rank.low or 0.0) < FAIR_CORRELATION else mood)


def _regret(group: Agreement) -> list[Verdict]:
    regret = group.winner_regret
    if regret.value is None or regret.high is None:
        return []
    lost = "nothing" if regret.value < 5e-4 else percentage_points(regret.value)
    text = (
        f"Choosing the twin’s best policy would have cost {lost} of real success; its nominal 90% interval ends at "
        f"{percentage_points(regret.high)}."
    )
    return [Verdict(text, "good" if regret.value <= SMALL_REGRET else "bad")]


def _bias(group: Agreement) -> Verdict:
    bias, covered = group.bias, group.coverage
    if bias.value is None or bias.low is None or bias.high is None:
        return Verdict("The bias of the twin’s rates is not known.", "bad")
    if bias.low <= 0.0 <= bias.high:
        text, mood = f"On average its rates deviate by no more than chance ({format_estimate(bias, True)})", "good"
    else:
        much = "high" if bias.value < 0 else "low"
        text, mood = f"On average its rates are {percentage_points(bias.value)} too {much}", "mixed"
    return Verdict(f"{text}; {covered.value or 0.0:.0%} of the cells agree with the road within chance.", mood)


def _predictions(group: Agreement) -> list[Verdict]:
    hold = group.corrected_coverage
    if hold.value is None:
        return []
    text = f"Predictions corrected by the other policies held for {hold.value:.0%} of {hold.n}; 90% are expected."
    return [Verdict(text, "good" if (hold.low or 0.0) <= 0.9 <= (hold.high or 1.0) else "mixed")]


def _leader(forecast: Forecast, task: str) -> Verdict:
    first = forecast.candidates_of(task)[0]
    sure = (
        f"best there with {format_probability(first.twin_ranks[0])} probability"
        if len(first.twin_ranks) > 1
        else "the only policy"
    )
    return Verdict(f"In the twin, on {task}, {first.policy} leads: {format_estimate(first.twin, True)}, {sure}.")


def limitations(forecast: Forecast) -> list[Caution]:
    """Limits of the forecast, with cures."""
    out = []
    for group in forecast.groups:
        for what in group.missing:
            out.append(Caution(f"{group.task}: no correlation is given because there are {what}.", _TRIALS_NEEDED))
    if not forecast.real_trials:
        out.append(
            Caution(
                "Whether the road ranks these policies as the twin does, and how far its rates are off, is not known.",
                _TRIALS_NEEDED,
            )
        )
    on_road = {p.policy for p in forecast.pairs}
    runs = {name.partition("/")[0] for name in on_road}
    if len(runs) < len(on_road):
        what = f"The {len(on_road)} policies that were driven on the road come from {len(runs)} trainings"
        out.append(
            Caution(
                f"{what}; the intervals treat them as independent and are therefore too narrow.",
                "train again with another --seed: the variation between trainings is known from these few only.",
            )
        )
    lightings = {name for c in forecast.candidates for name in c.lightings}
    out.append(
        Caution(
            f"Success was not measured in light unlike {join_names(sorted(lightings))}.",
            "validate under further lightings (any, mixtures, +randomised), film the place in that light, or add a "
            "photo with twin.relight.",
        )
    )
    for task in forecast.tasks:
        mine = forecast.candidates_of(task)
        sets = [frozenset(c.lightings) for c in mine]
        usual = max(sets, key=sets.count)
        uneven = [c.policy for c, under in zip(mine, sets, strict=True) if under != usual]
        if uneven:
            what = f"On {task} not all policies were validated under the same lightings ({join_names(uneven)} differ)."
            out.append(
                Caution(what, "validate all of them under the same ones; otherwise the ranking mixes policy and light.")
            )
        rows = {c.policy: {p.lighting for p in forecast.pairs if (p.policy, p.task) == (c.policy, task)} for c in mine}
        driven = {name: under for name, under in rows.items() if under}
        if len({frozenset(under) for under in driven.values()}) > 1:
            what = f"On {task} not all policies were driven on the road under the same lightings."
            out.append(
                Caution(what, "drive all of them under the same ones; otherwise the rates mix policy and light.")
            )
    out.append(
        Caution(
            "The twin lacks other traffic, wet ground, weather except for haze, sun and shadows, "
            "and all other changes since the films.",
            "only real trials measure it; spread them over several days.",
        )
    )
    return out


_TRIALS_NEEDED = (
    f"drive {MIN_POLICIES} policies or more of different quality, {MIN_TRIALS} times or more under each lighting; "
    "include good and bad ones, chosen before their real results are known."
)


_POSSIBLY_BEST = 0.05
"""Policies with at least this probability of being the best are worth further trials."""


def next_trials(forecast: Forecast) -> list[str]:
    """The most useful next trials on the road, per task."""
    out = []
    for task in forecast.tasks:
        mine = forecast.candidates_of(task)
        driven = [c for c in mine if c.driven]
        if len(driven) < min(MIN_POLICIES, len(mine)):
            some = [mine[round(k)] for k in np.linspace(0, len(mine) - 1, min(MIN_POLICIES, len(mine)))]
            names = join_names([c.policy for c in some if not c.driven], MIN_POLICIES)
            out.append(f"{task}: drive {names}, {MIN_TRIALS} times or more in each light: good and bad ones.")
            continue
        best = [c for c in driven if c.real_ranks and c.real_ranks[0] >= _POSSIBLY_BEST]
        if len(best) > 1:
            odds = join_names([f"{c.policy} ({format_probability(c.real_ranks[0])})" for c in best], 6)
            out.append(f"{task}: drive again those that may be the best of the driven, with this probability: {odds}.")
        elif best:
            out.append(f"{task}: drive {best[0].policy} on further days, in light that it has not met; it leads.")
        if unseen := [c.policy for c in mine if not c.driven]:
            out.append(f"{task}: drive what has not been driven, best in the twin first: {join_names(unseen, 6)}.")
    return out


def allocation_text(forecast: Forecast, allocation: TrialAllocation) -> str:
    if allocation.policies < 2:
        return f"{allocation.task}: one policy; there is nothing to rank."
    so_far = "" if allocation.basis == "road" else "no real trials yet; if the road were like the twin: "
    now = (
        ""
        if allocation.basis == "twin" or allocation.winner_now is None
        else f", now {format_probability(allocation.winner_now)} sure"
    )
    order = (
        ""
        if allocation.basis == "twin" or allocation.order_now is None
        else f", now {format_probability(allocation.order_now)} sure"
    )
    return (
        f"{allocation.task}, {allocation.policies} policies: {so_far}{_trial_count_text(allocation.more_for_winner)} "
        f"to find the best one{now}; {_trial_count_text(allocation.more_for_order)} to order all of them{order}."
    )


def _trial_count_text(trials: int | None) -> str:
    if trials is None:
        return f"more than {MAX_TRIALS} real trials each"
    return "no more real trials" if trials == 0 else f"{trials} more real trials each"


def summary_text(forecast: Forecast) -> str:
    lines = []
    for task in forecast.tasks:
        mine = forecast.candidates_of(task)
        width = max(len("policy"), *(len(c.policy) for c in mine))
        lines += [f"{task}: success, with 90% intervals; ranks in the twin, 1 is best"]
        lines += [f"  {'policy':<{width}}  {'twin':<20}  {'rank':<10}  {'road':<20}  predicted for the road"]
        for c in mine:
            ranks = f"{c.twin_rank.low:.0f} to {c.twin_rank.high:.0f}"
            cells = (
                f"{format_estimate(c.twin, True):<20}  {ranks:<10}  {format_estimate(c.real, True, 'not driven'):<20}"
            )
            lines.append(f"  {c.policy:<{width}}  {cells}  {format_estimate(c.corrected, True)}".rstrip())
        lines.append("")
    groups = [group for group in forecast.groups if not group.missing]
    if groups:
        lines.append(f"  {'':<18}" + "".join(f"{g.task + f' (n = {g.policies})':<26}" for g in groups).rstrip())
        for name, title, _ in STATISTICS:
            numbers = "".join(
                f"{format_estimate(getattr(group, name), name in PERCENT_STATISTICS):<26}" for group in groups
            )
            lines.append(f"  {title:<18}{numbers}".rstrip())
        lines += ["", *textwrap.wrap(NOMINAL_INTERVALS, 110), ""]
    lines += [f"{group.task}: no correlation: {'; '.join(group.missing)}" for group in forecast.groups if group.missing]
    lines += [allocation_text(forecast, allocation) for allocation in forecast.plans]
    lines += [verdict.text for verdict in verdicts(forecast)]
    if not forecast.groups:
        lines.append(limitations(forecast)[0].what)
    return "\n".join(lines)


def candidates_csv(forecast: Forecast) -> str:
    """`forecast.csv`: one row per candidate; empty cells where there is no number."""
    rows = []
    for c in forecast.candidates:
        numbers = [
            *(c.twin.value, c.twin.low, c.twin.high, c.twin.n, c.twin_rank.value, c.twin_rank.low, c.twin_rank.high),
            *(c.twin_ranks[0], c.real.value, c.real.low, c.real.high, c.real.n, *(c.real_ranks[:1] or [None])),
            *(c.corrected.value, c.corrected.low, c.corrected.high, c.trained.value, c.trained.low, c.trained.high),
        ]
        rows.append((c.task, c.policy, *("" if x is None else f"{x:.4f}".rstrip("0").rstrip(".") for x in numbers)))
    return csv_text(CSV_COLUMNS, rows)
