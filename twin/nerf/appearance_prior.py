"""Lightings that were never filmed but could have been: drawn at random, and judged without hands.

DriveEnv-NeRF draws appearance embeddings at random and a person picks those that look right. Here a rule does, on
*probes*: rays spread over the training frames, whose features are known, so that one embedding gives them all a colour.
Their colours together are the embedding's *picture*.

The rule has two parts. *Light adds*: a picture is plausible if it is nearly a sum of the filmed lightings' pictures in
linear light, each with a weight of its own that is not negative. More sun, street lamps at noon and a longer exposure
are such sums; green walls are not. *Exposed as filmed*: the weights are free, so the numbers that tell how bright,
contrasty and colourful the picture is must lie in the range of the filmed lightings and frames, slightly widened.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.errors import InputError
from twin.types import Array32

_GAMMA = 2.2  # of the films' tone curve, near enough
_MISFIT = 0.06  # from the nearest sum of lights [rms over the probes' colours, full scale = 1]
_FAR_OFF = 0.2  # a probe's colour that is off by more is wrong [full scale = 1]
_MOST_FAR_OFF = 0.02  # share of the probes that may be
_WIDEN = (0.02, 0.1)  # every filmed range grows by this much, and by this share of itself, at both ends
_CLIPPED = (0.02, 0.98)  # colours beyond are black or burnt out
_CONCENTRATION = 0.7  # of the Dirichlet distribution: below 1 favours one lighting over the middle of all
_SPREAD = 2.0  # frames' deviations from their lighting are drawn larger by this; the rule sorts out what is too much
_TRIES = 200

_NUMBERS = ("brightness", "contrast", "saturation", "red cast", "blue cast", "black share", "burnt share")


@dataclass(frozen=True)
class Probes:
    """Rays of training frames and the head that gives them their colours, see `network.py`."""

    features: Array32
    """Composited, with the backdrop behind them, shape (k, CHANNELS − 1)."""
    harmonics: Array32
    """Spherical harmonics of the directions, shape (k, 16)."""
    network: dict[str, Array32]
    """`head.*`."""

    @cached_property
    def _unlit(self) -> Array32:
        """The first layer but for the embedding, shape (k, hidden)."""
        w, f, s = self.network["head.0"], self.features.shape[1], self.harmonics.shape[1]
        return self.features @ w[:f] + self.harmonics @ w[f : f + s] + self.network["head.0.bias"]

    def picture(self, embedding: NDArray) -> Array32:
        """Colours in [0, 1] under an embedding (dim,), shape (k, 3)."""
        p, inputs = self.network, self.features.shape[1] + self.harmonics.shape[1]
        x = np.maximum(self._unlit + np.asarray(embedding, np.float32) @ p["head.0"][inputs:], 0.0)
        x = np.maximum(x @ p["head.1"] + p["head.1.bias"], 0.0) @ p["head.2"] + p["head.2.bias"]
        return 1.0 / (1.0 + np.exp(-x))


class AppearancePrior:
    """The rule of this module, for one place."""

    def __init__(self, probes: Probes, vectors: Array32, frame_vectors: Array32):
        """
        Args:
            probes: Of the place.
            vectors: Embeddings of the filmed lightings, shape (lightings, dim).
            frame_vectors: Embeddings of the filmed frames, shape (frames, dim).
        """
        self.probes = probes
        pictures = [probes.picture(vector) for vector in vectors]
        self._lights = np.stack([picture.ravel() for picture in pictures], 1).astype(np.float64) ** _GAMMA
        filmed = np.array([numbers(p) for p in [*pictures, *(probes.picture(vector) for vector in frame_vectors)]])
        low, high = filmed.min(0), filmed.max(0)
        margin = _WIDEN[0] + _WIDEN[1] * (high - low)
        self._low, self._high = low - margin, high + margin
        self._vectors, self._residuals = vectors, residuals(vectors, frame_vectors)

    def propose(self, rng: np.random.Generator) -> Array32:
        """An embedding (dim,) from the distribution of the learned ones, not judged yet.

        A random mixture of the lightings, and on it a normal deviate with the frames' covariance about their lightings.
        """
        embedding = rng.dirichlet(np.full(len(self._vectors), _CONCENTRATION)) @ self._vectors
        count = len(self._residuals)
        if count:
            # Normal weights on the residuals themselves give their covariance, however many dimensions they span.
            embedding = embedding + _SPREAD * rng.normal(size=count) @ self._residuals / np.sqrt(count)
        return embedding.astype(np.float32)

    def off(self, picture: NDArray) -> NDArray[np.float64]:
        """How far each probe's colour is from the nearest sum of the filmed lights, shape (k,), rms over channels."""
        from scipy.optimize import nnls

        weights, _ = nnls(self._lights, picture.ravel().astype(np.float64) ** _GAMMA)
        nearest = np.minimum(self._lights @ weights, 1.0) ** (1.0 / _GAMMA)
        return np.sqrt(((nearest.reshape(-1, 3) - picture) ** 2).mean(1))

    def faults(self, embedding: NDArray) -> list[str]:
        """What makes an embedding (dim,) implausible; nothing where it could have been filmed."""
        picture = self.probes.picture(embedding)
        off = self.off(picture)
        misfit, wrong = float(np.sqrt((off**2).mean())), float((off > _FAR_OFF).mean())
        found = []
        if not misfit <= _MISFIT:
            found.append(f"{misfit:.3f} from any sum of the filmed lights (at most {_MISFIT})")
        if not wrong <= _MOST_FAR_OFF:
            found.append(f"{wrong:.1%} of the probes off by {_FAR_OFF} (at most {_MOST_FAR_OFF:.0%})")
        for name, value, low, high in zip(_NUMBERS, numbers(picture), self._low, self._high, strict=True):
            if not low <= value <= high:
                found.append(f"{name} {value:.3f} (filmed: {low:.3f} to {high:.3f})")
        return found


def numbers(picture: NDArray) -> NDArray[np.float64]:
    """What `_NUMBERS` names, of the colours (k, 3) of a picture; shape (7,), all of the order of 1."""
    high, low = picture.max(1), picture.min(1)
    red, green, blue = picture.mean(0)
    grey = picture.mean(1)
    black, burnt = (high < _CLIPPED[0]).mean(), (low > _CLIPPED[1]).mean()
    saturation = ((high - low) / np.maximum(high, 1e-3)).mean()
    return np.array([grey.mean(), grey.std(), saturation, red - green, blue - green, black, burnt], np.float64)


def residuals(vectors: Array32, frame_vectors: Array32) -> Array32:
    """Of the frames' embeddings (frames, dim) from those of their lightings (lightings, dim); shape (frames, dim)."""
    # A frame's lighting is the one next to it: residuals are kept small in training.
    nearest = np.linalg.norm(frame_vectors[:, None] - vectors, axis=-1).argmin(1)
    return frame_vectors - vectors[nearest]


def sample(rng: np.random.Generator, judge: AppearancePrior) -> Array32:
    """A plausible embedding (dim,): proposals until the judge finds no fault.

    Raises:
        InputError: none of `_TRIES` proposals was plausible.
    """
    faults: list[str] = []
    for _ in range(_TRIES):
        embedding = judge.propose(rng)
        faults = judge.faults(embedding)
        if not faults:
            return embedding
    raise InputError(
        f"no plausible lighting among {_TRIES} drawn; the last is {'; '.join(faults)}; "
        "train the field longer (nerf.steps), or render the filmed lightings and their mixtures"
    )
