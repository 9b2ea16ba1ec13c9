"""SAC in one file, in the manner of CleanRL: python examples/sac.py scenes/demo --steps 20000

The algorithm is that of Haarnoja et al., arXiv 1812.05905. Networks with their optimizers and the replay buffer are
those of stable-baselines3: pip install '.[learn]'
"""

import argparse

import gymnasium
import torch
from safetensors.torch import save_model
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import CnnPolicy


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
    policy = CnnPolicy(world.observation_space, world.action_space, lambda _: 3e-4)
    policy.actor.features_extractor = policy.critic.features_extractor  # one encoder, in the critics' optimizer only
    log_alpha = torch.tensor(-2.0, requires_grad=True)
    alpha_optimizer = torch.optim.Adam([log_alpha], 3e-4)
    buffer = ReplayBuffer(min(given.steps, 5_000), world.observation_space, world.action_space, policy.device)
    picture, _ = world.reset(seed=0)
    world.action_space.seed(0)
    for step in range(given.steps):
        action = world.action_space.sample() if step < given.warmup else policy.predict(picture)[0]
        following, reward, terminated, truncated, info = world.step(action)
        buffer.add(picture, following, action, reward, terminated, [info])
        picture = following
        if terminated or truncated:
            print(f"step {step + 1}: {info['cause']} after {info['progress']:.1f} m")
            picture, _ = world.reset()
        if step < given.warmup:
            continue

        batch = buffer.sample(given.batch)
        alpha = log_alpha.exp().detach()
        with torch.no_grad():
            action, log_probability = policy.actor.action_log_prob(batch.next_observations)
            best = torch.cat(policy.critic_target(batch.next_observations, action), 1).amin(1, True)
            wanted = batch.rewards + 0.99 * (1 - batch.dones) * (best - alpha * log_probability[:, None])
        values = policy.critic(batch.observations, batch.actions)
        descend(policy.critic.optimizer, sum((value - wanted).square().mean() for value in values))
        action, log_probability = policy.actor.action_log_prob(batch.observations)
        value = torch.cat(policy.critic(batch.observations, action), 1).amin(1)
        descend(policy.actor.optimizer, (alpha * log_probability - value).mean())
        descend(alpha_optimizer, -(log_alpha.exp() * (log_probability.detach() - len(action[0]))).mean())
        polyak_update(policy.critic.parameters(), policy.critic_target.parameters(), 0.01)
    save_model(policy, given.out)


def descend(optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


if __name__ == "__main__":
    main()
