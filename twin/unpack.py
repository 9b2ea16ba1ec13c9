"""`twin unpack`: unpacks a *pack*, a file with all that driving in a built scene needs. `twin.pack` writes packs.

    twin unpack demo.twin scenes/demo_copy

A pack is a zip: `README.txt` for people, `manifest.json`, then the files of a scene folder. The manifest has the size
and SHA-256 of each file as unpacked, and the file's *coding*: `plain`, or `differences` for the field
(see `encode_differences`).

A pack may come from anyone, so unpacking runs nothing in it. A pack is refused if it has a name that does not match
`PLACES` (such as a path that leads elsewhere), a link, the same name twice, a size above the bounds or different from
the declared one, or a wrong digest. Then nothing remains on the disk.
"""

import argparse
import contextlib
import glob
import hashlib
import json
import math
import os
import re
import secrets
import shlex
import shutil
import stat
import struct
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from twin import commands, runtime
from twin.config_file import load_config
from twin.errors import InputError, short_repr
from twin.files import (
    digest_file,
    exists,
    is_file,
    parse_json,
    read_json,
    read_text,
    remove,
    require_text,
    wrap_read_errors,
)
from twin.geometry.cameras import Cameras
from twin.mjcf.world import SCENE_XML
from twin.runtime import exclusive_lock
from twin.scene import MAX_HASHED, PACK_JSON, STAGE_FOLDERS, SceneDir

SUFFIX = ".twin"
# Folders in which a pack given by its name is searched.
_SEARCHED = (Path(), Path("scenes"), Path(__file__).resolve().parents[1] / "scenes")
FORMAT, VERSION = "twin pack", 1
MANIFEST, README = "manifest.json", "README.txt"
PLAIN, DIFFERENCES = "plain", "differences"
STAGES_PACKED = ("metric", "field", "mesh", "mjcf")
"""Build stages of which some files are packed."""

_MAX_FILES = 100_000
_MAX_FILE = 2 << 30  # [bytes] largest file, unpacked
MAX_TOTAL = 4 << 30
"""Largest total size of the files, unpacked [bytes]."""
_MAX_RATIO = 30  # largest total size / the pack's size
_FREE = 16 << 20  # [bytes] a total up to this is allowed at any ratio
_MAX_MANIFEST = 16 << 20  # [bytes]
_CHUNK = 4 << 20  # [bytes]
_N = r"\w[\w.+-]{0,99}"  # a name in a path; it cannot begin with a dot, so ".." is excluded
PLACES = re.compile(
    rf"scene\.toml|robot\.toml|positions\.csv|lightings/{_N}\.json"
    rf"|build/{STAGE_FOLDERS['metric']}/(cameras\.(json|npz)|stamp\.json)"
    rf"|build/{STAGE_FOLDERS['field']}/(baked\.json|baked(_[1-9][0-9]{{0,3}})?\.safetensors|road\.safetensors|stamp\.json)"
    rf"|build/{STAGE_FOLDERS['mesh']}/({_N}\.(npz|png)|stamp\.json)"
    rf"|build/{STAGE_FOLDERS['mjcf']}/(scene\.xml|world\.json|stamp\.json|assets/{_N}\.(obj|png|bin))"
    rf"|runs/{_N}/(checkpoints/{_N}/)?policy\.(json|safetensors|onnx)|policies/{_N}\.(onnx|zip)"
)
"""Pattern of the names that files of a pack may have."""
IS_BAKED = re.compile(r"/baked(_\d+)?\.safetensors$")
"""Pattern of the names of files that are coded by `encode_differences`."""
_CURE = "fetch it again, or ask its sender for another"
_NOT_A_PACK = "expected a pack, as twin pack writes it"
_XML_PATHS = (
    *("file", "meshdir", "texturedir", "assetdir"),
    *("fileright", "fileleft", "fileup", "filedown", "filefront", "fileback"),
)
_XML_REFUSED = ("include", "plugin", "extension", "model", "attach")  # elements that load other files or code
# MuJoCo's parser expands no entities and knows no namespaces, so it would read another document than the checks do.
_XML_MARKS = ("<!DOCTYPE", "<!ENTITY", "xmlns")
_PARTIAL, _TOKEN = ".partial", 8  # suffix of an unfinished folder, and number of random characters in its name
_HEADER = 8  # [bytes] size of the number at the start of a safetensors file: the header's length


