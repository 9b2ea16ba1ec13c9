"""twin: a filmed place as a MuJoCo digital twin that a driving policy is trained and judged in."""

# zlib before anything that may load pycolmap: the other order corrupts PNG and zlib for the whole process.
import zlib  # noqa: F401
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from twin.env.suite import load
    from twin.errors import InputError
    from twin.geometry.cameras import Viewpoints
    from twin.loading import Twin, load_scene

__all__ = ["InputError", "Twin", "Viewpoints", "load", "load_scene"]

_MODULES = {
    "InputError": "twin.errors",
    "Twin": "twin.loading",
    "Viewpoints": "twin.geometry.cameras",
    "load": "twin.env.suite",
    "load_scene": "twin.loading",
}


def __getattr__(name: str) -> Any:
    """Imports public names when they are first used, so that `twin --help` waits for nothing heavy."""
    if name == "__version__":
        from importlib import metadata

        value: Any = metadata.version("twin")
    elif name in _MODULES:
        import importlib

        value = getattr(importlib.import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module 'twin' has no attribute {name!r}")
    globals()[name] = value
    return value


# Where gymnasium.make("twin/Drive-v0") finds the environment, without any of it being imported here.
gymnasium.register(
    "twin/Drive-v0", entry_point="twin.env.gym_env:DriveEnv", vector_entry_point="twin.env.gym_env:DriveVectorEnv"
)
