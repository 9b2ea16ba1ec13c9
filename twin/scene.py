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

import re
from dataclasses import dataclass
from pathlib import Path

from twin.errors import InputError

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
        """One row per trial in the twin; columns in `twin.report.trials`."""
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