def digest(content: bytes) -> str:
    """SHA-256 of a file's content."""
    return hashlib.sha256(content).hexdigest()


# ---- coding of the field


def encode_differences(content: bytes) -> bytes:
    """Recodes the byte arrays with two or more axes in a safetensors file, so that the file compresses better.

    The values of each channel (the last axis) are stored together, as differences modulo 256 from one value to the
    next, because neighbors are alike. The length does not change. `decode_differences` is the exact inverse.
    """
    out = np.frombuffer(content, np.uint8).copy()
    for data, channels in _byte_arrays(out):
        by_channel = np.ascontiguousarray(data.reshape(-1, channels).T).ravel()
        data[:] = np.diff(by_channel, prepend=np.uint8(0))
    return out.tobytes()


def decode_differences(content: NDArray[np.uint8]) -> None:
    """The inverse of `encode_differences`, in place: on the bytes of a file, such as a memory map.

    It needs the memory of the largest array. Raises ValueError for a damaged safetensors file.
    """
    for data, channels in _byte_arrays(content):
        given, decoded, last = data.reshape(channels, -1).copy(), data.reshape(-1, channels), np.uint8(0)
        for channel, differences in enumerate(given):
            values = np.cumsum(differences, dtype=np.uint8, out=differences)
            values += last
            decoded[:, channel], last = values, values[-1]


def _byte_arrays(content: NDArray[np.uint8]) -> Iterator[tuple[NDArray[np.uint8], int]]:
    """Views of the byte arrays with two or more axes in a safetensors file's bytes, and their last axes' lengths."""
    if len(content) < _HEADER:
        raise ValueError(f"it has {len(content)} bytes; expected a header")
    (length,) = struct.unpack("<Q", content[:_HEADER].tobytes())
    if length > len(content) - _HEADER:
        raise ValueError(f"its header has {length:,} bytes, but the file only {len(content):,}")
    start = _HEADER + length
    left = size = len(content) - start
    for name, tensor in json.loads(content[_HEADER:start].tobytes()).items():
        if name == "__metadata__" or tensor["dtype"] != "U8" or len(tensor["shape"]) < 2:
            continue
        first, last = tensor["data_offsets"]
        shape = [int(n) for n in tensor["shape"]]
        left -= last - first  # arrays that overlap would take time without bound
        inside = 0 <= first <= last <= size and left >= 0
        if not inside or min(shape) < 0 or math.prod(shape) != last - first:
            raise ValueError(
                f"{short_repr(name)}: shape {shape} does not match bytes {first} to {last}, or these overlap others or "
                f"are not within the {size} data bytes"
            )
        if last > first:
            yield content[start + first : start + last], shape[-1]


# ---- unpacking


def read_manifest(path: Path) -> dict[str, Any]:
    """Reads and checks the manifest of a pack.

    Raises InputError: the file is not a pack, it has another version, or it has names, links or declared sizes that are
    refused.
    """
    if not is_file(path):
        raise InputError(f"{path} is not a file; {_NOT_A_PACK}")
    with wrap_read_errors(path, _NOT_A_PACK), zipfile.ZipFile(path) as archive:
        return _checked_manifest(archive, path)


def unpack(path: Path, folder: Path, trust: bool = False) -> dict[str, Any]:
    """Unpacks a pack into a new folder; returns its manifest.

    The folder is created or filled only after everything was written and checked.

    Args:
        path: The pack.
        folder: A folder that does not exist, or is empty.
        trust: Also takes policies that may run code when they are loaded.

    Raises:
        InputError: an error of `read_manifest`; a file differs from its declaration; the folder exists and is not
            empty; or the pack has a policy that may run code and is not trusted.
        OSError: the folder cannot be written.
    """
    manifest = read_manifest(path)
    zips = [name for name in manifest["files"] if name.endswith(".zip")]
    if zips and not trust:
        raise InputError(
            f"{path} has {zips[0]}, which may run code when it is loaded; if you trust its sender, twin unpack --trust"
        )
    is_there = exists(folder)
    beside = folder if is_there else folder.parent
    _remove_abandoned(beside, glob.escape(folder.name[:80]))
    if is_there and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder} exists; give a folder that does not")
    beside.mkdir(parents=True, exist_ok=True)
    try:
        with _partial_folder(beside, folder.name[:80]) as partial:
            with wrap_read_errors(path, _CURE), zipfile.ZipFile(path) as archive:
                for name, facts in manifest["files"].items():
                    target = partial / name
                    target.parent.mkdir(parents=True, exist_ok=True)
                    _extract(archive, name, facts, target)
            _check_contents(partial, path)
            (partial / PACK_JSON).write_bytes(json.dumps(manifest, indent=1).encode())
            if is_there:  # not replaced, since it may be the working folder or a link
                _move_contents(partial, folder)
            else:
                partial.chmod(0o755)
                partial.rename(folder)
    except InputError as error:
        if isinstance(error.__cause__, OSError):
            raise error.__cause__ from None  # the disk failed, for example it is full; the pack is not damaged
        raise
    return manifest


