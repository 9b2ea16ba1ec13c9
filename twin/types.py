"""Names for arrays that cross rooms. Shapes and units are in the docstrings of what takes or returns them."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Geometry, physics and statistics are computed in double precision."""
Array32 = NDArray[np.float32]
"""What the field and its renderers compute with."""
Image = NDArray[np.uint8]
"""RGB, shape (height, width, 3); several: (n, height, width, 3)."""
Indices = NDArray[np.int64]
