"""Evaluation of a field on held-out frames, and a control experiment: filmed poses rendered under other lightings.

An embedding is fitted on one half of a held-out frame, left or right, starting from the embedding of its lighting; the
other half is scored. A score is the mean over both halves. *Unfitted* scores use the embedding of the lighting itself;
*wrong* scores use the embeddings of the other lightings, unfitted. *Small* scores use images of the size that policies
see, each half rendered under the embedding that was fitted on the other half. If there is a baked field, it is scored
instead of the trained one, since users see the baked one.
"""

from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from twin.geometry.cameras import Cameras, RenderableField, evenly_spaced, nearest_frame, pixel_grid, unproject
from twin.geometry.images import SSIM_WINDOW, psnr, resize, ssim
from twin.nerf import network
from twin.nerf.appearance import fit_appearance
from twin.nerf.baked import BakedField
from twin.nerf.buffers import CameraArrays, single_threaded_torch
from twin.nerf.dataset import load_frame
from twin.nerf.field import RadianceField
from twin.runtime import track
from twin.types import Array

_FIT_RAYS = 4000  # rays of half an image that a fit uses, evenly spaced
_MAX_FRAMES = 6  # held-out frames scored per lighting, evenly spaced
_SMALL_WIDTH = 160  # [px] width of the images that policies see
_ROW_STEP = 8  # step between the image rows on which the trained and the baked field are compared


