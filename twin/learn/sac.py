"""SAC from pixels (Haarnoja et al. 2018) on stable-baselines3, and the saved states of a training.

Actor and critics share one encoder, which converts stacks to features. The actor's loss does not train it (Yarats et
al. 2019; Kostrikov et al. 2020), and it has no target network (Yarats et al. 2021, DrQ-v2). An update has two forward
passes and one backward pass of the encoder; with the separate encoders of stable-baselines3, it would have five and
three.

The critics, but not the actor, also receive the robot's privileged *state* (asymmetric actor-critic, Pinto et al.
2018). A linear *state head* predicts the state from the features; its error is an auxiliary loss for the encoder.
"""

import copy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from safetensors.torch import load_file
from safetensors.torch import save as tensor_bytes
from stable_baselines3 import SAC
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, SACPolicy
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
from twin.learn.replay_buffer import FrameReplayBuffer
from twin.types import Array32

_LOGGED = ("critic_loss", "actor_loss", "state_loss", "ent_coef", "value")
_MAX_STATE = 3.0  # states are clamped to ± this multiple of their scales
_AVERAGING_RATE = 1e-3  # fraction of the actor that each update mixes into the averaged actor
_STATE, _TENSORS, _REPLAY = "state.json", "tensors.safetensors", "replay.npz"


class Encoder(BaseFeaturesExtractor):
    """The layers of `Architecture` that convert preprocessed stacks, with values 0 to 255, to features."""

    def __init__(self, observation_space: spaces.Box, architecture: Architecture) -> None:
        super().__init__(observation_space, architecture.features)
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


class DrivePolicy(SACPolicy):
    """Actor and critics that share an encoder, which the critics' optimizer trains."""

    def __init__(self, *arguments: Any, state_size: int = 0, **rest: Any) -> None:
        self._state_size = state_size
        super().__init__(*arguments, **rest)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Returns critics whose inputs are features and states."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        kwargs["features_dim"] += self._state_size
        return ContinuousCritic(**kwargs).to(self.device)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        encoder = set(self.actor.features_extractor.parameters())
        rate = lr_schedule(1)
        own = [p for p in self.actor.parameters() if p not in encoder]
        self.actor.optimizer = self.optimizer_class(own, lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]
        self.critic.optimizer = self.optimizer_class(self.critic.parameters(), lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]


