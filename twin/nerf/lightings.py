"""Lightings by name, as NumPy arrays for rendering without torch, and lightings added to a built scene, with their fog.

A lighting is requested by its name, by a frame (`day/000012`), or as a mixture `day:night:0.3`, 30 % of the way from
day to night. Random lightings come from `AppearancePrior`. `twin relight` fits a lighting to a photo and
stores it in `<scene>/lightings/<name>.json`, outside `build/`, since users may delete `build/` at any time. An
embedding is valid for one field only, so each file stores the content digest of its field stage; with any other build
of the field, the lighting is *stale*.

Fog is homogeneous and applied to an image by its depth (Koschmieder 1924). Over a distance d, it keeps a share
exp(−extinction · d) of a surface's light; the rest of the color is the *airlight*, which the air scatters towards the
camera. The meteorological visibility, at which fog keeps 5 %, is 3 / extinction.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.config import RESERVED_LIGHTINGS, SAMPLED_LIGHTING
from twin.errors import InputError, name_hint
from twin.files import read_json, wrap_read_errors, write_json
from twin.nerf.sun import Sun, Sunlight, mixed_sunlight
from twin.scene import SceneDir, check_name, stage_result
from twin.types import Array32

# ---- fog

FOG_REACH = 100.0
"""Greatest distance [m] over which fog accumulates: fog lies low and does not hide the sky."""


@dataclass(frozen=True)
class Fog:
    """Fog in addition to any in the film; none by default."""

    extinction: float = 0.0
    """[1/m]"""
    airlight: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """RGB in [0, 1]."""

    def apply(self, rgb: Array32, distance: Array32) -> Array32:
        """Applies the fog to an image (..., 3) with distances along the rays [m], shape (...)."""
        if not self.extinction:
            return rgb
        kept = np.exp(np.float32(-self.extinction) * np.minimum(distance, np.float32(FOG_REACH)))[..., None]
        return kept * rgb + (np.float32(1.0) - kept) * np.asarray(self.airlight, np.float32)


def mixed_fog(one: Fog | None, other: Fog | None, share: float) -> Fog | None:
    """Interpolated fog, `share` of the way from `one` to `other`; None stands for no additional fog.

    The airlights are weighted by the extinctions.
    """
    if one is None and other is None:
        return None
    a, b = one or Fog(), other or Fog()
    mine, its = (1.0 - share) * a.extinction, share * b.extinction
    total = mine + its
    if not total:
        return Fog()
    red, green, blue = (mine * np.array(a.airlight) + its * np.array(b.airlight)) / total
    return Fog(total, (float(red), float(green), float(blue)))


# ---- random lightings

_GAMMA = 2.2  # approximate tone curve of the films
_MAX_MISFIT = 0.06  # greatest rms color difference from the nearest sum of lights [full scale = 1]
_OUTLIER_ERROR = 0.2  # color difference above which a probe is an outlier [full scale = 1]
_MAX_OUTLIER_SHARE = 0.02  # greatest share of outliers among the probes
_RANGE_MARGIN = (0.02, 0.1)  # a filmed range of width w is extended at both ends by the first value plus the second · w
_CLIPPED = (0.02, 0.98)  # all channels below the first value: black; all above the second: burnt out
_CONCENTRATION = 0.7  # parameter of the Dirichlet distribution of mixtures; values below 1 favor single lightings
_RESIDUAL_SCALE = 2.0  # scale of sampled frame residuals; the rule rejects implausible ones
_MAX_TRIES = 200

_STATISTICS = ("brightness", "contrast", "saturation", "red cast", "blue cast", "black share", "burnt share")


@dataclass(frozen=True)
class Probes:
    """Rays of training frames and the head that colors them, see `network.py`."""

    features: Array32
    """Ray features composited over the background, shape (k, CHANNELS − 1)."""
    harmonics: Array32
    """Spherical harmonics of the ray directions, shape (k, 16)."""
    network: dict[str, Array32]
    """Parameters `head.*`."""

    @cached_property
    def _first_layer(self) -> Array32:
        """Output of the head's first layer without the embedding's part, shape (k, hidden)."""
        w, f, s = self.network["head.0"], self.features.shape[1], self.harmonics.shape[1]
        return self.features @ w[:f] + self.harmonics @ w[f : f + s] + self.network["head.0.bias"]

    def picture(self, embedding: NDArray) -> Array32:
        """Probe colors in [0, 1] under an embedding (dim,), shape (k, 3)."""
        p, inputs = self.network, self.features.shape[1] + self.harmonics.shape[1]
        x = np.maximum(self._first_layer + np.asarray(embedding, np.float32) @ p["head.0"][inputs:], 0.0)
        x = np.maximum(x @ p["head.1"] + p["head.1.bias"], 0.0) @ p["head.2"] + p["head.2.bias"]
        return 1.0 / (1.0 + np.exp(-x))


class AppearancePrior:
    """Prior of one place's plausible appearance embeddings: samples random embeddings and rejects implausible ones.

    In DriveEnv-NeRF, a person picks the sampled embeddings that look right. Here, a rule with two parts checks the
    *picture* of an embedding: the colors that it gives to *probes*, rays through the training frames with known
    features. First, since light is additive, the picture must be close to a weighted sum of the filmed lightings'
    pictures in linear light, with non-negative weights. More sun, street lamps at noon and longer exposure are such
    sums; green walls are not. Second, statistics of brightness, contrast and color must lie in the widened range of the
    filmed lightings and frames.
    """

    def __init__(self, probes: Probes, vectors: Array32, frame_vectors: Array32):
        """Takes the embeddings of the filmed lightings (lightings, dim) and frames (frames, dim)."""
        self.probes = probes
        pictures = [probes.picture(vector) for vector in vectors]
        self._lights = np.stack([picture.ravel() for picture in pictures], 1).astype(np.float64) ** _GAMMA
        pictures += [probes.picture(vector) for vector in frame_vectors]
        filmed = np.array([picture_statistics(picture) for picture in pictures])
        low, high = filmed.min(0), filmed.max(0)
        margin = _RANGE_MARGIN[0] + _RANGE_MARGIN[1] * (high - low)
        self._low, self._high = low - margin, high + margin
        # Training keeps residuals small, so a frame's lighting is the one with the nearest embedding.
        nearest = np.linalg.norm(frame_vectors[:, None] - vectors, axis=-1).argmin(1)
        self._vectors, self._residuals = vectors, frame_vectors - vectors[nearest]

    def propose(self, rng: np.random.Generator) -> Array32:
        """Samples an unchecked embedding (dim,) that resembles the learned ones.

        It is a random mixture of the lightings plus a normal deviate with the scaled covariance of the frame residuals.
        """
        embedding = rng.dirichlet(np.full(len(self._vectors), _CONCENTRATION)) @ self._vectors
        count = len(self._residuals)
        if count:
            # A sum of the residuals with normal weights has their covariance, even if they do not span all dimensions.
            embedding = embedding + _RESIDUAL_SCALE * rng.normal(size=count) @ self._residuals / np.sqrt(count)
        return embedding.astype(np.float32)

    def color_error(self, picture: NDArray) -> NDArray[np.float64]:
        """Color errors (rms over channels) of the probes against the nearest sum of filmed lights, shape (k,).

        The weights of the sum are non-negative.
        """
        from scipy.optimize import nnls

        weights, _ = nnls(self._lights, picture.ravel().astype(np.float64) ** _GAMMA)
        nearest = np.minimum(self._lights @ weights, 1.0) ** (1.0 / _GAMMA)
        return np.sqrt(((nearest.reshape(-1, 3) - picture) ** 2).mean(1))

    def sample(self, rng: np.random.Generator) -> Array32:
        """Samples a plausible embedding (dim,) by rejection; raises InputError after `_MAX_TRIES` proposals."""
        violations: list[str] = []
        for _ in range(_MAX_TRIES):
            embedding = self.propose(rng)
            violations = self.violations(embedding)
            if not violations:
                return embedding
        raise InputError(
            f"no plausible lighting among {_MAX_TRIES} sampled; the last has {'; '.join(violations)}; "
            "train the field longer (nerf.steps), or render the filmed lightings and their mixtures"
        )

    def violations(self, embedding: NDArray) -> list[str]:
        """Descriptions of the parts of the rule that an embedding (dim,) violates; empty if it is plausible."""
        picture = self.probes.picture(embedding)
        error = self.color_error(picture)
        misfit, wrong = float(np.sqrt((error**2).mean())), float((error > _OUTLIER_ERROR).mean())
        found = []
        if not misfit <= _MAX_MISFIT:
            found.append(f"an rms color error of {misfit:.3f} from any sum of filmed lights (limit: {_MAX_MISFIT})")
        if not wrong <= _MAX_OUTLIER_SHARE:
            found.append(f"{wrong:.1%} of the probes off by over {_OUTLIER_ERROR} (limit: {_MAX_OUTLIER_SHARE:.0%})")
        for name, value, low, high in zip(_STATISTICS, picture_statistics(picture), self._low, self._high, strict=True):
            if not low <= value <= high:
                found.append(f"{name} {value:.3f} (filmed: {low:.3f} to {high:.3f})")
        return found


def picture_statistics(picture: NDArray) -> NDArray[np.float64]:
    """The `_STATISTICS` of a picture (k, 3), shape (7,)."""
    high, low = picture.max(1), picture.min(1)
    red, green, blue = picture.mean(0)
    gray = picture.mean(1)
    black, burnt = (high < _CLIPPED[0]).mean(), (low > _CLIPPED[1]).mean()
    saturation = ((high - low) / np.maximum(high, 1e-3)).mean()
    return np.array([gray.mean(), gray.std(), saturation, red - green, blue - green, black, burnt], np.float64)


# ---- lightings of a field


@dataclass(frozen=True)
class Lightings:
    """Appearance embeddings of lightings and of the frames filmed under them."""

    names: tuple[str, ...]
    vectors: Array32
    """Shape (lightings, dim)."""
    frames: tuple[str, ...]
    frame_vectors: Array32
    """Shape (frames, dim)."""
    probes: Probes | None = None
    """Rays that check random lightings, see `AppearancePrior`; only a baked field has them."""
    stale: tuple[str, ...] = ()
    """Added lightings that are refused, since they were fitted to another build of the field or by an older twin."""
    count_added: int = 0
    """Number of added lightings, the last ones of `names`."""
    fogs: Mapping[str, Fog] = field(default_factory=dict)
    """Fog in the photos of the added lightings, by name."""
    suns: Mapping[str, Sun] = field(default_factory=dict)
    """Suns of those added lightings that have one, by name."""

    def embedding(self, lighting: str) -> Array32:
        """The embedding of a lighting, a frame or a mixture, shape (dim,).

        Raises:
            InputError: an unknown name, or a mixture that is not `a:b:share` with a share from 0 to 1.
        """
        if lighting in self.names:
            return self.vectors[self.names.index(lighting)]
        if lighting in self.frames:
            return self.frame_vectors[self.frames.index(lighting)]
        if mixture := _mixture(lighting):
            a, b, share = mixture
            return ((1.0 - share) * self.embedding(a) + share * self.embedding(b)).astype(np.float32)
        if lighting in self.stale:
            raise InputError(
                f"lighting {lighting!r}: fitted to another build of this field, or by an older twin; fit its photo "
                f"again: twin relight SCENE PHOTO --name {lighting}"
            )
        every = f"the field has {', '.join(self.names)}"
        raise InputError(f"lighting {lighting!r}: unknown; {name_hint(lighting, self.names, every)}")

    def fog(self, lighting: str) -> Fog | None:
        """Fog of an added lighting or of a mixture with one; None means no additional fog.

        Raises InputError for a mixture that is not `a:b:share` with a share from 0 to 1.
        """
        if lighting in self.fogs:
            return self.fogs[lighting]
        mixture = None if lighting in self.names else _mixture(lighting)
        return mixed_fog(self.fog(mixture[0]), self.fog(mixture[1]), mixture[2]) if mixture else None

    def sunlight(self, lighting: str) -> Sunlight:
        """Suns of an added lighting or of a mixture with one; empty: the light of the film alone.

        Raises InputError for a mixture that is not `a:b:share` with a share from 0 to 1.
        """
        if lighting in self.suns:
            return ((self.suns[lighting], 1.0),)
        mixture = None if lighting in self.names else _mixture(lighting)
        return mixed_sunlight(self.sunlight(mixture[0]), self.sunlight(mixture[1]), mixture[2]) if mixture else ()

    def sample(self, rng: np.random.Generator) -> Array32:
        """Samples a plausible lighting's embedding (dim,). Raises InputError without probes, or if it finds none."""
        return self.prior.sample(rng)

    @cached_property
    def prior(self) -> AppearancePrior:
        """The prior of embeddings that resemble the filmed lightings. Raises InputError without probes."""
        if self.probes is None:
            raise InputError(
                "this field has no probes to check random lightings; use the baked one, twin.load_scene(SCENE).field()"
            )
        return AppearancePrior(self.probes, self.filmed().vectors, self.frame_vectors)

    def added(
        self,
        more: Mapping[str, Array32],
        stale: tuple[str, ...] = (),
        fogs: Mapping[str, Fog] | None = None,
        suns: Mapping[str, Sun] | None = None,
    ) -> "Lightings":
        """A copy with more lightings: embeddings (dim,) by name, stale names (see `stale`), fog and suns by name."""
        return replace(
            self,
            names=(*self.names, *more),
            vectors=np.concatenate([self.vectors, *(vector[None] for vector in more.values())]),
            stale=(*self.stale, *stale),
            count_added=self.count_added + len(more),
            fogs={**self.fogs, **(fogs or {})},
            suns={**self.suns, **(suns or {})},
        )

    def filmed(self) -> "Lightings":
        """A copy without the added lightings."""
        count = len(self.names) - self.count_added
        return replace(self, names=self.names[:count], vectors=self.vectors[:count], count_added=0, fogs={}, suns={})


