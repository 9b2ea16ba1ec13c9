"""What made an artifact, and whether it would be made the same way again.

A stage's *key* is the hash of everything its result depends on: its config sections, the digests of its input files,
the *results* (content digests) of its upstream stages, its version and the seed. A stage folder whose stamp carries
the present key, and whose files are all there, is up to date. Package versions are recorded, but are not in the key.
"""

import os
import shutil
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from twin.scene import STAGES, SceneDir, digest_file, digest_json, read_json, write_json

_PACKAGES = ("twin", "numpy", "torch", "warp-lang", "mujoco", "mujoco-warp", "pycolmap", "coacd", "av", "scipy")


@dataclass(frozen=True)
class Stamp:
    """The contents of `stamp.json`."""

    stage: str
    key: str
    """Hash of what the stage depends on."""
    result: str
    """Hash of the files the stage made."""
    depends: dict[str, Any]
    """What went into the key: version, seed, config, inputs, upstream."""
    files: dict[str, int]
    """Every file the stage made, relative to its folder, and its size [bytes]."""
    metrics: dict[str, Any]
    """The stage's numbers for the report."""
    seconds: float
    peak_memory_bytes: int
    device: str
    packages: dict[str, str]

    def save(self, folder: Path) -> None:
        write_json(folder / "stamp.json", asdict(self))

    @staticmethod
    def load(folder: Path) -> "Stamp | None":
        """The stamp of a finished stage folder, or None where it is missing, damaged, or does not fit its files."""
        try:
            stamp = Stamp(**read_json(folder / "stamp.json"))
            complete = all((folder / name).stat().st_size == size for name, size in stamp.files.items())
        except (OSError, ValueError, TypeError):
            return None
        return stamp if complete else None


def key_of(depends: dict[str, Any]) -> str:
    return digest_json(depends)


def digest_folder(folder: Path) -> tuple[str, dict[str, int]]:
    """Content digest of a folder, and its files with their sizes."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "stamp.json")
    names = [path.relative_to(folder).as_posix() for path in files]
    digests = [digest_file(path) for path in files]
    return digest_json([names, digests]), dict(zip(names, (path.stat().st_size for path in files), strict=True))


def package_versions() -> dict[str, str]:
    """Installed versions of what decides a result."""
    return {name: metadata.version(name) for name in _PACKAGES}


def commit(scene: SceneDir, stage: str, stamp: Stamp) -> None:
    """Stamps the partial folder of a stage and puts it in the place of the former one.

    A kill between the two renames leaves the former folder as `<folder>.old`; `recover` puts it back.
    """
    partial, final = scene.partial(stage), scene.stage(stage)
    old = final.with_name(final.name + ".old")
    stamp.save(partial)
    shutil.rmtree(old, ignore_errors=True)
    if final.exists():
        final.rename(old)
    partial.rename(final)
    shutil.rmtree(old, ignore_errors=True)


def recover(scene: SceneDir) -> None:
    """Clears what a killed build left: half-written folders go, a former result that was being replaced returns."""
    for stage in STAGES:
        final = scene.stage(stage)
        old = final.with_name(final.name + ".old")
        if old.exists() and not final.exists():
            old.rename(final)
        shutil.rmtree(old, ignore_errors=True)
        shutil.rmtree(scene.partial(stage), ignore_errors=True)


def replace_file(source: Path, target: Path) -> None:
    """Puts a copy of `source` at `target` in one step (a hard link where the file system has them)."""
    aside = target.with_name(target.name + ".partial")
    aside.unlink(missing_ok=True)
    try:
        os.link(source, aside)
    except OSError:
        shutil.copyfile(source, aside)
    aside.replace(target)
