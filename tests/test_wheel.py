"""The wheel: contains all of the package, and works outside the checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from twin.commands import VERBS

_ROOT = Path(__file__).resolve().parents[1]
_QUICK = ("nerf.steps=80", "nerf.rays=1024", "nerf.max_width=160", "nerf.bake_steps=20", "nerf.max_bricks=1200")
_QUICK += ("nerf.detail_passes=0", "mesh.voxel=0.2", "review.fps=3", "review.width=160", "review.renders=12")
_DRIVE = """
import twin
environment = twin.load("place", "route", seed=0)
environment.reset()
step = environment.step([0.5, 0.0])
print(step.observation["pixels"].shape, twin.__file__)
"""


def _tracked() -> list[str]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=_ROOT, check=True, capture_output=True, text=True).stdout
    return [name for name in listing.split("\0") if name and (_ROOT / name).exists()]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # From a copy of the tracked files: pip leaves a folder `build` behind, whose old files would get into the wheel.
    copy, out = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("wheel")
    for name in _tracked():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(_ROOT / name, copy / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", out, copy]
    subprocess.run(pip, check=True)
    (path,) = out.glob("*.whl")
    return path


def test_contains_every_file_of_the_packages(wheel: Path) -> None:
    expected = {name.removeprefix("ros2/twin_policy/") for name in _tracked()}
    expected = {name for name in expected if name.startswith(("twin/", "twin_policy/"))}
    found = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert found == expected


@pytest.mark.slow
def test_films_builds_and_drives_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site, folder = tmp_path / "site", tmp_path / "elsewhere"
    folder.mkdir()
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", site, wheel]
    subprocess.run(pip, check=True)
    # The dependencies are those of this environment; `twin` is the wheel's, as PYTHONPATH comes first.
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def python(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, (arguments, done.stderr[-3000:])
        return done.stdout

    for verb in VERBS:
        assert f"usage: twin {verb}" in python("-m", "twin", verb, "--help")
    python("-m", "twin", "reality", "film", "--tiny", "--out", "place")
    python("-m", "twin", "build", "place", *(word for setting in _QUICK for word in ("--set", setting)))
    assert (folder / "place/build/report.html").exists() and (folder / "place/build/review.mp4").exists()
    assert python("-c", _DRIVE).split(") ") == ["(4, 90, 160, 3", f"{site / 'twin' / '__init__.py'}\n"]
