"""Convex decomposition of closed meshes by CoACD (Wei et al. 2022), with checked results.

*Piece*: a closed mesh to decompose. *Part*: a closed convex hull. *Protrusion* [m]: the largest distance by which a
part's surface lies outside its piece. *Uncovered*: the fraction of a piece's surface whose distance to every part
exceeds the protrusion bound.

CoACD may crash, so it runs in child processes with a time limit. Its results may vary from run to run, even with one
seed, so it uses one thread, and its results are cached by a hash of the input. Its parts may be too large, and even
block doorways, so parts that protrude too far are split.
"""

import contextlib
import hashlib
import json
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from twin import runtime
from twin.errors import InputError
from twin.files import digest_json, load_arrays, save_arrays
from twin.runtime import child_environment, die_with_parent
from twin.types import Array

_MAX_COACD_FACES = 400  # larger meshes are decimated for CoACD, which is slow with many faces; checks use all faces
# Results are checked, so a coarser search than CoACD's defaults suffices.
_SEARCH = {"resolution": 100, "mcts_nodes": 5, "mcts_iterations": 10, "mcts_max_depth": 2}
_TIME_LIMIT = 120.0  # [s] per piece; far more than a piece needs, so that a slow machine does not change the result
_POLL = 0.02  # [s] between checks for a result
_MAX_PROCESSES = 16  # each takes 150 MB
_MAX_HULL_VERTICES = 32
_SAMPLE_SPACING = 0.06  # [m] between test points on surfaces
_MAX_UNCOVERED = 0.08
_MAX_SPLITS = 5


@dataclass(frozen=True)
class ConvexPart:
    """A closed convex hull."""

    vertices: Array  # shape (v, 3) [m]
    faces: NDArray[np.int64]  # shape (f, 3), outward

    @staticmethod
    def hull(points: Array) -> "ConvexPart | None":
        """The hull of points (k, 3), or None if they span no volume."""
        if len(points) < 4:
            return None
        try:
            hull = ConvexHull(points)
        except QhullError:
            return None
        corners, inverse = np.unique(hull.simplices, return_inverse=True)
        faces = inverse.reshape(-1, 3)
        vertices = points[corners]
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
        faces[inward] = faces[inward][:, ::-1]
        return ConvexPart(vertices, faces.astype(np.int64))


@dataclass(frozen=True)
class SolidPiece:
    """A closed mesh with sample points on its surface."""

    vertices: Array
    faces: NDArray[np.int64]
    samples: Array  # shape (s, 3)
    tree: cKDTree
    inside: Callable[[Array], NDArray[np.bool_]]  # maps points (k, 3) to a mask (k,) of those inside the mesh

    @staticmethod
    def from_mesh(vertices: Array, faces: NDArray, inside: Callable[[Array], NDArray[np.bool_]]) -> "SolidPiece":
        """Samples the surface of a mesh; for `inside` see the attribute."""
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        samples = surface_samples(vertices, faces, _SAMPLE_SPACING)
        return SolidPiece(vertices, faces, samples, cKDTree(samples), inside)

    def protrusion(self, part: ConvexPart) -> float:
        """Protrusion of a part [m]; 0 below the sample spacing. It may be too large by up to half that spacing."""
        points = surface_samples(part.vertices, part.faces, 2 * _SAMPLE_SPACING)
        away = self.tree.query(points)[0]
        far = away > _SAMPLE_SPACING
        return float(away[far][~self.inside(points[far])].max(initial=0.0))


@dataclass(frozen=True)
class Decomposition:
    """Convex parts of all pieces, and statistics."""

    parts: list[ConvexPart]
    protrusion: Array  # protrusion of each part [m], shape (n,)
    uncovered: float  # uncovered fraction of the surfaces of all pieces
    failed: int  # pieces on which CoACD crashed, timed out or left too much uncovered
    split: int  # parts that were split because they protruded too far
    cached: int  # pieces whose result was in the cache


