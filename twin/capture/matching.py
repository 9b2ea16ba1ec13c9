"""Selects pairs of frames and computes their features and matches in COLMAP's database.

A *pair* (i, j), i < j, holds indices of the capture's frames. Pairs come from four rules: *sequence* (neighbors in
time), *probes* (a few distant frames that look alike or lie equally far along two sources), *expansion* (frames
near those of a verified probe) and *nearness* (cameras reconstructed close to each other). A pair is *verified* if
enough of its matches satisfy one two-view geometry. Each source has one database camera; posed input may have one per
image. A camera is *known* (a given, fixed calibration), has a focal length *prior*, or is *unknown*.
"""

import itertools
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from twin.capture.camera_models import Lens
from twin.capture.capture_data import Capture, SourceInfo
from twin.capture.pair_geometry import Pair, PairGeometry, ordered_pair, pair_geometries
from twin.capture.pose_averaging import consistent_pairs
from twin.capture.worker import send_message
from twin.errors import InputError
from twin.geometry.cameras import evenly_spaced
from twin.geometry.images import write_image
from twin.types import Array

SEQUENCE_STEPS = (1, 2, 3, 4, 6, 8, 12)
"""Distances [frames] of sequence pairs within a source: short ones for neighbors, long ones against drift.

Matches between frames that are farther apart are mostly on very distant objects, which mislead global mapping.
"""
PROBE_INLIERS = 25
"""Least number of verified matches that proves a common view of a pair; fewer than 20 occur by chance."""
_LINKING_PAIRS = 8  # pairs with a consistent rotation that link two sources; in short sources, half as many as frames
_WORDS = 32  # visual words of the VLAD descriptor
_SAMPLES_PER_FRAME = 150
_PROBES_PER_SOURCE = 20
_CROSS_OFFSETS: tuple[int, ...] = (-2, -1, 0, 1, 2)  # [frames] around the expected counterpart of a frame
_BLIND_OFFSETS: tuple[int, ...] = (-3, -2, -1, 0, 1, 2, 3)  # [frames] the same if no counterpart is known
_CHUNK_FRAMES = 16
_CHUNK_PAIRS = 100
_MIN_FEATURES = 50  # smallest accepted median number of features per frame
_UNKNOWN_FOCAL = 1.2  # [longer side], COLMAP's default


# ---- selection of pairs


