"""SAC in one file, with nothing but torch and Gymnasium: python examples/sac.py scenes/demo --steps 20000

The algorithm is that of Haarnoja et al., arXiv 1812.05905, with one convolutional encoder that the critics train.
"""

import argparse
import copy

import gymnasium
import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn
from torch.nn import functional


class Agent(nn.Module):
    def __init__(self, channels: int, actions: int) -> None:
        super().__init__()
        layers = [
            nn.Conv2d(channels, 32, 4, 4),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, 2),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d((4, 8)),
        ]
        self.encoder = nn.Sequential(*layers, nn.Flatten(), nn.Linear(1024, 64), nn.LayerNorm(64), nn.Tanh())
        self.actor = nn.Sequential(nn.Linear(64, 256), nn.ReLU(), nn.Linear(256, 2 * actions))
        self.critics = nn.ModuleList(
            nn.Sequential(nn.Linear(64 + actions, 256), nn.ReLU(), nn.Linear(256, 1)) for _ in range(2)
        )
        self.log_alpha = nn.Parameter(torch.tensor(-2.0))

    def act(self, seen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Sampled actions in (-1, 1) and their log probabilities, from encoded pictures."""
        mean, deviation = self.actor(seen).chunk(2, -1)
        normal = torch.distributions.Normal(mean, deviation.clamp(-5, 1).exp())
        raw = normal.rsample()
        squash = 2.0 * (np.log(2.0) - raw - functional.softplus(-2.0 * raw))
        return raw.tanh(), (normal.log_prob(raw) - squash).sum(-1)

    def values(self, seen: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return torch.cat([critic(torch.cat([seen, action], -1)) for critic in self.critics], -1)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--task", default="straight")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--warmup", type=int, default=500, help="steps of random driving at first")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--out", default="sac.safetensors")
    given = parser.parse_args(arguments)

    rewards = {"progress": 1.0, "cross_track": -0.1}
    world = gymnasium.make("twin:twin/Drive-v0", scene=given.scene, task=given.task, rewards=rewards)
    shape, size = world.observation_space.shape, world.action_space.shape[0]
    agent = Agent(shape[0], size)
    target = copy.deepcopy(agent)
    train_critics = torch.optim.Adam([*agent.encoder.parameters(), *agent.critics.parameters()], 3e-4)
    train_actor = torch.optim.Adam([*agent.actor.parameters(), agent.log_alpha], 3e-4)
    kept = min(given.steps, 5_000)  # 1.7 GB of pictures
    seen, then = (np.zeros((kept, *shape), np.uint8) for _ in range(2))
    acted, earned, ended = np.zeros((kept, size), np.float32), np.zeros(kept, np.float32), np.zeros(kept, np.float32)
    rng = np.random.default_rng(0)

    def pictures(batch: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(batch).float() / 255.0 - 0.5

    picture, _ = world.reset(seed=0)
    goals = episodes = 0
    for step in range(given.steps):
        if step < given.warmup:
            action = rng.uniform(-1, 1, size).astype(np.float32)
        else:
            with torch.no_grad():
                action = agent.act(agent.encoder(pictures(picture[None])))[0][0].numpy()
        following, reward, terminated, truncated, info = world.step(action)
        k = step % kept
        seen[k], then[k], acted[k], earned[k], ended[k] = picture, following, action, reward, terminated
        picture = following
        if terminated or truncated:
            episodes, goals = episodes + 1, goals + info["is_success"]
            print(f"step {step + 1}: {info['cause']} after {info['progress']:.1f} m; {goals} of {episodes} at the goal")
            picture, _ = world.reset()
        if step < given.warmup:
            continue

        some = rng.integers(0, min(step + 1, kept), given.batch)
        action_batch, reward_batch, over = (torch.as_tensor(x[some]) for x in (acted, earned, ended))
        with torch.no_grad():
            later = target.encoder(pictures(then[some]))
            next_action, log_probability = agent.act(agent.encoder(pictures(then[some])))
            best = target.values(later, next_action).min(-1).values - agent.log_alpha.exp() * log_probability
            wanted = reward_batch + 0.99 * (1 - over) * best
        encoded = agent.encoder(pictures(seen[some]))
        train_critics.zero_grad()
        functional.mse_loss(agent.values(encoded, action_batch), wanted[:, None].expand(-1, 2)).backward()
        train_critics.step()
        chosen, log_probability = agent.act(encoded.detach())
        alpha = agent.log_alpha.exp()
        value = agent.values(encoded.detach(), chosen).min(-1).values
        train_actor.zero_grad()
        (
            (alpha.detach() * log_probability - value).mean() - (alpha * (log_probability.detach() - size)).mean()
        ).backward()
        train_actor.step()
        with torch.no_grad():
            for slow, fast in zip(target.parameters(), agent.parameters(), strict=True):
                slow.lerp_(fast, 0.01)
    save_file(agent.state_dict(), given.out)


if __name__ == "__main__":
    main()
