"""Reading `scene.toml` and `robot.toml`: a TOML table becomes dataclasses of `config.py`, or one line says why not.

An *override* is a setting of the command line, `section.key=value`, which wins over the file. Unknown keys are refused
with the nearest valid name, so that a typo never silently becomes a default.
"""

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from twin.config import (
    CAMERA_MODELS,
    KINDS,
    MAPPERS,
    MARKER_FAMILIES,
    OBSTACLE_KINDS,
    RANDOMISED,
    RESERVED_LIGHTINGS,
    UPS,
    MetricConfig,
    ObstacleConfig,
    SceneConfig,
    SourceConfig,
    TaskConfig,
)
from twin.errors import InputError, shown
from twin.files import exists, parse_toml, path_is_link, read_toml
from twin.robot import HuskyParams

ROBOT_TOML = "robot.toml"

LONGEST_NAME = 80
"""Characters of a name that files are named after."""
_MOST = math.inf
# What a number may be. Beyond these a stage would end in an error of arithmetic, for want of memory or never, most of
# them minutes into a build. An image narrower than 64 px has too few features to be reconstructed from, the near box is
# divided into bricks of 0.24 m at first, and fewer than 100 bricks do not cover even the far grid at its coarsest.
_RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "capture": {
        "frames": (0, _MOST),
        "fps": (1e-3, 1e3),
        "max_frames": (2, _MOST),
        "max_size": (64, _MOST),
        "held_out_every": (2, _MOST),
        "min_motion": (0, _MOST),
    },
    "cameras": {
        "features": (1, 1e6),
        "max_feature_size": (64, 1e5),
        "min_registered": (0, 1),
        "max_outlier": (1e-3, _MOST),
    },
    "metric": {"camera_height": (0, _MOST)},
    "nerf": {
        "steps": (1, _MOST),
        "rays": (1, 2**20),
        "samples": (1, 1024),
        "sightings": (0, 0.7),  # the others are the triples' and the single pixels'
        "bake_steps": (1, _MOST),
        "max_bricks": (100, _MOST),
        "max_width": (32, _MOST),
        "learning_rate": (1e-6, 1),
        "appearance_dim": (1, 1024),
        "levels": (1, 32),
        "log2_table": (1, 24),
        "near_half_extent": (0, 100),
        "near_plane": (0, 100),
    },
    "mesh": {
        "voxel": (1e-2, 1),
        "ground_cell": (1e-2, 1),
        "ground_smoothing": (0, 10),
        "obstacle_height": (0, _MOST),
        "max_height": (0.1, 100),
        "max_parts": (0, _MOST),
        "max_protrusion": (1e-2, _MOST),
        "margin": (1, 1e3),
        "views": (1, _MOST),
        "view_width": (8, 4096),
    },
    "mjcf": {"half_width": (0.1, 100), "hfield_cell": (1e-2, 10), "corridor_margin": (0, 100)},
    "review": {
        "speed": (1e-2, _MOST),
        "fps": (1, 240),
        "width": (1, 4096),
        "render_width": (1, 4096),
        "renders": (0, _MOST),
    },
}


def load_config(path: Path, overrides: tuple[str, ...] = ()) -> SceneConfig:
    """Reads `scene.toml` and, for `[robot]`, the `robot.toml` beside it; applies `section.key=value` overrides.

    Raises:
        InputError: no such file, wrong TOML, unknown key, wrong type, or a value out of range.
    """
    table = _table(path)
    if table is None:
        raise InputError(f"no scene.toml at {path}; write one, or run python -m twin.new SCENE VIDEO...")
    for override in overrides:
        _apply_override(table, override)
    if isinstance(table.get("robot", {}), dict):
        table["robot"] = overruled(read_robot(path.parent / ROBOT_TOML), table.get("robot", {}), str(path))
    config = parse(SceneConfig, table, str(path))
    if not config.name:
        config = dataclasses.replace(config, name=path.resolve().parent.name)
    _check(config, path)
    return config


