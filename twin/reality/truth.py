"""Ground truth of a generated scene (poses, some depth maps, and the place, which is rebuilt from parameters), and the
errors of a build against it.

`twin reality film` writes the truth to `<scene>/truth`. A build must not read it; `compare`, `twin reality drive`,
benchmarks and tests read it.

The *twin frame* is the metric frame of the build, the *true frame* that of the generated world. All errors except
`ate_m`, `ate_max_m` and `scale_error` are measured after a rigid alignment of the twin's cameras with the true ones.
The alignment does not correct the twin's scale, since a wrong scale misleads a robot. Obstacles and meshes are compared
only where a camera could see them.
"""

from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from twin.assets.ground import Ground
from twin.errors import InputError
from twin.files import load_arrays, read_json, wrap_read_errors, write_json
from twin.geometry.cameras import Cameras, Viewpoints, evenly_spaced, pixel_grid, scaled_intrinsics, unproject
from twin.geometry.mesh_rays import Surface
from twin.geometry.poses import Similarity, pose_of, rotation_angle, umeyama
from twin.geometry.route import BRANCH
from twin.nerf.baked import BakedField
from twin.reality import SEED, campus_road
from twin.reality.campus_road import RoadLine
from twin.reality.filming import CAMERA_HEIGHT
from twin.reality.place_objects import DrivenLine, KnownPlace
from twin.reality.place_sampling import sample_place
from twin.reality.place_spec import FREE_HALF_WIDTH
from twin.reality.sampled_place import build_number
from twin.reality.sampled_road import SampledRoad
from twin.reality.side_roads import SideLine
from twin.scene import SceneDir, require_stage, stage_result
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

    route: RoadLine | SampledRoad
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
    side_roads: dict[str, float] = field(default_factory=dict)
    """Filmed lengths along the lines into the side roads [m], by name."""

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
        if self.side_roads:
            head["side_roads"] = self.side_roads
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
            side_roads = {name: float(length) for name, length in head.get("side_roads", {}).items()}
            truth = Truth(
                SampledRoad(sample_place(number, head.get("road_length", 0.0), bool(side_roads)))
                if number
                else RoadLine(**head["route"]),
                head["start"],
                head["length"],
                head["half_width"],
                data["intrinsics"],
                (int(head["size"][0]), int(head["size"][1])),
                {name: TrueFilm(*(data[f"{key}_{name}"] for key in keys)) for name in head["films"]},
                number,
                head.get("lightings", {}),
                head.get("camera_height", CAMERA_HEIGHT),
                side_roads,
            )
            _ = truth.lines  # a KeyError if this version of the place lacks one of the side roads
            filmed, now = np.array(head["fingerprint"], float), np.array(fingerprint(truth.place))
        if filmed.shape != now.shape or not np.allclose(filmed, now, atol=1e-4):
            raise InputError(f"{folder}: filmed in another version of the place; film again: twin reality film")
        return truth

    @property
    def road_length(self) -> float:
        """Length of the driven line [m] if it was lengthened, else 0."""
        return self.route.length if self.number and self.route.length > sample_place(self.number).line.length else 0.0

    @cached_property
    def place(self) -> KnownPlace:
        """The rebuilt place."""
        if isinstance(self.route, RoadLine):
            return campus_road.build(self.route)
        return build_number(self.number, length=self.road_length, side_roads=bool(self.side_roads))

    @cached_property
    def lines(self) -> dict[str, tuple[DrivenLine, float, float]]:
        """The filmed lines by name, "" for the driven line: line, first station, filmed length [m]."""
        out: dict[str, tuple[DrivenLine, float, float]] = {"": (self.route, self.start, self.length)}
        if isinstance(self.route, SampledRoad):
            axes = {axis.one.name: axis for axis in self.route.side_axes}
            out |= {name: (SideLine(self.route, axes[name]), 0.0, length) for name, length in self.side_roads.items()}
        return out

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
        turns = Slerp(film.times, Rotation.from_matrix(film.camera_to_world[:, :3, :3]))(at).as_matrix()
        positions = [np.interp(at, film.times, film.camera_to_world[:, axis, 3]) for axis in range(3)]
        return pose_of(turns, np.stack(positions, 1))


def fingerprint(place: KnownPlace) -> list[float]:
    """Identifies a version of the place: numbers of objects and vertices, mean and standard deviation of vertices."""
    vertices = np.concatenate([obj.part.vertices for obj in place.objects])
    return [len(place.objects), len(vertices), *vertices.mean(0).tolist(), *vertices.std(0).tolist()]


