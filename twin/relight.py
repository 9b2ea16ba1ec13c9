"""`twin relight`: adds a lighting to a built scene from a single photo.

    twin relight scenes/demo photo.jpg --name afternoon
    twin relight scenes/demo photo.jpg --name afternoon --time 2026-06-01T17:30+02:00 --location 48.14,11.58

This localizes the photo, then fits an appearance embedding and fog so that renderings of the frozen radiance field
match the photo. The lighting is saved as `<scene>/lightings/afternoon.json`, with an image beside it (`comparison`). It
may have a sun, whose direction is given, computed from time and place, or searched in the photo (`nerf/sun_fit.py`).
"""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from twin import commands, runtime
from twin.assets.ground import Ground, lattice_faces
from twin.assets.tsdf import compact
from twin.assets.views import Views, render_views
from twin.errors import InputError
from twin.files import load_arrays, require_writable
from twin.geometry.cameras import Cameras, RenderableField, pixel_grid, unproject
from twin.geometry.images import psnr, resize, to_uint8, write_image
from twin.geometry.shadow_map import ShadowCasters, angles, direction
from twin.nerf.lightings import AddedLighting, Fog, check_new_name
from twin.nerf.sun import Sun, heading_from_gps, parse_time, sun_direction
from twin.scene import SceneDir, require_stage, stage_result
from twin.types import Array

if TYPE_CHECKING:
    from twin.nerf.sun_fit import AirFit, TracedPhoto

