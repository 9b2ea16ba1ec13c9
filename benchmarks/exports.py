"""Benchmark of exported files against the film: PSNR of their ray-cast images at held-out frames.

    python benchmarks/exports.py --scene scenes/demo --only mesh      # the .glb's texture, against colors per vertex
    python benchmarks/exports.py --scene scenes/demo --only splats    # the .ply in MuJoCo Warp's splat renderer

`mesh` scores only pixels that show the mesh. The textured mesh and the one with colors per vertex have the same
geometry, and thus cover the same pixels. The texture is read back from the exported file. Exposure and white balance
of the filmed frames vary, so pictures are also scored after a factor per color channel was fitted on the left half of
a frame; then only the right half is scored.
"""

# mypy: disable-error-code="index, attr-defined"

import argparse
import io
import time
from unittest import mock

import mujoco
import numpy as np
import trimesh

from twin.assets import gaussians
from twin.assets.gaussians import FAR, VIEWS, WIDTH, gaussians_by_lighting, views_by_lighting
from twin.assets.views import Views, render_views
from twin.env.mujoco_renderer import RayCaster, mujoco_rays
from twin.export import gltf
from twin.files import load_arrays
from twin.geometry.cameras import opencv_to_mujoco, pixel_grid, scaled_intrinsics, unproject
from twin.geometry.images import psnr, read_image, resize
from twin.loading import Twin, load_scene
from twin.scene import require_stage
from twin.warp_runtime import wp


@wp.kernel
def _hit(
    mesh: wp.uint64, eye: wp.vec3, rays: wp.array[wp.vec3], face: wp.array[int], u: wp.array[float], v: wp.array[float]
):
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, eye, rays[i], 1.0e3)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        u[i] = hit.u
        v[i] = hit.v


class MeshDrawing:
    """Draws a textured or vertex-colored mesh without shading."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._mesh = mesh
        points = wp.array(mesh.vertices.astype(np.float32), dtype=wp.vec3, device="cpu")
        self._hits = wp.Mesh(points, wp.array(mesh.faces.astype(np.int32).ravel(), dtype=int, device="cpu"))

    def draw(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colors (k, 3) in [0, 255] along rays (k, 3), and the mask of those that hit."""
        n = len(rays)
        unit = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
        directions = wp.array(unit, dtype=wp.vec3, device="cpu")
        face, u, v = (wp.zeros(n, dtype=kind, device="cpu") for kind in (int, float, float))
        wp.launch(_hit, n, [self._hits.id, wp.vec3(*eye), directions], [face, u, v], device="cpu")
        hit = face.numpy() >= 0
        corner = self._mesh.faces[face.numpy()[hit]]
        a, b = u.numpy()[hit], v.numpy()[hit]
        share = np.stack([a, b, 1.0 - a - b], 1)[..., None]
        out = np.zeros((n, 3))
        if isinstance(self._mesh.visual, trimesh.visual.TextureVisuals):
            texture = np.asarray(self._mesh.visual.material.baseColorTexture.convert("RGB"), np.float64)
            height, width = texture.shape[:2]
            uv = (self._mesh.visual.uv[corner] * share).sum(1)
            x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
            i, j = np.floor(x).astype(int).clip(0, width - 2), np.floor(y).astype(int).clip(0, height - 2)
            s, t = (x - i)[:, None], (y - j)[:, None]
            top = texture[j, i] * (1 - s) + texture[j, i + 1] * s
            out[hit] = top * (1 - t) + (texture[j + 1, i] * (1 - s) + texture[j + 1, i + 1] * s) * t
        else:
            out[hit] = (self._mesh.visual.vertex_colors[corner, :3] * share).sum(1)
        return out, hit


