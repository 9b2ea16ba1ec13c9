"""`twin new`: creates a scene folder from films or a robot's bags.

    twin new scenes/my_road day.mp4 dusk.mp4 --camera-height 1.2

This writes `scenes/my_road/scene.toml` with the common settings and copies the films into `input/`. The GPS and
odometry of a bag (`twin.capture.bag_film`) become sources of scale. Its `/tf_static` gives the camera's extrinsics
(height, position and angles on the robot), which are written to `robot.toml`.

A *posed image set* is a `transforms.json` or a COLMAP model, which refers to image files. Its *root* is the deepest
folder that contains all of its files; they are copied with their paths relative to the root.
"""

import argparse
import contextlib
import filecmp
import itertools
import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from twin import commands, runtime
from twin.capture.bag import METADATA
from twin.capture.bag_film import BagContents, CameraSeat, read_contents
from twin.capture.film_check import FilmCheck, check_film, timing_notes
from twin.capture.formats import ImageSet, find_model, is_image, listed_files, read_colmap, read_transforms
from twin.capture.frames import detect_kind
from twin.capture.photos import load_photo
from twin.capture.scale import local_east_north_up
from twin.capture.video import open_film, probe
from twin.config import MAX_CAMERA_HEIGHT, RANDOMIZED, RESERVED_LIGHTINGS
from twin.config_file import ROBOT_TOML, parse_table
from twin.errors import InputError, join_names
from twin.files import atomic_path, exists, is_file, new_folder, read_toml, toml_string, write_text
from twin.geometry.images import write_image
from twin.geometry.passes import path_length
from twin.robot import BASE_HEIGHT, HuskyParams
from twin.scene import MAX_NAME, SceneDir
from twin.sysid.identification import toml_text

_POSED = ("colmap", "transforms")
_PLAYLISTS = ("hls", "dash", "concat")  # FFmpeg's names of formats that consist of other files
_MIN_FIX_WAY = 20.0  # [m] from the first GPS fix to the farthest fix; with less, GPS does not determine the scale
_MIN_ODOMETRY_WAY = 15.0  # [m] length of the path; with less, odometry does not determine the scale
_SEAT_TOLERANCE = 0.02  # [m] standard deviation of a camera's height that comes from /tf_static
_SEAT_FIELDS = ("height", "offset", "yaw", "pitch", "roll")

_HEAD = """\
# Settings of this place. All others have defaults: see twin/config.py.
name = {name}
"""

_SOURCE = """
[[source]]
path = {path}
{topic}{height}lighting = {lighting}  # sources filmed under the same light may share a name
# Mask image or folder of masks: pixels of value 0 are ignored, such as the robot's hood or a person ahead.
{mask}
# Calibrate the camera if possible: forward motion biases self-calibration. Lengths in pixels of the upright image.
# camera = {{ model = "PINHOLE", params = [fx, fy, cx, cy], width = 1920, height = 1080 }}
"""

_NO_MASK = '# mask = "input/mask.png"'
_MASK = """\
# Found by twin new: where this mask is black, all frames look the same. If that is wrong, delete the next line.
mask = {path}"""

_REST = """
[capture]
fps = 2.0                      # frames kept per second of film, the sharpest of each time slot
# frames = 80                  # or: this number of frames per film
# keep = [[0, 62.5]]           # use only these time ranges [s]; under a [[source]]: for that source only

[metric]                       # sources of the metric scale; several are compared and combined
{camera_height}
{gps}
{odometry}
# poses_are_metric = true      # the given poses are in meters
# marker = {{ family = "DICT_APRILTAG_36h11", id = 0, size = 0.16 }}   # a printed marker; side of its square [m]
# distance = {{ metres = 3.5, frame_a = "day/000012", a = [400, 500], b = [700, 500] }}   # two points on the road

[mjcf]
half_width = 1.0               # half the width of the drivable corridor around the filmed route [m]
# route = false                # for a capture around an object, without driving
"""


