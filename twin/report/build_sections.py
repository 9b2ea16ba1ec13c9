"""What the report says about each stage: what was done, its numbers, and cautions with their cures; no HTML here.

The stages up to metric cameras are in `build_sections.py`. `sections` has them all: page, `report.json` and the printed
summary take headlines and cautions from there alone.
"""

from collections.abc import Callable
from typing import Any

from twin.errors import listing
from twin.report.html import (
    ENOUGH_REGISTERED,
    LARGE_PATH_ERROR,
    LARGE_SCALE_UNCERTAINTY,
    LOW_PSNR,
    NOT_MEASURED,
    Caution,
    Fact,
    Section,
    Verdict,
    duration,
    follower_verdict,
    number,
    numbers,
    pick,
    plain,
    scale_uncertainty,
    source_words,
)
from twin.report.visual_vs_collision import seen_section

# ---- What the report says where the truth of a place is known; words only, no HTML.


# From where on an error is worth a caution.
_LARGE_SCALE_ERROR = 0.02  # relative
_LARGE_GROUND_ERROR = 0.04  # [m]
_LARGE_SURFACE_ERROR = 0.1  # [m]


def truth_section(report: dict[str, Any]) -> Section:
    """How far the twin is from the known truth; not a stage, and not there for a real place."""
    truth = pick(report, "truth")
    title, name = "Against the truth", "truth"
    if not isinstance(truth, dict):
        return Section(
            name,
            title,
            "",
            not_applicable="no truth was compared with: it is known of generated places only "
            "(python -m twin.reality compare SCENE)",
        )
    rows = (
        ("ate_m", "camera positions", "{:.3f} m", "root mean square, after the best fit of path to path"),
        ("ate_max_m", "worst camera", "{:.3f} m", "the frame that is furthest off"),
        ("ate_rigid_m", "camera positions, in the twin’s metres", "{:.3f} m", "with its scale as it is"),
        ("rotation_median_deg", "camera directions", "{:.2f}°", "median"),
        ("scale_error", "scale", "{:+.2%}", "the twin’s metre against the true one"),
        ("tilt_deg", "gravity", "{:.2f}°", "between the twin’s vertical and the true one"),
        ("ground_median_m", "ground height", "{:.3f} m", "median error inside the corridor"),
        ("ground_p95_m", "ground height, worst places", "{:.3f} m", "95 of 100 places are better"),
        ("obstacle_accuracy_m", "solid parts to true surface", "{:.3f} m", "median: is there something where it says?"),
        ("obstacle_completeness_m", "true surface to solid parts", "{:.3f} m", "median: is everything there?"),
        ("mesh_accuracy_median_m", "visible mesh to true surface", "{:.3f} m", "median: is what it shows there?"),
        ("mesh_accuracy_mean_m", "the same, mean", "{:.3f} m", "what is wrong by more than 1 m counts as 1 m"),
        ("mesh_completeness_5cm", "true surface within 5 cm of it", "{:.0%}", "of all that the cameras saw near by"),
        ("mesh_completeness_10cm", "true surface within 10 cm of it", "{:.0%}", _by_kind(truth)),
        ("mesh_chamfer_m", "visible mesh, Chamfer distance", "{:.3f} m", "mean of there and back, each up to 1 m"),
        ("corridor_intrusions", "parts inside the true corridor", "{}", "nothing solid may stand there"),
        ("route_median_m", "route", "{:.3f} m", "median distance to the true centre line"),
        ("depth_median_m", "depth of the field", "{:.3f} m", "median error, up to 20 m"),
    )
    facts = [Fact(label, number(truth.get(key), form), meaning) for key, label, form, meaning in rows]
    cautions = [
        Caution(f"{what}: {number(abs(truth[key]), form)} off, more than {number(limit, form)}.", cure)
        for key, limit, what, form, cure in (
            ("ate_m", LARGE_PATH_ERROR, "The camera path", "{:.3f} m", "give the camera’s calibration."),
            ("scale_error", _LARGE_SCALE_ERROR, "The scale", "{:.1%}", "check what the metres come from."),
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
        "This place was generated, so what is really there is known. The build never saw that; only this comparison "
        "does.",
        facts,
        cautions,
        verdict=_verdict(truth),
    )


def _verdict(truth: dict[str, Any]) -> Verdict | None:
    """How true the twin is in one sentence, where that is known."""
    off, ground = truth.get("ate_m"), truth.get("ground_median_m")
    if not isinstance(off, int | float):
        return None
    text = f"Against the known truth its cameras are {100 * off:.1f} cm off"
    if isinstance(ground, int | float):
        text += f", and its ground {100 * ground:.1f} cm"
    return Verdict(f"{text}.", "good")


def _by_kind(truth: dict[str, Any]) -> str:
    """How much of the ground, of solid things and of leaves the visible mesh has."""
    words = (("ground", "ground"), ("obstacle", "solid things up to their roofs"), ("foliage", "leaves"))
    shares = [(name, truth.get(f"mesh_completeness_10cm_{kind}")) for kind, name in words]
    told = [f"{number(share, '{:.0%}')} of {name}" for name, share in shares if share is not None]
    return listing(told) if told else "is everything shown?"


# ---- What the report says about the lightings' independence of the poses, see `twin.nerf.evaluate`; no HTML here.


_FEW_FOLLOW = 0.7  # share; one half is a draw
_DEPTH_STILL = 1e-3  # [m]


def cross_lighting_words(report: dict[str, Any]) -> tuple[list[Fact], list[Caution]]:
    """Whether places look as the light asked for has it, whatever they were filmed in; nothing with one light."""
    cross = pick(report, "field.cross_lighting")
    follows = numbers(pick(cross, "colour_follows"))
    facts, cautions = [], []
    for name, share in follows.items():
        off, own = (number(pick(cross, f"{key}.{name}"), "{:.0%}") for key in ("to_shown_rms", "to_filmed_rms"))
        told = f"of places filmed in other light look like its film once shown in it: {off} of full brightness off"
        facts.append(
            Fact(f"{name}, swapped in", f"{share:.0%}", f"{told}, but {own} off the light they were filmed in")
        )
        if share < _FEW_FOLLOW:
            cautions.append(
                Caution(
                    f"Only {share:.0%} of the places filmed in other light look like “{name}” when shown in it.",
                    "film every light along the same path; lights that look much alike come to about 50% anyway.",
                )
            )
    moves = pick(cross, "depth_moves_m")
    if follows:
        facts.append(
            Fact("depth, light swapped", number(moves, "{:.3f} m"), "the most it changes: by design not at all")
        )
    if isinstance(moves, int | float) and moves > _DEPTH_STILL:
        cautions.append(Caution(f"Depth moves by up to {moves:.3f} m with the light.", "this is a defect; report it."))
    return facts, cautions


# ---- What the report says about capture, cameras and metres: how the films became posed frames; no HTML here.


# From where on a number is worth a warning.
_LARGE_REPROJECTION = 1.5  # [px]
_FEW_FRAMES = 20
_LARGE_TILT = 1.5  # [°]


def capture_section(report: dict[str, Any]) -> Section:
    capture = pick(report, "capture") or {}
    frames = capture.get("frames")
    sources = capture.get("sources")
    facts = [
        Fact("frames kept", number(frames, "{}"), "the sharpest of each time slot"),
        Fact("to learn from", number(capture.get("train"), "{}"), "training frames"),
        Fact("held out", number(capture.get("held_out"), "{}"), "never trained on, kept to judge the result"),
        Fact("sources", number(_count(sources), "{}"), "films or photo folders, each under one lighting"),
    ]
    cautions = []
    if isinstance(frames, int) and frames < _FEW_FRAMES:
        cautions.append(Caution(f"Only {frames} frames were kept.", "film slower or longer, or raise capture.fps."))
    for name, source in sources.items() if isinstance(sources, dict) else ():
        kept, damaged = pick(source, "kept"), pick(source, "damaged")
        if isinstance(kept, int):
            facts.append(Fact(str(name), f"{kept} frames", _about_source(source)))
        if isinstance(damaged, int) and damaged > 0:
            cautions.append(
                Caution(
                    f"{damaged} frame(s) of “{name}” are damaged.", "copy the film again from the camera if you can."
                )
            )
    return Section(
        "capture",
        "Capture",
        "Frames were chosen from the films at regular spacing, blurred and standing ones left out, and split into "
        "those to learn from and those to judge by.",
        facts,
        cautions,
    )


def _about_source(source: dict[str, Any]) -> str:
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
        if total and registered / total < ENOUGH_REGISTERED:
            cautions.append(
                Caution(
                    f"{total - registered} of {total} frames could not be placed.",
                    "film slower and with more overlap, raise capture.fps, mask what moves; twilight and night need "
                    "the same path as the day.",
                )
            )
    if isinstance(error, int | float) and error > _LARGE_REPROJECTION:
        cautions.append(
            Caution(
                f"Points miss their pixels by {error:.2f} px.",
                "give the camera’s calibration (camera = … under [[source]]); a wrong lens model bends the path.",
            )
        )
    outliers = cameras.get("outliers")
    if isinstance(outliers, list) and outliers:
        cautions.append(
            Caution(
                f"{len(outliers)} frame(s) lay off their path and were dropped: {listing(outliers, 6)}.",
                "a few are normal beside a large moving or featureless thing; mask it if there are many.",
            )
        )
    if cameras.get("note"):
        cautions.append(
            Caution(
                f"{str(cameras['note']).rstrip('.').capitalize()}.",
                "check the poses that came with the input, or let twin find them from the images.",
            )
        )
    facts = [
        Fact("frames placed", placed, "how many frames the reconstruction could use"),
        Fact("reprojection error", number(error, "{:.2f} px"), "how far points are from where they were seen"),
        Fact("points", number(cameras.get("points"), "{:,}"), "seen and located"),
        Fact(
            "track length",
            number(_first(cameras, "mean_track_length", "track_length"), "{:.1f} frames"),
            "how many frames saw each point",
        ),
        Fact("focal length", _focal(_first(cameras, "focal_px", "focal")), "given, or found by the reconstruction"),
        Fact("method", str(cameras.get("mapper") or NOT_MEASURED), "global first, incremental where that fails"),
    ]
    return Section(
        "cameras",
        "Cameras",
        "Where each frame was taken and which way it looked, found from points that several frames share "
        "(structure from motion).",
        facts,
        cautions,
        verdict=verdict,
    )


def _first(table: dict[str, Any], *keys: str) -> Any:
    """The value of the first key that is there."""
    return next((table[key] for key in keys if table.get(key) is not None), None)


def _focal(value: Any) -> str:
    if isinstance(value, dict):
        each = {number(focal, "{:.0f} px") for focal in value.values()}
        if len(each) == 1:
            return each.pop()
        return ", ".join(f"{name} {number(focal, '{:.0f} px')}" for name, focal in value.items()) or NOT_MEASURED
    if isinstance(value, list) and value:
        return ", ".join(number(focal, "{:.0f} px") for focal in value[:4])
    return number(value, "{:.0f} px")


def metric_section(report: dict[str, Any]) -> Section:
    metric = pick(report, "metric") or {}
    uncertainty = scale_uncertainty(report)
    cautions = []
    if uncertainty is not None and uncertainty > LARGE_SCALE_UNCERTAINTY:
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
                f"Which way is up is uncertain by {tilt:.1f}°.",
                "film with the road in view and the horizon level; give the camera’s calibration.",
            )
        )
    if metric.get("road_reliable") is False:
        cautions.append(
            Caution(
                "Too few points lie on the road to find its plane.",
                "film nearer to the ground or in higher resolution, or put something with texture on the road.",
            )
        )
    source = metric.get("scale_source")
    sure = "" if uncertainty is None else f", sure to about {uncertainty:.1%}"
    verdict = Verdict(f"Its metres come from {source_words(source)}{sure}.", "good") if source is not None else None
    facts = [
        Fact("metres from", source_words(source) if source else NOT_MEASURED, "what scene.toml gave"),
        Fact("scale uncertainty", number(uncertainty, "{:.1%}"), "one standard deviation, relative"),
        Fact("up from", str(_first(metric, "gravity_source", "gravity") or NOT_MEASURED), "what decided where up is"),
        Fact("tilt uncertainty", number(metric.get("gravity_uncertainty_deg"), "{:.2f}°"), "one standard deviation"),
        Fact("filmed path", number(metric.get("path_length_m"), "{:.1f} m"), "of the longest film"),
        Fact(
            "camera height", number(metric.get("camera_height_median_m"), "{:.2f} m"), "median, above the floor found"
        ),
    ]
    return Section(
        "metric",
        "Metres and gravity",
        "The reconstruction was turned upright, put on the floor, and brought to metres.",
        facts,
        cautions,
        verdict=verdict,
    )


