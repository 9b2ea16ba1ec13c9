"""What the capture stage hands on: kept frames on disk, and what is known of each before any geometry."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.scene import read_json, write_json


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
        head = read_json(folder / "capture.json")
        sources = tuple(SourceInfo(**{**s, "camera_params": tuple(s["camera_params"])}) for s in head["sources"])
        with np.load(folder / "capture.npz", allow_pickle=False) as data:
            return Capture(sources, tuple(head["names"]), **{key: data[key] for key in data.files})
