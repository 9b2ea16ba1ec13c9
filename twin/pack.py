"""`twin pack`: packs a built scene, with chosen policies, into one file for another machine.

    twin pack scenes/demo --policy first -o demo.twin

A pack contains what driving needs: the baked radiance field, the MJCF scene with its assets, ground, collision parts
and cameras, tasks, robot, and lightings fitted to photos. It contains no films, frames, reports, or torch model.
Private data are left out: comments and paths of `scene.toml`, photos, dependencies in stamps and, unless asked for, GPS
positions. `twin.unpack` describes the format.

Driving in a pack gives the same results as in the scene, bit for bit: the radiance field differs only in samples that
no ray reads (`baked_arrays.samples_read`). With `--levels` below 256, the field's features are rounded to that number
of values, which makes the pack smaller and changes the field.
"""

import argparse
import csv
import io
import shlex
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as to_bytes

from twin import commands, runtime, unpack
from twin.capture.capture_data import Capture
from twin.config_file import ROBOT_TOML
from twin.errors import InputError, short_repr
from twin.files import (
    atomic_path,
    digest_json,
    json_bytes,
    load_tensors,
    read_bytes,
    read_json,
    read_toml,
    require_output,
    toml_value,
)
from twin.learn.policy import JSON, ONNX, WEIGHTS, find_policy, load_policy
from twin.loading import Twin, load_scene
from twin.nerf.baked_arrays import BAKED_FORMATS, BAKED_HEAD, BrickLayout, samples_read, section_file
from twin.nerf.lightings import lighting_files
from twin.nerf.road import ROAD_FILE, read_head
from twin.scene import STAGE_FOLDERS, SceneDir, Stamp, package_versions, require_stage, stage_result

LEVELS = 256
"""Default of `--levels`: the number of values of a byte, so nothing is rounded."""
_ZERO = 128  # byte that encodes 0 in the detail; bytes are rounded to this plus multiples of the step
_FINER = 4  # step of features / step of density; density is rounded less because it determines surfaces
_VERTEX_STEP = 2  # step of the hash grid's vertices / step of features
_CHUNK = 1 << 20  # [bytes] written between two updates of the progress bar
_PACKED = {"metric": ("cameras.json", "cameras.npz"), "field": (BAKED_HEAD, "baked.safetensors")}
_MESH = ("ground.npz", "parts.npz", "visual.npz")
_TEXT = """\
A pack of {name}, made by twin {version}: a MuJoCo simulation of a place, which `twin build` made from films.

  twin: the program that opens it; its README says how to install it
  twin drive {file}     the Husky drives in it{driver}
  twin unpack {file} FOLDER              a scene folder, in which all commands work that need no films

LICENCE
  {licence}

PRIVACY
  The place is shown as its films show it: people, license plates and private ground that are in them may be
  recognizable in rendered pictures. Whoever passes this file on is responsible for that.
  Films, frames, photos and their EXIF headers are not in it. {positions}

Nothing in this file runs when it is opened{zips}. manifest.json has the SHA-256 of every file.
"""


def pack(
    root: Path,
    out: Path | None = None,
    policies: Sequence[str] = (),
    levels: int = LEVELS,
    licence: str = "",
    positions: bool = False,
    trust: bool = False,
) -> tuple[Path, dict[str, Any]]:
    """Packs a built scene; returns the pack's path and its manifest.

    Args:
        root: The scene.
        out: The file; by default `<name of the folder>.twin` in the working folder.
        policies: Runs, checkpoints, policy folders or ONNX files; with `trust` also zips of stable-baselines3.
        levels: Number of values to which the field's features are rounded, 2 to 256.
        licence: Terms for those who receive the pack.
        positions: Adds the films' GPS positions.
        trust: Also packs policies that may run code; those who unpack the file must trust them, too.

    Raises:
        InputError: the scene is not built, a policy cannot be packed, `positions` are wanted but there are none, or a
            setting is out of range.
    """
    if not 2 <= levels <= LEVELS:
        raise InputError(f"--levels {levels}: expected 2 to {LEVELS}")
    twin = load_scene(root)
    scene = twin.scene
    name = scene.root.resolve().name
    out = out or Path(f"{name}{unpack.SUFFIX}")
    require_output(out, (unpack.SUFFIX,))
    files: dict[str, bytes] = {"scene.toml": _scene_toml(scene, name)}
    if (scene.root / ROBOT_TOML).exists():
        files[ROBOT_TOML] = _toml(read_toml(scene.root / ROBOT_TOML))
    names: list[str] = []
    for one in dict.fromkeys(policies):
        names.append(_add_policy(files, scene.root, one, trust))
        if names[-1] in names[:-1]:
            raise InputError(f"--policy {one}: the pack has a policy {names[-1]} already; rename one, or leave it out")
    if positions:
        files["positions.csv"] = _positions(twin)
    field = _add_stages(files, scene, levels)
    for path in lighting_files(scene):
        lighting = read_json(path)
        if lighting.get("field") == stage_result(scene, "field"):  # lightings of an older field are left out
            lighting |= {"field": field, "photo": PurePath(str(lighting.get("photo"))).name}
            files[f"lightings/{path.name}"] = json_bytes(lighting)
    head = {
        "format": unpack.FORMAT,
        "version": unpack.VERSION,
        "name": name,
        "licence": licence or "not stated; ask the sender",
        "positions": positions,
        "policies": names,
        "levels": levels,
        "packages": package_versions(),
    }
    return out, _write(out, files, head)


