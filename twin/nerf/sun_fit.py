"""Fit of a sun to a photo: a search over directions, then a joint fit with the appearance embedding and the fog.

A *base* is the picture of the field under one embedding. The photo is compared with each of several bases times the
sun's gain (`sun.py`). For one base and one direction, the gain's coefficients are a linear least squares problem, so
hundreds of directions can be tried. The best base and direction are the start of a gradient descent on coefficients,
embedding and fog.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from twin import runtime
from twin.geometry.images import psnr
from twin.geometry.shadow_map import TEXEL, OrthographicShadowMap, ShadowCasters, angles, direction
from twin.nerf import network
from twin.nerf.appearance import FogFit, descend
from twin.nerf.lightings import FOG_REACH, Fog
from twin.nerf.sun import MAX_GAIN, MIN_GAIN, TERMS, SeenSurfaces, Sun
from twin.types import Array, Array32

if TYPE_CHECKING:
    from twin.nerf.field import RadianceField

SEARCH_TEXEL = 0.5
"""[m] side of the texels of a search's shadow maps."""
_ELEVATIONS = (8.0, 18.0, 32.0, 50.0)  # [°] elevations of the first directions
_AZIMUTH_STEP = 22.5  # [°] step of the azimuths of the first directions
_ELEVATION_RANGE = (3.0, 80.0)  # [°] range of elevations in a search
_REFINEMENTS = (9.0, 5.0, 2.5)  # [°] steps of the further searches around the best directions
_STARTS = 2  # number of directions of the grid that are refined
_BASES = 2  # number of bases that are refined, in addition to that of the embedding fitted without a sun
_RIDGE = 2e-4  # weight of the squared differences of coefficients from those without a sun
_PLAIN = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])  # coefficients of the terms without a sun
_LIGHT = np.array([True, True, False, False, False, True])  # terms with coefficients ≥ 0, since they are light
_STEPS = 100
_RAYS, _SEARCH_RAYS = 6_000, 2_500  # pixels of the joint fits and of the searches, evenly spaced over the photo
_EMBEDDING_RATE, _COEFFICIENT_RATE = 0.03, 0.03  # learning rates
_EXTINCTION_RATE, _AIRLIGHT_RATE = 0.1, 0.03  # learning rates of the logarithm of extinction and of the airlight
_PRIOR = 1e-2  # weight of the squared distance from the initial embedding


@dataclass(frozen=True)
class SunProblem:
    """n pixels of a photo, and the field's surfaces and colors in these pixels."""

    colors: Array32
    """Colors of the photo, shape (n, 3)."""
    seen: SeenSurfaces
    distances: Array32
    """Distances along the rays [m], shape (n,)."""
    bases: Array32
    """Colors of the field under each base, shape (bases, n, 3)."""


@dataclass(frozen=True)
class LinearFit:
    """A sun fitted to a photo by least squares, with one base."""

    toward: Array
    """Unit vector towards the sun, shape (3,)."""
    coefficients: Array32
    """Shape (6, 3), see `Sun`."""
    error: float
    """Mean squared difference of the colors."""


def search_directions(problem: SunProblem, casters: ShadowCasters, fog: Fog) -> list[LinearFit]:
    """Best fit of each base over a grid of directions; for the best bases, the best directions are then refined."""
    known: dict[tuple[float, float], list[LinearFit]] = {}

    def fits(azimuth: float, elevation: float) -> list[LinearFit]:
        key = round(azimuth % 360.0, 1), round(min(max(elevation, _ELEVATION_RANGE[0]), _ELEVATION_RANGE[1]), 1)
        if key not in known:
            known[key] = fit_direction(problem, casters.seen_from(direction(*key), SEARCH_TEXEL), fog)
        return known[key]

    grid = [fits(a, e) for e in _ELEVATIONS for a in np.arange(0.0, 360.0, _AZIMUTH_STEP)]
    error = attrgetter("error")
    best = [min((one[k] for one in grid), key=error) for k in range(len(problem.bases))]
    promising = set(np.argsort([one.error for one in best])[:_BASES].tolist()) | {len(best) - 1}
    for k in promising:
        starts = sorted((one[k] for one in grid), key=error)[:_STARTS]
        for found in starts:
            for step in _REFINEMENTS:
                azimuth, elevation = angles(found.toward)
                wide = step / math.cos(math.radians(elevation))
                around = ((wide, 0.0), (-wide, 0.0), (0.0, step), (0.0, -step))
                found = min([found, *(fits(azimuth + a, elevation + e)[k] for a, e in around)], key=error)
            best[k] = min(best[k], found, key=error)
    return best


