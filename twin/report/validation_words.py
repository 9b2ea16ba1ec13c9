"""What a validation says in words: why episodes failed, who is better, what the numbers cannot tell. No HTML here.

`said` is what `summary.json` holds, see `validation.summary` and `twin.validate`.
"""

from typing import Any

from twin.config import ANY, HELD_OUT, RANDOMISED, TRAINING
from twin.report.forecast import Estimate
from twin.report.forecast_words import show
from twin.report.words import Caution, Verdict, listing

LUCK = 0.1
"""A paired difference that luck alone would bring more often than this is called within chance."""
FEW = 30
"""Episodes in a cell below which the intervals are called wide."""
FAILURES = {
    "collision": ("hit something", "touched anything solid but the ground"),
    "out_of_bounds": ("left the corridor", "its middle was more than half the corridor’s width off the route"),
    "timeout": ("ran out of time", "drove on without arriving within the time limit"),
    "rollover": ("rolled over", "tipped onto its side"),
    "stuck": ("got stuck", "stood still too long"),
}
"""Cause of failure → what it is called, and what it means."""
LIGHTS = {
    HELD_OUT: "another light for every episode, drawn from those that no training may show",
    TRAINING: "another light for every episode, drawn from those that trainings show",
    ANY: "another light for every episode, any that could have been filmed",
}
"""Lightings that are sets, explained."""

_GOOD, _MIXED = 0.9, 0.5


def percent(rate: dict[str, Any]) -> str:
    """ "93% (87% to 96%)", or a dash where there was nothing to count."""
    return show(Estimate(rate["rate"], rate["low"], rate["high"], rate["trials"]), percent=True)


def why(cell: dict[str, Any]) -> str:
    """ "9 left the corridor, 2 hit something", most first; empty where none failed."""
    causes = sorted(cell["causes"].items(), key=lambda item: -item[1])
    return ", ".join(f"{n} {FAILURES[cause][0]}" for cause, n in causes)


def light_words(lighting: str) -> str:
    """What a lighting of the tables is."""
    if lighting.endswith(RANDOMISED):
        plain = light_words(lighting.removesuffix(RANDOMISED))
        return (
            f"{plain}; and for every episode another sun, other shadows, haze unless a photo told the air, things "
            "beside the corridor, and another robot but for what is known of yours"
        )
    if lighting.startswith("drawn_"):
        return f"light number {lighting[6:]} of those drawn in the search"
    if lighting.count(":") == 2:
        a, b, part = lighting.split(":")
        return f"{float(part):.0%} of the way from {a} to {b}"
    return LIGHTS.get(lighting, "this one light in every episode")


def trained_words(trained: dict[str, Any]) -> str:
    """What a training was: "on straight, in varying light"."""
    if trained["observe"] == "simulator":
        return f"on {trained['task']}, from MuJoCo’s picture of the mesh"
    light = "in varying light" if trained["lighting"] in (TRAINING, ANY) else f"in the light {trained['lighting']}"
    return f"on {trained['task']}, {light}"


def verdicts(said: dict[str, Any]) -> list[Verdict]:
    """The headlines: for every task who arrives most often and where it fares worst."""
    out = []
    for task in tasks(said):
        by_policy: dict[str, list[dict[str, Any]]] = {}
        for cell in said["cells"]:
            if cell["task"] == task:
                by_policy.setdefault(cell["policy"], []).append(cell)
        # Only lightings that all have driven in compare them fairly.
        common = set.intersection(*({c["lighting"] for c in cells} for cells in by_policy.values()))
        if not common:
            out.append(Verdict(f"On {task} no lighting was driven in by all policies: there is no best one.", "mixed"))
            continue
        means = {
            policy: sum(c["rate"] for c in cells if c["lighting"] in common) / len(common)
            for policy, cells in by_policy.items()
        }
        best = max(means, key=lambda policy: means[policy])
        cells = [c for c in by_policy[best] if c["lighting"] in common]
        won, of = sum(c["successes"] for c in cells), sum(c["trials"] for c in cells)
        tied = [policy for policy in means if means[policy] == means[best] and policy != best]
        lead = " most often" if len(by_policy) > 1 and not tied else ""
        text = f"On {task}, {best} reaches the goal{lead}: in {won} of {of} episodes"
        every = dict.fromkeys(c["lighting"] for c in said["cells"] if c["task"] == task)
        if len(common) < len(every):
            text += f" in the light that all have driven in ({listing(name for name in every if name in common)})"
        text += f", and so does {listing(tied)} as often" if tied else ""
        weakest = min(cells, key=lambda c: c["rate"])
        if weakest["rate"] < max(c["rate"] for c in cells):
            text += f"; least often in the light {weakest['lighting']}, {weakest['successes']} of {weakest['trials']}"
        mood = "good" if means[best] >= _GOOD else "mixed" if means[best] >= _MIXED else "bad"
        out.append(Verdict(f"{text}.", mood))
    low, of = (sum(c[k]["trials"] for c in said["cells"]) for k in ("low_trust", "trusted"))
    if low:
        text = f"In {low} of {low + of} episodes the pictures are not to be trusted; they are counted apart below."
        out.append(Verdict(text, "mixed"))
    return out


def pair_words(pair: dict[str, Any]) -> str:
    """Whether a paired difference is more than luck."""
    if pair["only_a"] == pair["only_b"]:
        return "no difference"
    return (
        "within chance" if pair["p"] > LUCK else f"{'first' if pair['only_a'] > pair['only_b'] else 'second'} is better"
    )


def chance_words(p: float) -> str:
    """How often luck alone would do it."""
    return "<0.1%" if p < 0.001 else f"{100 * p:.1f}%" if p < LUCK else f"{p:.0%}"


def unknowns(said: dict[str, Any]) -> list[Caution]:
    """What the numbers cannot tell, and what would."""
    out = [
        Caution(
            "Success here is success in the twin. How often it means success on the road is another question.",
            "drive some of the policies on the road and run python -m twin.forecast.",
        )
    ]
    few = [c for c in said["cells"] if c["trials"] < FEW]
    if few:
        smallest = min(c["trials"] for c in few)
        out.append(
            Caution(
                f"{len(few)} of {len(said['cells'])} rates come from fewer than {FEW} episodes (the least: "
                f"{smallest}), so their intervals are wide.",
                "run the same command with more --episodes; what was driven is kept.",
            )
        )
    drawn = dict.fromkeys(c["lighting"] for c in said["cells"] if c["lighting"].endswith(RANDOMISED))
    if drawn and not said.get("robot_known"):
        out.append(
            Caution(
                f"What your robot does: under {listing(drawn)} another one drives every episode, for nothing is known "
                "of yours.",
                "log five minutes of driving, run python -m twin.align, build again and validate anew.",
            )
        )
    searched = {(w["policy"], w["task"]) for w in said.get("worst", [])}
    left = dict.fromkeys(c["policy"] for c in said["cells"] if (c["policy"], c["task"]) not in searched)
    if left:
        out.append(
            Caution(
                f"The worst light that {listing(left)} might meet was not searched for.",
                "run the same command with --worst.",
            )
        )
    return out


def tasks(said: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(c["task"] for c in said["cells"]))
