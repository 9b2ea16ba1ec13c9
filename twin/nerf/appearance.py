"""What makes one place look different: the appearance embedding.

The embedding of a frame is its *lighting*'s vector plus a *residual* of its own, which is kept small and takes up what
drifts within a film (exposure). A *lighting* can be asked for by name, as a frame (`day/000012`), or as a mixture
`day:night:0.3`, which is 30 % of the way from day to night.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from twin.errors import InputError


class Appearance:
    """The embeddings of a field's lightings and frames."""

    def __init__(
        self,
        lightings: tuple[str, ...],
        frames: tuple[str, ...],
        frame_lighting: NDArray[np.int64],
        vectors: torch.Tensor,
        residuals: torch.Tensor,
    ):
        """
        Args:
            lightings: Names, in the order of `vectors`.
            frames: Names of the training frames, in the order of `residuals`.
            frame_lighting: Index of each frame's lighting, shape (n,).
            vectors: Shape (lightings, dim).
            residuals: Shape (n, dim).
        """
        self.lightings, self.frames, self.frame_lighting = lightings, frames, frame_lighting
        self.vectors, self.residuals = vectors, residuals
        self.lighting_of_frame = torch.as_tensor(frame_lighting, device=vectors.device)

    def of_frames(self, frame: torch.Tensor) -> torch.Tensor:
        """Embeddings of frame indices, shape (k,) → (k, dim)."""
        return self.vectors[self.lighting_of_frame[frame]] + self.residuals[frame]

    def embedding(self, lighting: str) -> NDArray[np.float32]:
        """The embedding of a lighting, a frame or a mixture, shape (dim,).

        Raises:
            InputError: an unknown name, or a mixture that is not `a:b:share`.
        """
        if lighting in self.lightings:
            return self.vectors[self.lightings.index(lighting)].detach().cpu().numpy()
        if lighting in self.frames:
            i = self.frames.index(lighting)
            vector = self.vectors[int(self.frame_lighting[i])] + self.residuals[i]
            return vector.detach().cpu().numpy()
        if lighting.count(":") == 2:
            a, b, share = lighting.split(":")
            try:
                s = float(share)
            except ValueError:
                raise InputError(f"lighting {lighting!r}: {share!r} is no number; expected a:b:share") from None
            return ((1.0 - s) * self.embedding(a) + s * self.embedding(b)).astype(np.float32)
        raise InputError(f"lighting {lighting!r}: unknown; the field has {', '.join(self.lightings)}")


def initial_appearance(
    lightings: tuple[str, ...], frames: tuple[str, ...], frame_lighting: NDArray[np.int64], dim: int, seed: int
) -> Appearance:
    """Lightings apart at random, residuals zero."""
    rng = np.random.default_rng([seed, 1])
    vectors = torch.as_tensor(rng.normal(0.0, 0.3, (len(lightings), dim)).astype(np.float32))
    return Appearance(lightings, frames, frame_lighting, vectors, torch.zeros(len(frames), dim))
