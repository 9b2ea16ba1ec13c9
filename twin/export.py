"""Verb: exports the visual mesh as glTF and the radiance field as Gaussian splats.

    python -m twin.export scenes/demo --glb road.glb --ply road.ply --lighting night

Both have the colors of one lighting. The mesh is that of the build; the splats come from the field's depth and color,
rendered from the filmed poses (see `assets/splats.py`), and are not fitted to photos.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin import commands
from twin.assets.splats import gaussians_of_views
from twin.assets.views import Views, render_views
from twin.errors import InputError
from twin.files import load_arrays, write_bytes
from twin.geometry.cameras import project
from twin.loading import load_scene
from twin.scene import require_stage

_VIEWS, _WIDTH = 60, 320
_FAR = 100.0  # [m] beyond which geometry becomes background
_BACKGROUND = 150.0  # [m] distance of the background's splats
_DEPTH_TOLERANCE = 0.03  # relative depth difference within which a vertex counts as visible
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def vertex_colors(views: Views, vertices: NDArray) -> NDArray[np.uint8]:
    """Colors of vertices (k, 3) [m] as a mean over views weighted by 1 / depth², shape (k, 3).

    A vertex that no view sees has the color of the nearest visible vertex.
    """
    height, width = views.depth.shape[1:]
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for i in range(len(views)):
        pixel, depth = project(vertices, views.camera_to_world[i], views.intrinsics[i])
        u, v = np.floor(np.nan_to_num(pixel, nan=-1.0).clip(-1.0, 1e6)).astype(int).T
        inside = np.flatnonzero((depth > 0.0) & (u >= 0) & (v >= 0) & (u < width) & (v < height))
        rendered = views.depth[i, v[inside], u[inside]]
        visible = inside[np.abs(rendered - depth[inside]) < _DEPTH_TOLERANCE * depth[inside]]
        share = 1.0 / depth[visible] ** 2
        total[visible] += share[:, None] * views.rgb[i, v[visible], u[visible]]
        weight[visible] += share
    known = weight > 0.0
    if not known.any():
        raise InputError("no view of the field shows the mesh; build the scene again")
    colors = total / np.maximum(weight, 1e-12)[:, None]
    colors[~known] = colors[known][cKDTree(vertices[known]).query(vertices[~known])[1]]
    return (colors + 0.5).astype(np.uint8)


def export(scene: Path, lighting: str | None, glb: Path | None, ply: Path | None) -> list[str]:
    """Writes the given files and returns a summary line for each. Colors are without fog.

    Raises:
        InputError: the scene is not built, the lighting is unknown, or an output folder does not exist.
    """
    for path in (glb, ply):
        if path is not None and not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}; create it, or give another path")
    twin = load_scene(scene)
    field = twin.field()
    lighting = lighting or field.lightings[0]
    field.embedding(lighting)  # raises early for an unknown name
    views = render_views(field, twin.cameras(), _VIEWS, _WIDTH, _FAR, lighting)
    lines = []
    if glb is not None:
        mesh = load_arrays(require_stage(twin.scene, "mesh") / "visual.npz")
        vertices, faces = mesh["vertices"], mesh["faces"]
        colors = vertex_colors(views, vertices.astype(np.float64))
        surface = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
        surface.apply_transform(_Z_UP_TO_Y_UP)  # glTF's convention
        content = surface.export(file_type="glb")
        assert isinstance(content, bytes)
        write_bytes(glb, content)
        lines.append(f"{glb}: {len(faces)} faces under {lighting}, y up [m]")
    if ply is not None:
        splats = gaussians_of_views(views, _BACKGROUND)
        write_bytes(ply, splats.to_ply())
        lines.append(f"{ply}: {len(splats.rgb)} gaussians under {lighting}, z up [m]")
    return lines


def command(options: argparse.Namespace) -> None:
    """Runs the verb with the options parsed by `twin.commands`."""
    if options.glb is None and options.ply is None:
        raise InputError("nothing to write; give --glb FILE, --ply FILE or both")
    lines = export(options.scene, options.lighting, options.glb, options.ply)
    if not options.quiet:
        print("\n".join(lines))


main = partial(commands.main, "export")

if __name__ == "__main__":
    sys.exit(main())
