"""Computes metric camera poses from films and photos.

The import of pycolmap replaces our signal handlers by those of COLMAP's log library, which answer SIGTERM with a C++
stack trace. So pycolmap is imported here, before any module of this package, and our handlers are restored.
"""

from twin.runtime import signals_kept

with signals_kept():
    import pycolmap  # noqa: F401
