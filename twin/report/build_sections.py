"""Sections of the build report: for each stage what was done, its numbers, and cautions with their cures.

`sections` is the only source of headlines and cautions for the page, `report.json` and the printed summary.
"""

from collections.abc import Callable
from typing import Any

from twin.errors import join_names
from twin.report.html import (
    NOT_MEASURED,
    Caution,
    Fact,
    Section,
    Verdict,
    duration,
    follower_verdict,
    format_value,
    number,
    numbers,
    pick,
)
from twin.report.visual_vs_collision import geometry_section

# Thresholds of cautions.
_FEW_FRAMES = 20
_MIN_REGISTERED = 0.9  # share of frames
_LARGE_REPROJECTION = 1.5  # [px]
_LARGE_SCALE_UNCERTAINTY = 0.03  # relative
_LARGE_DISAGREEMENT = 3.0  # standard deviations between two sources of scale
_LARGE_TILT = 1.5  # [°]
_FEW_HELD_OUT = 3  # frames per lighting
_LOW_PSNR = 18.0  # [dB]
_LOW_LIGHTING_AGREEMENT = 0.7  # share of places; 0.5 is chance
_MAX_DEPTH_CHANGE = 1e-3  # [m]
_LOW_COVERAGE = 0.5  # share of the ground along the route
_LARGE_MEMORY = 4.0  # [GiB]
_LARGE_PATH_ERROR = 0.08  # [m]
_LARGE_SCALE_ERROR = 0.02  # relative
_LARGE_GROUND_ERROR = 0.04  # [m]
_LARGE_SURFACE_ERROR = 0.1  # [m]

_SCALE_SOURCES = {
    "camera_height": "the camera’s height above the ground",
    "distance": "a distance measured between two marked points",
    "marker": "a printed marker of known size",
    "gps": "the GPS positions of the images",
    "poses": "the given metric poses",
    "poses_are_metric": "the given metric poses",
}

# ---- comparison with ground truth


def truth_section(report: dict[str, Any]) -> Section:
    """Errors of the twin against ground truth; not applicable for a real place."""
    truth = pick(report, "truth")
    title, name = "Comparison with ground truth", "truth"
    if not isinstance(truth, dict):
        return Section(
            name,
            title,
            "",
            not_applicable="there is no ground truth to compare with; it exists for generated places only "
            "(python -m twin.reality compare SCENE)",
        )
    rows = (
        ("ate_m", "camera positions", "{:.3f} m", "root mean square, after a similarity fit of the paths"),
        ("ate_max_m", "worst camera", "{:.3f} m", "the frame with the largest error"),
        (
            "ate_rigid_m",
            "camera positions, in the twin’s meters",
            "{:.3f} m",
            "after a rigid fit, without a change of scale",
        ),
        ("rotation_median_deg", "camera directions", "{:.2f}°", "median"),
        ("scale_error", "scale", "{:+.2%}", "the twin’s meter compared with the true one"),
        ("tilt_deg", "gravity", "{:.2f}°", "between the twin’s vertical and the true one"),
        ("ground_median_m", "ground height", "{:.3f} m", "median error inside the corridor"),
        ("ground_p95_m", "ground height, worst places", "{:.3f} m", "95 of 100 places are better"),
        ("obstacle_accuracy_m", "solid parts to true surface", "{:.3f} m", "median: accuracy of the parts"),
        ("obstacle_completeness_m", "true surface to solid parts", "{:.3f} m", "median: completeness of the parts"),
        ("mesh_accuracy_median_m", "visual mesh to true surface", "{:.3f} m", "median: accuracy of the mesh"),
        ("mesh_accuracy_mean_m", "the same, mean", "{:.3f} m", "errors above 1 m count as 1 m"),
        ("mesh_completeness_5cm", "true surface within 5 cm of the mesh", "{:.0%}", "of what the cameras saw nearby"),
        ("mesh_completeness_10cm", "true surface within 10 cm of the mesh", "{:.0%}", _completeness_by_kind(truth)),
        ("mesh_chamfer_m", "visual mesh, Chamfer distance", "{:.3f} m", "mean of both directions, each up to 1 m"),
        ("corridor_intrusions", "parts inside the true corridor", "{}", "the corridor must be free"),
        ("route_median_m", "route", "{:.3f} m", "median distance to the true centre line"),
        ("depth_median_m", "depth of the field", "{:.3f} m", "median error, up to 20 m"),
    )
    facts = [Fact(label, number(truth.get(key), form), meaning) for key, label, form, meaning in rows]
    cautions = [
        Caution(f"{what}: {number(abs(truth[key]), form)} off, more than {number(limit, form)}.", cure)
        for key, limit, what, form, cure in (
            ("ate_m", _LARGE_PATH_ERROR, "The camera path", "{:.3f} m", "give the camera’s calibration."),
            ("scale_error", _LARGE_SCALE_ERROR, "The scale", "{:.1%}", "check the source of the scale."),
            ("ground_median_m", _LARGE_GROUND_ERROR, "The ground", "{:.3f} m", "check the camera’s height."),
            ("obstacle_median_m", _LARGE_SURFACE_ERROR, "Solid parts", "{:.3f} m", "lower mesh.max_protrusion."),
        )
        if isinstance(truth.get(key), int | float) and abs(truth[key]) > limit
    ]
    if isinstance(truth.get("corridor_intrusions"), int) and truth["corridor_intrusions"] > 0:
        cautions.append(
            Caution(
                f"{truth['corridor_intrusions']} solid part(s) reach into the true corridor.",
                "raise nerf.steps, or mjcf.corridor_margin.",
            )
        )
    return Section(
        name,
        title,
        "This place was generated, so its ground truth is known. Only this comparison uses it; the build does not.",
        facts,
        cautions,
        verdict=_truth_verdict(truth),
    )


