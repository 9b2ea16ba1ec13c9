"""The forecast's text (verdicts, limitations, next trials, printed summary) and its table, `forecast.csv`.

The text says how well the twin predicts the road, which policy is best, and how certain these answers are. The numbers
come from `twin.evaluation.forecasting`.
"""

import textwrap
from collections.abc import Sequence

import numpy as np

from twin.errors import join_names
from twin.evaluation.agreement import OTHERS, SHUFFLED, Agreement, Estimate
from twin.evaluation.agreement_intervals import MIN_DAYS, MIN_TRAININGS, training_of
from twin.evaluation.forecasting import ALL_TASKS, Forecast, TrialAllocation
from twin.evaluation.rate_model import MAX_TRIALS
from twin.evaluation.statistics import MIN_POLICIES, MIN_TRIALS
from twin.evaluation.trials import csv_text
from twin.report.html import Caution, Verdict, counted

GOOD_CORRELATION, FAIR_CORRELATION = 0.9, 0.6
"""Lowest rank correlations for the verdict that the twin ranks, or roughly ranks, policies as the road does."""
SMALL_REGRET = 0.05  # up to this regret, the verdict is good
# Verdicts are good only if the order is reliable for such differences of rates, and errors are smaller.
_SMALL_GAP = 0.1

STATISTICS = (
    ("spearman", "Spearman", "rank correlation of twin and road: 1 the same order, 0 no relation"),
    ("pearson", "Pearson", "linear correlation of the rates: 1 if they lie on a rising straight line"),
    ("mmrv", "MMRV", "mean maximum rank violation: real success lost by a policy’s worst swap, on average; 0 is best"),
    ("winner_agreement", "winner agrees", "1 if the twin’s best policy is also the best on the road, else 0"),
    ("winner_regret", "regret", "real success lost by choosing the twin’s best policy"),
    ("bias", "road minus twin", "mean over the policies; below 0 the twin is too optimistic"),
    (
        "coverage",
        "cells agree",
        "share of the cells where the 90% interval of road minus twin contains 0; if all trials of most cells have the "
        "same outcome, it is high even for a random guess",
    ),
    (
        "corrected_coverage",
        "predictions hold",
        "share of policies whose real rate is in the interval predicted from other trainings; 90% are expected",
    ),
    ("twin_error", "twin is off by", "mean over the policies of the absolute difference of the rates"),
    (
        "mean_real",
        "mean on the road",
        "mean real rate of policies like these, driven or not (prediction-powered estimate)",
    ),
)
"""Name of a field of `Agreement`, its short name on the page, and its meaning."""
PERCENT_STATISTICS = ("winner_regret", "bias", "coverage", "corrected_coverage", "twin_error", "mean_real")
"""Statistics shown in percent."""

INTERVALS_NOTE = (
    "The intervals (90%) treat the days and trainings as samples: they hold for a repetition with new ones. They are "
    "computed by leaving out days and trainings in turn, not trials. More days and more trainings make them narrower; "
    "more checkpoints of one training, or more trials on the same day, hardly do. With too few days or trainings for a "
    "reliable interval, there is none."
)
"""Note on all intervals in `Agreement`; `benchmarks/intervals.py` measures their coverage."""

CSV_COLUMNS = (
    *("task", "policy", "twin", "twin_low", "twin_high", "twin_trials", "rank", "rank_low", "rank_high"),
    *("best_in_twin", "real", "real_low", "real_high", "real_trials", "best_on_road"),
    *("predicted", "predicted_low", "predicted_high", "trained", "trained_low", "trained_high"),
)

_RELIABLE = 0.95  # the twin's order may be believed if the road confirms it in at least this fraction of pairs
_ENOUGH_PAIRS = 10  # fewer pairs do not suffice to confirm an order
_POSSIBLY_BEST = 0.05  # policies with at least this probability of being the best should get further trials
_MOST_NAMED = 6  # policies in a list of what to drive next
_TRIALS_NEEDED = (
    f"drive {MIN_POLICIES} policies or more of different quality, {MIN_TRIALS} times or more under each lighting; "
    "include good and bad ones, chosen before their real results are known."
)

# ---- numbers


