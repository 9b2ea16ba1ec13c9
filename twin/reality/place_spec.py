"""Descriptions of randomly sampled places: plain numbers and names, which `place_sampling.py` samples; random streams.

`sampled_place.py` builds a place from its description. The *driven line* is the line that the first film and the
robot's tasks follow; the road need not be symmetrical about it. Stations and laterals are those of `campus_road.py`.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from twin.reality import SEED

Rgb = tuple[float, float, float]


def rgb(values: ArrayLike) -> Rgb:
    """A color from an array of shape (3,)."""
    red, green, blue = np.asarray(values, float).tolist()
    return red, green, blue


SETTINGS = ("town", "suburb", "village", "works", "park", "forest", "field")
MOUTH_REACH = 26.0  # [m] from the road's edge to the end of a side road that is not filmed
FREE_HALF_WIDTH = 1.5  # [m] half width of the corridor along the driven line that is free of solid objects
CLEARANCE = 0.15  # [m] least distance of solid objects from the corridor, and by default from road and curb


@dataclass(frozen=True)
class Piece:
    """A straight or an arc of the driven line."""

    length: float
    """[m]"""
    curvature: float
    """[1/m], positive to the left; 0 for a straight."""


@dataclass(frozen=True)
class Mouth:
    """The mouth of a side road, which joins the road at right angles."""

    station: float
    """Station of its middle [m]."""
    side: int
    """1 = left, −1 = right."""
    width: float
    """[m]"""


@dataclass(frozen=True)
class SideRoad:
    """A side road that is filmed and driven: straight, and at right angles to the driven line."""

    name: str
    """`side_1`, `side_2`, ... in driving order."""
    mouth: Mouth
    radius: float
    """Radius of the turn from the driven line into the side road [m]."""
    driven: float
    """Distance from the driven line to the end of the film [m]."""
    length: float
    """Distance from the driven line to the end of the side road [m]."""


@dataclass(frozen=True)
class LineSpec:
    """The driven line in plan and in profile."""

    pieces: tuple[Piece, ...]
    length: float
    """Driven length [m]; the pieces continue beyond it, and before the start the line is straight."""
    grades: tuple[float, ...]
    """Slopes along the line at stations 0, `GRADE_STEP`, ...; interpolated linearly, constant beyond."""
    bumps: float
    """Standard deviation of the unevenness along the road [m]."""
    mouths: tuple[Mouth, ...]
    relief: float
    """Standard deviation of the land's swells away from the road [m]."""
    side_roads: tuple[SideRoad, ...] = ()
    """Side roads that are filmed; the other mouths have short ones."""


GRADE_STEP = 20.0  # [m] between grades
RUN_OUT = 26.0  # [m] of road beyond the driven length
RUN_IN = 8.0  # [m] of road before the start
LONGEST_DRAWN = 85.0  # [m] longest driven line of a place whose road was not lengthened


@dataclass(frozen=True)
class Side:
    """The ground beside the road on one side, from the curb outwards: a sidewalk, then a verge."""

    pavement: float
    """Width of the sidewalk [m]; 0 for none."""
    paving: str
    """Surface of the sidewalk: `slabs`, `pavers`, `asphalt`, `gravel`."""
    verge: str
    """Ground beyond the sidewalk: `grass`, `earth`, `gravel`, `meadow`."""
    width: float
    """Width of sidewalk and verge together [m]."""
    slope: float
    """Slope of the verge, positive where it rises away from the road."""


@dataclass(frozen=True)
class SectionSpec:
    """The road in cross-section."""

    left: float
    """Lateral of the left edge [m]."""
    right: float
    """Distance of the right edge from the driven line [m]."""
    shape: str
    """`crown`: falls from the middle to both edges; `camber`: falls from the left edge to the right."""
    crossfall: float
    """Slope across the road; negative for a camber that falls to the left."""
    curb_height: float
    """[m]; 0 for none."""
    curb_width: float
    """[m]"""
    sides: tuple[Side, Side]
    """Left, right."""

    @property
    def width(self) -> float:
        """Width of the road [m]."""
        return self.left + self.right

    def edge(self, side: int) -> float:
        """Distance of the road's edge from the driven line on a side (1 = left, −1 = right) [m]."""
        return self.left if side > 0 else self.right

    def curb_edge(self, side: int) -> float:
        """Distance of the curb's outer edge from the driven line on a side [m]."""
        return self.edge(side) + self.curb_width

    def beside(self, side: int) -> Side:
        """The ground on a side."""
        return self.sides[0 if side > 0 else 1]

    def verge_edge(self, side: int) -> float:
        """Distance of the verge's outer edge from the driven line on a side [m]."""
        return self.curb_edge(side) + self.beside(side).width