def _move_contents(partial: Path, folder: Path) -> None:
    """Moves everything in `partial` into an empty folder, or nothing if it is interrupted.

    `scene.toml`, by which a folder is a scene, comes last, and `PACK_JSON` first, in case that the process is killed.
    """
    last = SceneDir(folder).config_file.name
    names = sorted((one.name for one in partial.iterdir()), key=lambda name: (name == last, name != PACK_JSON))
    moved = []
    try:
        for name in names:
            moved.append(folder / name)
            (partial / name).rename(folder / name)
    except BaseException:
        for one in moved:
            remove(one)
        raise


@contextlib.contextmanager
def _partial_folder(beside: Path, name: str) -> Iterator[Path]:
    """Yields a new folder in `beside`, which is removed at the end unless it was renamed.

    A lock tells other processes that it is in use, see `_remove_abandoned`.
    """
    partial = _partial_path(beside, name)
    with exclusive_lock(partial.with_suffix(".lock"), f"{partial} is being written"):
        try:
            partial.mkdir(0o700)
            yield partial
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def _partial_path(beside: Path, name: str) -> Path:
    """A new name in `beside` that `_remove_abandoned` finds."""
    return beside / f".{name}.{secrets.token_hex(_TOKEN // 2)}{_PARTIAL}"


def _remove_abandoned(beside: Path, name: str) -> None:
    """Removes folders in `beside` that killed processes left; `name` is a pattern for `glob`."""
    for left in beside.glob(f".{name}.{'?' * _TOKEN}{_PARTIAL}"):
        with (
            contextlib.suppress(InputError),  # a process holds the lock
            exclusive_lock(left.with_suffix(".lock"), f"{left} is being written"),
        ):
            shutil.rmtree(left, ignore_errors=True)


