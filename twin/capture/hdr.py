"""Converts HDR films to SDR.

HDR films of phones and cameras (HLG and PQ of ITU-R BT.2100) become SDR pictures with the colors of BT.709. A frame's
signal is converted to display light L [cd/m²] by the formulas of BT.2100:

    HLG: E = inverse OETF of the signal;   L = 1000 Yˢ^0.2 E (OOTF)
    PQ:  L = EOTF of the signal

Yˢ is the luminance of E. For HLG a screen with a peak of 1,000 cd/m² is assumed; its system gamma is 1.2. Diffuse white
is 203 cd/m² in both (BT.2408). x = L / 203 is converted from the primaries of BT.2020 to those of BT.709 (BT.2087).
Then highlights are compressed, and the SDR signal is x^(1/2.4), the inverse of BT.1886:

    x → x up to 0.8;   x → 0.8 + 0.2 tanh((x − 0.8) / 0.2) above

The conversion is the same for every frame, so the exposure does not depend on a frame's content.
"""

from functools import lru_cache

import av
import cv2
import numpy as np

from twin.types import Array32, Image

HLG, PQ = 18, 16  # transfer characteristics of HDR films (ITU-T H.273)
HDR_NAMES = {HLG: "HLG", PQ: "PQ"}

_WHITE = 203.0  # [cd/m²] diffuse white
_PEAK, _SYSTEM_GAMMA = 1000.0, 1.2  # peak [cd/m²] and gamma of the display assumed for HLG
_HLG = (0.17883277, 0.28466892, 0.55991073)  # a, b, c of BT.2100
_PQ = (2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32)  # m1, m2, c1, c2, c3
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # weights of BT.2020's red, green and blue
_TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)  # BT.2087
_KNEE = 0.8
_DISPLAY_GAMMA = 2.4
_MATRICES = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593), 10: (0.2627, 0.0593)}
"""Matrix coefficients (H.273) → weights of red and blue in the luma; BT.2020's weights are used for all others."""
_LEVELS = 4096  # number of entries of a table over [0, 1]


def hdr_to_sdr(frame: av.VideoFrame, transfer: int) -> Image:
    """An HDR frame as an SDR picture, RGB uint8 (h, w, 3), unrotated."""
    red, blue = _MATRICES.get(int(frame.colorspace or 0), _MATRICES[9])
    coded = frame.to_ndarray(format="yuv444p16le").astype(np.float32) / 65536.0  # y, u, v
    full_range = int(frame.color_range or 0) == 2
    offset, luma_range, chroma_range = (0.0, 1.0, 1.0) if full_range else (16 / 256, 219 / 256, 224 / 256)
    y = (coded[..., 0] - offset) / luma_range
    u, v = ((coded[..., k] - 0.5) / chroma_range for k in (1, 2))
    signal = np.empty_like(coded)
    signal[..., 0] = y + 2.0 * (1.0 - red) * v
    signal[..., 2] = y + 2.0 * (1.0 - blue) * u
    signal[..., 1] = (y - red * signal[..., 0] - blue * signal[..., 2]) / (1.0 - red - blue)
    x = _look_up(_light_table(transfer), signal)
    if transfer == HLG:
        x *= np.maximum(x @ _LUMINANCE, 1e-6)[..., None] ** (_SYSTEM_GAMMA - 1.0)
    x *= (_PEAK if transfer == HLG else 1.0) / _WHITE
    x = np.asarray(cv2.transform(x, _TO_BT709), np.float32)
    high = x > _KNEE
    x[high] = _KNEE + (1.0 - _KNEE) * np.tanh((x[high] - _KNEE) / (1.0 - _KNEE))
    return np.asarray(_look_up(_display_table(), np.sqrt(np.maximum(x, 0.0))) + 0.5, np.uint8)


@lru_cache
def _light_table(transfer: int) -> Array32:
    """HLG: scene light E of a signal from 0 to 1; PQ: display light [cd/m²]."""
    signal = np.linspace(0.0, 1.0, _LEVELS)
    if transfer == HLG:
        a, b, c = _HLG
        light = np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - c) / a) + b) / 12.0)
    else:
        m1, m2, c1, c2, c3 = _PQ
        root = signal ** (1.0 / m2)
        light = 10_000.0 * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1.0 / m1)
    return light.astype(np.float32)


@lru_cache
def _display_table() -> Array32:
    """SDR signal from 0 to 255 for light from 0 to 1."""
    # The table is indexed by the square root of light, which gives finer steps to dark colors.
    root = np.linspace(0.0, 1.0, _LEVELS)
    return (255.0 * root ** (2.0 / _DISPLAY_GAMMA)).astype(np.float32)


def _look_up(table: Array32, values: Array32) -> Array32:
    return np.asarray(table[(np.clip(values, 0.0, 1.0) * (_LEVELS - 1) + 0.5).astype(np.int32)])
