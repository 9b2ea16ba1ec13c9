"""Paths of a scene folder, and the stamps of build stages.

scenes/<name>/
  scene.toml            settings; the only file that is written by hand
  robot.toml            optional: robot parameters, as in `[robot]` of scene.toml
  input/                films or photos; only `twin.new` writes here
  build/
    1_capture/ ... 6_review/   one folder per stage, written as `<folder>.partial` and renamed when done
    report.json report.html review.mp4
  lightings/            <name>.json and .png: lightings fitted to photos of the built place
  validation/           episodes.csv, cells.csv, validation.html, films/: policies evaluated in the twin
  forecast/             forecast.json .csv .html: forecast of success on the real road

A stage's *key* is the hash of everything on which its result depends: its config sections, the digests of its input
files, the *results* (content digests) of its upstream stages, its version and the seed. A stage folder is up to date if
its stamp has the current key and its files match the stamp. Package versions are recorded, but are not part of the key.
"""

import os
import re
import shlex
import shutil
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from twin.errors import InputError
from twin.files import (
    atomic_path,
    digest_file,
    digest_json,
    json_bytes,
    read_json,
    regular_file,
    remove,
    wrap_read_errors,
    write_bytes,
)

STAGE_FOLDERS: dict[str, str] = {
    "capture": "1_capture",
    "cameras": "2_cameras",
    "metric": "2_metric",
    "field": "3_field",
    "mesh": "4_mesh",
    "mjcf": "5_mjcf",
    "review": "6_review",
}
"""Stage name → folder under `build/`, in running order. `twin.build.PIPELINE` defines the stages."""

PACK_JSON = "pack.json"
"""File that marks a scene folder as unpacked from a pack (`twin.unpack`); such a folder has only what driving needs."""


@dataclass(frozen=True)
class SceneDir:
    """The paths of one scene."""

    root: Path

    @property
    def config_file(self) -> Path:
        return self.root / "scene.toml"

    @property
    def build(self) -> Path:
        return self.root / "build"

    def stage(self, name: str) -> Path:
        """The finished folder of a stage."""
        return self.build / STAGE_FOLDERS[name]

    def partial(self, name: str) -> Path:
        """The folder to which a running stage writes."""
        return self.build / f"{STAGE_FOLDERS[name]}.partial"

    @property
    def report_json(self) -> Path:
        return self.build / "report.json"

    @property
    def report_html(self) -> Path:
        return self.build / "report.html"

    @property
    def truth_json(self) -> Path:
        """Comparison with the known truth, for generated scenes only."""
        return self.build / "truth.json"

    @property
    def review_mp4(self) -> Path:
        return self.build / "review.mp4"

    @property
    def lightings(self) -> Path:
        """Folder of the lightings added to the built field; kept outside `build/`, which may be deleted."""
        return self.root / "lightings"

    @property
    def validation(self) -> Path:
        return self.root / "validation"

    @property
    def episodes_csv(self) -> Path:
        """Table with one row per trial in the twin; for its columns see `twin.evaluation.trials`."""
        return self.validation / "episodes.csv"

    @property
    def cells_csv(self) -> Path:
        """Table of trials aggregated by policy, task and lighting."""
        return self.validation / "cells.csv"

    @property
    def forecast(self) -> Path:
        return self.root / "forecast"

    @property
    def truth(self) -> Path:
        """Ground truth of a generated scene (`truth/truth.npz`); no stage may read it."""
        return self.root / "truth"

    @property
    def has_route(self) -> bool:
        return (self.stage("mjcf") / "world.json").exists()


MAX_NAME = 80
"""Largest number of characters in a name that becomes part of a file name. File names may have 255 bytes, including the
suffixes that twin appends."""
_NAME = re.compile(r"\w[\w.-]*")


