"""Fits an appearance embedding and fog to a photo of a field's place, with the field frozen."""

import math

import numpy as np
import torch
from numpy.typing import NDArray

from twin.nerf import network
from twin.nerf.field import RadianceField
from twin.nerf.fog import REACH, Fog

_STEPS = 40
_RATE = 0.05  # of the embedding
_PRIOR = 1e-3  # weight of the distance from the initial embedding, as of residuals in training
_INITIAL_EXTINCTION = 2.5e-3  # [1/m]
_EXTINCTION_RATE, _AIRLIGHT_RATE = 0.3, 0.05  # the first of the logarithm of extinction
_MAX_EXTINCTION = 0.1  # [1/m], a visibility of 30 m: a denser veil is probably on the lens
_FARTHEST_SHARE = 0.25  # share of the rays, the farthest, whose mean color initializes the airlight


def fit_appearance(
    field: RadianceField,
    features: torch.Tensor,
    harmonics: torch.Tensor,
    colors: torch.Tensor,
    start: NDArray[np.float32],
    steps: int = _STEPS,
    distances: torch.Tensor | None = None,
) -> tuple[NDArray[np.float32], Fog]:
    """Fits the embedding (dim,) and the fog under which traced rays have given colors (n, 3) in [0, 1].

    Features (n, CHANNELS − 1) and harmonics (n, 16) come from `RadianceField.trace`. The embedding starts at `start`,
    the mean of its prior. Fog is fitted only with distances along the rays [m], shape (n,).
    """
    origin = torch.as_tensor(start, device=features.device)
    embedding = origin.clone().requires_grad_(True)
    parameters, rates = [embedding], [_RATE]
    if distances is not None:
        distances = distances.clamp(max=REACH)
        farthest = distances.topk(max(1, int(_FARTHEST_SHARE * len(distances)))).indices
        log_extinction = torch.tensor(math.log(_INITIAL_EXTINCTION), device=features.device, requires_grad=True)
        airlight = colors[farthest].mean(0).clone().requires_grad_(True)
        parameters += [log_extinction, airlight]
        rates += [_EXTINCTION_RATE, _AIRLIGHT_RATE]
    optimizer = torch.optim.Adam([{"params": [p], "lr": rate} for p, rate in zip(parameters, rates, strict=True)])
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1.0 - step / steps)
    for _ in range(steps):
        rgb = network.head(field.parameters, features, harmonics, embedding)
        if distances is not None:
            kept = torch.exp(-torch.exp(log_extinction) * distances)[:, None]
            rgb = kept * rgb + (1.0 - kept) * airlight
        loss = ((rgb - colors) ** 2).mean() + _PRIOR * ((embedding - origin) ** 2).mean()
        for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
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