def decompose(pieces: list[SolidPiece], bound: float, cache: Path, seed: int) -> Decomposition:
    """Decomposes closed meshes into convex parts, which are split until they protrude by at most `bound` [m].

    A part that was split `_MAX_SPLITS` times may protrude further. A piece whose hull protrudes by at most the bound
    has this hull as its only part. If CoACD fails on a piece, the piece's hull is split instead. `cache` is the folder
    of earlier CoACD results, created if missing.
    """
    parts_of: list[list[tuple[ConvexPart, float]]] = []
    for piece in pieces:
        hull = ConvexPart.hull(piece.vertices)
        parts_of.append([] if hull is None else [(hull, piece.protrusion(hull))])
    concave = [i for i, parts in enumerate(parts_of) if not parts or parts[0][1] > bound]
    results, cached = _run_coacd([pieces[i] for i in concave], bound, cache, seed)
    failed = split = 0
    uncovered = 0.0
    for i, result in zip(concave, results, strict=True):
        piece, hulls = pieces[i], [hull for hull, _ in parts_of[i]]
        fitted = [split_to_bound(part, piece, bound) for part in result or hulls]
        fraction = uncovered_fraction(piece, [part for parts in fitted for part, _ in parts], bound)
        bad = result is None or fraction > _MAX_UNCOVERED
        failed += bad
        if bad and result is not None:
            fitted = [split_to_bound(part, piece, bound) for part in hulls]
            fraction = uncovered_fraction(piece, [part for parts in fitted for part, _ in parts], bound)
        split += sum(len(parts) > 1 for parts in fitted)
        uncovered += fraction * len(piece.samples)
        parts_of[i] = [item for parts in fitted for item in parts]
    items = [item for parts in parts_of for item in parts]
    samples = max(sum(len(piece.samples) for piece in pieces), 1)
    protrusions = np.array([protrusion for _, protrusion in items], np.float64)
    return Decomposition([part for part, _ in items], protrusions, uncovered / samples, failed, split, cached)


def split_to_bound(
    part: ConvexPart, piece: SolidPiece, bound: float, max_splits: int = _MAX_SPLITS
) -> list[tuple[ConvexPart, float]]:
    """Splits a part until no part protrudes by more than `bound` [m], or `max_splits` times; returns the parts with
    their protrusions [m].

    A split takes the samples of the piece's surface inside the part, divides them at the middle of the coordinate
    axis along which they extend furthest, and takes the hull of each half.
    """
    protrusion = piece.protrusion(part)
    if max_splits == 0 or protrusion <= bound:
        return [(part, protrusion)]
    inside = piece.samples[inside_hull(part, piece.samples, 1e-3 + _SAMPLE_SPACING)]
    if len(inside) < 8:
        return []
    along = inside[:, np.argmax(np.ptp(inside, axis=0))]
    middle = float(along.min() + along.max()) / 2
    halves = []
    for half in (along <= middle + _SAMPLE_SPACING, along >= middle - _SAMPLE_SPACING):
        hull = ConvexPart.hull(inside[half])
        if hull is not None:
            halves += split_to_bound(hull, piece, bound, max_splits - 1)
    return halves


def inside_hull(part: ConvexPart, points: Array, slack: float = 0.0) -> NDArray[np.bool_]:
    """Mask of the points (k, 3) inside the part or within about `slack` [m] of it."""
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    solid = length > 1e-12
    normal = normal[solid] / length[solid, None]
    return np.all(points @ normal.T <= (normal * a[solid]).sum(1) + slack, axis=1)


def uncovered_fraction(piece: SolidPiece, parts: list[ConvexPart], bound: float) -> float:
    """Fraction of the piece's surface whose distance to every part exceeds about `bound` [m]."""
    uncovered = np.ones(len(piece.samples), bool)
    for part in parts:
        uncovered[uncovered] = ~inside_hull(part, piece.samples[uncovered], bound)
    return float(uncovered.mean()) if len(uncovered) else 0.0


