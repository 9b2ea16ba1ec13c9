"""`twin export`: writes a built scene for other programs.

    twin export scenes/demo --usd road.usdz
    twin export scenes/demo --glb road.glb --ply road.ply --spz road.spz --lighting night
    twin export scenes/demo --nerfstudio road_ns --colmap road_colmap
    twin export scenes/demo --task straight --task-file straight.json

`camera_formats` writes frames and cameras, `gltf` the mesh, and `usd` all of the place; `twin.assets.gaussians` makes
the splats, and `twin.env.task` the task files.
"""

import argparse
import sys
from pathlib import Path

import mujoco
import numpy as np

from twin import commands
from twin.assets.gaussians import gaussians_by_lighting, require_spz, views_by_lighting
from twin.assets.views import render_views
from twin.config_file import load_config
from twin.env.options import Options
from twin.env.route_segments import find_task
from twin.env.task import task_table
from twin.errors import InputError
from twin.export import gltf
from twin.export.camera_formats import write_colmap, write_nerfstudio
from twin.files import load_arrays, require_absent, require_output, write_bytes, write_json
from twin.geometry.cameras import SparsePoints
from twin.loading import Twin, load_scene
from twin.mjcf.scene_xml import Parts
from twin.mjcf.world import SCENE_XML
from twin.scene import PACK_JSON, require_stage

_MEGABYTE = 1e6
_SUFFIXES = (".usdz", ".usd", ".usdc"), (".glb",), (".ply",), (".spz",)  # of --usd, --glb, --ply and --spz


def command(given: argparse.Namespace) -> None:
    """Runs `twin export` with the options parsed by `twin.commands`."""
    paths = given.usd, given.glb, given.ply, given.spz, given.nerfstudio, given.colmap
    lines = export(given.scene, given.lighting, *paths, given.task_file, given.task)
    if not given.quiet:
        print("\n".join(lines))


def export(
    scene: Path,
    lighting: str | None = None,
    usd_file: Path | None = None,
    glb: Path | None = None,
    ply: Path | None = None,
    spz: Path | None = None,
    nerfstudio: Path | None = None,
    colmap: Path | None = None,
    task_file: Path | None = None,
    task: str | None = None,
) -> list[str]:
    """Writes the given files and folders; returns a summary line for each. Colors do not include a lighting's fog.

    Raises:
        InputError: nothing to write, the scene is not built, it is a pack and frames are wanted, the lighting or
            task is unknown, a lighting is given for files that have none, a file has another suffix than its format,
            a path is given twice or cannot be written, or a folder to write exists already.
    """
    files, folders = [one for one in (usd_file, glb, ply, spz) if one], [one for one in (nerfstudio, colmap) if one]
    task_files = [task_file] if task_file else []
    if not files and not folders and not task_files:
        raise InputError("nothing to write; give --usd, --glb, --ply, --spz, --nerfstudio, --colmap or --task-file")
    if (task_file is None) != (task is None):
        raise InputError("--task and --task-file belong together; give both, such as --task straight --task-file FILE")
    if lighting and not files:
        raise InputError(f"--lighting {lighting}: only --usd, --glb, --ply and --spz have a lighting; leave it out")
    for path in folders:
        require_absent(path)
    for file, suffixes in zip((usd_file, glb, ply, spz, task_file), (*_SUFFIXES, ()), strict=True):
        if file is not None:
            require_output(file, suffixes)
    outputs = [path.resolve() for path in (*files, *folders, *task_files)]
    for path in outputs:
        if outputs.count(path) > 1:
            raise InputError(f"{path} is given twice; give each file and folder a name of its own")
    if usd_file is not None:
        _require_usd()
    if spz is not None:
        require_spz()
    twin = load_scene(scene)
    if folders and (twin.scene.root / PACK_JSON).exists():
        require_stage(twin.scene, "capture")  # raises InputError: a pack has no frames
    lines = []
    if task_file and task:
        if not twin.scene.has_route:
            raise InputError(f"{twin.scene.root}: has no route, so no tasks; set mjcf.route = true and build it again")
        world = twin.world()
        segment = find_task(task, world, load_config(twin.scene.config_file).task)
        write_json(task_file, task_table(world.along(segment.route), segment, Options()))
        lines.append(f"{task_file}: {task}, {segment.length:.1f} m long, starts {segment.start:.1f} m along the route")
    if files:
        lines += _field_files(twin, lighting, usd_file, glb, ply, spz)
    if folders:
        cameras = twin.cameras()
        points = SparsePoints.load(require_stage(twin.scene, "metric"))
        for out, write in ((nerfstudio, write_nerfstudio), (colmap, write_colmap)):
            if out is not None:
                write(out, cameras, points)
                lines.append(f"{out}: {len(cameras)} frames, {len(points)} points, z up [m]")
    return lines


