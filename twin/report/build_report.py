"""Writes `report.html`: what a build did, how good the result is, and how to improve it.

The page is self-contained except for the review video beside it. Pictures and figures come from the stage folders, text
from `twin.report.build_sections`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from twin.assets.ground import Ground
from twin.files import read_json, wrap_read_errors, write_text
from twin.geometry.cameras import Cameras, SparsePoints
from twin.report import figures
from twin.report.build_sections import SECTIONS, costs_section, headline_sections, sections
from twin.report.html import (
    NOT_MEASURED,
    Html,
    Section,
    caution,
    chart,
    data_url,
    document,
    duration,
    element,
    flatten,
    folded,
    headline,
    number,
    numbers,
    page_header,
    pick,
    picture,
    table,
)
from twin.report.video_layout import load_footprints
from twin.scene import SceneDir, stage_result
from twin.types import Array

_MAX_REPROJECTION = 4.0  # [px] right end of the histogram
_MAX_TRACK_LENGTH = 30.0  # frames, right end of the histogram


@dataclass(frozen=True)
class Chart:
    section: str
    title: str
    svg: str


def charts(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """All figures for which the stage folders and the report have data."""
    return [
        *_map_charts(scene, report),
        *_reconstruction_charts(scene),
        *_field_charts(report),
        *_drive_charts(report),
        *_geometry_charts(report),
        *_truth_charts(scene),
    ]


def _map_charts(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """Maps of the reconstruction and of the drivable ground."""
    folder = scene.stage("metric")
    if not (folder / "cameras.npz").exists():
        return []
    cameras = Cameras.load(folder)
    points = SparsePoints.load(folder) if (folder / "points.npz").exists() else SparsePoints.empty()
    mesh = scene.stage("mesh")
    ground = Ground.load(mesh) if (mesh / "ground.npz").exists() else None
    parts = load_footprints(mesh / "parts.npz", ground)
    route = _load_route(mesh / "route.npz")
    half_width = pick(report, "mjcf.half_width_m")
    wide = float(half_width) if isinstance(half_width, int | float) else 0.0
    drawn = figures.place_map(cameras.positions, cameras.sources, cameras.held_out, points.xyz, points.rgb, route, wide)
    out = [Chart("metric", "Map of points, cameras and route", figures.svg(drawn))]
    if ground is not None:
        path = cameras.positions[:, :2] if route is None else route
        drawn = figures.ground_map(ground, path, route, wide, parts)
        out.append(Chart("mesh", "Ground and solid parts", figures.svg(drawn)))
    return out


def _load_route(path: Path) -> Array | None:
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as data:
        return data["xy"].astype(np.float64)


def _reconstruction_charts(scene: SceneDir) -> list[Chart]:
    folder = scene.stage("cameras")
    if not (folder / "points.npz").exists():
        return []
    points = SparsePoints.load(folder)
    if not len(points):
        return []
    error = figures.histogram(points.error, "reprojection error of a point [px]", _MAX_REPROJECTION)
    tracks = figures.histogram(points.track_length, "frames that observe a point", _MAX_TRACK_LENGTH, integer=True)
    return [
        Chart("cameras", "Reprojection error of points", figures.svg(error)),
        Chart("cameras", "Track length of points", figures.svg(tracks)),
    ]


def _field_charts(report: dict[str, Any]) -> list[Chart]:
    out = []
    psnr = numbers(pick(report, "field.psnr"))
    if psnr:
        counts = {name: int(n) for name, n in numbers(pick(report, "field.n")).items()}
        drawn = figures.bar_chart(psnr, counts, "dB", "PSNR on held-out frames [dB]")
        out.append(Chart("field", "Similarity of rendered and real frames", figures.svg(drawn)))
    curve = pick(report, "field.curve")
    if isinstance(curve, list) and len(curve) > 1 and all(isinstance(row, list) and len(row) == 2 for row in curve):
        steps, values = zip(*curve, strict=True)
        drawn = figures.training_curve(steps, values, "PSNR on training pixels [dB]")
        out.append(Chart("field", "How training went", figures.svg(drawn)))
    return out


def _drive_charts(report: dict[str, Any]) -> list[Chart]:
    trace = pick(report, "review.trace")
    if not isinstance(trace, dict) or len(trace.get("progress_m") or []) < 2:
        return []
    half_width = pick(report, "mjcf.half_width_m")
    limit = float(half_width) if isinstance(half_width, int | float) else None
    off = figures.curves_along_path(
        trace["progress_m"], {"cross-track": trace["cross_track_m"]}, "off the route [m], left is positive", limit
    )
    speed = figures.curves_along_path(trace["progress_m"], {"speed": trace["speed_m_s"]}, "speed [m/s]", lowest=0.0)
    title = "How far off the route it drove" + ("" if limit is None else "; dashed: the corridor")
    return [Chart("review", title, figures.svg(off)), Chart("review", "How fast it drove", figures.svg(speed))]


def _geometry_charts(report: dict[str, Any]) -> list[Chart]:
    """Visual against collision geometry along the route."""
    along = pick(report, "seen_touched.along")
    if not isinstance(along, dict) or len(along.get("station_m") or []) < 2:
        return []
    known: dict[str, Sequence[float]] = {
        name: [float("nan") if value is None else float(value) for value in along[key]]
        for name, key in (
            ("largest visual-only", "leak_m"),
            ("largest collision-only", "ghost_m"),
            ("ground, median", "ground_m"),
        )
    }
    drawn = figures.curves_along_path(along["station_m"], known, "in the corridor [m]", lowest=0.0)
    return [Chart("seen_touched", "Difference of visual and collision geometry along the route", figures.svg(drawn))]


def _truth_charts(scene: SceneDir) -> list[Chart]:
    compared = load_truth_comparison(scene)
    if not compared:
        return []
    errors = compared["camera_errors_m"]
    drawn = figures.errors_by_group(errors, "camera position error [m]")
    return [Chart("truth", "Camera position error along the films", figures.svg(drawn))]


def load_truth_comparison(scene: SceneDir) -> dict[str, Any] | None:
    """Loads the comparison of this build with ground truth, written by `python -m twin.reality compare`.

    Returns:
        `figures` (see `twin.reality.comparison`) and `camera_errors_m` by source [m]; None if this build has none.
    """
    if not scene.truth_json.exists():
        return None
    with wrap_read_errors(scene.truth_json, f"run python -m twin.reality compare {scene.root}"):
        compared = dict(read_json(scene.truth_json))
        if any(
            not scene.stage(name).exists() or stage_result(scene, name) != result
            for name, result in compared["of"].items()
        ):
            return None  # it belongs to an earlier build
        return compared


_STAGE_TITLES = {name: make({}).title for name, make in SECTIONS.items()}


def write_page(scene: SceneDir, report: dict[str, Any]) -> None:
    """Writes `build/report.html`, atomically.

    Args:
        scene: Source of pictures and figures; missing ones are left out.
        report: As in `report.json`; missing numbers are shown as not measured.
    """
    write_text(scene.report_html, page(scene, report))


def page(scene: SceneDir, report: dict[str, Any]) -> str:
    drawn, pictures = charts(scene, report), _pictures(scene)
    name = str(report.get("scene") or scene.root.name)
    shown = [section for section in sections(report) if section.name != "costs"]
    return document(
        f"{name}: build report",
        "",
        _header(name, report),
        _video_section(scene, pictures),
        element(
            "nav", *(element("a", s.title, href=f"#{s.name}") for s in shown), element("a", "Costs", href="#costs")
        ),
        *(_stage_section(k + 1, s, report, drawn, pictures) for k, s in enumerate(shown)),
        _costs_section(report),
        element("footer", "Every number is in ", element("a", "report.json", href="report.json"), " beside this page."),
    )


def _header(name: str, report: dict[str, Any]) -> Html:
    seconds = report.get("seconds")
    if seconds is None:
        each = [pick(stage, "seconds") for stage in (report.get("stages") or {}).values()]
        seconds = sum(s for s in each if isinstance(s, int | float)) if each else None
    cost = f"built in {duration(seconds)}"
    memory = number(_gibibytes(report.get("peak_memory_bytes")), "peak memory {:.1f} GiB")
    kicker = f"A filmed place as a MuJoCo twin: {cost}, {memory}."
    return page_header(name, kicker, *map(_summary, headline_sections(report)))


def _summary(section: Section) -> Html:
    assert section.headline is not None
    below = [element("li", element("a", problem.what, href=f"#{section.name}")) for problem in section.cautions]
    return headline(section.headline, element("ul", *below) if below else "")


def _video_section(scene: SceneDir, pictures: list[tuple[str, Path, str]]) -> Html:
    """The review video, which is stored beside the page, with an embedded poster."""
    if not (scene.stage("review") / "review.mp4").exists() and not scene.review_mp4.exists():
        return Html("")
    posters = [path for section, path, _ in pictures if section == "poster"]
    # The last one shows the drive, if there is one.
    poster = data_url(posters[-1]) if posters else None
    return element(
        "section",
        element("video", src="review.mp4", poster=poster, controls=True, preload="none", playsinline=True),
        element(
            "p",
            "The video shows real and rendered frames side by side, the changing light, and the drive. "
            "It is stored beside this page: ",
            element("a", "review.mp4", href="review.mp4"),
            class_="meaning",
        ),
        id="film",
    )


def _pictures(scene: SceneDir) -> list[tuple[str, Path, str]]:
    """Section, file and caption of every picture of the review stage."""
    folder = scene.stage("review")
    if not (folder / "review.json").exists():
        return []
    stored = read_json(folder / "review.json").get("pictures", [])
    rows = [(str(row["section"]), folder / str(row["file"]), str(row["caption"])) for row in stored]
    return [row for row in rows if row[1].is_file()]


def _stage_section(
    position: int, section: Section, report: dict[str, Any], drawn: list[Chart], pictures: list[tuple[str, Path, str]]
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
    images = [picture(path, caption) for name, path, caption in pictures if name == section.name]
    plots = [chart(c.title, c.svg) for c in drawn if c.section == section.name]
    rows = flatten(report.get(section.name))
    return element(
        "section",
        title,
        element("p", section.done, class_="done"),
        _not_applicable(section) if section.not_applicable else "",
        *map(caution, section.cautions),
        element("dl", *facts),
        element("div", *images, class_="pictures") if images else "",
        element("div", *plots, class_="charts") if plots else "",
        folded("All numbers of this stage", table(["key", "value"], [[*row] for row in rows])),
        id=section.name,
    )


def _not_applicable(section: Section) -> Html:
    return element("p", f"Does not apply here: {section.not_applicable}.", class_="na")


def _gibibytes(size: Any) -> float | None:
    return size / 2**30 if isinstance(size, int | float) else None


def _costs_section(report: dict[str, Any]) -> Html:
    stages: dict[str, Any] = report.get("stages") or {}
    seconds = {name: pick(stage, "seconds") for name, stage in stages.items()}
    longest = max([s for s in seconds.values() if isinstance(s, int | float)], default=0.0)
    rows = []
    for name, stage in stages.items():
        spent = seconds[name]
        share = 100.0 * spent / longest if isinstance(spent, int | float) and longest > 0 else 0.0
        rows.append(
            [
                _STAGE_TITLES.get(name, name) + (" (up to date)" if pick(stage, "skipped") else ""),
                duration(spent),
                element("span", class_="bar", style=f"width:{share:.1f}%"),
                number(_gibibytes(pick(stage, "peak_memory_bytes")), "{:.2f} GiB"),
            ]
        )
    settings = [row for name, stage in stages.items() for row in flatten(pick(stage, "config") or {}, name)]
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
        folded("Versions", table(["package", "version"], versions)),
        folded("Input files", table(["file", "SHA-256 (start)"], inputs)),
        folded("Settings", table(["setting", "value"], [[*row] for row in settings])),
        id="costs",
    )