def format_estimate(estimate: Estimate, percent: bool = False, missing: str = "–", digits: int = 2) -> str:
    """Formats an estimate as "0.93 (0.81 to 0.97)", or returns `missing`."""
    if estimate.value is None:
        return missing
    value, *ends = (
        _format_value(x, percent, digits) for x in (estimate.value, estimate.low, estimate.high) if x is not None
    )
    return f"{value} ({' to '.join(ends)})" if len(ends) == 2 else value


def _format_value(value: float, percent: bool, digits: int) -> str:
    text = f"{100 * value:.0f}%" if percent else f"{value:.{digits}f}"
    return text.replace("-", "−" if text.strip("-0.%") else "")


def percentage_points(share: float) -> str:
    return f"{abs(100 * share):.1f} percentage points"


def format_probability(probability: float) -> str:
    """Formats an estimated probability in percent: "<1%" for 0.5% or less, ">99%" for 99.5% or more."""
    if probability >= 0.995:
        return ">99%"
    return "<1%" if probability <= 0.005 else f"{probability:.0%}"


# ---- verdicts


def verdicts(forecast: Forecast) -> list[Verdict]:
    """The headlines of the forecast."""
    leaders = [_leader(forecast, task) for task in forecast.tasks]
    if not forecast.groups:
        return [Verdict("Nothing is known yet about the road: no real trials were given.", "mixed"), *leaders]
    measured = [group for group in forecast.groups if not group.missing]
    if not measured:
        first = f"Too few data to measure how well the twin predicts the road: {forecast.groups[0].missing[0]}."
        return [Verdict(first, "bad"), *leaders]
    group = measured[-1]  # the group of all measured tasks, or of the only one
    return [
        believable(group),
        _agreement(measured),
        *_regret(group),
        _bias(group),
        *_skill(group),
        *(
            Verdict(f"Too few data to say how well the twin predicts {other.task}: {other.missing[0]}.", "mixed")
            for other in forecast.groups
            if other.missing
        ),
    ]


def believable(group: Agreement) -> Verdict:
    """Verdict on the smallest difference of two policies' rates in the twin at which the road confirms their order."""
    ties = sum(it.pairs for it in group.ordered if not it.high)
    pairs = [(it.low, it.pairs, it.right) for it in group.ordered if it.high]
    many, days = counted(group.trainings, "training"), counted(group.days, "day")
    where = f"measured on {days} and {many}"
    alike = f"; {counted(ties, 'further pair')} had the same rate in the twin" if ties else ""
    alike += f"; {counted(group.tied_pairs, 'further pair')} had the same rate on the road" if group.tied_pairs else ""
    if not pairs and not ties:
        text = f"These policies do not differ on the road, so no order in the twin could be confirmed ({where})."
        return Verdict(text, "bad")
    for start, _, _ in pairs:
        beyond = [(n, right) for low, n, right in pairs if low >= start]
        n, right = sum(n for n, _ in beyond), sum(right for _, right in beyond)
        if n >= _ENOUGH_PAIRS and right >= _RELIABLE * n:
            closer = [(m, r) for low, m, r in pairs if low < start]
            m, r = sum(m for m, _ in closer), sum(r for _, r in closer)
            gap = f"that differ by {100 * start:.0f} percentage points or more" if start else "that differ at all"
            rest = (f", and in {r:g} of {m} closer pairs" if m else "") + alike
            text = (
                f"What may be believed: the order of two policies {gap} in the twin. The road had the same order in "
                f"{right:g} of {n} such pairs{rest} ({where})."
            )
            enough = group.trainings >= MIN_TRAININGS and group.days >= MIN_DAYS and group.tied_pairs <= n
            return Verdict(text, "good" if enough and start <= _SMALL_GAP else "mixed")
    n, right = sum(n for _, n, _ in pairs), sum(right for _, _, right in pairs)
    text = f"No order of two policies in the twin may be believed yet: the road agrees in {right:g} of {n} pairs"
    return Verdict(f"{text}{alike} ({where}).", "bad")


