"""Sections of the build report on its stages: a description of each, its numbers, and cautions with their cures."""

from collections.abc import Callable
from typing import Any

from twin.errors import join_names
from twin.mjcf.scene_xml import CLEARANCE_RANGE
from twin.report.html import (
    NOT_MEASURED,
    Caution,
    Fact,
    Section,
    Verdict,
    as_number,
    cautions_above,
    duration,
    facts_of,
    follower_verdict,
    format_value,
    number,
    numbers,
    pick,
)

_MIN_REGISTERED = 0.9  # a caution is given if fewer of the frames have a camera pose
_LARGE_SCALE_UNCERTAINTY = 0.03  # [relative] a caution is given if it is larger
_LOW_PSNR = 18.0  # [dB]
_FEW_HELD_OUT = 3  # a caution is given if a lighting has fewer held-out frames
_LOW_LIGHTING_AGREEMENT = 0.7  # fraction of places, see `cross_lighting_facts`; 0.5 is chance

_SCALE_SOURCES = {
    "camera_height": "the camera’s height above the ground",
    "distance": "a distance measured between two marked points",
    "marker": "a printed marker of known size",
    "gps": "the GPS positions of the images",
    "odometry": "the robot’s odometry",
    "poses": "the given metric poses",
    "poses_are_metric": "the given metric poses",
}


def capture_section(report: dict[str, Any]) -> Section:
    sources = pick(report, "capture.sources") or {}
    photos = bool(sources) and all("promised" not in source for source in sources.values())  # a film's declared frames
    chosen = "without blank photos and duplicates" if photos else "the sharpest of each time slot"
    scored = "excluded from training; up to six per lighting, evenly spaced, are scored under Radiance field"
    facts = [
        *facts_of(
            report,
            ("capture.frames", "frames kept", "{}", chosen),
            ("capture.train", "training frames", "{}", "the field is trained on them"),
            ("capture.held_out", "held out", "{}", scored),
        ),
        Fact("sources", number(len(sources) or None, "{}"), "films or photo folders, each under one lighting"),
    ]
    cautions = []
    frames = as_number(pick(report, "capture.frames"))
    if frames is not None and frames < 20:
        cautions.append(Caution(f"Only {frames} frames were kept.", "film slower or longer, or raise capture.fps."))
    for name, source in sources.items():
        kept, seconds, light = (source.get(key) for key in ("kept", "duration_s", "lighting"))
        if kept is not None:
            about = (source.get("kind"), seconds and duration(seconds), light and f"lighting “{light}”")
            facts.append(Fact(name, f"{kept} frames", ", ".join(part for part in about if part)))
        if damaged := source.get("damaged"):
            cure = "copy the film from the camera again if possible."
            cautions.append(Caution(f"{damaged} frame(s) of “{name}” are damaged.", cure))
    taken = (
        "Photos were read" if photos else "Frames were chosen at regular spacing, without blurred and stationary ones,"
    )
    done = f"{taken} and split into training and held-out frames."
    return Section("capture", "Capture", done, facts, cautions)