def score_frame(
    field: RadianceField, cameras: Cameras, i: int, max_width: int, baked: BakedField | None = None
) -> dict[str, float]:
    """Scores of one held-out frame, see `evaluate`; nan or missing where unknown, empty if all of it is masked."""
    bytes_, mask, intrinsics = load_frame(cameras, i, max_width)
    if not mask.any():
        return {}
    image = bytes_.astype(np.float32) / 255.0
    height, width = mask.shape
    camera = cameras.select(np.array([i]))
    start = field.embedding(cameras.lightings[i])
    grid = pixel_grid(width, height)
    arrays = CameraArrays(camera.camera_to_world, intrinsics[None], field.device)
    # The trained field is slow to render, so if a baked one is given, the trained one renders only some rows.
    rows = slice(None) if baked is None else slice(min(_ROW_STEP, height) // 2, None, _ROW_STEP)
    pixel = grid[rows].reshape(-1, 2)
    features, harmonics, _, _ = field.trace(arrays, np.zeros(len(pixel), int), pixel)
    if baked is not None:
        trained = field.color(features, harmonics, start).reshape(image[rows].shape)
        rays = unproject(grid.reshape(-1, 2), intrinsics) @ camera.camera_to_world[0, :3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        harmonics = network.spherical_harmonics(torch.as_tensor(rays.astype(np.float32), device=field.device))
        composited = baked.render_features(camera, start, (width, height))[1][0].reshape(-1, height * width).T
        features = network.ray_features(field.parameters, torch.as_tensor(composited, device=field.device), harmonics)
    colors = torch.as_tensor(image.reshape(-1, 3), device=field.device)

    def picture(embedding: NDArray[np.float32]) -> NDArray[np.float32]:
        return field.color(features, harmonics, embedding).reshape(height, width, 3)

    out = {}
    if baked is not None and mask[rows].any():
        gain = psnr(picture(start)[rows], image[rows], mask[rows]) - psnr(trained, image[rows], mask[rows])
        out["baking_gain"] = gain

    left = np.zeros((height, width), bool)
    left[:, : width // 2] = True
    psnrs, ssims, fitted = [], [], []
    for half in (left, ~left):
        fit_on, score_on = np.flatnonzero(half & mask), ~half & mask
        if not len(fit_on) or not score_on.any():
            continue
        some = torch.as_tensor(fit_on[:: max(1, len(fit_on) // _FIT_RAYS)], device=field.device)
        fitted.append(fit_appearance(field.parameters, features[some], harmonics[some], colors[some], start)[0])
        shown = picture(fitted[-1])
        psnrs.append(psnr(shown, image, score_on))
        # Copying masked pixels from the frame limits their effect on the windows of SSIM that contain them.
        shown[~mask] = image[~mask]
        side = slice(width // 2, None) if half is left else slice(None, width // 2)
        if min(height, width // 2) >= SSIM_WINDOW:
            ssims.append(ssim(shown[:, side], image[:, side], mask[:, side]))
    if baked is not None and len(fitted) == 2:
        out |= _small_scores(baked, camera, image, mask, fitted)
    others = [name for name in field.lightings if name != cameras.lightings[i]]
    wrong = [psnr(picture(field.embedding(name)), image, mask) for name in others]
    return out | {
        "psnr": float(np.mean(psnrs)) if psnrs else float("nan"),
        "ssim": float(np.nanmean(ssims)) if np.isfinite(ssims).any() else float("nan"),
        "psnr_unfitted": psnr(picture(start), image, mask),
        "psnr_wrong_lighting": float(np.mean(wrong)) if wrong else float("nan"),
    }


def _small_scores(
    baked: BakedField, camera: Cameras, image: NDArray, mask: NDArray[np.bool_], fitted: list[NDArray[np.float32]]
) -> dict[str, float]:
    """Small scores (see the module) of a frame, with the embeddings that were fitted on its left and its right half."""
    height, width = mask.shape
    size = min(_SMALL_WIDTH, width), max(1, round(height * min(_SMALL_WIDTH, width) / width))
    wanted, usable = resize(image, *size), resize(mask.astype(np.float32), *size) > 0.999
    left, right = (baked.render(camera, embedding, size).rgb[0] for embedding in fitted)
    shown = np.concatenate([right[:, : size[0] // 2], left[:, size[0] // 2 :]], 1)
    shown[~usable] = wanted[~usable]
    out = {}
    for name, rows in (("small", slice(0, None)), ("small_lower", slice(size[1] // 2, None))):
        if not usable[rows].any():
            continue
        out[f"psnr_{name}"] = psnr(shown[rows], wanted[rows], usable[rows])
        if min(shown[rows].shape[:2]) >= SSIM_WINDOW:
            out[f"ssim_{name}"] = ssim(shown[rows], wanted[rows], usable[rows])
    return out


def evaluate(
    field: RadianceField,
    cameras: Cameras,
    max_width: int,
    max_frames: int = _MAX_FRAMES,
    baked: BakedField | None = None,
) -> dict[str, Any]:
    """Mean held-out scores by lighting, as a dictionary of dictionaries: score → lighting → mean.

    The scores are `psnr` [dB], `ssim`, `psnr_unfitted` and `psnr_wrong_lighting` (None without another lighting); with
    a baked field also `baking_gain` [dB], its unfitted PSNR minus that of the trained field on every eighth row, and
    `psnr_small` and `ssim_small` of images at most 160 px wide, and `psnr_small_lower` and `ssim_small_lower` of their
    lower halves. `n` is the number of frames that are not masked as a whole; lightings without any have n = 0 and no
    other entry.
    """
    keys = ["psnr", "ssim", "psnr_unfitted"]
    if baked is not None:
        keys += ["baking_gain", "psnr_small", "psnr_small_lower", "ssim_small", "ssim_small_lower"]
    keys += ["n", "psnr_wrong_lighting"]
    result: dict[str, Any] = {key: {} for key in keys}
    frames = []
    for name in field.lightings:
        mine = [i for i in np.flatnonzero(cameras.held_out) if cameras.lightings[i] == name]
        frames += [(name, int(mine[k])) for k in evenly_spaced(len(mine), max_frames)]
    scores: dict[str, list[dict[str, float]]] = {name: [] for name in field.lightings}
    with single_threaded_torch():
        for name, i in track(frames, "held-out frames", unit="frame"):
            if row := score_frame(field, cameras, i, max_width, baked):
                scores[name].append(row)
    for name, rows in scores.items():
        if rows:
            result["psnr_wrong_lighting"][name] = None
        for key in keys:
            values = [row[key] for row in rows if np.isfinite(row.get(key, np.nan))]
            if values:
                result[key][name] = round(float(np.mean(values)), 4)
        result["n"][name] = len(rows)
    return result


# ---- cross-lighting control

_MAX_POSES = 60  # poses of all lightings together, evenly spaced over each lighting's frames
_WIDTH = 96  # [px] longer side of the images


def cross_lighting(field: RenderableField, cameras: Cameras, max_poses: int = _MAX_POSES) -> dict[str, Any] | None:
    """Renders training poses under every lighting, not only their own; None with fewer than two lightings.

    Only the mean color of an image is used (RGB in [0, 1], over unmasked pixels). No film shows a pose under two
    lightings, so the reference for lighting j is the nearest frame filmed under j.

    Keys, with Euclidean color distances in RGB:

    * `poses`: number of poses, each rendered under every lighting.
    * `filmed_colour[i]`: mean color of the film at the poses of lighting i.
    * `mean_colour[i][j]`: mean color of the poses of lighting i, rendered under j.
    * `to_shown_rms[j]`: rms distance between `filmed_colour[j]` and the poses of other lightings, rendered under j.
    * `to_filmed_rms[j]`: rms distance between the same renderings and `filmed_colour[i]`, where i is the lighting under
      which each pose was filmed.
    * `colour_follows[j]`: share of the same renderings that are closer to the nearest frame filmed under j than to the
      frame filmed at their pose; a tie counts one half. 1: the lighting decides the color; 0: the pose decides it.
    * `follows_by_pair[i][j]`: the same for the poses of lighting i alone.
    * `depth_moves_m`: greatest change of any pixel's depth between two lightings [m], 0 by construction.
    """
    trained = cameras.select(~cameras.held_out)
    lightings = [name for name in field.lightings if name in trained.lightings]
    if len(lightings) < 2:
        return None

    @cache
    def filmed(i: int) -> Array:
        image, mask, _ = load_frame(trained, i, _WIDTH)
        return mean_color(image / 255.0, mask)

    poses = []
    for name in lightings:
        mine = [i for i, light in enumerate(trained.lightings) if light == name]
        poses += [mine[k] for k in evenly_spaced(len(mine), max(1, max_poses // len(lightings)))]
    light = np.array([lightings.index(trained.lightings[i]) for i in poses])
    shown = np.empty((len(poses), len(lightings), 3))
    moves = 0.0
    for row, i in enumerate(track(poses, "poses under every lighting", unit="pose")):
        mask = load_frame(trained, i, _WIDTH)[1]
        views = [field.render(trained.select(np.array([i])), name, mask.shape[::-1]) for name in lightings]
        shown[row] = [mean_color(view.rgb[0], mask) for view in views]
        moves = max(moves, float(np.ptp([view.depth[0] for view in views], axis=0).max()))
    own = np.array([filmed(i) for i in poses])
    film = np.array([own[light == j].mean(0) for j in range(len(lightings))])
    out: dict[str, Any] = {
        "poses": len(poses),
        "filmed_colour": {name: _rounded(film[j]) for j, name in enumerate(lightings)},
        "mean_colour": {
            name: {other: _rounded(shown[light == i, j].mean(0)) for j, other in enumerate(lightings)}
            for i, name in enumerate(lightings)
        },
    }
    columns: dict[str, dict[str, float]] = {"to_shown_rms": {}, "to_filmed_rms": {}, "colour_follows": {}}
    pairs: dict[str, dict[str, float]] = {name: {} for name in lightings}
    for j, name in enumerate(lightings):
        rows = np.flatnonzero(light != j)
        nearest = [nearest_frame(trained, poses[row], name) for row in rows]
        there = np.array([filmed(i) for i in nearest if i is not None])  # never None: each lighting has a frame
        # Differences below 5e-7 are rounding errors and count as a tie.
        nearer = np.round(_distance(shown[rows, j], own[rows]) - _distance(shown[rows, j], there), 6)
        for key, reference in (("to_shown_rms", film[j]), ("to_filmed_rms", film[light[rows]])):
            rms = np.sqrt((_distance(shown[rows, j], reference) ** 2).mean())
            columns[key][name] = round(float(rms), 4)
        follows = 0.5 + 0.5 * np.sign(nearer)
        columns["colour_follows"][name] = round(float(follows.mean()), 4)
        for i in np.unique(light[rows]):
            pairs[lightings[i]][name] = round(float(follows[light[rows] == i].mean()), 4)
    return out | columns | {"follows_by_pair": pairs, "depth_moves_m": moves}


def mean_color(image: NDArray, mask: NDArray[np.bool_]) -> Array:
    """Mean color (3,) of an image (h, w, 3) where the mask (h, w) is true, or of all of it if it is true nowhere."""
    return np.asarray(image[mask] if mask.any() else image.reshape(-1, 3), np.float64).mean(0)


def _rounded(color: Array) -> list[float]:
    return [round(float(value), 4) for value in color]


def _distance(a: Array, b: Array) -> Array:
    """Euclidean distances of colors, (n, 3) and (n, 3) or (3,) → (n,)."""
    return np.linalg.norm(a - b, axis=-1)
