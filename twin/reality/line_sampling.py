"""Samples the driven line of a place: straights and bends in plan, grades, unevenness and side roads."""

import numpy as np

from twin.reality.place_spec import GRADE_STEP, RUN_OUT, LineSpec, Mouth, Piece, SectionSpec

_SEPARATION = 28.0  # [m] least distance in plan of points that are more than twice this far apart along the line


def sample_line(rng: np.random.Generator, setting: str, section: SectionSpec) -> LineSpec:
    """Samples the driven line of a place with a setting and a cross section."""
    length = float(rng.uniform(42.0, 85.0))
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


def _keeps_clear(pieces: tuple[Piece, ...]) -> bool:
    """True if points more than 2 `_SEPARATION` apart along the line are more than `_SEPARATION` apart in plan."""
    heading, point, points = 0.0, np.zeros(2), []
    for piece in pieces:
        count = max(1, round(piece.length))
        for _ in range(count):
            heading += 0.5 * piece.curvature * piece.length / count
            point = point + piece.length / count * np.array([np.cos(heading), np.sin(heading)])
            heading += 0.5 * piece.curvature * piece.length / count
            points.append(point)
    xy = np.array(points)
    apart = np.abs(np.subtract.outer(np.arange(len(xy)), np.arange(len(xy)))) > 2.0 * _SEPARATION
    distance = np.linalg.norm(xy[:, None] - xy[None], axis=-1)
    return bool((distance[apart] > _SEPARATION).all())
