"""The report page: what it says follows from the numbers, nothing is made up, and no name can break it."""

import ast
import copy
import inspect
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jinja2 import UndefinedError
from page_text import Text

from twin.build import summary
from twin.commands import parser_of
from twin.errors import join_names
from twin.files import write_json
from twin.geometry.cameras import Cameras
from twin.geometry.images import write_image
from twin.report import build_report as report_page
from twin.report import build_sections, visual_vs_collision
from twin.report import html as report_html
from twin.report.build_report import cautions, headline_sections, page, sections, truth_section, write_page
from twin.report.build_sections import SECTIONS, capture_section, mjcf_section
from twin.report.html import (
    NOT_MEASURED,
    Caution,
    Chart,
    duration,
    flatten,
    follower_verdict,
    number,
    pick,
    render,
)
from twin.scene import STAGE_FOLDERS, SceneDir

REPORT: dict[str, Any] = {
    "scene": "road",
    "seed": 3,
    "versions": {"twin": "0.1.0"},
    "peak_memory_bytes": 3 * 2**30,
    "seconds": 185.0,
    "inputs": {"input/day.mp4": "ab" * 32},
    "stages": {
        name: {"seconds": 10.0 * k, "peak_memory_bytes": 2**30, "skipped": k == 0, "config": {"fps": 2.0}}
        for k, name in enumerate(STAGE_FOLDERS)
    },
    "capture": {"frames": 160, "train": 140, "held_out": 20, "sources": {"day": {"kept": 160, "damaged": 0}}},
    "cameras": {
        "registered": 158,
        "total": 160,
        "reprojection_error_px": 0.61,
        "mean_track_length": 5.2,
        "checked_steps": 157,
        "contradicted_steps": [],
    },
    "metric": {"scale_source": "camera_height", "scale_uncertainty": 0.012},
    "field": {"psnr": {"day": 24.3}, "ssim": {"day": 0.7}, "n": {"day": 10}, "curve": [[0, 10.0], [100, 20.0]]},
    "mesh": {"parts": 42},
    "mjcf": {"route_length_m": 59.8, "turn_deg": -82.0, "half_width_m": 1.0},
    "review": {
        "follower": {
            "reached_goal": True,
            "touched": [],
            "max_cross_track_m": 0.07,
            "seconds": 61.0,
            "distance_m": 59.1,
            "turn_deg": -82.4,
        },
        "frames": 560,
        "duration_s": 56.0,
        "trace": {"progress_m": [0.0, 30.0, 59.0], "cross_track_m": [0.0, 0.07, 0.0], "speed_m_s": [0.0, 1.0, 1.0]},
    },
    "truth": None,
}


def changed(path: str, value: Any, of: dict[str, Any] = REPORT) -> dict[str, Any]:
    report = copy.deepcopy(of)
    *folders, last = path.split(".")
    inner = report
    for key in folders:
        inner[key] = inner.get(key) or {}
        inner = inner[key]
    inner[last] = value
    return report


@pytest.fixture
def scene(tmp_path: Path) -> SceneDir:
    scene = SceneDir(tmp_path / "road")
    scene.stage("review").mkdir(parents=True)
    return scene


def test_the_page_shows_the_results_of_every_stage(scene: SceneDir) -> None:
    write_page(scene, REPORT)
    text = Text(scene.report_html.read_text(encoding="utf-8")).text
    assert "The Husky followed the 59.8 m route from start to end and touched nothing but the ground." in text
    assert "158 of 160" in text
    assert "24.3 dB PSNR, 0.70 SSIM" in text
    assert "3 min 05 s" in text and "3.0 GiB" in text
    assert "Seed: 3" in text
    assert [p.name for p in scene.build.iterdir() if p.is_file()] == ["report.html"]


def test_an_empty_report_makes_a_page_that_makes_nothing_up(scene: SceneDir) -> None:
    text = Text(page(scene, {})).text
    assert text.count("This stage has not run.") == len(SECTIONS)
    assert NOT_MEASURED in text
    assert not re.search(r"\d dB|\d m\b|\d %", text)


