"""Ground truth of a generated scene: poses, some depth maps, and the place, which is rebuilt from parameters.

`twin reality film` writes it to `<scene>/truth`. A build must not read it; `twin/reality/comparison.py`,
`twin reality drive`, benchmarks and tests read it.
"""

from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from twin.errors import InputError
from twin.files import load_arrays, read_json, wrap_read_errors, write_json
from twin.reality import SEED, campus_road
from twin.reality.campus_road import RoadLine
from twin.reality.drawn_place import build_number
from twin.reality.drawn_road import DrawnRoad
from twin.reality.filming import CAMERA_HEIGHT
from twin.reality.place_objects import KnownPlace
from twin.reality.place_sampling import draw
from twin.reality.place_spec import FREE_HALF_WIDTH
from twin.types import Array

HALF_WIDTH = FREE_HALF_WIDTH  # [m] half width of the free corridor around the route


@dataclass(frozen=True)
class TrueFilm:
    """True camera poses and depth maps of one source."""

    times: Array
    """[s], shape (n,)."""
    camera_to_world: Array
    """OpenCV axes of the camera, world z up [m], shape (n, 4, 4)."""
    depth_frames: NDArray[np.int64]
    """Indices of the frames with a depth map, shape (k,)."""
    depth: NDArray[np.float16]
    """z-depth [m], 0 = sky, at a quarter or a third of the film's size, shape (k, h, w)."""


@dataclass(frozen=True)
class Truth:
    """The truth of one filmed scene."""

    route: RoadLine | DrawnRoad
    start: float
    """Station where the films start [m]."""
    length: float
    """Filmed length [m]."""
    half_width: float
    """Half width of the free corridor [m]."""
    intrinsics: Array
    """fx, fy, cx, cy [px] of every film, shape (4,)."""
    size: tuple[int, int]
    """Width, height of every film [px]."""
    films: dict[str, TrueFilm]
    """Films by source name."""
    number: int = 0
    """Number of the place."""
    lightings: dict[str, str] = field(default_factory=dict)
    """Lighting of each film by source name; a film that is missing here is named after its lighting."""
    camera_height: float = CAMERA_HEIGHT
    """Mean height of the lens above the ground [m]."""

    def save(self, folder: Path) -> None:
        """Writes `truth.json` and `truth.npz`."""
        folder.mkdir(parents=True, exist_ok=True)
        arrays = {f"{key}_{name}": value for name, film in self.films.items() for key, value in vars(film).items()}
        np.savez_compressed(folder / "truth.npz", intrinsics=self.intrinsics, **arrays)
        road = asdict(self.route) if isinstance(self.route, RoadLine) else self.number
        head: dict[str, Any] = {
            "route" if self.number == 0 else "place": road,
            "start": self.start,
            "length": self.length,
        }
        if self.road_length > 0.0:
            head["road_length"] = self.road_length
        head |= {"half_width": self.half_width}
        if self.number > 0:
            head |= {"lightings": self.lightings, "camera_height": self.camera_height}
        head |= {"size": list(self.size), "films": list(self.films), "seed": SEED}
        write_json(folder / "truth.json", head | {"fingerprint": fingerprint(self.place)})

    @staticmethod
    def load(folder: Path) -> "Truth":
        """Reads a truth and rebuilds its place.

        Raises:
            InputError: the files are damaged, or this version of the code builds another place than the one filmed.
        """
        with wrap_read_errors(folder, "film again: twin reality film"):
            head = read_json(folder / "truth.json")
            data = load_arrays(folder / "truth.npz")
            keys = ("times", "camera_to_world", "depth_frames", "depth")
            number = int(head.get("place", 0))
            truth = Truth(
                DrawnRoad(draw(number, head.get("road_length", 0.0))) if number else RoadLine(**head["route"]),
                head["start"],
                head["length"],
                head["half_width"],
                data["intrinsics"],
                (int(head["size"][0]), int(head["size"][1])),
                {name: TrueFilm(*(data[f"{key}_{name}"] for key in keys)) for name in head["films"]},
                number,
                head.get("lightings", {}),
                head.get("camera_height", CAMERA_HEIGHT),
            )
        if not np.allclose(head["fingerprint"], fingerprint(truth.place), atol=1e-4):
            raise InputError(f"{folder}: filmed in another version of the place; film again: twin reality film")
        return truth

    @property
    def road_length(self) -> float:
        """Length of the driven line [m] if it was lengthened, else 0."""
        return self.route.length if self.number and self.route.length > draw(self.number).line.length else 0.0

    @cached_property
    def place(self) -> KnownPlace:
        """The rebuilt place."""
        if isinstance(self.route, RoadLine):
            return campus_road.build(self.route)
        return build_number(self.number, length=self.road_length)

    def ground_height(self, xy: Array) -> Array:
        """Height of the ground [m], shape (..., 2) → (...)."""
        return self.route.ground_height(xy)

    def lighting(self, film: str) -> str:
        """The lighting of a film by its source name."""
        return self.lightings.get(film, film)

    def poses(self, source: str, times: Array) -> Array:
        """Interpolated camera_to_world of one source at times within its film [s], shapes (n,) → (n, 4, 4)."""
        film = self.films[source]
        at = np.clip(times, film.times[0], film.times[-1])
        out = np.tile(np.eye(4), (len(at), 1, 1))
        out[:, :3, :3] = Slerp(film.times, Rotation.from_matrix(film.camera_to_world[:, :3, :3]))(at).as_matrix()
        for axis in range(3):
            out[:, axis, 3] = np.interp(at, film.times, film.camera_to_world[:, axis, 3])
        return out


def fingerprint(place: KnownPlace) -> list[float]:
    """Identifies a version of the place: numbers of objects and vertices, mean and standard deviation of vertices."""
    vertices = np.concatenate([obj.part.vertices for obj in place.objects])
    return [len(place.objects), len(vertices), *vertices.mean(0).tolist(), *vertices.std(0).tolist()]