def cameras_section(report: dict[str, Any]) -> Section:
    cameras = pick(report, "cameras") or {}
    registered, total = cameras.get("registered"), cameras.get("total")
    cautions: list[Caution] = []
    placed, verdict = NOT_MEASURED, None
    if isinstance(registered, int) and isinstance(total, int):
        placed = f"{registered} of {total}"
        if total:
            text = f"All {total} frames" if registered == total else f"{placed} frames ({registered / total:.0%})"
            verdict = Verdict(f"{text} were placed in space.", "good")
        if total and registered / total < _MIN_REGISTERED:
            cure = (
                "film slower and with more overlap, raise capture.fps, mask moving things; film twilight and night "
                "along the same path as the day."
            )
            cautions.append(Caution(f"{total - registered} of {total} frames could not be placed.", cure))
    calibrate = "give the camera’s calibration (camera = … under [[source]]); a wrong lens model distorts the path."
    cautions += cautions_above(
        report, ("cameras.reprojection_error_px", 1.5, "The reprojection error is {:.2f} px.", calibrate)
    )
    if outliers := cameras.get("outliers"):
        what = f"{len(outliers)} frame(s) were outliers of their path and were dropped: {join_names(outliers, 6)}."
        cure = "a few are normal near large moving or featureless objects; mask these if there are many."
        cautions.append(Caution(what, cure))
    if apart := cameras.get("apart"):
        what = (
            f"Film(s) that match the others neither by views nor by the ground were left out: {join_names(apart, 6)}."
        )
        cure = "remove them, or film again along the same path, with the road in view."
        cautions.append(Caution(what, cure))
    if may_drift := cameras.get("may_drift"):
        what = (
            f"The scale may drift along these films, since most attempts tore them apart: {join_names(may_drift, 6)}."
        )
        cure = "check on the map that the road has its true length and no jumps. Film with more frames per meter."
        cautions.append(Caution(what, cure))
    checked, contradicted = cameras.get("checked_steps"), cameras.get("contradicted_steps") or []
    if contradicted and checked:
        first = " to ".join(contradicted[0])
        what = (
            f"{len(contradicted)} of {checked} steps between successive frames contradict the matches of these frames: "
            f"first {first}."
        )
        given = cameras.get("mapper") == "given poses"
        more = "check the given poses and their calibration" if given else "film slower at that place"
        cure = f"the path may be torn, bent or wrongly scaled there; check it on the map, and {more}."
        cautions.append(Caution(what, cure))
    if stabilized := cameras.get("stabilized"):
        films = join_names(stabilized, 6)
        what = f"Stabilization moves the picture in these films, which bends the reconstruction: {films}."
        cautions.append(Caution(what, "film again with stabilization off."))
    if note := cameras.get("note"):
        cure = "check the given poses, or let twin estimate them from the images."
        cautions.append(Caution(f"{note.capitalize()}.", cure))
    focal = {name: number(length, "{:.0f} px") for name, length in numbers(cameras.get("focal_px")).items()}
    focals = set(focal.values())
    texts = sorted(focals) if len(focals) < 2 else [f"{name} {text}" for name, text in focal.items()]
    facts = [
        Fact("frames placed", placed, "frames whose camera pose was estimated"),
        *facts_of(
            report,
            (
                "cameras.reprojection_error_px",
                "reprojection error",
                "{:.2f} px",
                "mean distance of projected points from their observations",
            ),
            ("cameras.points", "points", "{:,}", "triangulated"),
        ),
        Fact(
            "steps not contradicted",
            f"{checked - len(contradicted)} of {checked}" if checked else NOT_MEASURED,
            "steps between successive frames, by the relative poses of pairs of near frames",
        ),
        Fact("track length", number(cameras.get("mean_track_length"), "{:.1f} frames"), "frames that observe a point"),
        Fact("focal length", ", ".join(texts) or NOT_MEASURED, "given, or estimated by the reconstruction"),
        Fact(
            "method",
            str(cameras.get("mapper") or NOT_MEASURED),
            "averaging of pairs, then COLMAP's global and incremental mapping if that fails",
        ),
    ]
    if joined := cameras.get("joined"):
        meaning = "films in the opposite direction: reconstructed separately, and placed by the ground seen from above"
        facts.append(Fact("joined by the ground", join_names(joined, 6), meaning))
    if turned := numbers(cameras.get("rolling_shutter_deg")):
        text = ", ".join(f"{name} {number(degrees, '{:.2f}°')}" for name, degrees in turned.items())
        facts.append(Fact("rolling shutter", text, "corrected; median rotation of the camera while a frame was read"))
    done = "Structure from motion estimated the pose of each frame from points that several frames share."
    return Section("cameras", "Cameras", done, facts, cautions, verdict=verdict)