@pytest.mark.parametrize("stage", list(SECTIONS))
def test_a_stage_without_numbers_is_not_measured(stage: str) -> None:
    for empty in ({}, {stage: {}}, {stage: None}):
        facts = SECTIONS[stage](empty).facts
        assert facts or stage == "review"
        digits = [fact for fact in facts if re.search(r"\d", fact.value)]
        assert digits == []


def test_every_missing_key_is_tolerated(scene: SceneDir) -> None:
    for stage in SECTIONS:
        for key in REPORT[stage]:
            report = copy.deepcopy(REPORT)
            del report[stage][key]
            SECTIONS[stage](report), headline_sections(report)
            report[stage][key] = None
            SECTIONS[stage](report), headline_sections(report)
    for key in REPORT:
        Text(page(scene, {k: v for k, v in REPORT.items() if k != key}))


def test_names_from_files_are_text(scene: SceneDir) -> None:
    evil = '<script>alert("1")</script>&amp;'
    report = changed("field.psnr", {evil: 20.0})
    report["scene"] = evil
    report["inputs"] = {evil: evil}
    report["versions"] = {evil: evil}
    report["capture"]["sources"] = {evil: {"kept": 3, "damaged": 1, "lighting": evil}}
    report["metric"]["scale_source"] = evil
    report["review"]["follower"] |= {"reached_goal": False, "touched": [evil]}
    report["stages"][evil] = {"seconds": 1.0, "config": {evil: evil}}
    write_image(scene.stage("review") / "pictures" / "a.jpg", np.zeros((4, 4, 3), np.uint8))
    write_json(
        scene.stage("review") / "review.json",
        {"pictures": [{"file": "pictures/a.jpg", "section": "field", "caption": evil}]},
    )
    parser = Text(page(scene, report))
    assert "script" not in parser.tags
    assert evil in parser.text


def test_nothing_is_fetched_from_elsewhere(scene: SceneDir) -> None:
    (scene.stage("review") / "review.mp4").write_bytes(b"film")
    write_image(scene.stage("review") / "pictures" / "a.jpg", np.zeros((4, 4, 3), np.uint8))
    told = [
        {"file": f"pictures/{name}.jpg", "section": s, "caption": s} for name, s in (("a", "poster"), ("b", "field"))
    ]
    write_json(scene.stage("review") / "review.json", {"pictures": told})
    write_image(scene.stage("field") / "excluded.jpg", np.zeros((4, 4, 3), np.uint8))
    html = page(scene, REPORT)
    assert "were not used" in html
    parser = Text(html)
    assert {link for link in parser.links if not link.startswith(("#", "data:"))} == {"review.mp4", "report.json"}
    assert "http" not in html and "url(" not in html.replace("url(#", "")
    assert "video" in parser.tags


def test_a_page_without_a_video_has_no_player(scene: SceneDir) -> None:
    assert "video" not in Text(page(scene, REPORT)).tags


def test_a_print_splits_no_figure(scene: SceneDir) -> None:
    """A rule for whole sections has no effect on those longer than a sheet, whose figures it would split."""
    printed = page(scene, {}).partition("@media print")[2]
    assert ".charts > div, figure, dl div, .caution, tr { break-inside:avoid }" in printed


@pytest.mark.parametrize(
    ("follower", "sentence", "mood"),
    [
        ({"reached_goal": True, "touched": []}, "from start to end and touched nothing but the ground.", "good"),
        ({"reached_goal": True, "touched": ["tree"]}, "from start to end and touched tree.", "mixed"),
        ({"reached_goal": True}, "and its contacts were not measured.", "mixed"),
        (
            {"reached_goal": False, "touched": ["a", "b"], "distance_m": 23.06},
            "did not reach the end of the 59.8 m route: it drove 23.1 m and touched a and b.",
            "bad",
        ),
    ],
)
def test_the_headline_states_the_outcome_of_the_drive(follower: dict[str, Any], sentence: str, mood: str) -> None:
    verdict = follower_verdict(changed("review.follower", follower))
    assert verdict.text.endswith(sentence)
    assert verdict.mood == mood


