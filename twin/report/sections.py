"""What the report says in words: from the numbers of a build to sentences, facts and warnings; no HTML here.

A *verdict* is a sentence that a newcomer understands, with a mood: good, mixed, bad or plain. A *fact* is a number with
its unit and what it means. A *warning* names what is wrong and its *cure*. Whatever a stage did not report is "not
measured"; nothing is made up.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

NOT_MEASURED = "not measured"

# From where on a number is worth a warning.
_ENOUGH_REGISTERED = 0.9  # share of frames
_LARGE_REPROJECTION = 1.5  # [px]
_LARGE_SCALE_UNCERTAINTY = 0.03  # relative
_LOW_PSNR = 18.0  # [dB]
_FEW_HELD_OUT = 3  # frames per lighting
_LARGE_MEMORY = 4.0  # [GiB]


@dataclass(frozen=True)
class Verdict:
    text: str
    mood: str = "plain"
    """good, mixed, bad or plain."""


@dataclass(frozen=True)
class Fact:
    name: str
    value: str
    meaning: str = ""


@dataclass(frozen=True)
class Warning:
    what: str
    cure: str


@dataclass(frozen=True)
class Section:
    """One stage in the report."""

    name: str
    """Stage name, as in `report.json`."""
    title: str
    done: str
    """What the stage did, for somebody who sees twin for the first time."""
    facts: list[Fact] = field(default_factory=list)
    warnings: list[Warning] = field(default_factory=list)
    not_applicable: str = ""
    """Why there is nothing to show; empty where there is."""


def pick(report: Any, path: str) -> Any:
    """The value at a dotted path, or None where there is none."""
    for key in path.split("."):
        report = report.get(key) if isinstance(report, dict) else None
    return report


def number(value: Any, form: str = "{:.3g}") -> str:
    """A number in a format such as "{:.1f} m", or "not measured"."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return NOT_MEASURED
    return form.format(value)


def duration(seconds: Any) -> str:
    """Seconds as "8.2 s" or "3 min 05 s"."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float):
        return NOT_MEASURED
    if round(seconds, 1) < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"


def listing(names: Iterable[str], most: int = 4) -> str:
    """ "a", "a and b", "a, b and c"; beyond `most`, how many more there are."""
    names = [str(name) for name in names]
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} more"]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]])) if names else "none"


def flat(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Every plain number and word below a JSON value with its dotted path; long lists are only counted."""
    if isinstance(value, dict):
        return [row for key, below in value.items() for row in flat(below, f"{prefix}.{key}" if prefix else str(key))]
    if isinstance(value, list):
        if len(value) > 8 or any(isinstance(item, dict | list) for item in value):
            return [(prefix, f"{len(value)} values")]
        return [(prefix, ", ".join(_plain(item) for item in value) or "none")]
    return [(prefix, _plain(value))]


def _plain(value: Any) -> str:
    if value is None:
        return NOT_MEASURED
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def follower_verdict(report: dict[str, Any]) -> Verdict:
    """Whether the Husky got through, in one sentence."""
    follower = pick(report, "review.follower")
    if not isinstance(follower, dict):
        reason = pick(report, "review.not_applicable") or "this build has no drive"
        return Verdict(f"No robot was driven here: {reason}.")
    length = number(pick(report, "mjcf.route_length_m"), "{:.1f} m ")
    length = "" if length == NOT_MEASURED else length
    touched = follower.get("touched")
    contact = "what it touched was not measured"
    if isinstance(touched, list):
        contact = f"touched {listing(touched)}" if touched else "touched nothing but the ground"
    if follower.get("reached_goal"):
        return Verdict(
            f"The Husky followed the {length}route from start to end and {contact}.",
            "mixed" if touched or touched is None else "good",
        )
    gone = number(follower.get("distance_m"), "it came {:.1f} m far")
    gone = "" if gone == NOT_MEASURED else f"{gone} and "
    return Verdict(f"The Husky did not reach the end of the {length}route: {gone}{contact}.", "bad")


