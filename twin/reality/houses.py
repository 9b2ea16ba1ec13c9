"""Buildings with windows, sills and doors, under flat or pitched roofs."""

from dataclasses import dataclass, replace

import numpy as np

from twin.reality import primitives
from twin.reality.place_objects import KnownPlace, PlaceObject, Solid, vertical_quad
from twin.reality.primitives import MeshPart
from twin.types import Array


def add_block(
    place: KnownPlace,
    name: str,
    center: tuple[float, float],
    size: tuple[float, float, float],
    windows: tuple[int, int],
) -> None:
    """Adds a building: a box with a roof slab, windows, sills and doors.

    Args:
        place: The place.
        name: Name of the object and of the texture of its walls.
        center: x, y [m].
        size: Width (x), depth (y) and height [m].
        windows: Windows per 10 m of wall, and number of floors.
    """
    rng = place.rng(1, len(place.objects))
    width, depth, height = size
    corners = np.array(center) + 0.5 * np.array([[a * width, b * depth] for a in (-1, 1) for b in (-1, 1)])
    base = float(place.route.ground_height(corners).min()) - 0.2
    origin = np.array([*center, 0.0])
    shell = primitives.walls(width, depth, base, base + height).moved(origin)
    solid = Solid("box", np.array([*center, base + height / 2]), (width / 2, depth / 2, height / 2))
    place.objects.append(PlaceObject(name, "obstacle", shell, name, (solid,)))
    roof = place.cell("tank", primitives.box((width + 0.7, depth + 0.7, 0.35), base + height).moved(origin))
    trim: list[MeshPart] = [roof]
    panes: list[tuple[int, MeshPart]] = []
    lit: list[tuple[int, MeshPart]] = []
    floor = (height - 0.6) / windows[1]
    for wall in range(4):
        length = (width, depth)[wall % 2]
        across = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]][wall], float)
        out = np.array([across[1], -across[0]])
        face = np.array(center) + out * (depth, width)[wall % 2] / 2
        count = max(2, round(length / 10.0 * windows[0]))
        door = int(rng.integers(0, count))
        for level in range(windows[1]):
            for k in range(count):
                along = length * ((k + 0.5) / count - 0.5)
                middle = face + across * along
                is_door = level == 0 and k == door
                tall, wide = (2.25, 1.25) if is_door else (min(1.75, floor * 0.58), 1.2)
                z0 = base + 0.2 if is_door else base + 0.6 + level * floor + 0.35 * (floor - tall)
                left, right = middle - across * wide / 2, middle + across * wide / 2
                pane = vertical_quad(left + 0.02 * out, right + 0.02 * out, z0, z0 + tall)
                if is_door:
                    trim.append(place.cell(f"door{int(rng.integers(0, 2))}", pane))
                    canopy = primitives.box((wide + 0.8, 0.9, 0.12), z0 + tall + 0.15)
                    at = np.append(middle + 0.45 * out, 0.0)
                    trim.append(place.cell("dark", canopy.moved(at, float(np.arctan2(across[1], across[0])))))
                    continue
                shining = rng.random() < 0.42
                kind = int(rng.integers(0, 16))
                (lit if shining else panes).append((kind, pane))
                sill = primitives.box((wide + 0.2, 0.14, 0.07), z0 - 0.09)
                at = np.append(middle + 0.07 * out, 0.0)
                trim.append(place.cell("white", sill.moved(at, float(np.arctan2(across[1], across[0])))))
    glass = [place.cell(f"window{k}", pane) for k, pane in panes]
    place.objects.append(PlaceObject(f"{name}_trim", "obstacle", primitives.join(trim)))
    place.objects.append(PlaceObject(f"{name}_glass", "obstacle", primitives.join(glass)))
    # A window that is lit after dark has a mesh for day and one for dark; `true_world.world_spec` selects one.
    day = primitives.join([place.cell(f"window{k}", p) for k, p in lit])
    dark = primitives.join([place.cell(f"lit{k % 8}", p) for k, p in lit])
    place.objects.append(PlaceObject(f"{name}_day", "obstacle", day, "windows_by_day"))
    place.objects.append(PlaceObject(f"{name}_lit", "obstacle", dark, "windows_by_night"))


# ---- houses under pitched roofs

_STOREY = 2.75  # [m] height of a floor
_EAVES = 0.45  # [m] overhang of a roof


