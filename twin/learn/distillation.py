"""Distillation: a policy learns from pictures what the teacher does by the robot's state (`teacher.py`).

This is *learning by cheating* (Chen et al. 2019). SAC from pixels has to learn from rewards what to see and what to do
at once; the teacher has learned the latter, so the policy is fitted by regression. Most pictures are from very short
episodes, which start anywhere on the route, beside it and turned; the others from whole drives of the policy itself, so
that it knows what it will see (DAgger, Ross et al. 2011). Its loss is the squared error of its actions and, from its
features, of the robot's state.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from safetensors.torch import save as tensor_bytes
from torch import nn

from twin.files import (
    load_arrays,
    read_json,
    regular_file,
    remove,
    save_arrays,
    wrap_read_errors,
    write_bytes,
    write_json,
)
from twin.learn.policy_network import NORM_EPSILON, Architecture
from twin.learn.replay_buffer import PictureBuffer
from twin.learn.teacher import STATE_SCALES, Teacher
from twin.types import Array32

_NOISE = 0.15  # standard deviation of the noise on actions in training
_ACTION_WEIGHT = 10.0  # weight of the actions' error; states are scaled to errors of up to about 1
_AVERAGING_RATE = 5e-3  # fraction of the network that each update mixes into the averaged one
_STATE, _TENSORS, _BUFFER = "state.json", "tensors.safetensors", "buffer.npz"


class Encoder(nn.Module):
    """The layers of `Architecture` that convert preprocessed stacks, with values 0 to 255, to features."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = architecture.channels
        for channels, kernel, stride in architecture.convolutions:
            layers += [nn.Conv2d(before, channels, kernel, stride), nn.ReLU()]
            before = channels
        assert isinstance(layers[0], nn.Conv2d)
        self.first, self.further = layers[0], nn.Sequential(*layers[1:], nn.Flatten())
        self.linear = nn.Linear(before * architecture.grid[0] * architecture.grid[1], architecture.features)
        self.norm = nn.LayerNorm(architecture.features, NORM_EPSILON)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """Shapes (n, 3 · stack, h, w) → (n, features)."""
        # The first convolution's weights are scaled instead of the pictures, which saves a third of an update's time.
        weight = self.first.weight
        bias = self.first.bias - 0.5 * weight.sum((1, 2, 3))  # type: ignore[operator]
        out = nn.functional.conv2d(pictures.float(), weight / 255.0, bias, self.first.stride)
        return torch.tanh(self.norm(self.linear(self.further(out))))


class PolicyNetwork(nn.Module):
    """The network of `Architecture`, and a linear layer that predicts the robot's scaled state from the features."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.encoder = Encoder(architecture)
        layers: list[nn.Module] = []
        before = architecture.features
        for width in architecture.hidden:
            layers += [nn.Linear(before, width), nn.ReLU()]
            before = width
        self.hidden, self.mean = nn.Sequential(*layers), nn.Linear(before, architecture.actions)
        self.state_head = nn.Linear(architecture.features, len(STATE_SCALES))

    def forward(self, pictures: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions (n, actions) in [-1, 1], and scaled states (n, 10), for stacks (n, 3 · stack, h, w)."""
        features = self.encoder(pictures)
        return torch.tanh(self.mean(self.hidden(features))), self.state_head(features)

    def weights(self, architecture: Architecture) -> dict[str, Array32]:
        """The weights without the state head's; the names are those of `Architecture.shapes`."""
        convolutions = [self.encoder.first, *(m for m in self.encoder.further if isinstance(m, nn.Conv2d))]
        hidden = [m for m in self.hidden if isinstance(m, nn.Linear)]
        modules: dict[str, Any] = {f"conv.{i}": m for i, m in enumerate(convolutions)}
        modules |= {"features": self.encoder.linear, "norm": self.encoder.norm, "mean": self.mean}
        modules |= {f"hidden.{i}": m for i, m in enumerate(hidden)}
        out = {}
        for name in architecture.shapes():
            module, parameter = name.rsplit(".", 1)
            out[name] = getattr(modules[module], parameter).detach().cpu().numpy().copy()
        return out


