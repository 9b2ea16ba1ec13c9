"""From films and photos to metric cameras.

pycolmap is imported here, before any module of this package, to restore our signal handlers afterwards: those of
COLMAP's log library would answer SIGTERM with a C++ stack trace.
"""

from twin.runtime import signals_kept

with signals_kept():
    import pycolmap  # noqa: F401
