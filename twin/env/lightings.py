"""In which light an episode is driven.

A *light* is one appearance embedding. What an episode is asked to be lit by is one of

    "sun"                a lighting by its name, or a frame's (`sun/000012`)
    "sun:night:0.3"      a mixture: 30 % of the way from sun to night
    ("sun", "night")     one of these, drawn for every episode; each may be a mixture
    "any"                drawn by `field.sample_lighting`: any that could have been filmed
    "training"           drawn from the training set
    "held-out"           drawn from the held-out set

*Training and held-out set* never mix, whatever the seed: they are regions of the space of lightings. The distance of
two lights is that of their pictures (rms over the probes' colours, see `nerf/plausible.py`). Among many lights drawn
with a fixed seed, *anchors* are chosen, each as far as possible from those before, the first being the filmed
lightings. The filmed ones are anchors of the training set; of the others, every second, from the first on, is of the
held-out set. A light belongs to the set of its nearest anchor, unless an anchor of the other set is nearly as near:
then to neither.

A light may also *drift*: an episode then begins in one and ends, if it lasts that long, in another of the same kind.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.nerf.baked import BakedField

Floats = NDArray[np.float32]

TRAINING, HELD_OUT, ANY = "training", "held-out", "any"

_SEED = 20_240_315  # of the anchors; a constant, so that every run on a build has the same sets
_DRAWN = 200  # lights that anchors are chosen among
_FURTHER = 8  # anchors besides the filmed lightings
_MARGIN = 1.25  # the other set's nearest anchor must be this much further than the own one
_TRIES = 400


@dataclass(frozen=True)
class Light:
    """The light of one episode."""

    name: str
    """As it was asked for, or how it was drawn."""
    start: Floats
    """Embedding at the beginning, shape (dim,)."""
    end: Floats | None = None
    """Embedding after `duration`; None where it stays."""
    duration: float = 0.0
    """[s]"""

    def at(self, time: float) -> Floats:
        """The embedding after `time` [s], shape (dim,)."""
        if self.end is None:
            return self.start
        share = float(np.clip(time / self.duration, 0.0, 1.0))
        return ((1.0 - share) * self.start + share * self.end).astype(np.float32)


class LightSets:
    """Training and held-out lights of one field."""

    def __init__(self, field: BakedField) -> None:
        self.field = field
        # Photos that were added later must not move the sets, or what was trained on could become held out.
        self._filmed = field.lightings_by_name.filmed()

    @cached_property
    def anchors(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Pictures of the anchors, shape (k, 3·probes), and whether each is of the held-out set, shape (k,).

        Raises:
            InputError: the field has no probes to judge lightings on.
        """
        filmed = [self._picture(vector) for vector in self._filmed.vectors]
        rng = np.random.default_rng(_SEED)
        drawn = np.stack([self._picture(self._filmed.sample(rng)) for _ in range(_DRAWN)])
        chosen = list(filmed)
        nearest = np.min([_distance(drawn, picture) for picture in chosen], axis=0)
        for _ in range(_FURTHER):
            chosen.append(drawn[int(nearest.argmax())])
            nearest = np.minimum(nearest, _distance(drawn, chosen[-1]))
        held_out = np.arange(len(chosen)) - len(filmed)
        return np.stack(chosen), (held_out >= 0) & (held_out % 2 == 0)

    def set_of(self, embedding: Floats) -> str | None:
        """`TRAINING`, `HELD_OUT`, or None for a light that belongs to neither; embedding (dim,)."""
        pictures, held_out = self.anchors
        distance = _distance(pictures, self._picture(embedding))
        training, other = float(distance[~held_out].min()), float(distance[held_out].min())
        if other > _MARGIN * training:
            return TRAINING
        return HELD_OUT if training > _MARGIN * other else None

    def sample(self, which: str, rng: np.random.Generator) -> Floats:
        """A random light of a set, shape (dim,). Raises InputError where none is found."""
        for _ in range(_TRIES):
            embedding = self._filmed.sample(rng)
            if self.set_of(embedding) == which:
                return embedding
        raise InputError(
            f"lighting {which!r}: none among {_TRIES} drawn; this place was filmed in too few lightings: film another, "
            "or name the lightings to be driven in"
        )

    def _picture(self, embedding: Floats) -> Floats:
        return self._filmed.judge.probes.picture(embedding).ravel()


def _distance(pictures: Floats, picture: Floats) -> NDArray[np.float64]:
    return np.sqrt(((pictures - picture) ** 2).mean(-1))


def draw_light(
    wanted: str | Sequence[str], drift: bool, duration: float, sets: LightSets, rng: np.random.Generator
) -> Light:
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
    name, start = _one(wanted, sets, rng)
    if not drift:
        return Light(name, start)
    other, end = _one(wanted, sets, rng)
    if isinstance(wanted, str) and wanted not in (TRAINING, HELD_OUT, ANY):
        names = [n for n in sets.field.lightings if n != wanted]
        if not names:
            raise InputError(f"lighting {wanted!r} cannot drift: the field has no other; give lighting_drift=False")
        other, end = _one(tuple(names), sets, rng)
    return Light(f"{name} → {other}", start, end, duration)


def _one(wanted: str | Sequence[str], sets: LightSets, rng: np.random.Generator) -> tuple[str, Floats]:
    if not isinstance(wanted, str):
        if not wanted:
            raise InputError("lighting = (): expected at least one name")
        wanted = wanted[int(rng.integers(len(wanted)))]
    if wanted == ANY:
        return ANY, sets.field.sample_lighting(rng)
    if wanted in (TRAINING, HELD_OUT):
        return wanted, sets.sample(wanted, rng)
    return wanted, sets.field.embedding(wanted)
