"""Samples the descriptions of places, with the place's number as seed.

`sample_place(number)` returns the description of a place from number 1 on; place 0 is designed, see `campus_road.py`.
Every aspect of a place, such as the surface or the trees, has its own random stream, see `place_spec.stream`. The line
is sampled in `sampled_road.py`. The *setting*, such as `village`, sets probabilities and ranges of all aspects.
"""

import colorsys
from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from twin.errors import InputError
from twin.reality.place_spec import (
    SETTINGS,
    BoundarySpec,
    FilmSpec,
    FurnitureSpec,
    HorizonSpec,
    HousesSpec,
    LampsSpec,
    LightSpec,
    LineSpec,
    PassSpec,
    PlaceSpec,
    Rgb,
    SectionSpec,
    Side,
    SurfaceSpec,
    TreesSpec,
    rgb,
    stream,
)
from twin.reality.sampled_road import SampledRoad, lengthen, sample_line
from twin.reality.side_roads import with_side_roads

T = TypeVar("T")

MAX_FRAMES = 420  # wanted bound of the frames in all films of a place; whole frame rates exceed it by up to a quarter


def check_length(number: int, length: float) -> None:
    """Raises InputError: a length [m] for `sample_place` below that of the place's road."""
    if length < (sampled := sample_place(number).line.length):
        raise InputError(
            f"--length {length:g}: the road of place {number} has {sampled:g} m; give more, or leave --length out"
        )


def sample_place(number: int, length: float = 0.0, side_roads: bool = False) -> PlaceSpec:
    """The description of the place with a number, always the same.

    If its line is shorter than `length` [m], it is lengthened to that. Section, materials, amounts and camera are then
    those of the place, but other objects stand beside the road. With `side_roads`, the place has side roads to
    drive into, where there is room.

    Raises:
        InputError: `number` < 1; place 0 has no `PlaceSpec`.
    """
    if number < 1:
        raise InputError(f"place {number}: expected 1 or more; place 0 is not sampled")
    setting = _pick(stream(number, "setting"), dict(zip(SETTINGS, (3, 4, 4, 2, 2, 2, 3), strict=True)))
    section = _section(stream(number, "section"), setting)
    line = sample_line(stream(number, "line"), setting, section)
    fitted = _fitted(section, line)
    if length > line.length:
        line = lengthen(stream(number, "longer"), line, setting, fitted, length)
    surface = _surface(stream(number, "surface"), stream(number, "markings"), setting, section)
    lamps = _lamps(stream(number, "lamps"), setting)
    lights = _lights(stream(number, "weather"), lamps)
    spec = PlaceSpec(
        number,
        setting,
        line,
        fitted,
        surface,
        _houses(stream(number, "houses"), setting),
        _boundaries(stream(number, "boundaries"), setting, section),
        _trees(stream(number, "trees"), setting, surface.grass),
        _furniture(stream(number, "furniture"), stream(number, "cars"), setting),
        lamps,
        _horizon(stream(number, "horizon"), setting),
        lights,
        _film(stream(number, "film"), line, section, len(lights)),
    )
    if not side_roads:
        return spec
    road = SampledRoad(spec)
    return replace(spec, line=with_side_roads(line, fitted, road, road.start, road.end))


# ---- aspects


def _pick(rng: np.random.Generator, weights: Mapping[T, float]) -> T:
    """Samples a key of a table, with probabilities in proportion to the weights."""
    share = np.array(list(weights.values()), float)
    return list(weights)[int(rng.choice(len(share), p=share / share.sum()))]


def _subset(rng: np.random.Generator, items: tuple[T, ...], least: int, most: int) -> tuple[T, ...]:
    """Samples between `least` and `most` of the items, without replacement."""
    count = min(len(items), int(rng.integers(least, most + 1)))
    return tuple(items[k] for k in rng.permutation(len(items))[:count])


def _shade(rng: np.random.Generator, base: Rgb, spread: float) -> Rgb:
    """Samples a color near `base`: the brightness varies by up to `spread`, the channels with σ = 0.2 `spread`."""
    color = np.array(base) * rng.uniform(1.0 - spread, 1.0 + spread) + rng.normal(0.0, 0.2 * spread, 3)
    return rgb(np.clip(color, 0.03, 0.93))