def metric_section(report: dict[str, Any]) -> Section:
    metric = pick(report, "metric") or {}
    uncertainty = as_number(metric.get("scale_uncertainty"))
    cautions = []
    if uncertainty is not None and uncertainty > _LARGE_SCALE_UNCERTAINTY:
        what = f"The scale is uncertain by {uncertainty:.1%}: 10 m may be {10 * uncertainty:.1f} m longer or shorter."
        cure = (
            "give a measured distance ([metric] distance = …) or a printed marker, and keep the camera’s height "
            "constant while filming."
        )
        cautions.append(Caution(what, cure))
    cure = "film with the road in view and the horizon level; give the camera’s calibration."
    what = "The direction of gravity is uncertain by {:.1f}°."
    cautions += cautions_above(report, ("metric.gravity_uncertainty_deg", 1.5, what, cure))
    if metric.get("road_reliable") is False:
        cure = "film closer to the ground or at a higher resolution, or put textured objects on the road."
        cautions.append(Caution("Too few points lie on the road to estimate its plane.", cure))
    cure = "measure again what was given under [metric], and remove the source that is wrong."
    what = "The sources of scale contradict each other: they differ by {:.1f} standard deviations."
    cautions += cautions_above(report, ("metric.scale_disagreement", 3.0, what, cure))
    source = metric.get("scale_source")
    source_text, verdict = NOT_MEASURED, None
    if source:
        source_text = " and ".join(_SCALE_SOURCES.get(one, one) for one in str(source).split(" + "))
        sure = "" if uncertainty is None else f", with an uncertainty of about {uncertainty:.1%}"
        verdict = Verdict(f"The scale comes from {source_text}{sure}.", "good")
    by_source = [
        Fact(
            f"by {_SCALE_SOURCES.get(name, name)}",
            f"{number(one['relative'] - 1.0, '{:+.2%}')} ± {number(one['uncertainty'], '{:.1%}')}",
            "compared with the combined scale",
        )
        for name, one in (metric.get("scales") or {}).items()
    ]
    facts = [
        Fact("scale from", source_text, "as given in scene.toml"),
        Fact("scale uncertainty", number(uncertainty, "{:.1%}"), "one standard deviation, relative"),
        *by_source,
        Fact("gravity from", str(metric.get("gravity_source") or NOT_MEASURED), "source of the vertical direction"),
        *facts_of(
            report,
            ("metric.gravity_uncertainty_deg", "tilt uncertainty", "{:.2f}°", "one standard deviation"),
            ("metric.path_length_m", "filmed path", "{:.1f} m", "of the longest film"),
            ("metric.camera_height_median_m", "camera height", "{:.2f} m", "median, above the ground"),
        ),
    ]
    done = "The reconstruction was aligned with gravity, placed on the ground, and scaled to meters."
    return Section("metric", "Scale and gravity", done, facts, cautions, verdict=verdict)


def _transient_facts(field: dict[str, Any]) -> list[Fact]:
    """Facts about what was left out: moving things, and objects that only some lightings' films show."""
    share, objects = pick(field, "transients.moving_share"), pick(field, "transients.objects") or []
    if share is None:
        return []
    facts = [
        Fact(
            "moving things",
            number(share, "{:.1%}"),
            "of the training pixels seem to show them and were left out; 1% is common if nothing moved",
        )
    ]
    for k, one in enumerate(objects, 1):
        size, (x, y, _) = sorted(one["size"], reverse=True), one["center"]
        text = f"{size[0]:.1f} m long, at x = {x:.1f}, y = {y:.1f} m"
        meaning = f"filmed in {' and '.join(one['present'])}, absent in {' or '.join(one['absent'])}; left out"
        facts.append(Fact(f"removed object {k}", text, meaning))
    return facts