def fit_direction(problem: SunProblem, shadows: OrthographicShadowMap, fog: Fog) -> list[LinearFit]:
    """Fits the coefficients of the sun with this shadow map for each base, in given fog."""
    terms = problem.seen.terms(shadows).astype(np.float64)
    kept = _kept(fog, problem.distances)[:, None]
    target = problem.colors - (1.0 - kept) * np.asarray(fog.airlight)
    out = []
    for base in problem.bases:
        coefficients = np.empty((len(TERMS), 3))
        for c in range(3):
            coefficients[:, c] = _solve(kept * base[:, c : c + 1] * terms, target[:, c])
        gain = np.clip(terms @ coefficients, MIN_GAIN, MAX_GAIN)
        shown = np.clip(kept * base * gain + (1.0 - kept) * np.asarray(fog.airlight), 0.0, 1.0)
        error = float(((shown - problem.colors) ** 2).mean())
        out.append(LinearFit(shadows.toward, coefficients.astype(np.float32), error))
    return out


def _kept(fog: Fog, distances: NDArray) -> NDArray:
    """Fraction of light that the fog keeps."""
    return np.exp(-fog.extinction * np.minimum(distances, FOG_REACH))


def _solve(columns: NDArray, target: NDArray) -> NDArray:
    """Least squares with a weak pull to `_PLAIN`; the coefficients in `_LIGHT` are not negative."""
    scale = _RIDGE * float((columns**2).mean(0).sum()) * len(columns)
    square = columns.T @ columns + scale * np.eye(len(_PLAIN))
    right = columns.T @ target + scale * _PLAIN
    free = np.ones(len(_PLAIN), bool)
    while True:
        out = np.zeros(len(_PLAIN))
        out[free] = np.linalg.solve(square[np.ix_(free, free)], right[free])
        negative = free & (out < 0.0) & _LIGHT
        if not negative.any():
            return out
        free &= ~negative


def fit_jointly(
    parameters: dict[str, torch.Tensor],
    features: torch.Tensor,
    harmonics: torch.Tensor,
    problem: SunProblem,
    start: Array32,
    sun: Sun,
    fog: Fog,
) -> tuple[Array32, Sun, Fog]:
    """Fits embedding (dim,), coefficients and, if there is fog, the fog, by gradient descent from a linear fit.

    `parameters` are the weights of the field's networks; features (n, CHANNELS − 1) and harmonics (n, 16) of the
    problem's pixels come from `RadianceField.trace`. `start` is the mean of the embedding's prior.
    """
    device = features.device
    terms = torch.as_tensor(problem.seen.terms(sun.shadows), device=device)
    colors = torch.as_tensor(problem.colors, device=device)
    distances = torch.as_tensor(problem.distances, device=device).clamp(max=FOG_REACH)
    origin = torch.as_tensor(start, device=device)
    embedding = origin.clone().requires_grad_(True)
    coefficients = torch.tensor(sun.coefficients, device=device, requires_grad=True)
    fitted, fit = [(embedding, _EMBEDDING_RATE), (coefficients, _COEFFICIENT_RATE)], None
    if fog.extinction:
        fit = FogFit(fog.extinction, torch.tensor(fog.airlight, device=device), distances)
        fitted += zip(fit.parameters, (_EXTINCTION_RATE, _AIRLIGHT_RATE), strict=True)

    def loss() -> torch.Tensor:
        rgb = network.head(parameters, features, harmonics, embedding)
        rgb = rgb * (terms @ coefficients).clamp(MIN_GAIN, MAX_GAIN)
        rgb = fit.apply(rgb) if fit else rgb
        return ((rgb.clamp(max=1.0) - colors) ** 2).mean() + _PRIOR * ((embedding - origin) ** 2).mean()

    def bound() -> None:
        coefficients[_LIGHT] = coefficients[_LIGHT].clamp(min=0.0)
        if fit:
            fit.bound()

    descend(fitted, _STEPS, loss, bound)
    found = Sun(sun.shadows, coefficients.detach().cpu().numpy())
    return embedding.detach().cpu().numpy(), found, fit.result() if fit else fog


# ---- fit to a photo


@dataclass(frozen=True)
class TracedPhoto:
    """A photo with the field's depth and features in its pixels."""

    photo: Array32
    """RGB in [0, 1], shape (h, w, 3)."""
    depth: Array32
    """z-depth [m], shape (h, w)."""
    rays: Array
    """Rays of the pixels in the camera frame, with z = 1, shape (h, w, 3)."""
    camera_to_world: Array
    """OpenCV axes, shape (4, 4)."""
    features: torch.Tensor
    """Shape (h · w, CHANNELS − 1), see `RadianceField.trace`."""
    harmonics: torch.Tensor
    """Shape (h · w, 16)."""

    @property
    def distance(self) -> Array32:
        """Distances along the rays [m], shape (h, w)."""
        return self.depth * np.linalg.norm(self.rays, axis=-1).astype(np.float32)