def test_the_headline_names_the_branches() -> None:
    branches = {name: {"reached_goal": True, "touched": []} for name in ("east", "west")}
    verdict = follower_verdict(changed("review.branches", branches))
    assert verdict.text.startswith("The Husky followed the 59.8 m route, branch east and branch west from start to end")
    assert verdict.mood == "good"
    lost = {"west": {"reached_goal": False, "touched": []}}
    verdict = follower_verdict(changed("review.branches", branches | lost))
    assert verdict.text.endswith(" touched nothing but the ground. On branch west it did not arrive.")
    assert verdict.mood == "mixed"


def test_the_headline_tells_contacts_on_branches_from_those_on_the_route() -> None:
    branches = {"east": {"reached_goal": True, "touched": []}, "west": {"reached_goal": False, "touched": ["part_7"]}}
    report = changed("review.branches", branches)
    verdict = follower_verdict(report)
    assert verdict.text.endswith(" touched nothing but the ground. On branch west it touched part_7.")
    report["review"]["follower"] |= {"reached_goal": False, "distance_m": 3.0, "touched": []}
    verdict = follower_verdict(report)
    assert verdict.mood == "bad" and verdict.text == (
        "The Husky did not reach the end of the 59.8 m route: it drove 3.0 m and touched nothing but the ground. "
        "It followed branch east from start to end. On branch west it touched part_7."
    )


def test_no_drive_says_why(scene: SceneDir) -> None:
    report = changed("review.follower", None)
    report["review"]["not_applicable"] = "this is not a drive"
    assert follower_verdict(report).text == "No robot was driven here: this is not a drive."
    assert "Does not apply here: this is not a drive." in Text(page(scene, report)).text


CAUTIONS: list[tuple[str, str, Any, str]] = [
    ("capture", "capture.frames", 5, "Only 5 frames"),
    ("capture", "capture.sources", {"day": {"damaged": 4}}, "4 frame(s)"),
    ("cameras", "cameras.registered", 100, "60 of 160 frames could not be placed"),
    ("cameras", "cameras.may_drift", ["noon"], "tore them apart: noon."),
    ("cameras", "cameras.contradicted_steps", [["day/000001", "day/000002"]], "1 of 157 steps"),
    ("cameras", "cameras.reprojection_error_px", 2.5, "2.50 px"),
    ("cameras", "cameras.outliers", ["day/000001"], "day/000001"),
    ("cameras", "cameras.apart", ["day_back"], "day_back"),
    ("cameras", "cameras.stabilized", ["phone"], "phone"),
    ("cameras", "cameras.note", "the given poses did not fit", "The given poses did not fit."),
    ("metric", "metric.scale_uncertainty", 0.1, "10.0%"),
    ("metric", "metric.scale_disagreement", 4.2, "4.2 standard deviations"),
    ("metric", "metric.gravity_uncertainty_deg", 3.0, "3.0°"),
    ("metric", "metric.road_reliable", False, "Too few points"),
    ("field", "field.psnr", {"day": 12.0}, "12.0 dB"),
    ("field", "field.n", {"day": 1}, "Only 1 held-out frame"),
    ("field", "field.cross_lighting", {"colour_follows": {"day": 0.4}}, "Only 40% of the places"),
    (
        "field",
        "field.cross_lighting",
        {"colour_follows": {"day": 1.0}, "depth_moves_m": 0.2},
        "changes by up to 0.200 m",
    ),
    ("mesh", "mesh.parts", 0, "Nothing solid"),
    ("mesh", "mesh.parts_left_out", 3, "3 convex part(s) were left out"),
    ("mesh", "mesh.parts_beyond_bound", 2, "2 convex part(s) stick out"),
    ("mesh", "mesh.coacd_failed", 1, "1 piece(s)"),
    ("mesh", "mesh.ground", {"corridor_coverage": 0.2}, "Only 20%"),
    ("mjcf", "mjcf.spawn_touched", ["part_0003"], "part_0003"),
    ("review", "review.follower.reached_goal", False, "did not reach the goal"),
    ("review", "review.follower.touched", ["part_0001"], "The robot touched part_0001."),
    (
        "review",
        "review.branches",
        {"side": {"reached_goal": False, "touched": ["part_0002"], "max_cross_track_m": 0.4}},
        "On branch side, the scripted driver touched part_0002.",
    ),
    ("seen_touched", "seen_touched.median_m", 0.052, "differ by 0.052 m"),
    (
        "seen_touched",
        "seen_touched.corridor_leak_m",
        0.3,
        "has no collision geometry. The largest difference is 0.300 m",
    ),
    (
        "seen_touched",
        "seen_touched.corridor_ghost_m",
        0.23,
        "Collision geometry in the corridor is not visible. The largest difference is 0.230 m",
    ),
    ("seen_touched", "seen_touched.unfilmed_ghost_m", 1.53, "1.530 m"),
    ("truth", "truth.ate_m", 0.2, "The camera path is 0.200 m off"),
    ("truth", "truth.scale_error", -0.05, "The scale is 5.0% off"),
    ("truth", "truth.ground_median_m", 0.2, "The ground is 0.200 m off"),
    ("truth", "truth.obstacle_median_m", 0.2, "Convex parts are 0.200 m off"),
    ("truth", "truth.corridor_intrusions", 2, "2 convex part(s) reach into the true corridor"),
    ("costs", "peak_memory_bytes", 6 * 2**30, "6.0 GiB of memory."),
]
"""Every kind of caution: its section, the number that causes it, and what is said of it."""


