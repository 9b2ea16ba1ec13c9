"""A scene folder: every path named once, and the stamp that says what made an artifact.

scenes/<name>/
  scene.toml            the only hand-written file
  robot.toml            where there is one: what differs on the robot, as `[robot]` of scene.toml
  input/                films or photos, never written by twin
  build/
    1_capture/ ... 6_review/   one folder per stage, written aside as `<folder>.partial` and renamed when done
    report.json report.html review.mp4
  lightings/            <name>.json and .png: lightings fitted to photos of the built place
  validation/           episodes.csv, cells.csv, validation.html, films/: policies driven in the twin
  forecast/             forecast.json .csv .html: what that says about the real runs
"""

import os
import re
import shutil
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from twin.errors import InputError
from twin.files import aside, damaged, digest_file, digest_json, read_json, regular, remove, write_json

STAGES: dict[str, str] = {
    "capture": "1_capture",
    "cameras": "2_cameras",
    "metric": "2_metric",
    "field": "3_field",
    "mesh": "4_mesh",
    "mjcf": "5_mjcf",
    "review": "6_review",
}
"""Stage name → folder under `build/`, in the order they run."""


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
        return self.build / STAGES[name]

    def partial(self, name: str) -> Path:
        """The folder a stage is being written to."""
        return self.build / f"{STAGES[name]}.partial"

    def stamp(self, name: str) -> Path:
        return self.stage(name) / "stamp.json"

    @property
    def report_json(self) -> Path:
        return self.build / "report.json"

    @property
    def report_html(self) -> Path:
        return self.build / "report.html"

    @property
    def truth_json(self) -> Path:
        """The comparison with the known truth, of generated places."""
        return self.build / "truth.json"

    @property
    def review_mp4(self) -> Path:
        return self.build / "review.mp4"

    @property
    def lightings(self) -> Path:
        """Lightings added to the built field; outside `build/`, which may be deleted."""
        return self.root / "lightings"

    @property
    def validation(self) -> Path:
        return self.root / "validation"

    @property
    def episodes_csv(self) -> Path:
        """One row per trial in the twin; columns in `twin.evaluation.trials`."""
        return self.validation / "episodes.csv"

    @property
    def cells_csv(self) -> Path:
        """The same, summed up by policy, task and lighting."""
        return self.validation / "cells.csv"

    @property
    def forecast(self) -> Path:
        return self.root / "forecast"

    @property
    def truth(self) -> Path:
        """Known truth of a synthetic scene (`truth/truth.npz`). Only reports and tests may read it, never a stage."""
        return self.root / "truth"

    @property
    def has_route(self) -> bool:
        return (self.stage("mjcf") / "world.json").exists()


_NAME = re.compile(r"\w[\w.-]*")
_LONGEST_NAME = 80  # characters; with what is added to it, a file system takes 255 bytes


def check_name(name: str, what: str) -> str:
    """A name that becomes that of a file or folder.

    Args:
        name: Letters, digits and `_ . -`, the first a letter, a digit or `_`; at most 80 characters.
        what: What it is the name of, such as `--run`, to open the message.

    Raises:
        InputError: it is something else, such as a path.
    """
    if not _NAME.fullmatch(name):
        raise InputError(f"{what} {name!r}: expected a name of letters, digits and _ . - only, no path")
    if len(name) > _LONGEST_NAME or len(name.encode()) > 2 * _LONGEST_NAME:
        raise InputError(f"{what} {name!r}: {len(name)} characters; expected at most {_LONGEST_NAME}")
    return name


def run_folder(scene: SceneDir, name: str) -> Path:
    """The folder of a training run. Raises InputError where the name is none; see `check_name`."""
    return scene.root / "runs" / check_name(name, "--run")


# ---- What made an artifact, and whether it would be made the same way again.
#
# A stage's *key* is the hash of everything its result depends on: its config sections, the digests of its input files,
# the *results* (content digests) of its upstream stages, its version and the seed. A stage folder whose stamp carries
# the present key, and whose files are all as they were written, is up to date. Package versions are recorded, but are
# not in the key.