def _checked_manifest(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    entries = archive.infolist()
    if len(entries) > _MAX_FILES:
        raise InputError(f"{path} has {len(entries):,} files; expected at most {_MAX_FILES:,}")
    by_name = {entry.filename: entry for entry in entries}
    if len({name.lower() for name in by_name}) < len(entries):
        raise InputError(f"{path} has a name twice; {_CURE}")
    for entry in entries:
        kind, name = stat.S_IFMT(entry.external_attr >> 16), short_repr(entry.filename)
        if kind not in (0, stat.S_IFREG) or entry.is_dir():
            raise InputError(f"{path}: {name} is not a regular file; {_CURE}")
        if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(f"{path}: {name} is encrypted, or compressed by another method than deflate; {_CURE}")
    if MANIFEST not in by_name or by_name[MANIFEST].file_size > _MAX_MANIFEST:
        raise InputError(f"{path} has no {MANIFEST} of at most {_MAX_MANIFEST >> 20} MB; {_NOT_A_PACK}")
    with archive.open(MANIFEST) as file:  # `archive.read` would inflate more than the declared size before it looks
        text = file.read(by_name[MANIFEST].file_size).decode("utf-8")
    head = parse_json(text, f"{path}: {MANIFEST}")
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        raise InputError(f"{path}: no {FORMAT}; {_NOT_A_PACK}")
    if head.get("version") != VERSION:
        raise InputError(
            f"{path}: version {short_repr(head.get('version'))}, expected {VERSION}: it was written by another version "
            "of twin; use that version, or pack the scene again with this one"
        )
    if missing := {*head["files"], README, MANIFEST} ^ set(by_name):
        name = short_repr(min(missing))
        raise InputError(
            f"{path}: {name} is listed in {MANIFEST} but not in the pack, or in the pack but not listed; {_CURE}"
        )
    total = 0
    for name, facts in head["files"].items():
        if not PLACES.fullmatch(name):
            raise InputError(f"{path}: {short_repr(name)} is not a file of a scene; {_CURE}")
        size = facts["bytes"]
        if not isinstance(size, int) or not 0 <= size <= _MAX_FILE:
            raise InputError(f"{path}: {name} has {short_repr(size)} bytes; expected at most {_MAX_FILE:,}")
        if facts["coding"] not in (PLAIN, DIFFERENCES):
            coding = short_repr(facts["coding"])
            raise InputError(f"{path}: {name} has coding {coding}; expected {PLAIN} or {DIFFERENCES}; {_CURE}")
        if facts["coding"] == DIFFERENCES and not IS_BAKED.search(name):
            raise InputError(f"{path}: {name} has coding {DIFFERENCES}; expected {PLAIN}; {_CURE}")
        require_text(facts["sha256"])
        if by_name[name].file_size != size:
            raise InputError(
                f"{path}: {name} has {by_name[name].file_size:,} bytes; {MANIFEST} says otherwise; {_CURE}"
            )
        total += size
    bound = min(MAX_TOTAL, max(_FREE, _MAX_RATIO * path.stat().st_size))
    if total > bound:
        raise InputError(f"{path} unpacks to {total:,} bytes; expected at most {bound:,} for a file of its size")
    head["name"] = require_text(head["name"])
    head["policies"] = list(map(require_text, head["policies"]))
    for name in head["policies"]:
        if _policy_file(name) not in head["files"]:
            raise InputError(f"{path}: policy {short_repr(name)} is not in the pack; {_CURE}")
    return head


def _policy_file(name: str) -> str:
    """The file in a pack for the name of a policy: `run`, `run/checkpoint` or `policies/file`."""
    if name.startswith("policies/"):
        return name
    run, _, checkpoint = name.partition("/")
    return f"runs/{run}/checkpoints/{checkpoint}/policy.json" if checkpoint else f"runs/{run}/policy.json"


def _extract(archive: zipfile.ZipFile, name: str, facts: dict[str, Any], target: Path) -> None:
    left = facts["bytes"]
    with archive.open(name) as source, target.open("xb") as file:
        while block := source.read(_CHUNK):
            left -= len(block)
            if left < 0:
                raise ValueError(f"{name} is longer than declared")
            file.write(block)
    if left:
        raise ValueError(f"{name} is {left:,} bytes shorter than declared")
    if facts["coding"] == DIFFERENCES:
        mapped = np.memmap(target, np.uint8, "r+")  # so that the content need not be in memory
        decode_differences(mapped)
        mapped.flush()
        del mapped
    if digest_file(target) != facts["sha256"]:
        raise ValueError(f"{name} is not as it was packed")


def _check_contents(root: Path, path: Path) -> None:
    """Raises InputError if a file of the scene refers to a file outside it, or if `scene.xml` has entities."""
    scene = SceneDir(root)
    xml = scene.stage("mjcf") / SCENE_XML
    try:
        content = read_text(xml) if xml.exists() else ""  # UTF-8, as MuJoCo reads it, whatever encoding it declares
        config = load_config(scene.config_file)
        cameras = Cameras.load(scene.stage("metric"))
        folders = [os.path.relpath(one, scene.build.resolve()) for one in (cameras.images, cameras.masks) if one]
    except ValueError as error:  # also InputError
        raise InputError(f"{path}: {str(error).replace(f'{root}{os.sep}', '')}") from None
    inputs = (one for source in config.source for one in (source.path, source.images, source.mask) if one)
    read = (*folders, *cameras.names, *inputs)
    bad = next((one for one in read if one.startswith("/") or ".." in one.split("/")), None)
    if bad is None and content:
        for mark in _XML_MARKS:
            if mark in content:
                raise InputError(f"{path}: {SCENE_XML} has {mark}; expected a document without; {_CURE}")
        with wrap_read_errors(path, _CURE):
            for element in ElementTree.fromstring(content).iter():
                paths = [element.get(key, "x") for key in _XML_PATHS]
                if element.tag in _XML_REFUSED or not all(re.fullmatch(_N, one) for one in paths):
                    bad = f"<{element.tag}> of {SCENE_XML}"
    if bad is not None:
        raise InputError(f"{path}: {short_repr(bad)} names a file outside the scene; {_CURE}")


# ---- packs used instead of scene folders


def open_scene(path: Path) -> Path:
    """Returns the folder of a scene: `path` itself; for a pack or its name, the cache folder into which it is unpacked.

    A pack is unpacked once, into a folder in `$XDG_CACHE_HOME/twin/packs` that is named after its digest; again if that
    folder has been damaged. Several processes may do so at once, but only one removes a damaged folder.

    Raises InputError: see `unpack`; or another process is removing the damaged folder.
    """
    pack = find_pack(path)
    if pack is None:
        return path
    folder = _cache() / f"{pack.stem[:60]}-{digest_file(pack)[:32]}"
    if exists(folder) and not _is_whole(folder):
        with exclusive_lock(folder.with_name(f".{folder.name}.lock"), f"{folder}, which is damaged, is being removed"):
            if exists(folder) and not _is_whole(folder):  # else another process was faster
                runtime.log_line(f"{folder} is damaged; {pack} is unpacked again")
                damaged = _partial_path(folder.parent, folder.name[:80])
                with wrap_read_errors(folder, "remove it"):
                    folder.rename(damaged)  # at once, so that no other process sees half of it
                remove(damaged)
    if not (folder / PACK_JSON).exists():
        _remove_abandoned(folder.parent, "*")
        try:
            unpack(pack, folder)
        except (InputError, OSError):
            if not (folder / PACK_JSON).exists():  # else another process was faster
                raise
    return folder


def _is_whole(folder: Path) -> bool:
    """True if a folder has the files of its pack as they were packed; those above `MAX_HASHED` are compared by size."""
    try:
        files = read_json(folder / PACK_JSON)["files"]
        for name, facts in files.items():
            size = (folder / name).stat().st_size
            if size != facts["bytes"] or (size <= MAX_HASHED and digest_file(folder / name) != facts["sha256"]):
                return False
    except (InputError, OSError, KeyError, TypeError, AttributeError):  # also for a damaged `PACK_JSON`
        return False
    return True


def find_pack(path: Path) -> Path | None:
    """The pack at a path, or with a name such as `demo`; None if there is none.

    Names are searched in the working folder, in its `scenes/`, and in `scenes/` of twin's repository.
    """
    if is_file(path):
        return path if path.suffix == SUFFIX or zipfile.is_zipfile(path) else None
    if exists(path) or len(path.parts) != 1:
        return None
    return next((one for place in _SEARCHED if is_file(one := place / f"{path.name}{SUFFIX}")), None)


def place_names() -> list[str]:
    """Names that `find_pack` finds, and scene folders beside these packs."""
    packs = {path.stem for place in _SEARCHED for path in place.glob(f"*{SUFFIX}")}
    return sorted(packs | {str(path.parent) for place in _SEARCHED[:2] for path in place.glob("*/scene.toml")})


def is_cached(root: Path) -> bool:
    """True for a scene folder in the cache of packs, to which no results may be written."""
    return root.parent == _cache()


def _cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if home.startswith("/") else Path.home() / ".cache") / "twin" / "packs"


def packed_policies(root: Path) -> list[str]:
    """Names of the policies that came in a scene's pack; empty for a scene that was built here.

    Only names of files in the scene: another name, such as `module:function`, would run code.
    """
    path, names = root / PACK_JSON, []
    if path.exists():
        with wrap_read_errors(path, _CURE):
            names = list(map(require_text, read_json(path)["policies"]))
    files = {name: _policy_file(name) for name in names}
    return [name for name, file in files.items() if PLACES.fullmatch(file) and (root / file).is_file()]


def command(given: argparse.Namespace) -> None:
    """Runs `twin unpack` with the options parsed by `twin.commands`."""
    manifest = unpack(find_pack(given.pack) or given.pack, given.folder, given.trust)
    if not given.quiet:
        policies = f", with the policies {', '.join(manifest['policies'])}" if manifest["policies"] else ""
        print(f"{given.folder}: {manifest['name']}{policies}; drive in it: twin drive {shlex.quote(str(given.folder))}")


if __name__ == "__main__":
    sys.exit(commands.main("unpack"))
