"""twin: a filmed place as a MuJoCo digital twin that a driving policy is trained and judged in."""

# zlib before anything that may load pycolmap: the other order corrupts PNG and zlib for the whole process.
import zlib  # noqa: F401
from importlib import metadata

import gymnasium

from twin.errors import InputError
from twin.geometry.cameras import Viewpoints
from twin.loading import Twin, load, load_scene

__all__ = ["InputError", "Twin", "Viewpoints", "load", "load_scene"]
__version__ = metadata.version("twin")

# Where the environment is found by its name, without any of it being imported here.
gymnasium.register(
    "twin/Drive-v0", entry_point="twin.env.gym:DriveEnv", vector_entry_point="twin.env.gym:DriveVectorEnv"
)
