"""In which light an episode is driven.

A *light* is one appearance embedding. What an episode is asked to be lit by is one of

    "sun"                a lighting by its name, or a frame's (`sun/000012`)
    "sun:night:0.3"      a mixture: 30 % of the way from sun to night
    ("sun", "night")     one of these, drawn for every episode; each may be a mixture
    "any"                drawn by `field.sample_lighting`: any that could have been filmed
    "training"           drawn from the training set
    "held-out"           drawn from the held-out set

*Training and held-out set* never mix, whatever the seed: they are regions of the space of lightings. The distance of
two lights is that of their pictures (rms over the probes' colours, see `nerf/appearance_prior.py`). Among many lights drawn
with a fixed seed, *anchors* are chosen, each as far as possible from those before, the first being the filmed
lightings. The filmed ones are anchors of the training set; of the others, every second, from the first on, is of the
held-out set. A light belongs to the set of its nearest anchor, unless an anchor of the other set is nearly as near:
then to neither. Every anchor's lights are drawn as often as another's, or night would be rare.

A light may also *drift*: an episode then begins in one and ends, if it lasts that long, in another of the same kind.
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
from twin.nerf.fog import Fog, mixed
from twin.types import Array32

VERSION = 2
"""Of what a generator draws from a set. Raised where the same one draws other lights."""

_SEED = 20_240_315  # of the anchors; a constant, so that every run on a build has the same sets
_DRAWN = 200  # lights that anchors are chosen among
_FURTHER = 8  # anchors besides the filmed lightings
_MARGIN = 1.25  # the other set's nearest anchor must be this much further than the own one
_TRIES = 60  # proposals for an anchor, of which about every tenth is near it


@dataclass(frozen=True)
class EpisodeLighting:
    """The light of one episode."""

    name: str
    """As it was asked for, or how it was drawn."""
    start: Array32
    """Embedding at the beginning, shape (dim,)."""
    end: Array32 | None = None
    """Embedding after `duration`; None where it stays."""
    duration: float = 0.0
    """[s]"""
    air: Fog | None = None
    """Of the beginning, where a photo told it; None: the film's."""
    end_air: Fog | None = None
    """Of the end."""

    def at(self, time: float) -> Array32:
        """The embedding after `time` [s], shape (dim,)."""
        if self.end is None:
            return self.start
        share = self._share(time)
        return ((1.0 - share) * self.start + share * self.end).astype(np.float32)

    def air_at(self, time: float) -> Fog | None:
        """The air after `time` [s]; None: the film's."""
        return self.air if self.end is None else mixed(self.air, self.end_air, self._share(time))

    def _share(self, time: float) -> float:
        return float(np.clip(time / self.duration, 0.0, 1.0))


@dataclass(frozen=True)
class Anchors:
    """What the two sets are made of: k lights far from each other."""

    embeddings: Array32
    """Shape (k, dim)."""
    pictures: Array32
    """Shape (k, 3·probes)."""
    held_out: NDArray[np.bool_]
    """Whether each is of the held-out set, shape (k,)."""


