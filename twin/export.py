"""Verb: the place for other programs: its visual mesh as glTF, its field as Gaussian splats.

    python -m twin.export scenes/demo --glb road.glb --ply road.ply --lighting night

Both have the colours of one lighting. The mesh is that of the build; the splats are the field's own depth and colour,
rendered from the filmed poses (see `assets/splats.py`), not fitted to photos.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from twin import cli
from twin.assets.splats import gaussians_of_views
from twin.assets.views import Views, render_views
from twin.errors import InputError
from twin.files import load_arrays, write_bytes
from twin.geometry.cameras import project
from twin.loading import load_scene
from twin.scene import finished

_VIEWS, _WIDTH = 60, 320
_FAR = 100.0  # [m] what is further becomes background
_BACKGROUND = 150.0  # [m] where splats of the background go
_SEEN = 0.03  # share of a vertex's depth that it may lie behind what is rendered there
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def vertex_colours(views: Views, vertices: NDArray) -> NDArray[np.uint8]:
    """What the views show of vertices (k, 3) [m], the nearest ones most; shape (k, 3).

    A vertex that none sees has the colour of the nearest one that is seen.
    """
    height, width = views.depth.shape[1:]
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for i in range(len(views)):
        pixel, depth = project(vertices, views.camera_to_world[i], views.intrinsics[i])
        u, v = np.floor(np.nan_to_num(pixel, nan=-1.0).clip(-1.0, 1e6)).astype(int).T
        inside = np.flatnonzero((depth > 0.0) & (u >= 0) & (v >= 0) & (u < width) & (v < height))
        there = views.depth[i, v[inside], u[inside]]
        seen = inside[np.abs(there - depth[inside]) < _SEEN * depth[inside]]
        share = 1.0 / depth[seen] ** 2
        total[seen] += share[:, None] * views.rgb[i, v[seen], u[seen]]
        weight[seen] += share
    known = weight > 0.0
    if not known.any():
        raise InputError("no view of the field shows the mesh; build the scene anew")
    colours = total / np.maximum(weight, 1e-12)[:, None]
    colours[~known] = colours[known][cKDTree(vertices[known]).query(vertices[~known])[1]]
    return (colours + 0.5).astype(np.uint8)


def export(scene: Path, lighting: str | None, glb: Path | None, ply: Path | None) -> list[str]:
    """Writes the files asked for, and returns a line on each. Colours are as in clear air, whatever a photo told.

    Raises:
        InputError: a scene that is not built, an unknown lighting, or a folder that is not there.
    """
    for path in (glb, ply):
        if path is not None and not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}; create it, or give another path")
    twin = load_scene(scene)
    field = twin.field()
    lighting = lighting or field.lightings[0]
    field.embedding(lighting)  # raises for an unknown name before anything takes time
    views = render_views(field, twin.cameras(), _VIEWS, _WIDTH, _FAR, lighting)
    lines = []
    if glb is not None:
        mesh = load_arrays(finished(twin.scene, "mesh") / "visual.npz")
        vertices, faces = mesh["vertices"], mesh["faces"]
        colours = vertex_colours(views, vertices.astype(np.float64))
        solid = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
        solid.apply_transform(_Z_UP_TO_Y_UP)  # as glTF has it
        content = solid.export(file_type="glb")
        assert isinstance(content, bytes)
        write_bytes(glb, content)
        lines.append(f"{glb}: {len(faces)} faces under {lighting}, y up [m]")
    if ply is not None:
        splats = gaussians_of_views(views, _BACKGROUND)
        write_bytes(ply, splats.to_ply())
        lines.append(f"{ply}: {len(splats.rgb)} gaussians under {lighting}, z up [m]")
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status, see `twin.cli`."""
    parser = cli.Parser(
        prog="python -m twin.export",
        description="Write a built place for other programs: its mesh as glTF, its field as Gaussian splats.",
    )
    parser.add_argument("scene", type=Path, help="folder of a built scene")
    parser.add_argument("--glb", type=Path, help="write the visual mesh with colours per vertex (binary glTF, y up)")
    parser.add_argument("--ply", type=Path, help="write gaussians as 3DGS viewers read them (z up)")
    parser.add_argument("--lighting", help="name, or two and a share as sun:night:0.5; by default the first filmed one")
    parser.add_argument("--quiet", action="store_true", help="no progress, no summary")
    return cli.run(parser, _main, arguments)


def _main(options: argparse.Namespace) -> None:
    if options.glb is None and options.ply is None:
        raise InputError("nothing to write; give --glb FILE, --ply FILE or both")
    lines = export(options.scene, options.lighting, options.glb, options.ply)
    if not options.quiet:
        print("\n".join(lines))


if __name__ == "__main__":
    sys.exit(main())