def _truth_verdict(truth: dict[str, Any]) -> Verdict | None:
    off, ground = truth.get("ate_m"), truth.get("ground_median_m")
    if not isinstance(off, int | float):
        return None
    text = f"Compared with ground truth, its cameras are off by {100 * off:.1f} cm"
    if isinstance(ground, int | float):
        text += f" and its ground by {100 * ground:.1f} cm"
    return Verdict(f"{text}.", "good")


def _completeness_by_kind(truth: dict[str, Any]) -> str:
    words = (("ground", "ground"), ("obstacle", "obstacles up to full height"), ("foliage", "leaves"))
    shares = [(name, truth.get(f"mesh_completeness_10cm_{kind}")) for kind, name in words]
    shares_text = [f"{number(share, '{:.0%}')} of {name}" for name, share in shares if share is not None]
    return join_names(shares_text) if shares_text else "completeness of the mesh"


def cross_lighting_facts(report: dict[str, Any]) -> tuple[list[Fact], list[Caution]]:
    """Facts and cautions on rendering places in a lighting they were not filmed in (`twin.nerf.evaluate`)."""
    cross = pick(report, "field.cross_lighting")
    follows = numbers(pick(cross, "colour_follows"))
    facts, cautions = [], []
    for name, share in follows.items():
        off, own = (number(pick(cross, f"{key}.{name}"), "{:.0%}") for key in ("to_shown_rms", "to_filmed_rms"))
        text = "of the places filmed in another lighting look like the film of this lighting when rendered in it"
        facts.append(
            Fact(
                f"{name}, swapped in",
                f"{share:.0%}",
                f"{text}. RMS color error: {off} to this lighting's film, {own} to their own film",
            )
        )
        if share < _LOW_LIGHTING_AGREEMENT:
            cautions.append(
                Caution(
                    f"Only {share:.0%} of the places filmed in other light resemble “{name}” when rendered in it.",
                    "film every light along the same path; lights that look very similar reach about 50% at best.",
                )
            )
    moves = pick(cross, "depth_moves_m")
    if follows:
        facts.append(Fact("depth, light swapped", number(moves, "{:.3f} m"), "largest change; zero by design"))
    if isinstance(moves, int | float) and moves > _MAX_DEPTH_CHANGE:
        cautions.append(
            Caution(f"Depth moves by up to {moves:.3f} m with the light.", "this is a bug; please report it.")
        )
    return facts, cautions


