"""`twin relight`: adds a lighting to a built scene from a single photo.

    python -m twin.relight scenes/demo photo.jpg --name afternoon

This localizes the photo, then fits an appearance embedding and fog so that renderings of the frozen field match the
photo. The lighting is saved as `<scene>/lightings/afternoon.json`, with an image beside it that shows the photo, the
field under the fitted lighting, and the field under the most similar filmed lighting. Afterwards,
`twin.load_scene(scene).field()` has the lighting as `lighting="afternoon"` or in mixtures such as
`"sun:afternoon:0.5"`; environments apply its fog to their images.
"""

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin import commands
from twin.errors import InputError
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.images import psnr, resize, write_image
from twin.nerf.fog import Fog
from twin.nerf.lightings import AddedLighting, check_name
from twin.scene import SceneDir, require_stage, stage_result

_CLEAR = Fog()
_MAX_WIDTH = 480  # [px] longer side of the fitted image, as for training frames
_STEPS = 300
_RAYS = 10_000  # the fit uses about this many rays, evenly spaced over the image
_START_RAYS = 1000  # number of rays by which the most similar filmed frame is chosen
_FOG_GAIN = 0.2  # [dB] by which fog must improve the half of the image that is not fitted
_GAP = 4  # [px] between the images
_LABEL_SIZE = 13  # [px] text size in the images; usual labels fit into an upright photo 270 px wide


@dataclass(frozen=True)
class PhotoFit:
    """The lighting fitted to a photo, and its scores."""

    nearest: str
    """The filmed lighting most similar to the photo."""
    embedding: NDArray[np.float32]
    """Appearance embedding, shape (dim,)."""
    fog: Fog
    """The fitted fog, or none if fog does not improve the fit."""
    images: tuple[NDArray, NDArray, NDArray]
    """Photo, field under the fitted lighting and fog, field under `nearest`; RGB in [0, 1], shapes (h, w, 3)."""
    psnr_nearest: float
    """PSNR of the field under `nearest` [dB]."""
    psnr_fitted: float
    """PSNR of the field under the fitted lighting and fog [dB]."""
    psnr_other_half: float
    """Mean PSNR of the left and right half of the image, each under the lighting fitted to the other half [dB]."""
    psnr_clear_other_half: float
    """The same mean for fits without fog [dB]."""


