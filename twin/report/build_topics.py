"""Sections of the build report on topics beside the stages: geometry, ground truth, costs."""

from typing import Any

from twin.errors import join_names
from twin.report.html import Caution, Section, Verdict, as_number, cautions_above, facts_of, number, pick
from twin.report.visual_vs_collision import LARGE_ERROR, MAX_DEPTH

_LARGE_MEMORY = 4.0  # [GiB]


def geometry_section(report: dict[str, Any]) -> Section:
    """The review stage's comparison of visual with collision geometry (`twin.report.visual_vs_collision`)."""
    name, title = "seen_touched", "Visual and collision geometry"
    found = pick(report, name)
    if not isinstance(found, dict):
        return Section(name, title, "", not_applicable="no robot was driven, so there are no views to compare")
    visible = "height of visible geometry above the ground"
    behind = "distance by which visible geometry lies behind it"
    nearest = "median distance to the nearest surface"
    far = f"of points on parts, over {LARGE_ERROR:g} m from visible geometry"
    twice = "where no film shows the corridor from two directions; not part of the previous number"
    within = f"median within {MAX_DEPTH:g} m, ground and parts"
    facts = facts_of(
        found,
        ("median_m", "visual to collision geometry, along the ray", "{:.3f} m", within),
        ("p90_m", "the same, 90th percentile", "{:.3f} m", "large where the ground is seen at a low angle"),
        ("ground_median_m", "visual to collision ground", "{:.3f} m", "median height difference in the corridor"),
        ("ground_p95_m", "the same, 95th percentile", "{:.3f} m", "height difference in the corridor"),
        ("corridor_leak_m", "largest visual-only in the corridor", "{:.3f} m", visible),
        ("corridor_ghost_m", "largest collision-only in the corridor", "{:.3f} m", behind),
        ("unfilmed_ghost_m", "largest collision-only, filmed from one direction", "{:.3f} m", twice),
        ("standing_median_m", "visible obstacles to collision geometry", "{:.3f} m", nearest),
        ("leak_share", "visual-only", "{:.1%}", f"of obstacle points, over {LARGE_ERROR:g} m from collision geometry"),
        ("ghost_share", "collision-only", "{:.1%}", far),
        ("views", "views", "{}", "of the robot’s camera, along its drive"),
    )
    beyond = ". The largest difference is {:.3f} m, more than {:g} m."
    unfilmed = (
        "No film shows some of the corridor, usually its first meters, from two directions. The field’s depth there is "
        "not determined, may differ from build to build, and differs from collision geometry" + beyond
    )
    leak = "Something in the corridor is visible but has no collision geometry" + beyond
    ghost = "Collision geometry in the corridor is not visible" + beyond
    earlier = (
        "film from a few meters before the start; without a new film, let tasks start further along ([[task]] with "
        "start = 3.0, for example), which avoids these meters but leaves this caution."
    )
    apart = "Visual and collision geometry differ by {:.3f} m in the median, more than {:g} m."
    cautions = cautions_above(
        found,
        ("median_m", 0.05, apart, "raise nerf.steps, or lower mesh.voxel."),
        ("corridor_leak_m", LARGE_ERROR, leak, "mask what moved while filming."),
        ("corridor_ghost_m", LARGE_ERROR, ghost, "raise nerf.steps."),
        ("unfilmed_ghost_m", LARGE_ERROR, unfilmed, earlier),
    )
    done = (
        "A policy sees the radiance field but collides with MuJoCo’s ground and convex parts. Both were rendered from "
        "the robot’s camera along the drive and compared pixel by pixel."
    )
    median = as_number(found.get("median_m"))
    verdict = None
    if median is not None:
        verdict = Verdict(f"Visual and collision geometry differ by {100 * median:.1f} cm in the median.", "good")
    return Section(name, title, done, facts, cautions, verdict=verdict)


def truth_section(report: dict[str, Any]) -> Section:
    """Errors of the twin compared with ground truth, which only generated places have (`twin reality compare`)."""
    truth = report["truth"]
    name, title = "truth", "Comparison with ground truth"
    kinds = {"ground": "ground", "obstacle": "obstacles of any height", "foliage": "leaves"}
    shares = {kind: truth.get(f"mesh_completeness_10cm_{kind}") for kind in kinds}
    complete = [f"{number(share, '{:.0%}')} of {kinds[kind]}" for kind, share in shares.items() if share is not None]
    rigid = "after a rigid fit, without a change of scale"
    seen = "of that seen within 10 m of the route"
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
