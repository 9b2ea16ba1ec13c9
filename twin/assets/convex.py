"""Closed meshes into convex parts that are checked against them.

A *piece* is one closed mesh to decompose, a *part* a closed convex hull. A part's *protrusion* is how far a point of
its surface lies outside its piece [m]; *uncovered* is the share of a piece's surface further than that bound from every
part.

CoACD (Wei et al. 2022) has crashed, grown shapes, closed doorways and answered differently at the same seed. So it runs
in child processes with one thread and a time limit, its answers are cached by what they were made from, every part is
checked, and what fails is cut in halves until it passes.
"""

import argparse
import hashlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from twin import runtime
from twin.files import digest_json
from twin.runtime import die_with_parent, environment
from twin.types import Array

_FACES = 400  # a piece is thinned to this many for CoACD, whose time grows fast with them; the check uses all of them
_TIME_LIMIT = 120.0  # [s] per piece: far more than any takes, so that a busy machine does not change the answer
_CHILDREN = 2
_MAX_CORNERS = 32  # of a part
_SAMPLING = 0.06  # [m] spacing of test points on surfaces
_MAX_UNCOVERED = 0.08
_MAX_HALVINGS = 5


@dataclass(frozen=True)
class ConvexPart:
    """A closed convex hull."""

    vertices: Array
    """Shape (v, 3) [m]."""
    faces: NDArray[np.int64]
    """Shape (f, 3), outward."""

    @staticmethod
    def hull(points: Array) -> "ConvexPart | None":
        """The hull of points (k, 3), or None where they span no volume."""
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
    """A closed mesh, with points spread over its surface."""

    vertices: Array
    faces: NDArray[np.int64]
    samples: Array
    """Shape (s, 3)."""
    tree: cKDTree
    """Of the samples."""
    inside: Callable[[Array], NDArray[np.bool_]]
    """Which points (k, 3) the mesh encloses."""

    @staticmethod
    def of(vertices: Array, faces: NDArray, inside: Callable[[Array], NDArray[np.bool_]] | None = None) -> "SolidPiece":
        """A piece; give `inside` where something knows it faster than by winding numbers."""
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
        samples = surface_samples(vertices, faces, _SAMPLING)

        def by_winding(points: Array) -> NDArray[np.bool_]:
            return winding_number(points, vertices, faces) > 0.5

        return SolidPiece(vertices, faces, samples, cKDTree(samples), inside or by_winding)

    def protrusion(self, part: ConvexPart) -> float:
        """How far the part sticks out [m]; an upper estimate, by up to half the sampling."""
        points = surface_samples(part.vertices, part.faces, 2 * _SAMPLING)
        away = self.tree.query(points)[0]
        far = np.flatnonzero(away > _SAMPLING)
        outside = far[~self.inside(points[far])]
        return float(away[outside].max(initial=0.0))


@dataclass(frozen=True)
class Decomposition:
    """What became of all pieces."""

    parts: list[ConvexPart]
    piece: NDArray[np.int64]
    """Which piece each part came from."""
    protrusion: Array
    """Of each part [m]."""
    uncovered: float
    """Share of all pieces' surfaces further than the bound from their parts."""
    failed: int
    """Pieces CoACD crashed or timed out on."""
    halved: int
    """Parts that were cut because they stuck out too far."""
    cached: int
    """Pieces whose answer was known."""