def _hsv(rng: np.random.Generator, *ranges: tuple[float, float]) -> Rgb:
    """Samples a color, from ranges of its hue in turns, its saturation and its value in [0, 1]."""
    hue, saturation, value = (float(rng.uniform(*one)) for one in ranges)
    return colorsys.hsv_to_rgb(hue, saturation, value)


def _section(rng: np.random.Generator, setting: str) -> SectionSpec:
    streets = {"town": (5.0, 7.0), "suburb": (4.5, 6.5), "village": (3.5, 6.0), "works": (5.5, 7.0)}
    width = float(rng.uniform(*streets.get(setting, (2.5, 5.0))))
    # The line runs in the right-hand lane, or in the middle of the road.
    lane = width >= 5.0 and rng.random() < 0.5
    right = 0.5 * width if not lane else max(1.5, 0.28 * width)
    curbed = rng.random() < {"town": 0.95, "suburb": 0.8, "village": 0.45, "works": 0.6, "park": 0.3}.get(setting, 0.0)
    paved = {"town": 0.95, "suburb": 0.7, "village": 0.4, "works": 0.35, "park": 0.15}.get(setting, 0.0)
    verges = {
        "town": {"grass": 1.0, "gravel": 1.0, "earth": 0.7},
        "works": {"gravel": 2.0, "earth": 1.5, "grass": 1.0},
        "forest": {"earth": 2.0, "meadow": 1.0, "grass": 0.6},
        "field": {"meadow": 2.5, "earth": 1.0, "grass": 1.0},
    }.get(setting, {"grass": 3.0, "meadow": 1.0, "gravel": 0.4})
    sides = []
    for _ in range(2):
        has = rng.random() < paved
        pavement = float(rng.uniform(1.2, 2.6))
        paving = _pick(rng, {"slabs": 2.0, "pavers": 2.0, "asphalt": 1.5, "gravel": 0.5})
        verge, room, slope = _pick(rng, verges), float(rng.uniform(1.5, 5.0)), float(rng.uniform(-0.04, 0.07))
        pavement *= has
        sides.append(Side(pavement, paving, verge, pavement + room, slope if not has else 0.02))
    shape = _pick(rng, {"crown": 2.0, "camber": 1.0})
    fall = float(rng.uniform(0.005, 0.04))
    if shape == "camber" and rng.random() < 0.5:
        fall = -fall
    curb_height, curb_width = float(rng.uniform(0.03, 0.15)), float(rng.uniform(0.10, 0.30))
    return SectionSpec(
        width - right, right, shape, fall, curb_height * curbed, curb_width * curbed, (sides[0], sides[1])
    )


def _fitted(section: SectionSpec, line: LineSpec) -> SectionSpec:
    """The section with verges that end before the center of the tightest bend on their side."""
    sides = []
    for side, edge, sign in zip(section.sides, (section.left, section.right), (1.0, -1.0), strict=True):
        tight = [1.0 / abs(piece.curvature) for piece in line.pieces if sign * piece.curvature > 0.0]
        width = min(side.width, min(tight, default=np.inf) - edge - section.curb_width - 0.35)
        sides.append(replace(side, pavement=min(side.pavement, 0.75 * width), width=width))
    return replace(section, sides=(sides[0], sides[1]))


