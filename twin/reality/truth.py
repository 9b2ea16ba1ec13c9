"""The truth about a filmed scene: poses, a few depth maps, and the geometry, regenerated from its parameters.

Written by `python -m twin.reality film` into `<scene>/truth`; only `twin/reality/comparison.py` and the tests may read it.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from twin.errors import InputError
from twin.files import read_json, write_json
from twin.reality import centerline as roads
from twin.reality import place as places
from twin.reality import primitives
from twin.reality.centerline import RoadLine
from twin.reality.things import SEED, KnownPlace
from twin.types import Array

HALF_WIDTH = 1.5  # [m] the corridor around the route that nothing reaches into


@dataclass(frozen=True)
class TrueFilm:
    """True cameras of one source."""

    times: Array
    """[s], shape (n,)."""
    camera_to_world: Array
    """OpenCV axes, metres, z up, shape (n, 4, 4)."""
    depth_frames: NDArray[np.int64]
    """Frames whose depth is kept, shape (k,)."""
    depth: NDArray[np.float16]
    """z-depth [m], 0 = sky, at a quarter of the film's size, shape (k, height / 4, width / 4)."""


@dataclass(frozen=True)
class Truth:
    """Everything known about one filmed scene."""

    route: RoadLine
    start: float
    """Station where the films start [m]."""
    length: float
    """Length filmed [m]."""
    half_width: float
    """Half width of the free corridor [m]."""
    intrinsics: Array
    """fx, fy, cx, cy [px] of every film, shape (4,)."""
    size: tuple[int, int]
    """Width, height of every film [px]."""
    films: dict[str, TrueFilm]
    """By source name."""

    def save(self, folder: Path) -> None:
        """Writes `truth.json` and `truth.npz`."""
        folder.mkdir(parents=True, exist_ok=True)
        arrays = {f"{key}_{name}": value for name, film in self.films.items() for key, value in vars(film).items()}
        np.savez_compressed(folder / "truth.npz", intrinsics=self.intrinsics, **arrays)
        head = {"route": asdict(self.route), "start": self.start, "length": self.length, "half_width": self.half_width}
        head |= {"size": list(self.size), "films": list(self.films), "seed": SEED}
        write_json(folder / "truth.json", head | {"fingerprint": fingerprint(self.place)})

    @staticmethod
    def load(folder: Path) -> "Truth":
        """Reads a truth and builds its place anew.

        Raises:
            InputError: the films were made of another place than this version of the code builds.
        """
        head = read_json(folder / "truth.json")
        with np.load(folder / "truth.npz", allow_pickle=False) as data:
            keys = ("times", "camera_to_world", "depth_frames", "depth")
            films = {name: TrueFilm(*(data[f"{key}_{name}"] for key in keys)) for name in head["films"]}
            route = RoadLine(**head["route"])
            size = (int(head["size"][0]), int(head["size"][1]))
            truth = Truth(route, head["start"], head["length"], head["half_width"], data["intrinsics"], size, films)
        if not np.allclose(head["fingerprint"], fingerprint(truth.place), atol=1e-4):
            raise InputError(
                f"{folder}: filmed in another version of the place; film again: python -m twin.reality film"
            )
        return truth

    @cached_property
    def place(self) -> KnownPlace:
        """The place itself, built anew."""
        return places.build(self.route)

    def ground_height(self, xy: Array) -> Array:
        """Height of the ground [m], shape (..., 2) → (...)."""
        return roads.ground_height(self.route, xy)

    def path(self, step: float = 0.25) -> Array:
        """The filmed part of the centre line on the ground [m], shape (m, 3)."""
        xy = self.route.at(np.arange(self.start, self.start + self.length + step / 2, step))
        return np.concatenate([xy, self.ground_height(xy)[:, None]], 1)

    def obstacle_mesh(self, foliage: bool = False) -> trimesh.Trimesh:
        """The surface of everything solid that stands on the ground (and of leaves, if asked for)."""
        kinds = ("obstacle", "foliage") if foliage else ("obstacle",)
        parts = [thing.part for thing in self.place.things if thing.kind in kinds]
        whole = primitives.join(parts)
        return trimesh.Trimesh(whole.vertices, whole.faces, process=False)

    def poses(self, source: str, times: Array) -> Array:
        """camera_to_world of one source at times [s] within its film, interpolated; shapes (n,) → (n, 4, 4)."""
        film = self.films[source]
        at = np.clip(times, film.times[0], film.times[-1])
        out = np.tile(np.eye(4), (len(at), 1, 1))
        out[:, :3, :3] = Slerp(film.times, Rotation.from_matrix(film.camera_to_world[:, :3, :3]))(at).as_matrix()
        for axis in range(3):
            out[:, axis, 3] = np.interp(at, film.times, film.camera_to_world[:, axis, 3])
        return out


def fingerprint(place: KnownPlace) -> list[float]:
    """What tells one version of the place from another: counts of things and vertices, and the vertices' moments."""
    vertices = np.concatenate([thing.part.vertices for thing in place.things])
    return [len(place.things), len(vertices), *vertices.mean(0).tolist(), *vertices.std(0).tolist()]