# From where on a number is worth a warning.
_FEW_HELD_OUT = 3  # frames per lighting
_LOW_COVERAGE = 0.5  # share of the ground along the route
_LARGE_MEMORY = 4.0  # [GiB]


def field_section(report: dict[str, Any]) -> Section:
    psnr, ssim = numbers(pick(report, "field.psnr")), pick(report, "field.ssim")
    n = numbers(pick(report, "field.n"))
    cautions, facts = [], []
    for name, value in psnr.items():
        like = ssim.get(name) if isinstance(ssim, dict) else None
        seen = f"{n[name]:.0f} held-out frames" if name in n else "held-out frames"
        text = f"{value:.1f} dB PSNR" + ("" if like is None else number(like, ", {:.2f} SSIM"))
        facts.append(Fact(name, text, f"on {seen}, compared with the real film"))
        if value < LOW_PSNR:
            cautions.append(
                Caution(
                    f"“{name}” is rendered at only {value:.1f} dB.",
                    "raise nerf.steps, mask what moves, film slower in this light, or film it from more places.",
                )
            )
        if name in n and n[name] < _FEW_HELD_OUT:
            cautions.append(
                Caution(
                    f"Only {n[name]:.0f} frame(s) of “{name}” were held out, so its score is rough.",
                    "keep more frames (capture.fps) or hold out more of them (capture.held_out_every).",
                )
            )
    facts = facts or [Fact("held-out PSNR", NOT_MEASURED)]
    facts.append(Fact("training steps", number(pick(report, "field.steps"), "{:,}"), "more: sharper, but slower"))
    if (found := pick(report, "field.stereo.sightings")) is not None:
        share = number(pick(report, "field.stereo.share"), "learnt from too; {:.0%} of those tried")
        facts.append(Fact("distances by stereo", number(found, "{:,}"), share))
    for name, value in (pick(report, "field.psnr_baked") or {}).items():
        lost = value - float(pick(report, f"field.psnr_unfitted.{name}") or value)
        facts.append(Fact(f"{name}, baked", f"{lost:+.1f} dB", "what the bricks change, on the same frames"))
    swapped, more = cross_lighting_words(report)
    return Section(
        "field",
        "Radiance field",
        "A NeRF learnt what every point looks like from every side, in each lighting. It is judged on frames it never "
        "saw: only the light is fitted on one half of such a frame, the other half is scored (for the pictures not "
        "even that). Above about 20 dB a view is easy to recognise, above 30 dB it is hard to tell from the film.",
        facts + swapped,
        cautions + more,
        verdict=_field_verdict(psnr),
    )


