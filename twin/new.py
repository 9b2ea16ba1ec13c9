"""Verb: start a scene folder from films.

    python -m twin.new scenes/my_road day.mp4 dusk.mp4 --camera-height 1.2

writes `scenes/my_road/scene.toml`, with every line a user is likely to want, and copies the films into `input/`.
`python -m twin.build scenes/my_road` builds it.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

from twin.capture.formats import detect_kind
from twin.capture.video import probe
from twin.errors import InputError, refuse
from twin.scene import SceneDir, digest_file, write_text

_HEAD = """\
# What twin.build knows of this place. Every other setting has a default: see twin/config.py.
name = {name}
"""

_SOURCE = """
[[source]]
path = {path}
lighting = {lighting}  # sources filmed under the same light may share a name
# mask = "input/mask.png"      # 0 = ignore: the robot's own bonnet, a person walking ahead; or a folder of masks
# A calibrated camera pays: forward driving bends a self-calibrated one. Lengths in pixels, of the upright picture.
# camera = {{ model = "PINHOLE", params = [fx, fy, cx, cy], width = 1920, height = 1080 }}
"""

_REST = """
[capture]
fps = 2.0                      # frames kept per second of film, the sharpest of each time slot
# frames = 80                  # or: so many per film

[metric]                       # where the metres come from; exactly one way
{camera_height}
# gps = true                   # the photos' EXIF positions
# poses_are_metric = true      # the input brought poses in metres
# marker = {{ family = "DICT_APRILTAG_36h11", id = 0, size = 0.16 }}   # a printed marker; side of its square [m]
# distance = {{ metres = 3.5, frame_a = "day/000012", a = [400, 500], b = [700, 500] }}   # two points on the road

[mjcf]
half_width = 1.0               # half the width of the drivable corridor around the filmed route [m]
# route = false                # for an object filmed around, where nothing drives
"""


def new_scene(root: Path, films: list[Path], camera_height: float | None = None) -> Path:
    """Writes a scene folder: copies of the films under `input/`, then `scene.toml`.

    Args:
        root: The scene folder; made where it does not exist.
        films: Films, image folders or posed image sets; one source and one lighting each.
        camera_height: Lens above the ground [m]; without it the line is left for the user to fill.

    Returns:
        The path of `scene.toml`.

    Raises:
        InputError: a scene is there already, a film cannot be read, or the height is impossible.
    """
    scene = SceneDir(root)
    if scene.config_file.exists():
        raise InputError(f"{scene.config_file}: a scene is here already; edit it, or choose another folder")
    if camera_height is not None and not 0.01 <= camera_height <= 100.0:
        raise InputError(f"--camera-height {camera_height:g}: expected metres above the ground, such as 1.2")
    for film in films:
        if not film.exists():
            raise InputError(f"{film}: no such film; give the path of a video file or an image folder")
        if detect_kind(film) == "video":
            probe(film)
    inputs = root / "input"
    inputs.mkdir(parents=True, exist_ok=True)
    text = _HEAD.format(name=_quoted(root.resolve().name))
    for film in films:
        copy = _copied(film.resolve(), inputs)
        text += _SOURCE.format(path=_quoted(f"input/{copy.name}"), lighting=_quoted(_lighting(copy)))
    given = f"{camera_height:<14g}" if camera_height is not None else None
    line = f"camera_height = {given} # lens above the ground [m], carried at a constant height"
    if given is None:
        line = "# camera_height = 1.2          # lens above the ground [m]: fill in, or choose another way below"
    write_text(scene.config_file, text + _REST.format(camera_height=line))
    return scene.config_file


def _copied(film: Path, inputs: Path) -> Path:
    """A copy of a film (or folder) under `input/`; what is there already is kept and reused where it is the same."""
    copy, number = inputs / film.name, 2
    while copy.exists() and not _is_same(film, copy):
        copy, number = inputs / f"{film.stem}_{number}{film.suffix}", number + 1
    if copy.exists():
        return copy
    aside = copy.with_name(copy.name + ".partial")  # an interrupted copy never passes for a film
    if film.is_dir():
        shutil.rmtree(aside, ignore_errors=True)
        shutil.copytree(film, aside)
    else:
        shutil.copyfile(film, aside)
    aside.replace(copy)
    return copy


def _is_same(film: Path, copy: Path) -> bool:
    if film == copy.resolve():
        return True
    both_files = film.is_file() and copy.is_file() and film.stat().st_size == copy.stat().st_size
    return both_files and digest_file(film) == digest_file(copy)


def _lighting(copy: Path) -> str:
    return copy.stem.replace(":", "_").replace("/", "_")


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # a JSON string is a TOML basic string


def main(arguments: list[str] | None = None) -> int:
    """Runs the verb; returns the exit status: 0, or 2 with one line on standard error."""
    parser = argparse.ArgumentParser(prog="python -m twin.new", description="Start a scene folder from films.")
    parser.add_argument("scene", type=Path, help="folder to make, such as scenes/my_road")
    parser.add_argument("films", type=Path, nargs="+", metavar="VIDEO", help="films or image folders, one per lighting")
    parser.add_argument("--camera-height", type=float, metavar="METRES", help="lens above the ground while filming")
    options = parser.parse_args(arguments)
    try:
        config = new_scene(options.scene, options.films, options.camera_height)
    except (InputError, OSError) as error:
        return refuse(error)
    print(f"wrote {config}")
    if options.camera_height is None:
        print("fill in [metric] there: without a scale nothing is metric")
    print(f"next: python -m twin.build {options.scene}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
