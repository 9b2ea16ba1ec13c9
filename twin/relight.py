"""Verb: learn one more lighting of a built place from a single photo of it.

    python -m twin.relight scenes/demo photo.jpg --name afternoon

finds where the photo was taken (`capture/localize.py`), then the appearance embedding and the air under which the
frozen field looks most like it. The lighting goes to `<scene>/lightings/afternoon.json`, with a picture beside it: the
photo, the field under what was fitted, and under the most similar filmed one. From then on
`twin.load_scene(scene).field()` has it: `lighting="afternoon"`, `"sun:afternoon:0.5"`; environments lay its air over
their pictures.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin import cli
from twin.errors import InputError
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.images import psnr, resize, write_image
from twin.nerf.added_lightings import AddedLighting, check_name, field_result
from twin.nerf.fog import Fog
from twin.scene import SceneDir, finished

_CLEAR = Fog()
_MAX_WIDTH = 480  # [px] longer side of the picture fitted, as that of the frames trained on
_STEPS = 300
_RAYS = 10_000  # fitted at most, spread evenly
_LOOK_RAYS = 1000  # that tell which filmed frame is most like the photo
_HAZY = 0.2  # [dB] by which haze has to explain the other half better
_GAP = 4  # [px] between the pictures


@dataclass(frozen=True)
class Relit:
    """What a photo's lighting was fitted as."""

    nearest: str
    """The filmed lighting that looks most like the photo."""
    embedding: NDArray[np.float32]
    """Shape (dim,)."""
    air: Fog
    """Clear where haze does not explain the picture better."""
    pictures: tuple[NDArray, NDArray, NDArray]
    """Photo, field under the fitted lighting and air, field under the nearest; RGB in [0, 1], shapes (h, w, 3)."""
    psnr_nearest: float
    """[dB]"""
    psnr_fitted: float
    """[dB]"""
    psnr_other_half: float
    """[dB] of each half of the picture, left and right, under what was fitted to the other; mean over both."""
    psnr_clear_other_half: float
    """[dB] The same with the air taken for clear."""


