"""What the report says where the truth of a place is known; words only, no HTML."""

from typing import Any

from twin.report.words import LARGE_PATH_ERROR, Caution, Fact, Section, Verdict, listing, number, pick

# From where on an error is worth a caution.
_LARGE_SCALE_ERROR = 0.02  # relative
_LARGE_GROUND_ERROR = 0.04  # [m]
_LARGE_SURFACE_ERROR = 0.1  # [m]


def truth_section(report: dict[str, Any]) -> Section:
    """How far the twin is from the known truth; not a stage, and not there for a real place."""
    truth = pick(report, "truth")
    title, name = "Against the truth", "truth"
    if not isinstance(truth, dict):
        return Section(name, title, "", not_applicable="this is a real place: its truth is not known")
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
