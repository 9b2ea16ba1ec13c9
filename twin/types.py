"""Array types for all packages. Shapes and units are stated where the types are used."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Double precision, for geometry, physics and statistics."""
Array32 = NDArray[np.float32]
"""Single precision, for the radiance field and its renderers."""
Image = NDArray[np.uint8]
"""RGB, shape (height, width, 3), or (n, height, width, 3)."""
Indices = NDArray[np.int64]