class PixelSAC(SAC):
    """SAC with a shared encoder and privileged states."""

    replay_buffer: FrameReplayBuffer
    ent_coef_optimizer: torch.optim.Adam
    log_ent_coef: torch.Tensor
    target_entropy: float
    averaged_actor: Actor
    """Running mean of the actor and its encoder, which is saved as the policy. The actor itself fluctuates between
    updates: a policy saved at a bad moment would leave the road."""

    def __init__(self, *arguments: Any, state_scales: tuple[float, ...] = (), **rest: Any) -> None:
        """`state_scales`: typical magnitude of each component of the privileged state; empty: no state is used.

        The other arguments are those of `SAC`.
        """
        self._scales = state_scales
        super().__init__(*arguments, **rest)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.averaged_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self._scale = torch.tensor(self._scales, device=self.device)
        self.state_head: nn.Module = nn.Identity()
        if self._scales:
            self.state_head = nn.Linear(self.actor.features_extractor.features_dim, len(self._scales)).to(self.device)
            self.critic.optimizer.add_param_group({"params": list(self.state_head.parameters())})

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        self.policy.set_training_mode(True)
        critics, targets = (
            [p for q in c.q_networks for p in q.parameters()] for c in (self.critic, self.critic_target)
        )
        sums = np.zeros(len(_LOGGED))
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        for step in range(gradient_steps):
            data = self.replay_buffer.sample(batch_size)
            features = self.actor.features_extractor(data.observations)
            with torch.no_grad():
                alpha = self.log_ent_coef.exp()
                next_features = self.actor.features_extractor(data.next_observations)
                action, log_prob = self._act(next_features)
                next_inputs = torch.cat([next_features, self._scaled(data.next_states), action], 1)
                best = torch.cat([q(next_inputs) for q in self.critic_target.q_networks], 1)
                value = best.min(1, keepdim=True).values - alpha * log_prob
                target = data.rewards + (1.0 - data.dones) * self.gamma * value
            states = self._scaled(data.states)
            inputs = torch.cat([features, states.nan_to_num(), data.actions], 1)
            critic_loss = sum(nn.functional.mse_loss(q(inputs), target) for q in self.critic.q_networks) / 2
            assert isinstance(critic_loss, torch.Tensor)
            self.critic.optimizer.zero_grad()
            state_loss = self._state_loss(features, states)
            (critic_loss + state_loss).backward()
            self.critic.optimizer.step()

            features = features.detach()
            action, log_prob = self._act(features)
            actor_inputs = torch.cat([features, states.nan_to_num(), action], 1)
            best = torch.cat([q(actor_inputs) for q in self.critic.q_networks], 1).min(1, keepdim=True).values
            actor_loss = (alpha * log_prob - best).mean()
            self.actor.optimizer.zero_grad()
            actor_loss.backward()
            self.actor.optimizer.step()

            entropy_loss = -(self.log_ent_coef * (log_prob.detach() + self.target_entropy)).mean()
            self.ent_coef_optimizer.zero_grad()
            entropy_loss.backward()
            self.ent_coef_optimizer.step()
            polyak_update(critics, targets, self.tau)
            done = self._n_updates + step
            polyak_update(
                self.actor.parameters(), self.averaged_actor.parameters(), max(_AVERAGING_RATE, 1.0 / (done + 1))
            )
            sums += [value.item() for value in (critic_loss, actor_loss, state_loss, alpha, best.mean())]
        self._n_updates += gradient_steps
        for name, value in zip(_LOGGED, sums / gradient_steps, strict=True):
            self.logger.record(f"train/{name}", value)

    def _scaled(self, states: torch.Tensor) -> torch.Tensor:
        return (states / self._scale).clamp(-_MAX_STATE, _MAX_STATE)

    def _state_loss(self, features: torch.Tensor, states: torch.Tensor) -> torch.Tensor:
        """Mean squared error of the state head's predictions, over the samples whose state is known."""
        known = ~states.isnan().any(1)
        if not (self._scales and known.any()):
            return features.new_zeros(())
        return nn.functional.mse_loss(self.state_head(features[known]), states[known])

    def _act(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Sampled actions (n, actions) and their log densities (n, 1)."""
        latent = self.actor.latent_pi(features)
        log_std = self.actor.log_std(latent).clamp(LOG_STD_MIN, LOG_STD_MAX)  # type: ignore[operator]
        action, log_prob = self.actor.action_dist.log_prob_from_params(self.actor.mu(latent), log_std)  # type: ignore[call-arg]
        return action, log_prob.reshape(-1, 1)


def actor_weights(model: PixelSAC, architecture: Architecture) -> dict[str, Array32]:
    """Weights of the averaged actor without its exploration; the names are those of `Architecture.shapes`."""
    actor = model.averaged_actor
    encoder = actor.features_extractor
    assert isinstance(encoder, Encoder)
    convolutions = [encoder.first, *(m for m in encoder.further if isinstance(m, nn.Conv2d))]
    hidden = [m for m in actor.latent_pi if isinstance(m, nn.Linear)]
    modules: dict[str, Any] = {f"conv.{i}": m for i, m in enumerate(convolutions)}
    modules |= {"features": encoder.linear, "norm": encoder.norm}
    modules |= {f"hidden.{i}": m for i, m in enumerate(hidden)} | {"mean": actor.mu}
    out = {}
    for name in architecture.shapes():
        module, parameter = name.rsplit(".", 1)
        out[name] = getattr(modules[module], parameter).detach().cpu().numpy()
    return out


# ---- saved states
#
# A saved state contains the whole training. Loading it runs no code: tensors are in a safetensors file, the replay
# buffer without its pictures in an npz file, the rest in a JSON file. These files are in a folder `state_<steps>`. The
# file `state.json` names this folder and is written last, so a killed training leaves one complete state.


def save_state(folder: Path, model: PixelSAC, more: dict[str, Any]) -> None:
    """Writes a state, with the JSON-able values `more`, and then removes the previous state.

    Raises OSError: the disk is full; the previous state is intact.
    """
    name = f"state_{model.num_timesteps:09d}"
    remove(folder / name)
    (folder / name).mkdir(parents=True)
    try:
        write_bytes(folder / name / _TENSORS, tensor_bytes(_tensors(model)))
        arrays, replay = model.replay_buffer.state()
        save_arrays(folder / name / _REPLAY, arrays)
    except OSError:  # free some space, so that the error can be logged
        remove(folder / name)
        raise
    counts = {"steps": model.num_timesteps, "updates": model._n_updates, "episodes": model._episode_num}
    rng = {"action_space": model.action_space.np_random.bit_generator.state}
    write_json(folder / _STATE, {"folder": name, **counts, "replay": replay, "rng": rng, "more": more})
    for old in folder.glob("state_*"):
        if old.name != name:
            shutil.rmtree(old)


def has_state(folder: Path) -> bool:
    return (folder / _STATE).exists()


def saved_steps(folder: Path) -> int:
    """Number of control steps done when the state was saved."""
    with wrap_read_errors(folder / _STATE, "train again under another name"):
        return int(read_json(folder / _STATE)["steps"])


def load_state(folder: Path, model: PixelSAC) -> dict[str, Any]:
    """Restores the saved state in a new model; returns the values given to `save_state` as `more`.

    Raises InputError: files are missing or damaged, or belong to another network.
    """
    with wrap_read_errors(folder, "train again under another name"):
        head = read_json(folder / _STATE)
        state = folder / Path(head["folder"]).name
        tensors = load_file(regular_file(state / _TENSORS))
        model.replay_buffer.set_state(load_arrays(state / _REPLAY), head["replay"])
        _set_tensors(model, tensors)
        int(head["steps"]), int(head["updates"]), int(head["episodes"]), dict(head["more"])
        model.action_space.np_random.bit_generator.state = head["rng"]["action_space"]
    model.num_timesteps, model._n_updates, model._episode_num = head["steps"], head["updates"], head["episodes"]
    return head["more"]


def _optimizers(model: PixelSAC) -> dict[str, torch.optim.Optimizer]:
    return {"actor": model.actor.optimizer, "critic": model.critic.optimizer, "entropy": model.ent_coef_optimizer}


def _modules(model: PixelSAC) -> dict[str, torch.nn.Module]:
    return {"policy": model.policy, "steady": model.averaged_actor, "teller": model.state_head}


def _tensors(model: PixelSAC) -> dict[str, torch.Tensor]:
    out = {"log_ent_coef": model.log_ent_coef.detach(), "rng": torch.get_rng_state()}
    for name, module in _modules(model).items():
        out |= {f"{name}.{key}": value for key, value in module.state_dict().items()}
    for name, optimizer in _optimizers(model).items():
        for i, values in optimizer.state_dict()["state"].items():
            out |= {f"optimizer.{name}.{i}.{key}": value for key, value in values.items()}
    if torch.cuda.is_available():
        out["rng.cuda"] = torch.cuda.get_rng_state()
    # The tensors are copied: the shared encoder has several names, and safetensors does not store shared tensors.
    return {name: value.detach().cpu().clone().contiguous() for name, value in out.items()}


def _set_tensors(model: PixelSAC, tensors: dict[str, torch.Tensor]) -> None:
    for name, module in _modules(model).items():
        own = {n.removeprefix(f"{name}."): value for n, value in tensors.items() if n.startswith(f"{name}.")}
        module.load_state_dict(own)
    with torch.no_grad():
        model.log_ent_coef.copy_(tensors["log_ent_coef"])
    for name, optimizer in _optimizers(model).items():
        state: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"optimizer.{name}."):
                i, field = key.removeprefix(f"optimizer.{name}.").split(".")
                state.setdefault(int(i), {})[field] = value
        optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
    torch.set_rng_state(tensors["rng"])
    if "rng.cuda" in tensors and torch.cuda.is_available():
        torch.cuda.set_rng_state(tensors["rng.cuda"])