def _require_usd() -> None:
    """Raises InputError if the package usd-core is missing or too old."""
    try:
        from pxr import UsdVol
    except ImportError as error:
        raise InputError(f"{error}: --usd needs usd-core; pip install 'twin[usd]'") from None
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise InputError("this usd-core has no ParticleField3DGaussianSplat; pip install 'usd-core>=26.3'")


def _field_files(
    twin: Twin, lighting: str | None, usd_file: Path | None, glb: Path | None, ply: Path | None, spz: Path | None
) -> list[str]:
    """Writes the files with colors rendered from the radiance field; returns their summary lines."""
    field, cameras = twin.field(), twin.cameras()
    lighting = lighting or field.lightings[0]
    field.embedding(lighting)  # raises InputError early if the name is unknown
    lines = []
    mesh = load_arrays(require_stage(twin.scene, "mesh") / "visual.npz") if usd_file or glb else {}
    if usd_file or ply or spz:
        names = dict.fromkeys([lighting, *field.lightings]) if usd_file else [lighting]
        views = views_by_lighting(field, cameras, list(names))
        splats = gaussians_by_lighting(views)
        if ply:
            write_bytes(ply, splats[lighting].to_ply())
            lines.append(f"{ply}: {len(splats[lighting].rgb)} gaussians under {lighting}, z up [m]")
        if spz:
            splats[lighting].write_spz(spz)
            size = f"{spz.stat().st_size / _MEGABYTE:.1f} MB"
            lines.append(f"{spz}: {len(splats[lighting].rgb)} gaussians under {lighting}, {size}, z up [m]")
        if usd_file:
            from twin.export.usd import write_usd

            tints = {name: gltf.vertex_colors(one, mesh["vertices"].astype(np.float64)) for name, one in views.items()}
            parts = Parts.load(require_stage(twin.scene, "mesh") / "parts.npz")
            world = twin.world() if twin.scene.has_route else None
            model = mujoco.MjModel.from_xml_path(str(require_stage(twin.scene, "mjcf") / SCENE_XML))
            surface = mesh["vertices"], mesh["faces"]
            write_usd(usd_file, splats, surface, tints, parts, model, world, lighting)
            lines.append(
                f"{usd_file}: {len(splats[lighting].rgb)} gaussians under {', '.join(splats)}, {len(parts.vertices)} "
                f"convex parts{', the Husky' if world else ''}, {usd_file.stat().st_size / _MEGABYTE:.0f} MB, z up [m]"
            )
    if glb:
        views_of_one = render_views(field, cameras, gltf.VIEWS, gltf.WIDTH, gltf.FAR, lighting, f"textures, {lighting}")
        frames = gltf.filmed_frames(cameras, lighting)
        write_bytes(glb, gltf.textured_glb(mesh["vertices"].astype(np.float64), mesh["faces"], views_of_one, frames))
        source = f"the field and {len(frames)} frames" if frames else "the field"
        lines.append(f"{glb}: {len(mesh['faces'])} faces, textured under {lighting} from {source}, y up [m]")
    return lines


if __name__ == "__main__":
    sys.exit(commands.main("export"))
