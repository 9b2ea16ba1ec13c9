"""Writes `report.html`: what a build did, how good the result is, and how to improve it.

The page is self-contained except for the review video, a file beside it. Pictures come from the stage folders. Figures
show data from these folders and from the report. `build_sections.py` describes the stages. `sections` is the only
source of headlines and cautions for the page, `report.json` and the printed summary.
"""

import shlex
from typing import Any

import numpy as np

from twin.assets.ground import Ground
from twin.env.route_segments import scene_tasks
from twin.errors import join_names
from twin.files import read_json, wrap_read_errors, write_text
from twin.geometry.cameras import Cameras, SparsePoints
from twin.geometry.passes import find_passes
from twin.geometry.polyline import arc_lengths
from twin.geometry.route import BRANCH
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import SCENE_XML, World
from twin.report import figures
from twin.report.build_sections import SECTIONS
from twin.report.html import (
    Caution,
    Chart,
    Picture,
    Section,
    Verdict,
    as_number,
    cautions_above,
    command,
    data_url,
    duration,
    facts_of,
    flatten,
    number,
    numbers,
    pick,
    render,
)
from twin.report.video_layout import footprints
from twin.report.visual_vs_collision import geometry_section
from twin.scene import SceneDir, stage_result

# ---- sections

_LARGE_MEMORY = 4.0  # [GiB]


def truth_section(report: dict[str, Any]) -> Section:
    """Errors of the twin compared with ground truth, which only generated places have (`twin reality compare`)."""
    truth = report["truth"]
    name, title = "truth", "Comparison with ground truth"
    kinds = {"ground": "ground", "obstacle": "obstacles of any height", "foliage": "leaves"}
    shares = {kind: truth.get(f"mesh_completeness_10cm_{kind}") for kind in kinds}
    complete = [f"{number(share, '{:.0%}')} of {kinds[kind]}" for kind, share in shares.items() if share is not None]
    rigid = "after a rigid fit, without a change of scale"
    seen = "share of the true surface that cameras saw within 10 m of the route"
    by_kind = join_names(complete) if complete else "completeness of the mesh"
    facts = facts_of(
        truth,
        ("ate_m", "camera positions", "{:.3f} m", "root mean square, after a similarity fit of the paths"),
        ("ate_max_m", "worst camera", "{:.3f} m", "the frame with the largest error"),
        ("ate_rigid_m", "camera positions, in the twin’s meters", "{:.3f} m", rigid),
        ("rotation_median_deg", "camera directions", "{:.2f}°", "median"),
        ("scale_error", "scale", "{:+.2%}", "the twin’s meter compared with the true one"),
        ("tilt_deg", "gravity", "{:.2f}°", "between the twin’s vertical and the true one"),
        ("ground_median_m", "ground height", "{:.3f} m", "median error inside the corridor"),
        ("ground_p95_m", "the same, 95th percentile", "{:.3f} m", "error inside the corridor"),
        ("obstacle_accuracy_m", "convex parts to true surface", "{:.3f} m", "median: accuracy of the parts"),
        ("obstacle_completeness_m", "true surface to convex parts", "{:.3f} m", "median: completeness of the parts"),
        ("mesh_accuracy_median_m", "visual mesh to true surface", "{:.3f} m", "median: accuracy of the mesh"),
        ("mesh_accuracy_mean_m", "the same, mean", "{:.3f} m", "errors above 1 m count as 1 m"),
        ("mesh_completeness_5cm", "true surface within 5 cm of the mesh", "{:.0%}", seen),
        ("mesh_completeness_10cm", "true surface within 10 cm of the mesh", "{:.0%}", by_kind),
        ("mesh_chamfer_m", "visual mesh, Chamfer distance", "{:.3f} m", "mean of both directions, each up to 1 m"),
        ("corridor_intrusions", "parts inside the true corridor", "{}", "the corridor must be free"),
        ("route_median_m", "route", "{:.3f} m", "median distance to the true center line"),
        *_branch_rows(truth),
        ("depth_median_m", "depth of the field", "{:.3f} m", "median error, up to 20 m"),
    )
    wider = "raise nerf.steps, or mjcf.corridor_margin."
    cautions = cautions_above(
        truth,
        ("ate_m", 0.08, "The camera path is {:.3f} m off, more than {:.3f} m.", "give the camera’s calibration."),
        ("scale_error", 0.02, "The scale is {:.1%} off, more than {:.1%}.", "check the source of the scale."),
        ("ground_median_m", 0.04, "The ground is {:.3f} m off, more than {:.3f} m.", "check the camera’s height."),
        ("obstacle_median_m", 0.1, "Convex parts are {:.3f} m off, more than {:.3f} m.", "lower mesh.max_protrusion."),
        ("corridor_intrusions", 0, "{} convex part(s) reach into the true corridor.", wider),
    )
    off, ground = as_number(truth.get("ate_m")), as_number(truth.get("ground_median_m"))
    verdict = None
    if off is not None:
        also = "" if ground is None else f" and the ground by {100 * ground:.1f} cm (median)"
        verdict = Verdict(f"Compared with ground truth, the cameras are off by {100 * off:.1f} cm (rms){also}.", "good")
    done = "This place was generated, so its ground truth is known. Only this comparison uses it; the build does not."
    return Section(name, title, done, facts, cautions, verdict=verdict)