def fit_photo(field, photo: NDArray, camera_to_world: NDArray, intrinsics: NDArray) -> PhotoFit:
    """Fits the appearance embedding and fog of a photo with the field frozen.

    Fog is kept only if, in fits to one half of the image, it improves the other half by `_FOG_GAIN`.

    Args:
        field: A `RadianceField`.
        photo: RGB in [0, 1], shape (h, w, 3), of a pinhole camera.
        camera_to_world: OpenCV axes, shape (4, 4).
        intrinsics: fx, fy, cx, cy [px] at the photo's size, shape (4,).
    """
    import torch

    from twin.nerf.appearance import fit_appearance
    from twin.nerf.buffers import CameraArrays, single_threaded_torch

    height, width = photo.shape[:2]
    v, u = np.mgrid[:height, :width] + 0.5
    cameras = CameraArrays(np.asarray(camera_to_world)[None], np.asarray(intrinsics)[None], field.device)
    pixel = np.stack([u.ravel(), v.ravel()], -1)
    features, harmonics, depth, _ = field.trace(cameras, np.zeros(len(pixel), int), pixel)
    rays = unproject(pixel_grid(width, height), np.asarray(intrinsics))
    distance = depth.cpu().numpy().reshape(height, width) * np.linalg.norm(rays, axis=-1).astype(np.float32)
    distances = torch.as_tensor(distance.ravel(), device=field.device)
    colors = torch.as_tensor(photo.reshape(-1, 3).astype(np.float32), device=field.device)

    def render(embedding: NDArray, fog: Fog = _CLEAR) -> NDArray:
        return fog.apply(field.color(features, harmonics, embedding).reshape(photo.shape), distance)

    def fit(pixels: NDArray, start: NDArray, with_fog: bool) -> tuple[NDArray, Fog]:
        some = torch.as_tensor(pixels[:: max(1, len(pixels) // _RAYS)], device=field.device)
        rays = field.parameters, features[some], harmonics[some], colors[some]
        return fit_appearance(*rays, start, _STEPS, distances[some] if with_fog else None)

    filmed = {name: render(field.embedding(name)) for name in field.lightings}
    nearest = max(filmed, key=lambda name: psnr(filmed[name], photo))
    # The fit starts from the most similar embedding of a frame or a lighting. On the demo, compared with a start from
    # embeddings of lightings alone, other views of the place gain up to 1.7 dB and lose at most 0.2 dB.
    some = slice(None, None, max(1, height * width // _START_RAYS))
    starts = [*field.appearance.named().vectors, *field.appearance.named().frame_vectors]
    renders = [field.color(features[some], harmonics[some], one) for one in starts]
    start = starts[int(np.argmin([((one - photo.reshape(-1, 3)[some]) ** 2).mean() for one in renders]))]
    left = np.broadcast_to(np.arange(width) < width // 2, (height, width))
    with single_threaded_torch():
        clear, foggy = (
            float(np.mean([psnr(render(*fit(np.flatnonzero(h), start, with_fog)), photo, ~h) for h in (left, ~left)]))
            for with_fog in (False, True)
        )
        is_foggy = foggy > clear + _FOG_GAIN
        embedding, fog = fit(np.arange(height * width), start, is_foggy)
    fitted = render(embedding, fog)
    return PhotoFit(
        *(nearest, embedding, fog, (photo, fitted, filmed[nearest])),
        *(psnr(filmed[nearest], photo), psnr(fitted, photo), foggy if is_foggy else clear, clear),
    )


def comparison(name: str, relit: PhotoFit) -> NDArray[np.uint8]:
    """Labelled image of a fit: photo, fitted lighting and nearest filmed lighting side by side."""
    from twin.report.video_layout import draw_label

    height, width = relit.images[0].shape[:2]
    gap = np.ones((height, _GAP, 3), np.float32)
    photo, fitted, nearest = relit.images
    row = np.hstack([photo, gap, fitted, gap, nearest])
    out = (np.clip(row, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    labels = (
        "photo",
        f"fitted: {name}, {relit.psnr_fitted:.1f} dB",
        f"nearest filmed: {relit.nearest}, {relit.psnr_nearest:.1f} dB",
    )
    for k, label in enumerate(labels):
        draw_label(out, label, (k * (width + _GAP), 0, width, height), size=_LABEL_SIZE)
    return out


def relight(root: Path, photo: Path, name: str) -> AddedLighting:
    """Adds the lighting of a photo to a scene under a name, and returns it.

    Raises:
        InputError: the scene is not built, the photo is unusable or cannot be localized, or the name is invalid.
    """
    scene = SceneDir(root)
    if not scene.config_file.exists():
        raise InputError(f"no scene.toml in {root}; give the scene's folder, such as scenes/demo")
    result = stage_result(scene, "field")

    from twin.capture.camera_models import undistorted
    from twin.capture.localize import register_photo
    from twin.capture.photos import load_photo
    from twin.geometry.cameras import Cameras
    from twin.nerf.field import RadianceField

    for stage in ("capture", "cameras", "metric"):
        require_stage(scene, stage)
    field = RadianceField.load(scene.stage("field"))
    check_name(name, field.lightings)
    image, facts = load_photo(photo, None)
    try:
        found = register_photo(image, facts, scene)
    except InputError as error:
        raise InputError(f"{photo}: {error}") from None
    position = found.camera_to_world[:3, 3]
    flat, lens = undistorted(image, found.lens) if found.lens.is_distorted else (image, found.lens)
    scale = min(1.0, _MAX_WIDTH / max(lens.width, lens.height))
    lens = lens.scaled(round(lens.width * scale), round(lens.height * scale))
    small = np.asarray(resize(flat, lens.width, lens.height), np.float32) / 255.0
    relit = fit_photo(field, small, found.camera_to_world, lens.intrinsics)
    away = float(np.linalg.norm(Cameras.load(scene.stage("metric")).positions - position, axis=1).min())
    figures = {
        "inliers": found.inliers,
        "matches": found.matches,
        "reprojection_error_px": round(found.error, 3),
        "camera_to_world": found.camera_to_world.tolist(),
        "from_path_m": round(away, 3),
        "focal_px": round(float(found.lens.intrinsics[0]), 2),
        "focal_from": found.lens_from,
        "nearest": relit.nearest,
        "psnr_nearest": round(relit.psnr_nearest, 3),
        "psnr_fitted": round(relit.psnr_fitted, 3),
        "psnr_other_half": round(relit.psnr_other_half, 3),
        "psnr_clear_other_half": round(relit.psnr_clear_other_half, 3),
    }
    write_image(scene.lightings / f"{name}.png", comparison(name, relit))
    lighting = AddedLighting(name, [float(x) for x in relit.embedding], relit.fog, result, str(photo), figures)
    lighting.save(scene)
    return lighting


def summary(lighting: AddedLighting) -> str:
    f, fog = lighting.figures, lighting.air
    clear = f"without fog those halves have {f['psnr_clear_other_half']:.1f} dB"
    x, y, z = np.array(f["camera_to_world"])[:3, 3]
    return (
        f"registered with {f['inliers']} inliers of {f['matches']} matches at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
        f"{f['from_path_m']:.2f} m from the nearest frame; {f['reprojection_error_px']:.2f} px; "
        f"focal length {f['focal_px']:.0f} px ({f['focal_from']})\n"
        f"{lighting.name}: {f['psnr_nearest']:.1f} dB under the nearest filmed lighting ({f['nearest']}), "
        f"{f['psnr_fitted']:.1f} dB fitted; each half of the image by the other's fit {f['psnr_other_half']:.1f} dB\n"
        + (f"visibility {3.0 / fog.extinction:.0f} m; {clear}" if fog.extinction else "no fog")
    )


def command(options: argparse.Namespace) -> None:
    """Runs the verb with the options parsed by `twin.commands`."""
    lighting = relight(options.scene, options.photo, options.name)
    if not options.quiet:
        print(summary(lighting))
        print(f"look at {SceneDir(options.scene).lightings / f'{options.name}.png'}")


main = partial(commands.main, "relight")

if __name__ == "__main__":
    sys.exit(main())