def decompose(pieces: list[SolidPiece], bound: float, cache: Path, seed: int) -> Decomposition:
    """Convex parts of closed meshes, each within `bound` [m] of its mesh.

    Args:
        pieces: Closed meshes.
        bound: Protrusion allowed [m].
        cache: Folder of earlier answers; made if absent.
        seed: CoACD's.
    """
    whole = [ConvexPart.hull(piece.vertices) for piece in pieces]
    sticks = [np.inf if hull is None else piece.protrusion(hull) for hull, piece in zip(whole, pieces, strict=True)]
    hard = [i for i, protrusion in enumerate(sticks) if protrusion > bound]
    answers, cached = _coacd([pieces[i] for i in hard], bound, cache, seed)
    found = [
        [(hull, out)] if hull is not None and out <= bound else [] for hull, out in zip(whole, sticks, strict=True)
    ]
    failed = halved = 0
    missing = 0.0
    for i, answer in zip(hard, answers, strict=True):
        hull = whole[i]
        coarse = [hull] if hull is not None else []
        fitted = [within_bound(part, pieces[i], bound) for part in answer or coarse]
        open_ = uncovered(pieces[i], [part for cut in fitted for part, _ in cut], bound)
        bad = answer is None or open_ > _MAX_UNCOVERED
        failed += bad
        if bad and answer is not None:
            fitted = [within_bound(part, pieces[i], bound) for part in coarse]
            open_ = uncovered(pieces[i], [part for cut in fitted for part, _ in cut], bound)
        halved += sum(len(cut) > 1 for cut in fitted)
        missing += open_ * len(pieces[i].samples)
        found[i] = [item for cut in fitted for item in cut]
    total = max(sum(len(piece.samples) for piece in pieces), 1)
    return Decomposition(
        [part for items in found for part, _ in items],
        np.array([i for i, items in enumerate(found) for _ in items], np.int64),
        np.array([out for items in found for _, out in items], np.float64),
        missing / total,
        failed,
        halved,
        cached,
    )


def within_bound(
    part: ConvexPart, piece: SolidPiece, bound: float, halvings: int = _MAX_HALVINGS
) -> list[tuple[ConvexPart, float]]:
    """The part and its protrusion if it fits, else those of hulls of the halves of the surface inside it, and so on."""
    sticks_out = piece.protrusion(part)
    if halvings == 0 or sticks_out <= bound:
        return [(part, sticks_out)]
    inside = piece.samples[inside_hull(part, piece.samples, 1e-3 + _SAMPLING)]
    if len(inside) < 8:
        return []
    axis = int(np.argmax(np.ptp(inside, axis=0)))
    middle = float(inside[:, axis].min() + inside[:, axis].max()) / 2
    halves = []
    for half in (inside[inside[:, axis] <= middle + _SAMPLING], inside[inside[:, axis] >= middle - _SAMPLING]):
        hull = ConvexPart.hull(half)
        if hull is not None:
            halves += within_bound(hull, piece, bound, halvings - 1)
    return halves


def inside_hull(part: ConvexPart, points: Array, slack: float = 0.0) -> NDArray[np.bool_]:
    """Which points (k, 3) are in the part, or within about `slack` [m] of it."""
    normal, offset = half_spaces(part)
    return np.all(points @ normal.T <= offset + slack, axis=1)


def half_spaces(part: ConvexPart) -> tuple[Array, Array]:
    """Outward normals (f, 3) and offsets (f,): inside is normal · x ≤ offset."""
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    solid = length > 1e-12
    normal = normal[solid] / length[solid, None]
    return normal, (normal * a[solid]).sum(1)


def uncovered(piece: SolidPiece, parts: list[ConvexPart], bound: float) -> float:
    """Share of the piece's surface further than about `bound` from every part."""
    open_ = np.ones(len(piece.samples), bool)
    for part in parts:
        open_[open_] = ~inside_hull(part, piece.samples[open_], bound)
    return float(open_.mean()) if len(open_) else 0.0


def surface_samples(vertices: Array, faces: NDArray, spacing: float) -> Array:
    """Points on every triangle about `spacing` apart, corners included; regular: the same mesh gives the same."""
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