def read_robot(path: Path) -> dict[str, Any]:
    """The table in a `robot.toml`, checked; empty where there is no such file. Raises InputError."""
    table = _table(path) or {}
    parse(HuskyParams, table, str(path))
    return table


def overruled(robot: dict[str, Any], by_hand: dict[str, Any], where: str) -> dict[str, Any]:
    """What a `robot.toml` says, but for what `[robot]` in `scene.toml` says otherwise.

    Intrinsics and the size that they are for go together: whichever has the intrinsics has the size.

    Raises:
        InputError: a size by hand for intrinsics that are not; `where` opens the message.
    """
    if "camera_intrinsics" in by_hand:
        robot = {name: value for name, value in robot.items() if name != "camera_size"}
    elif "camera_size" in by_hand and "camera_intrinsics" in robot:
        raise InputError(
            f"{where}: robot: camera_size = {by_hand['camera_size']}, but {ROBOT_TOML} has the camera_intrinsics; give "
            "both or neither"
        )
    return robot | by_hand


def _table(path: Path) -> dict[str, Any] | None:
    """What a TOML file says; None where there is no such file."""
    if path.parent.is_file():
        raise InputError(f"{path.parent} is a file; give the folder of the scene, {_folder(path.parent)}")
    if not exists(path) and not path_is_link(path):
        return None
    return read_toml(path)


def _folder(file: Path) -> str:
    """The scene's folder that was probably meant where a file was given."""
    return f"{file.parent}" if file.name == "scene.toml" else "such as scenes/demo"


def _apply_override(table: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names):
        raise InputError(f"--set {override!r}: expected section.key=value, such as nerf.steps=4000")
    try:
        value = parse_toml(f"value = {text}", "--set")["value"]
    except (InputError, KeyError):  # no TOML, or none that is taken: a word, to be checked as such
        value = text
    for name in names[:-1]:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise InputError(f"--set {override!r}: {name} is not a section")
    table[names[-1]] = value


