"""The pairs of frames that are matched, and the outliers of a path."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twin.capture.matching import (
    SEQUENCE_STEPS,
    Matcher,
    expanded_pairs,
    frame_signatures,
    near_pairs,
    probe_pairs,
    sequence_pairs,
)
from twin.capture.pair_geometry import PairGeometry, PairMatches
from twin.geometry.passes import path_outliers
from twin.geometry.poses import look_at


def test_sequence_stays_within_a_source() -> None:
    source = np.array([0] * 5 + [1] * 4)
    pairs = sequence_pairs(source)
    assert (0, 1) in pairs and (0, 4) in pairs and (5, 8) in pairs
    assert all(source[i] == source[j] and i < j and j - i in SEQUENCE_STEPS for i, j in pairs)


def test_films_of_different_speeds_are_paired_at_the_same_places() -> None:
    # The second film shows at frame q what the first shows at p = q² / 40: slow first, fast later.
    source = np.array([0] * 40 + [1] * 40)
    same = {int(q * q / 40): q for q in range(40)}
    probes = {(p, 40 + q) for p, q in same.items() if p % 3 == 0} | {(5, 75)}
    inliers = dict.fromkeys(probes, 100) | {(5, 75): 3}
    pairs = expanded_pairs(source, probes, inliers, min_inliers=25)
    for p, q in same.items():
        assert any((p, 40 + q + d) in pairs for d in (-1, 0, 1)), (p, q)
    assert (5, 75) not in pairs


def test_without_anchors_films_are_paired_by_fraction_of_length() -> None:
    pairs = expanded_pairs(np.array([0] * 10 + [1] * 19), {(0, 20)}, {}, min_inliers=25)
    assert all((i, 10 + 2 * i) in pairs for i in range(10))


def test_near_cameras_that_were_never_matched_are_paired() -> None:
    # Out along x for 30 frames and back beside it, looking the same way: the ends of the film meet its start.
    out = [look_at(np.array([x, 0.0, 1]), np.array([x, 9.0, 1])) for x in range(30)]
    back = [look_at(np.array([x, 0.5, 1]), np.array([x, 9.5, 1])) for x in range(29, -1, -1)]
    away = [look_at(np.array([3.0, 0.1, 1]), np.array([3.0, -9.0, 1]))]
    poses = np.array(out + back + away)
    tried = sequence_pairs(np.zeros(61, np.int64))
    pairs = near_pairs(poses, np.arange(61), tried, reach=1.0, most=2)
    assert (2, 57) in pairs
    assert not pairs & tried
    assert not any(60 in pair for pair in pairs)  # it looks the other way


def test_signatures_find_the_same_place_under_another_light() -> None:
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 200, (80, 128)) for _ in range(8)]
    views = [
        np.clip(place[rng.permutation(80)[:60]] + shift + rng.integers(-9, 9, (60, 128)), 0, 255).astype(np.uint8)
        for shift in (0, 25)
        for place in places
    ]
    source = np.repeat([0, 1], 8)
    signatures = frame_signatures(views, source, rng)
    similarity = signatures[:8] @ signatures[8:].T
    assert np.mean(similarity.argmax(1) == np.arange(8)) >= 0.75
    probes = probe_pairs(source, signatures)
    assert sum((i, 8 + i) in probes for i in range(8)) == 8
    assert frame_signatures([np.zeros((0, 128), np.uint8)] * 3, np.zeros(3, np.int64), rng).max() == 0


def _turning_path(count: int = 50) -> np.ndarray:
    """30 m straight, then a right turn of 6 m radius, about a meter per frame, with centimeters of shake."""
    s = np.linspace(0.0, 48.0, count)
    angle = np.clip((s - 30.0) / 6.0, 0.0, np.pi / 2)
    past = np.maximum(s - 30.0 - 3.0 * np.pi, 0.0)
    eyes = np.stack(
        [np.minimum(s, 30.0) + 6.0 * np.sin(angle), -6.0 * (1 - np.cos(angle)) - past, 1.2 + 0.03 * np.sin(3 * s)], 1
    )
    ahead = np.stack([np.cos(angle), -np.sin(angle), 0 * s - 0.1], 1)
    return np.array([look_at(e, e + a) for e, a in zip(eyes, ahead, strict=True)])


def test_a_turning_path_has_no_outliers() -> None:
    assert not path_outliers(_turning_path(), 0.3).any()


def test_a_path_with_stops_and_gaps_has_no_outliers() -> None:
    path = _turning_path(100)
    kept = np.random.default_rng(1).random(100) < 0.6
    assert not path_outliers(path[kept], 0.3).any()


@pytest.mark.parametrize("frame", [0, 7, 33, 49])
def test_a_frame_beside_the_path_is_found_and_no_other(frame: int) -> None:
    path = _turning_path()
    path[frame, :3, 3] += [0.3, -0.9, 0.4]
    assert np.flatnonzero(path_outliers(path, 0.3)).tolist() == [frame]


def test_a_twisted_frame_is_found() -> None:
    path = _turning_path()
    path[20, :3, :3] = path[20, :3, :3] @ look_at(np.zeros(3), np.array([0.3, 1.0, 0.2]))[:3, :3]
    assert np.flatnonzero(path_outliers(path, 0.3)).tolist() == [20]


def test_two_outliers_side_by_side_are_found() -> None:
    path = _turning_path()
    path[20, :3, 3] += [0, 5.0, 0]
    path[21, :3, 3] += [0, -3.0, 1]
    assert np.flatnonzero(path_outliers(path, 0.3)).tolist() == [20, 21]


def test_photos_in_no_order_have_no_outliers() -> None:
    path = _turning_path()
    assert not path_outliers(path[np.random.default_rng(0).permutation(50)], 0.3).any()
    assert not path_outliers(path[:4], 0.3).any()


def test_sources_are_linked_by_pairs_that_agree_on_their_rotation_and_not_by_others() -> None:
    """Films in opposite directions have many verified pairs by chance, each with another rotation."""
    source, rng = np.repeat([0, 1, 2], 20), np.random.default_rng(0)
    turns = Rotation.random(60, rng=rng)
    sequence = [(i, i + 1) for i in range(59) if source[i] == source[i + 1]]
    consistent = [(20 + i, 40 + i) for i in range(8)]
    known = {pair: _geometry(pair, turns[pair[1]] * turns[pair[0]].inv()) for pair in sequence + consistent}
    known |= {(i, 20 + i): _geometry((i, 20 + i), Rotation.random(rng=rng)) for i in range(20)}
    capture = SimpleNamespace(source_index=source, sources=(None, None, None))
    matcher = Matcher(Path(), Path(), None, capture, np.arange(60), 1, 0, set(), np.arange(60))  # type: ignore[arg-type]
    matcher.geometries = lambda: list(known.values())  # type: ignore[method-assign]
    first, second = matcher.linked_groups()
    assert set(source[first]) == {1, 2} and set(source[second]) == {0}
    vague = known[consistent[0]]
    known[consistent[0]] = replace(vague, rotation_error=0.1)
    assert len(matcher.linked_groups()) == 3


def _geometry(pair: tuple[int, int], rotation: Rotation) -> PairGeometry:
    """Geometry without points."""
    none = np.zeros((0, 2), np.int64)
    matches = PairMatches(*pair, none, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    forward = np.array([0.0, 0.0, 1.0])
    return PairGeometry(
        matches, rotation.as_matrix(), forward, 1.0, none, np.zeros((0, 2)), np.zeros(0), 1e-3, 1e-3, 1.0
    )