if TYPE_CHECKING:
    from twin.nerf.field import RadianceField


# ---- comparison with a build

_NEAR_ROUTE = 10.0  # [m] from the route; surfaces farther away are not compared
_MAX_HEIGHT = 3.0  # [m] above the ground; higher points of obstacles are not compared
_MIN_HEIGHT = 0.15  # [m] above the ground; lower points belong to the ground or a curb
_INTRUSION_HEIGHTS = (0.05, 0.15, 0.3, 0.6, 1.0, 1.5)  # [m] heights above the ground at which the corridor must be free
_RAYS = (96, 54)  # columns and rows of rays per camera that find the visible surface
_MAX_CAMERAS = 48  # largest number of cameras whose rays find the visible surface
_MAX_DEPTH = 20.0  # [m] pixels with a larger true depth are not compared
_DEPTH_KEYS = ("depth_median_m", "depth_relative")
_MESH_KEYS = (
    *("mesh_accuracy_median_m", "mesh_accuracy_mean_m", "mesh_completeness_mean_m"),
    *("mesh_completeness_5cm", "mesh_completeness_10cm", "mesh_chamfer_m"),
)
_MAX_DISTANCE = 1.0  # [m] larger distances count as this in a mean
_VISIBLE_CELL = 0.1  # [m] side of a cell; the visible surface is thinned to one point per cell


def compare(scene: SceneDir) -> dict[str, Any]:
    """Measures a build against its truth and writes `build/truth.json`, which the report reads.

    Returns:
        The written table: the entries of `measure`, and `of`, the content digest of each compared stage.

    Raises:
        InputError: the scene has no truth, or a stage up to the mesh has not been built.
    """
    if not (scene.truth / "truth.npz").exists():
        raise InputError(f"{scene.root} has no truth; only scenes of `twin reality film` have one")
    require_stage(scene, "mesh")  # which is of the same build as the others
    of = {stage: stage_result(scene, stage) for stage in ("metric", "field", "mesh")}
    compared = {"of": of, **measure(scene)}
    write_json(scene.truth_json, compared)
    return compared


def measure(scene: SceneDir) -> dict[str, Any]:
    """Measures a build against its truth.

    Returns:
        `figures`, and `camera_errors_m`: position errors after a similarity alignment [m], as a list per source.

        `figures`, lengths in m, angles in °: `frames` (number), `ate_m`, `ate_max_m` (absolute trajectory error after a
        similarity alignment: rms and maximum), `scale_error` (ratio of a length in the twin to the true length, minus
        1), `ate_rigid_m`, `ate_rigid_max_m` (the same after the rigid alignment), `rotation_median_deg`, `tilt_deg`
        (angle between the twin's vertical and the true one), `ground_median_m`, `ground_p95_m`, `ground_bias_m` (height
        of the ground inside the corridor: median and 95 % quantile of the absolute error, median of the signed error),
        `obstacle_accuracy_m` (median distance from the convex parts' visible surface to the true surface),
        `obstacle_completeness_m` (median distance from the true surface to the parts), `obstacle_median_m` (the larger
        of the two), `corridor_intrusions` (number of convex parts in the corridor), `route_median_m` (median distance
        of the twin's route from the true center line), the same for filmed side roads with their names appended
        (`route_median_m_side_1`), `depth_median_m`, `depth_relative` (median error of the field's
        depth, absolute and relative, up to a true depth of 20 m).

        The `mesh_*` figures compare the visual mesh with the true surface, at any height within 10 m of the route, in
        parts that a camera could see: `mesh_accuracy_median_m`, `mesh_accuracy_mean_m` (distance from mesh to true
        surface), `mesh_completeness_mean_m` (from true surface to mesh), `mesh_completeness_5cm` and
        `mesh_completeness_10cm` (fraction of the true surface within this distance of the mesh; the latter also per
        kind of object: `_ground`, `_obstacle`, `_foliage`), `mesh_chamfer_m` (half the sum of the two means). In means,
        distances above 1 m count as 1 m. A figure is None if its stage produced nothing to measure.
    """
    truth = Truth.load(scene.truth)
    cameras = Cameras.load(scene.stage("metric"))
    true_poses = matched_poses(truth, cameras)
    figures: dict[str, Any] = dict(camera_errors(cameras.camera_to_world, true_poses))
    to_truth = align_poses(cameras.camera_to_world, true_poses)
    mesh = scene.stage("mesh")
    figures |= _ground_errors(mesh, truth, to_truth)
    figures |= _surface_errors(mesh, truth, to_truth, true_poses)
    field = scene.stage("field")
    baked = (field / "baked.json").exists()
    figures |= depth_errors(BakedField.load(field), truth, to_truth) if baked else dict.fromkeys(_DEPTH_KEYS)
    true = true_poses[:, :3, 3]
    off = np.linalg.norm(umeyama(cameras.positions, true).points(cameras.positions) - true, axis=1)
    by_source = {name: off[[s == name for s in cameras.sources]].tolist() for name in dict.fromkeys(cameras.sources)}
    return {"figures": figures, "camera_errors_m": by_source}


