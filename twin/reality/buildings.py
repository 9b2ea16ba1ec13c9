"""Buildings: blocks with a roof slab, windows, sills and doors."""

import numpy as np

from twin.reality import shapes
from twin.reality.route import ground_height
from twin.reality.shapes import Part
from twin.reality.things import SEED, Array, Place, Solid, Thing, cell

# Name: centre (x, y) [m]; width, depth, height [m]; windows per 10 m of wall, floors.
BUILDINGS: dict[str, tuple[tuple[float, float], tuple[float, float, float], tuple[int, int]]] = {
    "hall": ((10.0, -14.0), (17.0, 9.0, 8.0), (4, 2)),
    "library": ((19.5, 13.8), (18.0, 8.0, 10.5), (4, 3)),
    "lodge": ((-3.0, 13.5), (12.0, 7.0, 5.0), (3, 1)),
    "school": ((54.0, -16.0), (10.0, 30.0, 9.5), (3, 3)),
    "workshop": ((43.0, 15.0), (18.0, 9.0, 6.5), (3, 2)),
    "annex": ((25.5, -25.0), (10.0, 15.0, 7.0), (4, 2)),
    "dormitory": ((39.0, -66.0), (34.0, 9.0, 12.0), (4, 4)),
    "tower": ((-22.0, -40.0), (12.0, 12.0, 18.0), (3, 5)),
    "block": ((82.0, 6.0), (14.0, 24.0, 14.0), (3, 4)),
    "sheds": ((20.0, -52.0), (14.0, 9.0, 4.5), (2, 1)),
}


def _building(
    place: Place, name: str, centre: tuple[float, float], size: tuple[float, float, float], windows: tuple[int, int]
) -> None:
    """A block with a roof slab, windows in `windows` = (per 10 m of wall, floors), sills and doors."""
    rng = np.random.default_rng([SEED, 1, len(place.things)])
    width, depth, height = size
    corners = np.array(centre) + 0.5 * np.array([[a * width, b * depth] for a in (-1, 1) for b in (-1, 1)])
    base = float(ground_height(place.route, corners).min()) - 0.2
    origin = np.array([*centre, 0.0])
    shell = shapes.walls(width, depth, base, base + height).moved(origin)
    solid = Solid("box", np.array([*centre, base + height / 2]), (width / 2, depth / 2, height / 2))
    place.things.append(Thing(name, "obstacle", shell, name, (solid,)))
    roof = cell("tank", shapes.box((width + 0.7, depth + 0.7, 0.35), base + height).moved(origin))
    trim: list[Part] = [roof]
    panes: list[tuple[int, Part]] = []
    lit: list[tuple[int, Part]] = []
    floor = (height - 0.6) / windows[1]
    for wall in range(4):
        length = (width, depth)[wall % 2]
        across = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]][wall], float)
        out = np.array([across[1], -across[0]])
        face = np.array(centre) + out * (depth, width)[wall % 2] / 2
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
                pane = upright(left + 0.02 * out, right + 0.02 * out, z0, z0 + tall)
                if is_door:
                    trim.append(cell(f"door{int(rng.integers(0, 2))}", pane))
                    canopy = shapes.box((wide + 0.8, 0.9, 0.12), z0 + tall + 0.15)
                    at = np.append(middle + 0.45 * out, 0.0)
                    trim.append(cell("dark", canopy.moved(at, float(np.arctan2(across[1], across[0])))))
                    continue
                shining = rng.random() < 0.42
                kind = int(rng.integers(0, 16))
                (lit if shining else panes).append((kind, pane))
                sill = shapes.box((wide + 0.2, 0.14, 0.07), z0 - 0.09)
                at = np.append(middle + 0.07 * out, 0.0)
                trim.append(cell("white", sill.moved(at, float(np.arctan2(across[1], across[0])))))
    place.things.append(Thing(f"{name}_trim", "obstacle", shapes.join(trim)))
    place.things.append(Thing(f"{name}_glass", "obstacle", shapes.join([cell(f"window{k}", p) for k, p in panes])))
    # Windows that are lit after dark: which texture they show depends on the lighting.
    day = shapes.join([cell(f"window{k}", p) for k, p in lit])
    dark = shapes.join([cell(f"lit{k % 8}", p) for k, p in lit])
    place.things.append(Thing(f"{name}_day", "obstacle", day, "windows_by_day"))
    place.things.append(Thing(f"{name}_lit", "obstacle", dark, "windows_by_night"))


def upright(left: Array, right: Array, low: float, high: float) -> Part:
    """A vertical rectangle between two points of the plan."""
    return shapes.quad(np.array([[*left, high], [*left, low], [*right, low], [*right, high]]))


def add(place: Place) -> None:
    """Adds every building to a place."""
    for name, (centre, size, windows) in BUILDINGS.items():
        _building(place, name, centre, size, windows)