# ---- stages


def capture_section(report: dict[str, Any]) -> Section:
    capture = pick(report, "capture") or {}
    frames = capture.get("frames")
    sources = capture.get("sources")
    facts = [
        Fact("frames kept", number(frames, "{}"), "the sharpest of each time slot"),
        Fact("training frames", number(capture.get("train"), "{}"), "the field is trained on them"),
        Fact("held out", number(capture.get("held_out"), "{}"), "excluded from training, for evaluation"),
        Fact("sources", number(_count(sources), "{}"), "films or photo folders, each under one lighting"),
    ]
    cautions = []
    if isinstance(frames, int) and frames < _FEW_FRAMES:
        cautions.append(Caution(f"Only {frames} frames were kept.", "film slower or longer, or raise capture.fps."))
    for name, source in sources.items() if isinstance(sources, dict) else ():
        kept, damaged = pick(source, "kept"), pick(source, "damaged")
        if isinstance(kept, int):
            facts.append(Fact(str(name), f"{kept} frames", _source_text(source)))
        if isinstance(damaged, int) and damaged > 0:
            cautions.append(
                Caution(
                    f"{damaged} frame(s) of “{name}” are damaged.", "copy the film from the camera again if possible."
                )
            )
    return Section(
        "capture",
        "Capture",
        "Frames were chosen from the films at regular spacing, without blurred and stationary ones, and split into "
        "training and held-out frames.",
        facts,
        cautions,
    )


def _source_text(source: dict[str, Any]) -> str:
    seconds = source.get("duration_s")
    length = duration(seconds) if isinstance(seconds, int | float) and seconds > 0 else None
    light = source.get("lighting")
    return ", ".join(str(part) for part in (source.get("kind"), length, light and f"lighting “{light}”") if part)


def _count(value: Any) -> int | None:
    return len(value) if isinstance(value, list | dict) else value if isinstance(value, int) else None


def cameras_section(report: dict[str, Any]) -> Section:
    cameras = pick(report, "cameras") or {}
    registered, total = cameras.get("registered"), cameras.get("total")
    error = cameras.get("reprojection_error_px")
    cautions = []
    placed, verdict = NOT_MEASURED, None
    if isinstance(registered, int) and isinstance(total, int):
        placed = f"{registered} of {total}"
        if total:
            text = f"All {total} frames" if registered == total else f"{placed} frames ({registered / total:.0%})"
            verdict = Verdict(f"{text} were placed in space.", "good")
        if total and registered / total < _MIN_REGISTERED:
            cautions.append(
                Caution(
                    f"{total - registered} of {total} frames could not be placed.",
                    "film slower and with more overlap, raise capture.fps, mask moving things; film twilight and night "
                    "along the same path as the day.",
                )
            )
    if isinstance(error, int | float) and error > _LARGE_REPROJECTION:
        cautions.append(
            Caution(
                f"The reprojection error is {error:.2f} px.",
                "give the camera’s calibration (camera = … under [[source]]); a wrong lens model distorts the path.",
            )
        )
    outliers = cameras.get("outliers")
    if isinstance(outliers, list) and outliers:
        cautions.append(
            Caution(
                f"{len(outliers)} frame(s) were outliers of their path and were dropped: {join_names(outliers, 6)}.",
                "a few are normal near large moving or featureless objects; mask these if there are many.",
            )
        )
    if cameras.get("note"):
        cautions.append(
            Caution(
                f"{str(cameras['note']).rstrip('.').capitalize()}.",
                "check the given poses, or let twin estimate them from the images.",
            )
        )
    facts = [
        Fact("frames placed", placed, "frames that the reconstruction could use"),
        Fact("reprojection error", number(error, "{:.2f} px"), "distance of points from their observations"),
        Fact("points", number(cameras.get("points"), "{:,}"), "triangulated"),
        Fact(
            "track length",
            number(_first_present(cameras, "mean_track_length", "track_length"), "{:.1f} frames"),
            "frames that observe a point",
        ),
        Fact(
            "focal length",
            _focal_text(_first_present(cameras, "focal_px", "focal")),
            "given, or estimated by the reconstruction",
        ),
        Fact("method", str(cameras.get("mapper") or NOT_MEASURED), "global; incremental if that fails"),
    ]
    return Section(
        "cameras",
        "Cameras",
        "Structure from motion estimated the pose of each frame from points that several frames share.",
        facts,
        cautions,
        verdict=verdict,
    )


