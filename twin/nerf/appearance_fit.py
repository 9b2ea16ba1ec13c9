"""The light and the air that a picture of a field's place was taken in, by optimisation with the field frozen."""

import math

import numpy as np
import torch
from numpy.typing import NDArray

from twin.nerf import network
from twin.nerf.field import RadianceField
from twin.nerf.fog import REACH, Fog

_STEPS = 40
_RATE = 0.05
_PRIOR = 1e-3  # pull towards the embedding to start from, as residuals are in training
_EXTINCTION = 2.5e-3  # [1/m] to start from
_EXTINCTION_RATE, _AIRLIGHT_RATE = 0.3, 0.05  # the first of its logarithm
_MOST_EXTINCTION = 0.1  # [1/m], a visibility of 30 m: a veil over what is nearer is rather of the lens
_FAR = 0.25  # share of the rays, the farthest, whose mean colour the airlight starts from


def fit_appearance(
    field: RadianceField,
    features: torch.Tensor,
    harmonics: torch.Tensor,
    colours: torch.Tensor,
    start: NDArray[np.float32],
    steps: int = _STEPS,
    distances: torch.Tensor | None = None,
) -> tuple[NDArray[np.float32], Fog]:
    """The embedding and the air under which traced rays (see `RadianceField.trace`) look like `colours`.

    Args:
        field: Stays as it is.
        features: Shape (n, CHANNELS − 1).
        harmonics: Shape (n, 16).
        colours: In [0, 1], shape (n, 3).
        start: Embedding to start from and stay near to, shape (dim,).
        steps: Of the optimiser.
        distances: Along the rays [m], shape (n,); without them the air is taken for clear.
    """
    origin = torch.as_tensor(start, device=features.device)
    embedding = origin.clone().requires_grad_(True)
    parameters, rates = [embedding], [_RATE]
    if distances is not None:
        distances = distances.clamp(max=REACH)
        farthest = distances.topk(max(1, int(_FAR * len(distances)))).indices
        log_extinction = torch.tensor(math.log(_EXTINCTION), device=features.device, requires_grad=True)
        airlight = colours[farthest].mean(0).clone().requires_grad_(True)
        parameters += [log_extinction, airlight]
        rates += [_EXTINCTION_RATE, _AIRLIGHT_RATE]
    optimiser = torch.optim.Adam([{"params": [p], "lr": rate} for p, rate in zip(parameters, rates, strict=True)])
    falls = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 1.0 - step / steps)
    for _ in range(steps):
        rgb = network.head(field.parameters, features, harmonics, embedding)
        if distances is not None:
            kept = torch.exp(-torch.exp(log_extinction) * distances)[:, None]
            rgb = kept * rgb + (1.0 - kept) * airlight
        loss = ((rgb - colours) ** 2).mean() + _PRIOR * ((embedding - origin) ** 2).mean()
        for parameter, slope in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = slope
        optimiser.step()
        falls.step()
        if distances is not None:
            with torch.no_grad():
                log_extinction.clamp_(max=math.log(_MOST_EXTINCTION))
                airlight.clamp_(0.0, 1.0)
    air = Fog()
    if distances is not None:
        red, green, blue = airlight.tolist()
        air = Fog(float(log_extinction.detach().exp()), (red, green, blue))
    return embedding.detach().cpu().numpy(), air