@dataclass(frozen=True)
class House:
    """A house with its front along the road. In the house's frame, x runs along the front, which faces −y."""

    center: Array
    """x, y [m]."""
    yaw: float
    """Direction of the house's x axis [rad]."""
    width: float
    """Width along the front [m]."""
    depth: float
    """Depth behind the front [m]."""
    storeys: int
    roof: str
    """Kind of roof: `gable`, `cross_gable`, `hip`, `shed`, `flat`."""
    pitch: float
    """Slope of the roof [rad]."""
    window: str
    """Style of the windows."""

    @property
    def eaves(self) -> float:
        """Height of the eaves above the ground floor [m]."""
        return 0.45 + _STOREY * self.storeys

    @property
    def roof_size(self) -> tuple[float, float]:
        """Length of the ridge, and of one side from ridge to eaves [m]."""
        along, across = (self.depth, self.width) if self.roof == "cross_gable" else (self.width, self.depth)
        half = across if self.roof == "shed" else 0.5 * across
        return along + 2 * _EAVES, (half + _EAVES) / np.cos(self._slope)

    @property
    def _slope(self) -> float:
        return {"flat": 0.0, "shed": min(self.pitch, 0.25)}.get(self.roof, self.pitch)


def add_house(place: KnownPlace, k: int, house: House, lit_windows: float) -> str:
    """Adds house k with doors and windows; returns its name. Its textures are `<name>` (walls) and `<name>_roof`.

    `lit_windows` is the fraction of windows that are lit after dark.
    """
    rng, name = place.rng(1, k), f"house_{k}"
    w, d = house.width, house.depth
    turn = np.array([[np.cos(house.yaw), -np.sin(house.yaw)], [np.sin(house.yaw), np.cos(house.yaw)]])
    corners = house.center + 0.5 * np.array([[a * w, b * d] for a in (-1, 1) for b in (-1, 1)]) @ turn.T
    ground = place.route.ground_height(corners)
    foot, floor = float(ground.min()) - 0.3, float(ground.max()) + 0.15
    top = floor + house.eaves
    origin = np.append(house.center, 0.0)

    def put(part: MeshPart) -> MeshPart:
        return part.moved(origin, house.yaw)

    shell = [primitives.walls(w, d, foot, top)]
    slopes, ridge, gables = _roof(house, top)
    for gable in gables:
        shell.append(replace(gable, uv=gable.uv * [w / (2 * (w + d)), 0.35]))
    solid = Solid("box", np.append(house.center, 0.5 * (foot + top)), (w / 2, d / 2, 0.5 * (top - foot)), house.yaw)
    place.objects.append(PlaceObject(name, "obstacle", put(primitives.join(shell)), name, (solid,)))
    place.objects.append(PlaceObject(f"{name}_roof", "obstacle", put(primitives.join(slopes)), f"{name}_roof"))
    trim: list[MeshPart] = []
    if house.roof == "flat":
        trim.append(place.cell("tank", primitives.box((w + 0.3, d + 0.3, 0.3), top)))
    elif rng.random() < 0.75:
        x, y = rng.uniform(-0.3, 0.3) * w, rng.uniform(-0.12, 0.12) * d
        size = float(rng.uniform(0.4, 0.8))
        chimney = primitives.box((size, size, ridge - top + float(rng.uniform(0.3, 1.0))), top)
        trim.append(place.cell("chimney", chimney.moved(np.array([x, y, 0.0]))))
    panes, lit = _openings(place, house, floor, rng, lit_windows, trim)
    for kind, parts in (("trim", trim), ("glass", panes)):
        if parts:
            place.objects.append(PlaceObject(f"{name}_{kind}", "obstacle", put(primitives.join(parts))))
    if lit:
        day = [place.cell(f"window{k}", part) for k, part in lit]
        dark = [place.cell(f"lit{k % 8}", part) for k, part in lit]
        place.objects.append(PlaceObject(f"{name}_day", "obstacle", put(primitives.join(day)), "windows_by_day"))
        place.objects.append(PlaceObject(f"{name}_lit", "obstacle", put(primitives.join(dark)), "windows_by_night"))
    return name