def _surface(rng: np.random.Generator, paint: np.random.Generator, setting: str, section: SectionSpec) -> SurfaceSpec:
    kinds = {
        "town": {"asphalt": 3.0, "pavers": 2.0, "concrete": 0.5},
        "suburb": {"asphalt": 4.0, "concrete": 1.0, "pavers": 1.0},
        "village": {"asphalt": 3.0, "pavers": 1.5, "gravel": 0.5},
        "works": {"concrete": 3.0, "asphalt": 2.0, "pavers": 0.5},
        "park": {"gravel": 2.0, "asphalt": 1.5, "pavers": 1.0},
        "forest": {"gravel": 2.5, "asphalt": 1.5},
        "field": {"gravel": 2.0, "asphalt": 1.5, "concrete": 1.2},
    }[setting]
    kind = _pick(rng, kinds)
    level = float(rng.uniform(*{"asphalt": (0.20, 0.46), "concrete": (0.46, 0.66)}.get(kind, (0.34, 0.6))))
    hue = {"asphalt": (1.0, 1.0, 1.02), "concrete": (1.02, 1.0, 0.94)}.get(kind) or _pick(
        rng, {(1.0, 0.99, 0.97): 2.0, (1.14, 0.97, 0.78): 1.5, (1.28, 0.88, 0.72): 1.0, (1.07, 1.02, 0.88): 1.5}
    )
    tone = _shade(rng, rgb(level * np.array(hue)), 0.05)
    unit = (float(rng.uniform(0.10, 0.24)), float(rng.uniform(0.10, 0.30)))
    if kind == "concrete":
        unit = (section.width / int(rng.integers(1, 3)), float(rng.uniform(2.5, 6.0)))
    age = float(rng.uniform(0.0, 1.0))
    narrow = kind in ("gravel", "concrete") and section.width < 4.2 and section.left == section.right
    patched = {"asphalt": 0.7, "concrete": 0.15, "pavers": 0.1}.get(kind, 0.0)
    green = _hsv(rng, (0.13, 0.27), (0.25, 0.60), (0.28, 0.54))
    earth = _hsv(rng, (0.06, 0.12), (0.2, 0.5), (0.30, 0.54))
    bare = float(rng.uniform(0.0, 0.5)) ** 1.5
    coarse, cracks = float(rng.uniform(0.5, 1.3)), 1.6 * age * float(rng.uniform(0.2, 1.0))
    covers = float(rng.uniform(9.0, 30.0)) * (rng.random() < 0.8)
    litter = float(rng.uniform(0.5, 14.0)) * (2.0 if setting in ("forest", "park") else 1.0)
    strip = float(rng.uniform(0.5, 0.9)) * (rng.random() < 0.6)
    drained = section.curb_height > 0.0
    markings: list[str] = []
    marked = {"town": 0.75, "suburb": 0.45, "village": 0.35, "works": 0.6, "field": 0.35, "forest": 0.25}
    if kind in ("asphalt", "concrete") and paint.random() < marked.get(setting, 0.2):
        if section.width > 4.4:
            markings.append(_pick(paint, {"dashes": 3.0, "centre": 1.0}))
        if paint.random() < 0.5:
            markings.append("edges")
        if setting in ("town", "suburb", "village") and paint.random() < 0.6:
            markings.append("zebra")
        if setting in ("town", "works") and paint.random() < 0.4:
            markings.append("arrows")
    color = _pick(paint, {(0.84, 0.83, 0.79): 4.0, (0.86, 0.66, 0.16): 1.0})
    return SurfaceSpec(
        kind,
        tone,
        coarse,
        patched * age * float(rng.uniform(0.3, 1.0)),
        cracks * (kind in ("asphalt", "concrete")),
        covers * (drained or kind == "asphalt") * (kind != "gravel"),
        litter,
        strip * narrow,
        unit,
        green,
        earth,
        bare,
        tuple(markings),
        color,
        float(paint.uniform(0.0, 0.7)),
    )


_WALL_COLORS: dict[str, tuple[Rgb, ...]] = {
    "bricks": ((0.50, 0.25, 0.18), (0.62, 0.36, 0.24), (0.42, 0.22, 0.19), (0.66, 0.52, 0.38), (0.38, 0.34, 0.32)),
    "plaster": (
        *((0.82, 0.78, 0.68), (0.78, 0.66, 0.46), (0.74, 0.74, 0.72), (0.68, 0.48, 0.38), (0.56, 0.64, 0.66)),
        *((0.72, 0.56, 0.52), (0.60, 0.66, 0.52), (0.84, 0.82, 0.80), (0.80, 0.70, 0.38)),
    ),
    "boards": ((0.42, 0.16, 0.12), (0.78, 0.76, 0.70), (0.34, 0.28, 0.22), (0.36, 0.44, 0.46), (0.62, 0.56, 0.34)),
    "stone": ((0.50, 0.47, 0.42), (0.58, 0.53, 0.44), (0.40, 0.39, 0.39)),
    "sheet": ((0.52, 0.56, 0.60), (0.30, 0.38, 0.48), (0.66, 0.66, 0.63), (0.42, 0.48, 0.40), (0.60, 0.34, 0.24)),
    "panels": ((0.60, 0.59, 0.57), (0.70, 0.68, 0.62), (0.48, 0.50, 0.53)),
}


