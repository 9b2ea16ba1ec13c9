"""A forecast in words and in plain tables: headlines, what is not known, the printed summary, and the CSV."""

import textwrap

from twin.errors import listing
from twin.evaluation.forecasting import ALL_TASKS, Estimate, Forecast, Group, TrialAllocation
from twin.evaluation.ranking import MOST_TRIALS
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.evaluation.trials import csv_text
from twin.report.html import Caution, Verdict

GOOD, FAIR = 0.9, 0.6
"""Rank correlations from which on the twin ranks as the road does, or roughly so."""
SMALL_REGRET = 0.05

STATISTICS = (
    ("spearman", "Spearman", "how alike twin and road rank the policies: 1 the same, 0 no relation"),
    ("pearson", "Pearson", "how near the rates lie to a straight line: 1 on it"),
    ("mmrv", "MMRV", "mean worst rank violation, in real success: 0 is best"),
    ("winner_agreement", "winner agrees", "whether the twin’s best policy is the road’s: 1 yes, 0 no"),
    ("winner_regret", "winner’s regret", "real success lost by taking the twin’s best policy"),
    ("bias", "road minus twin", "mean over the cells: below 0 the twin promises too much"),
    (
        "coverage",
        "cells agree",
        "share of the cells where twin and road differ by no more than chance; high for any guess where most cells are "
        "all or none",
    ),
    ("corrected_coverage", "predictions hold", "share of policies within the interval predicted without them"),
    ("mean_real", "mean on the road", "of policies such as these, driven or not (prediction-powered)"),
)
"""Field of `Group`, its short name, and what it means."""
SHARES = ("winner_regret", "bias", "coverage", "corrected_coverage", "mean_real")
"""Shown in per cent."""

NOMINAL = (
    "These 90% intervals are nominal: in simulated worlds of 36 policies, 20 days and 5 trials a day, most days all or "
    "none, they contained the true value as rarely as about 60% (Spearman), 70% (Pearson) and 50% (MMRV) of the time. "
    "They take policies of one training, and trials of one day, for independent. More days and more trainings reduce "
    "the doubt; more checkpoints and more trials on the same days reduce it less."
)
"""What stands wherever intervals of the agreement of twin and road are shown; figures: `benchmarks/intervals.py`."""

CSV_COLUMNS = (
    *("task", "policy", "twin", "twin_low", "twin_high", "twin_trials", "rank", "rank_low", "rank_high"),
    *("best_in_twin", "real", "real_low", "real_high", "real_trials", "best_on_road"),
    *("predicted", "predicted_low", "predicted_high", "trained", "trained_low", "trained_high"),
)


def show(estimate: Estimate, percent: bool = False, missing: str = "–") -> str:
    """ "0.93 (0.81 to 0.97)", or what stands for a missing one."""
    if estimate.value is None:
        return missing
    value = _number(estimate.value, percent)
    if estimate.low is None or estimate.high is None:
        return value
    return f"{value} ({_number(estimate.low, percent)} to {_number(estimate.high, percent)})"


def _number(value: float, percent: bool) -> str:
    text = f"{100 * value:.0f}%" if percent else f"{value:.2f}"
    return text.replace("-", "−") if text.strip("-0.%") else text.replace("-", "")


def points(share: float) -> str:
    """Of success, without sign."""
    return f"{abs(100 * share):.1f} points"


def chance(probability: float) -> str:
    """In per cent; nothing that was drawn at random is certain or impossible."""
    if probability > 0.995:
        return ">99%"
    return "<1%" if probability < 0.005 else f"{probability:.0%}"


def overall(forecast: Forecast) -> Group | None:
    """The group of all tasks, or of the only one."""
    return forecast.groups[-1] if forecast.groups else None


def verdicts(forecast: Forecast) -> list[Verdict]:
    """The headlines, the most important first."""
    group = overall(forecast)
    if group is None:
        return [
            Verdict("Nothing is known yet about the road: no real trials were given.", "mixed"),
            *[_leader(forecast, task) for task in forecast.tasks],
        ]
    if group.missing:
        first = f"Too few real trials to say how well the twin foretells the road: {group.missing[0]}."
        return [Verdict(first, "bad"), *[_leader(forecast, task) for task in forecast.tasks]]
    return [_agreement(group), *_regret(group), _bias(group), *_predictions(group)]