def _roof(house: House, top: float) -> tuple[list[MeshPart], float, list[MeshPart]]:
    """The sides of a roof, the height of its ridge [m] and its gables, in the house's frame."""
    turned = house.roof == "cross_gable"
    w, d = (house.depth, house.width) if turned else (house.width, house.depth)  # along and across the ridge
    slope, o = np.tan(house._slope), _EAVES
    if house.roof == "flat":
        z = top + 0.32
        corners = [[-w / 2, d / 2, z], [-w / 2, -d / 2, z], [w / 2, -d / 2, z], [w / 2, d / 2, z]]
        return [primitives.quad(corners)], top, []
    low = top - o * slope + 0.06
    if house.roof == "shed":
        high = top + d * slope
        y0, y1, z1 = -d / 2 - o, d / 2 + o, high + o * slope + 0.06
        x, y = w / 2, d / 2
        side = primitives.quad([[-x - o, y1, z1], [-x - o, y0, low], [x + o, y0, low], [x + o, y1, z1]])
        back = primitives.quad([[x, y, high], [x, y, top], [-x, y, top], [-x, y, high]])
        uv = [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]
        ends = [primitives.triangle([[end, -y, top], [end, y, top], [end, y, high]], uv) for end in (-x, x)]
        return [side], high, [back, *ends]
    ridge = top + 0.5 * d * slope
    inset = min(0.5 * d, 0.45 * w) if house.roof == "hip" else -o
    x, y, z, tip = w / 2 + o, d / 2 + o, ridge + 0.06, w / 2 - inset
    slopes, gables = [], []
    for sign in (1.0, -1.0):
        right, front = sign * x, -sign * y
        corners = [[-sign * tip, 0, z], [-right, front, low], [right, front, low], [sign * tip, 0, z]]
        slopes.append(primitives.quad(corners))
    uv = [[0.5, 0.0], [0.0, 1.0], [1.0, 1.0]]
    for sign in (1.0, -1.0):
        right, end = sign * x, sign * w / 2
        if house.roof == "hip":
            slopes.append(primitives.triangle([[sign * tip, 0, z], [right, -y, low], [right, y, low]], uv))
        else:
            gables.append(primitives.triangle([[end, 0, ridge], [end, -d / 2, top], [end, d / 2, top]], uv))
    if turned:
        slopes, gables = ([part.moved(np.zeros(3), np.pi / 2) for part in parts] for parts in (slopes, gables))
    return slopes, ridge, gables


def _openings(
    place: KnownPlace, house: House, floor: float, rng: np.random.Generator, lit_windows: float, trim: list[MeshPart]
) -> tuple[list[MeshPart], list[tuple[int, MeshPart]]]:
    """Returns the panes that are never lit, and (kind, pane) of the panes that are lit after dark.

    Adds doors, sills and shutters to `trim`.
    """
    panes: list[MeshPart] = []
    lit: list[tuple[int, MeshPart]] = []
    wide, tall = {
        "cross": (1.15, 1.35),
        "casement": (0.95, 1.2),
        "sash": (0.95, 1.65),
        "ribbon": (2.3, 1.1),
        "shutters": (1.0, 1.4),
    }[house.window]
    wide, tall = wide * float(rng.uniform(0.85, 1.15)), tall * float(rng.uniform(0.9, 1.1))
    gap = wide * float(rng.uniform(1.6, 2.6)) + 0.6
    sills, doors = rng.random() < 0.6, int(rng.integers(1, 3))
    for wall in range(4):
        length, reach = ((house.width, house.depth), (house.depth, house.width))[wall % 2]
        across = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]][wall], float)
        out = np.array([across[1], -across[0]])
        count = max(1, int((length - 0.6) / gap))
        door = int(rng.integers(0, count)) if wall == 0 or rng.random() < 0.25 else -1
        yaw = float(np.arctan2(across[1], across[0]))
        for storey in range(house.storeys):
            for k in range(count):
                middle = out * reach / 2 + across * length * ((k + 0.5) / count - 0.5)
                is_door = storey == 0 and k == door
                if not is_door and rng.random() < 0.07:
                    continue
                w, h = (1.0, 2.1) if is_door else (wide, tall)
                z = floor - 0.05 if is_door else floor + 0.9 + _STOREY * storey + 0.5 * (1.35 - tall)
                left, right = middle - across * w / 2 + 0.03 * out, middle + across * w / 2 + 0.03 * out
                pane = vertical_quad(left, right, z, z + h)
                if is_door:
                    trim.append(place.cell(f"door{int(rng.integers(0, doors))}", pane))
                    step = primitives.box((1.5, 0.6, 0.5), floor - 0.55)
                    trim.append(place.cell("tank", step.moved(np.append(middle + 0.3 * out, 0.0), yaw)))
                    continue
                kind = int(rng.integers(0, 16))
                if rng.random() < lit_windows:
                    lit.append((kind, pane))
                else:
                    panes.append(place.cell(f"window{kind}", pane))
                if sills:
                    sill = primitives.box((w + 0.2, 0.14, 0.06), z - 0.08)
                    trim.append(place.cell("white", sill.moved(np.append(middle + 0.07 * out, 0.0), yaw)))
                if house.window == "shutters":
                    for side in (-1.0, 1.0):
                        at = middle + side * across * (0.75 * w) + 0.04 * out
                        board = vertical_quad(at - across * w / 4, at + across * w / 4, z, z + h)
                        trim.append(place.cell("shutter", board))
    return panes, lit