def _first_present(table: dict[str, Any], *keys: str) -> Any:
    """The value of the first key that is present."""
    return next((table[key] for key in keys if table.get(key) is not None), None)


def _focal_text(value: Any) -> str:
    if isinstance(value, dict):
        each = {number(focal, "{:.0f} px") for focal in value.values()}
        if len(each) == 1:
            return each.pop()
        return ", ".join(f"{name} {number(focal, '{:.0f} px')}" for name, focal in value.items()) or NOT_MEASURED
    if isinstance(value, list) and value:
        return ", ".join(number(focal, "{:.0f} px") for focal in value[:4])
    return number(value, "{:.0f} px")


def _scale_facts(each: dict[str, Any]) -> list[Fact]:
    """Each of several sources of scale, compared with the combined scale."""
    facts = []
    for name, one in each.items():
        relative, sigma = (one.get(key) if isinstance(one, dict) else None for key in ("relative", "uncertainty"))
        offset = relative - 1.0 if isinstance(relative, int | float) else None
        facts.append(
            Fact(
                f"by {_SCALE_SOURCES.get(name, name)}",
                f"{number(offset, '{:+.2%}')} ± {number(sigma, '{:.1%}')}",
                "compared with the combined scale",
            )
        )
    return facts


def metric_section(report: dict[str, Any]) -> Section:
    metric = pick(report, "metric") or {}
    uncertainty = metric.get("scale_uncertainty")
    if isinstance(uncertainty, bool) or not isinstance(uncertainty, int | float):
        uncertainty = None
    cautions = []
    if uncertainty is not None and uncertainty > _LARGE_SCALE_UNCERTAINTY:
        cautions.append(
            Caution(
                f"The scale is uncertain by {uncertainty:.1%}: 10 m may be {10 * uncertainty:.1f} m longer or shorter.",
                "give a measured distance ([metric] distance = …) or a printed marker, and keep the camera’s height "
                "constant while filming.",
            )
        )
    tilt = metric.get("gravity_uncertainty_deg")
    if isinstance(tilt, int | float) and tilt > _LARGE_TILT:
        cautions.append(
            Caution(
                f"The direction of gravity is uncertain by {tilt:.1f}°.",
                "film with the road in view and the horizon level; give the camera’s calibration.",
            )
        )
    if metric.get("road_reliable") is False:
        cautions.append(
            Caution(
                "Too few points lie on the road to estimate its plane.",
                "film closer to the ground or at a higher resolution, or put textured objects on the road.",
            )
        )
    each = metric.get("scales")
    each = each if isinstance(each, dict) else {}
    apart = metric.get("scale_disagreement")
    if isinstance(apart, int | float) and apart > _LARGE_DISAGREEMENT:
        cautions.append(
            Caution(
                f"The sources of scale contradict each other: they differ by {apart:.1f} standard deviations.",
                "measure again what was given under [metric], and remove the source that is wrong.",
            )
        )
    source = metric.get("scale_source")
    sure = "" if uncertainty is None else f", with an uncertainty of about {uncertainty:.1%}"
    named = " and ".join(_SCALE_SOURCES.get(one, one) for one in str(source).split(" + "))
    source_text = named if source else NOT_MEASURED
    verdict = None
    if source is not None:
        verdict = Verdict(f"Its scale comes from {named}{sure}.", "good")
    facts = [
        Fact("scale from", source_text, "as given in scene.toml"),
        Fact("scale uncertainty", number(uncertainty, "{:.1%}"), "one standard deviation, relative"),
        *_scale_facts(each),
        Fact(
            "gravity from",
            str(_first_present(metric, "gravity_source", "gravity") or NOT_MEASURED),
            "source of the vertical direction",
        ),
        Fact("tilt uncertainty", number(metric.get("gravity_uncertainty_deg"), "{:.2f}°"), "one standard deviation"),
        Fact("filmed path", number(metric.get("path_length_m"), "{:.1f} m"), "of the longest film"),
        Fact(
            "camera height",
            number(metric.get("camera_height_median_m"), "{:.2f} m"),
            "median, above the estimated floor",
        ),
    ]
    return Section(
        "metric",
        "Scale and gravity",
        "The reconstruction was aligned with gravity, placed on the floor, and scaled to meters.",
        facts,
        cautions,
        verdict=verdict,
    )


