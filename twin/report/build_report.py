"""`report.html`: one file that tells a newcomer what was built, how good it is, and what to do about what is not.

Everything is inside the page but the film, which lies beside it; nothing is fetched. Pictures and figures come from the
stage folders, words from `twin.report.build_sections`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from twin.assets.ground import Ground
from twin.files import damaged, read_json, write_text
from twin.geometry.cameras import Cameras, SparsePoints
from twin.report import figures
from twin.report.build_sections import SECTIONS, costs_section, sections, summed_up
from twin.report.html import (
    NOT_MEASURED,
    Html,
    Section,
    caution,
    data_url,
    document,
    duration,
    element,
    flat,
    headline,
    join,
    number,
    numbers,
    pick,
    picture,
    table,
)
from twin.report.video_layout import footprints
from twin.scene import SceneDir, result_of
from twin.types import Array

# ---- Which figures a finished build can have: reads the artifacts that exist and the report, and draws each section's.


_WORST_REPROJECTION = 4.0  # [px], right end of the histogram
_LONGEST_TRACK = 30.0  # frames, right end of the histogram


@dataclass(frozen=True)
class Chart:
    """A figure under its title."""

    section: str
    title: str
    svg: str


def charts(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """Every figure that the build's artifacts and numbers allow."""
    return [*_place(scene, report), *_points(scene), *_field(report), *_drive(report), *_seen(report), *_truth(scene)]