def new_scene(root: Path, films: list[Path], camera_height: float | None = None, topic: str = "") -> Path:
    """Writes a scene folder: copies of the films in `input/`, `robot.toml` if a bag has the camera's extrinsics,
    and `scene.toml`. Returns the path of `scene.toml`. Logs the data found in bags, and problems with films.

    Args:
        root: The scene folder; created if it does not exist.
        films: Films, bags, image folders or posed image sets. Each becomes a source with its own lighting.
        camera_height: Height of the lens above the ground [m]; None: taken from a bag, or left to the user.
        topic: Topic of the pictures in bags; empty: the topic with most pictures.

    Raises:
        InputError: a scene exists already, a film is unreadable or given twice, images of a posed image set are
            missing, or the height is invalid.
    """
    scene = SceneDir(root)
    if scene.config_file.exists():
        raise InputError(f"{scene.config_file}: a scene is here already; edit it, or choose another folder")
    if camera_height is not None and not 0.01 <= camera_height <= MAX_CAMERA_HEIGHT:
        raise InputError(f"--camera-height {camera_height:g}: expected meters above the ground, such as 1.2")
    bags: dict[Path, BagContents] = {}
    for k, film in enumerate(films):
        if not film.exists():
            raise InputError(f"{film}: no such film; give the path of a video file, an image folder or a bag")
        if any(film.samefile(other) for other in films[:k]):
            raise InputError(f"{film} is given twice; each film is one lighting, so give it once")
        kind = detect_kind(film)
        if kind not in _POSED and film.resolve() in (root / "input").resolve().parents:
            raise InputError(
                f"{root}: the scene would lie inside the folder {film}, which is copied into it; choose "
                "another folder for the scene"
            )
        if kind == "video":
            _check_video(film)
        elif kind == "bag":
            bags[film] = read_contents(film, topic)
        elif kind in _POSED:
            posed = _image_set(film)
            if posed.lenses:
                load_photo(posed.paths[0], posed.lenses[0])  # raises an error if the camera does not fit the images
    if topic and not bags:
        raise InputError(f"--topic {topic}: none of the films is a bag; leave it out")
    with runtime.exclusive_lock(root / ".new.lock", f"{root} is being written"):
        return _write_scene(scene, films, bags, camera_height)


def _write_scene(
    scene: SceneDir, films: list[Path], bags: dict[Path, BagContents], camera_height: float | None
) -> Path:
    """Copies checked films and writes `scene.toml`, see `new_scene`."""
    root = scene.root
    if scene.config_file.exists():
        raise InputError(f"{scene.config_file}: another process has just written it; edit it")
    inputs = root / "input"
    inputs.mkdir(exist_ok=True)
    text = _HEAD.format(name=toml_string(root.resolve().name))
    notes: list[str] = []
    lightings: list[str] = []
    paths: list[Path] = []
    seated = next((bag for bag in bags.values() if bag.seat), None)
    seat = _known_seat(root / ROBOT_TOML, seated) if seated else None
    own_heights = {} if camera_height is not None or seat is None else _own_heights(films, bags)
    for film in films:
        path = _import_film(film, inputs)
        if path in paths:
            raise InputError(f"{film}: has the same content as a film before it; give it once")
        paths.append(path)
        lighting = name = _lighting(inputs, path, detect_kind(film))
        if name in lightings:
            lighting = next(one for k in itertools.count(2) if (one := _shortened(name, f"_{k}")) not in lightings)
            notes.append(
                f"{film}: another film is called {name}, too, so its lighting is {lighting}; if both show the same "
                "light, give both sources the same name in scene.toml"
            )
        lightings.append(lighting)
        chosen = f"topic = {toml_string(bags[film].topics['pictures'])}\n" if film in bags else ""
        path_text = toml_string(("input" / path).as_posix())
        mask = _NO_MASK
        if detect_kind(film) == "video":
            check = check_film(film)
            found, mask = _mask_lines(check, inputs, path)
            notes += [f"{film.name}: {note}" for note in check.notes + found]
        elif detect_kind(film) == "images" and (outer := _posed_around(film)):
            notes.append(
                f"{film}: {outer} has camera poses of these photos, which are not used; to use them, delete "
                f"{scene.config_file} and give {outer}"
            )
        elif film in bags:
            notes += [f"{film.name}: {note}" for note in timing_notes(bags[film].film().timing)]
        height = f"camera_height = {own_heights[film]:.4g}  # [m] by /tf_static\n" if film in own_heights else ""
        text += _SOURCE.format(path=path_text, topic=chosen, height=height, lighting=toml_string(lighting), mask=mask)
    if seated and seat:
        _write_seat(root / ROBOT_TOML, seated)
    scales = _scale_lines(list(bags.values()), camera_height, seat, bool(own_heights))
    write_text(scene.config_file, text + _REST.format(**scales))
    for note in (*map(_taken, bags.values()), *notes):
        runtime.log_line(note)
    return scene.config_file


