"""The light and the air that a picture of a field's place was taken in, by optimisation with the field frozen."""

import numpy as np
import torch
from numpy.typing import NDArray

from twin.nerf import network
from twin.nerf.air import REACH, Air
from twin.nerf.field import RadianceField

_STEPS = 40
_RATE = 0.05
_PRIOR = 1e-3  # pull towards the embedding to start from, as residuals are in training
_EXTINCTION = 2.5e-3  # [1/m] to start from
_EXTINCTION_RATE, _AIRLIGHT_RATE = 0.1, 0.01  # the first of its logarithm
_FAR = 0.25  # share of the rays, the farthest, whose mean colour the airlight starts from


def fit_embedding(
    field: RadianceField,
    features: torch.Tensor,
    harmonics: torch.Tensor,
    colours: torch.Tensor,
    start: NDArray[np.float32],
    steps: int = _STEPS,
) -> NDArray[np.float32]:
    """The embedding under which traced rays (see `RadianceField.trace`) look like `colours`, in clear air.

    Args:
        field: Stays as it is.
        features: Shape (n, CHANNELS − 1).
        harmonics: Shape (n, 16).
        colours: In [0, 1], shape (n, 3).
        start: Embedding to start from and stay near to, shape (dim,).
        steps: Of the optimiser.
    """
    return _fit(field, features, harmonics, colours, start, steps, None)[0]


def fit_light_and_air(
    field: RadianceField,
    features: torch.Tensor,
    harmonics: torch.Tensor,
    colours: torch.Tensor,
    distances: torch.Tensor,
    start: NDArray[np.float32],
    steps: int = _STEPS,
) -> tuple[NDArray[np.float32], Air]:
    """As `fit_embedding`, and the air through which they look so; distances along the rays [m], shape (n,)."""
    embedding, air = _fit(field, features, harmonics, colours, start, steps, distances)
    assert air is not None
    return embedding, air


def _fit(
    field: RadianceField,
    features: torch.Tensor,
    harmonics: torch.Tensor,
    colours: torch.Tensor,
    start: NDArray[np.float32],
    steps: int,
    distances: torch.Tensor | None,
) -> tuple[NDArray[np.float32], Air | None]:
    origin = torch.as_tensor(start, device=features.device)
    embedding = origin.clone().requires_grad_(True)
    groups = [{"params": [embedding], "rate": _RATE}]
    if distances is not None:
        distances = distances.clamp(max=REACH)
        farthest = distances.topk(max(1, int(_FAR * len(distances)))).indices
        log_extinction = torch.tensor(float(np.log(_EXTINCTION)), device=features.device, requires_grad=True)
        airlight = colours[farthest].mean(0).clone().requires_grad_(True)
        groups += [
            {"params": [log_extinction], "rate": _EXTINCTION_RATE},
            {"params": [airlight], "rate": _AIRLIGHT_RATE},
        ]
    parameters = [p for group in groups for p in group["params"]]  # type: ignore[attr-defined]
    optimiser = torch.optim.Adam(groups, lr=_RATE)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = group["rate"] * (1.0 - step / steps)
        rgb = network.head(field.parameters, features, harmonics, embedding)
        if distances is not None:
            kept = torch.exp(-torch.exp(log_extinction) * distances)[:, None]
            rgb = kept * rgb + (1.0 - kept) * airlight
        loss = ((rgb - colours) ** 2).mean() + _PRIOR * ((embedding - origin) ** 2).mean()
        for parameter, slope in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            parameter.grad = slope
        optimiser.step()
    air = None
    if distances is not None:
        red, green, blue = airlight.detach().clamp(0.0, 1.0).tolist()
        air = Air(float(log_extinction.exp().detach()), (red, green, blue))
    return embedding.detach().cpu().numpy(), air
