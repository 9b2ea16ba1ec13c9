"""The former name of `twin.env.compositor`, kept for one release."""

from twin.env.compositor import Compositor as Overlay

__all__ = ["Overlay"]