def _check_video(film: Path) -> None:
    """Raises InputError: an unreadable film, a playlist, a photo, or a film of one frame."""
    timing = probe(film)
    with open_film(film) as (container, _):
        if container.format.name in _PLAYLISTS:
            raise InputError(
                f"{film}: a playlist, which only names films; give the film, or join its parts by "
                f"ffmpeg -i {film.name} -c copy {film.stem}.mp4"
            )
    if len(timing.times) < 2:
        cure = "give the folder of all photos" if is_image(film) else "give a longer film, or a folder of photos"
        raise InputError(f"{film}: one picture only (need 2, better 50); {cure}")


def _mask_lines(check: FilmCheck, inputs: Path, path: Path) -> tuple[list[str], str]:
    """Writes the mask of what is fixed to the camera, unless the mask's file exists.

    Args:
        path: The film, relative to the folder `inputs`.

    Returns:
        Sentences for the user, and the line about the mask for `scene.toml`.
    """
    if check.mask is None:
        return [check.static_note] if check.static_note else [], _NO_MASK
    file = path.with_name(f"{path.stem}_mask.png")
    name = ("input" / file).as_posix()
    if exists(inputs / file):
        return [f"{check.static_note}; {name} exists and is kept; to use it, set mask in scene.toml"], _NO_MASK
    write_image(inputs / file, check.mask)
    return [f"{check.static_note}; masked by {name}: look at it"], _MASK.format(path=toml_string(name))


def _own_heights(films: list[Path], bags: dict[Path, BagContents]) -> dict[Path, float]:
    """Camera height [m] of each bag that has a possible one, if it does not hold for all films; else empty."""
    found = {film: bag.seat.height for film, bag in bags.items() if bag.seat}
    heights = {film: height for film, height in found.items() if 0.01 <= height <= MAX_CAMERA_HEIGHT}
    alike = max(heights.values(), default=0.0) - min(heights.values(), default=0.0) < _SEAT_TOLERANCE
    return {} if alike and len(heights) == len(films) else heights


def _scale_lines(
    bags: list[BagContents], camera_height: float | None, seat: CameraSeat | None, own_heights: bool
) -> dict[str, str]:
    """Lines for [metric]; a line is commented out if its value is not known.

    `own_heights`: camera heights are given under the sources.
    """
    if camera_height is not None:
        height = f"camera_height = {camera_height:<14g} # lens above the ground [m], carried at a constant height"
    elif seat is not None:
        height = (
            "# camera_height = 1.2          # lens above the ground [m] in all sources that do not give their own\n"
            if own_heights
            else f"camera_height = {seat.height:<14.4g} # lens above the ground [m], by /tf_static\n"
        ) + (
            f"camera_height_tolerance = {_SEAT_TOLERANCE:<4g} # its standard deviation [m]; smaller if measured by hand"
        )
    else:
        height = "# camera_height = 1.2          # lens above the ground [m]: fill in, or choose another source below"
    gps = "" if any(_fix_way(bag) >= _MIN_FIX_WAY for bag in bags) else "# "
    odometry = "" if any(_odometry_way(bag) >= _MIN_ODOMETRY_WAY for bag in bags) else "# "
    return {
        "camera_height": height,
        "gps": f"{gps + 'gps = true':<30} # positions: EXIF of photos, or a bag's NavSatFix",
        "odometry": f"{odometry + 'odometry = true':<30} # distances by a bag's odometry, accurate to 3 %"
        " (odometry_tolerance)",
    }


def _fix_way(bag: BagContents) -> float:
    """Largest distance between the first and any other GPS fix during a bag's film [m]."""
    during = (bag.fix_times >= bag.stamps[0]) & (bag.fix_times <= bag.stamps[-1])
    fixes = np.nan_to_num(bag.fixes[during & np.isfinite(bag.fixes[:, :2]).all(1)])
    if len(fixes) < 3:
        return 0.0
    east_north = local_east_north_up(fixes)[:, :2]
    return float(np.linalg.norm(east_north - east_north[0], axis=1).max())