def verdicts(report: dict[str, Any]) -> list[Verdict]:
    """The headlines, the most important first."""
    out = [follower_verdict(report)]
    registered, total = pick(report, "cameras.registered"), pick(report, "cameras.total")
    if isinstance(registered, int) and isinstance(total, int) and total > 0:
        share = registered / total
        text = f"All {total} frames" if registered == total else f"{registered} of {total} frames ({share:.0%})"
        out.append(Verdict(f"{text} were placed in space.", "good" if share >= _ENOUGH_REGISTERED else "mixed"))
    source = pick(report, "metric.scale_source")
    if source is not None:
        uncertainty = _uncertainty(report)
        sure = "" if uncertainty is None else f", sure to about {uncertainty:.1%}"
        good = uncertainty is None or uncertainty <= _LARGE_SCALE_UNCERTAINTY
        out.append(Verdict(f"Its metres come from {_source_words(source)}{sure}.", "good" if good else "mixed"))
    psnr = _numbers(pick(report, "field.psnr"))
    if psnr:
        low, high = min(psnr.values()), max(psnr.values())
        span = f"{low:.1f} dB" if round(low, 1) == round(high, 1) else f"{low:.1f} to {high:.1f} dB"
        under = f"in {len(psnr)} lightings" if len(psnr) > 1 else f"in the lighting “{next(iter(psnr))}”"
        out.append(
            Verdict(
                f"Views it had never seen were rendered {under} at {span} PSNR.",
                "good" if low >= _LOW_PSNR else "mixed",
            )
        )
    return out


def _numbers(value: Any) -> dict[str, float]:
    table = value if isinstance(value, dict) else {}
    return {str(k): float(v) for k, v in table.items() if isinstance(v, int | float) and not isinstance(v, bool)}


def _uncertainty(report: dict[str, Any]) -> float | None:
    value = pick(report, "metric.scale_uncertainty")
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _source_words(source: str) -> str:
    return {
        "camera_height": "the camera's height above the ground",
        "distance": "a distance measured between two marked points",
        "marker": "a printed marker of known size",
        "gps": "the GPS positions of the images",
        "poses": "the given poses, which are metric already",
        "poses_are_metric": "the given poses, which are metric already",
    }.get(str(source), str(source))


def capture_section(report: dict[str, Any]) -> Section:
    capture = pick(report, "capture") or {}
    facts = [
        Fact("frames kept", number(capture.get("kept"), "{}"), "the sharpest of each time slot"),
        Fact("held out", number(capture.get("held_out"), "{}"), "never trained on, kept to judge the result"),
        Fact("sources", number(_count(capture.get("sources")), "{}"), "films or photo folders, one lighting each"),
    ]
    warnings = []
    if isinstance(capture.get("kept"), int) and capture["kept"] < 20:
        warnings.append(
            Warning(f"Only {capture['kept']} frames were kept.", "film slower or longer, or raise capture.fps.")
        )
    return Section(
        "capture",
        "Capture",
        "Frames were chosen from the films at regular spacing, blurred and standing ones left out, and split into "
        "those to learn from and those to judge by.",
        facts,
        warnings,
    )


def _count(value: Any) -> int | None:
    return len(value) if isinstance(value, list | dict) else value if isinstance(value, int) else None


