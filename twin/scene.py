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

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


def digest_file(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_json(value: Any) -> str:
    """SHA-256 of a JSON value in canonical form."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def write_text(path: Path, text: str) -> None:
    """Writes a text aside and renames it, so that a reader never sees half a file."""
    aside = path.with_name(path.name + ".partial")
    aside.write_text(text, encoding="utf-8")
    aside.replace(path)


def write_json(path: Path, value: Any) -> None:
    """Writes JSON as `write_text` does. NaN is refused."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
