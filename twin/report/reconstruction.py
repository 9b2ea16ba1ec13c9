"""What the report says about capture, cameras and metres: how the films became posed frames; no HTML here."""

from typing import Any

from twin.report.words import (
    ENOUGH_REGISTERED,
    LARGE_SCALE_UNCERTAINTY,
    NOT_MEASURED,
    Caution,
    Fact,
    Section,
    Verdict,
    duration,
    listing,
    number,
    pick,
    scale_uncertainty,
    source_words,
)

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
