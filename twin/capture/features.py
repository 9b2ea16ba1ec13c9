"""Features and matches of a capture in COLMAP's database.

One database camera per source (posed input may bring one per image). A *known* camera is a given calibration, held
fixed for good; a *prior* one has a focal length to start from; an *unknown* one has neither. A pair is *verified* when
enough of its matches obey one two-view geometry.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.capture.lens import Lens
from twin.capture.pairs import Pair, ordered
from twin.capture.pycolmap_import import pycolmap
from twin.capture.types import Capture, SourceInfo
from twin.capture.worker import tell
from twin.errors import InputError
from twin.geometry.images import write_image

_CHUNK_FRAMES = 16
_CHUNK_PAIRS = 100
_MIN_FEATURES = 50
_UNKNOWN_MODEL = "SIMPLE_RADIAL"
_UNKNOWN_FOCAL = 1.2  # [longer side], COLMAP's own guess


@dataclass
class Matcher:
    """The database of one capture, and which pairs were tried in it."""

    database: Path
    images: Path
    masks: Path | None
    capture: Capture
    image_ids: NDArray[np.int64]
    """Database id of each frame, shape (n,)."""
    threads: int
    seed: int
    tried: set[Pair]

    def frame_of(self) -> dict[int, int]:
        """Database id → frame index."""
        return {int(image): frame for frame, image in enumerate(self.image_ids)}

    def extract(self, most: int, max_size: int) -> None:
        """Finds SIFT features in every frame, masked parts left out.

        Raises:
            InputError: a source has frames without texture.
        """
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads, options.max_image_size, options.use_gpu = self.threads, max_size, False
        options.sift.max_num_features = most
        reader = pycolmap.ImageReaderOptions()
        if self.masks:
            reader.mask_path = str(self.masks)
        names = [f"{name}.png" for name in self.capture.names]
        tell(bar="features", total=len(names))
        for start in range(0, len(names), _CHUNK_FRAMES):
            chunk = names[start : start + _CHUNK_FRAMES]
            pycolmap.extract_features(
                self.database, self.images, chunk, pycolmap.CameraMode.PER_IMAGE, reader, options, pycolmap.Device.cpu
            )
            tell(step=len(chunk))
        with pycolmap.Database.open(self.database) as database:
            counts = np.array([database.num_keypoints_for_image(int(i)) for i in self.image_ids])
        for s, source in enumerate(self.capture.sources):
            median = float(np.median(counts[self.capture.source_index == s]))
            if median < _MIN_FEATURES:
                raise InputError(
                    f"source {source.name!r}: {median:.0f} features per frame in the median (need {_MIN_FEATURES}); "
                    "film with more texture and light in view, in focus, or mask less"
                )

    def descriptors(self) -> list[NDArray[np.uint8]]:
        """SIFT descriptors per frame, shapes (m, 128)."""
        with pycolmap.Database.open(self.database) as database:
            return [np.asarray(database.read_descriptors(int(i)).data).reshape(-1, 128) for i in self.image_ids]

    def match(self, pairs: set[Pair], what: str) -> None:
        """Matches and verifies the pairs that were not tried before."""
        fresh = sorted(pairs - self.tried)
        self.tried.update(fresh)
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads, options.use_gpu = self.threads, False
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self.seed
        pairing = pycolmap.ImportedPairingOptions()
        listing = self.database.with_name("pairs.txt")
        pairing.match_list_path = str(listing)
        tell(bar=what, total=len(fresh))
        for start in range(0, len(fresh), _CHUNK_PAIRS):
            chunk = fresh[start : start + _CHUNK_PAIRS]
            names = self.capture.names
            listing.write_text("".join(f"{names[i]}.png {names[j]}.png\n" for i, j in chunk), encoding="utf-8")
            pycolmap.match_image_pairs(self.database, options, pairing, verification, pycolmap.Device.cpu)
            tell(step=len(chunk))

    def verified(self) -> dict[Pair, int]:
        """Verified matches per pair of frames, where there are any."""
        frame_of = self.frame_of()
        with pycolmap.Database.open(self.database) as database:
            pair_ids, counts = database.read_two_view_geometry_num_inliers()
        pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids]
        return {ordered(frame_of[a], frame_of[b]): n for (a, b), n in zip(pairs, counts, strict=True) if n > 0}


def open_database(capture: Capture, stage: Path, work: Path, free_focal: bool, threads: int, seed: int) -> Matcher:
    """A fresh database with the capture's frames and cameras.

    Args:
        capture: The kept frames.
        stage: The capture stage's folder.
        work: Where the database is made.
        free_focal: Forget every calibration and focal prior.
        threads: For COLMAP.
        seed: For COLMAP's RANSAC.
    """
    path, images = work / "database.db", stage / "images"
    path.unlink(missing_ok=True)
    pycolmap.Database.open(path).close()
    image_ids = np.zeros(len(capture.names), np.int64)
    for s, source in enumerate(capture.sources):
        frames = np.flatnonzero(capture.source_index == s)
        posed = capture.camera_to_world is not None and capture.intrinsics is not None
        one_each = posed and bool(np.ptp(capture.intrinsics[frames], axis=0).max() > 1e-9)  # type: ignore[index]
        mode = pycolmap.CameraMode.PER_IMAGE if one_each else pycolmap.CameraMode.SINGLE
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "PINHOLE"
        # Imported before features are found, so that ids follow the frames' order and not the threads' luck.
        pycolmap.import_images(path, images, mode, [f"{capture.names[i]}.png" for i in frames], reader)
        with pycolmap.Database.open(path) as database:
            done = set()
            for i in frames:
                image = database.read_image_with_name(f"{capture.names[i]}.png")
                if image is None:
                    raise InputError(f"{images / capture.names[i]}.png: not a readable image; build again from scratch")
                image_ids[i] = image.image_id
                if image.camera_id not in done:
                    done.add(image.camera_id)
                    intrinsics = capture.intrinsics[i] if capture.intrinsics is not None and posed else None
                    database.update_camera(_camera(source, image.camera_id, free_focal and not posed, intrinsics))
    return Matcher(path, images, _mask_folder(capture, stage, work), capture, image_ids, threads, seed, set())


def _camera(source: SourceInfo, camera_id: int, forget: bool, intrinsics: NDArray | None) -> pycolmap.Camera:
    model, params = source.camera_model, source.camera_params
    if intrinsics is not None:
        lens = Lens(model, params, source.width, source.height) if params else None
        if lens is None:
            model, params = "PINHOLE", tuple(float(v) for v in intrinsics)
        else:
            params = lens.with_intrinsics(np.asarray(intrinsics)).params
        forget = False
    if not params or forget:
        guess = _UNKNOWN_FOCAL * max(source.width, source.height)
        camera = pycolmap.Camera.create_from_model_name(
            camera_id, model or _UNKNOWN_MODEL, guess, source.width, source.height
        )
        camera.has_prior_focal_length = False
        return camera
    return pycolmap.Camera(
        camera_id=camera_id,
        model=model,
        width=source.width,
        height=source.height,
        params=list(params),
        has_prior_focal_length=True,
    )


def _mask_folder(capture: Capture, stage: Path, work: Path) -> Path | None:
    """The masks under the names COLMAP looks for: `a.png` has the mask `a.png.png`. None where nothing is masked."""
    masked = {name for name in capture.names if (stage / "masks" / f"{name}.png").exists()}
    if not masked:
        return None
    folder = work / "masks"
    for name, s in zip(capture.names, capture.source_index, strict=True):
        target = folder / f"{name}.png.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        if name in masked:
            shutil.copyfile(stage / "masks" / f"{name}.png", target)
        else:  # COLMAP finds nothing in an image whose mask is missing
            source = capture.sources[int(s)]
            write_image(target, np.full((source.height, source.width), 255, np.uint8))
    return folder
