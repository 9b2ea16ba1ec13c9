"""Behavior cloning of recorded drives.

    twin film scenes/demo --task straight --lerobot drives --episodes 20 --randomise
    python examples/imitation.py drives
    cd examples && twin film ../scenes/demo --task straight --policy imitation:act

The last command drives by `act`, with the weights in `imitation.safetensors`.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_model, save_model
from torch import nn

from twin.report.drive_dataset import read_drives

WEIGHTS = Path(__file__).with_name("imitation.safetensors")
STACK = 4  # pictures that a policy sees, the newest last

torch.manual_seed(0)
EYES = [nn.Conv2d(3 * STACK, 32, 5, 4), nn.ReLU(), nn.Conv2d(32, 32, 3, 2), nn.ReLU(), nn.AdaptiveAvgPool2d((4, 8))]
MODEL = nn.Sequential(*EYES, nn.Flatten(), nn.Linear(1024, 64), nn.ReLU(), nn.Linear(64, 2), nn.Tanh())


def act(pixels: np.ndarray) -> np.ndarray:
    """Speed and yaw rate as an action in [-1, 1], shape (2,), from a stack of four pictures (12, height, width)."""
    return MODEL(torch.as_tensor(pixels[None]).float() / 255.0 - 0.5)[0].detach().numpy()


def train(dataset: Path, steps: int = 2000) -> None:
    pictures, actions, frame = (torch.as_tensor(values) for values in read_drives(dataset))
    optimizer = torch.optim.Adam(MODEL.parameters(), 1e-3)
    for step in range(steps):
        some = torch.randint(len(actions), (64,))
        # At the start of a drive, the stack has the first picture several times, as in the environment.
        stack = [pictures[some - frame[some].clamp(max=back)] for back in reversed(range(STACK))]
        seen = torch.cat(stack, -1).permute(0, 3, 1, 2).float() / 255.0 - 0.5
        loss = (MODEL(seen) - actions[some]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 200 == 0 or step == steps - 1:
            print(f"step {step}: mean squared error {loss.item():.4f}")
    save_model(MODEL, WEIGHTS)


if __name__ == "__main__":
    train(Path(sys.argv[1]))
elif WEIGHTS.exists():
    load_model(MODEL, WEIGHTS)