def _scene_toml(scene: SceneDir, name: str) -> bytes:
    """`scene.toml` without comments and without the folders of its films."""
    table = read_toml(scene.config_file)
    for source in table.get("source", ()):
        source |= {key: _last_part(source[key]) for key in ("path", "images", "mask") if source.get(key)}
    return _toml({"name": name} | table)


def _last_part(path: str) -> str:
    """The last part of a path; `unpack` refuses `..`."""
    name = PurePath(path).name
    return "input" if name in ("", "..") else name


def _toml(table: dict[str, Any]) -> bytes:
    return "".join(f"{key} = {toml_value(value)}\n" for key, value in table.items()).encode()


def _add_policy(files: dict[str, bytes], root: Path, source: str, trust: bool) -> str:
    """Adds the files of a policy; returns its name in the pack."""
    path = Path(find_policy(root, source))
    path = path.parent if path.name == JSON else path
    load_policy(path if path.exists() else source, trust)  # raises InputError if it is damaged
    if path.is_dir():
        kept = f"{path.parent.parent.name}/checkpoints/{path.name}" if path.parent.name == "checkpoints" else path.name
        for name in (JSON, WEIGHTS, ONNX):
            if (path / name).exists():
                files[f"runs/{kept}/{name}"] = read_bytes(path / name)
        return kept.replace("/checkpoints/", "/")
    if not path.is_file():
        raise InputError(f"--policy {source}: a pack cannot contain a Python function; export the policy to ONNX")
    files[f"policies/{path.name}"] = read_bytes(path)
    return f"policies/{path.name}"


def _positions(twin: Twin) -> bytes:
    """GPS positions of the filmed frames beside their positions in the scene, as CSV."""
    capture = Capture.load(require_stage(twin.scene, "capture"))
    cameras = twin.cameras()
    known = {name: gps for name, gps in zip(capture.names, capture.gps, strict=True) if np.isfinite(gps[:2]).all()}
    if not known:
        raise InputError(f"--with-positions: no frame of {twin.scene.root} has a GPS position")
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "latitude_deg", "longitude_deg", "altitude_m", "x_m", "y_m", "z_m"])
    for name, position in zip(cameras.names, cameras.positions, strict=True):
        if name in known:
            table.writerow([name, *known[name].tolist(), *position.tolist()])
    return text.getvalue().encode()


def _add_stages(files: dict[str, bytes], scene: SceneDir, levels: int) -> str:
    """Adds the files of each stage that driving needs, with a stamp for these files; returns the field's result.

    The stamps keep the build's results (content digests), so that lightings and tables remain valid. The exception is a
    rounded field, which gets another digest.
    """
    results = {}
    for stage in unpack.STAGES_PACKED:
        folder = require_stage(scene, stage)
        stamp = Stamp.verified(folder)
        names = tuple(stamp.files) if stage == "mjcf" else _PACKED.get(stage, _MESH)
        kept = {name: read_bytes(folder / name) for name in names if (folder / name).is_file()}
        results[stage] = stamp.result
        if stage == "field":
            for k, layout in enumerate(read_head(folder / BAKED_HEAD, BAKED_FORMATS, BrickLayout)[0]):
                name = section_file(k)
                kept[name] = to_bytes(packed_field(layout, load_tensors(folder / name), levels))
            if (folder / ROAD_FILE).exists():
                kept[ROAD_FILE] = read_bytes(folder / ROAD_FILE)
            if levels < LEVELS:
                results[stage] = digest_json([stamp.result, levels])
        sizes = {name: len(content) for name, content in kept.items()}
        digests = {name: unpack.digest(content) for name, content in kept.items()}
        stamp = replace(stamp, result=results[stage], depends={}, metrics={}, files=sizes, sha256=digests)
        kept["stamp.json"] = stamp.content()
        files |= {f"build/{STAGE_FOLDERS[stage]}/{name}": content for name, content in kept.items()}
    return results["field"]