def _branch_rows(truth: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    prefix = "route_median_m_"
    names = [key.removeprefix(prefix) for key in truth if key.startswith(prefix)]
    return [(f"{prefix}{name}", f"branch {name}", "{:.3f} m", "median distance to its true line") for name in names]


def costs_section(report: dict[str, Any]) -> Section:
    peak, cautions = as_number(pick(report, "peak_memory_bytes")), []
    if peak is not None and peak / 2**30 > _LARGE_MEMORY:
        cure = "for a smaller machine lower capture.max_size or nerf.rays, or raise mesh.voxel."
        cautions.append(Caution(f"The build needed {peak / 2**30:.1f} GiB of memory.", cure))
    done = "Time and memory per stage, and everything needed to reproduce this build."
    return Section("costs", "Costs and provenance", done, cautions=cautions)


def sections(report: dict[str, Any]) -> list[Section]:
    truth = [truth_section(report)] if isinstance(pick(report, "truth"), dict) else []
    return [*(make(report) for make in (*SECTIONS.values(), geometry_section)), *truth, costs_section(report)]


def headline_sections(report: dict[str, Any]) -> list[Section]:
    """The sections with a headline. The review is first, because the twin is made for driving; the others follow."""
    with_headline = [section for section in sections(report) if section.headline]
    return sorted(with_headline, key=lambda section: section.name != "review")


def cautions(report: dict[str, Any]) -> list[dict[str, str]]:
    return [
        {"section": section.name, "title": section.title, "what": caution.what, "cure": caution.cure}
        for section in sections(report)
        for caution in section.cautions
    ]


# ---- figures

_MAX_REPROJECTION = 4.0  # [px] right end of the histogram of reprojection errors
_MAX_TRACK_LENGTH = 30.0  # [frames] right end of the histogram of track lengths


def charts(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """All figures for which the stage folders and the report have data."""
    return [
        *_map_charts(scene, report),
        *_reconstruction_charts(scene),
        *_field_charts(report),
        *_drive_charts(scene, report),
    ]


def _map_charts(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """Two maps: of the reconstruction, and of the ground's height with the convex parts."""
    folder, mesh = scene.stage("metric"), scene.stage("mesh")
    if not (folder / "cameras.npz").exists():
        return []
    cameras = Cameras.load(folder)
    points = SparsePoints.load(folder) if (folder / "points.npz").exists() else SparsePoints.empty()
    route, branches = None, {}
    if scene.has_route:
        world = World.load(scene.stage("mjcf"))
        lines = [world.along(branch) for branch in ("", *world.branches)]
        route, *others = (line.route[arc_lengths(line.route) >= line.start, :2] for line in lines)
        branches = dict(zip(world.branches, others, strict=True))
    elif (mesh / "route.npz").exists():
        with np.load(mesh / "route.npz", allow_pickle=False) as data:
            route = data["xy"].astype(np.float64)
            branches = {name.removeprefix(BRANCH): data[name][:, :2] for name in data if name.startswith(BRANCH)}
    wide = as_number(pick(report, "mjcf.half_width_m")) or 0.0
    passes = find_passes(cameras) if route is not None else []
    row = {name: k for k, name in enumerate(cameras.names)}
    torn = [(row[a], row[b]) for a, b in pick(report, "cameras.contradicted_steps") or [] if a in row and b in row]
    seen = cameras.positions, cameras.sources, cameras.held_out, points.xyz, points.rgb
    drawn = figures.place_map(*seen, route, wide, passes, branches, torn)
    title = f"Map of points (n = {len(points):,}), cameras (n = {len(cameras)}) and route"
    out = [Chart(title, figures.svg(drawn), "metric")]
    if (mesh / "ground.npz").exists():
        ground = Ground.load(mesh)
        path = cameras.positions[:, :2] if route is None else route
        parts = footprints(Parts.load(mesh / "parts.npz"), ground)
        drawn = figures.ground_map(ground, path, route, wide, parts, branches)
        out.append(Chart("Ground and convex parts", figures.svg(drawn), "mesh"))
    return out


def _reconstruction_charts(scene: SceneDir) -> list[Chart]:
    folder = scene.stage("cameras")
    if not (folder / "points.npz").exists():
        return []
    points = SparsePoints.load(folder)
    if not len(points):
        return []
    error = figures.histogram(points.error, "mean reprojection error [px]", "points", _MAX_REPROJECTION)
    tracks = figures.histogram(
        points.track_length, "frames that observe a point", "points", _MAX_TRACK_LENGTH, integer=True
    )
    return [
        Chart("Reprojection error of points", figures.svg(error), "cameras"),
        Chart("Track length of points", figures.svg(tracks), "cameras"),
    ]


def _field_charts(report: dict[str, Any]) -> list[Chart]:
    out = []
    psnr = numbers(pick(report, "field.psnr"))
    if psnr:
        counts = {name: int(n) for name, n in numbers(pick(report, "field.n")).items()}
        drawn = figures.bar_chart(psnr, counts, "dB", "PSNR on held-out frames [dB]")
        out.append(Chart("Similarity of rendered and real frames", figures.svg(drawn), "field"))
    curve = pick(report, "field.curve")
    if isinstance(curve, list) and len(curve) > 1 and all(isinstance(row, list) and len(row) == 2 for row in curve):
        steps, values = zip(*curve, strict=True)
        drawn = figures.curve_chart({"": (steps, values)}, "training step", "PSNR on training pixels [dB]")
        out.append(Chart("PSNR during training", figures.svg(drawn), "field"))
    return out


def _drive_charts(scene: SceneDir, report: dict[str, Any]) -> list[Chart]:
    """Curves along the drive; also curves along the films, if the build was compared with ground truth."""
    out = []
    along_route = "distance along the route [m]"
    trace = pick(report, "review.trace")
    if isinstance(trace, dict) and len(trace.get("progress_m") or []) > 1:
        limit, at = as_number(pick(report, "mjcf.half_width_m")), trace["progress_m"]
        off, speed = {"": (at, trace["cross_track_m"])}, {"": (at, trace["speed_m_s"])}
        drawn = figures.curve_chart(off, along_route, "cross-track [m], left is positive", limit)
        title = "Cross-track error of the drive" + ("" if limit is None else "; dashed: the corridor")
        out.append(Chart(title, figures.svg(drawn), "review"))
        drawn = figures.curve_chart(speed, along_route, "speed [m/s]", lowest=0.0)
        out.append(Chart("Speed of the drive", figures.svg(drawn), "review"))
    along = pick(report, "seen_touched.along")
    if isinstance(along, dict) and len(along.get("station_m") or []) > 1:
        keys = {"largest visual-only": "leak_m", "largest collision-only": "ghost_m", "ground, median": "ground_m"}
        curves = {name: (along["station_m"], np.array(along[key], float)) for name, key in keys.items()}
        drawn = figures.curve_chart(curves, along_route, "difference in the corridor [m]", lowest=0.0)
        title = "Difference of visual and collision geometry along the route"
        out.append(Chart(title, figures.svg(drawn), "seen_touched"))
    if compared := load_truth_comparison(scene):
        errors = compared["camera_errors_m"]
        shares = {name: np.linspace(0.0, 100.0 * (len(values) > 1), len(values)) for name, values in errors.items()}
        drawn = figures.curve_chart(
            {name: (shares[name], values) for name, values in errors.items()},
            "position in the film [%]",
            "camera position error [m]",
            lowest=0.0,
        )
        title = f"Camera position error along the films (n = {sum(map(len, errors.values()))} frames)"
        out.append(Chart(title, figures.svg(drawn), "truth"))
    return out


def load_truth_comparison(scene: SceneDir) -> dict[str, Any] | None:
    """Loads the comparison of this build with ground truth, written by `twin reality compare`.

    Returns:
        A dictionary with `figures` (see `twin.reality.truth`) and `camera_errors_m` (a list per source [m]); None
        if this build was not compared.
    """
    if not scene.truth_json.exists():
        return None
    with wrap_read_errors(scene.truth_json, f"run twin reality compare {scene.root}"):
        compared = dict(read_json(scene.truth_json))
        if any(
            not scene.stage(name).exists() or stage_result(scene, name) != result
            for name, result in compared["of"].items()
        ):
            return None  # the comparison belongs to an earlier build
        return compared


# ---- page

_EXCLUDED = "Frames of each lighting. Red pixels were not used: they seem to show things that moved or went away."
_STAGE_TITLES = {name: make({}).title for name, make in SECTIONS.items()}


def write_page(scene: SceneDir, report: dict[str, Any]) -> None:
    """Writes `build/report.html`, atomically.

    Args:
        scene: Source of pictures and figures; missing ones are left out.
        report: The content of `report.json`; missing numbers are shown as not measured.
    """
    write_text(scene.report_html, page(scene, report))


def page(scene: SceneDir, report: dict[str, Any]) -> str:
    drawn, pictures = charts(scene, report), _pictures(scene)
    name = str(report.get("scene") or scene.root.name)
    shown = [section for section in sections(report) if section.name != "costs"]
    stages: dict[str, Any] = report.get("stages") or {}
    memory = number(_gibibytes(report.get("peak_memory_bytes")), "peak memory {:.1f} GiB")
    posters = [picture.path for picture in pictures if picture.section == "poster"]
    return render(
        "build_report.html",
        title=f"{name}: build report",
        kicker=f"A filmed place as a MuJoCo twin: built in {duration(report.get('seconds'))}, {memory}.",
        headlines=headline_sections(report),
        has_video=(scene.stage("review") / "review.mp4").exists() or scene.review_mp4.exists(),
        poster=data_url(posters[-1]) if posters else None,  # if there is a drive, the last poster shows it
        headings={s.name: s.title for s in shown} | {"costs": "Costs", "next": "What to do next"},
        shown=[
            {
                "section": section,
                "is_stage": section.name in SECTIONS,
                "ran": section.name in report or section.name in stages,
                "pictures": [picture for picture in pictures if picture.section == section.name],
                "charts": [chart for chart in drawn if chart.section == section.name],
                "numbers": flatten(report.get(section.name)),
            }
            for section in shown
        ],
        costs=costs_section(report),
        stages=_stage_costs(stages),
        seed=report.get("seed"),
        versions=report.get("versions") or {},
        inputs=report.get("inputs") or {},
        settings=[row for name, stage in stages.items() for row in flatten(pick(stage, "config") or {}, name)],
        next_steps=_next_steps(scene, report),
        files=["report.json"],
    )


def _pictures(scene: SceneDir) -> list[Picture]:
    """The pictures that the review stage saved for the page, and one of the pixels that training left out."""
    folder, pictures = scene.stage("review"), []
    if (folder / "review.json").exists():
        stored = read_json(folder / "review.json").get("pictures", [])
        pictures = [Picture(folder / str(row["file"]), str(row["caption"]), str(row["section"])) for row in stored]
    pictures.append(Picture(scene.stage("field") / "excluded.jpg", _EXCLUDED, "field"))
    return [picture for picture in pictures if picture.path.is_file()]


def _stage_costs(stages: dict[str, Any]) -> list[dict[str, Any]]:
    seconds = numbers({name: pick(stage, "seconds") for name, stage in stages.items()})
    longest = max(seconds.values(), default=0.0)
    return [
        {
            "title": _STAGE_TITLES.get(name, name),
            "skipped": pick(stage, "skipped"),
            "seconds": seconds.get(name),
            "share": 100.0 * seconds.get(name, 0.0) / longest if longest > 0 else 0.0,
            "memory": number(_gibibytes(pick(stage, "peak_memory_bytes")), "{:.2f} GiB"),
        }
        for name, stage in stages.items()
    ]


def _gibibytes(size: Any) -> float | None:
    return size / 2**30 if as_number(size) is not None else None


def _next_steps(scene: SceneDir, report: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """Next steps after a build: texts with their commands."""
    root, wrong = scene.root, sum(len(section.cautions) for section in sections(report))
    build = command("build", root)
    first = "Watch the video and look at the pictures above: is this the place that you filmed?"
    if wrong:
        first = (
            f"Look at the {'caution' if wrong == 1 else f'{wrong} cautions'} above. Change scene.toml or the films as "
            "proposed there, and build again; only the stages that depend on the change run again:"
        )
    out = [(first, [build] if wrong else [])]
    drive = ", and drive the robot there" if scene.has_route else ""
    look = f"Look around in the browser, in any lighting{drive} (needs the extra “view”: pip install 'twin[view]'):"
    out.append((look, [command("view", root)]))
    if scene.has_route:
        shown = shlex.join(["python", "-m", "mujoco.viewer", f"--mjcf={scene.stage('mjcf') / SCENE_XML}"])
        out.append(("MuJoCo’s own viewer shows the physical scene, with its convex parts:", [shown]))
    if pick(report, "review.not_applicable"):
        mesh = command("export", root, "--glb", "place.glb")
        return [*out, ("There is no drive here, so no policy can be trained. Other programs can use the mesh:", [mesh])]
    task = "straight"
    if scene.has_route and task not in scene_tasks(World.load(scene.stage("mjcf"))):
        task = "route"
    align = "Log ten minutes of your robot’s driving, fit the simulated robot to the log, and build again:"
    return [
        *out,
        (align, [command("align", root, "drive.csv"), build]),
        (f"Train a policy on the task “{task}”:", [command("train", root, "--task", task, "--run", "first")]),
        (
            "Validate the policy: measure how often it reaches the goal in lightings that it was not trained in:",
            [command("validate", root, "--task", task, "--policy", "first", "--films")],
        ),
    ]