def _field_verdict(psnr: dict[str, float]) -> Verdict | None:
    if not psnr:
        return None
    low, high = min(psnr.values()), max(psnr.values())
    span = f"{low:.1f} dB" if round(low, 1) == round(high, 1) else f"{low:.1f} to {high:.1f} dB"
    under = f"in {len(psnr)} lightings" if len(psnr) > 1 else f"in the lighting “{next(iter(psnr))}”"
    return Verdict(f"Views it had never seen were rendered {under} at {span} PSNR.", "good")


def mesh_section(report: dict[str, Any]) -> Section:
    mesh = pick(report, "mesh") or {}
    parts = mesh.get("parts")
    cautions = []
    if parts == 0:
        cautions.append(
            Caution(
                "Nothing solid was found beside the ground.",
                "if there are obstacles, film them from nearer, raise nerf.steps or lower mesh.obstacle_height.",
            )
        )
    left_out = mesh.get("parts_left_out")
    if isinstance(left_out, int) and left_out > 0:
        cautions.append(
            Caution(
                f"{left_out} solid part(s) were left out, as mesh.max_parts allows no more.",
                "raise mesh.max_parts, or mesh.voxel for fewer.",
            )
        )
    beyond, failed = mesh.get("parts_beyond_bound"), mesh.get("coacd_failed")
    if isinstance(beyond, int) and beyond > 0:
        cautions.append(
            Caution(
                f"{beyond} solid part(s) stick out of their surface by more than mesh.max_protrusion.",
                "raise mesh.max_parts, so that each may be smaller, or lower mesh.voxel.",
            )
        )
    if isinstance(failed, int) and failed > 0:
        cautions.append(
            Caution(
                f"{failed} piece(s) could not be split into convex parts and are coarser than the rest.",
                "look at them in the picture of the MuJoCo scene; a smaller mesh.voxel usually helps.",
            )
        )
    covered = pick(mesh, "ground.corridor_coverage")
    if isinstance(covered, int | float) and covered < _LOW_COVERAGE:
        cautions.append(
            Caution(
                f"Only {covered:.0%} of the ground along the route was measured; the rest is filled in.",
                "film with more of the road in view, or carry the camera at constant height.",
            )
        )
    facts = [
        Fact("solid parts", number(parts, "{}"), "convex bodies the robot can bump into"),
        Fact("surface", number(mesh.get("faces"), "{:,} triangles"), "what is seen; it touches nothing"),
        Fact("ground measured", number(pick(mesh, "ground.coverage"), "{:.0%}"), "the rest of its area was filled in"),
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
        "The field’s density became a surface: the ground as a height field, and everything that stands on it as "
        "convex parts, because a physics engine needs those.",
        facts,
        cautions,
    )