def held_out_frames(twin: Twin, lighting: str, size: tuple[int, int]):
    """Index, pose, rays in the camera frame (h, w, 3) and photo of every held-out frame under a lighting."""
    cameras = twin.cameras()
    for i in np.flatnonzero(cameras.held_out):
        if cameras.lightings[i] == lighting:
            native = int(cameras.sizes[i, 0]), int(cameras.sizes[i, 1])
            rays = unproject(pixel_grid(*size), scaled_intrinsics(cameras.intrinsics[i], native, size))
            photo = np.asarray(resize(read_image(cameras.image_path(i)), *size), np.float64)
            yield i, cameras.camera_to_world[i], rays, photo


def score_mesh(twin: Twin, lighting: str, size: tuple[int, int]) -> None:
    """Prints the PSNR of the mesh with colors per vertex, of the textured mesh, and of the field."""
    field, cameras = twin.field(), twin.cameras()
    stored = load_arrays(require_stage(twin.scene, "mesh") / "visual.npz")
    vertices, faces = stored["vertices"].astype(np.float64), stored["faces"]
    coarse = render_views(field, cameras, VIEWS, WIDTH, FAR, lighting)
    plain = trimesh.Trimesh(vertices, faces, vertex_colors=gltf.vertex_colors(coarse, vertices), process=False)
    start = time.perf_counter()
    fine = render_views(field, cameras, gltf.VIEWS, gltf.WIDTH, gltf.FAR, lighting)
    content = gltf.textured_glb(vertices, faces, fine, gltf.filmed_frames(cameras, lighting))
    seconds = time.perf_counter() - start
    read = trimesh.load(io.BytesIO(content), file_type="glb", process=False).to_geometry()
    read.vertices = read.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]  # glTF has y up, the scene z
    texture = read.visual.material.baseColorTexture
    print(f"{lighting}: texture {texture.size[0]}×{texture.size[1]}, {len(content) / 1e6:.1f} MB, {seconds:.0f} s")
    drawings = {"colors per vertex": MeshDrawing(plain), "texture": MeshDrawing(read)}
    scores: dict[tuple[str, int, bool], list[float]] = {}
    exposures: list[np.ndarray] = []
    for i, pose, rays, photo in held_out_frames(twin, lighting, size):
        shown = {
            name: drawing.draw(pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T) for name, drawing in drawings.items()
        }
        hit = shown["texture"][1].reshape(size[::-1])
        pictures = {name: rgb.reshape(photo.shape) for name, (rgb, _) in shown.items()}
        pictures["field"] = (
            field.render(cameras.select(np.array([i])), lighting, size).rgb[0].astype(np.float64) * 255.0
        )
        left = np.arange(size[0])[None] < size[0] // 2
        if min(np.count_nonzero(hit & left), np.count_nonzero(hit & ~left)) < 100 * 4 * 4:
            print(f"{lighting}: frame {i} shows too little of the mesh and is left out")
            continue
        exposures.append(_exposure(pictures["field"], photo, hit))
        for name, rgb in pictures.items():
            for fitted in (False, True):
                shown_rgb = np.clip(rgb * _exposure(rgb, photo, hit & left), 0.0, 255.0) if fitted else rgb
                scored = hit & ~left if fitted else hit
                for k in (1, 4):  # at full size, and averaged over 4 × 4 pixels, as policies see it
                    a, b = _averaged(shown_rgb, k) / 255.0, _averaged(photo, k) / 255.0
                    scores.setdefault((name, k, fitted), []).append(psnr(a, b, _averaged(scored, k) == 1.0))
    print(f"{lighting}: exposure of the frames varies by {np.std(exposures, axis=0).mean():.1%} (standard deviation)")
    for (name, k, fitted), values in scores.items():
        where = f"{len(values)} held-out frames of {size[0] // k}×{size[1] // k}"
        how = ", exposure fitted on the left half" if fitted else ""
        print(f"{lighting}: {name}: {np.mean(values):.2f} dB over {where}{how}")