def matched_poses(truth: Truth, cameras: Cameras) -> Array:
    """True poses of a build's cameras, shape (n, 4, 4). Raises InputError for a source that the truth does not have."""
    out = np.empty((len(cameras), 4, 4))
    for source in sorted(set(cameras.sources)):
        if source not in truth.films:
            raise InputError(
                f"source {source}: the truth has only the films {', '.join(truth.films)}; leave this source out, or "
                "give it the name of its film"
            )
        rows = np.array([s == source for s in cameras.sources])
        out[rows] = truth.poses(source, cameras.times[rows])
    return out


def align_poses(poses: Array, true_poses: Array, with_scale: bool = False) -> Similarity:
    """The rigid transform, or similarity if `with_scale`, that best maps camera poses onto the true ones, (n, 4, 4).

    Each camera contributes its center and the tips of its axes, 1 m long, because centers on a straight path do not
    determine the roll about it.
    """

    def tripods(p: Array) -> Array:
        return np.concatenate([p[:, :3, 3], *(p[:, :3, 3] + p[:, :3, k] for k in range(3))])

    return umeyama(tripods(poses), tripods(true_poses), with_scale=with_scale)


def camera_errors(poses: Array, true_poses: Array) -> dict[str, float]:
    """Errors of camera poses against the true ones, shapes (n, 4, 4)."""
    centers, true_centers = poses[:, :3, 3], true_poses[:, :3, 3]
    similarity = umeyama(centers, true_centers)
    off = np.linalg.norm(similarity.points(centers) - true_centers, axis=1)
    rigid = align_poses(poses, true_poses)
    rigid_off = np.linalg.norm(rigid.points(centers) - true_centers, axis=1)
    turned = np.swapaxes(true_poses[:, :3, :3], 1, 2) @ rigid.poses(poses)[:, :3, :3]
    return {
        "frames": len(poses),
        "ate_m": float(np.sqrt((off**2).mean())),
        "ate_max_m": float(off.max()),
        "scale_error": float(1.0 / similarity.scale - 1.0),
        "ate_rigid_m": float(np.sqrt((rigid_off**2).mean())),
        "ate_rigid_max_m": float(rigid_off.max()),
        "rotation_median_deg": float(np.rad2deg(np.median(rotation_angle(turned)))),
        "tilt_deg": float(np.rad2deg(np.arccos(np.clip(rigid.rotation[2, 2], -1.0, 1.0)))),
    }


def corridor(truth: Truth, half_width: float, step: float = 0.25) -> Array:
    """Grid of ground points within the true corridors of all filmed lines [m], shape (m, 3)."""
    laterals = np.linspace(-half_width, half_width, 2 * round(half_width / step) + 1)
    parts = []
    for line, start, length in truth.lines.values():
        stations = np.arange(start, start + length + step / 2, step)
        parts.append(line.at(stations[:, None], laterals[None]).reshape(-1, 2))
    xy = np.concatenate(parts)
    return np.concatenate([xy, truth.ground_height(xy)[:, None]], 1)


def _ground_errors(mesh: Path, truth: Truth, to_truth: Similarity) -> dict[str, float | None]:
    keys = ("ground_median_m", "ground_p95_m", "ground_bias_m")
    if not (mesh / "ground.npz").exists():
        return dict.fromkeys(keys)
    ground = Ground.load(mesh)
    xy = to_truth.inverse().points(corridor(truth, truth.half_width))[:, :2]
    twin = to_truth.points(np.concatenate([xy, ground.at(xy)[:, None]], 1))
    error = twin[:, 2] - truth.ground_height(twin[:, :2])
    values = (np.median(np.abs(error)), np.quantile(np.abs(error), 0.95), np.median(error))
    return {key: float(value) for key, value in zip(keys, values, strict=True)}


