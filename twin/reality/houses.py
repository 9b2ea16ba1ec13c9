"""Buildings: blocks with windows, sills and doors, under flat or pitched roofs."""

import numpy as np

from twin.reality import primitives
from twin.reality.place_objects import KnownPlace, PlaceObject, Solid, vertical_quad
from twin.reality.primitives import MeshPart


def add_block(
    place: KnownPlace,
    name: str,
    center: tuple[float, float],
    size: tuple[float, float, float],
    windows: tuple[int, int],
) -> None:
    """A block with a roof slab, windows in `windows` = (per 10 m of wall, floors), sills and doors."""
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
    place.objects.append(PlaceObject(f"{name}_trim", "obstacle", primitives.join(trim)))
    place.objects.append(
        PlaceObject(f"{name}_glass", "obstacle", primitives.join([place.cell(f"window{k}", p) for k, p in panes]))
    )
    # Windows lit after dark exist twice; the lighting decides which of the two is in the model.
    day = primitives.join([place.cell(f"window{k}", p) for k, p in lit])
    dark = primitives.join([place.cell(f"lit{k % 8}", p) for k, p in lit])
    place.objects.append(PlaceObject(f"{name}_day", "obstacle", day, "windows_by_day"))
    place.objects.append(PlaceObject(f"{name}_lit", "obstacle", dark, "windows_by_night"))
