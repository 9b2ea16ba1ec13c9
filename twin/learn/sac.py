"""SAC from pixels (Haarnoja et al. 2018) on stable-baselines3, with one encoder for actor and critics.

The encoder turns stacks into features. The actor's loss does not train it (Yarats et al. 2019; Kostrikov et al. 2020),
and it has no target network (Yarats et al. 2021, DrQ-v2). An update runs it forward twice and backward once; in
stable-baselines3, with separate encoders, it is five and three times.

The critics receive the robot's privileged *state* beside the features (Pinto et al. 2018, asymmetric actor-critic); the
actor never does. A linear *state head* predicts the state from the features, as an auxiliary loss for the encoder.
"""

import copy
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN, Actor, SACPolicy
from torch import nn

from twin.learn.policy_network import NORM_EPSILON, Architecture
from twin.learn.replay_buffer import FrameReplayBuffer
from twin.types import Array32

_LOGGED = ("critic_loss", "actor_loss", "state_loss", "ent_coef", "value")
_MAX_STATE = 3.0  # times its scale, at which a state is clamped
_AVERAGING_RATE = 1e-3  # of the averaged actor, per update


class Encoder(BaseFeaturesExtractor):
    """The layers of `Architecture` from preprocessed stacks of values 0 to 255 to features."""

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
        # Scaling the weights of the first convolution, instead of the pictures, saves a third of an update.
        weight = self.first.weight
        bias = self.first.bias - 0.5 * weight.sum((1, 2, 3))  # type: ignore[operator]
        out = nn.functional.conv2d(pictures.float(), weight / 255.0, bias, self.first.stride)
        return torch.tanh(self.norm(self.linear(self.further(out))))


class DrivePolicy(SACPolicy):
    """Actor and critics with one encoder, which the critics' optimizer trains."""

    def __init__(self, *arguments: Any, state_size: int = 0, **rest: Any) -> None:
        self._state_size = state_size
        super().__init__(*arguments, **rest)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Critics of features and states."""
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

    averaged_actor: Actor
    """Running mean of the actor and its encoder. It becomes the policy: single updates make the actor swing, and a
    policy saved at the wrong moment leaves the road where the ones before and after do not."""

    def __init__(self, *arguments: Any, state_scales: tuple[float, ...] = (), **rest: Any) -> None:
        """
        Args:
            arguments: Of `SAC`.
            state_scales: Typical magnitudes of the numbers in the replay buffer's states; empty: no privileged states.
            rest: Of `SAC`.
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
        """Updates all networks `gradient_steps` times."""
        assert isinstance(self.replay_buffer, FrameReplayBuffer)
        assert self.ent_coef_optimizer is not None and self.log_ent_coef is not None
        assert isinstance(self.target_entropy, float)
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
            losses = critic_loss, actor_loss, state_loss
            sums += [*(loss.item() for loss in losses), alpha.item(), best.mean().item()]
        self._n_updates += gradient_steps
        for name, value in zip(_LOGGED, sums / gradient_steps, strict=True):
            self.logger.record(f"train/{name}", value)

    def _scaled(self, states: torch.Tensor) -> torch.Tensor:
        return (states / self._scale).clamp(-_MAX_STATE, _MAX_STATE)

    def _state_loss(self, features: torch.Tensor, states: torch.Tensor) -> torch.Tensor:
        """Mean squared error of the state head, over the samples whose states are known."""
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
    """Weights of the averaged, deterministic actor, by the names of `Architecture.shapes`."""
    actor = model.averaged_actor
    encoder = actor.features_extractor
    assert isinstance(encoder, Encoder)
    convolutions = [encoder.first, *(m for m in encoder.further if isinstance(m, nn.Conv2d))]
    hidden = [m for m in actor.latent_pi if isinstance(m, nn.Linear)]
    modules: dict[str, Any] = {f"conv.{i}": m for i, m in enumerate(convolutions)}
    modules |= {"features": encoder.linear, "norm": encoder.norm}
    modules |= {f"hidden.{i}": m for i, m in enumerate(hidden)} | {"mean": actor.mu}
    return {
        name: getattr(modules[name.rsplit(".", 1)[0]], name.rsplit(".", 1)[1]).detach().cpu().numpy()
        for name in architecture.shapes()
    }
