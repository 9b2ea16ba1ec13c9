"""Appearance embeddings in training: a vector per lighting plus a small residual per frame.

The per-frame residual captures gradual changes within a film, such as exposure. `lightings.py` looks embeddings up by
name.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from twin.nerf.lightings import Lightings


class Appearance:
    """Embeddings of a field's lightings and frames."""

    def __init__(
        self,
        lightings: tuple[str, ...],
        frames: tuple[str, ...],
        frame_lighting: NDArray[np.int64],
        vectors: torch.Tensor,
        residuals: torch.Tensor,
        stale: tuple[str, ...] = (),
    ):
        """
        Args:
            lightings: Names of the `vectors` (lightings, dim).
            frames: Names of the training frames, of the `residuals` (n, dim).
            frame_lighting: Index of each frame's lighting, shape (n,).
            stale: See `Lightings.stale`.
        """
        self.lightings, self.frames, self.frame_lighting = lightings, frames, frame_lighting
        self.vectors, self.residuals, self.stale = vectors, residuals, stale
        self.lighting_of_frame = torch.as_tensor(frame_lighting, device=vectors.device)

    def of_frames(self, frame: torch.Tensor) -> torch.Tensor:
        """Embeddings (k, dim) of frame indices (k,)."""
        return self.vectors[self.lighting_of_frame[frame]] + self.residuals[frame]

    def named(self) -> Lightings:
        """All embeddings by name, as NumPy arrays."""
        every = torch.arange(len(self.frames), device=self.vectors.device)
        with torch.no_grad():
            vectors, frame_vectors = self.vectors.detach().cpu().numpy(), self.of_frames(every).cpu().numpy()
        return Lightings(self.lightings, vectors, self.frames, frame_vectors, stale=self.stale)

    def embedding(self, lighting: str) -> NDArray[np.float32]:
        """See `Lightings.embedding`."""
        return self.named().embedding(lighting)

    def added(self, more: dict[str, NDArray[np.float32]], stale: tuple[str, ...] = ()) -> "Appearance":
        """See `Lightings.added`."""
        new = [torch.as_tensor(vector, device=self.vectors.device)[None] for vector in more.values()]
        return Appearance(
            *((*self.lightings, *more), self.frames, self.frame_lighting, torch.cat([self.vectors, *new])),
            *(self.residuals, (*self.stale, *stale)),
        )


def initial_appearance(
    lightings: tuple[str, ...], frames: tuple[str, ...], frame_lighting: NDArray[np.int64], dim: int, seed: int
) -> Appearance:
    """Random lighting vectors and zero residuals."""
    rng = np.random.default_rng([seed, 1])
    vectors = torch.as_tensor(rng.normal(0.0, 0.3, (len(lightings), dim)).astype(np.float32))
    return Appearance(lightings, frames, frame_lighting, vectors, torch.zeros(len(frames), dim))