def field_section(report: dict[str, Any]) -> Section:
    psnr, ssim = numbers(pick(report, "field.psnr")), pick(report, "field.ssim")
    n = numbers(pick(report, "field.n"))
    cautions, facts = [], []
    for name, value in psnr.items():
        like = ssim.get(name) if isinstance(ssim, dict) else None
        frames = f"{n[name]:.0f} held-out frames" if name in n else "held-out frames"
        text = f"{value:.1f} dB PSNR" + ("" if like is None else number(like, ", {:.2f} SSIM"))
        facts.append(Fact(name, text, f"on {frames}, compared with the real film"))
        if value < _LOW_PSNR:
            cautions.append(
                Caution(
                    f"“{name}” is rendered at only {value:.1f} dB.",
                    "raise nerf.steps, mask moving things, film slower in this light, or film it from more places.",
                )
            )
        if name in n and n[name] < _FEW_HELD_OUT:
            cautions.append(
                Caution(
                    f"Only {n[name]:.0f} frame(s) of “{name}” were held out, so its PSNR is uncertain.",
                    "keep more frames (capture.fps) or hold out more of them (capture.held_out_every).",
                )
            )
    facts = facts or [Fact("held-out PSNR", NOT_MEASURED)]
    facts.append(
        Fact("training steps", number(pick(report, "field.steps"), "{:,}"), "more steps are sharper but slower")
    )
    if (found := pick(report, "field.stereo.sightings")) is not None:
        form = "used for depth supervision; {:.0%} of the attempted stereo estimates succeeded"
        share = number(pick(report, "field.stereo.share"), form)
        facts.append(Fact("stereo depths", number(found, "{:,}"), share))
    for name, value in (pick(report, "field.psnr_baked") or {}).items():
        lost = value - float(pick(report, f"field.psnr_unfitted.{name}") or value)
        facts.append(Fact(f"{name}, baked", f"{lost:+.1f} dB", "effect of baking, on the same frames"))
    swapped, more = cross_lighting_facts(report)
    return Section(
        "field",
        "Radiance field",
        "A NeRF models the appearance of every point from every direction, in each lighting. It is evaluated on "
        "held-out frames: only the appearance is fitted on one half of such a frame, and the other half is scored. "
        "Images on this page are rendered without fitting. Above about 20 dB a view is easy to recognize; above 30 dB "
        "it is hard to distinguish from the film.",
        facts + swapped,
        cautions + more,
        verdict=_field_verdict(psnr),
    )


def _field_verdict(psnr: dict[str, float]) -> Verdict | None:
    if not psnr:
        return None
    low, high = min(psnr.values()), max(psnr.values())
    psnr_range = f"{low:.1f} dB" if round(low, 1) == round(high, 1) else f"{low:.1f} to {high:.1f} dB"
    under = f"in {len(psnr)} lightings" if len(psnr) > 1 else f"in the lighting “{next(iter(psnr))}”"
    return Verdict(f"Held-out views were rendered {under} at {psnr_range} PSNR.", "good")


