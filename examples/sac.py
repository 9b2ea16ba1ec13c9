"""SAC in one file, in the manner of CleanRL: python examples/sac.py scenes/demo

The algorithm is that of Haarnoja et al., arXiv 1812.05905. Networks with their optimizers and the replay buffer are
those of stable-baselines3: pip install '.[learn]'
"""

import sys

import gymnasium
import torch
from safetensors.torch import save_model
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import CnnPolicy


def learn(scene, task="straight", steps=20_000, warmup=500, batch=64, out="sac.safetensors"):
    world = gymnasium.make("twin:twin/Drive-v0", scene=scene, task=task, rewards={"progress": 1.0, "cross_track": -0.1})
    policy = CnnPolicy(world.observation_space, world.action_space, lambda _: 3e-4)
    policy.actor.features_extractor = policy.critic.features_extractor  # one encoder, in the critics' optimizer only
    log_alpha = torch.tensor(-2.0, requires_grad=True)
    alpha_optimizer = torch.optim.Adam([log_alpha], 3e-4)
    buffer = ReplayBuffer(min(steps, 5_000), world.observation_space, world.action_space, policy.device)
    picture, _ = world.reset(seed=0)
    for step in range(steps):
        action, _ = policy.predict(picture)  # at first nearly uniform
        following, reward, terminated, truncated, info = world.step(action)
        buffer.add(picture, following, action, reward, terminated, [info])
        if terminated or truncated:
            print(f"step {step + 1}: {info['cause']} after {info['progress']:.1f} m")
        picture = world.reset()[0] if terminated or truncated else following
        if step >= warmup:
            update(policy, log_alpha, alpha_optimizer, *buffer.sample(batch)[:5])
    save_model(policy, out)


def update(policy, log_alpha, alpha_optimizer, pictures, actions, following, ends, rewards):
    with torch.no_grad():
        action, log_probability = policy.actor.action_log_prob(following)
        best = torch.cat(policy.critic_target(following, action), 1).amin(1, True)
        wanted = rewards + 0.99 * (1 - ends) * (best - log_alpha.exp() * log_probability[:, None])
    descend(policy.critic.optimizer, sum((q - wanted).square().mean() for q in policy.critic(pictures, actions)))
    action, log_probability = policy.actor.action_log_prob(pictures)
    value = torch.cat(policy.critic(pictures, action), 1).amin(1)
    descend(policy.actor.optimizer, (log_alpha.exp().detach() * log_probability - value).mean())
    descend(alpha_optimizer, -(log_alpha.exp() * (log_probability.detach() - actions.shape[1])).mean())
    polyak_update(policy.critic.parameters(), policy.critic_target.parameters(), 0.01)


def descend(optimizer, loss):
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


if __name__ == "__main__":
    learn(*sys.argv[1:])
