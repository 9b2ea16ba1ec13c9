"""Counts the poles of a generated place that its twin shows and that are solid in it.

    python benchmarks/poles.py SCENE ... [--json FILE]

A scene is one of `twin reality film`, built up to stage `mesh`. Errors of its scale do not count, since a similarity
aligns the cameras with the true ones. Poles are the upright cylinders of the truth that are at least 0.7 m high, at
most 16 cm in radius and up to 10 m beside the filmed road.

- *seen*: the field's depth is within 10 cm of the pole's front in at least half of the samples. A sample is a height in
  a filmed frame up to 10 m away in which nothing hides the pole there; there are up to two frames per film.
- *high samples*: samples above 3 m, in frames 7 to 18 m away; they do not count for *seen*.
- *solid*: a convex part is within 10 cm of the axis, at more than half of three heights up to 0.6 m.
- *false*: poles that the build found, and that are more than 15 cm from everything that stands in the truth.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from record import record_parser
from sections import run_sections, versions

from twin.errors import InputError, print_error
from twin.geometry.cameras import Cameras, Viewpoints, project
from twin.geometry.mesh_rays import Surface
from twin.geometry.poses import Similarity
from twin.loading import load_scene
from twin.nerf.baked import BakedField
from twin.nerf.poles import Poles
from twin.reality.place_objects import Solid
from twin.reality.truth import Truth, align_poses, load_parts, matched_poses, surface_of

_LEAST_HEIGHT, _MAX_RADIUS = 0.7, 0.16  # [m]
_BESIDE = 10.0  # [m]
_HEIGHTS, _DISTANCES = (0.3, 0.7, 1.1, 1.5, 1.9, 2.3), (0.0, 5.0, 10.0)
"""Heights of samples [m], and the least, best and largest distance of their frames [m]."""
_HIGH, _HIGH_DISTANCES = (3.3, 3.8, 4.3, 4.8), (7.0, 12.0, 18.0)
_SOLID_HEIGHTS = (0.2, 0.4, 0.6)  # [m]
_TOLERANCE = 0.10  # [m]
_FALSE = 0.15  # [m]
Planes = tuple[NDArray, NDArray]
TARGETS: dict[str, tuple[str, float]] = {"seen": ("≥", 0.95), "solid": ("≥", 0.95), "false": ("≤", 0.0)}


def true_poles(truth: Truth) -> list[tuple[str, Solid]]:
    """Names and shapes of the poles beside the filmed road."""
    out = []
    for thing in truth.place.objects:
        for one in thing.solids:
            thin = one.kind == "cylinder" and one.half[0] <= _MAX_RADIUS and 2.0 * one.half[1] >= _LEAST_HEIGHT
            if thin and any(_is_beside(one.center, *line) for line in truth.lines.values()):
                out.append((thing.name, one))
    return out


def _is_beside(point: NDArray, line: Any, start: float, length: float) -> bool:
    station, lateral = line.project(point[None, :2])
    return bool(start + 2.0 < station[0] < start + length + 2.0 and abs(lateral[0]) < _BESIDE)


def depth_errors(
    pole: Solid,
    truth: Truth,
    to_truth: Similarity,
    field: BakedField,
    whole: Surface,
    wanted: tuple[float, ...] = _HEIGHTS,
    distances: tuple[float, float, float] = _DISTANCES,
) -> NDArray:
    """Depth of the field minus that of the pole's front in all samples [m]."""
    ground = float(truth.ground_height(pole.center[None, :2])[0])
    heights = [h for h in wanted if ground + h < pole.center[2] + pole.half[1]]
    if not heights:
        return np.zeros(0)
    points, (least, best, far) = np.array([[*pole.center[:2], ground + h] for h in heights]), distances
    errors = [np.zeros(0)]
    for name, film in truth.films.items():
        away = np.linalg.norm(film.camera_to_world[:, :2, 3] - pole.center[:2], axis=1)
        used = 0
        for i in np.argsort(np.abs(away - best)):
            pixel, depth = project(points, film.camera_to_world[i], truth.intrinsics)
            shown = (depth > 1.0) & (pixel > 4).all(1) & (pixel < np.array(truth.size) - 4).all(1)
            if used == 2 or not least < away[i] < far or not shown.any():
                continue
            eye = film.camera_to_world[i, :3, 3]
            true = whole.cast(np.tile(eye, (len(points), 1)), points - eye) * depth
            shown &= np.abs(true - depth) < 0.25  # else something hides the pole
            if shown.any():
                used += 1
                pose = to_truth.inverse().poses(film.camera_to_world[i][None])
                view = Viewpoints.of(pose, truth.intrinsics, truth.size)
                column, row = pixel[shown].astype(int).T
                depth = to_truth.scale * field.render(view, truth.lighting(name), truth.size).depth[0, row, column]
                errors.append(depth - true[shown])
    return np.concatenate(errors)


