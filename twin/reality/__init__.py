"""The known-truth world: a generated campus road that is filmed like a real place and serves as the real test.

The rest of `twin` imports nothing from this package. The truth beside a scene is read only by `comparison.py`, by the
verb `drive` for a task in the scene's frame, by benchmarks and by tests.
"""

SEED = 20  # seed of everything random in this world: places, textures, skies, films, robots, cameras
REALITY_VERSION = 2
"""Version of the robot, camera and judge of the real test. In version 1 these three were parts of the twin."""
