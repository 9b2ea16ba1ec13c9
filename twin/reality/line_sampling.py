"""Samples the driven line of a place: straights and bends in plan, grades, unevenness and side roads.

A *lengthened* line begins with the sampled one and goes on with further elements of the same kinds.
"""

from dataclasses import replace

import numpy as np

from twin.reality.place_spec import GRADE_STEP, LONGEST_DRAWN, RUN_IN, RUN_OUT, LineSpec, Mouth, Piece, SectionSpec
from twin.types import Array

_SEPARATION = 28.0  # [m] least distance in plan of points that are more than twice this far apart along the line
_LONG_SEPARATION = 30.0  # [m] the same between a point of the lengthening and any other
# Headings this close to one direction make 60 m along the line at least 30 m in plan, hence `_LONG_SEPARATION`.
_HEADING_BOUND = float(np.deg2rad(58.0))  # [rad]
_BEND_ROOM = 2.0  # [m] least distance from a verge's outer edge to the center of a bend of the lengthening
_MOUTH_ROOM = 30.0  # [m] from the road's edge; there, a side road of the lengthening is far from the rest of the road


def sample_line(rng: np.random.Generator, setting: str, section: SectionSpec) -> LineSpec:
    """Samples the driven line of a place with a setting and a cross section."""
    length = float(rng.uniform(42.0, LONGEST_DRAWN))
    while True:  # until no part of the line comes near another
        pieces = _pieces(rng, setting, section, length + RUN_OUT)
        if _keeps_clear(pieces):
            break
    hilly = rng.random() < 0.65
    count = int(np.ceil((length + RUN_OUT) / GRADE_STEP)) + 1
    steepest = float(rng.uniform(0.02, 0.08)) * hilly
    base = rng.normal(0.0, 1.0, count) + rng.normal(0.0, 1.2)
    grades = steepest * np.clip(base / 1.5, -1.0, 1.0)
    bumps = float(rng.uniform(0.003, 0.012))
    mouths: list[Mouth] = []
    stations = np.cumsum([0.0, *(piece.length for piece in pieces)])
    for piece, start in zip(pieces, stations, strict=False):
        width, side = float(rng.uniform(2.8, 6.0)), int(rng.choice([-1, 1]))
        offset, wanted = float(rng.uniform(0.0, 1.0)), rng.random() < (0.25 if setting in ("forest", "field") else 0.5)
        room = min(piece.length, length - float(start)) - width - 4.0
        if piece.curvature == 0.0 and wanted and room > 0.0 and len(mouths) < 2:
            mouths.append(Mouth(round(float(start) + 2.0 + width / 2 + offset * room, 2), side, width))
    relief = float(rng.uniform(0.0, 0.35 if setting in ("town", "works") else 1.4))
    return LineSpec(pieces, round(length, 2), tuple(grades.tolist()), bumps, tuple(mouths), relief)


def _pieces(rng: np.random.Generator, setting: str, section: SectionSpec, length: float) -> tuple[Piece, ...]:
    """Straights and bends of a total length of at least `length` [m]; bends in a row turn to alternate sides."""
    pieces: list[Piece] = []
    bendy = {"town": 0.6, "works": 0.6}.get(setting, 1.0)
    straight = rng.random() < 0.75
    left = bool(rng.random() < 0.5)
    total = 0.0
    while total < length:
        if straight:
            piece = Piece(float(rng.uniform(6.0, 34.0)), 0.0)
        else:
            least = max(6.0, (section.left if left else section.right) + section.kerb_width + 2.2)
            radius = float(np.exp(rng.uniform(np.log(least), np.log(40.0))))
            angle = np.deg2rad(rng.uniform(20.0, 100.0)) * bendy
            piece = Piece(min(radius * float(angle), 45.0), (1.0 if left else -1.0) / radius)
        last = straight
        straight = rng.random() < 0.55 if not last else False  # no two straights in a row
        if not last:
            left = not left if not straight else bool(rng.random() < 0.5)
        pieces.append(piece)
        total += piece.length
    return tuple(pieces)


