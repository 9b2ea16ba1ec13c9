"""Lighting of an episode: an appearance embedding, which may be sampled. The option `lighting` is one of

    "sun"                the lighting of this name; `sun/000012`: the lighting of one frame
    "sun:night:0.3"      a mixture: 30 % of the way from sun to night
    ("sun", "night")     one of several lightings or mixtures, sampled for every episode
    "any"                any lighting that could have been filmed, sampled by `field.sample_lighting`
    "training"           sampled from the training set, see `LightingSets`
    "held-out"           sampled from the held-out set

With drift, an episode's lighting changes gradually into a second one, sampled in the same way. If the option names a
single lighting, the second one is another filmed lighting.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from twin.config import ANY, HELD_OUT, RESERVED_LIGHTINGS, TRAINING
from twin.errors import InputError
from twin.nerf.baked import BakedField
from twin.nerf.lightings import Fog, Lightings, mixed_fog
from twin.nerf.sun import Sunlight, mixed_sunlight
from twin.types import Array32

VERSION = 2
"""Version of `LightingSets.sample`. Increase it whenever a change of the code changes the lightings of a seed."""

_SEED = 20_240_315  # fixed random seed of `Anchors`: all runs with a build have the same sets
_POOL_SIZE = 200  # number of lightings among which anchors are chosen
_EXTRA_ANCHORS = 8  # number of anchors besides the filmed lightings
# A lighting is in a set if (distance to the other set's nearest anchor) / (distance to its own) exceeds this.
_MARGIN = 1.25
_MAX_TRIES = 60  # largest number of proposals per sample; about one in ten is near the chosen anchor


@dataclass(frozen=True)
class EpisodeLighting:
    """Lighting of one episode: an appearance embedding with its fog and suns, or a drift from one to another."""

    name: str
    """Name of the lighting or its set, `<name> → <name>` with drift; the option `observe` if there is no field."""
    start: Array32
    """Embedding at the beginning, shape (dim,)."""
    end: Array32 | None = None
    """Embedding after `duration`; None: no drift."""
    duration: float = 0.0
    """[s]"""
    fog: Fog | None = None
    """Fog at the beginning, if fitted to a photo; None: no fog beyond the film's haze."""
    end_fog: Fog | None = None
    """Fog after `duration`; None as for `fog`."""
    sunlight: Sunlight = ()
    """Suns at the beginning; empty: the light of the film."""
    end_sunlight: Sunlight = ()
    """Suns after `duration`."""
    filmed: Lightings | None = None
    """The field's filmed lightings, if this one was sampled from a set of lightings; `name` is then the set's."""

    @cached_property
    def mixture(self) -> str:
        """The nearest mixture of filmed lightings, such as `: sun 0.62, night 0.38`; empty if it was not sampled."""
        if self.filmed is None:
            return ""
        ends = [self.start] if self.end is None else [self.start, self.end]
        return ": " + " → ".join(mixture_text(end, self.filmed) for end in ends)

    def at(self, time: float) -> Array32:
        """The embedding after `time` [s], shape (dim,)."""
        if self.end is None:
            return self.start
        share = self._share(time)
        return ((1.0 - share) * self.start + share * self.end).astype(np.float32)

    def fog_at(self, time: float) -> Fog | None:
        """The fog after `time` [s]; None as for `fog`."""
        return self.fog if self.end is None else mixed_fog(self.fog, self.end_fog, self._share(time))

    def sunlight_at(self, time: float) -> Sunlight:
        """The suns after `time` [s]."""
        if self.end is None or not (self.sunlight or self.end_sunlight):
            return self.sunlight
        return mixed_sunlight(self.sunlight, self.end_sunlight, self._share(time))

    def _share(self, time: float) -> float:
        return float(np.clip(time / self.duration, 0.0, 1.0))


@dataclass(frozen=True)
class Anchors:
    """k lightings far from each other that define the training and held-out sets."""

    embeddings: Array32
    """Shape (k, dim)."""
    probe_colors: Array32
    """Colors of the field's probes under each lighting, shape (k, 3·probes)."""
    held_out: NDArray[np.bool_]
    """True for anchors of the held-out set, shape (k,)."""