def parse(kind: type, table: Any, where: str) -> Any:
    """A frozen dataclass of `kind` from a TOML table, checked key by key. Raises InputError."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: expected a table, got {shown(table)}")
    hints = typing.get_type_hints(kind)
    for key in table:
        if key not in hints:
            near = difflib.get_close_matches(key, list(hints), n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"valid keys: {', '.join(sorted(hints))}"
            raise InputError(f"{where}: unknown key {key!r}; {hint}")
    values = {key: _convert(hints[key], value, f"{where}: {key}") for key, value in table.items()}
    try:
        return kind(**values)
    except InputError as error:  # a dataclass that checks its own values
        raise InputError(f"{where}: {error}") from None


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
        origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return parse(typing.cast(type, hint), value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise InputError(f"{where}: expected a list, got {shown(value)}")
        return tuple(_convert(typing.get_args(hint)[0], item, where) for item in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = _real(value, where)
    if type(value) is not hint:
        raise InputError(f"{where}: expected {hint.__name__}, got {shown(value)}")
    if hint is float and not math.isfinite(value):
        raise InputError(f"{where}: expected a finite number, got {value}")
    return value


def _real(value: int, where: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"{where}: expected a number below 1e308, got {shown(value)}") from None


def _scale_sources(metric: MetricConfig) -> tuple[str, ...]:
    """Names of the scale sources that are given: camera_height, distance, gps, marker, poses_are_metric."""
    given = {
        "camera_height": metric.camera_height > 0.0,
        "distance": metric.distance is not None,
        "gps": metric.gps,
        "marker": metric.marker is not None,
        "poses_are_metric": metric.poses_are_metric,
    }
    return tuple(name for name, is_given in given.items() if is_given)


def _check(config: SceneConfig, path: Path) -> None:
    if not config.source:
        raise InputError(f"{path}: no [[source]] given; add one per film, with path = and lighting =")
    for source in config.source:
        _check_source(source, path)
    _check_choice(config.cameras.mapper, MAPPERS, f"{path}: cameras.mapper")
    _check_choice(config.metric.up, UPS, f"{path}: metric.up")
    if not config.name.isprintable() and config.name != path.resolve().parent.name:
        raise InputError(f"{path}: name = {config.name!r}; expected a text without control characters")
    _check_tasks(config.task, path)
    for section, ranges in _RANGES.items():
        for key, (low, high) in ranges.items():
            _check_range(getattr(getattr(config, section), key), low, high, f"{path}: {section}.{key}")
    _check_range(config.seed, 0, 2**31 - 1, f"{path}: seed")  # as COLMAP takes it
    for source in config.source:
        _check_range(source.camera_height, 0, _MOST, f"{path}: camera_height of [[source]] {source.path!r}")
        _check_parts(source.keep, f"{path}: keep of [[source]] {source.path!r}")
    _check_parts(config.capture.keep, f"{path}: capture.keep")
    _check_obstacles(config.obstacle, path)
    _check_metric(config.metric, path)
    given = _scale_sources(config.metric)
    if len(given) != 1 and not (not given and any(source.camera_height > 0.0 for source in config.source)):
        # Checked before anything runs, so that nobody waits minutes to learn it.
        raise InputError(
            f"{path}: [metric] gives {'no scale' if not given else ' and '.join(given)}; give exactly one of "
            "camera_height = 1.2 (lens above ground [m]), distance = {metres, frame_a, a, b} (two marked points), "
            "gps = true (EXIF), marker = {family, id, size} (printed ArUco or AprilTag), poses_are_metric = true"
        )


def _check_range(value: float, low: float, high: float, what: str) -> None:
    if not low <= value <= high:
        expected = f"at least {low:,.10g}" if high == _MOST else f"{low:,.10g} to {high:,.10g}"
        raise InputError(f"{what} = {value:,.10g}; expected {expected}")


def _check_source(source: SourceConfig, path: Path) -> None:
    if not source.path:
        raise InputError(f"{path}: a [[source]] has no path; give the video or the image folder")
    for key in ("path", "images", "mask"):
        if "\0" in getattr(source, key):
            raise InputError(f"{path}: {key} = {getattr(source, key)!r}; expected a path, which has no NUL")
    what = f"of [[source]] {source.path!r}"
    _check_choice(source.kind, KINDS, f"{path}: kind")
    if source.lighting:
        check_lighting(source.lighting, f"{path}: lighting {what}")
    camera = source.camera
    if camera is not None:
        _check_choice(camera.model, CAMERA_MODELS, f"{path}: camera.model {what}")
        if len(camera.params) != CAMERA_MODELS[camera.model]:
            raise InputError(
                f"{path}: camera.params {what} has {len(camera.params)} numbers; {camera.model} has "
                f"{CAMERA_MODELS[camera.model]}, in COLMAP's order"
            )
        if min(camera.width, camera.height) < 0 or (camera.width > 0) != (camera.height > 0):
            raise InputError(
                f"{path}: camera {what} is for {camera.width}x{camera.height} px; give the width and the height that "
                "the calibration is for, or neither"
            )


def check_lighting(name: str, what: str) -> None:
    """Refuses a name that no lighting may have; `what` opens the message of the InputError."""
    if set(name) & set(":/") or name.endswith(RANDOMISED):
        raise InputError(
            f"{what} = {name!r}: ':', '/' and '{RANDOMISED}' have a meaning of their own; choose a plain name"
        )
    if name in RESERVED_LIGHTINGS:
        raise InputError(
            f"{what} = {name!r} has a meaning of its own, a light drawn at random; choose another name, such as morning"
        )
    _check_name(name, what)


def _check_tasks(tasks: tuple[TaskConfig, ...], path: Path) -> None:
    for task in tasks:
        if not task.name or task.start < 0.0 or not task.length > 0.0:
            raise InputError(
                f"{path}: a [[task]] has name = {task.name!r}, start = {task.start}, length = {task.length}; "
                "expected a name, start ≥ 0 and length > 0 [m]"
            )
        _check_name(task.name, f"{path}: [[task]] name")
    _check_apart([task.name for task in tasks], "[[task]]", path)


def _check_metric(metric: MetricConfig, path: Path) -> None:
    if metric.marker is not None:
        family, number, size = metric.marker.family, metric.marker.id, metric.marker.size
        _check_choice(family, MARKER_FAMILIES, f"{path}: metric.marker.family")
        _check_range(number, 0, MARKER_FAMILIES[family] - 1, f"{path}: metric.marker.id")
        if not size > 0.0:
            raise InputError(f"{path}: metric.marker.size = {size:g}; expected the side of the black square [m]")
    if metric.distance is not None:
        distance = metric.distance
        if not distance.metres > 0.0:
            raise InputError(
                f"{path}: metric.distance.metres = {distance.metres:g}; expected the metres between the points a and b"
            )
        for key in ("a", "b", *(("a2", "b2") if distance.frame_b else ())):
            if len(getattr(distance, key)) != 2:
                raise InputError(
                    f"{path}: metric.distance.{key} = {list(getattr(distance, key))}; expected [u, v] [px]"
                )
        if "/" not in distance.frame_a:
            raise InputError(
                f"{path}: metric.distance.frame_a = {distance.frame_a!r}; expected a frame such as 'day/000012', as in "
                "build/2_cameras/images"
            )


def _check_choice(value: str, choices: Iterable[str], what: str) -> None:
    names = list(choices)
    if value in names:
        return
    lower = {name.lower(): name for name in names}
    near = difflib.get_close_matches(value.lower()[:LONGEST_NAME], list(lower), n=1)
    hint = f"did you mean {lower[near[0]]!r}?" if near else f"expected {', '.join(names[:-1])} or {names[-1]}"
    raise InputError(f"{what} = {value!r}; {hint}")


def _check_name(name: str, what: str) -> None:
    """Refuses a name that cannot be part of a file's name."""
    unfit = not name.isprintable() or "/" in name or "\\" in name or name.startswith(".") or not name.strip()
    if unfit or len(name) > LONGEST_NAME or len(name.encode()) > 2 * LONGEST_NAME:
        raise InputError(
            f"{what} = {name!r}; files are named after it: expected at most {LONGEST_NAME} characters without slashes "
            "and line ends, and no dot to begin with"
        )


