"""Checks camera poses against the relative poses of pairs of near frames of a film.

A *step* leads from a frame of a film to the next one that has a pose. Each pair of frames that are at most `_REACH`
steps apart tells how much the camera turned and in which direction it moved; this supports or contradicts the steps
between them, and both frames. Two pairs that meet in a frame and see the same near points tell the ratio of their
lengths; this supports or contradicts the step that begins there. Reprojection errors do not reveal wrong poses: the
pieces of a film that was torn apart have small ones.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from twin.capture.matching import Pair, ordered_pair
from twin.capture.pair_geometry import PairGeometry
from twin.capture.pose_averaging import unit_equations
from twin.types import Array

_REACH = 3  # [steps] largest distance between the frames of a pair that is used
_MAX_TURN = np.radians(1.0)  # deviation from a pair's rotation that contradicts it, at least
_MAX_DIRECTION = np.radians(10.0)  # deviation from a pair's direction that contradicts it, at least
_MAX_RATIO = 0.25  # deviation of the logarithm of a ratio of two distances that contradicts it, at least
_CERTAIN = 4.0  # [standard deviations] smaller deviations contradict nothing
_STILL = 0.2  # [median step] cameras that are nearer to each other have no direction
# A pair of frames some steps apart is left out if it deviates more from the pairs between, in turn or in direction.
_MAX_CHAIN_TURN, _MAX_CHAIN_ANGLE = np.radians(2.0), np.radians(60.0)
# A pair tells a direction and a ratio of distances only with so many near points, at most so far away (median, in
# distances of its cameras). With less parallax, moving things and a rolling shutter decide.
_MIN_NEAR, _MAX_DEPTH = 8, 30.0


@dataclass(frozen=True)
class PoseCheck:
    """Steps of films that pairs of frames tell about."""

    steps: int
    """Number of steps that were checked."""
    contradicted: list[tuple[int, int]]
    """Both frames of each step that most pairs contradict."""


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
    """Compares poses with the geometry of pairs.

    Args:
        pairs: Pairs with geometry.
        row_of: Frame of each of COLMAP's images.
        film: Film of each frame (n,), whose frames are in the order of time.
        frames: Frames with a pose (k,), sorted.
        camera_to_world: Their poses (k, 4, 4), in any unit of length.
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
    return PoseCheck(
        int(np.count_nonzero(checked)), [(int(frames[k]), int(frames[k + 1])) for k in np.flatnonzero(torn)]
    )


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