@dataclass(frozen=True)
class SurfaceSpec:
    """The road's surface and the ground's colors."""

    kind: str
    """`asphalt`, `concrete`, `pavers`, `gravel`."""
    tone: Rgb
    coarseness: float
    """Relative contrast of the grain."""
    patches: float
    """Repairs per meter of road."""
    cracks: float
    """Cracks per meter of road."""
    covers: float
    """Mean distance between manhole covers [m]; 0 for none."""
    litter: float
    """Leaves and stones per meter of road."""
    strip: float
    """Width of the grass strip between the wheel tracks [m]; 0 for none."""
    unit: tuple[float, float]
    """Size of slabs or pavers across and along the road [m]."""
    grass: Rgb
    earth: Rgb
    bare: float
    """Fraction of bare earth in the grass, 0 to 1."""
    markings: tuple[str, ...]
    """Any of `centre`, `dashes`, `edges`, `zebra`, `arrows`."""
    paint: Rgb
    wear: float
    """Wear of the markings, 0 to 1."""


@dataclass(frozen=True)
class HousesSpec:
    """Buildings beside the road."""

    density: float
    """Buildings per 100 m and side; 0 for none."""
    setback: tuple[float, float]
    """Least and largest distance [m] of a front from the verge's outer edge, measured from 1 m inside this edge."""
    front: tuple[float, float]
    """Range of the width along the road [m]."""
    storeys: tuple[int, int]
    """Least and largest number of floors."""
    roofs: tuple[str, ...]
    """Kinds to choose from: `gable`, `cross_gable` (gable to the road), `hip`, `flat`, `shed`."""
    pitch: float
    """Slope of the roofs [rad]."""
    walls: tuple[str, ...]
    """Materials to choose from: `bricks`, `plaster`, `boards`, `stone`, `sheet`, `panels`."""
    colors: tuple[Rgb, ...]
    """Colors of walls."""
    roof_colors: tuple[Rgb, ...]
    window: str
    """`cross`, `casement`, `sash`, `ribbon`, `shutters`."""
    trim: Rgb
    """Color of window frames and sills."""


@dataclass(frozen=True)
class BoundarySpec:
    """The boundary along the road on one side, such as a hedge or a fence."""

    kind: str
    """`none`, `hedge`, `picket`, `rails`, `mesh`, `wall`, `boards`, `bollards`."""
    height: float
    """[m]; hedges are about 1 m high whatever it is."""
    color: Rgb
    covered: float
    """Fraction of the length that has the boundary."""
    distance: float
    """Distance from the outer edge of the curb, or from the road's edge if there is none [m]."""


@dataclass(frozen=True)
class TreesSpec:
    """Trees and shrubs."""

    density: float
    """Trees per 100 m and side."""
    kinds: tuple[str, ...]
    """Kinds to choose from: `broadleaf`, `slender`, `conifer`, `bare`, `birch`, `shrub`."""
    height: tuple[float, float]
    """Range of the height [m]."""
    greens: tuple[Rgb, Rgb, Rgb, Rgb]
    """Colors of leaves."""
    bark: Rgb
    row: bool
    """True for trees in a row beside the road; False for scattered ones."""
    tufts: float
    """Tufts of grass per meter of road."""


@dataclass(frozen=True)
class FurnitureSpec:
    """Small objects and cars beside the road; amounts are expected numbers per 100 m of road."""

    signs: float
    bins: float
    benches: float
    bollards: float
    cones: float
    crates: float
    cabinets: float
    stones: float
    poles: bool
    """Poles with overhead wires."""
    cars: float
    car_colors: tuple[Rgb, ...]
    vans: float
    """Fraction of cars that are vans."""


@dataclass(frozen=True)
class LampsSpec:
    """Street lamps."""

    kind: str
    """`none`, `arm`, `post_top`, `double`, `lantern`."""
    spacing: float
    """[m]"""
    height: float
    """[m]"""
    side: int
    """1 = left, −1 = right, 0 = alternating."""
    color: Rgb
    """Light color; the largest component is 1."""
    broken: float
    """Fraction of lamps that are dark."""
    lit_windows: float
    """Fraction of windows that are lit after dark."""


@dataclass(frozen=True)
class HorizonSpec:
    """The far view, above the horizon."""

    kind: str
    """`hills`, `trees`, `towers`, `flat`, `mountains`."""
    height: float
    """Mean elevation angle of the skyline [rad]."""
    roughness: float
    """Standard deviation of the elevation angle [rad]."""
    period: float
    """Width of the largest features [rad]."""
    tint: Rgb
    """Factor on the lighting's skyline color."""