def _agreement(group: Group) -> Verdict:
    rank = group.spearman
    if rank.value is None:
        return Verdict(f"The rankings cannot be compared: {rank.missing}.", "bad")
    how, mood = "does not rank", "bad"
    if rank.value >= FAIR:
        how, mood = ("ranks", "good") if rank.value >= GOOD else ("roughly ranks", "mixed")
    where = "on all tasks together" if group.task == ALL_TASKS else f"on {group.task}"
    text = f"The twin {how} these {group.policies} policies as the road does: Spearman {show(rank)} {where}."
    # A wide interval is no success, whatever its middle.
    return Verdict(text, "mixed" if mood == "good" and (rank.low or 0.0) < FAIR else mood)


def _regret(group: Group) -> list[Verdict]:
    regret = group.winner_regret
    if regret.value is None or regret.high is None:
        return []
    lost = "nothing" if regret.value < 5e-4 else points(regret.value)
    text = (
        f"Taking the twin’s best policy would have cost {lost} of real success; its nominal 90% interval ends at "
        f"{points(regret.high)}."
    )
    return [Verdict(text, "good" if regret.value <= SMALL_REGRET else "bad")]


def _bias(group: Group) -> Verdict:
    bias, covered = group.bias, group.coverage
    if bias.value is None or bias.low is None or bias.high is None:
        return Verdict("How much the twin promises too much is not known.", "bad")
    if bias.low <= 0.0 <= bias.high:
        text, mood = f"On average its rates are not off by more than chance ({show(bias, True)})", "good"
    else:
        much = "too much" if bias.value < 0 else "too little"
        text, mood = f"It promises {points(bias.value)} {much} on average", "mixed"
    return Verdict(f"{text}; {covered.value or 0.0:.0%} of the cells agree with the road within chance.", mood)


def _predictions(group: Group) -> list[Verdict]:
    hold = group.corrected_coverage
    if hold.value is None:
        return []
    text = f"Predictions corrected by the other policies held for {hold.value:.0%} of {hold.n}, where 90% are meant to."
    return [Verdict(text, "good" if (hold.low or 0.0) <= 0.9 <= (hold.high or 1.0) else "mixed")]


def _leader(forecast: Forecast, task: str) -> Verdict:
    first = forecast.of(task)[0]
    sure = (
        f"best there with {chance(first.twin_ranks[0])} probability" if len(first.twin_ranks) > 1 else "the only policy"
    )
    return Verdict(f"In the twin, on {task}, {first.policy} leads: {show(first.twin, True)}, {sure}.")


def unknowns(forecast: Forecast) -> list[Caution]:
    """What these numbers cannot say, and what would."""
    out = []
    for group in forecast.groups:
        for what in group.missing:
            out.append(Caution(f"{group.task}: no correlation is given, as there are {what}.", _NEEDED))
    if not forecast.real_trials:
        out.append(Caution("Whether the road ranks these policies as the twin does, and how much it is off.", _NEEDED))
    on_road = {p.policy for p in forecast.pairs}
    runs = {name.partition("/")[0] for name in on_road}
    if len(runs) < len(on_road):
        what = f"The {len(on_road)} policies that were driven on the road come from {len(runs)} trainings"
        out.append(
            Caution(
                f"{what}; the intervals count each as one of its own, and are too narrow by that.",
                "train again with other --seed: how far trainings differ is known from these few only.",
            )
        )
    lightings = {name for c in forecast.candidates for name in c.lightings}
    out.append(
        Caution(
            f"How the policies do in light that is not like {listing(sorted(lightings))}.",
            "validate under further ones (any, mixtures, +randomised), film the place in that light, or add a photo "
            "with twin.relight.",
        )
    )
    for task in forecast.tasks:
        mine = forecast.of(task)
        sets = [frozenset(c.lightings) for c in mine]
        usual = max(sets, key=sets.count)
        uneven = [c.policy for c, under in zip(mine, sets, strict=True) if under != usual]
        if uneven:
            what = f"On {task} not all policies were validated under the same lightings ({listing(uneven)} differ)."
            out.append(Caution(what, "validate all of them under the same ones; the ranking mixes policy with light."))
        rows = {c.policy: {p.lighting for p in forecast.pairs if (p.policy, p.task) == (c.policy, task)} for c in mine}
        driven = {name: under for name, under in rows.items() if under}
        if len({frozenset(under) for under in driven.values()}) > 1:
            what = f"On {task} not all policies were driven on the road under the same lightings."
            out.append(Caution(what, "drive all of them under the same ones; the rates mix policy with light."))
    out.append(
        Caution(
            "What the twin does not have: other traffic, wet ground, weather but for haze, sun and shadows, and "
            "whatever else changed since the films.",
            "only real trials tell; spread them over days.",
        )
    )
    return out


