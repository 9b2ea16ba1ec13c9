"""Two policies in a scene's `runs/`: `ahead` drives straight on, `left` turns off the road."""

from pathlib import Path
from typing import Any

import numpy as np
from test_policy import some_weights

from twin.learn.policy import Control, save_policy
from twin.learn.policy_network import Architecture

SMALL = Architecture((32, 18), 2, 1, ((4, 5, 4),), 8, (8,), 1)


def tiny_runs(root: Path, trained: dict[str, Any] | None = None) -> None:
    """Adds the policies to the scene `root`; `trained` is the record of the training of `ahead`."""
    for name, turn in (("ahead", 0.0), ("left", 0.8)):
        weights = some_weights(SMALL)
        weights["mean.weight"] *= 0.3
        weights["mean.bias"][:] = np.arctanh(turn)
        save_policy(root / "runs" / name, SMALL, Control(), weights, trained or {} if name == "ahead" else {})
