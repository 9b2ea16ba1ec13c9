"""The two small networks: one per sample, one per ray.

The *trunk* turns the hash features of a sample into its raw density and features. The *head* turns the features
composited along a ray, its direction and an appearance embedding into a colour, so that a lighting is a constant of
the picture and no matter of the samples. What no surface stops takes its features from the *backdrop*, a network of
the direction alone: sky needs no density.
"""

import torch

from twin.nerf.kernels.composite import CHANNELS

_SH = 16  # spherical harmonics up to degree 3


def initial_parameters(inputs: int, hidden: int, appearance_dim: int, seed: int) -> dict[str, torch.Tensor]:
    """Weights of trunk, head and backdrop, drawn as He et al. 2015 do for rectifiers."""
    generator = torch.Generator().manual_seed(seed)
    features = CHANNELS - 1

    def he(rows: int, columns: int, gain: float = 2.0) -> torch.Tensor:
        return torch.randn(rows, columns, generator=generator) * (gain / rows) ** 0.5

    return {
        "trunk.0": he(inputs, hidden),
        "trunk.1": he(hidden, CHANNELS, 1.0),
        "head.0": he(features + _SH + appearance_dim, hidden),
        "head.0.bias": torch.zeros(hidden),
        "head.1": he(hidden, hidden),
        "head.1.bias": torch.zeros(hidden),
        "head.2": he(hidden, 3, 1.0),
        "head.2.bias": torch.zeros(3),
        "backdrop.0": he(_SH, hidden // 2),
        "backdrop.0.bias": torch.zeros(hidden // 2),
        "backdrop.1": he(hidden // 2, features, 1.0),
    }


def spherical_harmonics(d: torch.Tensor) -> torch.Tensor:
    """Real spherical harmonics of degree 0 to 3 of unit vectors, up to constant factors, shape (n, 3) → (n, 16)."""
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.ones_like(x),
            *(x, y, z),
            *(x * y, y * z, 3.0 * zz - 1.0, x * z, xx - yy),
            *(y * (3.0 * xx - yy), x * y * z, y * (5.0 * zz - 1.0), z * (5.0 * zz - 3.0)),
            *(x * (5.0 * zz - 1.0), z * (xx - yy), x * (xx - 3.0 * yy)),
        ],
        -1,
    )


def trunk(p: dict[str, torch.Tensor], features: torch.Tensor, hidden: torch.Tensor, out: torch.Tensor) -> None:
    """Raw density and features of samples into `out` (n, CHANNELS); `hidden` (n, width) is kept for the way back."""
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
    """Gradients of both weight matrices; that of the features goes into `features_grad`."""
    second = hidden.t() @ out_grad
    torch.mm(out_grad, p["trunk.1"].t(), out=hidden_grad)
    torch.ops.aten.threshold_backward.grad_input(hidden_grad, hidden, 0, grad_input=hidden_grad)
    first = features.t() @ hidden_grad
    torch.mm(hidden_grad, p["trunk.0"].t(), out=features_grad)
    return first, second


def ray_features(p: dict[str, torch.Tensor], composited: torch.Tensor, harmonics: torch.Tensor) -> torch.Tensor:
    """Features of rays with the backdrop behind them, shape (n, CHANNELS − 1). Slot 0 of `composited` is opacity."""
    backdrop = torch.relu(harmonics @ p["backdrop.0"] + p["backdrop.0.bias"]) @ p["backdrop.1"]
    return composited[:, 1:] + (1.0 - composited[:, :1]) * backdrop


def head(
    p: dict[str, torch.Tensor], features: torch.Tensor, harmonics: torch.Tensor, embedding: torch.Tensor
) -> torch.Tensor:
    """Colour in [0, 1], shape (n, 3), of rays under embeddings of shape (n, dim) or (dim,)."""
    f, s = features.shape[1], harmonics.shape[1]
    w = p["head.0"]
    # One embedding for all rays is one bias for all rays.
    x = features @ w[:f] + harmonics @ w[f : f + s] + (embedding @ w[f + s :] + p["head.0.bias"])
    x = torch.relu(torch.relu(x) @ p["head.1"] + p["head.1.bias"])
    return torch.sigmoid(x @ p["head.2"] + p["head.2.bias"])