def solid_share(pole: Solid, truth: Truth, parts: list[Planes]) -> float:
    """Fraction of the heights at which a convex part is within the tolerance of the axis."""
    ground = float(truth.ground_height(pole.center[None, :2])[0])
    axis = np.array([[*pole.center[:2], ground + h] for h in _SOLID_HEIGHTS])
    away = [(axis @ normals.T - offsets).max(1) for normals, offsets in parts]
    return float((np.min(away, 0, initial=np.inf) < _TOLERANCE).mean())


def planes(vertices: NDArray, faces: NDArray) -> Planes:
    """Outward unit normals and offsets of a convex part's faces."""
    hull = trimesh.Trimesh(vertices, faces, process=False)
    return hull.face_normals, (hull.face_normals * hull.triangles[:, 0]).sum(1)


def measure(root: Path) -> dict[str, float | None]:
    scene = load_scene(root).scene
    truth, cameras = Truth.load(scene.truth), Cameras.load(scene.stage("metric"))
    to_truth = align_poses(cameras.camera_to_world, matched_poses(truth, cameras), with_scale=True)
    field, found = BakedField.load(scene.stage("field")), Poles.load(scene.stage("field"))
    whole, standing = (
        surface_of([(one.part.vertices, one.part.faces) for one in truth.place.objects if one.kind not in without])
        for without in ((), ("ground",))
    )
    parts = [planes(to_truth.points(v), f) for v, f in load_parts(scene.stage("mesh"))]
    seen, solid, samples, high = [], [], [], [np.zeros(0)]
    for name, pole in true_poles(truth):
        errors, share = depth_errors(pole, truth, to_truth, field, whole), solid_share(pole, truth, parts)
        within = np.abs(errors) < _TOLERANCE
        high.append(np.abs(depth_errors(pole, truth, to_truth, field, whole, _HIGH, _HIGH_DISTANCES)) < _TOLERANCE)
        if len(errors):  # else it is hidden in all frames
            seen.append(within.mean() >= 0.5)
            solid.append(share > 0.5)
            samples.append(within)
            shown = f"{within.mean():.0%} of {len(within)} samples"
            print(
                f"  {name}: radius {pole.half[0]:.3f} m, seen in {shown}, solid at {share:.0%} of the heights",
                flush=True,
            )
    if not seen:
        raise InputError(f"{root}: no pole of the place is in its films; choose another place")
    points = np.concatenate([to_truth.points(found.foot + np.array([0.0, 0.0, h])) for h in (0.3, 0.6)])
    away = standing.distance(points).reshape(2, -1).max(0) if len(found) else np.zeros(0)
    for foot, distance in zip(to_truth.points(found.foot), away, strict=True):
        if distance > _FALSE:
            print(f"  false: a pole at {foot[0]:.2f}, {foot[1]:.2f}, {distance:.2f} m from anything", flush=True)
    figures = {
        "poles": len(seen),
        "seen": float(np.mean(seen)),
        "solid": float(np.mean(solid)),
        "samples_within_10cm": float(np.concatenate(samples).mean()),
        "high_samples": len(np.concatenate(high)),
        "high_samples_within_10cm": float(np.concatenate(high).mean()) if len(np.concatenate(high)) else None,
        "found": len(found),
        "false": int((away > _FALSE).sum()),
    }
    return {f"{root.name}.{name}": value for name, value in figures.items()}


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    options = parser.parse_args()
    if len({root.name for root in options.scenes}) < len(options.scenes):
        parser.error("two scenes have the same folder name, under which figures are kept; give each another name")
    about = {"scenes": [str(one) for one in options.scenes], "versions": versions("twin", "numpy")}
    targets = {f"{root.name}.{name}": wanted for root in options.scenes for name, wanted in TARGETS.items()}
    measures = [partial(measure, root) for root in options.scenes]
    try:
        return run_sections(measures, targets, about, options.json, options.replace_record)
    except InputError as error:
        return print_error(error)


if __name__ == "__main__":
    sys.exit(main())