def _mixture(lighting: str) -> tuple[str, str, float] | None:
    """Parts of `a:b:share`; None if the name has another form."""
    if lighting.count(":") != 2:
        return None
    a, b, share = lighting.split(":")
    try:
        s = float(share)
    except ValueError:
        raise InputError(f"lighting {lighting!r}: {share!r} is not a number; expected a:b:share") from None
    if not 0.0 <= s <= 1.0:
        raise InputError(
            f"lighting {lighting!r}: the share {share} is not from 0 to 1; give {a}:{b}:0.3 for 30 % of the "
            f"way from {a} to {b}"
        )
    return a, b, s


# ---- lightings added to a scene

_FORMAT = 3  # format 1 has no fog; a lighting without a sun has format 2


@dataclass(frozen=True)
class AddedLighting:
    """One added lighting and its origin. The file stores these names as keys."""

    name: str
    embedding: list[float]
    """Length dim."""
    air: Fog
    """Fog in the photo."""
    field: str
    """Content digest of the field stage that it was fitted to."""
    photo: str
    """Path of the photo, as given."""
    figures: dict[str, Any]
    """Numbers of the fit, JSON-able."""
    sun: Sun | None = None
    """Sun in the photo; None: the light of the film."""

    def save(self, scene: SceneDir) -> None:
        """Writes `lightings/<name>.json`, replacing an existing file."""
        scene.lightings.mkdir(exist_ok=True)
        head = {"format": _FORMAT if self.sun else 2, **asdict(replace(self, sun=None))}
        del head["sun"]
        if self.sun:
            head["sun"] = self.sun.to_json()
        write_json(scene.lightings / f"{self.name}.json", head)


