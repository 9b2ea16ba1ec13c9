"""What a field is trained to besides the colours of the pictures: how much each part counts, and what needs no kernel.

Distortion and depth are in `kernels/composite.py`, with the gradient of volume rendering.
"""

from dataclasses import dataclass

import torch

_EDGE = 10.0  # a contrast of 1/10 makes bending count e times less
_MOST_BEND = 0.5  # beyond this it is an edge of depth, whatever the colours say
_HORIZON = 0.03  # rays this near to level are neither above nor below the horizon [sine]


@dataclass(frozen=True)
class Weights:
    """How much each part of the loss counts."""

    distortion: float = 0.005
    depth: float = 1.0
    depth_reach: float = 0.5
    plane: float = 0.01
    free: float = 1e-3
    sky: float = 1e-2
    ground: float = 1e-2
    residual: float = 1e-3


def bending(inverse_depth: torch.Tensor, colour: torch.Tensor) -> torch.Tensor:
    """How far triples of rays are from seeing a plane, where their colours give no reason for an edge.

    The inverse z-depth of a plane is affine in the pixel, so its second difference vanishes on any plane; relative to
    the inverse depth itself it has no unit. The road has little texture, so this is what spreads the few known depths.

    Args:
        inverse_depth: Expected inverse z-depth [1/m], shape (3k,), triple after triple.
        colour: Shape (3k, 3).
    """
    d = inverse_depth.view(-1, 3)
    c = colour.view(-1, 3, 3)
    contrast = (c[:, 0] - c[:, 1]).abs().sum(-1) + (c[:, 2] - c[:, 1]).abs().sum(-1)
    bend = (d[:, 0] + d[:, 2] - 2.0 * d[:, 1]).abs() / (d.detach().mean(1) + 1e-3)
    return (torch.exp(-_EDGE * contrast) * bend.clamp(max=_MOST_BEND)).mean()


def horizon_loss(opacity: torch.Tensor, up: torch.Tensor, sky: float, ground: float) -> torch.Tensor:
    """Above the horizon what may be open is open (a plain sky fits at any distance); below it something is solid.

    Args:
        opacity: Of rays, shape (n,).
        up: Vertical component of their unit directions, shape (n,).
        sky: Cost of an opaque ray above the horizon.
        ground: Cost of an open ray below it.
    """
    above, below = (up > _HORIZON).float(), (up < -_HORIZON).float()
    return (sky * above * opacity + ground * below * (1.0 - opacity)).mean()