def packed_field(layout: BrickLayout, arrays: dict[str, NDArray], levels: int = LEVELS) -> dict[str, NDArray]:
    """The arrays of a section (see `BakedSection`) for a pack.

    Samples that no ray reads become copies of the preceding sample, which compress to almost nothing. With `levels`
    below 256, densities and features are rounded.
    """
    step = LEVELS / levels
    features = arrays["features"]
    if step > 1:
        features = np.concatenate(
            [rounded(features[..., :1], max(1.0, step / _FINER)), rounded(features[..., 1:], step)], -1
        )
        coarser = {"detail.texels": step, "detail.vertices": _VERTEX_STEP * step}
        detail = {name: rounded(arrays[name], by) for name, by in coarser.items() if name in arrays}
        arrays = arrays | detail
    read = samples_read(layout, arrays).ravel()
    last = np.maximum.accumulate(np.where(read, np.arange(len(read)), 0))
    flat = features.reshape(len(read), -1)
    return arrays | {"features": flat[last].reshape(features.shape)}


def rounded(values: NDArray[np.uint8], step: float) -> NDArray[np.uint8]:
    """Rounds bytes to multiples of a step, counted from `_ZERO`."""
    table = np.round((np.arange(LEVELS) - _ZERO) / step) * step + _ZERO
    return np.clip(np.round(table), 0, LEVELS - 1).astype(np.uint8)[values]


def _write(out: Path, files: dict[str, bytes], head: dict[str, Any]) -> dict[str, Any]:
    coded = {name: unpack.DIFFERENCES if unpack.IS_BAKED.search(name) else unpack.PLAIN for name in files}
    facts = {
        name: {"bytes": len(content), "sha256": unpack.digest(content), "coding": coded[name]}
        for name, content in sorted(files.items())
    }
    for name in files:
        if not unpack.PLACES.fullmatch(name):
            raise InputError(
                f"{short_repr(name)} cannot be in a pack; rename it: letters, digits and _ . + - only, "
                "and none of . + - at the beginning"
            )
    total = sum(map(len, files.values()))
    if total > unpack.MAX_TOTAL:
        raise InputError(
            f"{out}: {total / 2**30:.1f} GiB unpacked, and twin unpack takes at most {unpack.MAX_TOTAL >> 30} GiB; "
            "build the place with a smaller nerf.max_bricks or a longer nerf.section_length"
        )
    manifest = head | {"files": facts}
    text = _TEXT.format(
        name=head["name"],
        version=head["packages"]["twin"],
        file=out.name,
        driver=f", by the policy {head['policies'][0]}" if head["policies"] else "",
        licence=head["licence"],
        positions="GPS positions of the frames are in positions.csv."
        if head["positions"]
        else "It has no GPS positions.",
        zips=", but loading a policy in policies/ may run its code" if any(n.endswith(".zip") for n in files) else "",
    )
    with (
        atomic_path(out) as partial,
        zipfile.ZipFile(partial, "w") as archive,
        runtime.bar("pack", total, "B", after=1.0) as progress,
    ):
        archive.writestr(_entry(unpack.README), text.encode())
        archive.writestr(_entry(unpack.MANIFEST), json_bytes(manifest))
        for name in facts:
            content = files[name]
            if coded[name] == unpack.DIFFERENCES:
                content = unpack.encode_differences(content)
            entry = _entry(name)
            entry.file_size = len(content)  # the zip's header needs the size before the content is written
            with archive.open(entry, "w") as packed:
                for start in range(0, len(content), _CHUNK):
                    progress.update(packed.write(content[start : start + _CHUNK]))
        archive.close()
        unpack.read_manifest(partial)  # nobody could unpack a pack that is refused here
    return manifest


def _entry(name: str) -> zipfile.ZipInfo:
    """A zip entry without a time, so that the same scene always gives the same pack."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.external_attr = 0o100644 << 16
    return entry


def command(given: argparse.Namespace) -> None:
    """Runs `twin pack` with the options parsed by `twin.commands`."""
    out, manifest = pack(
        given.scene, given.out, given.policy, given.levels, given.licence, given.with_positions, given.trust
    )
    if not given.quiet:
        total = sum(one["bytes"] for one in manifest["files"].values())
        size = f"{out.stat().st_size / 1e6:.1f} MB, {total / 1e6:.1f} MB unpacked"
        print(f"{out}: {size}; drive in it: twin drive {shlex.quote(str(out))}")


if __name__ == "__main__":
    sys.exit(commands.main("pack"))