@dataclass(frozen=True)
class LightSpec:
    """One lighting of a place."""

    name: str
    """`sun`, `overcast`, `low_sun`, `dusk`, `night`."""
    elevation: float
    """Elevation of the sun, or of the moon at night [°]."""
    azimuth: float
    """Azimuth of the sun or moon, counterclockwise from the direction of the driven line at its start [°]."""
    clouds: float
    """Cloud cover, 0 to 1."""
    haze: float
    """`Lighting.visibility` [m]; infinite for clear air."""
    warmth: float
    """White balance: positive is warmer."""


@dataclass(frozen=True)
class PassSpec:
    """One pass along the road; every pass is a film of its own."""

    name: str
    """`out`, `back`, `again` or `lane`; the last three are appended to the film's name."""
    lateral: float
    """Lateral of the camera's path [m]."""
    backwards: bool


@dataclass(frozen=True)
class FilmSpec:
    """Films of the place, and the camera's settings."""

    carrier: str
    """`phone` (held by hand), `cart`, `mast` (of a robot)."""
    passes: tuple[PassSpec, ...]
    speed: float
    """[m/s]"""
    fps: int
    camera_height: float
    """True height of the camera above the ground [m]."""
    stated_height: float
    """The height written into `scene.toml` [m]."""
    height_tolerance: float
    """Standard deviation of the error of the stated height [m]."""
    pitch: float
    """Pitch of the camera, downwards [rad]."""
    fov: float
    """Horizontal field of view [rad]."""
    size: tuple[int, int]
    """Width, height [px]."""
    shake: float
    """Amplitude of the shake relative to a cart's."""
    calibrated: bool
    """True if `scene.toml` states the intrinsics."""


@dataclass(frozen=True)
class PlaceSpec:
    """The description of a place."""

    number: int
    setting: str
    """One of `SETTINGS`."""
    line: LineSpec
    section: SectionSpec
    surface: SurfaceSpec
    houses: HousesSpec
    boundaries: tuple[BoundarySpec, BoundarySpec]
    """Left, right."""
    trees: TreesSpec
    furniture: FurnitureSpec
    lamps: LampsSpec
    horizon: HorizonSpec
    lights: tuple[LightSpec, ...]
    """Lightings of the films, those by day first."""
    film: FilmSpec


def tasks(line: LineSpec) -> dict[str, tuple[float, float]]:
    """The tasks on a driven line, by name: start station and length of a segment [m].

    `whole` always exists; `straight`, `right_turn`, `left_turn`, `s_bend`, `junction` and `slope` exist if the line has
    such a segment. All tasks end before the last 4 % + 0.5 m of the line, because a twin's route may be shorter than
    the true one.
    """
    end = 0.96 * line.length - 0.5
    found: dict[str, tuple[float, float]] = {}

    def add(name: str, first: float, last: float, shortest: float) -> None:
        first, last = max(0.0, first), min(end, last)
        if last - first >= shortest and name not in found:
            found[name] = (round(first, 2), round(last - first, 2))

    stations = np.cumsum([0.0, *(piece.length for piece in line.pieces)]).tolist()
    spans = [(p, a, min(b, end)) for p, a, b in zip(line.pieces, stations, stations[1:], strict=False) if a < end]
    straights = sorted((b - a, a, b) for p, a, b in spans if p.curvature == 0.0)
    if straights:
        add("straight", *straights[-1][1:], shortest=10.0)
    for piece, a, b in spans:
        if abs(piece.curvature) * (b - a) > np.deg2rad(25.0):
            add("left_turn" if piece.curvature > 0 else "right_turn", a - 8.0, b + 8.0, 12.0)
    for (p, a, _), (q, _, b) in pairwise(spans):
        if p.curvature * q.curvature < 0.0:
            add("s_bend", a - 5.0, b + 5.0, 12.0)
    for mouth in line.mouths:
        add("junction", mouth.station - 10.0, mouth.station + 10.0, 14.0)
    steep = [k * GRADE_STEP for k, grade in enumerate(line.grades) if abs(grade) >= 0.04]
    if steep:
        add("slope", steep[0] - 10.0, steep[0] + 10.0, 12.0)
    return found | {"whole": (0.0, round(end, 2))}


# ---- random streams

_ASPECTS = (
    *("setting", "line", "section", "surface", "markings", "houses", "boundaries", "trees", "furniture", "cars"),
    *("lamps", "horizon", "weather", "film", "longer", "side_roads"),
)
"""The aspects by index; new ones go to the end."""


def stream(number: int, aspect: str, *more: int) -> np.random.Generator:
    """A random generator of one aspect of a place; `more` distinguishes those of the same aspect.

    Each aspect has its own, so one more random value in an aspect does not change the random values of the others.
    """
    return np.random.default_rng([SEED, 100, number, _ASPECTS.index(aspect), *more])
