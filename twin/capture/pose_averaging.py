"""Camera poses of all frames from the relative poses of pairs, and a check of any poses against these.

Rotations are averaged first. The unit of length of a pair is the distance of its two cameras. Two pairs with a common
frame that see the same near points there have known relative units, so the units of all pairs follow, and then the
positions (as in Cui and Tan 2015). Far points affect rotations alone. Each of the three steps solves equations of
differences, x[first] − x[second] = value, under a Cauchy loss, and starts from the tree of the most reliable equations.

The check compares the poses of a model, or given ones, with pairs of near frames. A *step* leads from a frame of a film
to the next one that has a pose. Each pair of frames that are at most `_REACH` steps apart gives the turn of the camera
and the direction of its motion; this supports or contradicts the steps between them, and both frames. Two pairs that
meet in a frame and see the same near points give the ratio of their lengths; this supports or contradicts the step that
begins there. Reprojection errors do not reveal wrong poses: the pieces of a film that was torn apart have small ones.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags, eye
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from twin.capture.pair_geometry import Pair, PairGeometry, ordered_pair, with_rotation
from twin.geometry.poses import pose_of
from twin.types import Array

_OUTLIER = 3.0  # [standard deviations] scale of the Cauchy loss
_STEPS = 50  # largest number of steps of a solution
_MIN_ROTATION_ERROR = np.radians(0.02)  # standard deviation of a pair's rotation, at least
_MAX_ROTATION_RESIDUAL = np.radians(0.5)  # pairs that deviate more from the averaged rotations are left out
_STRAIGHT = 0.7  # |sum of the steps between two frames| / their number; above this, the film is straight there
_MAX_PATH_ANGLE = np.radians(30.0)  # largest angle between the direction of two frames and that of the steps between
_MIN_SCALE_ERROR = 0.004  # standard deviation of the logarithm of a ratio of units, at least
_MIN_DIRECTION_ERROR = 0.015  # [rad] standard deviation of the direction between two cameras, at least
_MIN_NEAR = 8  # least number of near points of a pair whose unit of length is used
_SHARED = 4  # least number of near points in common of two pairs
_WRONG = 4.0  # [standard deviations] an equation with a larger residual is wrong
_WRONG_FRACTION = 0.5  # a pair with a larger fraction of wrong equations is left out
_OTHER_FILM_STEPS = 10  # [frames] pairs of two films are as reliable as those of frames so far apart in one film


@dataclass(frozen=True)
class Differences:
    """Equations x[first] − x[second] = value for unknowns x (n, ...)."""

    first: NDArray[np.int64]  # (m,)
    second: NDArray[np.int64]  # (m,)
    value: Array  # (m, k)
    error: Array  # (m,) standard deviation of a value
    cost: Array  # (m,) unreliability; the first guess follows the tree with the smallest sum


def averaged_poses(
    pairs: list[PairGeometry], row_of: dict[int, int], film: NDArray[np.int64], seed: int
) -> tuple[NDArray[np.int64], Array]:
    """Frames (k,) whose poses are determined together, and their camera_to_world (k, 4, 4) in any unit of length.

    `row_of` maps COLMAP's images to frames; `film` (n,) is the film of each frame, whose frames are in the order of
    time; `seed` chooses random matches.
    """
    if not pairs:
        return np.zeros(0, np.int64), np.zeros((0, 4, 4))
    first, second, cost = _ends(pairs, row_of, film)
    rotations, residual = _average_rotations(pairs, first, second, cost, len(film))
    pairs = list(pairs)
    for k, pair in enumerate(pairs):
        if not _is_consistent(pair, residual[k]):  # two poses may explain the matches about equally well
            pairs[k] = with_rotation(pair, rotations[second[k]] @ rotations[first[k]].T, seed) or pair
    cost = _ends(pairs, row_of, film)[2]
    rotations, residual = _average_rotations(pairs, first, second, cost, len(film))
    directions = np.stack([-rotations[j].T @ pair.translation for j, pair in zip(second, pairs, strict=True)])
    along = _goes_along(first, second, directions, film)
    consistent = [k for k, pair in enumerate(pairs) if along[k] and _is_consistent(pair, residual[k])]
    usable = [k for k in consistent if len(pairs[k].features) >= _MIN_NEAR]
    scaled, units = _units([pairs[k] for k in usable], cost[usable])
    kept = np.array(usable, np.int64)[scaled]
    if not len(kept):
        return np.zeros(0, np.int64), np.zeros((0, 4, 4))
    units /= np.median(units)
    errors = np.array([max(pairs[k].direction_error, _MIN_DIRECTION_ERROR) for k in kept]) * units
    frames, positions, _ = solve_differences(
        Differences(second[kept], first[kept], units[:, None] * directions[kept], errors, cost[kept]), len(film)
    )
    return frames, pose_of(np.swapaxes(rotations[frames], 1, 2), positions[frames])


def _goes_along(
    first: NDArray[np.int64], second: NDArray[np.int64], directions: Array, film: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """False for pairs (m,) of a film whose direction contradicts those of the successive frames between.

    Distant frames may match by a repeated pattern, and then have a wrong direction with many near points.
    """
    step = np.zeros((len(film), 3))  # direction from each frame to the next one of its film
    for i, j, direction in zip(first, second, directions, strict=True):
        if film[i] == film[j] and abs(i - j) == 1:
            step[min(i, j)] = direction if i < j else -direction
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
    expected = path[second] - path[first]
    length = np.linalg.norm(expected, axis=1)
    # The direction is unknown if a film turns or stands still between two frames.
    known = (film[first] == film[second]) & (length > _STRAIGHT * np.abs(second - first))
    return ~known | ((expected * directions).sum(1) > np.cos(_MAX_PATH_ANGLE) * length)


def consistent_pairs(
    pairs: list[PairGeometry], row_of: dict[int, int], film: NDArray[np.int64]
) -> list[tuple[int, int]]:
    """Frames of the pairs whose rotations are certain and agree with the averaged ones.

    Arguments as for `averaged_poses`.
    """
    if not pairs:
        return []
    first, second, cost = _ends(pairs, row_of, film)
    residual = _average_rotations(pairs, first, second, cost, len(film))[1]
    return [
        (int(i), int(j))
        for pair, i, j, off in zip(pairs, first, second, residual, strict=True)
        if max(pair.rotation_error, float(off)) < _MAX_ROTATION_RESIDUAL
    ]


def _ends(
    pairs: list[PairGeometry], row_of: dict[int, int], film: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Both frames of each pair, and its unreliability."""
    first = np.array([row_of[pair.matches.first] for pair in pairs], np.int64)
    second = np.array([row_of[pair.matches.second] for pair in pairs], np.int64)
    steps = np.where(film[first] == film[second], np.abs(first - second), _OTHER_FILM_STEPS)
    support = np.array([max(len(pair.features), 1) * max(pair.agreeing, 0.1) ** 4 for pair in pairs])
    return first, second, steps / support