def lengthen(rng: np.random.Generator, line: LineSpec, setting: str, section: SectionSpec, length: float) -> LineSpec:
    """The line, lengthened to `length` [m].

    `section` is the section that the line's tightest bends leave; further bends leave it, too.
    """
    while True:  # until no part of the line comes near another
        pieces = _further(rng, line.pieces, setting, section, length + RUN_OUT)
        if _keeps_clear((Piece(RUN_IN, 0.0), *pieces), _LONG_SEPARATION, len(line.pieces) + 1):
            break
    count = int(np.ceil((length + RUN_OUT) / GRADE_STEP)) + 1 - len(line.grades)
    steepest = max(map(abs, line.grades))
    grades = steepest * np.clip(rng.normal(0.0, 1.0, max(count, 0)) / 1.5, -1.0, 1.0)
    xy = _points(pieces)[0]
    mouths = list(line.mouths)
    starts = np.cumsum([0.0, *(piece.length for piece in pieces)]).tolist()
    begins = np.cumsum([0, *(_point_count(piece) for piece in pieces)]).tolist()
    for n in range(len(line.pieces), len(pieces)):
        piece, start = pieces[n], starts[n]
        width, side = float(rng.uniform(2.8, 6.0)), int(rng.choice([-1, 1]))
        offset, wanted = float(rng.uniform(0.0, 1.0)), rng.random() < (0.25 if setting in ("forest", "field") else 0.5)
        room = min(piece.length, length - start) - width - 4.0
        if piece.curvature != 0.0 or not wanted or room <= 0.0:
            continue
        mouth = Mouth(round(start + 2.0 + width / 2 + offset * room, 2), side, width)
        begin = xy[begins[n] - 1]
        ahead = (xy[begins[n]] - begin) / np.linalg.norm(xy[begins[n]] - begin)
        reach = (section.left if side > 0 else section.right) + _MOUTH_ROOM
        end = begin + (mouth.station - start) * ahead + side * reach * np.array([-ahead[1], ahead[0]])
        if np.linalg.norm(xy - end, axis=1).min() > 0.5 * reach:
            mouths.append(mouth)
    return replace(
        line, pieces=pieces, length=round(length, 2), grades=(*line.grades, *grades.tolist()), mouths=tuple(mouths)
    )


def _further(
    rng: np.random.Generator, pieces: tuple[Piece, ...], setting: str, section: SectionSpec, length: float
) -> tuple[Piece, ...]:
    """The pieces and further ones, up to a total length of at least `length` [m].

    The headings of the further pieces stay near the direction from the line's start to the end of `pieces`, so the line
    does not come back.
    """
    xy, heading = _points(pieces)
    away = xy[-1] - xy[0]
    off = float(np.angle(np.exp(1j * (heading - np.arctan2(away[1], away[0])))))  # heading from that direction [rad]
    bendy = {"town": 0.6, "works": 0.6}.get(setting, 1.0)
    out, total = list(pieces), sum(piece.length for piece in pieces)
    straight = pieces[-1].curvature != 0.0 and rng.random() < 0.55
    left = pieces[-1].curvature < 0.0 if pieces[-1].curvature else bool(rng.random() < 0.5)
    while total < length:
        if straight:
            out.append(Piece(float(rng.uniform(6.0, 34.0)), 0.0))
            straight, left = False, bool(rng.random() < 0.5)
        else:
            angle = float(np.deg2rad(rng.uniform(20.0, 100.0))) * bendy
            if abs(off + (angle if left else -angle)) > _HEADING_BOUND:
                left = off < 0.0
                angle = min(angle, _HEADING_BOUND + abs(off))
            k = 0 if left else 1
            edge = (section.left, section.right)[k] + section.kerb_width
            least = max(6.0, edge + 2.2, edge + section.sides[k].width + _BEND_ROOM)
            radius = float(np.exp(rng.uniform(np.log(least), np.log(40.0))))
            angle = min(angle, 45.0 / radius)
            out.append(Piece(radius * angle, (1.0 if left else -1.0) / radius))
            off += angle if left else -angle
            straight, left = bool(rng.random() < 0.55), not left
        total += out[-1].length
    return tuple(out)


def _keeps_clear(pieces: tuple[Piece, ...], separation: float = _SEPARATION, first: int = 0) -> bool:
    """True if points more than 2 `separation` [m] apart along the line are more than `separation` apart in plan.

    Pairs of points on the pieces before number `first` are not examined.
    """
    xy, _ = _points(pieces)
    old = sum(_point_count(piece) for piece in pieces[:first])
    for k in range(old, len(xy)):
        before = xy[: max(0, k - int(2.0 * separation))]
        if len(before) and np.linalg.norm(before - xy[k], axis=1).min() <= separation:
            return False
    return True


def _point_count(piece: Piece) -> int:
    return max(1, round(piece.length))


def _points(pieces: tuple[Piece, ...]) -> tuple[Array, float]:
    """Points along the pieces about 1 m apart, from the end of the first meter on [m], and the last heading [rad]."""
    heading, point, points = 0.0, np.zeros(2), []
    for piece in pieces:
        count = _point_count(piece)
        for _ in range(count):
            heading += 0.5 * piece.curvature * piece.length / count
            point = point + piece.length / count * np.array([np.cos(heading), np.sin(heading)])
            heading += 0.5 * piece.curvature * piece.length / count
            points.append(point)
    return np.array(points), heading
