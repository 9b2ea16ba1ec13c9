"""Lightings by name, as NumPy arrays, for rendering without torch.

A lighting is requested by its name, by a frame (`day/000012`), or as a mixture `day:night:0.3`, 30 % of the way from
day to night. Random lightings come from `appearance_prior.py`; lightings fitted to photos (`added_lightings.py`) can be
added to those that the field was trained on.
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
    """Rays on which random lightings are checked; a baked field has them."""
    stale: tuple[str, ...] = ()
    """Added lightings that are refused, as they were fitted to another build of the field or by an older twin."""
    count_added: int = 0
    """Number of added lightings, the last ones of `names`."""
    fogs: Mapping[str, Fog] = field(default_factory=dict)
    """Fog in the photos of the added lightings, by name."""

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

    def fog(self, lighting: str) -> Fog | None:
        """Fog of an added lighting or of a mixture with one; None means the air of the film. Errors as `embedding`."""
        if lighting in self.fogs:
            return self.fogs[lighting]
        mixture = None if lighting in self.names else _mixture(lighting)
        return mixed(self.fog(mixture[0]), self.fog(mixture[1]), mixture[2]) if mixture else None

    def sample(self, rng: np.random.Generator) -> NDArray[np.float32]:
        """Samples the embedding (dim,) of a plausible lighting; raises InputError without probes or success."""
        return appearance_prior.sample_plausible(rng, self.prior)

    @cached_property
    def prior(self) -> appearance_prior.AppearancePrior:
        """The prior of plausible embeddings. Raises InputError without probes."""
        if self.probes is None:
            raise InputError(
                "no probes to check a random lighting on; use the baked field, twin.load_scene(SCENE).field()"
            )
        return appearance_prior.AppearancePrior(self.probes, self.vectors, self.frame_vectors)

    def added(
        self,
        more: Mapping[str, NDArray[np.float32]],
        stale: tuple[str, ...] = (),
        fogs: Mapping[str, Fog] | None = None,
    ) -> "Lightings":
        """A copy with more lightings: embeddings (dim,) by name, stale names (see `stale`), and fog by name."""
        vectors = np.concatenate([self.vectors, *(vector[None] for vector in more.values())])
        return replace(
            self,
            names=(*self.names, *more),
            vectors=vectors,
            stale=(*self.stale, *stale),
            count_added=self.count_added + len(more),
            fogs={**self.fogs, **(fogs or {})},
        )

    def filmed(self) -> "Lightings":
        """A copy without the added lightings."""
        count = len(self.names) - self.count_added
        return replace(self, names=self.names[:count], vectors=self.vectors[:count], count_added=0, fogs={})


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