def _is_consistent(pair: PairGeometry, residual: float) -> bool:
    return residual < max(_MAX_ROTATION_RESIDUAL, 3 * pair.rotation_error)


def _average_rotations(
    pairs: list[PairGeometry], first: NDArray[np.int64], second: NDArray[np.int64], cost: Array, count: int
) -> tuple[Array, Array]:
    """Rotations (count, 3, 3) from world to camera, and the deviation (m,) [rad] of each pair.

    Each connected part has its own world. Chatterjee and Govindu (2013).
    """
    relative = np.array([pair.rotation for pair in pairs])
    rotations = np.tile(np.eye(3), (count, 1, 1))
    for k, known, fresh in _forest(first, second, cost, count)[0]:
        turn = relative[k] if fresh == second[k] else relative[k].T
        rotations[fresh] = turn @ rotations[known]
    error = np.array([max(pair.rotation_error, _MIN_ROTATION_ERROR) for pair in pairs])
    system = _matrix(second, first, count)

    def deviations() -> Array:
        """In world coordinates, (m, 3) [rad]."""
        turns = np.swapaxes(rotations[second], 1, 2) @ relative @ rotations[first]
        return Rotation.from_matrix(turns).as_rotvec()

    for _ in range(_STEPS):
        step = _weighted_step(system, deviations(), error)
        rotations = rotations @ Rotation.from_rotvec(step).as_matrix()
        if np.abs(step).max() < 1e-7:
            break
    return rotations, np.linalg.norm(deviations(), axis=1)


