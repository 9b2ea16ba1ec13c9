"""`pycolmap`, imported so that SIGTERM stays ours: its log library would answer it with a C++ stack trace."""

from twin.cli import signals_kept

with signals_kept():
    import pycolmap

__all__ = ["pycolmap"]
