"""twin: a filmed place as a MuJoCo digital twin that a driving policy is trained and judged in."""

# zlib before anything that may load pycolmap: the other order corrupts PNG and zlib for the whole process.
import zlib  # noqa: F401
from importlib import metadata

from twin.errors import InputError
from twin.geometry.cameras import Viewpoints
from twin.loading import Twin, load, load_scene

__all__ = ["InputError", "Twin", "Viewpoints", "load", "load_scene"]
__version__ = metadata.version("twin")