def _exposure(rgb: np.ndarray, photo: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Factors (3,) of the color channels that bring rgb nearest to a photo, both (h, w, 3), at pixels of a mask."""
    return (rgb[where] * photo[where]).sum(0) / np.maximum((rgb[where] ** 2).sum(0), 1.0)


def _averaged(image: np.ndarray, k: int) -> np.ndarray:
    """Means over squares of k × k pixels."""
    height, width = (n // k * k for n in image.shape[:2])
    cut = image[:height, :width].astype(np.float64)
    return cut.reshape(height // k, k, width // k, k, *image.shape[2:]).mean((1, 3))


def score_splats(twin: Twin, lighting: str, size: tuple[int, int], frames: int) -> None:
    """Prints PSNR and processor time of the splats and of the field; and the PSNR if sky on surfaces were kept."""
    field, cameras = twin.field(), twin.cameras()
    with mock.patch.object(gaussians, "sky_on_surfaces", lambda views: np.zeros(views[0].depth.shape, bool)):
        kept = views_by_lighting(field, cameras, [lighting])
    pruned = views_by_lighting(field, cameras, [lighting])
    moved = np.count_nonzero(kept[lighting].depth != pruned[lighting].depth)
    near = np.count_nonzero((kept[lighting].depth > 0) & (kept[lighting].depth < FAR))
    print(f"{lighting}: {moved} of {near} pixels on surfaces have the sky's color and become background")
    casters = {"splats": _caster(pruned, lighting, size), "splats with sky on surfaces": _caster(kept, lighting, size)}
    scores: dict[str, list[float]] = {name: [] for name in (*casters, "field")}
    seconds: dict[str, list[float]] = {name: [] for name in (*casters, "field")}
    for i, pose, rays, photo in list(held_out_frames(twin, lighting, size))[:frames]:
        for name, caster in casters.items():
            start = time.process_time()
            caster.set_rays(mujoco_rays(rays))
            camera = opencv_to_mujoco(pose)
            caster.set_poses(cam_xpos=camera[None, :3, 3], cam_xmat=camera[None, :3, :3])
            rgb, _ = caster.cast()
            seconds[name].append(time.process_time() - start)
            scores[name].append(psnr(rgb.reshape(photo.shape) / 255.0, photo / 255.0))
        start = time.process_time()
        shown = field.render(cameras.select(np.array([i])), lighting, size)
        seconds["field"].append(time.process_time() - start)
        scores["field"].append(psnr(np.clip(shown.rgb[0], 0.0, 1.0), photo / 255.0))
    for name, values in scores.items():
        print(
            f"{lighting}: {name}: {np.mean(values):.2f} dB over {len(values)} held-out frames of {size[0]}×{size[1]}, "
            f"{np.median(seconds[name]):.2f} s of processor time each"
        )


def _caster(views: dict[str, Views], lighting: str, size: tuple[int, int]) -> RayCaster:
    """A ray caster that shows the splats of views and nothing else."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_camera(name="eye")
    spec.worldbody.add_geom(size=[0.01] * 3, pos=[0, 0, -1000])
    spec.stat.extent = 20.0  # so MuJoCo draws up to 1 km, as in the scene
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return RayCaster(model, data, cam_res=size, **gaussians_by_lighting(views)[lighting].render_settings())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="scenes/demo")
    parser.add_argument("--only", choices=("mesh", "splats"), required=True)
    parser.add_argument("--lighting", nargs="+", default=["sun"])
    parser.add_argument("--size", type=int, nargs=2, default=[640, 360], help="size of the pictures [px]")
    parser.add_argument("--frames", type=int, default=4, help="number of held-out frames that score the splats")
    given = parser.parse_args()
    twin, size = load_scene(given.scene), (given.size[0], given.size[1])
    for lighting in given.lighting:
        if given.only == "mesh":
            score_mesh(twin, lighting, size)
        else:
            score_splats(twin, lighting, size, given.frames)


if __name__ == "__main__":
    main()