def check_name(name: str, what: str) -> str:
    """Returns `name` if it is a valid name for a file or folder: letters, digits and `_ . -`.

    Raises InputError for any other name, such as a path. The message begins with `what`, the option that gives the
    name, such as `--run`.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"{what} {name!r}: expected a name of letters, digits and _ . - only, no path")
    if len(name) > MAX_NAME or len(name.encode()) > 2 * MAX_NAME:
        raise InputError(f"{what} {name!r}: {len(name)} characters; expected at most {MAX_NAME}")
    return name


def run_folder(scene: SceneDir, name: str) -> Path:
    """The folder of a training run. Raises InputError for an invalid name."""
    return scene.root / "runs" / check_name(name, "--run")


# ---- stamps

MAX_HASHED = 256 << 20
"""Largest file that is hashed when a scene is opened [bytes]."""
_PACKAGES = ("twin", "numpy", "torch", "warp-lang", "mujoco", "mujoco-warp", "pycolmap", "coacd", "av", "scipy")


@dataclass(frozen=True)
class Stamp:
    """The contents of `stamp.json`."""

    stage: str
    key: str
    """Hash of `depends`."""
    result: str
    """Hash of the stage's files."""
    depends: dict[str, Any]
    """Dependencies of the stage: version, seed, config, inputs, upstream."""
    files: dict[str, int]
    """Sizes [bytes] of the stage's files by path relative to its folder."""
    metrics: dict[str, Any]
    """Numbers for the report."""
    seconds: float
    peak_memory_bytes: int
    device: str
    packages: dict[str, str]
    sha256: dict[str, str] = field(default_factory=dict)
    """Digest of every file. Older stamps have no such digests; their folders are compared with `result` instead."""
    itself: str = ""
    """Digest of all other fields; empty in older stamps."""

    def save(self, folder: Path) -> None:
        write_bytes(folder / "stamp.json", self.content())

    def content(self) -> bytes:
        return json_bytes(asdict(replace(self, itself=self._digest())))

    @staticmethod
    def load(folder: Path) -> "Stamp | None":
        """The stamp of a finished stage folder; None if it is missing, damaged, or does not match the files."""
        try:
            return Stamp.verified(folder)
        except InputError:
            return None

    @staticmethod
    def verified(folder: Path, max_hashed: int | None = None) -> "Stamp":
        """The stamp of a finished stage folder. Raises InputError if it is missing or does not match the files.

        Files larger than `max_hashed` [bytes] are compared by size only.
        """
        cure = _cure(folder)
        stamp = Stamp._read(folder)
        with wrap_read_errors(folder / "stamp.json", cure):
            for name, size in stamp.files.items():
                stamp._check(folder / name, name, int(size), max_hashed, cure)
            if not stamp.sha256 and digest_folder(folder)[0] != stamp.result:
                raise InputError(f"{folder} is damaged (its files are not as they were written); {cure}")
        return stamp

    @staticmethod
    def _read(folder: Path) -> "Stamp":
        """The stamp itself; the files are not looked at. Raises InputError if it is missing or damaged."""
        path = folder / "stamp.json"
        with wrap_read_errors(path, _cure(folder)):
            stamp = Stamp(**read_json(path))
            if stamp.itself and stamp.itself != stamp._digest():
                raise ValueError("it is not as it was written")
        return stamp

    def _check(self, file: Path, name: str, size: int, max_hashed: int | None, cure: str) -> None:
        if not file.is_file():
            raise InputError(f"{file} is missing; {cure}")
        small = max_hashed is None or size <= max_hashed
        if file.stat().st_size != size or (name in self.sha256 and small and digest_file(file) != self.sha256[name]):
            raise InputError(f"{file} is damaged (it is not as it was written); {cure}")

    def _digest(self) -> str:
        return digest_json({name: value for name, value in asdict(self).items() if name != "itself"})


def _cure(folder: Path) -> str:
    """The advice on a damaged stage folder."""
    root = folder.resolve().parents[1]
    again = f"unpack the pack of {root} into another folder, and move your runs and results there"
    return again if (root / PACK_JSON).exists() else "build the scene again"