def _odometry_way(bag: BagContents) -> float:
    """Length of the path during a bag's film, by odometry [m]."""
    during = (bag.odometry_times >= bag.stamps[0]) & (bag.odometry_times <= bag.stamps[-1])
    some = bag.odometry[during & np.isfinite(bag.odometry).all(1)]
    return path_length(some[:: max(1, len(some) // 1000)])


def _seat_fields(bag: BagContents) -> dict[str, Any]:
    """The camera's extrinsics in a bag as fields of `robot.toml`."""
    return {f"camera_{name}": getattr(bag.seat, name) for name in _SEAT_FIELDS}


def _known_seat(path: Path, bag: BagContents) -> CameraSeat | None:
    """The camera's extrinsics in a bag; None if they are out of the ranges for a Husky."""
    fields = _seat_fields(bag)
    try:
        parse_table(HuskyParams, {k: list(v) if isinstance(v, tuple) else v for k, v in fields.items()}, str(path))
    except InputError:
        return None
    return bag.seat


def _write_seat(path: Path, bag: BagContents) -> None:
    """Writes `robot.toml` with the camera's extrinsics in a bag, unless the file exists."""
    if not exists(path):
        comment = f"The camera's pose on the robot is that of {bag.topics['transforms']} in {bag.path.name}."
        write_text(path, toml_text(comment, {}, {name: (value, None) for name, value in _seat_fields(bag).items()}))


def _short(way: float, needed: float) -> str:
    """Note on a path [m] that is too short to determine the scale."""
    return "" if way >= needed else f" (less than {needed:.0f} m, so not used for the scale)"


def _taken(bag: BagContents) -> str:
    """Text that lists the data found in a bag."""
    rate = (len(bag.stamps) - 1) / max(bag.duration, 1e-9)
    lines = [
        f"{bag.path.name}: {len(bag.stamps)} pictures of {bag.topics['pictures']}, {bag.size[0]}x{bag.size[1]} "
        f"{bag.encoding}, {rate:.1f} a second over {bag.duration:.1f} s",
        f"  calibration: {bag.lens_note}",
    ]
    parts = [file for file in bag.path.parent.glob(f"*{bag.path.suffix}") if is_file(bag.path.parent / METADATA)]
    if len(parts) > 1:
        lines.append(f"  only this one of the bag's {len(parts)} files is used; for all, give its folder")
    if bag.other_pictures:
        others = join_names(bag.other_pictures)
        lines.append(f"  other pictures: {others}; choose by --topic, or by `topic` in scene.toml")
    if "fixes" in bag.topics:
        lines.append(
            f"  GPS: {bag.topics['fixes']}, {np.isfinite(bag.fixes[:, :2]).all(1).sum()} fixes, "
            f"up to {_fix_way(bag):.1f} m from the first" + _short(_fix_way(bag), _MIN_FIX_WAY)
        )
    if "odometry" in bag.topics:
        way = _odometry_way(bag)
        lines.append(f"  odometry: {bag.topics['odometry']}, a path of {way:.1f} m{_short(way, _MIN_ODOMETRY_WAY)}")
    if bag.seat:
        ground = "" if bag.seat.ground_known else f" (base_link assumed {BASE_HEIGHT:.3f} m high, as on a Husky)"
        lines.append(
            f"  camera on the robot: {bag.seat.height:.3f} m above the ground{ground}, {bag.seat.offset[0]:.3f} m "
            f"ahead, pitch {bag.seat.pitch:.1f}°, by {bag.topics['transforms']}"
        )
    else:
        static = bag.topics.get("transforms")
        why = f"its frame is not connected to base_link on {static}" if static else "no /tf_static"
        lines.append(f"  camera on the robot: not found, {why}")
    lines.append(f"  {bag.log_note}")
    return "\n".join(lines)


def _import_film(film: Path, inputs: Path) -> Path:
    """Copies a film, folder or posed image set to `input/`, unless it or an equal copy is there already; returns its
    path relative to `input/`."""
    film, inputs = (Path(os.path.normpath(path.absolute())) for path in (film, inputs))
    if film.is_relative_to(inputs):
        return film.relative_to(inputs)
    is_posed = detect_kind(film) in _POSED
    root, files = _posed_files(film) if is_posed else (film, _files_within(film))
    names = {file.relative_to(root) for file in files}
    within = film.relative_to(root)
    copy, number = inputs / root.name, 2
    while copy.exists():
        if names == {file.relative_to(copy) for file in _files_within(copy)} and all(
            filecmp.cmp(root / name, copy / name, shallow=False) for name in names
        ):
            return (copy / within).relative_to(inputs)
        name = f"{root.name}_{number}" if root.is_dir() else f"{root.stem}_{number}{root.suffix}"
        copy, number = inputs / name, number + 1
    # Under another name until it is complete, so that an interrupted copy does not count as a film.
    with new_folder(copy) if root.is_dir() else atomic_path(copy) as aside:
        for file in files:
            target = aside / file.relative_to(root)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
        outside = (
            [path for path in _image_set(aside / within).paths if not path.is_relative_to(aside)] if is_posed else []
        )
        if outside:
            raise InputError(f"{film}: names images by absolute paths, such as {outside[0]}; make them relative")
    return (copy / within).relative_to(inputs)


def _files_within(path: Path) -> list[Path]:
    """The file itself, or the files below a folder, without pipes, devices, dangling links, and links to folders."""
    if path.is_file():
        return [path]
    return [Path(at, name) for at, _, names in os.walk(path) for name in names if is_file(Path(at, name))]


def _image_set(film: Path) -> ImageSet:
    """Reads a posed image set. Raises InputError if its images are missing."""
    try:
        return read_colmap(film) if detect_kind(film) == "colmap" else read_transforms(film)
    except InputError as error:
        raise InputError(str(error).replace("set images =", "put them beside it, or set images =")) from None


def _posed_around(folder: Path) -> Path | None:
    """The posed image set in one of the two folders above an image folder, if it refers to images of the folder."""
    folder = folder.resolve()
    for outer in folder.parents[:2]:
        with contextlib.suppress(InputError, OSError):
            if detect_kind(outer) in _POSED and any(
                path.resolve().is_relative_to(folder) for path in _image_set(outer).paths
            ):
                return outer
    return None


def _posed_files(film: Path) -> tuple[Path, list[Path]]:
    """The root of a posed image set and its files."""
    model = find_model(film) if film.is_dir() else None
    if model is not None:
        files = [path for path in model.iterdir() if path.is_file()]
    else:
        table = film / "transforms.json" if film.is_dir() else film
        files = [table, *listed_files(table)]
    files = [Path(os.path.normpath(file)) for file in (*files, *_image_set(film).paths)]
    root = Path(os.path.commonpath([film if film.is_dir() else film.parent, *files]))
    if root == root.parent:
        raise InputError(
            f"{film}: its images, such as {files[-1]}, lie too far from it; put them in a folder beside it"
        )
    return root, list(dict.fromkeys(files))


def _lighting(inputs: Path, path: Path, kind: str) -> str:
    """A lighting's name, derived from that of the film `inputs/path` or of the root folder of a posed image set."""
    file = inputs / path.parts[0] if kind in _POSED and path.parts else inputs / path
    name = (file.name if file.is_dir() else file.stem) or "film"
    name = "".join(c if c.isprintable() and c not in ":/\\" else "_" for c in name).lstrip(".") or "film"
    name = name.replace(RANDOMIZED, RANDOMIZED.replace("+", "_"))
    name = _shortened(name)
    return f"{name}_light" if name in RESERVED_LIGHTINGS else name


def _shortened(name: str, ending: str = "") -> str:
    """The name with an ending, shortened to the largest length of a lighting's name."""
    while len(name + ending) > MAX_NAME or len((name + ending).encode()) > 2 * MAX_NAME:
        name = name[:-1]
    return name + ending


def command(options: argparse.Namespace) -> None:
    """Runs `twin new` with the options parsed by `twin.commands`."""
    config = new_scene(options.scene, options.films, options.camera_height, options.topic or "")
    print(f"wrote {config}")
    table = read_toml(config)
    sources = [name for name, value in table["metric"].items() if value and "tolerance" not in name]
    if any("camera_height" in source for source in table["source"]):
        sources.insert(0, "camera_height")
    if sources:
        print(f"metric scale: {join_names(sources)}")
    else:
        print("fill in [metric] there: the build needs a metric scale")
    print(f"next: twin build {shlex.quote(str(options.scene))}")


if __name__ == "__main__":
    sys.exit(commands.main("new"))
