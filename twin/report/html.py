"""HTML and text elements shared by the reports, and the style of their pages.

A report consists of sections with verdicts, facts and cautions; numbers that a stage did not report are "not measured".
Summaries contain headlines and cautions of sections only, so no summary is better than what it summarizes. `element`
escapes text unless it is `Html` already.
"""

import base64
import html
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from PIL import Image

from twin.errors import join_names

# ---- content of a report, without HTML

NOT_MEASURED = "not measured"

MOOD_WORDS = {"good": "good", "mixed": "caution", "bad": "bad", "plain": ""}


@dataclass(frozen=True)
class Verdict:
    """A sentence for newcomers with a mood."""

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
    """A stage of the build, or a topic beside the stages, in the report."""

    name: str
    """Stage name, as in `report.json`; or "seen_touched", "truth", "costs"."""
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
        """The verdict, or the title if there are cautions only; cautions lower its mood to mixed at best."""
        if not self.cautions:
            return self.verdict
        if self.verdict is None:
            return Verdict(f"{self.title}.", "mixed")
        return self.verdict if self.verdict.mood == "bad" else replace(self.verdict, mood="mixed")


def pick(report: Any, path: str) -> Any:
    """Returns the value at a dotted path, or None."""
    for key in path.split("."):
        report = report.get(key) if isinstance(report, dict) else None
    return report


def number(value: Any, form: str = "{:.3g}") -> str:
    """Formats a number, for instance with "{:.1f} m"; "not measured" for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return NOT_MEASURED
    return form.format(value).replace("-", "−") if value < 0 else form.format(value)


def duration(seconds: Any) -> str:
    """Formats seconds as "8.2 s" or "3 min 05 s"."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        return NOT_MEASURED
    if round(seconds, 1) < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Lists the numbers and words of a JSON value with their dotted paths; long lists are only counted."""
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
    table = value if isinstance(value, dict) else {}
    return {str(k): float(v) for k, v in table.items() if isinstance(v, int | float) and not isinstance(v, bool)}


def follower_verdict(report: dict[str, Any]) -> Verdict:
    """Outcome of the scripted drive in one sentence."""
    follower = pick(report, "review.follower")
    if not isinstance(follower, dict):
        reason = pick(report, "review.not_applicable") or "this build has no drive"
        return Verdict(f"No robot was driven here: {reason}.")
    length = number(pick(report, "mjcf.route_length_m"), "{:.1f} m ")
    length = "" if length == NOT_MEASURED else length
    touched = follower.get("touched")
    contact = "its contacts were not measured"
    if isinstance(touched, list):
        contact = f"touched {join_names(touched)}" if touched else "touched nothing but the ground"
    if follower.get("reached_goal"):
        return Verdict(
            f"The Husky followed the {length}route from start to end and {contact}.",
            "mixed" if touched or touched is None else "good",
        )
    gone = number(follower.get("distance_m"), "it drove {:.1f} m")
    gone = "" if gone == NOT_MEASURED else f"{gone} and "
    return Verdict(f"The Husky did not reach the end of the {length}route: {gone}{contact}.", "bad")


# ---- HTML

MAX_TABLE_ROWS = 24
"""Longer tables are collapsed, below a figure of the same data."""

_STRIP_ASPECT = 2.4  # width over height from which on a picture spans the page


class Html(str):
    """Text that is HTML already and is not escaped again."""

    __slots__ = ()


_VOID = frozenset({"img", "meta", "source", "br"})


def element(tag: str, *children: str, **attributes: str | bool | None) -> Html:
    """Returns an element; escapes children unless they are Html.

    Attribute names lose a trailing underscore (`class_`); other underscores become hyphens. True gives a bare
    attribute; False and None leave it out.
    """
    parts = [tag]
    for key, value in attributes.items():
        name = key.rstrip("_").replace("_", "-")
        if value is True:
            parts.append(name)
        elif value is not None and value is not False:
            parts.append(f'{name}="{html.escape(str(value), quote=True)}"')
    opening = "<" + " ".join(parts) + ">"
    return Html(opening) if tag in _VOID else Html(f"{opening}{join(*children)}</{tag}>")


def join(*children: str) -> Html:
    """Concatenates children; escapes them unless they are Html."""
    return Html("".join(child if isinstance(child, Html) else html.escape(child, quote=False) for child in children))


def document(title: str, style: str, *body: str) -> str:
    """A whole page; `style` is appended to `STYLE`."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", title),
        element("style", Html(STYLE + style)),
    )
    return "<!DOCTYPE html>\n" + element("html", head, element("body", element("main", *body)), lang="en") + "\n"


