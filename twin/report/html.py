"""Parts that the reports share: types of their content, number formatting, and the Jinja environment of their pages.

A report consists of sections with verdicts, facts and cautions. A number that a stage did not report is shown as "not
measured". A summary repeats the headlines and cautions of the sections, so it is never more favorable than they are.
The templates of the pages are `templates/*.html`; they escape every text that is not `Markup`.
"""

import base64
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from twin.errors import join_names

# ---- content of a report, without HTML

NOT_MEASURED = "not measured"

MOOD_WORDS = {"good": "good", "mixed": "caution", "bad": "bad", "plain": ""}


@dataclass(frozen=True)
class Verdict:
    """A finding in one sentence for newcomers. Its mood says how good or bad the finding is."""

    text: str
    mood: str = "plain"
    """good, mixed, bad or plain."""

    @property
    def word(self) -> str:
        """The mood in words, for readers who do not see its color; empty for plain."""
        return MOOD_WORDS[self.mood]


@dataclass(frozen=True)
class Fact:
    """A number with its unit and meaning."""

    name: str
    value: str
    meaning: str = ""


@dataclass(frozen=True)
class Caution:
    what: str
    cure: str


@dataclass(frozen=True)
class Section:
    """A report's section on a stage of the build, or on a topic beside the stages."""

    name: str
    """Name of the stage or topic, as in `report.json`; the topics are "seen_touched", "truth" and "costs"."""
    title: str
    done: str
    """Description of what the stage did, for newcomers."""
    facts: list[Fact] = field(default_factory=list)
    cautions: list[Caution] = field(default_factory=list)
    not_applicable: str = ""
    """Reason why the section has no content; else empty."""
    verdict: Verdict | None = None
    """Summary in one sentence; None if nothing was measured."""

    @property
    def headline(self) -> Verdict | None:
        """The verdict; without one, the title if there are cautions, else None.

        If there are cautions, the mood is "mixed", or "bad" if the verdict's mood is "bad".
        """
        if not self.cautions:
            return self.verdict
        if self.verdict is None:
            return Verdict(f"{self.title}.", "mixed")
        return self.verdict if self.verdict.mood == "bad" else replace(self.verdict, mood="mixed")


def as_number(value: Any) -> float | None:
    """The value if it is a number, else None."""
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def pick(report: Any, path: str) -> Any:
    """Returns the value at a dotted path, or None."""
    for key in path.split("."):
        report = report.get(key) if isinstance(report, dict) else None
    return report


def number(value: Any, form: str = "{:.3g}") -> str:
    """Formats a number, for instance with "{:.1f} m". Returns "not measured" for anything that is not a number."""
    if (value := as_number(value)) is None:
        return NOT_MEASURED
    return form.format(value).replace("-", "−") if value < 0 else form.format(value)


def counted(n: int, one: str, many: str = "") -> str:
    """A number with its noun; the noun's plural is `many`, or has an s."""
    return f"{n} {one if n == 1 else many or f'{one}s'}"