def _houses(rng: np.random.Generator, setting: str) -> HousesSpec:
    density, setback, front, storeys = {
        "town": ((4.0, 6.5), (0.0, 2.5), (9.0, 19.0), (2, 5)),
        "suburb": ((2.6, 4.6), (2.0, 7.0), (8.0, 13.0), (1, 2)),
        "village": ((1.8, 4.2), (0.3, 6.0), (8.0, 15.0), (1, 3)),
        "works": ((1.5, 3.2), (2.0, 8.0), (14.0, 32.0), (1, 2)),
        "park": ((0.0, 0.7), (6.0, 14.0), (6.0, 12.0), (1, 2)),
        "forest": ((0.0, 0.3), (5.0, 12.0), (5.0, 10.0), (1, 1)),
        "field": ((0.0, 0.5), (8.0, 24.0), (8.0, 22.0), (1, 2)),
    }[setting]
    materials = {
        "town": ("bricks", "plaster", "plaster", "panels", "stone"),
        "works": ("sheet", "panels", "bricks"),
        "forest": ("boards", "stone"),
        "field": ("boards", "bricks", "sheet", "plaster"),
    }.get(setting, ("bricks", "plaster", "boards", "stone", "plaster"))
    walls = tuple(dict.fromkeys(_subset(rng, materials, 1, 3)))
    palette = tuple(color for wall in walls for color in _WALL_COLORS[wall])
    colors = tuple(_shade(rng, color, 0.14) for color in _subset(rng, palette, 2, 5))
    roofs = {
        "town": ("flat", "gable", "hip", "flat"),
        "works": ("flat", "shed", "gable"),
        "field": ("gable", "shed"),
        "forest": ("gable", "shed"),
    }.get(setting, ("gable", "cross_gable", "hip", "gable", "flat"))
    tiles = ((0.50, 0.24, 0.17), (0.34, 0.20, 0.17), (0.28, 0.29, 0.31), (0.42, 0.37, 0.31), (0.24, 0.30, 0.27))
    return HousesSpec(
        float(rng.uniform(*density)),
        setback,
        front,
        storeys,
        tuple(dict.fromkeys(_subset(rng, roofs, 1, 3))),
        float(np.deg2rad(rng.uniform(18.0, 52.0))),
        walls,
        colors,
        tuple(_shade(rng, color, 0.15) for color in _subset(rng, tiles, 1, 3)),
        _pick(rng, {"cross": 1.0, "casement": 1.0, "sash": 1.0, "ribbon": 1.0, "shutters": 1.0}),
        _pick(rng, {(0.86, 0.86, 0.84): 3.0, (0.30, 0.22, 0.15): 1.0, (0.22, 0.27, 0.25): 1.0, (0.5, 0.5, 0.5): 1.0}),
    )