def caution(it: Caution) -> Html:
    return element("div", element("b", it.what), f"What helps: {it.cure}", class_="caution", role="note")


def headline(it: Verdict, *below: str) -> Html:
    """List item of a verdict: mood, sentence, and further content."""
    word = element("b", f"{it.word}:", class_="mood") if it.word else ""
    return element("li", word, " " if word else "", it.text, *below, class_=it.mood)


def table(head: list[str], rows: list[list[str]], numeric: tuple[int, ...] = ()) -> Html:

    def row(kind: str, cells: list[str]) -> Html:
        return element("tr", *(element(kind, c, class_="n" if i in numeric else None) for i, c in enumerate(cells)))

    body = element("table", element("thead", row("th", head)), element("tbody", *(row("td", cells) for cells in rows)))
    return element("div", body, class_="scroll")


def folded(title: str, *content: str) -> Html:
    return element("details", element("summary", title), *content)


def picture(path: Path, caption: str) -> Html:
    """A JPEG or PNG embedded in the page, with its caption; wide strips span the page."""
    with Image.open(path) as image:
        width, height = image.size
    return element(
        "figure",
        element("img", src=data_url(path), alt=caption, loading="lazy"),
        element("figcaption", caption),
        class_="strip" if width > _STRIP_ASPECT * height else None,
    )


def chart(title: str, drawing: str) -> Html:
    return element("div", element("h3", title), Html(drawing))


def page_header(title: str, kicker: str, *verdicts: Html) -> Html:
    """Header of a page: title, one line of description, and its verdicts."""
    return element(
        "header",
        element("h1", title),
        element("p", kicker, class_="kicker"),
        element("ul", *verdicts, class_="verdicts"),
        class_="top",
    )


def data_url(path: Path) -> str:
    kind = "png" if path.suffix == ".png" else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


