"""Random streams of sampled places, one for every aspect of a place.

The stream is `np.random.default_rng([SEED, 100, number, index of the aspect])`, so one more random value in an aspect
does not change the random values of the others.
"""

import numpy as np

from twin.reality import SEED

_ASPECTS = (
    *("setting", "line", "section", "surface", "markings", "houses", "boundaries", "trees", "furniture", "cars"),
    *("lamps", "horizon", "weather", "film", "longer"),
)
"""The aspects by index; new ones go to the end."""


def stream(number: int, aspect: str, *more: int) -> np.random.Generator:
    """A random generator of one aspect of a place; `more` distinguishes those of the same aspect."""
    return np.random.default_rng([SEED, 100, number, _ASPECTS.index(aspect), *more])