@dataclass(frozen=True)
class AirFit:
    """Embedding and fog fitted to some pixels of a photo, without a sun."""

    pixels: NDArray[np.int64]
    """Indices of the pixels, shape (k,)."""
    embedding: Array32
    """Shape (dim,)."""
    fog: Fog


@dataclass(frozen=True)
class SunFit:
    """A sun fitted to a photo."""

    sun: Sun
    embedding: Array32
    """Appearance embedding under which the sun's gain applies, shape (dim,)."""
    fog: Fog
    picture: Array32
    """The field in this light, from the photo's pose, shape (h, w, 3)."""
    psnr_other_half: float
    """Mean PSNR of the photo's two halves, each under the fit to the other half [dB]."""
    disagreement: float
    """Angle between the directions found in the two halves [°]; 0 if the direction was given."""


def fit_sun(
    field: "RadianceField",
    traced: TracedPhoto,
    halves: Sequence[AirFit],
    whole: AirFit,
    casters: ShadowCasters,
    toward: Array | None,
) -> SunFit:
    """Fits a sun to a photo.

    Bases are the filmed lightings and the embedding fitted without a sun. For each, the fit to one half of the photo is
    scored on the other half; the base with the best score is used.

    Args:
        field: The field; it stays fixed.
        traced: The photo.
        halves: Fits to both halves without a sun.
        whole: The fit to the whole photo without a sun.
        casters: Surfaces that cast shadows.
        toward: Direction towards the sun, shape (3,); None: it is searched.
    """
    shape, seen = traced.photo.shape, SeenSurfaces.of(traced.depth, traced.rays, traced.camera_to_world)
    colors, distances = traced.photo.reshape(-1, 3).astype(np.float32), traced.distance.ravel()
    filmed = [field.embedding(name) for name in field.lightings]

    def color(rows: NDArray, embedding: Array32) -> Array32:
        index = torch.as_tensor(rows, device=field.device)
        return field.color(traced.features[index], traced.harmonics[index], embedding)

    def problem(rows: NDArray, count: int, embeddings: Sequence[Array32]) -> tuple[NDArray, SunProblem]:
        some = rows[:: max(1, len(rows) // count)]
        bases = np.stack([color(some, one) for one in embeddings])
        return some, SunProblem(colors[some], seen.subset(some), distances[some], bases)

    def solve(given: AirFit) -> list[tuple[LinearFit, Array32]]:
        """The best linear fits of the bases to some pixels, and the bases' embeddings."""
        embeddings = [*filmed, given.embedding]
        small = problem(given.pixels, _SEARCH_RAYS, embeddings)[1]
        if toward is None:
            found = search_directions(small, casters, given.fog)
        else:
            found = fit_direction(small, casters.seen_from(toward, SEARCH_TEXEL), given.fog)
        return list(zip(found, embeddings, strict=True))

    def refine(given: AirFit, start: LinearFit, embedding: Array32) -> tuple[Array32, Sun, Fog]:
        some, mine = problem(given.pixels, _RAYS, [embedding])
        fine = TEXEL if given is whole else SEARCH_TEXEL
        sun = Sun(casters.seen_from(start.toward, fine), start.coefficients)
        index = torch.as_tensor(some, device=field.device)
        traces = traced.features[index], traced.harmonics[index]
        return fit_jointly(field.parameters, *traces, mine, embedding, sun, given.fog)

    def picture(embedding: Array32, sun: Sun, fog: Fog) -> Array32:
        rgb = field.color(traced.features, traced.harmonics, embedding)
        gain = np.clip(seen.terms(sun.shadows) @ sun.coefficients, MIN_GAIN, MAX_GAIN)
        return np.clip(fog.apply((rgb * gain).reshape(shape), traced.distance), 0.0, 1.0)

    solved = [solve(half) for half in runtime.track(halves, "sun’s direction", unit="half")]
    order = np.argsort(np.mean([[fit.error for fit, _ in one] for one in solved], 0))
    scores = {}
    for k in runtime.track({*order[:_BASES].tolist(), len(filmed)}, "sun", unit="fit"):
        each = []
        for half, fits in zip(halves, solved, strict=True):
            rest = np.ones(len(colors), bool)
            rest[half.pixels] = False
            each.append(psnr(picture(*refine(half, *fits[k])), traced.photo, rest.reshape(shape[:2])))
        scores[k] = float(np.mean(each))
    base = max(scores, key=lambda k: scores[k])
    found = refine(whole, *solve(whole)[base])
    embedding, sun, fog = found
    one, other = (fits[base][0].toward for fits in solved)
    disagreement = float(np.rad2deg(np.arccos(np.clip(one @ other, -1.0, 1.0))))
    return SunFit(sun, embedding, fog, picture(*found), scores[base], disagreement)