def _check_apart(names: list[str], what: str, path: Path) -> None:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: two {what} are named {twice!r}; give each a name of its own")


def _check_parts(parts: tuple[tuple[float, ...], ...], what: str) -> None:
    end = 0.0
    for part in parts:
        if len(part) != 2 or not end <= part[0] < part[1]:
            raise InputError(
                f"{what} = {shown([list(one) for one in parts])}; expected pairs [from, to] in seconds, 0 ≤ from < to, "
                "in order and apart, such as [[0, 62.5]]"
            )
        end = part[1]


def _check_obstacles(obstacles: tuple[ObstacleConfig, ...], path: Path) -> None:
    for one in obstacles:
        _check_choice(one.kind, OBSTACLE_KINDS, f"{path}: [[obstacle]] kind")
        if one.name:
            _check_name(one.name, f"{path}: [[obstacle]] name")
        for key, lengths, meaning in (("to", (0, 2), "station and lateral [m]"), ("color", (0, 3), "red, green, blue")):
            if len(getattr(one, key)) not in lengths:
                raise InputError(f"{path}: [[obstacle]] {key} = {list(getattr(one, key))}; expected {meaning}")
        if len(one.size) not in (0, 3) or any(not side > 0.0 for side in one.size):
            raise InputError(f"{path}: [[obstacle]] size = {list(one.size)}; expected length, width, height > 0 [m]")
        if not all(0.0 <= c <= 1.0 for c in one.color):
            raise InputError(f"{path}: [[obstacle]] color = {list(one.color)}; expected values from 0 to 1")
        if one.to and not one.speed > 0.0:
            raise InputError(f"{path}: [[obstacle]] speed = {one.speed}; expected more than 0 where it moves")
    names = [one.name or f"{one.kind}_{k}" for k, one in enumerate(obstacles)]
    _check_apart(names, "[[obstacle]]", path)