def fit_photo(field, photo: NDArray, camera_to_world: NDArray, intrinsics: NDArray) -> Relit:
    """The lighting of a photo and its air, by optimisation with the field frozen.

    The air is taken for clear unless what is fitted to one half of the picture then explains the other half better by
    `_HAZY`.

    Args:
        field: A `RadianceField`.
        photo: RGB in [0, 1], shape (h, w, 3), of a pinhole camera.
        camera_to_world: OpenCV axes, shape (4, 4).
        intrinsics: fx, fy, cx, cy [px] at the photo's size, shape (4,).
    """
    import torch

    from twin.nerf.appearance_fit import fit_appearance
    from twin.nerf.buffers import CameraArrays, single_threaded_torch

    height, width = photo.shape[:2]
    v, u = np.mgrid[:height, :width] + 0.5
    cameras = CameraArrays(np.asarray(camera_to_world)[None], np.asarray(intrinsics)[None], field.where)
    pixel = np.stack([u.ravel(), v.ravel()], -1)
    features, harmonics, depth, _ = field.trace(cameras, np.zeros(len(pixel), int), pixel)
    rays = unproject(pixel_grid(width, height), np.asarray(intrinsics))
    distance = depth.cpu().numpy().reshape(height, width) * np.linalg.norm(rays, axis=-1).astype(np.float32)
    distances = torch.as_tensor(distance.ravel(), device=field.where)
    colours = torch.as_tensor(photo.reshape(-1, 3).astype(np.float32), device=field.where)

    def picture(embedding: NDArray, air: Fog = _CLEAR) -> NDArray:
        return air.over(field.colour(features, harmonics, embedding).reshape(photo.shape), distance)

    def fitted(use: NDArray, start: NDArray, hazy: bool) -> tuple[NDArray, Fog]:
        some = torch.as_tensor(use[:: max(1, len(use) // _RAYS)], device=field.where)
        seen = field, features[some], harmonics[some], colours[some]
        return fit_appearance(*seen, start, _STEPS, distances[some] if hazy else None)

    filmed = {name: picture(field.embedding(name)) for name in field.lightings}
    nearest = max(filmed, key=lambda name: psnr(filmed[name], photo))
    # A frame is a nearer start than its lighting, and what is fitted from there suits other views of the place better:
    # by up to 1.7 dB on the demo, and never worse by more than 0.2 dB.
    some = slice(None, None, max(1, height * width // _LOOK_RAYS))
    starts = [*field.appearance.named().vectors, *field.appearance.named().frame_vectors]
    looks = [field.colour(features[some], harmonics[some], one) for one in starts]
    start = starts[int(np.argmin([((look - photo.reshape(-1, 3)[some]) ** 2).mean() for look in looks]))]
    left = np.broadcast_to(np.arange(width) < width // 2, (height, width))
    with single_threaded_torch():
        clear, hazy = (
            float(np.mean([psnr(picture(*fitted(np.flatnonzero(h), start, air)), photo, ~h) for h in (left, ~left)]))
            for air in (False, True)
        )
        is_hazy = hazy > clear + _HAZY
        embedding, air = fitted(np.arange(height * width), start, is_hazy)
    shown = picture(embedding, air)
    return Relit(
        *(nearest, embedding, air, (photo, shown, filmed[nearest])),
        *(psnr(filmed[nearest], photo), psnr(shown, photo), hazy if is_hazy else clear, clear),
    )


def relight(root: Path, photo: Path, name: str) -> AddedLighting:
    """Adds the lighting of a photo to the scene at `root`, under a name, and returns it.

    Raises:
        InputError: no built scene, no usable photo, one that does not show the place, or an impossible name.
    """
    scene = SceneDir(root)
    if not scene.config_file.exists():
        raise InputError(f"no scene.toml in {root}; give the scene's folder, such as scenes/demo")
    result = field_result(scene)

    from twin.capture.camera_models import flattened
    from twin.capture.localize import register_photo
    from twin.capture.photos import load_photo
    from twin.geometry.cameras import Cameras
    from twin.nerf.field import RadianceField

    for stage in ("capture", "cameras", "metric"):
        finished(scene, stage)
    field = RadianceField.load(scene.stage("field"))
    check_name(name, field.lightings)
    image, facts = load_photo(photo, None)
    try:
        found = register_photo(image, facts, scene)
    except InputError as error:
        raise InputError(f"{photo}: {error}") from None
    position = found.camera_to_world[:3, 3]
    flat, lens = flattened(image, found.lens) if found.lens.is_distorted else (image, found.lens)
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
    gap = np.ones((lens.height, _GAP, 3), np.float32)
    a, b, c = relit.pictures
    write_image(scene.lightings / f"{name}.png", np.hstack([a, gap, b, gap, c]))
    lighting = AddedLighting(name, [float(x) for x in relit.embedding], relit.air, result, str(photo), figures)
    lighting.save(scene)
    return lighting


def summary(lighting: AddedLighting) -> str:
    """The lines printed at the end."""
    f, air = lighting.figures, lighting.air
    clear = f"in clear air those halves have {f['psnr_clear_other_half']:.1f} dB"
    x, y, z = np.array(f["camera_to_world"])[:3, 3]
    return (
        f"registered with {f['inliers']} inliers of {f['matches']} matches at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
        f"{f['from_path_m']:.2f} m from the nearest frame; {f['reprojection_error_px']:.2f} px; "
        f"focal length {f['focal_px']:.0f} px ({f['focal_from']})\n"
        f"{lighting.name}: {f['psnr_nearest']:.1f} dB under the nearest filmed lighting ({f['nearest']}), "
        f"{f['psnr_fitted']:.1f} dB fitted; each half of the picture by the other's fit {f['psnr_other_half']:.1f} dB\n"
        + (f"visibility {3.0 / air.extinction:.0f} m; {clear}" if air.extinction else "the air is clear")
    )


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    parser = cli.Parser(
        prog="python -m twin.relight",
        description="Learn one more lighting of a built place from a single photo of it: find where it was taken, then "
        "fit the field's appearance and the air to it. What it looks like this afternoon, the twin then looks like, "
        "everywhere.",
    )
    parser.add_argument("scene", type=Path, help="folder of a built scene")
    parser.add_argument("photo", type=Path, help="an image file that shows the place, from near the filmed path")
    parser.add_argument("--name", required=True, help="what the lighting is to be called; an added one is replaced")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    return cli.run(parser, _main, arguments)


def _main(options: argparse.Namespace) -> None:
    lighting = relight(options.scene, options.photo, options.name)
    if not options.quiet:
        print(summary(lighting))
        print(f"look at {SceneDir(options.scene).lightings / f'{options.name}.png'}")


if __name__ == "__main__":
    sys.exit(main())