def cameras_section(report: dict[str, Any]) -> Section:
    cameras = pick(report, "cameras") or {}
    registered, total = cameras.get("registered"), cameras.get("total")
    error = cameras.get("reprojection_error_px")
    warnings = []
    placed = NOT_MEASURED
    if isinstance(registered, int) and isinstance(total, int):
        placed = f"{registered} of {total}"
        if total and registered / total < _ENOUGH_REGISTERED:
            warnings.append(
                Warning(
                    f"{total - registered} of {total} frames could not be placed.",
                    "film slower and with more overlap, raise capture.fps, mask what moves; twilight and night need "
                    "the same path as the day.",
                )
            )
    if isinstance(error, int | float) and error > _LARGE_REPROJECTION:
        warnings.append(
            Warning(
                f"Points miss their pixels by {error:.2f} px.",
                "give the camera's calibration (camera = … under [[source]]); a wrong lens model bends the path.",
            )
        )
    facts = [
        Fact("frames placed", placed, "how many frames the reconstruction could use"),
        Fact("reprojection error", number(error, "{:.2f} px"), "how far points are from where they were seen"),
        Fact("track length", number(cameras.get("track_length"), "{:.1f} frames"), "how many frames saw each point"),
        Fact("focal length", _focal(cameras.get("focal")), "given, or found by the reconstruction"),
        Fact("method", str(cameras.get("mapper") or NOT_MEASURED), "global first, incremental where that fails"),
    ]
    return Section(
        "cameras",
        "Cameras",
        "Where each frame was taken and which way it looked, found from points that several frames share "
        "(structure from motion).",
        facts,
        warnings,
    )