def _agreement(groups: Sequence[Agreement]) -> Verdict:
    """Verdict on the ranking in the task in which the twin ranks worst: ranks of all tasks together mostly show that
    one task is harder than another.
    """
    tasks = [group for group in groups if group.task != ALL_TASKS]
    ranked = [group for group in tasks if group.spearman.value is not None]
    if not ranked:
        return Verdict(f"The rankings cannot be compared: {tasks[0].spearman.missing}.", "bad")
    group = min(ranked, key=lambda one: one.spearman.value or 0.0)
    rank, correlation = group.spearman, group.spearman.value or 0.0
    how, mood = "does not rank", "bad"
    if correlation >= FAIR_CORRELATION:
        how, mood = ("ranks", "good") if correlation >= GOOD_CORRELATION else ("roughly ranks", "mixed")
    where = f"on {group.task}, the task on which it ranks worst" if len(ranked) > 1 else f"on {group.task}"
    text = f"The twin {how} these {group.policies} policies as the road does: Spearman {format_estimate(rank)} {where}."
    if rank.no_interval:
        text = f"{text.removesuffix('.')}; {rank.no_interval}."
    # A high correlation is good news only if its interval contains no poor ones.
    return Verdict(text, "mixed" if mood == "good" and (rank.low or 0.0) < FAIR_CORRELATION else mood)


def _regret(group: Agreement) -> list[Verdict]:
    regret = group.winner_regret
    if regret.value is None:
        return []
    lost = "nothing" if regret.value < 5e-4 else percentage_points(regret.value)
    text = f"In these trials, choosing the twin’s best policy would have cost {lost} of real success."
    return [Verdict(text, "good" if regret.value <= SMALL_REGRET else "bad")]


def _bias(group: Agreement) -> Verdict:
    bias, off = group.bias, group.twin_error
    if bias.value is None or off.value is None:
        return Verdict("The bias of the twin’s rates is not known.", "bad")
    single = f"for a single policy, the twin’s rate is off by {percentage_points(off.value)} on average"
    much = "high" if bias.value < 0 else "low"
    mean = f"The twin’s rates are {percentage_points(bias.value)} too {much} on average"
    if abs(bias.value) < 5e-4:
        mean = "On average, the twin’s rates are right"
    if bias.low is None or bias.high is None:
        return Verdict(f"{mean} ({bias.no_interval}); {single}.", "mixed")
    if not bias.low <= 0.0 <= bias.high:
        return Verdict(f"{mean}; {single}.", "mixed")
    known = bias.low >= -_SMALL_GAP and bias.high <= _SMALL_GAP
    told = "The twin has no significant bias" if known else "These trials leave open whether the twin has a bias"
    mood = "good" if known and off.value <= _SMALL_GAP else "mixed"
    return Verdict(f"{told}: road minus twin is {format_estimate(bias, True)}; {single}.", mood)


def _skill(group: Agreement) -> list[Verdict]:
    """Verdict on how well the twin predicts single days, compared with the mean of other trainings, if scored."""
    gains = {it.predictor: it.gain for it in group.scores}
    gain = gains.get(OTHERS)
    if gain is None or gain.value is None:
        return []
    if gain.low is None or gain.high is None:
        better = "better" if gain.value > 0 else "worse"
        how = f"{better} than the mean of other trainings"
        text = f"In these trials the twin predicts single days {how} (log scores; {gain.no_interval})."
        return [Verdict(text, "mixed")]
    if gain.low > 0:
        text = "The twin predicts success on single days better than the mean of other trainings does"
        shuffled = gains.get(SHUFFLED)
        if shuffled is not None and shuffled.low is not None:
            more = "and distinguishes days" if shuffled.low > 0 else "but it is not certain that it distinguishes days"
            text = f"{text}, {more}"
        return [Verdict(f"{text} (log scores).", "good")]
    how = "worse than" if gain.high < 0 else "not significantly better than"
    text = f"The twin predicts success on single days {how} the mean of other trainings does (log scores)."
    return [Verdict(text, "bad")]


def _leader(forecast: Forecast, task: str) -> Verdict:
    first, *others = forecast.candidates_of(task)
    # Sampling orders policies with the same counts by chance.
    equal = [c.policy for c in others if (c.twin.value, c.twin.n) == (first.twin.value, first.twin.n)]
    if equal:
        names = join_names(sorted(f"“{name}”" for name in (first.policy, *equal)), 6)
        return Verdict(f"In the twin, on {task}, {names} lead with the same rate: {format_estimate(first.twin, True)}.")
    chance = f"best there with {format_probability(first.twin_ranks[0])} probability"
    sure = chance if len(first.twin_ranks) > 1 else "the only policy"
    return Verdict(f"In the twin, on {task}, “{first.policy}” leads: {format_estimate(first.twin, True)}, {sure}.")