def _boundaries(rng: np.random.Generator, setting: str, section: SectionSpec) -> tuple[BoundarySpec, BoundarySpec]:
    kinds = {
        "town": {"none": 4.0, "wall": 1.0, "bollards": 2.0, "rails": 0.5},
        "suburb": {"hedge": 3.0, "picket": 2.0, "wall": 1.5, "boards": 1.5, "mesh": 1.0, "none": 1.0},
        "village": {"hedge": 2.0, "picket": 1.5, "wall": 2.0, "rails": 1.0, "none": 1.5},
        "works": {"mesh": 4.0, "wall": 1.0, "none": 1.5, "rails": 0.5},
        "park": {"none": 3.0, "hedge": 1.5, "rails": 1.0, "bollards": 1.0},
        "forest": {"none": 5.0, "rails": 0.7, "mesh": 0.3},
        "field": {"none": 3.5, "rails": 1.5, "mesh": 1.0, "hedge": 0.7},
    }[setting]
    out = []
    for side in section.sides:
        kind = _pick(rng, kinds)
        height = float(rng.uniform(0.6, 1.9))
        if kind in ("picket", "bollards", "rails"):
            height = min(height, 1.25)
        wood = _hsv(rng, (0.04, 0.12), (0.1, 0.6), (0.25, 0.85))
        stone = _hsv(rng, (0.03, 0.14), (0.05, 0.45), (0.35, 0.8))
        zinc = _hsv(rng, (0.25, 0.6), (0.0, 0.35), (0.25, 0.6))
        color = {"wall": stone, "mesh": zinc, "bollards": zinc}.get(kind, wood)
        beyond = float(rng.uniform(0.1, 1.6))
        distance = section.curb_width + side.pavement + beyond
        if kind == "bollards":
            distance = section.curb_width + 0.35
        out.append(BoundarySpec(kind, height, color, float(rng.uniform(0.45, 0.95)), distance))
    return out[0], out[1]


def _trees(rng: np.random.Generator, setting: str, grass: Rgb) -> TreesSpec:
    density = {
        "town": (0.0, 4.0),
        "suburb": (1.0, 6.0),
        "village": (1.0, 5.0),
        "works": (0.0, 2.5),
        "park": (5.0, 11.0),
        "forest": (14.0, 22.0),
        "field": (0.0, 2.5),
    }[setting]
    kinds: tuple[str, ...] = ("broadleaf", "slender", "conifer", "bare", "birch", "shrub")
    if setting == "forest":
        kinds = _pick(rng, {("conifer",): 1.0, ("conifer", "birch"): 1.0, ("broadleaf", "shrub", "birch"): 1.0})
    else:
        kinds = _subset(rng, kinds, 1, 3)
    hue, value = float(rng.uniform(0.13, 0.33)), float(rng.uniform(0.26, 0.50))
    if rng.random() < 0.18:  # autumn
        hue = float(rng.uniform(0.06, 0.13))
    greens = tuple(
        colorsys.hsv_to_rgb(
            float(np.clip(hue + rng.normal(0.0, 0.025), 0.03, 0.40)),
            float(rng.uniform(0.3, 0.65)),
            float(np.clip(value + rng.normal(0.0, 0.05), 0.16, 0.6)),
        )
        for _ in range(4)
    )
    low = float(rng.uniform(3.0, 6.5))
    bark = _hsv(rng, (0.04, 0.1), (0.1, 0.5), (0.18, 0.5))
    tufts = {"town": (0.0, 20.0), "works": (0.0, 30.0), "field": (40.0, 120.0), "forest": (30.0, 90.0)}
    return TreesSpec(
        float(rng.uniform(*density)),
        kinds,
        (low, low + float(rng.uniform(1.0, 6.0))),
        (greens[0], greens[1], greens[2], greens[3]),
        bark,
        bool(rng.random() < (0.7 if setting in ("town", "park", "village") else 0.35)),
        float(rng.uniform(*tufts.get(setting, (10.0, 80.0)))),
    )