def _units(pairs: list[PairGeometry], cost: Array) -> tuple[NDArray[np.int64], Array]:
    """Pairs (k,) whose units of length are known relative to each other, and these units (k,)."""
    equations, count = unit_equations(pairs), len(pairs)
    if not equations:
        return np.zeros(0, np.int64), np.zeros(0)
    first, second = (np.array([one[k] for one in equations], np.int64) for k in (0, 1))
    value, error, shared = (np.array([one[k] for one in equations], np.float64) for k in (2, 3, 4))
    solved, logarithms, residual = solve_differences(
        Differences(first, second, value[:, None], error, (cost[first] + cost[second]) / shared), count
    )
    wrong = (residual > _WRONG * error).astype(np.float64)
    used = np.isfinite(residual)
    ends = np.concatenate([first[used], second[used]])
    total = np.maximum(np.bincount(ends, minlength=count), 1)
    bad = np.bincount(ends, np.tile(wrong[used], 2), minlength=count) / total
    good = solved[bad[solved] < _WRONG_FRACTION]
    return good, np.exp(logarithms[good, 0])


def unit_equations(pairs: list[PairGeometry]) -> list[tuple[int, int, float, float, int]]:
    """For pairs with near points in common: both pairs, the difference of the logarithms of their units, its standard
    deviation, and the number of points."""
    at: dict[int, list[tuple[int, int]]] = {}
    for k, pair in enumerate(pairs):
        at.setdefault(pair.matches.first, []).append((k, 0))
        at.setdefault(pair.matches.second, []).append((k, 1))
    equations: list[tuple[int, int, float, float, int]] = []
    for views in at.values():
        count = 1 + max(int(pairs[k].features[:, side].max()) for k, side in views)
        depth, variance = np.full((2, len(views), count), np.nan)
        for row, (k, side) in enumerate(views):
            feature = pairs[k].features[:, side]
            depth[row, feature] = np.log(pairs[k].depths[:, side])
            variance[row, feature] = pairs[k].depth_error ** 2
        known = np.isfinite(depth)
        shared = known.astype(np.int32) @ known.T.astype(np.int32)
        for i, j in np.argwhere(np.triu(shared >= _SHARED, 1)):
            both = known[i] & known[j]
            ratio, spread = depth[j, both] - depth[i, both], variance[i, both] + variance[j, both]
            middle = _weighted_median(ratio, 1 / spread)
            scatter = max(1.4826 * float(np.median(np.abs(ratio - middle))), float(1 / np.sqrt(np.mean(1 / spread))))
            error = max(1.25 * scatter / np.sqrt(len(ratio)), _MIN_SCALE_ERROR)
            equations.append((views[i][0], views[j][0], middle, error, len(ratio)))
    return equations


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, cumulative[-1] / 2)])


# ---- equations of differences