def field_section(report: dict[str, Any]) -> Section:
    field = pick(report, "field") or {}
    psnr, ssim, n = (numbers(field.get(key)) for key in ("psnr", "ssim", "n"))
    cautions, facts = [], []
    for name, value in psnr.items():
        frames = f"{n[name]:.0f} of its held-out frames" if name in n else "held-out frames"
        text = f"{value:.1f} dB PSNR" + (f", {ssim[name]:.2f} SSIM" if name in ssim else "")
        facts.append(Fact(name, text, f"on {frames}, compared with the real ones"))
        if value < _LOW_PSNR:
            cure = "raise nerf.steps, mask moving things, film slower in this lighting, or film it from more places."
            cautions.append(Caution(f"“{name}” is rendered at only {value:.1f} dB.", cure))
        if name in n and n[name] < _FEW_HELD_OUT:
            what = f"Only {n[name]:.0f} held-out frame(s) of “{name}” were scored, so its PSNR is uncertain."
            cure = "keep more frames (capture.fps) or hold out more of them (capture.held_out_every)."
            cautions.append(Caution(what, cure))
    facts = facts or [Fact("held-out PSNR", NOT_MEASURED)]
    facts += facts_of(report, ("field.steps", "training steps", "{:,}", "more steps are sharper but slower"))
    if (found := pick(field, "stereo.sightings")) is not None:
        form = "used for depth supervision; {:.0%} of the attempted stereo estimates succeeded"
        facts.append(Fact("stereo depths", number(found, "{:,}"), number(pick(field, "stereo.share"), form)))
    facts += _transient_facts(field)
    small, lower = (numbers(field.get(key)) for key in ("psnr_small", "psnr_small_lower"))
    for name, value in small.items():
        text = number(value, "{:.1f} dB PSNR") + (f", {lower[name]:.1f} dB in the lower half" if name in lower else "")
        facts.append(Fact(f"{name}, at 160×90", text, "the image size of policies"))
    for name, value in numbers(field.get("baking_gain")).items():
        meaning = "change of the PSNR by baking and added detail, without fitting"
        facts.append(Fact(f"{name}, baked", number(value, "{:+.1f} dB"), meaning))
    swapped, more = cross_lighting_facts(report)
    done = (
        "A NeRF models the appearance of every point from every direction, in each lighting. It is evaluated on "
        "held-out frames: the appearance embedding is fitted to one half of a frame, and the other half is scored. "
        "Images on this page are rendered without fitting. Above about 20 dB a view is easy to recognize; above 30 dB "
        "it is hard to distinguish from the film."
    )
    verdict = None
    if psnr:
        ends = dict.fromkeys(f"{value:.1f}" for value in (min(psnr.values()), max(psnr.values())))
        under = f"{len(psnr)} lightings" if len(psnr) > 1 else f"the lighting “{next(iter(psnr))}”"
        verdict = Verdict(f"Held-out views were rendered in {under} at {' to '.join(ends)} dB PSNR.", "good")
    return Section("field", "Radiance field", done, facts + swapped, cautions + more, verdict=verdict)


def cross_lighting_facts(report: dict[str, Any]) -> tuple[list[Fact], list[Caution]]:
    """Facts and cautions about filmed places that are rendered in another lighting (`twin.nerf.evaluate`)."""
    cross = pick(report, "field.cross_lighting") or {}
    follows, own, shown = (numbers(cross.get(key)) for key in ("colour_follows", "to_filmed_rms", "to_shown_rms"))
    facts, cautions = [], []
    for name, share in follows.items():
        rms = f"{number(shown.get(name), '{:.0%}')} to this film, {number(own.get(name), '{:.0%}')} to their own"
        meaning = (
            "of the places filmed in other lightings, rendered in this one, have a mean color closer to its film than "
            f"to their own. RMS color error: {rms}"
        )
        facts.append(Fact(f"{name}, swapped in", f"{share:.0%}", meaning))
        if share < _LOW_LIGHTING_AGREEMENT:
            what = f"Only {share:.0%} of the places filmed in other lightings resemble “{name}” when rendered in it."
            cure = "film every lighting along the same path; very similar lightings reach about 50% at best."
            cautions.append(Caution(what, cure))
    moves = (
        "field.cross_lighting.depth_moves_m",
        "depth",
        "{:.3f} m",
        "largest change between lightings; zero by design",
    )
    what = "Depth changes by up to {:.3f} m with the lighting."
    cautions += cautions_above(report, (moves[0], 1e-3, what, "this is a bug; please report it."))
    return facts + (facts_of(report, moves) if follows else []), cautions