def mesh_section(report: dict[str, Any]) -> Section:
    mesh = pick(report, "mesh") or {}
    parts = mesh.get("parts")
    cautions = []
    if parts == 0:
        cautions.append(
            Caution(
                "Nothing solid was found apart from the ground.",
                "if there are obstacles, film them from closer, raise nerf.steps or lower mesh.obstacle_height.",
            )
        )
    left_out = mesh.get("parts_left_out")
    if isinstance(left_out, int) and left_out > 0:
        cautions.append(
            Caution(
                f"{left_out} solid part(s) were left out because of mesh.max_parts.",
                "raise mesh.max_parts, or raise mesh.voxel for fewer parts.",
            )
        )
    beyond, failed = mesh.get("parts_beyond_bound"), mesh.get("coacd_failed")
    if isinstance(beyond, int) and beyond > 0:
        cautions.append(
            Caution(
                f"{beyond} solid part(s) stick out of their surface by more than mesh.max_protrusion.",
                "raise mesh.max_parts, which allows smaller parts, or lower mesh.voxel.",
            )
        )
    if isinstance(failed, int) and failed > 0:
        cautions.append(
            Caution(
                f"{failed} piece(s) could not be split into convex parts and are coarser than the rest.",
                "check them in the picture of the MuJoCo scene; a smaller mesh.voxel usually helps.",
            )
        )
    covered = pick(mesh, "ground.corridor_coverage")
    if isinstance(covered, int | float) and covered < _LOW_COVERAGE:
        cautions.append(
            Caution(
                f"Only {covered:.0%} of the ground along the route was measured; the rest is interpolated.",
                "film with more of the road in view, or carry the camera at constant height.",
            )
        )
    facts = [
        Fact("solid parts", number(parts, "{}"), "convex collision geometry"),
        Fact("surface", number(mesh.get("faces"), "{:,} triangles"), "visual mesh, without collisions"),
        Fact(
            "ground measured", number(pick(mesh, "ground.coverage"), "{:.0%}"), "the rest of its area was interpolated"
        ),
        Fact("along the route", number(covered, "{:.0%}"), "of the ground was measured"),
        Fact(
            "road’s slope", number(pick(mesh, "ground.route_slope_rms"), "{:.1%}"), "root mean square, along the route"
        ),
        Fact("parts stick out", number(mesh.get("max_protrusion_m"), "{:.2f} m"), "of the surface, at most"),
        Fact("left out", number(left_out, "{}"), "parts beyond what mesh.max_parts allows"),
    ]
    return Section(
        "mesh",
        "Surfaces",
        "A surface was extracted from the field’s density: the ground as a height field, and everything above it as "
        "convex parts, which the physics engine needs.",
        facts,
        cautions,
    )


def _route_choice(report: dict[str, Any]) -> str:
    """The passes that the route follows, and how many there are."""
    route = pick(report, "mesh.route")
    if not isinstance(route, dict) or not route.get("passes"):
        return "the filmed path"
    if not route.get("chosen"):
        return "through the way points of [route]"
    count = len(route["passes"])
    chosen = ", then ".join(map(str, route["chosen"]))
    return f"along {chosen}, of {count} filmed passes; [route] chooses others" if count > 1 else "the filmed path"


def mjcf_section(report: dict[str, Any]) -> Section:
    mjcf = pick(report, "mjcf") or {}
    routeless = mjcf.get("has_route") is False
    done = "Ground, parts, lights and a Husky at the start of the route, as a folder that MuJoCo loads: "
    if routeless:
        done = "Ground, parts and lights as a folder that MuJoCo loads, without a robot because there is no route: "
    size = mjcf.get("assets_bytes")
    megabytes = size / 1e6 if isinstance(size, int | float) else None
    facts = [
        Fact("route", "none" if routeless else number(mjcf.get("route_length_m"), "{:.1f} m"), _route_choice(report)),
        Fact("turn", number(mjcf.get("turn_deg"), "{:+.0f}°"), "from the first heading to the last; right is negative"),
        Fact("corridor", number(mjcf.get("half_width_m"), "± {:.2f} m"), "kept free of solid parts"),
        Fact("free at the start", number(mjcf.get("spawn_clearance_m"), "{:.2f} m"), "robot to the nearest part"),
        Fact("geoms", number(mjcf.get("geoms"), "{:,}"), "shapes in the scene"),
        Fact("folder", number(megabytes, "{:.1f} MB"), "may be moved or zipped"),
    ]
    if routeless:
        facts = [fact for fact in facts if fact.name not in ("turn", "corridor", "free at the start")]
    touched = mjcf.get("spawn_touched")
    cautions = []
    if isinstance(touched, list) and touched:
        cautions.append(
            Caution(
                f"The robot touches {join_names(touched)} where it starts.",
                "raise mjcf.corridor_margin or mesh.obstacle_height, or start the film further along.",
            )
        )
    return Section("mjcf", "MuJoCo scene", f"{done}build/5_mjcf/scene.xml.", facts, cautions)


