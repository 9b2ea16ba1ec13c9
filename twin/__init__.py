"""twin: a filmed place as a MuJoCo digital twin, in which driving policies are trained and evaluated."""

# zlib must be imported before pycolmap; the other order corrupts zlib, and so PNG files, in the whole process.
import zlib  # noqa: F401
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from twin.env.env_factory import load
    from twin.errors import InputError
    from twin.geometry.cameras import Viewpoints
    from twin.loading import Twin, load_scene

__all__ = ["InputError", "Twin", "Viewpoints", "load", "load_scene"]

_MODULES = {
    "InputError": "twin.errors",
    "Twin": "twin.loading",
    "Viewpoints": "twin.geometry.cameras",
    "load": "twin.env.env_factory",
    "load_scene": "twin.loading",
}


def __getattr__(name: str) -> Any:
    """Imports a public name at its first use, so that `twin --help` imports nothing heavy."""
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


# For gymnasium.make("twin/Drive-v0"); registering does not import the environment.
gymnasium.register(
    "twin/Drive-v0", entry_point="twin.env.gym_env:DriveEnv", vector_entry_point="twin.env.gym_env:DriveVectorEnv"
)