class LightingSets:
    """Training and held-out lightings of one field: disjoint sets, which are the same for all seeds.

    The distance of two lightings is the rms difference of the colors that they give to the field's *probes* (rays with
    stored features, see `nerf/lightings.py`). The first anchors are the filmed lightings; they belong to the
    training set. More are chosen one by one from random lightings of a fixed seed, each as far as possible from all
    anchors before it; the first, third, fifth, ... of these belong to the held-out set. A lighting belongs to the set
    of its nearest anchor, or to no set if an anchor of the other set is nearly as near. All anchors of a set are
    sampled equally often; otherwise a lighting unlike all others, such as night, would be rare.
    """

    def __init__(self, field: BakedField) -> None:
        self.field = field
        # If photos added later moved the sets, a lighting used for training could become held out.
        self.filmed = field.lightings_by_name.filmed()

    @cached_property
    def anchors(self) -> Anchors:
        """Anchors of both sets. Raises InputError: the field has no probes, so lightings cannot be compared."""
        chosen = list(self.filmed.vectors)
        rng = np.random.default_rng(_SEED)
        pool = [self.filmed.sample(rng) for _ in range(_POOL_SIZE)]
        pool_colors = np.stack([self._probe_colors(embedding) for embedding in pool])
        chosen_colors = [self._probe_colors(embedding) for embedding in chosen]
        nearest = np.min([_distance(pool_colors, colors) for colors in chosen_colors], axis=0)
        for _ in range(_EXTRA_ANCHORS):
            best = int(nearest.argmax())
            chosen.append(pool[best])
            chosen_colors.append(pool_colors[best])
            nearest = np.minimum(nearest, _distance(pool_colors, pool_colors[best]))
        extra = np.arange(len(chosen)) - len(self.filmed.vectors)
        return Anchors(np.stack(chosen), np.stack(chosen_colors), (extra >= 0) & (extra % 2 == 0))

    def sample(self, which: str, rng: np.random.Generator) -> Array32:
        """A random lighting of a set, shape (dim,): near one of the set's anchors, all of which are equally likely.

        Raises:
            InputError: no lighting of the set is found.
        """
        own = np.flatnonzero(self.anchors.held_out == (which == HELD_OUT))
        anchor = int(rng.choice(own))
        prior = self.filmed.prior
        # If no proposal is near the anchor, for example at the edge of the filmed lightings, the anchor itself is used.
        for embedding in chain((prior.propose(rng) for _ in range(_MAX_TRIES)), [self.anchors.embeddings[anchor]]):
            # Most proposals are plausible, but few are near the anchor, so nearness is tested first.
            if self.set_and_anchor(embedding) == (which, anchor) and not prior.violations(embedding):
                return embedding
        raise InputError(
            f"lighting {which!r}: no sampled lighting belongs to this set, since the place was filmed in too few "
            "lightings; film it in another, or name the lightings to drive in"
        )

    def set_and_anchor(self, embedding: Array32) -> tuple[str | None, int]:
        """The set of a lighting (dim,), `TRAINING`, `HELD_OUT` or None (neither), and its nearest anchor's index."""
        distance = _distance(self.anchors.probe_colors, self._probe_colors(embedding))
        held_out, nearest = self.anchors.held_out, int(distance.argmin())
        to_training, to_held_out = float(distance[~held_out].min()), float(distance[held_out].min())
        if to_held_out > _MARGIN * to_training:
            return TRAINING, nearest
        return (HELD_OUT if to_training > _MARGIN * to_held_out else None), nearest

    def _probe_colors(self, embedding: Array32) -> Array32:
        return self.filmed.prior.probes.picture(embedding).ravel()


def _distance(many: Array32, one: Array32) -> NDArray[np.float64]:
    return np.sqrt(((many - one) ** 2).mean(-1))


def mixture_text(embedding: Array32, filmed: Lightings) -> str:
    """Text of the mixture of filmed lightings that is nearest to an embedding (dim,), such as `sun 0.62, night 0.38`.

    The fractions are nonnegative and add up to 1; those below 0.005 are omitted. A sampled embedding deviates somewhat
    from its mixture, like the embedding of a single frame; the text omits this deviation.
    """
    from scipy.optimize import nnls  # slow to import

    vectors = filmed.vectors.astype(np.float64)
    sum_weight = 1e3 * max(float(np.abs(vectors).max()), 1.0)  # weight of the equation Σ fractions = 1
    equations = np.vstack([vectors.T, np.full(len(vectors), sum_weight)])
    parts, _ = nnls(equations, np.append(embedding, sum_weight))
    order = np.argsort(-parts, kind="stable")
    return ", ".join(f"{filmed.names[k]} {parts[k]:.2f}" for k in order if parts[k] >= 0.005)


def check_lighting_names(lighting: str | Sequence[str], field: BakedField) -> None:
    """Raises InputError: a name in the option `lighting` (see the module) is unknown to the field."""
    for name in (lighting,) if isinstance(lighting, str) else lighting:
        if name not in RESERVED_LIGHTINGS:
            field.embedding(name)


def sample_lighting(
    lighting: str | Sequence[str], drift: bool, duration: float, sets: LightingSets, rng: np.random.Generator
) -> EpisodeLighting:
    """Samples the lighting of an episode. With `drift`, it changes during `duration` [s].

    Raises:
        InputError: a lighting is unknown, a set has no lighting, or there is no second lighting for the drift.
    """
    if not isinstance(lighting, str) and len(lighting) == 1:
        lighting = lighting[0]
    name, start, fog, suns = _sample_one(lighting, sets, rng)
    if not drift:
        filmed = sets.filmed if name in RESERVED_LIGHTINGS else None
        return EpisodeLighting(name, start, fog=fog, sunlight=suns, filmed=filmed)
    other, end, end_fog, end_suns = _sample_one(lighting, sets, rng)
    if isinstance(lighting, str) and lighting not in RESERVED_LIGHTINGS:
        names = [n for n in sets.filmed.names if n != lighting]
        if not names:
            raise InputError(f"lighting {lighting!r} cannot drift: the field has no other; give lighting_drift=False")
        other, end, end_fog, end_suns = _sample_one(tuple(names), sets, rng)
    filmed = sets.filmed if {name, other} & set(RESERVED_LIGHTINGS) else None
    return EpisodeLighting(f"{name} → {other}", start, end, duration, fog, end_fog, suns, end_suns, filmed)


def _sample_one(
    lighting: str | Sequence[str], sets: LightingSets, rng: np.random.Generator
) -> tuple[str, Array32, Fog | None, Sunlight]:
    """Name, embedding, fog and suns of one lighting."""
    if not isinstance(lighting, str):
        if not lighting:
            raise InputError("lighting = (): expected at least one name")
        lighting = lighting[int(rng.integers(len(lighting)))]
    if lighting == ANY:
        return ANY, sets.field.sample_lighting(rng), None, ()
    if lighting in (TRAINING, HELD_OUT):
        return lighting, sets.sample(lighting, rng), None, ()
    return lighting, sets.field.embedding(lighting), sets.field.fog(lighting), sets.field.sunlight(lighting)