# ---- limitations and next trials


def limitations(forecast: Forecast) -> list[Caution]:
    """Limits of the forecast, with cures."""
    out = [
        Caution(f"{group.task}: no correlation is given: {what}.", _TRIALS_NEEDED)
        for group in forecast.groups
        for what in group.missing
    ]
    if not forecast.real_trials:
        what = "It is unknown how well the twin ranks these policies, and how large the error of its rates is."
        out.append(Caution(what, _TRIALS_NEEDED))
    on_road = {p.policy for p in forecast.pairs}
    days = {p.lighting for p in forecast.pairs}
    runs = {training_of(name) for name in on_road}
    if on_road:
        what = (
            f"Trials of one day or of one training tend to have the same outcome: the real sample is "
            f"{counted(len(days), 'day')} and {counted(len(runs), 'training')}, "
            f"not {counted(forecast.real_trials, 'trial')}."
        )
        cure = "drive on further days, and train again with another --seed."
        out.append(Caution(what, cure))
    for group in forecast.groups:
        if group.spearman.no_interval:
            what = f"{group.task}: Spearman’s correlation has no interval ({group.spearman.no_interval})."
            out.append(Caution(what, "drive on further days, and with policies of further trainings."))
    lightings = join_names(sorted({name for c in forecast.candidates for name in c.lightings}))
    cure = (
        "validate under further lightings (any, mixtures, +randomised), film the place in that light, or add a photo "
        "with twin relight."
    )
    out.append(Caution(f"Success is unknown in light that differs from {lightings}.", cure))
    for task in forecast.tasks:
        mine = forecast.candidates_of(task)
        sets = [frozenset(c.lightings) for c in mine]
        usual = max(sets, key=sets.count)
        if uneven := [c.policy for c, under in zip(mine, sets, strict=True) if under != usual]:
            what = f"On {task} not all policies were validated under the same lightings ({join_names(uneven)} differ)."
            cure = "validate all under the same lightings; else the ranking mixes effects of policy and light."
            out.append(Caution(what, cure))
        driven = {
            c.policy: {p.lighting for p in forecast.pairs if (p.policy, p.task) == (c.policy, task)} for c in mine
        }
        if len({frozenset(under) for under in driven.values() if under}) > 1:
            what = f"On {task} not all policies were driven on the road under the same lightings."
            cure = "drive all under the same lightings; else the rates mix effects of policy and light."
            out.append(Caution(what, cure))
    what = (
        "The twin has no other traffic and no wet ground. Of the weather it has only haze, sun and shadows. Changes "
        "since the films are missing, too."
    )
    return [*out, Caution(what, "only real trials measure these effects; spread them over several days.")]


def next_trials(forecast: Forecast) -> list[str]:
    """The most useful next trials on the road, per task."""
    out = []
    for task in forecast.tasks:
        mine = forecast.candidates_of(task)
        driven = [c for c in mine if c.driven]
        enough = min(MIN_POLICIES, len(mine))
        if len(driven) < enough:
            some = [mine[round(k)] for k in np.linspace(0, len(mine) - 1, enough)]
            names = join_names([c.policy for c in some if not c.driven], MIN_POLICIES)
            out.append(f"{task}: drive {names}, {MIN_TRIALS} times or more in each lighting.")
            continue
        ranked = sorted((c for c in driven if c.real_ranks), key=lambda c: -c.real_ranks[0])
        best = [c for c in ranked if c.real_ranks[0] >= _POSSIBLY_BEST]
        if not best or (len(best) == 1 and best[0].real_ranks[0] <= 0.5):
            best = ranked[:_MOST_NAMED]
        if len(best) > 1:
            odds = join_names([f"{c.policy} ({format_probability(c.real_ranks[0])})" for c in best], _MOST_NAMED)
            out.append(
                f"{task}: drive these again; each may be the best policy, with the probability in parentheses: {odds}."
            )
        elif best:
            out.append(f"{task}: drive {best[0].policy} on further days, in new lightings; it is probably the best.")
        if unseen := [c.policy for c in mine if not c.driven]:
            names = join_names(unseen, _MOST_NAMED)
            out.append(f"{task}: drive the policies without real trials, best in the twin first: {names}.")
    return out


