"""Imports Warp as `wp` without its warnings about a missing GPU, which no setting of Warp silences."""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator

import warp as wp

__all__ = ["wp"]

_EXPECTED = (
    b"Could not find or load the NVIDIA CUDA driver",
    b"no CUDA-capable device is detected",  # the GPU is hidden, as from the children of a vector environment
)


@contextlib.contextmanager
def _without_the_warning() -> Iterator[None]:
    """Captures the output of the block on standard error, and writes all of it except expected lines."""
    try:
        sys.stderr.flush()
        real = os.dup(2)
    except (AttributeError, OSError, ValueError):  # there is no standard error
        yield
        return
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(real, 2)
            os.close(real)
            held.seek(0)
            for line in held:
                if not any(part in line for part in _EXPECTED):
                    os.write(2, line)


wp.config.log_level = wp.LOG_ERROR  # twin's own progress bars report compilation
with _without_the_warning():
    wp.init()