_CURE = "build the scene again"
_MOST_READ = 256 << 20  # [bytes] of a file that is compared when a scene is opened
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
    sha256: dict[str, str] = field(default_factory=dict)
    """Digest of every file; empty in stamps of before, whose folders are compared with `result` as a whole."""
    itself: str = ""
    """Digest of all of the above; empty in stamps of before."""

    def save(self, folder: Path) -> None:
        stamp = replace(self, itself=self._digest())
        write_json(folder / "stamp.json", asdict(stamp))

    @staticmethod
    def load(folder: Path) -> "Stamp | None":
        """The stamp of a finished stage folder, or None where it is missing, damaged, or does not fit its files.

        Every file is read.
        """
        try:
            return Stamp.checked(folder)
        except InputError:
            return None

    @staticmethod
    def checked(folder: Path, most: int | None = None) -> "Stamp":
        """The stamp of a finished stage folder, which fits its files.

        Args:
            folder: Of the stage.
            most: Of files larger than this only the size is compared [bytes]; None: all are read.

        Raises:
            InputError: names the file that is damaged or missing.
        """
        path = folder / "stamp.json"
        with damaged(path, _CURE):
            read = read_json(path)
            stamp = Stamp(**read)
            if stamp.itself and stamp.itself != stamp._digest():
                raise ValueError("it is not as it was written")
            for name, size in stamp.files.items():
                stamp._check(folder / name, name, int(size), most)
            if not stamp.sha256 and digest_folder(folder)[0] != stamp.result:
                raise InputError(f"{folder} is damaged (its files are not as they were written); {_CURE}")
        return stamp

    def _check(self, file: Path, name: str, size: int, most: int | None) -> None:
        if not file.is_file():
            raise InputError(f"{file} is missing; {_CURE}")
        small = most is None or size <= most
        if file.stat().st_size != size or (name in self.sha256 and small and digest_file(file) != self.sha256[name]):
            raise InputError(f"{file} is damaged (it is not as it was written); {_CURE}")

    def _digest(self) -> str:
        return digest_json({name: value for name, value in asdict(self).items() if name != "itself"})


def key_of(depends: dict[str, Any]) -> str:
    return digest_json(depends)


def digest_folder(folder: Path) -> tuple[str, dict[str, int], dict[str, str]]:
    """Content digest of a folder, and its files with their sizes [bytes] and with their digests."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "stamp.json")
    names = [path.relative_to(folder).as_posix() for path in files]
    digests = [digest_file(path) for path in files]
    sizes = [path.stat().st_size for path in files]
    return (
        digest_json([names, digests]),
        dict(zip(names, sizes, strict=True)),
        dict(zip(names, digests, strict=True)),
    )


def seal(folder: Path, stage: str, depends: dict[str, Any] | None = None, **more: Any) -> Stamp:
    """Stamps a stage folder with what is in it now.

    Args:
        folder: Of the stage.
        stage: Its name.
        depends: What went into the key.
        more: Fields of `Stamp`: metrics, seconds, peak_memory_bytes, device.
    """
    depends = depends or {}
    result, files, sha256 = digest_folder(folder)
    about = {"metrics": {}, "seconds": 0.0, "peak_memory_bytes": 0, "device": "auto", **more}
    stamp = Stamp(stage, key_of(depends), result, depends, files, packages=package_versions(), sha256=sha256, **about)
    stamp.save(folder)
    return stamp


@lru_cache(maxsize=64)
def _finished(folder: Path, _stamped: tuple[int, int]) -> Stamp:
    return Stamp.checked(folder, _MOST_READ)


def finished(scene: SceneDir, stage: str) -> Path:
    """The folder of a stage that has been built and is as it was written.

    A process compares the files of a stage once. Files above 256 MiB are compared by size alone: a change that keeps
    their size is found by the next build, which reads everything.

    Raises:
        InputError: the stage has not been built, or a file of it is damaged.
    """
    folder = scene.stage(stage).resolve()
    path = folder / "stamp.json"
    if not path.exists():
        raise InputError(f"{scene.root} has no {STAGES[stage]} yet; run python -m twin.build {scene.root}")
    facts = regular(path).stat()
    _finished(folder, (facts.st_mtime_ns, facts.st_size))
    return scene.stage(stage)


def result_of(scene: SceneDir, stage: str) -> str:
    """What the result of a built stage is known by. Raises InputError: see `finished`."""
    finished(scene, stage)
    facts = scene.stamp(stage).stat()
    return _finished(scene.stage(stage).resolve(), (facts.st_mtime_ns, facts.st_size)).result


def package_versions() -> dict[str, str]:
    """Installed versions of what decides a result."""
    return {name: metadata.version(name) for name in _PACKAGES}


def commit(scene: SceneDir, stage: str) -> None:
    """Puts the partial folder of a stage, stamped, in the place of the former one.

    A kill between the two renames leaves the former folder as `<folder>.old`; `recover` puts it back.
    """
    partial, final = scene.partial(stage), scene.stage(stage)
    old = final.with_name(final.name + ".old")
    remove(old)
    if final.exists():
        final.rename(old)
    partial.rename(final)
    remove(old)


def recover(scene: SceneDir) -> None:
    """Clears what a killed build left: half-written folders go, a former result that was being replaced returns."""
    for stage in STAGES:
        final = scene.stage(stage)
        old = final.with_name(final.name + ".old")
        if old.exists() and not final.exists():
            old.rename(final)
        remove(old)
        remove(scene.partial(stage))
        if final.is_symlink() or final.is_file():
            remove(final)


def replace_file(source: Path, target: Path) -> None:
    """Puts a copy of `source` at `target` in one step (a hard link where the file system has them)."""
    with aside(target) as partial:
        partial.unlink(missing_ok=True)
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)