_CLEAR = Fog()
_MAX_WIDTH = 480  # [px] longer side of the fitted image, as for training frames
_STEPS = 300
_RAYS = 10_000  # the fit uses about this many rays, evenly spaced over the image
_START_RAYS = 1000  # number of rays used to choose the most similar filmed frame
_FOG_GAIN = 0.2  # [dB] least gain in the half of the image that is not fitted, for fog to be kept
_SUN_GAIN = 0.3  # [dB] the same for a sun found in the photo
SEARCH = "search"
"""Value of the option `--sun` that searches the direction of the sun in the photo."""
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
    """The fitted fog; without effect if fog does not improve the fit."""
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
    traced: "TracedPhoto | None" = None
    """The photo with the field's depth and features at its pixels."""
    fits: tuple["AirFit", ...] = ()
    """The fits to the left half, to the right half and to the whole photo."""
    sun: Sun | None = None
    """The fitted sun; None if no sun is wanted, or the sun does not improve the fit."""
    sun_from: str = ""
    """Origin of the sun's direction, or the reason why there is no sun."""
    psnr_no_sun_other_half: float | None = None
    """`psnr_other_half` for fits without a sun [dB]; None if there is no sun."""
    sun_disagreement: float = 0.0
    """Angle between the suns found in the two halves of the photo [°]."""


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
    from twin.nerf.sun_fit import AirFit, TracedPhoto

    height, width = photo.shape[:2]
    pose, grid = np.asarray(camera_to_world), pixel_grid(width, height)
    cameras = CameraArrays(pose[None], np.asarray(intrinsics)[None], field.device)
    features, harmonics, z, _ = field.trace(cameras, np.zeros(height * width, int), grid.reshape(-1, 2))
    depth, rays = z.cpu().numpy().reshape(height, width), unproject(grid, np.asarray(intrinsics))
    traced = TracedPhoto(photo.astype(np.float32), depth, rays, pose, features, harmonics)
    distance = traced.distance
    distances = torch.as_tensor(distance.ravel(), device=field.device)
    colors = torch.as_tensor(photo.reshape(-1, 3).astype(np.float32), device=field.device)

    def render(embedding: NDArray, fog: Fog = _CLEAR) -> NDArray:
        return fog.apply(field.color(features, harmonics, embedding).reshape(photo.shape), distance)

    progress = runtime.bar("lighting", 5, "fit")

    def fit(pixels: NDArray, start: NDArray, with_fog: bool) -> tuple[NDArray, Fog]:
        some = torch.as_tensor(pixels[:: max(1, len(pixels) // _RAYS)], device=field.device)
        rays = field.parameters, features[some], harmonics[some], colors[some]
        found = fit_appearance(*rays, start, _STEPS, distances[some] if with_fog else None)
        progress.update()
        return found

    filmed = {name: render(field.embedding(name)) for name in field.lightings}
    nearest = max(filmed, key=lambda name: psnr(filmed[name], photo))
    # The fit starts from the most similar embedding of a frame or a lighting. On the demo, compared with a start from
    # embeddings of lightings alone, other views of the place gain up to 1.7 dB and lose at most 0.2 dB.
    some = slice(None, None, max(1, height * width // _START_RAYS))
    starts = [*field.appearance.named().vectors, *field.appearance.named().frame_vectors]
    renders = [field.color(features[some], harmonics[some], one) for one in starts]
    start = starts[int(np.argmin([((one - photo.reshape(-1, 3)[some]) ** 2).mean() for one in renders]))]
    left = np.broadcast_to(np.arange(width) < width // 2, (height, width))
    masks = (left, ~left)
    with single_threaded_torch(), progress:
        halves = [[fit(np.flatnonzero(h), start, with_fog) for h in masks] for with_fog in (False, True)]
        clear, foggy = (
            float(np.mean([psnr(render(*one), photo, ~h) for one, h in zip(fits, masks, strict=True)]))
            for fits in halves
        )
        is_foggy = foggy > clear + _FOG_GAIN
        embedding, fog = fit(np.arange(height * width), start, is_foggy)
    fitted = render(embedding, fog)
    every = np.ones((height, width), bool)
    whole = zip((*masks, every), (*halves[is_foggy], (embedding, fog)), strict=True)
    return PhotoFit(
        *(nearest, embedding, fog, (photo, fitted, filmed[nearest])),
        *(psnr(filmed[nearest], photo), psnr(fitted, photo), foggy if is_foggy else clear, clear),
        traced,
        tuple(AirFit(np.flatnonzero(h), *one) for h, one in whole),
    )


@dataclass(frozen=True)
class SunSource:
    """Direction of a photo's sun."""

    toward: Array | None
    """Unit vector towards the sun in the scene, shape (3,); None: it is searched in the photo."""
    origin: str
    """Source of the direction."""


def with_sun(field, relit: PhotoFit, casters: ShadowCasters, source: SunSource) -> PhotoFit:
    """Adds a sun to a fit if that improves the half of the photo that is not fitted.

    A sun that is found in the photo must improve that half by `_SUN_GAIN`. If no sun is added, `sun_from` of the result
    has the reason.
    """
    from twin.nerf.buffers import single_threaded_torch
    from twin.nerf.sun_fit import fit_sun

    assert relit.traced is not None
    left, right, whole = relit.fits
    with single_threaded_torch():
        lit = fit_sun(field, relit.traced, (left, right), whole, casters, source.toward)
    needed = relit.psnr_other_half + (_SUN_GAIN if source.toward is None else 0.0)
    if not lit.psnr_other_half > needed:
        seen = f"{lit.psnr_other_half:.1f} dB with it" + ("" if source.toward is None else f" ({source.origin})")
        because = f"a sun does not explain the photo better: {seen}"
        return replace(relit, sun_from=because, sun_disagreement=lit.disagreement)
    photo, _, nearest = relit.images
    return replace(
        relit,
        embedding=lit.embedding,
        fog=lit.fog,
        images=(photo, lit.picture, nearest),
        psnr_fitted=psnr(lit.picture, photo),
        psnr_other_half=lit.psnr_other_half,
        sun=lit.sun,
        sun_from=source.origin,
        psnr_no_sun_other_half=relit.psnr_other_half,
        sun_disagreement=lit.disagreement,
    )


def find_sun(
    scene: SceneDir, sun: str | None, time: str | None, location: str | None, heading: float | None
) -> SunSource | None:
    """Direction of the sun from the options of the command; None: no sun is wanted.

    Raises:
        InputError: an option is malformed, options contradict each other, or location or heading are missing and the
            scene has no GPS positions.
    """
    if sun is not None and time is not None:
        raise InputError(f"--sun {sun} with --time {time}: expected one of them")
    if time is None and (location is not None or heading is not None):
        raise InputError("--location and --heading need a time, such as --time 2026-06-01T17:30+02:00")
    if sun == SEARCH:
        return SunSource(None, "found in the photo")
    if sun is not None:
        azimuth, elevation = _two_numbers(
            "--sun", sun, f"azimuth and elevation in degrees, such as 120,35, or {SEARCH}"
        )
        if not 0.0 < elevation <= 90.0 or abs(azimuth) > 360.0:
            raise InputError(f"--sun {sun}: expected an azimuth within ±360 and an elevation above 0, up to 90 degrees")
        return SunSource(direction(azimuth, elevation), "given")
    if time is None:
        return None
    moment = parse_time(time)
    if heading is not None and not np.isfinite(heading):
        raise InputError(f"--heading {heading}: expected the compass angle of the scene's x axis in degrees")
    from twin.capture.capture_data import Capture, nearest_longitudes
    from twin.capture.scale import local_east_north_up

    capture = Capture.load(require_stage(scene, "capture"))
    known = np.isfinite(capture.gps[:, :2]).all(1)
    if location is not None:
        place = _two_numbers("--location", location, "latitude and longitude in degrees, such as 48.14,11.58")
    elif known.any():
        latitude, longitude = capture.gps[known, :2].T
        middle = np.median(nearest_longitudes(longitude, float(longitude[0])), keepdims=True)
        place = float(np.median(latitude)), float(nearest_longitudes(middle)[0])
    else:
        raise InputError("--time needs --location LAT,LON, since no frame of the scene has a GPS position")
    if heading is None:
        cameras = Cameras.load(require_stage(scene, "metric"))
        row = {name: i for i, name in enumerate(capture.names)}
        gps = capture.gps[[row[name] for name in cameras.names]]
        east_north = np.full((len(gps), 2), np.nan)
        rows = np.flatnonzero(np.isfinite(gps[:, :2]).all(1))
        if len(rows):
            east_north[rows] = local_east_north_up(np.where(np.isfinite(gps[rows]), gps[rows], 0.0))[:, :2]
        heading = heading_from_gps(cameras.positions[:, :2], east_north)
        if heading is None:
            raise InputError(
                "--time needs --heading DEG, the compass angle of the scene's x axis: the scene's GPS positions do not "
                "give it"
            )
    return SunSource(sun_direction(moment, *place, heading), f"time and place, x axis at {heading % 360.0:.0f}°")


def _two_numbers(option: str, text: str, expected: str) -> tuple[float, float]:
    try:
        first, second = map(float, text.split(","))
        if not np.isfinite([first, second]).all():
            raise ValueError
    except ValueError:
        raise InputError(f"{option} {text}: expected {expected}") from None
    return first, second


def comparison(name: str, relit: PhotoFit) -> NDArray[np.uint8]:
    """Labeled image of a fit: photo, fitted lighting and nearest filmed lighting side by side."""
    from twin.report.video_layout import draw_label

    height, width = relit.images[0].shape[:2]
    gap = np.ones((height, _GAP, 3), np.float32)
    photo, fitted, nearest = relit.images
    row = np.hstack([photo, gap, fitted, gap, nearest])
    out = to_uint8(row)
    labels = (
        "photo",
        f"fitted{' with sun' if relit.sun else ''}: {name}, {relit.psnr_fitted:.1f} dB",
        f"nearest filmed: {relit.nearest}, {relit.psnr_nearest:.1f} dB",
    )
    for k, label in enumerate(labels):
        draw_label(out, label, (k * (width + _GAP), 0, width, height), size=_LABEL_SIZE)
    return out


def relight(
    root: Path,
    photo: Path,
    name: str,
    sun: str | None = None,
    time: str | None = None,
    location: str | None = None,
    heading: float | None = None,
) -> AddedLighting:
    """Adds the lighting of a photo to a scene under a name, and returns it.

    Args:
        root: The scene.
        photo: The image file.
        name: Name of the lighting.
        sun: Azimuth, counterclockwise from the scene's x axis, and elevation of the sun [°], as `120,35`; `search`:
            the sun is searched in the photo. By default, there is no sun unless `time` is given.
        time: When the photo was taken, with the offset from UTC, as `2026-06-01T17:30+02:00`.
        location: Latitude and longitude [°], as `48.14,11.58`; by default from the GPS positions of the frames.
        heading: Compass angle of the scene's x axis [°]; by default from the GPS positions of the frames.

    Raises:
        InputError: the scene is not built, the photo is unusable or cannot be localized, or the name or an option is
            invalid.
    """
    scene = SceneDir(root)
    if not scene.config_file.exists():
        raise InputError(f"no scene.toml in {root}; give the scene's folder, such as scenes/demo")
    result = stage_result(scene, "field")

    from twin.capture.camera_models import undistorted
    from twin.capture.localize import register_photo
    from twin.capture.photos import load_photo
    from twin.nerf.baked import BakedField
    from twin.nerf.field import RadianceField

    for stage in ("capture", "cameras", "metric", "field"):
        require_stage(scene, stage)
    field = RadianceField.load(scene.stage("field"))
    check_new_name(name, field.lightings)
    source = find_sun(scene, sun, time, location, heading)
    if source:
        require_stage(scene, "mesh")  # checked first, since reading the baked field takes time
    require_writable(scene.lightings, "make it writable: the lighting is saved there")
    image, facts = load_photo(photo, None)
    # Before the photo is fitted, which takes a minute and would be lost if the build is damaged.
    casters = shadow_casters(scene, BakedField.load(scene.stage("field"))) if source else None
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
    if source and casters:
        relit = with_sun(field, relit, casters, source)
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
        **({"sun_from": relit.sun_from} if relit.sun_from else {}),
    }
    if relit.sun and relit.psnr_no_sun_other_half is not None:
        azimuth, elevation = angles(relit.sun.toward)
        figures |= {"sun_azimuth_deg": round(azimuth, 2), "sun_elevation_deg": round(elevation, 2)}
        figures["psnr_no_sun_other_half"] = round(relit.psnr_no_sun_other_half, 3)
    write_image(scene.lightings / f"{name}.png", comparison(name, relit))
    lighting = AddedLighting(
        name, [float(x) for x in relit.embedding], relit.fog, result, str(photo), figures, relit.sun
    )
    lighting.save(scene)
    return lighting


def summary(lighting: AddedLighting) -> str:
    f, fog = lighting.figures, lighting.air
    neither = " and sun" if lighting.sun else ""
    clear = f"{f['psnr_clear_other_half']:.1f} dB on the other half without fog{neither}"
    x, y, z = np.array(f["camera_to_world"])[:3, 3]
    return (
        f"registered with {f['inliers']} inliers of {f['matches']} matches at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
        f"{f['from_path_m']:.2f} m from the nearest frame; reprojection error {f['reprojection_error_px']:.2f} px; "
        f"focal length {f['focal_px']:.0f} px ({f['focal_from']})\n"
        f"{lighting.name}: {f['psnr_nearest']:.1f} dB under the nearest filmed lighting ({f['nearest']}), "
        f"{f['psnr_fitted']:.1f} dB fitted; {f['psnr_other_half']:.1f} dB on the other half (fitted to one half of the "
        "image)\n"
        + (f"visibility {3.0 / fog.extinction:.0f} m; {clear}" if fog.extinction else "no fog")
        + _sun_line(f)
    )


def _sun_line(figures: dict) -> str:
    """The line of the summary about the sun."""
    if "sun_azimuth_deg" in figures:
        return (
            f"\nsun at azimuth {figures['sun_azimuth_deg']:.0f}° (counterclockwise from the x axis), elevation "
            f"{figures['sun_elevation_deg']:.0f}°, {figures['sun_from']}; "
            f"{figures['psnr_no_sun_other_half']:.1f} dB on the other half without a sun"
        )
    return f"\nno sun: {figures['sun_from']}" if "sun_from" in figures else ""


def command(options: argparse.Namespace) -> None:
    """Runs `twin relight` with the options parsed by `twin.commands`."""
    given = (options.sun, options.time, options.location, options.heading)
    lighting = relight(options.scene, options.photo, options.name, *given)
    if not options.quiet:
        print(summary(lighting))
        print(f"look at {SceneDir(options.scene).lightings / f'{options.name}.png'}")


# ---- surfaces that cast shadows
#
# The mesh ends 2 m above `mesh.max_height` and at `mesh.margin` beside the route, but houses and trees beyond it cast
# shadows, too. So the depth of the field at filmed poses is turned into triangles, which connect neighboring pixels of
# about the same depth. They are less accurate than the mesh, hence *rough*.

_VIEWS, _WIDTH = 40, 96  # number of rendered poses, and their width [px]
_REACH = 45.0  # [m] greatest depth
_MAX_DEPTH_RATIO = 1.15  # largest ratio of a triangle's depths; beyond it, the triangle would connect two surfaces
_LEAST_HEIGHT = 1.0  # [m] lowest height above the ground outside the mesh's box
_OVERLAP = 0.5  # [m] overlap of the triangles with the mesh's box, at its top and its sides


def shadow_casters(scene: SceneDir, field: RenderableField) -> ShadowCasters:
    """Surfaces that cast shadows: the visual mesh and, above and around it, triangles from rendered depth.

    Raises InputError if its mesh is damaged or was not built."""
    stage = require_stage(scene, "mesh")
    data = load_arrays(stage / "visual.npz")
    vertices, faces = data["vertices"].astype(np.float64), data["faces"].astype(np.int64)
    views = render_views(field, Cameras.load(scene.stage("metric")), _VIEWS, _WIDTH, _REACH)
    return ShadowCasters(vertices, faces, *rough_triangles(views, Ground.load(stage), vertices))


def rough_triangles(views: Views, ground: Ground, mesh_vertices: Array) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (v, 3) [m] and faces (f, 3) of the surfaces in views that lie above or outside the mesh's box."""
    top = float((mesh_vertices[:, 2] - ground.at(mesh_vertices[:, :2])).max(initial=0.0)) - _OVERLAP
    low, high = mesh_vertices[:, :2].min(0) + _OVERLAP, mesh_vertices[:, :2].max(0) - _OVERLAP
    all_vertices, all_faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for i in range(len(views)):
        depth, points = views.depth[i], views.points(i)
        faces = lattice_faces(*depth.shape)
        corners = depth.ravel()[faces]
        faces = faces[
            (corners.min(1) > 0.0)
            & (corners.max(1) < _REACH)
            & (corners.max(1) < _MAX_DEPTH_RATIO * np.maximum(corners.min(1), 1e-3))
        ]
        middle = points.reshape(-1, 3)[faces].mean(1)
        height = middle[:, 2] - ground.at(middle[:, :2])
        inside = ((middle[:, :2] > low) & (middle[:, :2] < high)).all(1)
        faces = faces[height > np.where(inside, top, _LEAST_HEIGHT)]
        vertices, faces = compact(points.reshape(-1, 3), faces)
        all_vertices.append(vertices)
        all_faces.append(faces + count)
        count += len(vertices)
    return np.concatenate(all_vertices), np.concatenate(all_faces)


if __name__ == "__main__":
    sys.exit(commands.main("relight"))