def allocation_text(allocation: TrialAllocation) -> str:
    """States how many further real trials find the best policy, and how many find the order of all policies."""
    if allocation.policies < 2:
        return f"{allocation.task}: one policy; there is nothing to rank."

    def needed(trials: int | None, purpose: str, now: float | None, of: str) -> str:
        many = f"more than {MAX_TRIALS}" if trials is None else f"{trials} more" if trials else "no more"
        each = "" if trials == 0 else " each"
        known = allocation.basis != "twin" and now is not None
        sure = f" (now {format_probability(now)} {of})" if known and now is not None else ""
        return f"{many} real trials{each} to {purpose}{sure}"

    so_far = "" if allocation.basis == "road" else "too few real trials yet; if the road had the twin’s rates: "
    winner = needed(allocation.more_for_winner, "find the best one", allocation.winner_now, "probability")
    order = needed(allocation.more_for_order, "order all of them", allocation.order_now, "of pairs in the right order")
    return f"{allocation.task}, {allocation.policies} policies: {so_far}{winner}; {order}."


# ---- printed summary and table


def summary_text(forecast: Forecast) -> str:
    lines = []
    for task in forecast.tasks:
        mine = forecast.candidates_of(task)
        width = max(len("policy"), *(len(c.policy) for c in mine))
        row = f"  {{:<{width}}}  {{:<20}}  {{:<10}}  {{:<20}}  {{}}".format
        lines += [f"{task}: success, with 90% intervals; ranks in the twin, 1 is best"]
        lines += [row("policy", "twin", "rank", "road", "predicted for the road")]
        for c in mine:
            ranks = f"{c.twin_rank.low:.0f} to {c.twin_rank.high:.0f}"
            road, predicted = format_estimate(c.real, True, "not driven"), format_estimate(c.corrected, True)
            lines.append(row(c.policy, format_estimate(c.twin, True), ranks, road, predicted).rstrip())
        lines.append("")
    groups = [group for group in forecast.groups if not group.missing]
    if groups:
        lines.append(f"  {'':<18}" + "".join(f"{g.task + f' (n = {g.policies})':<26}" for g in groups).rstrip())
        for name, title, _ in STATISTICS:
            values = [format_estimate(getattr(group, name), name in PERCENT_STATISTICS) for group in groups]
            lines.append(f"  {title:<18}{''.join(f'{value:<26}' for value in values)}".rstrip())
        lines += ["", *_score_lines(groups[-1]), "", *textwrap.wrap(INTERVALS_NOTE, 110), ""]
    lines += [f"{group.task}: no correlation: {'; '.join(group.missing)}" for group in forecast.groups if group.missing]
    lines += [allocation_text(allocation) for allocation in forecast.plans]
    lines += [verdict.text for verdict in verdicts(forecast)]
    if not forecast.groups:
        lines.append(limitations(forecast)[0].what)
    return "\n".join(lines)


def _score_lines(group: Agreement) -> list[str]:
    """Lines of a table with each predictor's scores over the cells of a group."""
    width = max(len(it.predictor) for it in group.scores)
    row = f"  {{:<{width}}}  {{:<7}}  {{:<7}}  {{}}".format
    lines = [row(f"{group.task}: scores, 0 is best", "Brier", "log", "the twin's log score is better by")]
    for it in group.scores:
        numbers = (format_estimate(e, digits=3) for e in (it.brier, it.log, it.gain))
        lines.append(row(it.predictor, *numbers).rstrip())
    return lines


def candidates_csv(forecast: Forecast) -> str:
    """Content of `forecast.csv`: one row per candidate. A cell is empty if its number is missing."""
    rows = []
    for c in forecast.candidates:
        numbers = [
            *(c.twin.value, c.twin.low, c.twin.high, c.twin.n, c.twin_rank.value, c.twin_rank.low, c.twin_rank.high),
            *(c.twin_ranks[0], c.real.value, c.real.low, c.real.high, c.real.n, *(c.real_ranks[:1] or [None])),
            *(c.corrected.value, c.corrected.low, c.corrected.high, c.trained.value, c.trained.low, c.trained.high),
        ]
        rows.append((c.task, c.policy, *("" if x is None else f"{x:.4f}".rstrip("0").rstrip(".") for x in numbers)))
    return csv_text(CSV_COLUMNS, rows)
