"""The known-truth world: a generated campus road that is filmed like a real place and serves as the real test.

The product imports nothing from this package; the truth beside a scene is read by `comparison.py` and tests only.
"""

SEED = 20  # of everything random in this world: places, textures, skies, films, robots, cameras
REALITY_VERSION = 2
"""Version of the robot, camera and judge of the real test. Up to version 1 they were parts of the twin."""