@pytest.fixture
def no_charts() -> Iterator[None]:
    """Replaces the charts, which take a second a page and cause no caution."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_page, "charts", lambda scene, report: [])
        yield


def header_of(html: str) -> str:
    return Text(html[html.index("<header") : html.index("</header>")] + "</header>").text


def test_a_start_without_parts_nearby_is_free() -> None:
    """No distance is stored if no part is within range; the report lacks the key if it was not measured."""
    shown = {stored: mjcf_section({"mjcf": {"spawn_clearance_m": stored}}).facts[-3].value for stored in (1.5, None)}
    assert shown == {1.5: "1.50 m", None: "over 5 m"}
    assert mjcf_section({"mjcf": {}}).facts[-3].value == NOT_MEASURED


def test_nothing_wrong_gives_no_caution() -> None:
    assert cautions(REPORT) == [] and cautions({}) == []
    assert {section.headline.mood for section in headline_sections(REPORT) if section.headline} == {"good"}
    assert "caution" not in summary(REPORT)


def test_the_map_marks_the_steps_that_the_pictures_contradict(scene: SceneDir) -> None:
    positions = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = positions
    names = tuple(f"day/{k:06d}" for k in range(3))
    sizes, times = np.tile(np.array([64, 36]), (3, 1)), np.arange(3.0)
    folder = scene.stage("metric")
    folder.mkdir(parents=True)
    rest = ("day",) * 3, ("day",) * 3, times, np.zeros(3, bool), folder
    Cameras(names, poses, np.ones((3, 4)), sizes, *rest).save(folder)
    steps = [["day/000000", "day/000001"], ["day/000001", "day/000002"], ["night/000000", "night/000001"]]
    assert "contradicted (n = 2)" in page(scene, changed("cameras.contradicted_steps", steps))
    assert "contradicted (n" not in page(scene, REPORT)


@pytest.mark.parametrize(("mapper", "cure"), [("given poses", "check the given poses"), ("global", "film slower")])
def test_the_cure_of_contradicted_steps_fits_where_the_poses_come_from(mapper: str, cure: str) -> None:
    report = changed("cameras.contradicted_steps", [["day/000001", "day/000002"]])
    (caution,) = cautions(changed("cameras.mapper", mapper, report))
    assert cure in caution["cure"]


@pytest.mark.usefixtures("no_charts")
@pytest.mark.parametrize(("section", "path", "value", "what"), CAUTIONS)
def test_every_defect_gives_a_caution_with_a_cure_in_section_and_summary(
    scene: SceneDir, section: str, path: str, value: Any, what: str
) -> None:
    report = changed(path, value)
    (below,) = [s for s in sections(report) if s.cautions]
    (caution,) = below.cautions
    assert below.name == section and what in caution.what and caution.cure
    assert below.headline is not None and below.headline.mood in ("mixed", "bad")
    assert cautions(report) == [{"section": section, "title": below.title, "what": caution.what, "cure": caution.cure}]
    html = page(scene, report)
    above = header_of(html)
    assert f"{below.headline.word}:" in above and caution.what in above
    assert f'href="#{section}"' in html and f'id="{section}"' in html
    assert Text(html).text.count(caution.what) == 2  # above, and with its cure below
    printed = [line for line in summary(report).splitlines() if line.startswith("caution")]
    assert len(printed) == 1 and caution.what in printed[0] and caution.cure in printed[0]


def test_the_defects_tried_cover_every_kind_of_caution(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a caution that the code can give, but the list above lacks, would not be tested."""
    makers = (build_sections, report_page, report_html)
    given: set[tuple[str, int]] = set()
    limits: set[str] = set()
    exceeded: set[str] = set()
    above = report_html.cautions_above

    def recording(*args: str) -> Caution:
        frame = sys._getframe(1)
        given.add((frame.f_globals["__name__"], frame.f_lineno))
        return Caution(*args)

    def recording_limits(report: dict[str, Any], *rows: report_html.Limit) -> list[Caution]:
        limits.update(path for path, *_ in rows)
        exceeded.update(row[0] for row in rows if above(report, row))
        return above(report, *rows)

    for maker in makers:
        monkeypatch.setattr(maker, "Caution", recording)
    for maker in (*makers, visual_vs_collision):
        monkeypatch.setattr(maker, "cautions_above", recording_limits)
    for _, path, value, _ in CAUTIONS:
        sections(changed(path, value))
    written = {
        (maker.__name__, node.lineno)
        for maker in makers
        for node in ast.walk(ast.parse(inspect.getsource(maker)))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Caution"
    }
    assert len(written) > 15 and given == written
    assert len(limits) > 12 and exceeded == limits
    elsewhere = {
        path.stem
        for path in Path(build_sections.__file__).parent.glob("*.py")
        if "Caution(" in path.read_text(encoding="utf-8").replace("class Caution", "")
    }
    # The pages of a validation and of a forecast have their own.
    assert elsewhere == {"build_report", "build_sections", "html", "validation_report", "forecast_text"}


