"""Imports `pycolmap` and keeps our SIGTERM handler: COLMAP's log library would print a C++ stack trace instead."""

from twin.runtime import signals_kept

with signals_kept():
    import pycolmap

__all__ = ["pycolmap"]