class Distillation:
    """A policy in training, its teacher, and the pictures seen so far."""

    def __init__(
        self, architecture: Architecture, teacher: Teacher, buffer: PictureBuffer, seed: int = 0, device: str = "cpu"
    ) -> None:
        torch.manual_seed(seed)
        self.device = torch.device(device)
        self.network = PolicyNetwork(architecture).to(self.device)
        self.averaged = PolicyNetwork(architecture).to(self.device).requires_grad_(False)
        """Running mean of the network, which is saved as the policy. The network itself fluctuates between updates: a
        policy saved at a bad moment would leave the road."""
        self.averaged.load_state_dict(self.network.state_dict())
        self.teacher, self.buffer = teacher.to(self.device), buffer
        self.optimizer = torch.optim.Adam(self.network.parameters())
        self.steps, self.updates = 0, 0

    @torch.no_grad()
    def act(self, stacks: NDArray[np.uint8]) -> Array32:
        """Actions with noise, shape (n, actions), for preprocessed stacks."""
        actions, _ = self.network(torch.as_tensor(stacks, device=self.device))
        return (actions + _NOISE * torch.randn_like(actions)).clamp(-1.0, 1.0).cpu().numpy()

    def update(self, batch: int, rate: float) -> tuple[float, float]:
        """Updates the policy; returns the root-mean-square errors of actions and of scaled states.

        Args:
            batch: Number of samples.
            rate: Learning rate.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        stacks, states = self.buffer.sample(batch)
        actions, predicted = self.network(stacks)
        action_loss = nn.functional.mse_loss(actions, self.teacher(states))
        state_loss = nn.functional.mse_loss(predicted, self.teacher.scaled(states))
        self.optimizer.zero_grad()
        (_ACTION_WEIGHT * action_loss + state_loss).backward()
        self.optimizer.step()
        self.updates += 1
        share = max(_AVERAGING_RATE, 1.0 / self.updates)
        with torch.no_grad():
            for mean, new in zip(self.averaged.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(new, share)
        return action_loss.item() ** 0.5, state_loss.item() ** 0.5


# ---- saved states
#
# A saved state contains the whole training. Loading it runs no code: tensors are in a safetensors file, states and ages
# of the pictures in an npz file, the rest in a JSON file. These files are in a folder `state_<steps>`. The file
# `state.json` names this folder and is written last, so a killed training leaves one complete state.


def save_state(folder: Path, learner: Distillation, more: dict[str, Any]) -> None:
    """Writes a state, with the JSON-able values `more`, and then removes the previous state.

    Raises OSError: the disk is full; the previous state is intact.
    """
    name = f"state_{learner.steps:09d}"
    remove(folder / name)
    (folder / name).mkdir(parents=True)
    try:
        write_bytes(folder / name / _TENSORS, tensor_bytes(_tensors(learner)))
        arrays, pictures = learner.buffer.state()
        save_arrays(folder / name / _BUFFER, arrays)
    except OSError:  # free some space, so that the error can be logged
        remove(folder / name)
        raise
    counts = {"steps": learner.steps, "updates": learner.updates}
    write_json(folder / _STATE, {"folder": name, **counts, "buffer": pictures, "more": more})
    for old in folder.glob("state_*"):
        if old.name != name:
            shutil.rmtree(old)


def has_state(folder: Path) -> bool:
    return (folder / _STATE).exists()


def saved_steps(folder: Path) -> int:
    """Number of control steps done when the state was saved."""
    with wrap_read_errors(folder / _STATE, "train again under another name"):
        return int(read_json(folder / _STATE)["steps"])


def load_state(folder: Path, learner: Distillation) -> dict[str, Any]:
    """Restores the saved state in a new learner; returns the values given to `save_state` as `more`.

    Raises InputError: files are missing or damaged, or belong to another network.
    """
    with wrap_read_errors(folder, "train again under another name"):
        head = read_json(folder / _STATE)
        state = folder / Path(head["folder"]).name
        tensors = load_file(regular_file(state / _TENSORS))
        learner.buffer.set_state(load_arrays(state / _BUFFER), head["buffer"])
        _set_tensors(learner, tensors)
        learner.steps, learner.updates = int(head["steps"]), int(head["updates"])
        return dict(head["more"])


def _tensors(learner: Distillation) -> dict[str, torch.Tensor]:
    out = {"rng": torch.get_rng_state()}
    for name, module in {"network": learner.network, "averaged": learner.averaged}.items():
        out |= {f"{name}.{key}": value for key, value in module.state_dict().items()}
    for i, values in learner.optimizer.state_dict()["state"].items():
        out |= {f"optimizer.{i}.{key}": value for key, value in values.items()}
    if torch.cuda.is_available():
        out["rng.cuda"] = torch.cuda.get_rng_state()
    return {name: value.detach().cpu().clone().contiguous() for name, value in out.items()}


def _set_tensors(learner: Distillation, tensors: dict[str, torch.Tensor]) -> None:
    for name, module in {"network": learner.network, "averaged": learner.averaged}.items():
        own = {n.removeprefix(f"{name}."): value for n, value in tensors.items() if n.startswith(f"{name}.")}
        module.load_state_dict(own)
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith("optimizer."):
            _, i, field = key.split(".")
            state.setdefault(int(i), {})[field] = value
    learner.optimizer.load_state_dict({**learner.optimizer.state_dict(), "state": state})
    torch.set_rng_state(tensors["rng"])
    if "rng.cuda" in tensors and torch.cuda.is_available():
        torch.cuda.set_rng_state(tensors["rng.cuda"])
