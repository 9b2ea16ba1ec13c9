"""SAC in one file, in the manner of CleanRL: python examples/sac.py scenes/demo --steps 20000

The algorithm is that of Haarnoja et al., arXiv 1812.05905, with one convolutional encoder that the critics train.
Network layers, distribution and replay buffer are those of stable-baselines3: pip install 'twin[learn]'
"""

import argparse
from copy import deepcopy

import gymnasium
import numpy as np
import torch
from safetensors.torch import save_model
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.torch_layers import NatureCNN, create_mlp
from stable_baselines3.common.utils import polyak_update
from torch import nn


class Agent(nn.Module):
    def __init__(self, space: gymnasium.spaces.Box, actions: int) -> None:
        super().__init__()
        self.encoder = nn.Sequential(NatureCNN(space, 64), nn.LayerNorm(64), nn.Tanh())
        self.actor = nn.Sequential(*create_mlp(64, 2 * actions, [256]))
        self.critics = nn.ModuleList(nn.Sequential(*create_mlp(64 + actions, 1, [256])) for _ in range(2))
        self.log_alpha, self.squashed = nn.Parameter(torch.tensor(-2.0)), SquashedDiagGaussianDistribution(actions)

    def see(self, pictures: np.ndarray | torch.Tensor) -> torch.Tensor:
        return self.encoder(torch.as_tensor(pictures).float() / 255.0)

    def act(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, deviation = self.actor(seen).chunk(2, -1)
        action, log_probability = self.squashed.log_prob_from_params(mean, deviation.clamp(-5, 1))
        return action, log_probability[:, None]

    def values(self, seen: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return torch.cat([critic(torch.cat([seen, action], -1)) for critic in self.critics], -1)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--task", default="straight")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--warmup", type=int, default=500, help="number of first steps, with random actions")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--out", default="sac.safetensors")
    given = parser.parse_args(arguments)

    rewards = {"progress": 1.0, "cross_track": -0.1}
    world = gymnasium.make("twin:twin/Drive-v0", scene=given.scene, task=given.task, rewards=rewards)
    space, size = world.observation_space, world.action_space.shape[0]
    agent = Agent(space, size)
    target = deepcopy(agent)
    critics = torch.optim.Adam([*agent.encoder.parameters(), *agent.critics.parameters()], 3e-4)
    actor = torch.optim.Adam([*agent.actor.parameters(), agent.log_alpha], 3e-4)
    buffer = ReplayBuffer(min(given.steps, 5_000), space, world.action_space, handle_timeout_termination=False)
    picture, _ = world.reset(seed=0)
    world.action_space.seed(0)
    for step in range(given.steps):
        with torch.no_grad():
            action = agent.act(agent.see(picture[None]))[0][0].numpy()
        action = world.action_space.sample() if step < given.warmup else action
        following, reward, terminated, truncated, info = world.step(action)
        buffer.add(picture, following, action, reward, terminated, [info])
        picture = following
        if terminated or truncated:
            print(f"step {step + 1}: {info['cause']} after {info['progress']:.1f} m")
            picture, _ = world.reset()
        if step < given.warmup:
            continue

        batch = buffer.sample(given.batch)
        alpha = agent.log_alpha.exp().detach()
        with torch.no_grad():
            action, log_probability = agent.act(agent.see(batch.next_observations))
            best = target.values(target.see(batch.next_observations), action).min(-1, True).values
            wanted = batch.rewards + 0.99 * (1 - batch.dones) * (best - alpha * log_probability)
        seen = agent.see(batch.observations)
        critics.zero_grad()
        (agent.values(seen, batch.actions) - wanted).square().mean().backward()
        critics.step()
        action, log_probability = agent.act(seen.detach())
        value = agent.values(seen.detach(), action).min(-1, True).values
        entropy_loss = -(agent.log_alpha.exp() * (log_probability.detach() - size)).mean()
        actor.zero_grad()
        ((alpha * log_probability - value).mean() + entropy_loss).backward()
        actor.step()
        polyak_update(agent.parameters(), target.parameters(), 0.01)
    save_model(agent, given.out)


if __name__ == "__main__":
    main()
