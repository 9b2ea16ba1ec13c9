"""Random streams of drawn places: every aspect of a place has its own.

The stream is `np.random.default_rng([SEED, 100, number, index of the aspect])`, so a further random value in one aspect
leaves the random values of the others as they are.
"""

import numpy as np

from twin.reality import SEED

_ASPECTS = (
    *("setting", "line", "section", "surface", "markings", "houses", "boundaries", "trees", "furniture", "cars"),
    *("lamps", "horizon", "weather", "film"),
)
"""The aspects in the order of their streams; new ones go to the end."""


def stream(number: int, aspect: str, *more: int) -> np.random.Generator:
    """The random generator of one aspect of a place; `more` distinguishes several within an aspect."""
    return np.random.default_rng([SEED, 100, number, _ASPECTS.index(aspect), *more])
