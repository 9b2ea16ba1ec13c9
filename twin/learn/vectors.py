"""The former name of `twin.learn.sb3_env`, kept for one release."""

from twin.learn.sb3_env import DriveVecEnv

__all__ = ["DriveVecEnv"]