def _furniture(rng: np.random.Generator, cars: np.random.Generator, setting: str) -> FurnitureSpec:
    # Upper bounds per 100 m: signs, bins, benches, bollards, cones, crates, cabinets, stones, cars.
    bounds = {
        "town": (9.0, 5.0, 4.0, 8.0, 4.0, 1.0, 4.0, 0.0, 9.0),
        "suburb": (5.0, 6.0, 1.0, 2.0, 2.0, 1.0, 3.0, 3.0, 7.0),
        "village": (6.0, 4.0, 3.0, 4.0, 2.0, 3.0, 2.0, 4.0, 5.0),
        "works": (5.0, 4.0, 0.0, 8.0, 9.0, 9.0, 4.0, 2.0, 7.0),
        "park": (3.0, 5.0, 8.0, 5.0, 0.0, 0.0, 1.0, 5.0, 1.0),
        "forest": (1.5, 0.5, 1.0, 0.5, 0.0, 1.5, 0.0, 7.0, 0.7),
        "field": (1.5, 0.0, 0.5, 1.5, 0.5, 1.5, 0.5, 5.0, 0.7),
    }[setting]
    amounts = [float(most * rng.uniform(0.0, 1.0)) for most in bounds]
    if rng.random() < 0.15:  # an almost empty roadside
        amounts = [0.2 * amount for amount in amounts]
    paints = (
        *((0.80, 0.80, 0.79), (0.10, 0.10, 0.11), (0.50, 0.52, 0.54), (0.30, 0.31, 0.33), (0.12, 0.22, 0.46)),
        *((0.55, 0.08, 0.08), (0.14, 0.28, 0.20), (0.72, 0.62, 0.20), (0.60, 0.54, 0.44), (0.36, 0.50, 0.60)),
        *((0.66, 0.34, 0.10), (0.32, 0.16, 0.30)),
    )
    signs, bins, benches, bollards, cones, crates, cabinets, stones, parked = amounts
    return FurnitureSpec(
        signs=signs,
        bins=bins,
        benches=benches,
        bollards=bollards,
        cones=cones,
        crates=crates,
        cabinets=cabinets,
        stones=stones,
        poles=bool(rng.random() < {"town": 0.05, "works": 0.3, "forest": 0.1}.get(setting, 0.3)),
        cars=parked,
        car_colors=tuple(_shade(cars, color, 0.2) for color in _subset(cars, paints, 4, 6)),
        vans=float(cars.uniform(0.0, 0.6)),
    )


def _lamps(rng: np.random.Generator, setting: str) -> LampsSpec:
    lit = {"town": 0.95, "suburb": 0.85, "village": 0.75, "works": 0.7, "park": 0.55, "forest": 0.1}.get(setting, 0.08)
    kind = _pick(rng, {"arm": 3.0, "post_top": 2.0, "double": 1.0, "lantern": 1.5})
    if rng.random() > lit:
        kind = "none"
    height = float(rng.uniform(*{"arm": (4.5, 7.5), "double": (5.5, 8.0)}.get(kind, (2.8, 4.5))))
    color = _pick(rng, {(1.0, 0.80, 0.50): 2.0, (1.0, 0.66, 0.32): 1.0, (1.0, 0.95, 0.86): 1.5, (0.86, 0.93, 1.0): 1.0})
    broken = float(rng.uniform(0.1, 0.4)) * (rng.random() < 0.35)
    spacing, side = 3.0 * height + float(rng.uniform(0.0, 8.0)), int(rng.choice([-1, 0, 1]))
    return LampsSpec(kind, spacing, height, side, color, broken, float(rng.uniform(0.15, 0.7)))


def _horizon(rng: np.random.Generator, setting: str) -> HorizonSpec:
    kind = _pick(
        rng,
        {
            "town": {"towers": 3.0, "trees": 1.0, "hills": 1.0},
            "works": {"towers": 2.0, "flat": 1.0, "trees": 1.0},
            "forest": {"trees": 3.0, "mountains": 1.0},
            "field": {"flat": 1.5, "hills": 2.0, "mountains": 1.0, "trees": 1.0},
        }.get(setting, {"trees": 2.0, "hills": 2.0, "mountains": 1.0, "flat": 0.5, "towers": 0.7}),
    )
    height, roughness, period = {
        "hills": ((0.05, 0.16), (0.015, 0.04), (0.5, 1.6)),
        "trees": ((0.05, 0.11), (0.012, 0.03), (0.1, 0.5)),
        "towers": ((0.05, 0.12), (0.03, 0.09), (0.04, 0.12)),
        "flat": ((0.01, 0.02), (0.002, 0.005), (0.1, 0.4)),
        "mountains": ((0.12, 0.26), (0.04, 0.10), (0.4, 1.2)),
    }[kind]
    far = float(rng.uniform(0.0, 1.0))  # 1 is the farthest; a farther horizon is paler and bluer
    pale = {"trees": 0.3, "flat": 0.6}.get(kind, 0.95) * far
    base = np.array([0.95, 0.95, 0.85]) * rng.uniform(0.75, 1.15, 3)
    tint = rgb((1.0 - pale) * base + pale * np.array([1.75, 1.72, 1.95]))
    elevation, deviation, widest = (float(rng.uniform(*span)) for span in (height, roughness, period))
    return HorizonSpec(kind, elevation, deviation, widest, tint)


