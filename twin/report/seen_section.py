"""What the report says and shows of `seen_touched.py`: words, and pictures of single looks; no HTML here."""

from typing import Any

import numpy as np
from matplotlib import colormaps

from twin.report.panels import GROUND, SUNKEN, Picture, depth_colours, fit
from twin.report.rows import panel, scale_bar, under
from twin.report.seen_touched import LARGE, REACH, Looks
from twin.report.words import Caution, Fact, Section, Verdict, number, pick

_FEW_FOLLOW = 0.05  # [m] median gap from which on it is worth a caution
_MOST_GAP = 0.3  # [m] at the ends of the gap's colours
_WIDTH = 320  # [px] of a panel


def seen_section(report: dict[str, Any]) -> Section:
    """Whether the robot touches what its camera sees; not a stage of its own, but part of the review."""
    found = pick(report, "seen_touched")
    name, title = "seen_touched", "Seen and touched"
    if not isinstance(found, dict):
        return Section(name, title, "", not_applicable="nothing was driven here, so nothing was looked at on the way")
    rows = (
        ("median_m", "seen against solid, along the ray", "{:.3f} m", f"median within {REACH:g} m, ground and parts"),
        ("p90_m", "the same, worst places", "{:.3f} m", "90 of 100 pixels are better; ground is seen at a low angle"),
        ("ground_median_m", "seen ground over solid ground", "{:.3f} m", "median in the corridor, measured upright"),
        ("ground_p95_m", "the same, worst places", "{:.3f} m", "95 of 100 pixels are better"),
        ("corridor_leak_m", "largest leak in the corridor", "{:.3f} m", "seen above the solid ground, but not solid"),
        ("corridor_ghost_m", "largest ghost in the corridor", "{:.3f} m", "solid, but seen through"),
        (
            "unfilmed_ghost_m",
            "the same, filmed from one place",
            "{:.3f} m",
            "where no film shows the corridor from two places; not in the line above",
        ),
        ("standing_median_m", "what stands, to the nearest solid", "{:.3f} m", "median"),
        ("leak_share", "seen far from anything solid", "{:.1%}", f"of what stands, by more than {LARGE:g} m"),
        ("ghost_share", "solid far from anything seen", "{:.1%}", f"of the parts in view, by more than {LARGE:g} m"),
        ("views", "views", "{}", "of the robot’s camera, along its drive"),
    )
    facts = [Fact(label, number(found.get(key), form), meaning) for key, label, form, meaning in rows]
    cautions = []
    for key, limit, what, cure in (
        ("median_m", _FEW_FOLLOW, "What is seen and what is solid differ", "raise nerf.steps, or lower mesh.voxel."),
        ("corridor_leak_m", LARGE, "Something in the corridor is seen but not solid", "mask what moved while filming."),
        ("corridor_ghost_m", LARGE, "Solid things in the corridor are not seen", "raise nerf.steps."),
        (
            "unfilmed_ghost_m",
            LARGE,
            "The robot sees through something solid in the corridor that no film shows from two places; the field’s "
            "depth there is not determined and may differ from build to build",
            "begin the drive a little further on, or begin to film a little earlier.",
        ),
    ):
        value = found.get(key)
        if isinstance(value, int | float) and value > limit:
            cautions.append(Caution(f"{what}: {number(value, '{:.3f} m')}, more than {limit:g} m.", cure))
    return Section(
        name,
        title,
        "What a policy sees is the field, what it bumps into are MuJoCo’s ground and convex parts. Both were looked at "
        "along the drive by the robot’s camera and compared, pixel by pixel.",
        facts,
        cautions,
        verdict=_verdict(found),
    )


def _verdict(found: dict[str, Any]) -> Verdict | None:
    apart = found.get("median_m")
    if not isinstance(apart, int | float):
        return None
    return Verdict(f"What the robot sees is {100 * apart:.1f} cm from what it touches, in the median.", "good")


def seen_row(looks: Looks, k: int) -> Picture:
    """Look k: the field, how far what it shows is, how far what is solid is, and the gap between them in colours."""
    height, width = looks.seen.shape[1:]
    size = (_WIDTH, round(_WIDTH * height / width))
    near = (looks.seen < REACH) & (looks.solid < REACH)
    gap = np.where(near, looks.solid - looks.seen, 0.0)
    share = np.clip(0.5 + 0.5 * gap / _MOST_GAP, 0.0, 1.0)
    colours = (colormaps["coolwarm"](share)[..., :3] * 255 + 0.5).astype(np.uint8)
    colours[~near] = SUNKEN
    bar = _WIDTH - 16
    ramp = (colormaps["coolwarm"](np.linspace(0, 1, bar))[None, :, :3] * 255 + 0.5).astype(np.uint8)
    labels = [(0.0, f"ghost −{_MOST_GAP * 100:g} cm"), (0.5, "0"), (1.0, f"leak +{_MOST_GAP * 100:g} cm")]
    panels = [
        panel(fit(looks.rgb[k], size), "the field", "", under(_WIDTH, "what a policy sees")),
        panel(fit(depth_colours(looks.seen[k]), size), "seen", "how far", under(_WIDTH, "bright is near")),
        panel(fit(depth_colours(looks.solid[k]), size), "solid", "how far", under(_WIDTH, "ground and convex parts")),
        panel(fit(colours[k], size), "gap", f"up to {REACH:g} m", scale_bar(_WIDTH, ramp, labels)),
    ]
    space = np.full((len(panels[0]), 6, 3), GROUND, np.uint8)
    return np.concatenate([part for one in panels for part in (space, one)] + [space], 1)