@pytest.mark.usefixtures("no_charts")
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    wrong=st.lists(st.sampled_from(CAUTIONS), unique_by=lambda case: case[1], max_size=12),
    numbers=st.dictionaries(
        st.sampled_from([path for _, path, value, _ in CAUTIONS if isinstance(value, int | float)]),
        st.one_of(st.none(), st.booleans(), st.integers(-9, 999), st.floats(-2.0, 40.0)),
        max_size=8,
    ),
    missing=st.sets(st.sampled_from(list(REPORT)), max_size=3),
)
def test_no_summary_has_a_better_mood_than_its_sections(
    wrong: list[tuple[str, str, Any, str]], numbers: dict[str, Any], missing: set[str]
) -> None:
    report = {key: value for key, value in REPORT.items() if key not in missing or key in ("stages", "seconds")}
    report.setdefault("peak_memory_bytes", 2**30)
    for _, path, value, _ in wrong:
        report = changed(path, value, report)
    for path, value in numbers.items():
        if path != "peak_memory_bytes":
            report = changed(path, value, report)
    below = [(section, caution) for section in sections(report) for caution in section.cautions]
    above = {section.name: section for section in headline_sections(report)}
    for section, _ in below:
        headline = above[section.name].headline
        assert headline is not None and headline.mood in ("mixed", "bad") and headline.word in ("caution", "bad")
    html = page(SceneDir(Path("nowhere")), report)
    header, printed = header_of(html), summary(report)
    text = Text(html[html.index("</header>") + len("</header>") :].removesuffix("</html>").rsplit("</main>", 1)[0]).text
    for _, caution in below:
        assert caution.what in header and caution.what in text and caution.what in printed
    assert [it["what"] for it in cautions(report)] == [caution.what for _, caution in below]
    assert text.count("What helps:") == len(below) == printed.count("What helps:")


def test_a_failed_drive_says_what_to_try() -> None:
    report = changed("review.follower", {"reached_goal": False, "touched": ["part_0001"]})
    cautions = SECTIONS["review"](report).cautions
    assert [bool(c.cure) for c in cautions] == [True, True]
    assert "part_0001" in cautions[1].what


