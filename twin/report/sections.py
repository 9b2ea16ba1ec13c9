"""What the report says about each stage: what was done, its numbers, and cautions with their cures; no HTML here.

The stages up to metric cameras are in `reconstruction.py`. `sections` has them all: page, `report.json` and the printed
summary take headlines and cautions from there alone.
"""

from collections.abc import Callable
from typing import Any

from twin.report.against_truth import truth_section
from twin.report.crosslight import cross_lighting_words
from twin.report.reconstruction import cameras_section, capture_section, metric_section
from twin.report.seen_section import seen_section
from twin.report.words import (
    LOW_PSNR,
    NOT_MEASURED,
    Caution,
    Fact,
    Section,
    Verdict,
    duration,
    follower_verdict,
    listing,
    number,
    numbers,
    pick,
    plain,
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
