"""The field's networks: trunk per sample, head and background per ray.

The *trunk* maps hash features of a sample to raw density and features. The *head* maps the features composited along a
ray, the ray's direction and an appearance embedding to a color. So samples do not depend on the lighting. The
*background* network (`backdrop.*`) maps the direction alone to the features of the sky, so the sky needs no density.
"""

import torch

from twin.nerf.kernels.color_head import HARMONICS, harmonics_of
from twin.nerf.kernels.volume import CHANNELS


def initial_parameters(inputs: int, hidden: int, appearance_dim: int, seed: int) -> dict[str, torch.Tensor]:
    """Random weights of trunk, head and background (He et al. 2015)."""
    generator = torch.Generator().manual_seed(seed)
    features = CHANNELS - 1

    def he(rows: int, columns: int, gain: float = 2.0) -> torch.Tensor:
        return torch.randn(rows, columns, generator=generator) * (gain / rows) ** 0.5

    return {
        "trunk.0": he(inputs, hidden),
        "trunk.1": he(hidden, CHANNELS, 1.0),
        "head.0": he(features + HARMONICS + appearance_dim, hidden),
        "head.0.bias": torch.zeros(hidden),
        "head.1": he(hidden, hidden),
        "head.1.bias": torch.zeros(hidden),
        "head.2": he(hidden, 3, 1.0),
        "head.2.bias": torch.zeros(3),
        "backdrop.0": he(HARMONICS, hidden // 2),
        "backdrop.0.bias": torch.zeros(hidden // 2),
        "backdrop.1": he(hidden // 2, features, 1.0),
    }


def spherical_harmonics(d: torch.Tensor) -> torch.Tensor:
    """Spherical harmonics of unit vectors, shape (n, 3) → (n, 16), see `color_head.harmonics_of`."""
    x, y, z = d.unbind(-1)
    return torch.stack([torch.ones_like(x), *harmonics_of(x, y, z)], -1)


def trunk(p: dict[str, torch.Tensor], features: torch.Tensor, hidden: torch.Tensor, out: torch.Tensor) -> None:
    """Writes raw density and features to `out` (n, CHANNELS), and the hidden layer to `hidden` (n, width)."""
    torch.mm(features, p["trunk.0"], out=hidden)
    hidden.relu_()
    torch.mm(hidden, p["trunk.1"], out=out)


def trunk_backward(
    p: dict[str, torch.Tensor],
    features: torch.Tensor,
    hidden: torch.Tensor,
    out_grad: torch.Tensor,
    hidden_grad: torch.Tensor,
    features_grad: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradients of both weight matrices; writes the gradient of the features to `features_grad`."""
    second = hidden.t() @ out_grad
    torch.mm(out_grad, p["trunk.1"].t(), out=hidden_grad)
    torch.ops.aten.threshold_backward.grad_input(hidden_grad, hidden, 0, grad_input=hidden_grad)
    first = features.t() @ hidden_grad
    torch.mm(hidden_grad, p["trunk.0"].t(), out=features_grad)
    return first, second


def ray_features(p: dict[str, torch.Tensor], composited: torch.Tensor, harmonics: torch.Tensor) -> torch.Tensor:
    """Features of rays composited over the background, shape (n, CHANNELS − 1); `composited[:, 0]` is opacity."""
    background = torch.relu(harmonics @ p["backdrop.0"] + p["backdrop.0.bias"]) @ p["backdrop.1"]
    return composited[:, 1:] + (1.0 - composited[:, :1]) * background


def head(
    p: dict[str, torch.Tensor], features: torch.Tensor, harmonics: torch.Tensor, embedding: torch.Tensor
) -> torch.Tensor:
    """Colors in [0, 1], shape (n, 3), of rays under embeddings of shape (n, dim) or (dim,)."""
    f, s = features.shape[1], harmonics.shape[1]
    w = p["head.0"]
    # The product with an embedding (dim,) is one bias for all rays.
    x = features @ w[:f] + harmonics @ w[f : f + s] + (embedding @ w[f + s :] + p["head.0.bias"])
    x = torch.relu(torch.relu(x) @ p["head.1"] + p["head.1.bias"])
    return torch.sigmoid(x @ p["head.2"] + p["head.2.bias"])