_NEEDED = (
    f"drive {MIN_POLICIES} policies or more of different quality, {MIN_TRIALS} times or more under each lighting; "
    "good and bad ones, chosen before their real results are known."
)


def plan_words(forecast: Forecast, plan: TrialAllocation) -> str:
    """How many more real trials would settle the ranking of a task."""
    if plan.policies < 2:
        return f"{plan.task}: one policy; there is nothing to rank."
    so_far = "" if plan.basis == "road" else "no real trials yet; if the road were like the twin: "
    now = "" if plan.basis == "twin" or plan.winner_now is None else f", {chance(plan.winner_now)} sure now"
    order = "" if plan.basis == "twin" or plan.order_now is None else f", {chance(plan.order_now)} now"
    return (
        f"{plan.task}, {plan.policies} policies: {so_far}{_more(plan.more_for_winner)} to find the best one{now}; "
        f"{_more(plan.more_for_order)} to put all in order{order}."
    )


def _more(trials: int | None) -> str:
    if trials is None:
        return f"more than {MOST_TRIALS} real trials each"
    return "no more real trials" if trials == 0 else f"{trials} more real trials each"


def summary(forecast: Forecast) -> str:
    """The tables printed at the end."""
    lines = []
    for task in forecast.tasks:
        mine = forecast.of(task)
        width = max(len("policy"), *(len(c.policy) for c in mine))
        lines += [f"{task}: success, with 90% intervals; ranks in the twin, 1 is best"]
        lines += [f"  {'policy':<{width}}  {'twin':<20}  {'rank':<10}  {'road':<20}  predicted for the road"]
        for c in mine:
            ranks = f"{c.twin_rank.low:.0f} to {c.twin_rank.high:.0f}"
            cells = f"{show(c.twin, True):<20}  {ranks:<10}  {show(c.real, True, 'not driven'):<20}"
            lines.append(f"  {c.policy:<{width}}  {cells}  {show(c.corrected, True)}".rstrip())
        lines.append("")
    groups = [group for group in forecast.groups if not group.missing]
    if groups:
        lines.append(f"  {'':<18}" + "".join(f"{g.task + f' (n = {g.policies})':<26}" for g in groups).rstrip())
        for name, title, _ in STATISTICS:
            numbers = "".join(f"{show(getattr(group, name), name in SHARES):<26}" for group in groups)
            lines.append(f"  {title:<18}{numbers}".rstrip())
        lines += ["", *textwrap.wrap(NOMINAL, 110), ""]
    lines += [f"{group.task}: no correlation: {'; '.join(group.missing)}" for group in forecast.groups if group.missing]
    lines += [plan_words(forecast, plan) for plan in forecast.plans]
    lines += [verdict.text for verdict in verdicts(forecast)]
    if not forecast.groups:
        lines.append("Not known: " + unknowns(forecast)[0].what[0].lower() + unknowns(forecast)[0].what[1:])
    return "\n".join(lines)


def candidates_csv(forecast: Forecast) -> str:
    """`forecast.csv`: a row per candidate; empty where there is no number."""
    rows = []
    for c in forecast.candidates:
        numbers = [
            *(c.twin.value, c.twin.low, c.twin.high, c.twin.n, c.twin_rank.value, c.twin_rank.low, c.twin_rank.high),
            *(c.twin_ranks[0], c.real.value, c.real.low, c.real.high, c.real.n, *(c.real_ranks[:1] or [None])),
            *(c.corrected.value, c.corrected.low, c.corrected.high, c.trained.value, c.trained.low, c.trained.high),
        ]
        rows.append((c.task, c.policy, *("" if x is None else f"{x:.4f}".rstrip("0").rstrip(".") for x in numbers)))
    return csv_text(CSV_COLUMNS, rows)
