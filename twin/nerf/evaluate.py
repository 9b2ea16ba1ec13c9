"""Honest figures on frames the field never saw.

A held-out frame starts from the embedding of its lighting. Its own residual (exposure, say) is fitted on one half of
the picture, left or right, and scored on the other; both ways, and the mean counts. Nothing else is fitted.
*Unfitted* scores use the lighting's embedding as it is; *wrong* scores use that of the other lightings, unfitted.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from twin.geometry.cameras import Cameras
from twin.geometry.images import psnr, ssim
from twin.nerf.baked import BakedField
from twin.nerf.compute import single_threaded_torch
from twin.nerf.dataset import load_frame
from twin.nerf.field import RadianceField
from twin.nerf.fit_light import fit_light
from twin.nerf.workspace import CameraArrays
from twin.progress import track

_FIT_RAYS = 4000  # of a half picture, spread evenly
_MAX_FRAMES = 6  # held-out frames scored per lighting, spread evenly


def score_frame(
    field: RadianceField, cameras: Cameras, i: int, max_width: int, baked: BakedField | None = None
) -> dict[str, float]:
    """PSNR [dB] and SSIM of one held-out frame: `psnr`, `ssim`, `unfitted`, `wrong` (nan with one lighting), and
    `baked`, which is as `unfitted` (nan without a baked field)."""
    bytes_, mask, intrinsics = load_frame(cameras, i, max_width)
    image = bytes_.astype(np.float32) / 255.0
    height, width = mask.shape
    v, u = np.mgrid[:height, :width] + 0.5
    arrays = CameraArrays(cameras.camera_to_world[i : i + 1], intrinsics[None], field.where)
    pixel = np.stack([u.ravel(), v.ravel()], -1)
    features, harmonics, _, _ = field.trace(arrays, np.zeros(len(pixel), int), pixel)
    colours = torch.as_tensor(image.reshape(-1, 3), device=field.where)
    start = field.embedding(cameras.lightings[i])

    def picture(embedding: NDArray[np.float32]) -> NDArray[np.float32]:
        return field.colour(features, harmonics, embedding).reshape(height, width, 3)

    left = np.zeros((height, width), bool)
    left[:, : width // 2] = True
    psnrs, ssims = [], []
    for half in (left, ~left):
        fit_on, score_on = np.flatnonzero(half & mask), ~half & mask
        if not len(fit_on) or not score_on.any():
            continue
        some = torch.as_tensor(fit_on[:: max(1, len(fit_on) // _FIT_RAYS)], device=field.where)
        shown = picture(fit_light(field, features[some], harmonics[some], colours[some], start)[0])
        psnrs.append(psnr(shown, image, score_on))
        # Masked pixels are made equal: they neither help nor harm beyond their windows.
        shown[~mask] = image[~mask]
        side = slice(width // 2, None) if half is left else slice(None, width // 2)
        ssims.append(ssim(shown[:, side], image[:, side]))
    others = [name for name in field.lightings if name != cameras.lightings[i]]
    wrong = [psnr(picture(field.embedding(name)), image, mask) for name in others]
    again = float("nan")
    if baked is not None:
        again = psnr(baked.render(cameras.select(np.array([i])), start, (width, height)).rgb[0], image, mask)
    return {
        "baked": again,
        "psnr": float(np.mean(psnrs)) if psnrs else float("nan"),
        "ssim": float(np.mean(ssims)) if ssims else float("nan"),
        "unfitted": psnr(picture(start), image, mask),
        "wrong": float(np.mean(wrong)) if wrong else float("nan"),
    }


def evaluate(
    field: RadianceField,
    cameras: Cameras,
    max_width: int,
    max_frames: int = _MAX_FRAMES,
    baked: BakedField | None = None,
) -> dict[str, Any]:
    """Held-out scores by lighting: `psnr` [dB], `ssim`, `n`, `psnr_unfitted`, `psnr_baked` (unfitted, too; of the baked
    field where there is one) and `psnr_wrong_lighting` (None where there is no other lighting). Lightings without
    held-out frames have n = 0 and are left out of the rest."""
    columns = {"psnr": "psnr", "ssim": "ssim", "psnr_unfitted": "unfitted"}
    if baked is not None:
        columns["psnr_baked"] = "baked"
    result: dict[str, Any] = {key: {} for key in (*columns, "n", "psnr_wrong_lighting")}
    frames = []
    for name in field.lightings:
        mine = [i for i in np.flatnonzero(cameras.held_out) if cameras.lightings[i] == name]
        if len(mine) > max_frames:
            mine = [mine[k] for k in np.linspace(0, len(mine) - 1, max_frames).round().astype(int)]
        frames += [(name, int(i)) for i in mine]
    scores: dict[str, list[dict[str, float]]] = {name: [] for name in field.lightings}
    with single_threaded_torch():
        for name, i in track(frames, "held-out frames", unit="frame"):
            scores[name].append(score_frame(field, cameras, i, max_width, baked))
    for name, rows in scores.items():
        result["n"][name] = len(rows)
        for key, column in columns.items():
            values = [row[column] for row in rows if np.isfinite(row[column])]
            if values:
                result[key][name] = round(float(np.mean(values)), 4)
        wrong = [row["wrong"] for row in rows if np.isfinite(row["wrong"])]
        if rows:
            result["psnr_wrong_lighting"][name] = round(float(np.mean(wrong)), 4) if wrong else None
    return result