def _place(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """The maps: what was seen, and what can be driven on."""
    folder = scene.stage("metric")
    if not (folder / "cameras.npz").exists():
        return []
    cameras = Cameras.load(folder)
    points = SparsePoints.load(folder) if (folder / "points.npz").exists() else SparsePoints.empty()
    mesh = scene.stage("mesh")
    ground = Ground.load(mesh) if (mesh / "ground.npz").exists() else None
    parts = _footprints(mesh / "parts.npz", ground)
    route = _route(mesh / "route.npz")
    half_width = pick(report, "mjcf.half_width_m")
    wide = float(half_width) if isinstance(half_width, int | float) else 0.0
    seen = figures.place_map(cameras.positions, cameras.sources, cameras.held_out, points.xyz, points.rgb, route, wide)
    out = [Chart("metric", "The place from above: points, cameras and route", figures.svg(seen))]
    if ground is not None:
        path = cameras.positions[:, :2] if route is None else route
        drawn = figures.ground_map(ground, path, route, wide, parts)
        out.append(Chart("mesh", "Ground and solid parts", figures.svg(drawn)))
    return out


def _footprints(path: Path, ground: Ground | None) -> list[Array]:
    if not path.exists():
        return []
    with np.load(path, allow_pickle=False) as data:
        return footprints(data["vertices"], data["vertex_start"], ground)


def _route(path: Path) -> Array | None:
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as data:
        return data["xy"].astype(np.float64)


def _points(scene: SceneDir) -> list[Chart]:
    """How well the reconstruction fits, in its own pixels."""
    folder = scene.stage("cameras")
    if not (folder / "points.npz").exists():
        return []
    points = SparsePoints.load(folder)
    if not len(points):
        return []
    error = figures.histogram(points.error, "reprojection error of a point [px]", _WORST_REPROJECTION)
    tracks = figures.histogram(points.track_length, "frames that saw a point", _LONGEST_TRACK, whole=True)
    return [
        Chart("cameras", "How far points are from where they were seen", figures.svg(error)),
        Chart("cameras", "How often points were seen again", figures.svg(tracks)),
    ]


def _field(report: dict[str, Any]) -> list[Chart]:
    out = []
    psnr = numbers(pick(report, "field.psnr"))
    if psnr:
        counts = {name: int(n) for name, n in numbers(pick(report, "field.n")).items()}
        drawn = figures.bars(psnr, counts, "dB", "PSNR on frames it never saw [dB]")
        out.append(Chart("field", "How alike a view is to the real frame", figures.svg(drawn)))
    curve = pick(report, "field.curve")
    if isinstance(curve, list) and len(curve) > 1 and all(isinstance(row, list) and len(row) == 2 for row in curve):
        steps, values = zip(*curve, strict=True)
        drawn = figures.training_curve(steps, values, "PSNR on training pixels [dB]")
        out.append(Chart("field", "How training went", figures.svg(drawn)))
    return out


def _drive(report: dict[str, Any]) -> list[Chart]:
    trace = pick(report, "review.trace")
    if not isinstance(trace, dict) or len(trace.get("progress_m") or []) < 2:
        return []
    half_width = pick(report, "mjcf.half_width_m")
    limit = float(half_width) if isinstance(half_width, int | float) else None
    off = figures.along_the_path(
        trace["progress_m"], {"cross-track": trace["cross_track_m"]}, "off the route [m], left is positive", limit
    )
    speed = figures.along_the_path(trace["progress_m"], {"speed": trace["speed_m_s"]}, "speed [m/s]", lowest=0.0)
    title = "How far off the route it drove" + ("" if limit is None else "; dashed: the corridor")
    return [Chart("review", title, figures.svg(off)), Chart("review", "How fast it drove", figures.svg(speed))]


def _seen(report: dict[str, Any]) -> list[Chart]:
    """Leaks, ghosts and the ground's error along the route."""
    along = pick(report, "seen_touched.along")
    if not isinstance(along, dict) or len(along.get("station_m") or []) < 2:
        return []
    known: dict[str, Sequence[float]] = {
        name: [float("nan") if value is None else float(value) for value in along[key]]
        for name, key in (("largest leak", "leak_m"), ("largest ghost", "ghost_m"), ("ground, median", "ground_m"))
    }
    drawn = figures.along_the_path(along["station_m"], known, "in the corridor [m]", lowest=0.0)
    return [Chart("seen_touched", "Seen but not solid, solid but not seen, along the route", figures.svg(drawn))]


def _truth(scene: SceneDir) -> list[Chart]:
    """Errors of the cameras along their path, where the truth is known."""
    compared = comparison_of(scene)
    if not compared:
        return []
    by_source = compared["camera_errors_m"]
    drawn = figures.errors_by_group(by_source, "camera off by [m]")
    return [Chart("truth", "Camera error along the films", figures.svg(drawn))]


def comparison_of(scene: SceneDir) -> dict[str, Any] | None:
    """The comparison of this very build with the known truth, as `python -m twin.reality compare` wrote it; else None.

    Returns:
        `figures` (see `twin.reality.comparison`), and `camera_errors_m`, by source [m].
    """
    if not scene.truth_json.exists():
        return None
    with damaged(scene.truth_json, f"run python -m twin.reality compare {scene.root}"):
        compared = dict(read_json(scene.truth_json))
        if any(not scene.stage(name).exists() or result_of(scene, name) != it for name, it in compared["of"].items()):
            return None  # of an earlier build
        return compared


_STAGE_WORDS = {name: make({}).title for name, make in SECTIONS.items()}


def write_page(scene: SceneDir, report: dict[str, Any]) -> None:
    """Writes `build/report.html` from a report and what its build left on disk; half a page is never seen.

    Args:
        scene: Where pictures and figures come from; what is missing is left out.
        report: As in `report.json`. Whatever it lacks is shown as not measured.
    """
    write_text(scene.report_html, page(scene, report))


def page(scene: SceneDir, report: dict[str, Any]) -> str:
    """The whole page."""
    drawn, kept = charts(scene, report), _pictures(scene)
    name = str(report.get("scene") or scene.root.name)
    told = [section for section in sections(report) if section.name != "costs"]
    return document(
        f"{name}: a twin's report",
        "",
        _header(name, report),
        _film(scene, kept),
        element("nav", *(element("a", s.title, href=f"#{s.name}") for s in told), element("a", "Costs", href="#costs")),
        *(_section(k + 1, s, report, drawn, kept) for k, s in enumerate(told)),
        _costs(report),
        element("footer", "Every number is in ", element("a", "report.json", href="report.json"), " beside this page."),
    )


def _header(name: str, report: dict[str, Any]) -> Html:
    seconds = report.get("seconds")
    if seconds is None:
        each = [pick(stage, "seconds") for stage in (report.get("stages") or {}).values()]
        seconds = sum(s for s in each if isinstance(s, int | float)) if each else None
    cost = f"built in {duration(seconds)}"
    memory = number(_gibibytes(report.get("peak_memory_bytes")), "{:.1f} GiB of memory at most")
    return element(
        "header",
        element("h1", name),
        element("p", f"A filmed place as a MuJoCo twin: {cost}, {memory}.", class_="kicker"),
        element("ul", *map(_summary, summed_up(report)), class_="verdicts"),
        class_="top",
    )


def _summary(section: Section) -> Html:
    """A section's headline with its cautions, which link to the section, where the cures are."""
    assert section.headline is not None
    below = [element("li", element("a", it.what, href=f"#{section.name}")) for it in section.cautions]
    return headline(section.headline, element("ul", *below) if below else "")


def _film(scene: SceneDir, kept: list[tuple[str, Path, str]]) -> Html:
    """The film, which lies beside the page, and its poster, which is in it."""
    if not (scene.stage("review") / "review.mp4").exists() and not scene.review_mp4.exists():
        return Html("")
    posters = [path for section, path, _ in kept if section == "poster"]
    # The last one is of the drive, where there is one.
    poster = data_url(posters[-1]) if posters else None
    return element(
        "section",
        element("video", src="review.mp4", poster=poster, controls=True, preload="none", playsinline=True),
        element(
            "p",
            "The film shows the real frames beside the twin’s, the light turning, and the drive. "
            "It lies beside this page: ",
            element("a", "review.mp4", href="review.mp4"),
            class_="meaning",
        ),
        id="film",
    )


def _pictures(scene: SceneDir) -> list[tuple[str, Path, str]]:
    """Section, file and caption of every picture the review kept."""
    folder = scene.stage("review")
    if not (folder / "review.json").exists():
        return []
    told = read_json(folder / "review.json").get("pictures", [])
    rows = [(str(row["section"]), folder / str(row["file"]), str(row["caption"])) for row in told]
    return [row for row in rows if row[1].is_file()]


def _section(
    position: int, section: Section, report: dict[str, Any], drawn: list[Chart], kept: list[tuple[str, Path, str]]
) -> Html:
    title = element("h2", element("small", str(position)) if section.name in SECTIONS else "", section.title)
    ran = section.name in report or section.name in (report.get("stages") or {})
    if not ran and section.name in SECTIONS:
        return element("section", title, element("p", "This stage has not run.", class_="na"), id=section.name)
    if section.not_applicable and not section.done:
        return element("section", title, _not_applicable(section), id=section.name)
    facts = [
        element(
            "div",
            element("dt", fact.name),
            element(
                "dd",
                element("b", fact.value),
                element("span", fact.meaning, class_="meaning"),
                class_="none" if fact.value == NOT_MEASURED else None,
            ),
        )
        for fact in section.facts
    ]
    pictures = [picture(path, caption) for name, path, caption in kept if name == section.name]
    figures = [element("div", element("h3", c.title), Html(c.svg)) for c in drawn if c.section == section.name]
    rows = flat(report.get(section.name))
    return element(
        "section",
        title,
        element("p", section.done, class_="done"),
        _not_applicable(section) if section.not_applicable else "",
        *map(caution, section.cautions),
        element("dl", *facts),
        element("div", *pictures, class_="pictures") if pictures else "",
        element("div", *figures, class_="charts") if figures else "",
        element(
            "details",
            element("summary", "All numbers of this stage"),
            table(["key", "value"], [[*row] for row in rows]),
        ),
        id=section.name,
    )


def _not_applicable(section: Section) -> Html:
    return element("p", f"Does not apply here: {section.not_applicable}.", class_="na")


def _gibibytes(size: Any) -> float | None:
    return size / 2**30 if isinstance(size, int | float) else None


def _costs(report: dict[str, Any]) -> Html:
    stages: dict[str, Any] = report.get("stages") or {}
    seconds = {name: pick(stage, "seconds") for name, stage in stages.items()}
    longest = max([s for s in seconds.values() if isinstance(s, int | float)], default=0.0)
    rows = []
    for name, stage in stages.items():
        spent = seconds[name]
        share = 100.0 * spent / longest if isinstance(spent, int | float) and longest > 0 else 0.0
        rows.append(
            [
                _STAGE_WORDS.get(name, name) + (" (up to date)" if pick(stage, "skipped") else ""),
                duration(spent),
                element("span", class_="bar", style=f"width:{share:.1f}%"),
                number(_gibibytes(pick(stage, "peak_memory_bytes")), "{:.2f} GiB"),
            ]
        )
    settings = [row for name, stage in stages.items() for row in flat(pick(stage, "config") or {}, name)]
    inputs = [[str(name), element("code", str(digest)[:16])] for name, digest in (report.get("inputs") or {}).items()]
    versions = [[str(name), str(version)] for name, version in (report.get("versions") or {}).items()]
    seed, section = report.get("seed"), costs_section(report)
    return element(
        "section",
        element("h2", section.title),
        element("p", section.done, class_="done"),
        *map(caution, section.cautions),
        table(["stage", "time", "", "peak memory"], rows, (1, 3)),
        element("p", f"Seed: {NOT_MEASURED if seed is None else seed}"),
        _fold("Versions", table(["package", "version"], versions)),
        _fold("Input files", table(["file", "SHA-256 (start)"], inputs)),
        _fold("Settings", table(["setting", "value"], [[*row] for row in settings])),
        id="costs",
    )


def _fold(title: str, content: Html) -> Html:
    return element("details", element("summary", title), join(content))
