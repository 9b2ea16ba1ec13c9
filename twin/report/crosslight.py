"""What the report says about the lightings' independence of the poses, see `twin.nerf.crosslight`; no HTML here."""

from typing import Any

from twin.report.words import Caution, Fact, number, numbers, pick

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