def _focal(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {number(focal, '{:.0f} px')}" for name, focal in value.items()) or NOT_MEASURED
    if isinstance(value, list) and value:
        return ", ".join(number(focal, "{:.0f} px") for focal in value[:4])
    return number(value, "{:.0f} px")


def metric_section(report: dict[str, Any]) -> Section:
    metric = pick(report, "metric") or {}
    uncertainty = _uncertainty(report)
    warnings = []
    if uncertainty is not None and uncertainty > _LARGE_SCALE_UNCERTAINTY:
        warnings.append(
            Warning(
                f"The scale is uncertain by {uncertainty:.1%}: 10 m may be {10 * uncertainty:.1f} m longer or shorter.",
                "give a measured distance ([metric] distance = …) or a printed marker, and keep the camera's height "
                "constant while filming.",
            )
        )
    source = metric.get("scale_source")
    facts = [
        Fact("metres from", _source_words(source) if source else NOT_MEASURED, "what scene.toml gave"),
        Fact("scale uncertainty", number(uncertainty, "{:.1%}"), "one standard deviation, relative"),
        Fact("up from", str(metric.get("gravity") or metric.get("up") or NOT_MEASURED), "what decided where up is"),
    ]
    return Section(
        "metric",
        "Metres and gravity",
        "The reconstruction was turned upright, put on the floor, and brought to metres.",
        facts,
        warnings,
    )


def field_section(report: dict[str, Any]) -> Section:
    psnr, ssim = _numbers(pick(report, "field.psnr")), pick(report, "field.ssim")
    n = _numbers(pick(report, "field.n"))
    warnings, facts = [], []
    for name, value in psnr.items():
        like = ssim.get(name) if isinstance(ssim, dict) else None
        seen = f"{n[name]:.0f} held-out frames" if name in n else "held-out frames"
        text = f"{value:.1f} dB PSNR" + ("" if like is None else number(like, ", {:.2f} SSIM"))
        facts.append(Fact(name, text, f"on {seen}, compared with the real film"))
        if value < _LOW_PSNR:
            warnings.append(
                Warning(
                    f"“{name}” is rendered at only {value:.1f} dB.",
                    "raise nerf.steps, mask what moves, film slower in this light, or film it from more places.",
                )
            )
        if name in n and n[name] < _FEW_HELD_OUT:
            warnings.append(
                Warning(
                    f"Only {n[name]:.0f} frame(s) of “{name}” were held out, so its score is rough.",
                    "keep more frames (capture.fps) or hold out more of them (capture.held_out_every).",
                )
            )
    facts = facts or [Fact("held-out PSNR", NOT_MEASURED)]
    steps = pick(report, "field.steps")
    facts.append(Fact("training steps", number(steps, "{:,}"), "more make it sharper, and take longer"))
    return Section(
        "field",
        "Radiance field",
        "A NeRF learnt what every point looks like from every side, in each lighting. It is judged on frames it never "
        "saw: only the light is fitted on one half of such a frame, the other half is scored. Higher is better; above "
        "about 20 dB a view is easy to recognise, above 30 dB it is hard to tell from the film.",
        facts,
        warnings,
    )


def mesh_section(report: dict[str, Any], limit: int | None = None) -> Section:
    mesh = pick(report, "mesh") or {}
    parts = mesh.get("parts")
    warnings = []
    if parts == 0:
        warnings.append(
            Warning(
                "Nothing solid was found beside the ground.",
                "if there are obstacles, film them from nearer, raise nerf.steps or lower mesh.obstacle_height.",
            )
        )
    if isinstance(parts, int) and limit is not None and parts >= limit:
        warnings.append(
            Warning(f"All {parts} allowed solid parts were used up.", "raise mesh.max_parts, or mesh.voxel for fewer.")
        )
    facts = [
        Fact("solid parts", number(parts, "{}"), "convex bodies the robot can bump into"),
        Fact("surface", number(mesh.get("faces"), "{:,} triangles"), "what is seen; it touches nothing"),
        Fact("ground measured", number(mesh.get("ground_measured"), "{:.0%}"), "the rest of its area was filled in"),
    ]
    return Section(
        "mesh",
        "Surfaces",
        "The field's density became a surface: the ground as a height field, and everything that stands on it as "
        "convex parts, because a physics engine needs those.",
        facts,
        warnings,
    )


def mjcf_section(report: dict[str, Any]) -> Section:
    mjcf = pick(report, "mjcf") or {}
    facts = [
        Fact("route", number(mjcf.get("route_length_m"), "{:.1f} m"), "the filmed path on the ground"),
        Fact("turn", number(mjcf.get("turn_deg"), "{:+.0f}°"), "from the first heading to the last; right is negative"),
        Fact("corridor", number(mjcf.get("half_width_m"), "± {:.2f} m"), "kept free of solid parts"),
        Fact("geoms", number(mjcf.get("geoms"), "{:,}"), "bodies in the scene"),
    ]
    return Section(
        "mjcf",
        "MuJoCo scene",
        "Ground, parts, lights and a Husky at the start of the route, as a folder that plain MuJoCo opens: "
        "build/5_mjcf/scene.xml.",
        facts,
        not_applicable=str(mjcf.get("not_applicable") or ""),
    )


def review_section(report: dict[str, Any]) -> Section:
    review = pick(report, "review") or {}
    follower = review.get("follower")
    warnings: list[Warning] = []
    facts: list[Fact] = []
    if isinstance(follower, dict):
        if not follower.get("reached_goal"):
            warnings.append(
                Warning(
                    "The scripted driver did not reach the goal.",
                    "look in the film where it stops: a part in the way (raise mesh.obstacle_height or nerf.steps), "
                    "or a step in the ground (raise mesh.ground_smoothing).",
                )
            )
        if follower.get("touched"):
            warnings.append(
                Warning(
                    f"It touched {listing(follower['touched'], 8)}.",
                    "those are solid parts in or beside the corridor; if nothing stands there, mask what moved while "
                    "filming, or raise mjcf.corridor_margin.",
                )
            )
        facts = [
            Fact("goal reached", _plain(follower.get("reached_goal")), "by a scripted driver without eyes"),
            Fact("touched", listing(follower["touched"]) if "touched" in follower else NOT_MEASURED, "besides ground"),
            Fact("farthest off the route", number(follower.get("max_cross_track_m"), "{:.2f} m"), "cross-track"),
            Fact("driven", number(follower.get("distance_m"), "{:.1f} m"), duration(follower.get("seconds"))),
            Fact("turned", number(follower.get("turn_deg"), "{:+.0f}°"), "right is negative"),
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
        warnings,
        str(review.get("not_applicable") or ""),
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


def general_warnings(report: dict[str, Any]) -> list[Warning]:
    """Warnings that belong to the whole build."""
    peak = pick(report, "peak_memory_bytes")
    if isinstance(peak, int | float) and peak / 2**30 > _LARGE_MEMORY:
        return [
            Warning(
                f"The build needed {peak / 2**30:.1f} GiB of memory.",
                "lower capture.max_size, nerf.rays or mesh.voxel's resolution if your machine is smaller.",
            )
        ]
    return []