def surface_samples(vertices: Array, faces: NDArray, spacing: float) -> Array:
    """Points (k, 3) about `spacing` [m] apart: the vertices, and a regular grid in every triangle."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    level = np.clip(np.ceil(longest / spacing).astype(int), 1, 64)
    points = [vertices]
    for n in np.unique(level):
        i, j = (k.ravel() for k in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        keep = (i + j <= n) & ~((i % n == 0) & (j % n == 0))
        weights = np.stack([n - i[keep] - j[keep], i[keep], j[keep]], 1) / n
        points.append(np.einsum("kc,fcd->fkd", weights, corners[level == n]).reshape(-1, 3))
    return np.concatenate(points)


def _run_coacd(
    pieces: list[SolidPiece], bound: float, cache: Path, seed: int
) -> tuple[list[list[ConvexPart] | None], int]:
    """Returns CoACD's parts of each piece (None if it failed), and the number of results found in the cache."""
    cache.mkdir(parents=True, exist_ok=True)
    setting = {**_SEARCH, "bound": bound, "seed": seed, "faces": _MAX_COACD_FACES, "coacd": metadata.version("coacd")}
    jobs = []
    known: dict[Path, list[ConvexPart] | None] = {}
    for piece in pieces:
        shape = hashlib.sha256(piece.vertices.tobytes() + piece.faces.tobytes()).hexdigest()
        key = digest_json({**setting, "shape": shape})[:32]
        source, target = cache / f"{key}.in.npz", cache / f"{key}.npz"
        jobs.append((source, target, piece))
        if target.exists() and target not in known:
            try:
                known[target] = _read_parts(target)
            except InputError:  # a damaged file, which is computed again
                target.unlink()
    pending = [job for job in jobs if job[1] not in known]
    for source, _, piece in pending:
        np.savez(source, vertices=piece.vertices, faces=piece.faces, bound=bound, seed=seed)
    waiting = deque((source, target) for source, target, _ in sorted(pending, key=lambda job: -len(job[2].samples)))
    count = max(1, min(runtime.available_cores(), _MAX_PROCESSES, len(pending)))
    with runtime.bar("convex parts", len(pending), "piece") as bar, ThreadPoolExecutor(count) as pool:
        stopped = threading.Event()
        try:
            list(pool.map(lambda _: _run_child(waiting, bar, stopped), range(count)))
        finally:
            stopped.set()
    results: list[list[ConvexPart] | None] = []
    for source, target, _ in jobs:
        source.unlink(missing_ok=True)
        if target not in known and target.exists():
            known[target] = _read_parts(target)
        results.append(known.get(target))
    return results, len(jobs) - len(pending)


def _run_child(waiting: deque[tuple[Path, Path]], bar: runtime.tqdm, stopped: threading.Event) -> None:
    """Gives waiting jobs to a child process, until none is left, or `stopped` is set.

    A job whose child crashes or exceeds the time limit gets no result; the next job gets a new child.
    """
    child: subprocess.Popen[bytes] | None = None
    try:
        while not stopped.is_set():
            try:
                source, target = waiting.popleft()
            except IndexError:
                return
            child = child or subprocess.Popen(
                [sys.executable, "-m", "twin.assets.convex"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                process_group=0,  # terminal signals go to the parent only
                env=child_environment(OMP_NUM_THREADS="1"),
            )
            assert child.stdin
            with contextlib.suppress(BrokenPipeError):  # the child has crashed
                child.stdin.write(json.dumps([str(source), str(target)]).encode() + b"\n")
                child.stdin.flush()
            end = time.monotonic() + _TIME_LIMIT
            while not (target.exists() or child.poll() is not None or time.monotonic() > end or stopped.is_set()):
                time.sleep(_POLL)
            if not target.exists():
                _end(child)
                child = None
            bar.update()
    finally:
        if child:
            _end(child)


def _end(child: "subprocess.Popen[bytes]") -> None:
    child.kill()
    child.communicate()  # closes the pipe, too


def _read_parts(path: Path) -> list[ConvexPart] | None:
    data = load_arrays(path)
    points = np.split(data["points"], np.cumsum(data["counts"])[:-1])
    parts = [part for part in (ConvexPart.hull(p) for p in points) if part is not None]
    return parts or None


def _decompose_files(jobs: Iterable[bytes]) -> None:
    """Runs CoACD in the child process. A job is a line of JSON: the path of the input and that of its result."""
    import coacd

    coacd.set_log_level("off")
    for source, target in map(json.loads, jobs):
        data = load_arrays(Path(source))
        vertices, faces = data["vertices"], data["faces"]
        if len(faces) > _MAX_COACD_FACES:
            vertices, faces = fast_simplification.simplify(
                vertices.astype(np.float32), faces.astype(np.int32), target_count=_MAX_COACD_FACES, agg=3.0
            )[:2]
        result = coacd.run_coacd(
            coacd.Mesh(vertices, faces),
            threshold=float(data["bound"]),
            real_metric=True,
            preprocess_mode="off",  # pieces are closed
            **_SEARCH,
            max_ch_vertex=_MAX_HULL_VERTICES,
            decimate=True,
            seed=int(data["seed"]),
        )
        points = [np.asarray(v) for v, _ in result]
        save_arrays(Path(target), {"points": np.concatenate(points), "counts": np.array([len(p) for p in points])})


if __name__ == "__main__":
    die_with_parent()
    _decompose_files(sys.stdin.buffer)