def digest_folder(folder: Path) -> tuple[str, dict[str, int], dict[str, str]]:
    """Content digest of a folder, and size [bytes] and digest of each file in it."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "stamp.json")
    sizes = {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}
    digests = {name: digest_file(folder / name) for name in sizes}
    return digest_json([list(digests), list(digests.values())]), sizes, digests


def write_stamp(folder: Path, stage: str, depends: dict[str, Any] | None = None, **more: Any) -> Stamp:
    """Writes the stamp of a stage folder for the files that are in it now.

    `more` has further fields of `Stamp`: metrics, seconds, peak_memory_bytes, device.
    """
    depends = depends or {}
    result, files, sha256 = digest_folder(folder)
    fields = {"metrics": {}, "seconds": 0.0, "peak_memory_bytes": 0, "device": "auto", **more}
    stamp = Stamp(
        stage, digest_json(depends), result, depends, files, packages=package_versions(), sha256=sha256, **fields
    )
    stamp.save(folder)
    return stamp


@lru_cache(maxsize=64)
def _read_once(folder: Path, _stamped: tuple[int, int]) -> Stamp:
    return Stamp._read(folder)


@lru_cache(maxsize=64)
def _verified_once(folder: Path, _stamped: tuple[int, int]) -> Stamp:
    return Stamp.verified(folder, MAX_HASHED)


def _verified_stamp(scene: SceneDir, stage: str) -> Stamp:
    folder = scene.stage(stage).resolve()
    path, name = folder / "stamp.json", STAGE_FOLDERS[stage]
    if not path.exists() and (scene.root / PACK_JSON).exists():
        raise InputError(f"{scene.root} comes from a pack, which has neither {name} nor films; ask its sender for them")
    if not path.exists():
        raise InputError(f"{scene.root} has no {name} yet; run twin build {shlex.quote(str(scene.root))}")
    facts = regular_file(path).stat()
    return _verified_once(folder, (facts.st_mtime_ns, facts.st_size))


def require_stage(scene: SceneDir, stage: str) -> Path:
    """Returns the folder of a built stage, after comparing its files with its stamp (once per process).

    Files larger than 256 MiB are compared by size only. A build hashes every file, and so finds all changes.

    Raises:
        InputError: the stage has not been built, one of its files is damaged, or a stage on which it depends was built
            again since, as after an interrupted build.
    """
    _check_upstream(scene, stage, _verified_stamp(scene, stage))
    return scene.stage(stage)


def _check_upstream(scene: SceneDir, stage: str, stamp: Stamp) -> None:
    """Raises InputError if the stages on which a stage depends are not those from which it was built."""
    order = list(STAGE_FOLDERS)
    for name in order[: order.index(stage)]:
        path = scene.stage(name).resolve() / "stamp.json"
        with wrap_read_errors(scene.stage(stage) / "stamp.json", _cure(scene.stage(stage))):
            result = dict(stamp.depends.get("upstream", {})).get(name)
        if result is None or not path.exists():
            continue
        facts = regular_file(path).stat()
        upstream = _read_once(path.parent, (facts.st_mtime_ns, facts.st_size))
        if upstream.result != result:
            raise InputError(
                f"{scene.root}: {STAGE_FOLDERS[stage]} was built from an earlier {STAGE_FOLDERS[name]}, as after an "
                f"interrupted build; run twin build {shlex.quote(str(scene.root))}"
            )
        _check_upstream(scene, name, upstream)


def stage_result(scene: SceneDir, stage: str) -> str:
    """Content digest of a built stage. Raises InputError: the stage has not been built, or it is damaged."""
    return _verified_stamp(scene, stage).result


def package_versions() -> dict[str, str]:
    """Versions of the packages that affect results."""
    return {name: metadata.version(name) for name in _PACKAGES}


def commit_stage(scene: SceneDir, stage: str) -> None:
    """Replaces a stage's folder by its complete partial folder; `recover_stages` repairs an interrupted call."""
    partial, final = scene.partial(stage), scene.stage(stage)
    old = final.with_name(final.name + ".old")
    remove(old)
    if final.exists():
        final.rename(old)
    partial.rename(final)
    remove(old)


def recover_stages(scene: SceneDir) -> None:
    """Cleans up after a killed build: removes partial folders, and restores results that were being replaced."""
    for stage in STAGE_FOLDERS:
        final = scene.stage(stage)
        old = final.with_name(final.name + ".old")
        if old.exists() and not final.exists():
            old.rename(final)
        remove(old)
        remove(scene.partial(stage))
        if final.is_symlink() or final.is_file():
            remove(final)


def replace_file(source: Path, target: Path) -> None:
    """Replaces `target` atomically by a hard link to `source`, or by a copy if the file system has no hard links."""
    if target.exists() and target.samefile(source):  # to rename one link to another would leave both names
        return
    with atomic_path(target) as partial:
        partial.unlink(missing_ok=True)
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)