def solve_differences(equations: Differences, count: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Solves for the unknowns that are connected by equations, if there are several parts for those of the largest.

    Returns the solved unknowns' numbers (k,), all unknowns (count, ...), and the residuals (m,), NaN if not used.
    """
    first, second = equations.first, equations.second
    solution = np.zeros((count, equations.value.shape[1]))
    edges, part = _forest(first, second, equations.cost, count)
    for k, known, fresh in edges:
        solution[fresh] = solution[known] + (equations.value[k] if fresh == first[k] else -equations.value[k])
    largest = part == np.bincount(part).argmax()
    inside = largest[first]
    system, value = _matrix(first[inside], second[inside], count), equations.value[inside]
    error = equations.error[inside]
    for _ in range(_STEPS):
        step = _weighted_step(system, value - system @ solution, error)
        solution = solution + step
        if np.abs(step).max() < 1e-8:
            break
    residual = np.full(len(first), np.nan)
    residual[inside] = np.linalg.norm(value - system @ solution, axis=1)
    return np.flatnonzero(largest), solution, residual


def _forest(
    first: NDArray[np.int64], second: NDArray[np.int64], cost: Array, count: int
) -> tuple[list[tuple[int, int, int]], NDArray[np.int64]]:
    """The cheapest tree of each connected part, and the part of each node (count,).

    Edges come in order from the roots: edge, known node and fresh node.
    """
    best: dict[tuple[int, int], int] = {}
    for k in np.argsort(-cost).tolist():
        ends = int(first[k]), int(second[k])
        best[ends] = best[ends[::-1]] = k
    chosen = sorted(set(best.values()))
    graph = csr_matrix((cost[chosen], (first[chosen], second[chosen])), shape=(count, count))
    part = connected_components(graph, directed=False)[1].astype(np.int64)
    trees, edges = minimum_spanning_tree(graph), []
    for root in np.unique(part, return_index=True)[1].tolist():
        order, before = breadth_first_order(trees, root, directed=False)
        edges += [(best[int(before[node]), int(node)], int(before[node]), int(node)) for node in order[1:]]
    return edges, part


def _matrix(plus: NDArray[np.int64], minus: NDArray[np.int64], count: int) -> csr_matrix:
    row = np.arange(len(plus))
    ones = np.ones(len(plus))
    entries = np.concatenate([ones, -ones]), (np.tile(row, 2), np.concatenate([plus, minus]))
    return coo_matrix(entries, shape=(len(plus), count)).tocsr()


def _weighted_step(system: csr_matrix, residual: Array, error: Array) -> Array:
    """Step (n, k) of iteratively reweighted least squares; zero for unknowns without an equation."""
    relative = np.linalg.norm(residual, axis=1) / (_OUTLIER * error)
    weight = 1 / (error**2 * (1 + relative**2))
    normal = system.T @ diags(weight) @ system
    free = 1e-9 * normal.diagonal().max()  # the mean of a part is undetermined
    step = spsolve((normal + free * eye(system.shape[1])).tocsc(), system.T @ (weight[:, None] * residual))
    return np.reshape(step, (system.shape[1], -1))


# ---- check of poses

_REACH = 3  # [steps] largest distance between the frames of a pair that is used
_MAX_TURN = np.radians(1.0)  # deviation from a pair's rotation that contradicts it, at least
_MAX_DIRECTION = np.radians(10.0)  # deviation from a pair's direction that contradicts it, at least
_MAX_RATIO = 0.25  # deviation of the logarithm of a ratio of two distances that contradicts it, at least
_CERTAIN = 4.0  # [standard deviations] smaller deviations contradict nothing
_STILL = 0.2  # [median step] cameras that are nearer to each other have no direction
# A pair of frames some steps apart is left out if it deviates more from the pairs between, in turn or in direction.
_MAX_CHAIN_TURN, _MAX_CHAIN_ANGLE = np.radians(2.0), np.radians(60.0)
# A pair determines a direction and a ratio of distances only with `_MIN_NEAR` near points, at most so far away (median,
# in distances of its cameras). With less parallax, moving things and a rolling shutter decide.
_MAX_DEPTH = 30.0


@dataclass(frozen=True)
class PoseCheck:
    """Steps of films that pairs of frames support or contradict."""

    steps: int  # number of steps that were checked
    contradicted: list[tuple[int, int]]  # both frames of each step that most pairs contradict


def near_in_film(film: NDArray[np.int64], frames: NDArray[np.int64]) -> set[Pair]:
    """The pairs of frames that `check_poses` uses: at most `_REACH` steps apart in a film. Arguments as there."""
    within = [frames[film[frames] == one].tolist() for one in np.unique(film[frames])]
    return {pair for one in within for k in range(1, _REACH + 1) for pair in zip(one[:-k], one[k:], strict=True)}


def check_poses(
    pairs: list[PairGeometry],
    row_of: dict[int, int],
    film: NDArray[np.int64],
    frames: NDArray[np.int64],
    camera_to_world: Array,
) -> PoseCheck:
    """Compares the poses (k, 4, 4), in any unit of length, of sorted frames (k,) with the geometry of pairs.

    For `row_of` and `film` see `averaged_poses`.
    """
    near = near_in_film(film, frames)
    place = {int(frame): k for k, frame in enumerate(frames)}
    used, ends = [], []  # pairs, and both ends as indices of poses
    for pair in pairs:
        first, second = row_of[pair.matches.first], row_of[pair.matches.second]
        if ordered_pair(first, second) in near:
            used.append(pair)
            ends.append((place[first], place[second]))
    agreeing = _agree_with_chains(used, ends)
    used, ends = [used[k] for k in agreeing], [ends[k] for k in agreeing]
    if not used:
        return PoseCheck(0, [])
    # Supports and contradictions: of steps, by the frames where they begin, by turns and directions, and by ratios; and
    # of frames, by the pairs that end in them.
    votes = np.zeros((3, len(frames), 2), np.int64)
    position = camera_to_world[:, :3, 3]
    same = film[frames[1:]] == film[frames[:-1]]
    step = float(np.median(np.linalg.norm(np.diff(position, axis=0), axis=1)[same]))
    distance = np.array([np.linalg.norm(position[j] - position[i]) for i, j in ends])
    for (i, j), pair, apart in zip(ends, used, distance, strict=True):
        relative = camera_to_world[j, :3, :3].T @ camera_to_world[i, :3, :3]
        turn = float(Rotation.from_matrix(pair.rotation.T @ relative).magnitude())
        wrong = turn > max(_MAX_TURN, _CERTAIN * pair.rotation_error)
        if apart > _STILL * step and _has_parallax(pair):
            direction = camera_to_world[j, :3, :3].T @ (position[i] - position[j]) / apart
            angle = float(np.arccos(np.clip(direction @ pair.translation, -1.0, 1.0)))
            wrong = wrong or angle > max(_MAX_DIRECTION, _CERTAIN * pair.direction_error)
        votes[0, min(i, j) : max(i, j), int(wrong)] += 1
        votes[2, [i, j], int(wrong)] += 1
    scaled = [k for k, pair in enumerate(used) if _has_parallax(pair)]
    for first, second, ratio, error, _ in unit_equations([used[k] for k in scaled]):
        one, other = scaled[first], scaled[second]
        # Where the scale changes, the pairs on both sides of a frame contradict each other; other pairs lie across.
        before, after = sorted([sorted(ends[one]), sorted(ends[other])])
        if before[1] == after[0] and max(distance[one], distance[other]) > _STILL * step:
            found = np.log(max(distance[one], 1e-12) / max(distance[other], 1e-12))
            votes[1, after[0], int(abs(found - ratio) > max(_MAX_RATIO, _CERTAIN * error))] += 1
    checked = votes[:2].sum((0, 2)) > 0
    torn, misplaced = (votes[:2, :, 1] > votes[:2, :, 0]).any(0), votes[2, :, 1] > votes[2, :, 0]
    torn |= checked & (misplaced | np.roll(misplaced, -1))  # the steps to and from a misplaced frame
    contradicted = [(int(frames[k]), int(frames[k + 1])) for k in np.flatnonzero(torn)]
    return PoseCheck(int(np.count_nonzero(checked)), contradicted)


def _agree_with_chains(pairs: list[PairGeometry], ends: list[tuple[int, int]]) -> list[int]:
    """Indices of the pairs that agree with those of the successive frames between them, where these are known.

    Frames that are some steps apart may match by a repeated pattern, such as a row of houses or paving stones.
    """
    successive: dict[int, PairGeometry] = {i: p for (i, j), p in zip(ends, pairs, strict=True) if j == i + 1}
    kept = []
    for k, ((i, j), pair) in enumerate(zip(ends, pairs, strict=True)):
        rotation, path = np.eye(3), np.zeros(3)  # from frame i; the path in its coordinates, if all steps are as long
        chain = [successive.get(step) for step in range(i, j)]
        for one in chain:
            if one is not None:
                path = path - rotation.T @ one.rotation.T @ one.translation
                rotation = one.rotation @ rotation
        direction = -pair.rotation.T @ pair.translation
        turn = Rotation.from_matrix(pair.rotation @ rotation.T).magnitude()
        agrees = turn < _MAX_CHAIN_TURN and direction @ path > np.cos(_MAX_CHAIN_ANGLE) * np.linalg.norm(path)
        if j <= i + 1 or None in chain or agrees or not _has_parallax(pair):
            kept.append(k)
    return kept


def _has_parallax(pair: PairGeometry) -> bool:
    return len(pair.features) >= _MIN_NEAR and float(np.median(pair.depths)) <= _MAX_DEPTH