def mesh_section(report: dict[str, Any]) -> Section:
    cautions = []
    if pick(report, "mesh.parts") == 0:
        cure = "if there are obstacles, film closer to them, raise nerf.steps or lower mesh.obstacle_height."
        cautions.append(Caution("Nothing solid was found apart from the ground.", cure))
    cautions += cautions_above(
        report,
        (
            "mesh.parts_left_out",
            0,
            "{} convex part(s) were left out because of mesh.max_parts.",
            "raise mesh.max_parts, or raise mesh.voxel for fewer parts.",
        ),
        (
            "mesh.parts_beyond_bound",
            0,
            "{} convex part(s) stick out of their surface by more than mesh.max_protrusion.",
            "raise mesh.max_parts, which allows smaller parts, or lower mesh.voxel.",
        ),
        (
            "mesh.coacd_failed",
            0,
            "{} piece(s) could not be split into convex parts and are coarser than the rest.",
            "check them in the picture of the MuJoCo scene; a smaller mesh.voxel usually helps.",
        ),
    )
    covered = as_number(pick(report, "mesh.ground.corridor_coverage"))
    if covered is not None and covered < 0.5:
        what = f"Only {covered:.0%} of the ground along the route was measured; the rest is interpolated."
        cure = "film with more of the road in view, or carry the camera at constant height."
        cautions.append(Caution(what, cure))
    facts = facts_of(
        report,
        ("mesh.parts", "convex parts", "{}", "convex collision geometry"),
        (
            "mesh.poles",
            "poles",
            "{}",
            "of them: lamp posts, signs, trunks and other thin upright things found in the films",
        ),
        ("mesh.faces", "surface", "{:,} triangles", "visual mesh, without collisions"),
        ("mesh.ground.coverage", "ground measured", "{:.0%}", "the rest of its area was interpolated"),
        ("mesh.ground.corridor_coverage", "along the route", "{:.0%}", "of the ground was measured"),
        ("mesh.ground.route_slope_rms", "road’s slope", "{:.1%}", "root mean square, along the route"),
        ("mesh.max_protrusion_m", "parts stick out", "{:.2f} m", "of the extracted surface, at most"),
        ("mesh.parts_left_out", "left out", "{}", "parts beyond what mesh.max_parts allows"),
    )
    done = (
        "A surface was extracted from the field’s density: the ground as a height field, and everything above it as "
        "convex parts, which the physics engine needs."
    )
    return Section("mesh", "Surfaces", done, facts, cautions)


def _route_choice(report: dict[str, Any]) -> str:
    """Source of the route in words: filmed passes (`twin.geometry.passes`), way points, or the filmed path."""
    route = pick(report, "mesh.route")
    if not isinstance(route, dict) or not route.get("passes"):
        return "the filmed path"
    if not route.get("chosen"):
        return "through the way points of [route]"
    count, chosen = len(route["passes"]), ", then ".join(map(str, route["chosen"]))
    return f"along {chosen}, of {count} filmed passes; [route] chooses others" if count > 1 else "the filmed path"


