"""Frames that structure from motion placed beside the path.

A film moves smoothly: a frame's place and direction follow from its neighbours in time. A *residual* is how far a frame
is from what they say. Two predictions are made and the kinder one counts, since either alone errs on honest frames: the
chord between neighbours (blind to how evenly the film moves, but cuts corners), and the cubic through them (follows a
turn, but wants even steps).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from twin.geometry.poses import Array, rotation_angle

_MIN_FRAMES = 6
_MAX_SHARE = 0.25
"""If more than this share of a source looks wrong, it is not a smooth path, and nothing can be said."""
_ROUGH = 0.3
"""A path whose median residual is more than this share of its median step is photos in no order, not a film."""
_SPREADS = 8.0
"""A residual counts only beyond this many robust standard deviations of all residuals."""
_MAX_TURN = np.radians(5.0)  # [rad] off the neighbours, at least, before a direction counts as wrong


def path_residuals(camera_to_world: Array) -> tuple[Array, Array]:
    """How far each frame is off its neighbours' path.

    Args:
        camera_to_world: Poses of one source in time order, shape (n, 4, 4), n ≥ 5.

    Returns:
        Off in position (unit of the poses) and in direction [rad], shapes (n,).
    """
    n = len(camera_to_world)
    centres = camera_to_world[:, :3, 3]
    rotations = Rotation.from_matrix(camera_to_world[:, :3, :3])
    position, turn = np.zeros(n), np.zeros(n)
    for i in range(n):
        left, right = [k for k in (i - 1, i - 2) if k >= 0], [k for k in (i + 1, i + 2) if k < n]
        if left and right:
            chords = [_segment_distance(centres[i], centres[a], centres[b]) for a in left for b in right]
            position[i] = float(np.median(chords))
            if len(left) == len(right) == 2:  # Lagrange's cubic at the middle of five even steps
                a2, a1, b1, b2 = centres[left[1]], centres[left[0]], centres[right[0]], centres[right[1]]
                cubic = (4.0 * (a1 + b1) - (a2 + b2)) / 6.0
                position[i] = min(position[i], float(np.linalg.norm(centres[i] - cubic)))
            middle = [Slerp([a, b], Rotation.concatenate([rotations[a], rotations[b]]))(i) for a in left for b in right]
            turn[i] = min(_angle(m, rotations[i]) for m in middle)
        else:  # an end: go on along the line of the next two
            near, far = (right or left)[0], (right or left)[1]
            step = centres[near] - centres[far]
            position[i] = _segment_distance(centres[i], centres[near], centres[near] + 2.5 * step)
            same_again = rotations[near] * rotations[far].inv() * rotations[near]
            turn[i] = min(_angle(same_again, rotations[i]), _angle(rotations[near], rotations[i]))
    return position, turn


def _angle(a: Rotation, b: Rotation) -> float:
    return float(rotation_angle((a.inv() * b).as_matrix()))


def _segment_distance(point: Array, start: Array, end: Array) -> float:
    along = end - start
    share = np.clip((point - start) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
    return float(np.linalg.norm(point - start - share * along))


def path_outliers(camera_to_world: Array, limit: float) -> NDArray[np.bool_]:
    """Frames off their neighbours' path; found worst first, each judged without those found before.

    Args:
        camera_to_world: Poses of one source in time order, shape (n, 4, 4).
        limit: Allowed offset [median steps between frames]; more is allowed where the whole path is rough.

    Returns:
        True for outliers, shape (n,); all false for fewer than 6 frames, or where the path is not smooth at all.
    """
    n = len(camera_to_world)
    out = np.zeros(n, bool)
    if n < _MIN_FRAMES:
        return out
    step = float(np.median(np.linalg.norm(np.diff(camera_to_world[:, :3, 3], axis=0), axis=1)))
    position, turn = path_residuals(camera_to_world)
    if np.median(position) > _ROUGH * step:
        return out
    max_offset = max(limit * step, _SPREADS * _spread(position), 1e-12)
    max_turn = max(_MAX_TURN, _SPREADS * _spread(turn))
    while True:
        kept = np.flatnonzero(~out)
        if len(kept) < _MIN_FRAMES:
            return np.zeros(n, bool)
        position, turn = path_residuals(camera_to_world[kept])
        score = np.maximum(position / max_offset, turn / max_turn)
        worst = int(np.argmax(score))
        if score[worst] <= 1.0:
            return out
        # An outlier spoils its neighbours' predictions too: it goes only if the others then agree better.
        candidates = [k for k in range(max(worst - 2, 0), min(worst + 3, len(kept))) if score[k] > 0.5]
        out[kept[min(candidates, key=lambda k: _score_without(camera_to_world[kept], k, max_offset, max_turn))]] = True
        if out.sum() > _MAX_SHARE * n:
            return np.zeros(n, bool)


def _score_without(poses: Array, k: int, max_offset: float, max_turn: float) -> float:
    lo, hi = max(k - 5, 0), min(k + 6, len(poses))
    local = np.delete(poses[lo:hi], k - lo, axis=0)
    if len(local) < 3:
        return np.inf
    position, turn = path_residuals(local)
    return float(np.sum(np.maximum(position / max_offset, turn / max_turn)))


def _spread(values: Array) -> float:
    """Robust standard deviation about zero of non-negative residuals."""
    return 1.4826 * float(np.median(values))