def _lights(rng: np.random.Generator, lamps: LampsSpec) -> tuple[LightSpec, ...]:
    count = _pick(rng, {1: 1.0, 2: 1.5, 3: 1.5})
    by_day = {"sun": 3.0, "overcast": 2.0, "low_sun": 1.5}
    after = {"dusk": 1.0, "night": 2.5 if lamps.kind != "none" else 0.8}
    names = [_pick(rng, by_day)]
    while len(names) < count:
        name = _pick(rng, by_day | after)
        if name not in names:
            names.append(name)
    order = ("sun", "low_sun", "overcast", "dusk", "night")
    out = []
    for name in sorted(names, key=order.index):
        height = {"sun": (22.0, 62.0), "low_sun": (9.0, 20.0), "dusk": (3.0, 9.0)}.get(name, (25.0, 60.0))
        clouds = {"overcast": (0.88, 1.0), "sun": (0.05, 0.6), "night": (0.1, 0.9)}.get(name, (0.1, 0.7))
        elevation, azimuth, cover = (float(rng.uniform(*span)) for span in (height, (0.0, 360.0), clouds))
        hazy, thick = rng.random() < 0.25, float(np.exp(rng.uniform(np.log(120.0), np.log(500.0))))
        warmth = float(rng.normal(0.0, 0.02))
        out.append(LightSpec(name, elevation, azimuth, cover, thick if hazy else float("inf"), warmth))
    return tuple(out)


_SIZES = {(480, 270): 1.0, (640, 360): 2.0, (960, 540): 1.5, (1280, 720): 1.0}


def _film(rng: np.random.Generator, line: LineSpec, section: SectionSpec, lightings: int) -> FilmSpec:
    carrier = _pick(rng, {"phone": 2.0, "cart": 1.0, "mast": 1.5})
    height = float(rng.uniform(*{"phone": (1.2, 1.7), "cart": (0.7, 1.4)}.get(carrier, (0.4, 1.1))))
    tolerance = float(rng.uniform(*{"phone": (0.02, 0.05)}.get(carrier, (0.004, 0.015))))
    stated = round(height + float(np.clip(rng.normal(), -2.0, 2.0)) * tolerance, 2)
    lane = section.left - section.right
    kinds = {"one": 3.0, "there_and_back": 1.5, "two": 1.0, "lane": 1.5 if lane > 1.0 else 0.0}
    passes = [PassSpec("out", 0.0, False)]
    match _pick(rng, kinds):
        case "there_and_back":
            back = min(lane, section.left - 1.2) if lane > 1.0 else 0.0
            passes.append(PassSpec("back", back, True))
        case "two":
            passes.append(PassSpec("again", float(rng.uniform(-0.3, 0.3)), False))
        case "lane":
            passes.append(PassSpec("lane", min(lane, section.left - 1.2), False))
    speed = float(rng.uniform(*{"phone": (0.9, 1.8), "cart": (1.0, 3.6)}.get(carrier, (0.6, 2.4))))
    spacing = float(np.exp(rng.uniform(np.log(0.3), np.log(min(2.0, speed)))))
    spacing = max(spacing, line.length * len(passes) * lightings / MAX_FRAMES)
    fps = int(np.clip(round(speed / spacing), np.ceil(speed / 2.0), np.floor(speed / 0.3)))
    size = _pick(rng, _SIZES)
    fov = float(np.deg2rad(rng.uniform(55.0, 95.0)))
    pitch = float(np.deg2rad(rng.uniform(2.0, 14.0)))
    shake = float(rng.uniform(*{"phone": (1.8, 3.2), "cart": (0.7, 1.3)}.get(carrier, (0.4, 1.6))))
    calibrated = carrier != "phone" and rng.random() < 0.75
    return FilmSpec(
        carrier, tuple(passes), speed, fps, height, stated, tolerance, pitch, fov, size, shake, bool(calibrated)
    )
