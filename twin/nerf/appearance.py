"""Appearance embeddings in torch: the embeddings that training learns, and the fit of an embedding to a photo.

Training learns a vector per lighting plus a small residual per frame, which captures gradual changes within a film,
such as exposure. `lightings.py` looks embeddings up by name.
"""

import math

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
        stale: tuple[str, ...] = (),
    ):
        """
        Args:
            lightings: Names of the lightings, whose embeddings are `vectors` (lightings, dim).
            frames: Names of the training frames, whose residuals are `residuals` (n, dim).
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

    def added(self, more: dict[str, Array32], stale: tuple[str, ...] = ()) -> "Appearance":
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


# ---- fit to a photo

_STEPS = 40
_RATE = 0.05  # learning rate of the embedding
_PRIOR = 1e-3  # weight of the squared distance from the initial embedding; the same as `trainer._RESIDUAL`
_INITIAL_EXTINCTION = 2.5e-3  # [1/m]
_EXTINCTION_RATE, _AIRLIGHT_RATE = 0.3, 0.05  # learning rates of the logarithm of extinction and of the airlight
_MAX_EXTINCTION = 0.1  # [1/m], a visibility of 30 m; a photo that needs more was probably made with a dirty lens
_FARTHEST_SHARE = 0.25  # share of the rays, the farthest ones, whose mean color initializes the airlight


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
    fitted, rates = [embedding], [_RATE]
    if distances is not None:
        distances = distances.clamp(max=FOG_REACH)
        farthest = distances.topk(max(1, int(_FARTHEST_SHARE * len(distances)))).indices
        log_extinction = torch.tensor(math.log(_INITIAL_EXTINCTION), device=features.device, requires_grad=True)
        airlight = colors[farthest].mean(0).clone().requires_grad_(True)
        fitted += [log_extinction, airlight]
        rates += [_EXTINCTION_RATE, _AIRLIGHT_RATE]
    optimizer = torch.optim.Adam([{"params": [p], "lr": rate} for p, rate in zip(fitted, rates, strict=True)])
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0 - step / steps)
    for _ in range(steps):
        rgb = network.head(parameters, features, harmonics, embedding)
        if distances is not None:
            kept = torch.exp(-torch.exp(log_extinction) * distances)[:, None]
            rgb = kept * rgb + (1.0 - kept) * airlight
        loss = ((rgb - colors) ** 2).mean() + _PRIOR * ((embedding - origin) ** 2).mean()
        for parameter, gradient in zip(fitted, torch.autograd.grad(loss, fitted), strict=True):
            parameter.grad = gradient
        optimizer.step()
        schedule.step()
        if distances is not None:
            with torch.no_grad():
                log_extinction.clamp_(max=math.log(_MAX_EXTINCTION))
                airlight.clamp_(0.0, 1.0)
    fog = Fog()
    if distances is not None:
        red, green, blue = airlight.tolist()
        fog = Fog(float(log_extinction.detach().exp()), (red, green, blue))
    return embedding.detach().cpu().numpy(), fog
