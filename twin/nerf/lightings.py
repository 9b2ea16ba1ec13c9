"""Lightings by name: plain arrays, for whoever renders without training.

A *lighting* can be asked for by name, as a frame (`day/000012`), or as a mixture `day:night:0.3`, which is 30 % of the
way from day to night. One that nobody filmed can be drawn at random, see `appearance_prior.py`. To the lightings that a field
was trained on those may be *added* that photos were fitted for, see `added_lightings.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.nerf import appearance_prior
from twin.nerf.fog import Fog, mixed


@dataclass(frozen=True)
class Lightings:
    """Appearance embeddings of lightings and of the frames filmed under them."""

    names: tuple[str, ...]
    vectors: NDArray[np.float32]
    """Shape (lightings, dim)."""
    frames: tuple[str, ...]
    frame_vectors: NDArray[np.float32]
    """Shape (frames, dim)."""
    probes: appearance_prior.Probes | None = None
    """What a random lighting is judged on; a baked field has them."""
    stale: tuple[str, ...] = ()
    """Lightings that were added to another build of the field, or by an older twin, and mean nothing to this one."""
    count_added: int = 0
    """How many of the last ones were added."""
    airs: Mapping[str, Fog] = field(default_factory=dict)
    """Of those added, by name: what was in the air when their photos were taken."""

    def embedding(self, lighting: str) -> NDArray[np.float32]:
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
                f"again: python -m twin.relight SCENE PHOTO --name {lighting}"
            )
        raise InputError(f"lighting {lighting!r}: unknown; the field has {', '.join(self.names)}")

    def air(self, lighting: str) -> Fog | None:
        """The air that a photo told of a lighting, or of a mixture with one; None where it is the film's.

        Raises:
            InputError: as `embedding`, where a mixture is none.
        """
        if lighting in self.airs:
            return self.airs[lighting]
        mixture = None if lighting in self.names else _mixture(lighting)
        return mixed(self.air(mixture[0]), self.air(mixture[1]), mixture[2]) if mixture else None

    def sample(self, rng: np.random.Generator) -> NDArray[np.float32]:
        """The embedding of a random lighting that could have been filmed, shape (dim,); `appearance_prior.py` has the rule.

        The same generator state gives the same lighting.

        Raises:
            InputError: there are no probes, or none of the lightings drawn was plausible.
        """
        return appearance_prior.sample(rng, self.judge)

    @cached_property
    def judge(self) -> appearance_prior.AppearancePrior:
        """Tells whether an embedding could have been filmed. Raises InputError where there are no probes."""
        if self.probes is None:
            raise InputError(
                "no probes to judge a random lighting on; take the baked field, twin.load_scene(SCENE).field()"
            )
        return appearance_prior.AppearancePrior(self.probes, self.vectors, self.frame_vectors)

    def added(
        self,
        more: Mapping[str, NDArray[np.float32]],
        stale: tuple[str, ...] = (),
        airs: Mapping[str, Fog] | None = None,
    ) -> "Lightings":
        """With more lightings, embeddings (dim,) by name, the names of those that are not to be used, and airs."""
        vectors = np.concatenate([self.vectors, *(vector[None] for vector in more.values())])
        return replace(
            self,
            names=(*self.names, *more),
            vectors=vectors,
            stale=(*self.stale, *stale),
            count_added=self.count_added + len(more),
            airs={**self.airs, **(airs or {})},
        )

    def filmed(self) -> "Lightings":
        """Without those that were added."""
        count = len(self.names) - self.count_added
        return replace(self, names=self.names[:count], vectors=self.vectors[:count], count_added=0, airs={})


def _mixture(lighting: str) -> tuple[str, str, float] | None:
    """The two lightings and the share of `a:b:share`; None where it is not of that form."""
    if lighting.count(":") != 2:
        return None
    a, b, share = lighting.split(":")
    try:
        s = float(share)
    except ValueError:
        raise InputError(f"lighting {lighting!r}: {share!r} is no number; expected a:b:share") from None
    if not 0.0 <= s <= 1.0:
        raise InputError(
            f"lighting {lighting!r}: the share {share} is not from 0 to 1; give {a}:{b}:0.3 for 30 % of the "
            f"way from {a} to {b}"
        )
    return a, b, s
