"""How sharp a frame is, and how far the picture moved between two frames.

Everything here works on small grey pictures (uint8, shape (h, w)), so that judging a frame costs about a millisecond.
A *flow* is the displacement of a picture's corners from one frame to the next [px]. A *mask* has 0 where the picture
is to be ignored.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

FLOW_WIDTH = 320
"""Width at which motion is measured [px]."""

SHARPNESS_WIDTH = 640
"""Width at which sharpness is measured [px]; at full size the noise of the sensor would count as detail."""

_CORNERS = 200
_MIN_TRACKED = 12  # fewer corners than this say nothing about the whole picture
_MAX_RETURN_ERROR = 0.5  # [px], a corner tracked there and back must come home
_STILL_DIFFERENCE = 1.5  # [grey levels of a picture stretched to 255], below it two texture-free frames are the same


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of the picture; comparable only between frames of one view.

    Pech-Pacheco et al. 2000 ("LAPV"). Dividing by the contrast keeps a brightening exposure from passing for focus.
    """
    laplacian = cv2.Laplacian(grey, cv2.CV_32F)
    return float(laplacian.var() / (grey.astype(np.float32).var() + 1.0))


def median_motion(
    before: NDArray[np.uint8], after: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None
) -> float | None:
    """Median length of the flow between two grey frames of equal size [px]; None where too few corners are found.

    Pyramidal Lucas-Kanade on Shi-Tomasi corners; only corners that come home when tracked back are counted.
    """
    before, after = _stretched(before), _stretched(after)
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 5, mask=mask)
    if corners is None or len(corners) < _MIN_TRACKED:
        return None
    there, found_there, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)  # type: ignore[call-overload]
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None)  # type: ignore[call-overload]
    home = np.linalg.norm(back - corners, axis=-1) < _MAX_RETURN_ERROR
    good = (home & (found_there == 1) & (found_back == 1))[:, 0]
    if good.sum() < _MIN_TRACKED:
        return None
    return float(np.median(np.linalg.norm(there - corners, axis=-1)[good]))


def stands_still(
    before: NDArray[np.uint8], after: NDArray[np.uint8], min_motion: float, mask: NDArray[np.uint8] | None = None
) -> bool:
    """True where the picture moved less than `min_motion` [px]; without corners, where it did not change at all.

    A `min_motion` of 0 keeps every frame.
    """
    if min_motion <= 0.0:
        return False
    moved = median_motion(before, after, mask)
    if moved is not None:
        return moved < min_motion
    difference = cv2.absdiff(_stretched(before), _stretched(after))
    seen = difference if mask is None else difference[mask > 0]
    return float(seen.mean()) < _STILL_DIFFERENCE if seen.size else True


def _stretched(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Contrast stretched to the whole range, so that a night frame has corners too."""
    low, high = np.percentile(grey[::2, ::2], (1.0, 99.0))
    gain = 255.0 / max(high - low, 16.0)  # a blank frame's noise is not blown up without bound
    return np.clip((grey.astype(np.float32) - low) * gain, 0, 255).astype(np.uint8)