def check_new_name(name: str, filmed: tuple[str, ...]) -> None:
    """Raises InputError for a name that is reserved, filmed, or unfit for a file name or a part of a mixture."""
    check_name(name, "--name")
    if name in RESERVED_LIGHTINGS or name.startswith(SAMPLED_LIGHTING):
        raise InputError(f"--name {name!r}: reserved for random lightings; choose another, such as afternoon")
    if name in filmed:
        raise InputError(f"--name {name!r}: the place was filmed under a lighting of this name; choose another")


def lighting_files(scene: SceneDir) -> list[Path]:
    """Files of the lightings added to a scene, without those that are being written or whose writer was killed."""
    return sorted(path for path in scene.lightings.glob("*.json") if not path.name.startswith("."))


def added_lightings(
    scene: SceneDir, dim: int
) -> tuple[dict[str, Array32], tuple[str, ...], dict[str, Fog], dict[str, Sun]]:
    """Loads the lightings added to a scene's field: embeddings (dim,) by name, stale names, fog and suns by name.

    Raises InputError if the field is not built, or if a file is damaged or has another format.
    """
    result = stage_result(scene, "field")
    fresh: dict[str, Array32] = {}
    fogs: dict[str, Fog] = {}
    suns: dict[str, Sun] = {}
    stale = []
    for path in lighting_files(scene):
        with wrap_read_errors(path, "fit it again or delete it"):
            head = read_json(path)
            if head["format"] == 1:  # has no fog
                stale.append(path.stem)
                continue
            if head["format"] not in (2, _FORMAT):
                raise InputError(f"{path}: format {head['format']}, expected {_FORMAT}; fit it again or delete it")
            made_by, vector = head["field"], np.array(head["embedding"], np.float32)
            red, green, blue = map(float, head["air"]["airlight"])
            fog = Fog(float(head["air"]["extinction"]), (red, green, blue))
            if not (0.0 <= fog.extinction < np.inf and all(0.0 <= share <= 1.0 for share in fog.airlight)):
                raise ValueError(f"extinction {fog.extinction} below 0, or airlight {fog.airlight} not in 0 to 1")
            if vector.ndim != 1 or not np.isfinite(vector).all() or (made_by == result and vector.shape != (dim,)):
                raise ValueError(f"the embedding has shape {vector.shape}, not {(dim,)}, or is not finite")
            sun = Sun.from_json(head["sun"]) if head["format"] == _FORMAT else None
        if made_by == result:
            fresh[path.stem], fogs[path.stem] = vector, fog
            if sun:
                suns[path.stem] = sun
        else:
            stale.append(path.stem)
    return fresh, tuple(stale), fogs, suns
