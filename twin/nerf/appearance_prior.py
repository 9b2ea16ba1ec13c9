"""Prior of plausible appearance embeddings: samples random embeddings and rejects implausible ones.

In DriveEnv-NeRF, a person picks the sampled embeddings that look right. Here, a rule with two parts checks the
*picture* of an embedding: the colors that it gives to *probes*, rays through the training frames with known features.
First, since light is additive, the picture must be close to a weighted sum of the filmed lightings' pictures in linear
light, with non-negative weights. More sun, street lamps at noon and longer exposure are such sums; green walls are not.
Second, statistics of brightness, contrast and color must lie in the widened range of the filmed lightings and frames.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.types import Array32

_GAMMA = 2.2  # approximate tone curve of the films
_MAX_MISFIT = 0.06  # greatest rms color difference from the nearest sum of lights [full scale = 1]
_OUTLIER_ERROR = 0.2  # color difference above which a probe is an outlier [full scale = 1]
_MAX_OUTLIER_SHARE = 0.02  # greatest share of outliers among the probes
_RANGE_MARGIN = (0.02, 0.1)  # at both ends, filmed ranges grow by the first value plus the second times their width
_CLIPPED = (0.02, 0.98)  # all channels below the first value: black; all above the second: burnt out
_CONCENTRATION = 0.7  # of the Dirichlet distribution of mixtures; values below 1 favor single lightings
_RESIDUAL_SCALE = 2.0  # scale of sampled frame residuals; the rule rejects implausible ones
_MAX_TRIES = 200

_STATISTICS = ("brightness", "contrast", "saturation", "red cast", "blue cast", "black share", "burnt share")


@dataclass(frozen=True)
class Probes:
    """Rays of training frames and the head that colors them, see `network.py`."""

    features: Array32
    """Ray features composited over the background, shape (k, CHANNELS − 1)."""
    harmonics: Array32
    """Spherical harmonics of the ray directions, shape (k, 16)."""
    network: dict[str, Array32]
    """Parameters `head.*`."""

    @cached_property
    def _first_layer(self) -> Array32:
        """Output of the head's first layer without the embedding's part, shape (k, hidden)."""
        w, f, s = self.network["head.0"], self.features.shape[1], self.harmonics.shape[1]
        return self.features @ w[:f] + self.harmonics @ w[f : f + s] + self.network["head.0.bias"]

    def picture(self, embedding: NDArray) -> Array32:
        """Probe colors in [0, 1] under an embedding (dim,), shape (k, 3)."""
        p, inputs = self.network, self.features.shape[1] + self.harmonics.shape[1]
        x = np.maximum(self._first_layer + np.asarray(embedding, np.float32) @ p["head.0"][inputs:], 0.0)
        x = np.maximum(x @ p["head.1"] + p["head.1.bias"], 0.0) @ p["head.2"] + p["head.2.bias"]
        return 1.0 / (1.0 + np.exp(-x))


class AppearancePrior:
    """The prior of one place."""

    def __init__(self, probes: Probes, vectors: Array32, frame_vectors: Array32):
        """Takes the embeddings of the filmed lightings (lightings, dim) and frames (frames, dim)."""
        self.probes = probes
        pictures = [probes.picture(vector) for vector in vectors]
        self._lights = np.stack([picture.ravel() for picture in pictures], 1).astype(np.float64) ** _GAMMA
        pictures += [probes.picture(vector) for vector in frame_vectors]
        filmed = np.array([picture_statistics(picture) for picture in pictures])
        low, high = filmed.min(0), filmed.max(0)
        margin = _RANGE_MARGIN[0] + _RANGE_MARGIN[1] * (high - low)
        self._low, self._high = low - margin, high + margin
        # Training keeps residuals small, so a frame's lighting is the one with the nearest embedding.
        nearest = np.linalg.norm(frame_vectors[:, None] - vectors, axis=-1).argmin(1)
        self._vectors, self._residuals = vectors, frame_vectors - vectors[nearest]

    def propose(self, rng: np.random.Generator) -> Array32:
        """Samples an unchecked embedding (dim,) that resembles the learned ones.

        It is a random mixture of the lightings plus a normal deviate with the scaled covariance of the frame residuals.
        """
        embedding = rng.dirichlet(np.full(len(self._vectors), _CONCENTRATION)) @ self._vectors
        count = len(self._residuals)
        if count:
            # A sum of the residuals with normal weights has their covariance, even if they do not span all dimensions.
            embedding = embedding + _RESIDUAL_SCALE * rng.normal(size=count) @ self._residuals / np.sqrt(count)
        return embedding.astype(np.float32)

    def color_error(self, picture: NDArray) -> NDArray[np.float64]:
        """Color errors (rms over channels) of the probes against the nearest sum of filmed lights, shape (k,).

        The weights of the sum are non-negative.
        """
        from scipy.optimize import nnls

        weights, _ = nnls(self._lights, picture.ravel().astype(np.float64) ** _GAMMA)
        nearest = np.minimum(self._lights @ weights, 1.0) ** (1.0 / _GAMMA)
        return np.sqrt(((nearest.reshape(-1, 3) - picture) ** 2).mean(1))

    def sample(self, rng: np.random.Generator) -> Array32:
        """Samples a plausible embedding (dim,) by rejection; raises InputError after `_MAX_TRIES` proposals."""
        violations: list[str] = []
        for _ in range(_MAX_TRIES):
            embedding = self.propose(rng)
            violations = self.violations(embedding)
            if not violations:
                return embedding
        raise InputError(
            f"no plausible lighting among {_MAX_TRIES} sampled; the last has {'; '.join(violations)}; "
            "train the field longer (nerf.steps), or render the filmed lightings and their mixtures"
        )

    def violations(self, embedding: NDArray) -> list[str]:
        """Descriptions of the parts of the rule that an embedding (dim,) violates; empty if it is plausible."""
        picture = self.probes.picture(embedding)
        error = self.color_error(picture)
        misfit, wrong = float(np.sqrt((error**2).mean())), float((error > _OUTLIER_ERROR).mean())
        found = []
        if not misfit <= _MAX_MISFIT:
            found.append(f"an rms color error of {misfit:.3f} from any sum of filmed lights (limit: {_MAX_MISFIT})")
        if not wrong <= _MAX_OUTLIER_SHARE:
            found.append(f"{wrong:.1%} of the probes off by over {_OUTLIER_ERROR} (limit: {_MAX_OUTLIER_SHARE:.0%})")
        for name, value, low, high in zip(_STATISTICS, picture_statistics(picture), self._low, self._high, strict=True):
            if not low <= value <= high:
                found.append(f"{name} {value:.3f} (filmed: {low:.3f} to {high:.3f})")
        return found


def picture_statistics(picture: NDArray) -> NDArray[np.float64]:
    """The `_STATISTICS` of a picture (k, 3), shape (7,)."""
    high, low = picture.max(1), picture.min(1)
    red, green, blue = picture.mean(0)
    gray = picture.mean(1)
    black, burnt = (high < _CLIPPED[0]).mean(), (low > _CLIPPED[1]).mean()
    saturation = ((high - low) / np.maximum(high, 1e-3)).mean()
    return np.array([gray.mean(), gray.std(), saturation, red - green, blue - green, black, burnt], np.float64)