def review_section(report: dict[str, Any]) -> Section:
    review = pick(report, "review") or {}
    follower = review.get("follower")
    cautions: list[Caution] = []
    facts: list[Fact] = []
    if isinstance(follower, dict):
        if not follower.get("reached_goal"):
            cautions.append(
                Caution(
                    "The scripted driver did not reach the goal.",
                    "find in the video where it stops: at a part in the way (raise mesh.obstacle_height or "
                    "nerf.steps), or at a step in the ground (raise mesh.ground_smoothing).",
                )
            )
        if follower.get("touched"):
            cautions.append(
                Caution(
                    f"It touched {join_names(follower['touched'], 8)}.",
                    "these are solid parts in or beside the corridor; if nothing is there in reality, mask what moved "
                    "while filming, or raise mjcf.corridor_margin.",
                )
            )
        facts = [
            Fact("goal reached", format_value(follower.get("reached_goal")), "by a scripted driver without camera"),
            Fact(
                "touched", join_names(follower["touched"]) if "touched" in follower else NOT_MEASURED, "besides ground"
            ),
            Fact("farthest off the route", number(follower.get("max_cross_track_m"), "{:.2f} m"), "cross-track"),
            Fact("driven", number(follower.get("distance_m"), "{:.1f} m"), duration(follower.get("seconds"))),
            Fact("turned", number(follower.get("turn_deg"), "{:+.0f}°"), "right is negative"),
            Fact(
                "trust in its pictures",
                number((review.get("trust") or {}).get("mean"), "{:.2f}"),
                "mean estimated reliability of pictures rendered in the corridor, 0 (poor) to 1 (like the film)",
            ),
        ]
    facts += [
        Fact("video", duration(review.get("duration_s")), number(review.get("frames"), "{} frames")),
        Fact("rendering", number(review.get("render_seconds_per_frame"), "{:.2f} s"), "per NeRF view in the video"),
    ]
    return Section(
        "review",
        "Review",
        "The video above: the field beside the real frames, the changing light, and the Husky on the route.",
        facts,
        cautions,
        str(review.get("not_applicable") or ""),
        follower_verdict(report),
    )


SECTIONS: dict[str, Callable[[dict[str, Any]], Section]] = {
    "capture": capture_section,
    "cameras": cameras_section,
    "metric": metric_section,
    "field": field_section,
    "mesh": mesh_section,
    "mjcf": mjcf_section,
    "review": review_section,
}
"""Stage name → function that makes its section, in page order."""


def costs_section(report: dict[str, Any]) -> Section:
    peak, cautions = pick(report, "peak_memory_bytes"), []
    if isinstance(peak, int | float) and peak / 2**30 > _LARGE_MEMORY:
        cautions.append(
            Caution(
                f"The build needed {peak / 2**30:.1f} GiB of memory.",
                "for a smaller machine lower capture.max_size or nerf.rays, or raise mesh.voxel.",
            )
        )
    return Section(
        "costs",
        "Costs and provenance",
        "Time and memory per stage, and everything needed to reproduce this build.",
        cautions=cautions,
    )


def sections(report: dict[str, Any]) -> list[Section]:
    return [make(report) for make in (*SECTIONS.values(), geometry_section, truth_section, costs_section)]


def headline_sections(report: dict[str, Any]) -> list[Section]:
    """Sections that have a headline: the drive first, because it is the purpose of the twin, then in page order."""
    with_headline = [section for section in sections(report) if section.headline]
    return sorted(with_headline, key=lambda section: section.name != "review")


def cautions(report: dict[str, Any]) -> list[dict[str, str]]:
    return [
        {"section": section.name, "title": section.title, "what": caution.what, "cure": caution.cure}
        for section in sections(report)
        for caution in section.cautions
    ]