def frames_by_source(source_index: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Frame indices of each source, in time order."""
    return [np.flatnonzero(source_index == s) for s in range(int(source_index.max()) + 1)]


def sequence_pairs(source_index: NDArray[np.int64]) -> set[Pair]:
    """Neighbors in time within each source."""
    return {
        pair
        for frames in frames_by_source(source_index)
        for step in SEQUENCE_STEPS
        for pair in zip(frames[:-step].tolist(), frames[step:].tolist(), strict=True)
    }


def frame_signatures(
    descriptors: list[NDArray[np.uint8]], source_index: NDArray[np.int64], rng: np.random.Generator
) -> Array:
    """VLAD image descriptors (Jégou et al. 2010, eq. 1): one unit vector per frame, for retrieval of similar frames.

    Each source's mean is subtracted, since it represents the lighting rather than the place. `descriptors` holds the
    SIFT descriptors (m_i, 128) of each frame; the result has shape (n, 32 · 128), zero for a frame without features.
    """
    sample = np.concatenate(
        [d[rng.permutation(len(d))[:_SAMPLES_PER_FRAME]] for d in descriptors], dtype=np.float32
    ).reshape(-1, 128)
    n = len(descriptors)
    if len(sample) < _WORDS:
        return np.zeros((n, _WORDS * 128))
    words = sample[rng.permutation(len(sample))[:_WORDS]]
    for _ in range(8):  # Lloyd's iterations; a few suffice for retrieval
        nearest = _nearest_words(sample, words)
        for k in range(_WORDS):
            if np.any(nearest == k):
                words[k] = sample[nearest == k].mean(0)
    signatures = np.zeros((n, _WORDS, 128))
    for i, d in enumerate(descriptors):
        if not len(d):
            continue
        features = d.astype(np.float32)
        nearest = _nearest_words(features, words)
        np.add.at(signatures[i], nearest, features - words[nearest])
        signatures[i] /= np.maximum(np.linalg.norm(signatures[i], axis=1, keepdims=True), 1e-9)
    flat = signatures.reshape(n, -1)
    for frames in frames_by_source(source_index):
        flat[frames] -= flat[frames].mean(0)
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)


def _nearest_words(features: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    return np.argmax(features @ words.T - 0.5 * (words**2).sum(1), axis=1)


def probe_pairs(source_index: NDArray[np.int64], signatures: Array) -> set[Pair]:
    """Pairs of frames that may show the same place: of two sources, or of one source that may have returned to a place.

    Each probed frame is paired with four frames of every later source: the frame equally far along it, and the three
    most similar frames. Within its own source, it is paired with the two most similar frames beyond the sequence steps.
    """
    similarity = signatures @ signatures.T
    groups = frames_by_source(source_index)
    pairs: set[Pair] = set()
    for a, first in enumerate(groups):
        probed = evenly_spaced(len(first), _PROBES_PER_SOURCE)
        for k in probed:
            i = int(first[k])
            far = first[np.abs(np.arange(len(first)) - k) > SEQUENCE_STEPS[-1]]
            pairs.update(ordered_pair(i, int(j)) for j in far[np.argsort(-similarity[i, far])[:2]])
            for second in groups[a + 1 :]:
                guess = round(k * (len(second) - 1) / max(len(first) - 1, 1))
                pairs.add(ordered_pair(i, int(second[guess])))
                pairs.update(ordered_pair(i, int(j)) for j in second[np.argsort(-similarity[i, second])[:3]])
    return pairs


def expanded_pairs(
    source_index: NDArray[np.int64], probes: set[Pair], inliers: dict[Pair, int], min_inliers: int
) -> set[Pair]:
    """Pairs of frames near those of the verified probes.

    Across two sources, the best match of each probed frame is an anchor. Between anchors the position along the other
    source is interpolated, so that films of different speeds are paired frame by frame. With fewer than two anchors the
    frames are paired by equal fractions of the sources' lengths. `inliers` holds the number of verified matches per
    pair; a probe with at least `min_inliers` of them counts as verified.
    """
    groups = frames_by_source(source_index)
    position = np.concatenate([np.arange(len(frames)) for frames in groups])
    verified = {pair: inliers[pair] for pair in probes if inliers.get(pair, 0) >= min_inliers}
    pairs: set[Pair] = set()
    for i, j in verified:
        frames = groups[source_index[i]]
        if source_index[i] == source_index[j]:
            for di, dj in itertools.product(_CROSS_OFFSETS, _CROSS_OFFSETS):
                p, q = position[i] + di, position[j] + dj
                if 0 <= p < len(frames) and 0 <= q < len(frames) and p != q:
                    pairs.add(ordered_pair(int(frames[p]), int(frames[q])))
    for a, b in itertools.combinations(range(len(groups)), 2):
        first, second = groups[a], groups[b]
        best: dict[int, tuple[int, int]] = {}
        for (i, j), count in verified.items():
            if source_index[i] == a and source_index[j] == b:
                best[int(position[i])] = max(best.get(int(position[i]), (0, 0)), (count, int(position[j])))
        k, pace = np.arange(len(first)), (len(second) - 1) / max(len(first) - 1, 1)
        offsets: tuple[int, ...] = _CROSS_OFFSETS
        if len(best) >= 2:
            anchors = sorted(best)
            counterpart = np.interp(k, anchors, [best[p][1] for p in anchors])
            # np.interp is constant beyond the outermost anchors; there the ratio of the sources' lengths is the slope.
            counterpart += pace * (np.minimum(k - anchors[0], 0) + np.maximum(k - anchors[-1], 0))
        else:
            counterpart, offsets = k * (len(second) - 1) / max(len(first) - 1, 1), _BLIND_OFFSETS
        for i, center in zip(first.tolist(), np.rint(counterpart).astype(int), strict=True):
            pairs.update(ordered_pair(i, int(second[center + d])) for d in offsets if 0 <= center + d < len(second))
    return pairs


def near_pairs(
    camera_to_world: Array, frames: NDArray[np.int64], tried: set[Pair], reach: float, most: int
) -> set[Pair]:
    """Pairs each frame with up to `most` of the frames nearest to it.

    These are at most `reach` away, in the unit of the poses, and their viewing directions differ by less than 60°. The
    poses (k, 4, 4) belong to `frames` (k,). A pair (i, j) is left out if a tried pair (a, b) is close: i is at most two
    frames from a, and j from b.
    """
    centers, forward = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    offsets = list(itertools.product(_CROSS_OFFSETS, _CROSS_OFFSETS))
    linked = {ordered_pair(i + di, j + dj) for i, j in tried for di, dj in offsets if i + di != j + dj}
    pairs: set[Pair] = set()
    for k in range(len(frames)):
        distance = np.linalg.norm(centers - centers[k], axis=1)
        usable = (distance <= reach) & (forward @ forward[k] > 0.5)
        usable[k] = False
        order = np.argsort(distance)
        near = (ordered_pair(int(frames[k]), int(frames[other])) for other in order[usable[order]])
        pairs.update(itertools.islice((pair for pair in near if pair not in linked), most))
    return pairs


# ---- COLMAP's database


@dataclass
class Matcher:
    """The database of one capture and the pairs that were tried in it."""

    database: Path
    images: Path
    masks: Path | None
    capture: Capture
    image_ids: NDArray[np.int64]  # database id of each frame, shape (n,)
    threads: int
    seed: int
    tried: set[Pair]
    frames: NDArray[np.int64]  # indices of the frames that are to be reconstructed
    known: dict[tuple[int, int], PairGeometry] = field(default_factory=dict)  # by database ids, see `geometries`

    def frame_of(self) -> dict[int, int]:
        """Database id → frame index."""
        return {int(image): frame for frame, image in enumerate(self.image_ids)}

    def extract(self, most: int, max_size: int) -> None:
        """Extracts at most `most` SIFT features per frame, on unmasked pixels of images scaled down to `max_size` [px].

        Raises InputError: the frames of a source have too little texture.
        """
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads, options.max_image_size, options.use_gpu = self.threads, max_size, False
        options.sift.max_num_features = most
        reader = pycolmap.ImageReaderOptions()
        if self.masks:
            reader.mask_path = str(self.masks)
        names = [f"{name}.png" for name in self.capture.names]
        send_message(bar="features", total=len(names))
        for start in range(0, len(names), _CHUNK_FRAMES):
            chunk = names[start : start + _CHUNK_FRAMES]
            pycolmap.extract_features(
                self.database, self.images, chunk, pycolmap.CameraMode.PER_IMAGE, reader, options, pycolmap.Device.cpu
            )
            send_message(step=len(chunk))
        with pycolmap.Database.open(self.database) as database:
            counts = np.array([database.num_keypoints_for_image(int(i)) for i in self.image_ids])
        for s, source in enumerate(self.capture.sources):
            median = float(np.median(counts[self.capture.source_index == s]))
            if median < _MIN_FEATURES:
                raise InputError(
                    f"source {source.name!r}: a median of {median:.0f} features per frame (need {_MIN_FEATURES}); "
                    "film a scene with more texture and light, in focus, or mask less of the picture"
                )

    def descriptors(self) -> list[NDArray[np.uint8]]:
        """SIFT descriptors per frame, shapes (m, 128)."""
        with pycolmap.Database.open(self.database) as database:
            return [np.asarray(database.read_descriptors(int(i)).data).reshape(-1, 128) for i in self.image_ids]

    def match(self, pairs: set[Pair], label: str) -> None:
        """Matches and verifies the pairs that were not tried before; `label` is shown beside the progress bar."""
        fresh = sorted(pairs - self.tried)
        self.tried.update(fresh)
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads, options.use_gpu = self.threads, False
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self.seed
        pairing = pycolmap.ImportedPairingOptions()
        listing = self.database.with_name("pairs.txt")
        pairing.match_list_path = str(listing)
        send_message(bar=label, total=len(fresh))
        for start in range(0, len(fresh), _CHUNK_PAIRS):
            chunk = fresh[start : start + _CHUNK_PAIRS]
            names = self.capture.names
            listing.write_text("".join(f"{names[i]}.png {names[j]}.png\n" for i, j in chunk), encoding="utf-8")
            pycolmap.match_image_pairs(self.database, options, pairing, verification, pycolmap.Device.cpu)
            send_message(step=len(chunk))

    def verified(self) -> dict[Pair, int]:
        """Number of verified matches per verified pair."""
        frame_of = self.frame_of()
        with pycolmap.Database.open(self.database) as database:
            pair_ids, counts = database.read_two_view_geometry_num_inliers()
        pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids]
        return {ordered_pair(frame_of[a], frame_of[b]): n for (a, b), n in zip(pairs, counts, strict=True) if n > 0}

    def geometries(self) -> list[PairGeometry]:
        """Geometry of all verified pairs. The cameras' parameters must not change after the first call."""
        return pair_geometries(self.database, self.seed, self.known, processes=self.threads)

    def geometries_among(self, pairs: set[Pair], cameras: Mapping[int, pycolmap.Camera]) -> list[PairGeometry]:
        """Geometry of the verified ones of the given pairs of frames, with the cameras of a model."""
        images = {ordered_pair(int(self.image_ids[i]), int(self.image_ids[j])) for i, j in pairs}
        return pair_geometries(self.database, self.seed, self.known, images, cameras, self.threads)

    def linked_groups(self) -> list[NDArray[np.int64]]:
        """Groups of frames (k,) whose sources are linked, the largest first.

        Two sources are linked if enough of their pairs agree on the rotation between them. Films that go in opposite
        directions have no view in common, but many of their pairs may be verified by chance.
        """
        source, count = self.capture.source_index, len(self.capture.sources)
        consistent = np.zeros((count, count))
        for i, j in consistent_pairs(self.geometries(), self.frame_of(), source):
            consistent[source[i], source[j]] += 1
        frames = np.bincount(source, minlength=count)
        # At least two, since a single pair is always consistent with itself.
        enough = np.clip(np.minimum(frames, frames[:, None]) / 2, 2, _LINKING_PAIRS)
        linked = csr_matrix(consistent + consistent.T >= enough)
        group = connected_components(linked, directed=False)[1]
        groups = [np.flatnonzero(group[source] == k) for k in range(int(group.max()) + 1)]
        return sorted(groups, key=lambda one: (-len(one), int(one[0])))

    def restricted(self, frames: NDArray[np.int64], folder: Path) -> "Matcher":
        """A matcher of some of the frames, with its own database in a folder."""
        inside = set(frames.tolist())
        others = [pair for pair in self.verified() if not inside.issuperset(pair)]
        return replace(self, database=self.copied_without(others, folder), tried=set(self.tried), frames=frames)

    def copied_without(self, pairs: list[Pair], folder: Path) -> Path:
        """A copy of the database, in a folder, in which some pairs are not verified."""
        path = folder / self.database.name
        shutil.copyfile(self.database, path)
        with pycolmap.Database.open(path) as database:
            for i, j in pairs:
                database.delete_two_view_geometry(int(self.image_ids[i]), int(self.image_ids[j]))
        return path


def open_database(capture: Capture, stage: Path, work: Path, free_focal: bool, threads: int, seed: int) -> Matcher:
    """Creates a database in `work` with the frames and cameras of a capture, whose stage folder is `stage`.

    `free_focal` ignores all calibrations and focal length priors; `threads` and `seed` are for COLMAP and relative
    poses.
    """
    path, images = work / "database.db", stage / "images"
    path.unlink(missing_ok=True)
    pycolmap.Database.open(path).close()
    image_ids = np.zeros(len(capture.names), np.int64)
    given = capture.intrinsics if capture.camera_to_world is not None else None
    for s, source in enumerate(capture.sources):
        frames = np.flatnonzero(capture.source_index == s)
        camera_per_image = given is not None and bool(np.ptp(given[frames], axis=0).max() > 1e-9)
        mode = pycolmap.CameraMode.PER_IMAGE if camera_per_image else pycolmap.CameraMode.SINGLE
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "PINHOLE"
        # Importing the images before feature extraction makes their ids follow the order of frames, not of threads.
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
                    intrinsics = None if given is None else given[i]
                    database.update_camera(_camera(source, image.camera_id, free_focal, intrinsics))
    masks, frames = _mask_folder(capture, stage, work), np.arange(len(capture.names))
    return Matcher(path, images, masks, capture, image_ids, threads, seed, set(), frames)


def _camera(source: SourceInfo, camera_id: int, free_focal: bool, intrinsics: Array | None) -> pycolmap.Camera:
    """A source's camera, or that of a posed image with given intrinsics (4,)."""
    width, height = source.width, source.height
    lens = Lens(source.camera_model, source.camera_params, width, height)
    if intrinsics is not None:
        lens = lens if lens.params else Lens("PINHOLE", (0.0,) * 4, width, height)
        lens = lens.with_intrinsics(intrinsics)
    elif free_focal or not lens.params:
        model, guess = source.camera_model or "SIMPLE_RADIAL", _UNKNOWN_FOCAL * max(width, height)
        camera = pycolmap.Camera.create_from_model_name(camera_id, model, guess, width, height)
        camera.has_prior_focal_length = False
        return camera
    camera = lens.camera
    camera.camera_id, camera.has_prior_focal_length = camera_id, True
    return camera


def _mask_folder(capture: Capture, stage: Path, work: Path) -> Path | None:
    """Copies the masks to a folder under COLMAP's names (`a.png.png` for `a.png`); None if no frame has a mask."""
    masks = [stage / "masks" / f"{name}.png" for name in capture.names]
    if not any(mask.exists() for mask in masks):
        return None
    folder = work / "masks"
    for name, mask, s in zip(capture.names, masks, capture.source_index, strict=True):
        target = folder / f"{name}.png.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        if mask.exists():
            shutil.copyfile(mask, target)
        else:  # COLMAP extracts no features from an image whose mask is missing
            source = capture.sources[int(s)]
            write_image(target, np.full((source.height, source.width), 255, np.uint8))
    return folder
