"""Lightings by name: plain arrays, for whoever renders without training.

A *lighting* can be asked for by name, as a frame (`day/000012`), or as a mixture `day:night:0.3`, which is 30 % of the
way from day to night.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError


@dataclass(frozen=True)
class Lightings:
    """Appearance embeddings of lightings and of the frames filmed under them."""

    names: tuple[str, ...]
    vectors: NDArray[np.float32]
    """Shape (lightings, dim)."""
    frames: tuple[str, ...]
    frame_vectors: NDArray[np.float32]
    """Shape (frames, dim)."""

    def embedding(self, lighting: str) -> NDArray[np.float32]:
        """The embedding of a lighting, a frame or a mixture, shape (dim,).

        Raises:
            InputError: an unknown name, or a mixture that is not `a:b:share`.
        """
        if lighting in self.names:
            return self.vectors[self.names.index(lighting)]
        if lighting in self.frames:
            return self.frame_vectors[self.frames.index(lighting)]
        if lighting.count(":") == 2:
            a, b, share = lighting.split(":")
            try:
                s = float(share)
            except ValueError:
                raise InputError(f"lighting {lighting!r}: {share!r} is no number; expected a:b:share") from None
            return ((1.0 - s) * self.embedding(a) + s * self.embedding(b)).astype(np.float32)
        raise InputError(f"lighting {lighting!r}: unknown; the field has {', '.join(self.names)}")
