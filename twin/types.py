"""Array types shared by all packages; shapes and units are in the docstrings of their users."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Double precision: geometry, physics and statistics."""
Array32 = NDArray[np.float32]
"""Single precision: the radiance field and its renderers."""
Image = NDArray[np.uint8]
"""RGB, shape (height, width, 3), or (n, height, width, 3)."""
Indices = NDArray[np.int64]
