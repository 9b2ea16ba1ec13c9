"""Output of stage `capture`: the kept frames and their metadata before any reconstruction."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.files import check_shapes, load_arrays, read_json, require_text, wrap_read_errors, write_json


@dataclass(frozen=True)
class SourceInfo:
    """One source after capture. Its frames share one camera, except posed input with one camera per image."""

    name: str
    """Unique folder name of the source."""
    lighting: str
    kind: str
    """video, images, colmap or transforms."""
    width: int
    """Size of the kept frames [px]."""
    height: int
    camera_model: str
    """COLMAP model name of the known or assumed camera."""
    camera_params: tuple[float, ...]
    """Calibration or focal length prior [px], at the size of the kept frames; empty if unknown."""
    calibrated: bool
    """True if `camera_params` are a given calibration, which stays fixed."""
    camera_height: float
    """Lens above ground [m]; 0 = not given."""


@dataclass(frozen=True)
class Capture:
    """n kept frames, ordered by source and then by time."""

    sources: tuple[SourceInfo, ...]
    names: tuple[str, ...]
    """`<source>/<six digits>`; the image is `images/<name>.png` in the stage folder, its mask `masks/<name>.png`."""
    source_index: NDArray[np.int64]
    """Shape (n,)."""
    times: NDArray[np.float64]
    """Time within the source [s]; the index for photos without a clock. Shape (n,)."""
    held_out: NDArray[np.bool_]
    """True for test frames, which are never trained on. Shape (n,)."""
    gps: NDArray[np.float64]
    """Latitude [°], longitude [°], altitude [m]; NaN where unknown. Shape (n, 3)."""
    camera_to_world: NDArray[np.float64] | None = None
    """Poses given with the input (OpenCV axes), shape (n, 4, 4); None unless all sources have them."""
    intrinsics: NDArray[np.float64] | None = None
    """fx, fy, cx, cy [px] per frame of posed input at the kept size, shape (n, 4); `SourceInfo` has the distortion."""

    def save(self, folder: Path) -> None:
        """Writes `capture.json` and `capture.npz`."""
        arrays = {"source_index": self.source_index, "times": self.times, "held_out": self.held_out, "gps": self.gps}
        if self.camera_to_world is not None and self.intrinsics is not None:
            arrays |= {"camera_to_world": self.camera_to_world, "intrinsics": self.intrinsics}
        np.savez(folder / "capture.npz", **arrays)  # type: ignore[arg-type]
        write_json(folder / "capture.json", {"sources": [vars(s) for s in self.sources], "names": self.names})

    @staticmethod
    def load(folder: Path) -> "Capture":
        """Reads the files that `save` wrote. Raises InputError if they are missing or damaged."""
        head, data = read_json(folder / "capture.json"), load_arrays(folder / "capture.npz")
        with wrap_read_errors(folder / "capture.json", "build the scene again"):
            sources = tuple(SourceInfo(**{**s, "camera_params": tuple(s["camera_params"])}) for s in head["sources"])
            names = tuple(map(require_text, head["names"]))
        with wrap_read_errors(folder / "capture.npz", "build the scene again"):
            capture, n = Capture(sources, names, **data), len(names)
            shapes: dict[str, tuple[NDArray, tuple[int, ...], str]] = {
                "source_index": (capture.source_index, (n,), "i"),
                "times": (capture.times, (n,), "f"),
                "held_out": (capture.held_out, (n,), "b"),
                "gps": (capture.gps, (n, 3), "f"),
            }
            if capture.camera_to_world is not None and capture.intrinsics is not None:
                shapes["camera_to_world"] = capture.camera_to_world, (n, 4, 4), "f"
                shapes["intrinsics"] = capture.intrinsics, (n, 4), "f"
            check_shapes(shapes)
            if n and not (capture.source_index.min() >= 0 and capture.source_index.max() < len(sources)):
                raise ValueError(f"frames refer to a source index outside 0 to {len(sources) - 1}")
        return capture