def mjcf_section(report: dict[str, Any]) -> Section:
    mjcf = pick(report, "mjcf") or {}
    routeless = mjcf.get("has_route") is False
    done = "Ground, parts, lights and a Husky at the start of the route, as a folder that plain MuJoCo opens: "
    if routeless:
        done = (
            "Ground, parts and lights as a folder that plain MuJoCo opens, without a robot, since there is no route: "
        )
    size = mjcf.get("assets_bytes")
    megabytes = size / 1e6 if isinstance(size, int | float) else None
    facts = [
        Fact("route", "none" if routeless else number(mjcf.get("route_length_m"), "{:.1f} m"), "the filmed path"),
        Fact("turn", number(mjcf.get("turn_deg"), "{:+.0f}°"), "from the first heading to the last; right is negative"),
        Fact("corridor", number(mjcf.get("half_width_m"), "± {:.2f} m"), "kept free of solid parts"),
        Fact("free at the start", number(mjcf.get("spawn_clearance_m"), "{:.2f} m"), "from the robot to the next part"),
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
                f"The robot touches {listing(touched)} where it starts.",
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
                    "look in the film where it stops: a part in the way (raise mesh.obstacle_height or nerf.steps), "
                    "or a step in the ground (raise mesh.ground_smoothing).",
                )
            )
        if follower.get("touched"):
            cautions.append(
                Caution(
                    f"It touched {listing(follower['touched'], 8)}.",
                    "those are solid parts in or beside the corridor; if nothing stands there, mask what moved while "
                    "filming, or raise mjcf.corridor_margin.",
                )
            )
        facts = [
            Fact("goal reached", plain(follower.get("reached_goal")), "by a scripted driver without eyes"),
            Fact("touched", listing(follower["touched"]) if "touched" in follower else NOT_MEASURED, "besides ground"),
            Fact("farthest off the route", number(follower.get("max_cross_track_m"), "{:.2f} m"), "cross-track"),
            Fact("driven", number(follower.get("distance_m"), "{:.1f} m"), duration(follower.get("seconds"))),
            Fact("turned", number(follower.get("turn_deg"), "{:+.0f}°"), "right is negative"),
            Fact(
                "trust in its pictures",
                number((review.get("trust") or {}).get("mean"), "{:.2f}"),
                "0 to 1, in the corridor",
            ),
        ]
    facts += [
        Fact("film", duration(review.get("duration_s")), number(review.get("frames"), "{} frames")),
        Fact("rendering", number(review.get("render_seconds_per_frame"), "{:.2f} s"), "per NeRF picture of the film"),
    ]
    return Section(
        "review",
        "Review",
        "The film above: the field beside the real frames, the light turning, and the Husky driven along the route.",
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
"""Stage name → its section, in the order of the page."""


def costs_section(report: dict[str, Any]) -> Section:
    """What the whole build cost; not a stage."""
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
        "Costs and origins",
        "Where the time went, and everything needed to build the same twin again.",
        cautions=cautions,
    )


def sections(report: dict[str, Any]) -> list[Section]:
    """Everything the report says, in the order of the page."""
    beside = (seen_section, truth_section, costs_section)
    return [make(report) for make in (*SECTIONS.values(), *beside)]


def summed_up(report: dict[str, Any]) -> list[Section]:
    """The sections that have a headline: the drive first, as it is what the twin is for, then in the page's order."""
    told = [section for section in sections(report) if section.headline]
    return sorted(told, key=lambda section: section.name != "review")


def cautions(report: dict[str, Any]) -> list[dict[str, str]]:
    """Every caution of every section as in `report.json`: section, title, what, cure."""
    return [
        {"section": section.name, "title": section.title, "what": caution.what, "cure": caution.cure}
        for section in sections(report)
        for caution in section.cautions
    ]