def duration(seconds: Any) -> str:
    """Formats seconds as "8.2 s" or "3 min 05 s"."""
    if (seconds := as_number(seconds)) is None:
        return NOT_MEASURED
    if round(seconds, 1) < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Lists the numbers and words of a JSON value with their dotted paths.

    A long or nested list is replaced by its length.
    """
    if isinstance(value, dict):
        return [
            row for key, below in value.items() for row in flatten(below, f"{prefix}.{key}" if prefix else str(key))
        ]
    if isinstance(value, list):
        if len(value) > 8 or any(isinstance(item, dict | list) for item in value):
            return [(prefix, f"{len(value)} values")]
        return [(prefix, ", ".join(format_value(item) for item in value) or "none")]
    return [(prefix, format_value(value))]


def format_value(value: Any) -> str:
    if value is None:
        return NOT_MEASURED
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def numbers(value: Any) -> dict[str, float]:
    """The entries of a table that are numbers; empty for anything but a table."""
    table = value if isinstance(value, dict) else {}
    return {str(k): float(v) for k, v in table.items() if as_number(v) is not None}


Row = tuple[str, str, str, str]
"""Path of a number in the report, its name, its format, and its meaning."""
Limit = tuple[str, float, str, str]
"""Path of a number in the report, limit of its magnitude, caution if it exceeds the limit, and cure."""


def facts_of(report: dict[str, Any], *rows: Row) -> list[Fact]:
    """A fact for each row; its value is "not measured" if the report lacks the number."""
    return [Fact(name, number(pick(report, path), form), meaning) for path, name, form, meaning in rows]


def cautions_above(report: dict[str, Any], *limits: Limit) -> list[Caution]:
    """Cautions about the numbers whose magnitude exceeds their limit.

    The caution in a `Limit` is a format string for the magnitude and the limit.
    """
    return [
        Caution(what.format(abs(x), limit), cure)
        for path, limit, what, cure in limits
        if (x := as_number(pick(report, path))) is not None and abs(x) > limit
    ]


def follower_verdict(report: dict[str, Any]) -> Verdict:
    """Outcome of the scripted driver's drive along the route, and of those along the branches if there are any."""
    follower = pick(report, "review.follower")
    if not isinstance(follower, dict):
        reason = pick(report, "review.not_applicable") or "this build has no drive"
        return Verdict(f"No robot was driven here: {reason}.")
    meters, gone = as_number(pick(report, "mjcf.route_length_m")), as_number(follower.get("distance_m"))
    length = "" if meters is None else f"{meters:.1f} m "
    touched = follower.get("touched")
    contact = "its contacts were not measured"
    if isinstance(touched, list):
        contact = f"touched {join_names(touched)}" if touched else "touched nothing but the ground"
    branches = pick(report, "review.branches")
    branches = branches if isinstance(branches, dict) else {}
    arrived = [f"branch {name}" for name, drive in branches.items() if pick(drive, "reached_goal")]
    missed = [
        f" On branch {name} it {f'touched {join_names(hit)}' if (hit := pick(drive, 'touched')) else 'did not arrive'}."
        for name, drive in branches.items()
        if not pick(drive, "reached_goal")
    ]
    if follower.get("reached_goal"):
        lines = join_names([f"the {length}route", *arrived])
        return Verdict(
            f"The Husky followed {lines} from start to end and {contact}.{''.join(missed)}",
            "mixed" if touched or touched is None or missed else "good",
        )
    driven = "" if gone is None else f"it drove {gone:.1f} m and "
    also = [f" It followed {join_names(arrived)} from start to end."] if arrived else []
    rest = "".join(also + missed)
    return Verdict(f"The Husky did not reach the end of the {length}route: {driven}{contact}.{rest}", "bad")


# ---- HTML

MAX_TABLE_ROWS = 24
"""A table with more rows is collapsed; a figure above it shows the same data."""

_STRIP_ASPECT = 2.4  # pictures with a larger ratio of width to height span the page


@dataclass(frozen=True)
class Chart:
    """A figure with its heading, which is also its accessible name."""

    title: str
    svg: str
    """An inline SVG element, see `twin.report.figures.svg`."""
    section: str = ""

    @property
    def markup(self) -> Markup:
        return Markup('<svg role="img" aria-label="{}"').format(self.title) + Markup(self.svg.removeprefix("<svg"))


@dataclass(frozen=True)
class Picture:
    """A JPEG or PNG, embedded in the page, with its caption."""

    path: Path
    caption: str
    section: str = ""

    @property
    def url(self) -> str:
        return data_url(self.path)

    @property
    def is_strip(self) -> bool:
        """True for wide pictures, which span the page."""
        with Image.open(self.path) as image:
            return image.width > _STRIP_ASPECT * image.height


def data_url(path: Path) -> str:
    kind = "png" if path.suffix == ".png" else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def command(verb: str, *arguments: object) -> str:
    """A command of this package for a shell, with quoted arguments."""
    return shlex.join(["twin", verb, *map(str, arguments)])


_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).with_name("templates")),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.globals |= {"MAX_TABLE_ROWS": MAX_TABLE_ROWS, "NOT_MEASURED": NOT_MEASURED, "duration": duration}


def render(template: str, **data: Any) -> str:
    """Returns a whole page; `template` is a file in `templates/`. Raises jinja2.UndefinedError if data is missing."""
    return _TEMPLATES.get_template(template).render(data)
