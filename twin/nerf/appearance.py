"""Appearance embeddings in torch: the embeddings that training learns, and the fit of an embedding to a photo.

Training learns a vector per lighting plus a small residual per frame, which captures gradual changes within a film,
such as exposure. `lightings.py` looks embeddings up by name.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from twin.nerf import network
from twin.nerf.lightings import FOG_REACH, Fog, Lightings
from twin.types import Array32


class Appearance:
    """Embeddings of a field's lightings and frames."""

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
            lightings: Names of the lightings, whose embeddings are `vectors` (lightings, dim).
            frames: Names of the training frames, whose residuals are `residuals` (n, dim).
            frame_lighting: Index of each frame's lighting, shape (n,).
        """
        self.lightings, self.frames, self.frame_lighting = lightings, frames, frame_lighting
        self.vectors, self.residuals = vectors, residuals
        self.lighting_of_frame = torch.as_tensor(frame_lighting, device=vectors.device)

    def of_frames(self, frame: torch.Tensor) -> torch.Tensor:
        """Embeddings (k, dim) of frame indices (k,)."""
        return self.vectors[self.lighting_of_frame[frame]] + self.residuals[frame]

    def named(self) -> Lightings:
        """All embeddings by name, as NumPy arrays."""
        every = torch.arange(len(self.frames), device=self.vectors.device)
        with torch.no_grad():
            vectors, frame_vectors = self.vectors.detach().cpu().numpy(), self.of_frames(every).cpu().numpy()
        return Lightings(self.lightings, vectors, self.frames, frame_vectors)


# ---- fit to a photo

_STEPS = 40
_RATE = 0.05  # learning rate of the embedding
_PRIOR = 1e-3  # weight of the squared distance from the initial embedding; the same as `trainer._RESIDUAL`
_INITIAL_EXTINCTION = 2.5e-3  # [1/m]
_EXTINCTION_RATE, _AIRLIGHT_RATE = 0.3, 0.05  # learning rates of the logarithm of extinction and of the airlight
_MAX_EXTINCTION = 0.1  # [1/m], a visibility of 30 m; a photo that needs more was probably made with a dirty lens
_FARTHEST_SHARE = 0.25  # share of the rays, the farthest ones, whose mean color initializes the airlight


class FogFit:
    """Fog that is fitted to colors of rays by gradient descent, see `descend`."""

    def __init__(self, extinction: float, airlight: torch.Tensor, distances: torch.Tensor) -> None:
        """Starts at an extinction [1/m] and an airlight (3,); `distances` along the rays [m], shape (n,)."""
        self._log_extinction = torch.tensor(math.log(extinction), device=distances.device, requires_grad=True)
        self._airlight = airlight.requires_grad_(True)
        self._distances = distances
        self.parameters = [self._log_extinction, self._airlight]

    def apply(self, rgb: torch.Tensor) -> torch.Tensor:
        """Colors (n, 3) in the fog."""
        kept = torch.exp(-torch.exp(self._log_extinction) * self._distances)[:, None]
        return kept * rgb + (1.0 - kept) * self._airlight

    def bound(self) -> None:
        """Limits the parameters."""
        self._log_extinction.clamp_(max=math.log(_MAX_EXTINCTION))
        self._airlight.clamp_(0.0, 1.0)

    def result(self) -> Fog:
        """The fog fitted so far."""
        red, green, blue = self._airlight.tolist()
        return Fog(float(self._log_extinction.detach().exp()), (red, green, blue))


def descend(
    fitted: Sequence[tuple[torch.Tensor, float]],
    steps: int,
    loss: Callable[[], torch.Tensor],
    bound: Callable[[], None],
) -> None:
    """Minimizes a loss over tensors, each with its initial learning rate, by Adam.

    The rates fall linearly to zero. `bound` is called after each step, without recording gradients.
    """
    tensors = [tensor for tensor, _ in fitted]
    optimizer = torch.optim.Adam([{"params": [tensor], "lr": rate} for tensor, rate in fitted])
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0 - step / steps)
    for _ in range(steps):
        for tensor, gradient in zip(tensors, torch.autograd.grad(loss(), tensors), strict=True):
            tensor.grad = gradient
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            bound()


def fit_appearance(
    parameters: dict[str, torch.Tensor],
    features: torch.Tensor,
    harmonics: torch.Tensor,
    colors: torch.Tensor,
    start: Array32,
    steps: int = _STEPS,
    distances: torch.Tensor | None = None,
) -> tuple[Array32, Fog]:
    """Fits an embedding (dim,) and fog, such that traced rays get the given colors (n, 3) in [0, 1].

    `parameters`, the weights of the field's networks, stay fixed. Features (n, CHANNELS − 1) and harmonics
    (n, 16) come from `RadianceField.trace`. The embedding starts at `start`, the mean of its prior. Fog is fitted only
    if `distances` along the rays [m], shape (n,), are given.
    """
    origin = torch.as_tensor(start, device=features.device)
    embedding = origin.clone().requires_grad_(True)
    fitted, fog = [(embedding, _RATE)], None
    if distances is not None:
        distances = distances.clamp(max=FOG_REACH)
        farthest = distances.topk(max(1, int(_FARTHEST_SHARE * len(distances)))).indices
        fog = FogFit(_INITIAL_EXTINCTION, colors[farthest].mean(0).clone(), distances)
        fitted += zip(fog.parameters, (_EXTINCTION_RATE, _AIRLIGHT_RATE), strict=True)

    def loss() -> torch.Tensor:
        rgb = network.head(parameters, features, harmonics, embedding)
        rgb = fog.apply(rgb) if fog else rgb
        return ((rgb - colors) ** 2).mean() + _PRIOR * ((embedding - origin) ** 2).mean()

    descend(fitted, steps, loss, fog.bound if fog else lambda: None)
    return embedding.detach().cpu().numpy(), fog.result() if fog else Fog()