def test_errors_against_ground_truth_are_shown_where_it_is_known(scene: SceneDir) -> None:
    assert "ground truth" not in Text(page(scene, REPORT)).text
    known = changed("truth", {"ate_m": 0.042, "ground_median_m": 0.09, "corridor_intrusions": 2, "scale_error": None})
    section = truth_section(known)
    values = {fact.name: fact.value for fact in section.facts}
    assert values["camera positions"] == "0.042 m" and values["scale"] == NOT_MEASURED
    assert len(section.cautions) == 2
    assert section.headline is not None and "4.2 cm" in section.headline.text and section.headline.mood == "mixed"


def test_charts_are_drawn_from_the_report(scene: SceneDir) -> None:
    text = Text(page(scene, REPORT)).text
    assert "24.3 dB (n = 10)" in text
    assert "PSNR during training" in text and "Cross-track error of the drive" in text
    assert "Ground and convex parts" not in text  # no mesh stage on disk


def test_held_out_frames_are_told_from_scored_ones_and_photos_from_films(scene: SceneDir) -> None:
    """A report counts held-out frames of all lightings, and for each lighting those that were scored."""
    text = Text(page(scene, REPORT)).text
    assert "on 10 of its held-out frames" in text and "are scored under Radiance field" in text
    photos = {"day": {"kind": "images", "kept": 160}}
    assert "at regular spacing" not in capture_section(changed("capture.sources", photos)).done
    assert "at regular spacing" in capture_section({"capture": {"sources": {"day": {"promised": 160}}}}).done


def test_a_chart_has_its_heading_as_accessible_name() -> None:
    markup = Chart('a < b & "c"', "<svg viewBox='0'></svg>").markup
    assert markup == '<svg role="img" aria-label="a &lt; b &amp; &#34;c&#34;" viewBox=\'0\'></svg>'


def test_templates_escape_text_and_refuse_missing_data() -> None:
    data: dict[str, Any] = {"title": "<b>", "kicker": "a & b", "verdicts": [], "headings": {}, "files": ["x"]}
    html = render("base.html", **data)
    assert "<h1>&lt;b&gt;</h1>" in html and "a &amp; b" in html and "{" + "#" not in html
    with pytest.raises(UndefinedError, match="kicker"):
        render("base.html", **{key: value for key, value in data.items() if key != "kicker"})


def test_the_page_says_what_to_do_next_in_commands_that_parse(scene: SceneDir) -> None:
    """Also if the scene's folder needs quoting; without a drive, no training is proposed."""
    odd = SceneDir(scene.root.parent / "my road's")
    text = Text(page(odd, changed("mesh.parts", 0))).text
    assert "Look at the caution above." in text
    commands = [line for line in next_commands(odd, REPORT) if line.startswith("twin ")]
    for line in commands:
        _, verb, *arguments = shlex.split(line)
        assert str(odd.root) in arguments
        parser_of(verb).parse_args(arguments)
    assert [line.split()[1] for line in commands] == ["view", "align", "build", "train", "validate"]
    without = changed("review.not_applicable", "this is not a drive")
    assert [line.split()[1] for line in next_commands(odd, without)] == ["view", "export"]


def next_commands(scene: SceneDir, report: dict[str, Any]) -> list[str]:
    return [line for _, commands in report_page._next_steps(scene, report) for line in commands]


def test_numbers_durations_and_names_are_formatted_as_stated() -> None:
    assert number(None) == number(True) == number("x") == NOT_MEASURED
    assert number(2, "{:.1f} m") == "2.0 m"
    assert duration(8.24) == "8.2 s" and duration(59.96) == "1 min 00 s" and duration(None) == NOT_MEASURED
    assert join_names([]) == "none" and join_names(["a"]) == "a" and join_names("abc") == "a, b and c"
    assert join_names("abcdef") == "a, b, c and 3 more"
    assert pick({"a": {"b": 1}}, "a.b") == 1 and pick({"a": 2}, "a.b") is None and pick(None, "a") is None
    assert flatten({"a": {"b": 1.5, "c": [1, 2]}, "d": list(range(99)), "e": None, "f": True}) == [
        ("a.b", "1.5"),
        ("a.c", "1, 2"),
        ("d", "99 values"),
        ("e", NOT_MEASURED),
        ("f", "yes"),
    ]