class LightingSets:
    """Training and held-out lights of one field."""

    def __init__(self, field: BakedField) -> None:
        self.field = field
        # Photos that were added later must not move the sets, or what was trained on could become held out.
        self._filmed = field.lightings_by_name.filmed()

    @cached_property
    def anchors(self) -> Anchors:
        """Raises InputError: the field has no probes to judge lightings on."""
        filmed = list(self._filmed.vectors)
        rng = np.random.default_rng(_SEED)
        drawn = [self._filmed.sample(rng) for _ in range(_DRAWN)]
        pictures = np.stack([self._picture(light) for light in drawn])
        chosen, chosen_pictures = filmed, [self._picture(light) for light in filmed]
        nearest = np.min([_distance(pictures, picture) for picture in chosen_pictures], axis=0)
        for _ in range(_FURTHER):
            best = int(nearest.argmax())
            chosen.append(drawn[best])
            chosen_pictures.append(pictures[best])
            nearest = np.minimum(nearest, _distance(pictures, pictures[best]))
        held_out = np.arange(len(chosen)) - len(self._filmed.vectors)
        return Anchors(np.stack(chosen), np.stack(chosen_pictures), (held_out >= 0) & (held_out % 2 == 0))

    def set_of(self, embedding: Array32) -> str | None:
        """`TRAINING`, `HELD_OUT`, or None for a light that belongs to neither; embedding (dim,)."""
        return self._place_of(embedding)[0]

    def sample(self, which: str, rng: np.random.Generator) -> Array32:
        """A random light of a set, shape (dim,): near one of its anchors, each as likely as another.

        Raises:
            InputError: none is found.
        """
        own = np.flatnonzero(self.anchors.held_out == (which == HELD_OUT))
        anchor = int(rng.choice(own))
        judge = self._filmed.judge
        # Where lights are rarely drawn, such as at the edge of what was filmed, the anchor itself will do.
        for light in chain((judge.propose(rng) for _ in range(_TRIES)), [self.anchors.embeddings[anchor]]):
            # Few are near the anchor, and most could have been filmed: so the former is asked first.
            if self._place_of(light) == (which, anchor) and not judge.faults(light):
                return light
        raise InputError(
            f"lighting {which!r}: none among those drawn; this place was filmed in too few lightings: film another, "
            "or name the lightings to be driven in"
        )

    def _place_of(self, embedding: Array32) -> tuple[str | None, int]:
        """The set of a light, and its nearest anchor."""
        distance, held_out = _distance(self.anchors.pictures, self._picture(embedding)), self.anchors.held_out
        nearest, training, other = (
            int(distance.argmin()),
            float(distance[~held_out].min()),
            float(distance[held_out].min()),
        )
        if other > _MARGIN * training:
            return TRAINING, nearest
        return (HELD_OUT if training > _MARGIN * other else None), nearest

    def _picture(self, embedding: Array32) -> Array32:
        return self._filmed.judge.probes.picture(embedding).ravel()


def _distance(pictures: Array32, picture: Array32) -> NDArray[np.float64]:
    return np.sqrt(((pictures - picture) ** 2).mean(-1))


def check_names(wanted: str | Sequence[str], field: BakedField) -> None:
    """Raises InputError where a name in `wanted`, see the module, is none of the field's."""
    for name in (wanted,) if isinstance(wanted, str) else wanted:
        if name not in RESERVED_LIGHTINGS:
            field.embedding(name)


def sample_lighting(
    wanted: str | Sequence[str], drift: bool, duration: float, sets: LightingSets, rng: np.random.Generator
) -> EpisodeLighting:
    """The light of an episode.

    Args:
        wanted: See the module.
        drift: Whether it changes; a fixed lighting then drifts into another filmed one.
        duration: Over which it changes [s].
        sets: Of the field.
        rng: Of the episode.

    Raises:
        InputError: an unknown lighting, or none that fits.
    """
    name, start, air = _one(wanted, sets, rng)
    if not drift:
        return EpisodeLighting(name, start, air=air)
    other, end, end_air = _one(wanted, sets, rng)
    if isinstance(wanted, str) and wanted not in RESERVED_LIGHTINGS:
        names = [n for n in sets.field.lightings_by_name.filmed().names if n != wanted]
        if not names:
            raise InputError(f"lighting {wanted!r} cannot drift: the field has no other; give lighting_drift=False")
        other, end, end_air = _one(tuple(names), sets, rng)
    return EpisodeLighting(f"{name} → {other}", start, end, duration, air, end_air)


def _one(wanted: str | Sequence[str], sets: LightingSets, rng: np.random.Generator) -> tuple[str, Array32, Fog | None]:
    """A light's name, embedding and air."""
    if not isinstance(wanted, str):
        if not wanted:
            raise InputError("lighting = (): expected at least one name")
        wanted = wanted[int(rng.integers(len(wanted)))]
    if wanted == ANY:
        return ANY, sets.field.sample_lighting(rng), None
    if wanted in (TRAINING, HELD_OUT):
        return wanted, sets.sample(wanted, rng), None
    return wanted, sets.field.embedding(wanted), sets.field.air(wanted)