STYLE = """
:root { color-scheme: light dark;
  --page:#f4f6f8; --card:#fff; --sunken:#eef1f5; --ink:#17202b; --muted:#5a6675; --line:#dbe1e8; --link:#1a5fc4;
  --good:#1f8a4c; --mixed:#a86a05; --bad:#c23a2b; --plain:#5a6675;
  --c1:#2472e0; --c2:#d1482f; --c3:#279a58; --c4:#8a5cd6; --c5:#b7791f; --c6:#0e8a93 }
@media (prefers-color-scheme: dark) { :root {
  --page:#0f1318; --card:#171d25; --sunken:#202832; --ink:#e8ecf2; --muted:#9aa6b5; --line:#2c3642; --link:#7db8ff;
  --good:#5cd08c; --mixed:#f0b64c; --bad:#ff8273; --plain:#9aa6b5;
  --c1:#66adff; --c2:#ff8069; --c3:#58cf8d; --c4:#b795ff; --c5:#e2ad57; --c6:#4fc4cd } }
* { box-sizing:border-box }
body { margin:0; background:var(--page); color:var(--ink); font:16px/1.55 system-ui, sans-serif;
  overflow-wrap:anywhere; -webkit-text-size-adjust:100% }
main { max-width:1080px; margin:0 auto; padding:24px 16px 64px }
a { color:var(--link) }
h1 { font-size:clamp(1.5rem, 5vw, 2.1rem); line-height:1.2; margin:0 0 4px }
h2 { font-size:1.25rem; line-height:1.3; margin:0 0 6px }
h2 small { color:var(--muted); font-weight:400; margin-right:.4em }
.kicker, .done, figcaption, .meaning { color:var(--muted) }
.kicker { margin:0 0 18px } .done { margin:0 0 16px; max-width:72ch }
section, header.top { background:var(--card); border:1px solid var(--line); border-radius:12px; padding:20px;
  margin:0 0 18px; scroll-margin-top:12px }
ul.verdicts { list-style:none; margin:0; padding:0 } ul.verdicts li { padding:7px 0 7px 22px; position:relative }
ul.verdicts li::before { content:""; position:absolute; left:0; top:1em; width:11px; height:11px; border-radius:50%;
  background:var(--plain) }
ul.verdicts > li:first-child { font-size:clamp(1.1rem, 3.4vw, 1.35rem); font-weight:600; line-height:1.35 }
ul.verdicts li.good::before { background:var(--good) } ul.verdicts li.mixed::before { background:var(--mixed) }
ul.verdicts li.bad::before { background:var(--bad) }
ul.verdicts .mood { font-size:.8em; font-weight:600 } ul.verdicts li.good .mood { color:var(--good) }
ul.verdicts li.mixed .mood { color:var(--mixed) } ul.verdicts li.bad .mood { color:var(--bad) }
ul.verdicts ul { margin:2px 0 0; padding-left:18px; font-size:1rem; font-weight:400; line-height:1.55 }
ul.verdicts ul li { padding:2px 0 } ul.verdicts ul li::before { content:none !important }
nav { display:flex; flex-wrap:wrap; gap:8px; margin:0 0 18px }
nav a { text-decoration:none; background:var(--card); border:1px solid var(--line); border-radius:999px;
  padding:3px 12px; font-size:.9rem }
dl { display:grid; grid-template-columns:repeat(auto-fill, minmax(190px, 1fr)); gap:10px; margin:0 0 16px }
dl div { background:var(--sunken); border-radius:8px; padding:9px 12px }
dt { font-size:.82rem; color:var(--muted) } dd { margin:0 } dd b { font-size:1.08rem; font-weight:600; display:block }
dd .meaning { font-size:.82rem; display:block; line-height:1.35 } dd.none b { color:var(--muted); font-weight:400 }
.caution { border-left:4px solid var(--mixed); background:var(--sunken); border-radius:0 8px 8px 0; padding:9px 14px;
  margin:0 0 12px } .caution b { display:block } .na { color:var(--muted); font-style:italic; margin:0 0 16px }
figure { margin:0 0 16px; min-width:0 } figcaption { font-size:.86rem; line-height:1.4; margin-top:5px }
img, video { display:block; width:100%; height:auto; border-radius:8px; background:#000 }
.pictures { display:grid; grid-template-columns:repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap:0 16px }
.pictures .strip { grid-column:1 / -1 }
.charts { display:grid; grid-template-columns:repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap:8px 24px;
  align-items:start } .charts svg { display:block; width:100%; max-width:560px; height:auto }
.charts > :only-child { max-width:720px } .charts > :only-child svg { max-width:none }
.charts svg * { stroke-linejoin:round; stroke-linecap:butt }
.charts svg text { font-family:system-ui, sans-serif !important } .charts h3 { font-size:.95rem; margin:0 0 4px }
.scroll { overflow-x:auto; margin:0 0 12px } table { border-collapse:collapse; width:100%; font-size:.92rem }
th, td { text-align:left; padding:5px 10px 5px 0; border-bottom:1px solid var(--line); vertical-align:top }
th { color:var(--muted); font-weight:500 }
.n { text-align:right; font-variant-numeric:tabular-nums; white-space:nowrap }
.bar { display:block; margin-top:.5em; height:9px; border-radius:3px; background:var(--c1); min-width:2px }
#costs > .scroll td { overflow-wrap:normal } #costs > .scroll td:nth-child(3) { width:45%; min-width:40px }
details { margin:8px 0 0 } summary { cursor:pointer; color:var(--link); font-size:.92rem }
code { font:.88em ui-monospace, monospace } footer { color:var(--muted); font-size:.88rem }
@media (max-width:520px) { main { padding:12px 8px 40px } section, header.top { padding:14px 12px; border-radius:10px }
  dl { grid-template-columns:1fr 1fr; gap:8px } dl div { padding:8px 9px }
  #costs > .scroll td:nth-child(3) { width:15% } }
@media print { nav, video { display:none } section { break-inside:avoid } }
"""
