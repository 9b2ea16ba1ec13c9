"""What the capture stage hands on: kept frames on disk, and what is known of each before any geometry."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.files import check_shapes, checked_text, damaged, load_arrays, read_json, write_json


@dataclass(frozen=True)
class SourceInfo:
    """One source after capture. All its frames share one camera unless poses came with one camera per image."""

    name: str
    """Unique folder name of the source."""
    lighting: str
    kind: str
    """video, images, colmap or transforms."""
    width: int
    """Size of the kept frames [px]."""
    height: int
    camera_model: str
    """COLMAP model name of the known or assumed camera, at the size of the kept frames."""
    camera_params: tuple[float, ...]
    """Known calibration or focal prior [px]; empty where nothing is known."""
    calibrated: bool
    """True: `camera_params` were given and are held fixed."""
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
    """Time within the source [s]; for photos without a clock their index. Shape (n,)."""
    held_out: NDArray[np.bool_]
    """True: never trained on. Shape (n,)."""
    gps: NDArray[np.float64]
    """Latitude [°], longitude [°], altitude [m]; NaN where unknown. Shape (n, 3)."""
    camera_to_world: NDArray[np.float64] | None = None
    """Poses that came with the input (OpenCV axes), shape (n, 4, 4); None unless every source brought them."""
    intrinsics: NDArray[np.float64] | None = None
    """fx, fy, cx, cy [px] per frame of posed input, at the kept size, shape (n, 4); distortion is in the source."""

    def save(self, folder: Path) -> None:
        """Writes `capture.json` and `capture.npz`."""
        arrays = {"source_index": self.source_index, "times": self.times, "held_out": self.held_out, "gps": self.gps}
        if self.camera_to_world is not None and self.intrinsics is not None:
            arrays |= {"camera_to_world": self.camera_to_world, "intrinsics": self.intrinsics}
        np.savez(folder / "capture.npz", **arrays)  # type: ignore[arg-type]
        write_json(folder / "capture.json", {"sources": [vars(s) for s in self.sources], "names": self.names})

    @staticmethod
    def load(folder: Path) -> "Capture":
        """Raises InputError: no such files, or not those that `save` wrote."""
        head, data = read_json(folder / "capture.json"), load_arrays(folder / "capture.npz")
        with damaged(folder / "capture.json", "build the scene again"):
            sources = tuple(SourceInfo(**{**s, "camera_params": tuple(s["camera_params"])}) for s in head["sources"])
            names = tuple(map(checked_text, head["names"]))
        with damaged(folder / "capture.npz", "build the scene again"):
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
                raise ValueError(f"frames of sources that are not among the {len(sources)}")
        return capture