def _surface_errors(mesh: Path, truth: Truth, to_truth: Similarity, true_poses: Array) -> dict[str, float | int | None]:
    out: dict[str, float | int | None] = dict.fromkeys(
        (
            *("obstacle_accuracy_m", "obstacle_completeness_m", "obstacle_median_m", "corridor_intrusions"),
            *("route_median_m", *_MESH_KEYS),
        )
    )
    if (mesh / "route.npz").exists():
        with np.load(mesh / "route.npz", allow_pickle=False) as data:
            lines = {"": np.concatenate([data["xy"], data["z"][:, None]], 1)}
            lines |= {name: data[f"{BRANCH}{name}"] for name in truth.side_roads if f"{BRANCH}{name}" in data}
        for name, points in lines.items():
            off = truth.lines[name][0].project(to_truth.points(points)[:, :2])[1]
            out[f"route_median_m{name and f'_{name}'}"] = float(np.median(np.abs(off)))
    if not (mesh / "parts.npz").exists():
        return out
    parts = [(to_truth.points(v), f) for v, f in load_parts(mesh)]
    out["corridor_intrusions"] = sum(intrudes(v, f, truth) for v, f in parts)
    viewpoints = true_poses[evenly_spaced(len(true_poses), _MAX_CAMERAS)]
    kinds = {
        kind: [t.part for t in truth.place.objects if t.kind == kind] for kind in ("ground", "obstacle", "foliage")
    }
    solid = surface_of([(p.vertices, p.faces) for p in kinds["obstacle"]])
    leafy = surface_of([(p.vertices, p.faces) for p in kinds["obstacle"] + kinds["foliage"]])
    whole = surface_of([(p.vertices, p.faces) for kind in kinds.values() for p in kind])
    visible = visible_points(whole, viewpoints, truth)
    seen_points = _obstacle_points(visible, truth)
    seen_points = seen_points[solid.distance(seen_points) < 1e-3]  # without leaves and ground
    if parts and len(seen_points):
        twin = surface_of(parts)
        standing = _obstacle_points(visible_points(twin, viewpoints, truth), truth)
        if len(standing):
            accuracy, completeness = np.median(leafy.distance(standing)), np.median(twin.distance(seen_points))
            out["obstacle_accuracy_m"], out["obstacle_completeness_m"] = float(accuracy), float(completeness)
            out["obstacle_median_m"] = float(max(accuracy, completeness))
    if (mesh / "visual.npz").exists():
        with np.load(mesh / "visual.npz", allow_pickle=False) as data:
            visual = surface_of([(to_truth.points(data["vertices"].astype(np.float64)), data["faces"])])
        near, seen_points = _near_route(visible_points(visual, viewpoints, truth), truth), _near_route(visible, truth)
        if len(near) and len(seen_points):
            to_mesh = visual.distance(seen_points)
            out |= mesh_quality(whole.distance(near), to_mesh)
            for kind, objects in kinds.items():
                if not objects:  # such as the foliage of place 17
                    continue
                mine = surface_of([(p.vertices, p.faces) for p in objects]).distance(seen_points) < 1e-3
                if mine.any():
                    out[f"mesh_completeness_10cm_{kind}"] = float((to_mesh[mine] <= 0.1).mean())
    return out


def mesh_quality(to_true: Array, to_mesh: Array) -> dict[str, float]:
    """The `mesh_*` figures of `measure`.

    Args:
        to_true: Distances of mesh points from the true surface [m], shape (n,).
        to_mesh: Distances of true surface points from the mesh [m], shape (m,).
    """
    # A nearest surface beyond `_MAX_DISTANCE` belongs to another object; its distance says nothing about the build.
    accuracy, completeness = (float(np.minimum(d, _MAX_DISTANCE).mean()) for d in (to_true, to_mesh))
    near = [float((to_mesh <= reach).mean()) for reach in (0.05, 0.1)]
    values = (float(np.median(to_true)), accuracy, completeness, *near, 0.5 * (accuracy + completeness))
    return dict(zip(_MESH_KEYS, values, strict=True))


