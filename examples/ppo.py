"""PPO of stable-baselines3 on pictures and odometry: python examples/ppo.py scenes/demo --steps 200000

Needs pip install '.[learn]'. PPO needs more steps than `twin train`, whose teacher knows where the robot is; the
example shows how to connect any algorithm of stable-baselines3. For a policy that `twin validate --policy ppo.zip
--trust` can drive, leave out `state` and use CnnPolicy.
"""

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

from twin.learn.sb3_env import DriveVecEnv


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--task", default="straight")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--rollout", type=int, default=256, help="steps of each environment between updates")
    parser.add_argument("--out", default="ppo.zip")
    given = parser.parse_args(arguments)

    options = {"state": "odometry", "rewards": {"progress": 1.0, "cross_track": -0.1}}
    worlds = DriveVecEnv(given.scene, given.task, given.worlds, seed=0, lighting="training", **options)
    model = PPO("MultiInputPolicy", worlds, n_steps=given.rollout, batch_size=64, ent_coef=0.005, verbose=1)
    model.learn(given.steps)
    model.save(given.out)

    unseen = DriveVecEnv(given.scene, given.task, 2, seed=1000, lighting="held-out", **options)
    mean, deviation = evaluate_policy(model, unseen, n_eval_episodes=4, warn=False)
    print(f"return under held-out lightings: {mean:.2f} ± {deviation:.2f}; saved as {given.out}")


if __name__ == "__main__":
    main()
