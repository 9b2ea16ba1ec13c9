"""Array types for all packages, and ranges of settings. Shapes and units are stated where the types are used."""

import math
import typing
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Double precision, for geometry, physics and statistics."""
Array32 = NDArray[np.float32]
"""Single precision, for the radiance field and its renderers."""
Image = NDArray[np.uint8]
"""RGB, shape (height, width, 3), or (n, height, width, 3)."""
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Range:
    """Bounds of a setting, both included, as in `Annotated[float, Range(0, 1)]`."""

    low: float
    high: float = math.inf


@cache
def setting_ranges(kind: type) -> dict[str, Range]:
    """The ranges of a dataclass's fields, by name, for those that have one."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {name: bound for name, hint in hints.items() for bound in getattr(hint, "__metadata__", ())}