def winding_number(points: Array, vertices: Array, faces: NDArray) -> Array:
    """How often a closed mesh winds around points (k, 3): 1 inside, 0 outside; shape (k,).

    Sum of signed solid angles over 4π (van Oosterom & Strackee 1983, eq. 8).
    """
    out = np.zeros(len(points))
    corners = vertices[faces]
    chunk = max(1, 400_000 // max(len(faces), 1))
    for start in range(0, len(points), chunk):
        a, b, c = (corners[None, :, k] - points[start : start + chunk, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
        volume = np.einsum("pfk,pfk->pf", a, np.cross(b, c))
        ab, bc, ca = ((x * y).sum(-1) for x, y in ((a, b), (b, c), (c, a)))
        out[start : start + chunk] = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(1) / (2 * np.pi)
    return out


def _coacd(pieces: list[SolidPiece], bound: float, cache: Path, seed: int) -> tuple[list[list[ConvexPart] | None], int]:
    """CoACD's parts of each piece, None where it failed, and how many were known from before."""
    cache.mkdir(parents=True, exist_ok=True)
    setting = {"bound": bound, "seed": seed, "faces": _FACES, "coacd": metadata.version("coacd")}
    jobs = []
    for piece in pieces:
        shape = hashlib.sha256(piece.vertices.tobytes() + piece.faces.tobytes()).hexdigest()
        key = digest_json({**setting, "shape": shape})[:32]
        jobs.append((cache / f"{key}.in.npz", cache / f"{key}.npz", piece))
    open_ = [job for job in jobs if not job[1].exists()]
    for source, _, piece in open_:
        np.savez(source, vertices=piece.vertices, faces=piece.faces, bound=bound, seed=seed)
    with runtime.bar("convex parts", len(open_), "piece") as bar, ThreadPoolExecutor(_CHILDREN) as pool:
        # Alternate pieces, so that both children have large and small ones.
        shares = [[(job[0], job[1]) for job in open_[k::_CHILDREN]] for k in range(_CHILDREN)]
        stopped = threading.Event()
        try:
            list(pool.map(lambda share: _work_off(share, bar, stopped), shares))
        finally:
            stopped.set()
    answers: list[list[ConvexPart] | None] = []
    for source, target, _ in jobs:
        source.unlink(missing_ok=True)
        answers.append(_read(target) if target.exists() else None)
    return answers, len(jobs) - len(open_)


def _work_off(jobs: list[tuple[Path, Path]], bar: runtime.tqdm, stopped: threading.Event) -> None:
    """Runs children until every job is done or has killed one; a job that does is given up. Ends early once stopped."""
    todo = list(jobs)
    while todo:
        command = [sys.executable, "-m", "twin.assets.convex", *(str(path) for job in todo for path in job)]
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,  # a signal to all of a terminal's is for us
            env=environment(OMP_NUM_THREADS="1"),
        )
        done, since = 0, time.monotonic()
        while child.poll() is None and time.monotonic() - since < _TIME_LIMIT and not stopped.is_set():
            if todo[done:] and todo[done][1].exists():
                done, since = done + 1, time.monotonic()
                bar.update()
            else:
                time.sleep(0.05)
        child.kill()
        child.wait()
        if stopped.is_set():
            return
        finished = sum(target.exists() for _, target in todo)
        bar.update(finished - done)
        # Jobs are done in order: the first without an answer is the one that crashed or hung.
        todo = [job for job in todo if not job[1].exists()][1:]


def _read(path: Path) -> list[ConvexPart] | None:
    with np.load(path, allow_pickle=False) as data:
        counts = data["counts"]
        points = np.split(data["points"], np.cumsum(counts)[:-1]) if len(counts) else []
    parts = [part for part in (ConvexPart.hull(p) for p in points) if part is not None]
    return parts or None


def _child(paths: list[Path]) -> None:
    """Decomposes one file after another; each answer appears under its name only when it is complete."""
    import coacd

    coacd.set_log_level("off")
    for source, target in zip(paths[::2], paths[1::2], strict=True):
        with np.load(source, allow_pickle=False) as data:
            vertices, faces = data["vertices"], data["faces"]
            bound, seed = float(data["bound"]), int(data["seed"])
        if len(faces) > _FACES:
            thin = fast_simplification.simplify(
                vertices.astype(np.float32), faces.astype(np.int32), target_count=_FACES, agg=3.0
            )
            vertices, faces = thin[0], thin[1]
        result = coacd.run_coacd(
            coacd.Mesh(vertices, faces),
            threshold=bound,
            real_metric=True,
            # The pieces are closed already, and what CoACD answers is checked: a coarse search does, 10 times sooner.
            preprocess_mode="off",
            resolution=200,
            mcts_nodes=5,
            mcts_iterations=10,
            mcts_max_depth=2,
            max_ch_vertex=_MAX_CORNERS,
            decimate=True,
            seed=seed,
        )
        points = [np.asarray(v) for v, _ in result]
        aside = target.with_suffix(".partial.npz")
        np.savez(aside, points=np.concatenate(points), counts=np.array([len(p) for p in points]))
        aside.replace(target)


if __name__ == "__main__":
    die_with_parent()
    parser = argparse.ArgumentParser(description="Child of twin.assets.convex.")
    parser.add_argument("paths", type=Path, nargs="+")
    _child(parser.parse_args().paths)
