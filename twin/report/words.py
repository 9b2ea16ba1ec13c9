"""What a report is made of in words: numbers that may be missing, and the headlines they come to. No HTML here.

A *verdict* is a sentence that a newcomer understands, with a mood: good, mixed, bad or plain. A *fact* is a number with
its unit and what it means. A *caution* names what is wrong and its *cure*. Whatever a stage did not report is "not
measured"; nothing is made up.

A section has a verdict and cautions; `Section.headline` is the verdict, at best mixed where there is a caution. Every
summary is made of headlines and cautions of sections, so no summary is better than what it sums up.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

NOT_MEASURED = "not measured"

# From where on a number is worth a warning.
ENOUGH_REGISTERED = 0.9  # share of frames
LARGE_SCALE_UNCERTAINTY = 0.03  # relative
LOW_PSNR = 18.0  # [dB]
LARGE_PATH_ERROR = 0.08  # [m]

MOOD_WORDS = {"good": "good", "mixed": "caution", "bad": "bad", "plain": ""}


@dataclass(frozen=True)
class Verdict:
    text: str
    mood: str = "plain"
    """good, mixed, bad or plain."""

    @property
    def word(self) -> str:
        """The mood for those who do not see its colour; empty where it is plain."""
        return MOOD_WORDS[self.mood]


@dataclass(frozen=True)
class Fact:
    name: str
    value: str
    meaning: str = ""


@dataclass(frozen=True)
class Caution:
    what: str
    cure: str


@dataclass(frozen=True)
class Section:
    """One stage in the report, or what is told beside the stages."""

    name: str
    """Stage name, as in `report.json`; or "seen_touched", "truth", "costs"."""
    title: str
    done: str
    """What the stage did, for somebody who sees twin for the first time."""
    facts: list[Fact] = field(default_factory=list)
    cautions: list[Caution] = field(default_factory=list)
    not_applicable: str = ""
    """Why there is nothing to show; empty where there is."""
    verdict: Verdict | None = None
    """The section in one sentence; None where nothing was measured."""

    @property
    def headline(self) -> Verdict | None:
        """The verdict, or else the title where there are cautions. With cautions its mood is mixed, or bad."""
        if not self.cautions:
            return self.verdict
        if self.verdict is None:
            return Verdict(f"{self.title}.", "mixed")
        return self.verdict if self.verdict.mood == "bad" else replace(self.verdict, mood="mixed")


def pick(report: Any, path: str) -> Any:
    """The value at a dotted path, or None where there is none."""
    for key in path.split("."):
        report = report.get(key) if isinstance(report, dict) else None
    return report


def number(value: Any, form: str = "{:.3g}") -> str:
    """A number in a format such as "{:.1f} m", or "not measured"."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return NOT_MEASURED
    return form.format(value).replace("-", "−") if value < 0 else form.format(value)


def duration(seconds: Any) -> str:
    """Seconds as "8.2 s" or "3 min 05 s"."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        return NOT_MEASURED
    if round(seconds, 1) < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def listing(names: Iterable[str], most: int = 4) -> str:
    """ "a", "a and b", "a, b and c"; beyond `most`, how many more there are."""
    names = [str(name) for name in names]
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} more"]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else "none"


def flat(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Every plain number and word below a JSON value with its dotted path; long lists are only counted."""
    if isinstance(value, dict):
        return [row for key, below in value.items() for row in flat(below, f"{prefix}.{key}" if prefix else str(key))]
    if isinstance(value, list):
        if len(value) > 8 or any(isinstance(item, dict | list) for item in value):
            return [(prefix, f"{len(value)} values")]
        return [(prefix, ", ".join(plain(item) for item in value) or "none")]
    return [(prefix, plain(value))]


def plain(value: Any) -> str:
    if value is None:
        return NOT_MEASURED
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def numbers(value: Any) -> dict[str, float]:
    table = value if isinstance(value, dict) else {}
    return {str(k): float(v) for k, v in table.items() if isinstance(v, int | float) and not isinstance(v, bool)}


def scale_uncertainty(report: dict[str, Any]) -> float | None:
    value = pick(report, "metric.scale_uncertainty")
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def source_words(source: str) -> str:
    return {
        "camera_height": "the camera’s height above the ground",
        "distance": "a distance measured between two marked points",
        "marker": "a printed marker of known size",
        "gps": "the GPS positions of the images",
        "poses": "the given poses, which are metric already",
        "poses_are_metric": "the given poses, which are metric already",
    }.get(str(source), str(source))


def follower_verdict(report: dict[str, Any]) -> Verdict:
    """Whether the Husky got through, in one sentence."""
    follower = pick(report, "review.follower")
    if not isinstance(follower, dict):
        reason = pick(report, "review.not_applicable") or "this build has no drive"
        return Verdict(f"No robot was driven here: {reason}.")
    length = number(pick(report, "mjcf.route_length_m"), "{:.1f} m ")
    length = "" if length == NOT_MEASURED else length
    touched = follower.get("touched")
    contact = "what it touched was not measured"
    if isinstance(touched, list):
        contact = f"touched {listing(touched)}" if touched else "touched nothing but the ground"
    if follower.get("reached_goal"):
        return Verdict(
            f"The Husky followed the {length}route from start to end and {contact}.",
            "mixed" if touched or touched is None else "good",
        )
    gone = number(follower.get("distance_m"), "it came {:.1f} m far")
    gone = "" if gone == NOT_MEASURED else f"{gone} and "
    return Verdict(f"The Husky did not reach the end of the {length}route: {gone}{contact}.", "bad")
