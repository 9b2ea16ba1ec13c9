"""The known-truth world: generated places that are filmed like real ones and in which the real test drives.

Place 0 is the campus road. The rest of `twin` imports nothing from this package. Only `comparison.py`, `twin reality
drive` for a task in the scene's frame, benchmarks and tests read the truth beside a scene.
"""

SEED = 20  # seed of everything random in this world: places, textures, skies, films, robots, cameras
REALITY_VERSION = 2
"""Version of the robot, camera and judge of the real test. In version 1 these three were parts of the twin."""