def load_parts(mesh: Path) -> list[tuple[Array, NDArray[np.int32]]]:
    """The convex parts of a mesh stage, each as vertices (v, 3) [m] and faces (f, 3)."""
    with np.load(mesh / "parts.npz", allow_pickle=False) as data:
        v, f = data["vertices"].astype(np.float64), data["faces"].astype(np.int32)
        vs, fs = data["vertex_start"], data["face_start"]
    return [(v[vs[k] : vs[k + 1]], f[fs[k] : fs[k + 1]]) for k in range(len(vs) - 1)]


def intrudes(vertices: Array, faces: NDArray[np.int32], truth: Truth) -> bool:
    """True if a convex part (true frame) reaches into the true corridor, 5 cm to 1.5 m above the ground."""
    floor = corridor(truth, truth.half_width, 0.125)
    low, high = vertices.min(0), vertices.max(0)
    floor = floor[((floor[:, :2] >= low[:2]) & (floor[:, :2] <= high[:2])).all(1)]
    if not len(floor):
        return False
    points = np.concatenate([floor + np.array([0.0, 0.0, h]) for h in _INTRUSION_HEIGHTS])
    hull = trimesh.Trimesh(vertices, faces, process=False).convex_hull
    inside = np.ones(len(points), bool)
    for normal, origin in zip(hull.face_normals, hull.triangles[:, 0], strict=True):
        inside[inside] = (points[inside] - origin) @ normal <= 1e-9
    return bool(inside.any())


def _obstacle_points(points: Array, truth: Truth) -> Array:
    """Keeps the points near the filmed route that are `_MIN_HEIGHT` to `_MAX_HEIGHT` above the ground."""
    points = _near_route(points, truth)
    height = points[:, 2] - truth.ground_height(points[:, :2])
    return points[(height > _MIN_HEIGHT) & (height < _MAX_HEIGHT)]


def _near_route(points: Array, truth: Truth) -> Array:
    """Keeps the points near the filmed lines, at any height."""
    near = np.zeros(len(points), bool)
    for line, start, length in truth.lines.values():
        station, lateral = line.project(points[:, :2])
        near |= (station > start) & (station < start + length + _NEAR_ROUTE) & (np.abs(lateral) < _NEAR_ROUTE)
    return points[near]


def surface_of(meshes: list[tuple[Array, NDArray]]) -> Surface:
    """One surface of several meshes, each given by vertices (v, 3) [m] and faces (f, 3)."""
    starts = np.cumsum([0] + [len(v) for v, _ in meshes])
    faces = [f + start for (_, f), start in zip(meshes, starts, strict=False)]
    return Surface(np.concatenate([v for v, _ in meshes]), np.concatenate(faces))


def visible_points(surface: Surface, viewpoints: Array, truth: Truth) -> Array:
    """Points of a surface visible from camera poses (k, 4, 4), thinned to one per cell, shape (m, 3)."""
    local = unproject(pixel_grid(*_RAYS), scaled_intrinsics(truth.intrinsics, truth.size, _RAYS)).reshape(-1, 3)
    rays = np.concatenate([local @ pose[:3, :3].T for pose in viewpoints])
    origins = np.repeat(viewpoints[:, :3, 3], len(local), 0)
    t = surface.cast(origins, rays)
    points = (origins + rays * t[:, None])[t > 0.0]
    _, first = np.unique(np.floor(points / _VISIBLE_CELL).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def depth_errors(
    field: "BakedField | RadianceField", truth: Truth, to_truth: Similarity, reach: float = _MAX_DEPTH
) -> dict[str, float | None]:
    """Median errors of a field's depth, for true depths up to `reach` [m], in three frames of each film."""
    errors, relative = [], []
    for name, film in truth.films.items():
        lighting = truth.lighting(name)
        if lighting not in field.lightings:
            continue
        pick = evenly_spaced(len(film.depth), 5)[1:4]
        poses = to_truth.inverse().poses(film.camera_to_world[film.depth_frames[pick]])
        height, width = film.depth.shape[1:]
        depth = field.render(Viewpoints.of(poses, truth.intrinsics, truth.size), lighting, (width, height)).depth
        true_depth = film.depth[pick].astype(np.float64)
        valid = (true_depth > 0.0) & (true_depth < reach)
        errors.append(np.abs(depth - true_depth)[valid])
        relative.append(errors[-1] / true_depth[valid])
    if not errors:
        return dict.fromkeys(_DEPTH_KEYS)
    values = (float(np.median(np.concatenate(parts))) for parts in (errors, relative))
    return dict(zip(_DEPTH_KEYS, values, strict=True))
