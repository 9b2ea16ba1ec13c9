"""The simulated reality: generated places, filmed like real ones, in which policies drive in the *real test*.

Place 0, the campus road, is designed; the others are random. The rest of `twin` imports nothing from this package.
Only `truth.measure`, `twin reality drive` with a task file, benchmarks and tests read a scene's folder `truth`.
"""

SEED = 20  # seed of all that is random in this world: places, textures, skies, films, robots, cameras; not of trials
REALITY_VERSION = 4
"""Version of the real test: robot, camera, judge, tasks and days of trials. In version 1 the first three were parts of
the twin; in version 2 the tasks of place 0 began at the first frame; up to version 3 most movable objects of sampled
places stood on days of trials where they were filmed."""