def mjcf_section(report: dict[str, Any]) -> Section:
    routeless = pick(report, "mjcf.has_route") is False
    done = "Ground, parts, lights and a Husky at the start of the route, as a folder that MuJoCo loads: "
    route = [Fact("route", "none", "no line to drive along")]
    if routeless:
        done = "Ground, parts and lights as a folder that MuJoCo loads, without a robot because there is no route: "
    else:
        before = "after the first frame; before it, the robot’s camera would see ground that no film shows twice"
        start = (
            before if as_number(pick(report, "mjcf.route_start_m")) else "at the first frame, or where [route] begins"
        )
        route = facts_of(
            report,
            ("mjcf.route_length_m", "route", "{:.1f} m", _route_choice(report)),
            ("mjcf.route_start_m", "start", "{:.1f} m", start),
            ("mjcf.turn_deg", "turn", "{:+.0f}°", "from the first heading to the last; right is negative"),
            ("mjcf.half_width_m", "corridor", "± {:.2f} m", "kept free of convex parts"),
        )
        for name, length in numbers(pick(report, "mesh.branches_m")).items():
            route.append(Fact(f"branch {name}", f"{length:.1f} m", "another route, with the same corridor"))
        free = number(pick(report, "mjcf.spawn_clearance_m"), "{:.2f} m")
        if free == NOT_MEASURED and "spawn_clearance_m" in (pick(report, "mjcf") or {}):
            free = f"over {CLEARANCE_RANGE:g} m"  # None: no part within that range
        route.append(Fact("free at the start", free, "robot to the nearest part"))
    size = as_number(pick(report, "mjcf.assets_bytes"))
    facts = [
        *route,
        *facts_of(report, ("mjcf.geoms", "geoms", "{:,}", "shapes in the scene")),
        Fact("folder", number(size and size / 1e6, "{:.1f} MB"), "may be moved or zipped"),
    ]
    cautions = []
    if touched := pick(report, "mjcf.spawn_touched"):
        cure = "raise mjcf.corridor_margin or mesh.obstacle_height, or start the film further along."
        cautions.append(Caution(f"The robot touches {join_names(touched)} where it starts.", cure))
    return Section("mjcf", "MuJoCo scene", f"{done}build/5_mjcf/scene.xml.", facts, cautions)


def review_section(report: dict[str, Any]) -> Section:
    follower = pick(report, "review.follower")
    cautions: list[Caution] = []
    facts: list[Fact] = []
    if isinstance(follower, dict):
        touched = follower.get("touched")
        if not follower.get("reached_goal"):
            cure = (
                "find in the video where it stops: at a part in the way (raise mesh.obstacle_height or nerf.steps), or "
                "at a step in the ground (raise mesh.ground_smoothing)."
            )
            cautions.append(Caution("The scripted driver did not reach the goal.", cure))
        if touched:
            cure = (
                "these are convex parts in or beside the corridor; if nothing is there in reality, mask what moved "
                "while filming, or raise mjcf.corridor_margin."
            )
            cautions.append(Caution(f"The robot touched {join_names(touched, 8)}.", cure))
        parts = NOT_MEASURED if touched is None else join_names(touched)
        trust = "mean estimated reliability of pictures rendered in the corridor, 0 (poor) to 1 (like the film)"
        facts = [
            Fact("goal reached", format_value(follower.get("reached_goal")), "by a scripted driver without camera"),
            Fact("touched", parts, "besides ground"),
            *facts_of(
                report,
                ("review.follower.max_cross_track_m", "farthest off the route", "{:.2f} m", "cross-track error"),
                ("review.follower.distance_m", "driven", "{:.1f} m", duration(follower.get("seconds"))),
                ("review.follower.turn_deg", "turned", "{:+.0f}°", "right is negative"),
                ("review.trust.mean", "trust in the pictures", "{:.2f}", trust),
            ),
        ]
    branches = pick(report, "review.branches")
    for name, drive in branches.items() if isinstance(branches, dict) else ():
        off, touched = number(pick(drive, "max_cross_track_m"), "{:.2f} m"), pick(drive, "touched")
        reached = format_value(pick(drive, "reached_goal"))
        facts.append(Fact(f"goal of branch {name} reached", reached, f"at most {off} off the line; not in the video"))
        if not pick(drive, "reached_goal"):
            what = f"touched {join_names(touched, 8)}" if touched else "did not reach the goal"
            cure = "find in the map what is in the way: raise mjcf.corridor_margin, or film that part again."
            cautions.append(Caution(f"On branch {name}, the scripted driver {what}.", cure))
    frames = number(pick(report, "review.frames"), "{} frames")
    facts.append(Fact("video", duration(pick(report, "review.duration_s")), frames))
    facts += facts_of(
        report, ("review.render_seconds_per_frame", "rendering", "{:.2f} s", "per NeRF view in the video")
    )
    done = "The video above shows real and rendered frames, the changing light, and the Husky on the route."
    reason = str(pick(report, "review.not_applicable") or "")
    return Section("review", "Review", done, facts, cautions, reason, follower_verdict(report))


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
