"""Reads and checks `scene.toml` and `robot.toml` into the dataclasses of `config.py`.

An *override* is a command-line setting `section.key=value`, which replaces that of the file. An unknown key is an error
that suggests the nearest valid name; otherwise a typo would silently become a default.
"""

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

from twin.config import (
    CAMERA_MODELS,
    KINDS,
    MAPPERS,
    MARKER_FAMILIES,
    OBSTACLE_KINDS,
    RANDOMIZED,
    RESERVED_LIGHTINGS,
    UPS,
    MetricConfig,
    ObstacleConfig,
    RouteConfig,
    SceneConfig,
    SourceConfig,
    TaskConfig,
)
from twin.errors import InputError, short_repr
from twin.files import exists, is_link, parse_toml, read_toml
from twin.robot import HuskyParams
from twin.types import Range, setting_ranges

ROBOT_TOML = "robot.toml"

MAX_NAME = 80
"""Upper bound of characters of a name that becomes part of a file name."""
_SECTIONS = ("capture", "cameras", "metric", "nerf", "mesh", "route", "mjcf", "review")


def load_config(path: Path, overrides: tuple[str, ...] = ()) -> SceneConfig:
    """Reads `scene.toml` and, for `[robot]`, the `robot.toml` beside it; applies `section.key=value` overrides.

    Raises:
        InputError: no such file, wrong TOML, unknown key, wrong type, or a value out of range.
    """
    table = _read_table(path)
    if table is None:
        raise InputError(f"no scene.toml at {path}; write one, or run python -m twin.new SCENE VIDEO...")
    for override in overrides:
        _apply_override(table, override)
    if isinstance(table.get("robot", {}), dict):
        table["robot"] = merge_robot(read_robot(path.parent / ROBOT_TOML), table.get("robot", {}), str(path))
    config = parse_table(SceneConfig, table, str(path))
    if not config.name:
        config = dataclasses.replace(config, name=path.resolve().parent.name)
    _check(config, path)
    return config


def read_robot(path: Path) -> dict[str, Any]:
    """The checked table of a `robot.toml`; empty if there is no such file. Raises InputError."""
    table = _read_table(path) or {}
    parse_table(HuskyParams, table, str(path))
    return table


def merge_robot(robot: dict[str, Any], by_hand: dict[str, Any], where: str) -> dict[str, Any]:
    """Merges a `robot.toml` with `[robot]` of `scene.toml` (`by_hand`), which takes precedence.

    `camera_intrinsics` and `camera_size` belong together: both come from the table that has the intrinsics.

    Raises:
        InputError: `by_hand` has the size and `robot` the intrinsics; `where` opens the message.
    """
    if "camera_intrinsics" in by_hand:
        robot = {name: value for name, value in robot.items() if name != "camera_size"}
    elif "camera_size" in by_hand and "camera_intrinsics" in robot:
        raise InputError(
            f"{where}: robot: camera_size = {by_hand['camera_size']}, but {ROBOT_TOML} has the camera_intrinsics; give "
            "both or neither"
        )
    return robot | by_hand


def _read_table(path: Path) -> dict[str, Any] | None:
    """The table of a TOML file; None if there is no such file."""
    folder = path.parent
    if folder.is_file():
        hint = folder.parent if folder.name == "scene.toml" else "such as scenes/demo"
        raise InputError(f"{folder} is a file; give the folder of the scene, {hint}")
    if not exists(path) and not is_link(path):
        return None
    return read_toml(path)


def _apply_override(table: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names):
        raise InputError(f"--set {override!r}: expected section.key=value, such as nerf.steps=4000")
    try:
        value = parse_toml(f"value = {text}", "--set")["value"]
    except (InputError, KeyError):  # a bare word, checked as a string
        value = text
    for name in names[:-1]:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise InputError(f"--set {override!r}: {name} is not a section")
    table[names[-1]] = value


def parse_table(kind: type, table: Any, where: str) -> Any:
    """Converts a TOML table to the frozen dataclass `kind`, checked key by key. Raises InputError."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: expected a table, got {short_repr(table)}")
    hints = typing.get_type_hints(kind)
    for key in table:
        if key not in hints:
            near = difflib.get_close_matches(key, list(hints), n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"valid keys: {', '.join(sorted(hints))}"
            raise InputError(f"{where}: unknown key {key!r}; {hint}")
    values = {key: _convert(hints[key], value, f"{where}: {key}") for key, value in table.items()}
    try:
        return kind(**values)
    except InputError as error:  # from the dataclass's own checks
        raise InputError(f"{where}: {error}") from None


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
        origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return parse_table(typing.cast(type, hint), value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise InputError(f"{where}: expected a list, got {short_repr(value)}")
        return tuple(_convert(typing.get_args(hint)[0], item, where) for item in value)
    if hint is float and type(value) is int:
        try:
            value = float(value)
        except OverflowError:
            raise InputError(f"{where}: expected a number below 1e308, got {short_repr(value)}") from None
    if type(value) is not hint:
        raise InputError(f"{where}: expected {hint.__name__}, got {short_repr(value)}")
    if hint is float and not math.isfinite(value):
        raise InputError(f"{where}: expected a finite number, got {value}")
    return value


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
    for section in _SECTIONS:
        settings = getattr(config, section)
        kind: type = type(settings)
        for key, bounds in setting_ranges(kind).items():
            _check_range(getattr(settings, key), bounds, f"{path}: {section}.{key}")
    _check_range(config.seed, setting_ranges(SceneConfig)["seed"], f"{path}: seed")
    for source in config.source:
        what = f"{path}: camera_height of [[source]] {source.path!r}"
        _check_range(source.camera_height, setting_ranges(SourceConfig)["camera_height"], what)
        _check_segments(source.keep, f"{path}: keep of [[source]] {source.path!r}")
    _check_segments(config.capture.keep, f"{path}: capture.keep")
    _check_route(config.route, path)
    _check_obstacles(config.obstacle, path)
    _check_metric(config.metric, path)
    metric = config.metric
    scales = (metric.camera_height > 0.0, metric.distance is not None, metric.gps, metric.marker is not None)
    if not any(scales) and not metric.poses_are_metric and not any(one.camera_height > 0.0 for one in config.source):
        # Checked here, not minutes into the build.
        raise InputError(
            f"{path}: [metric] gives no scale; give one or more of "
            "camera_height = 1.2 (lens above ground [m]), distance = {metres, frame_a, a, b} (two marked points), "
            "gps = true (EXIF), marker = {family, id, size} (printed ArUco or AprilTag), poses_are_metric = true"
        )


def _check_range(value: float, bounds: Range, what: str) -> None:
    low, high = bounds.low, bounds.high
    if not low <= value <= high:
        expected = f"at least {low:,.10g}" if high == math.inf else f"{low:,.10g} to {high:,.10g}"
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
    """Raises InputError for a name that a lighting cannot have; `what` opens the message."""
    if set(name) & set(":/") or name.endswith(RANDOMIZED):
        raise InputError(f"{what} = {name!r}: ':', '/' and '{RANDOMIZED}' are reserved; choose a plain name")
    if name in RESERVED_LIGHTINGS:
        raise InputError(
            f"{what} = {name!r} is reserved for a lighting sampled at random; choose another name, such as morning"
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
    _check_unique([task.name for task in tasks], "[[task]]", path)


def _check_route(route: RouteConfig, path: Path) -> None:
    if route.passes and route.points:
        raise InputError(f"{path}: [route] gives passes and points; give one of them")
    if len(route.points) == 1 or any(len(point) != 2 for point in route.points):
        raise InputError(
            f"{path}: route.points = {short_repr([list(point) for point in route.points])}; expected two or more "
            "[x, y] [m], such as [[0, 0], [12.5, 1.0]]"
        )
    if any(a == b for a, b in pairwise(route.points)):
        raise InputError(f"{path}: route.points names a point twice in a row; give each once")


def _check_metric(metric: MetricConfig, path: Path) -> None:
    if metric.marker is not None:
        family, number, size = metric.marker.family, metric.marker.id, metric.marker.size
        _check_choice(family, MARKER_FAMILIES, f"{path}: metric.marker.family")
        _check_range(number, Range(0, MARKER_FAMILIES[family] - 1), f"{path}: metric.marker.id")
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
    near = difflib.get_close_matches(value.lower()[:MAX_NAME], list(lower), n=1)
    hint = f"did you mean {lower[near[0]]!r}?" if near else f"expected {', '.join(names[:-1])} or {names[-1]}"
    raise InputError(f"{what} = {value!r}; {hint}")


def _check_name(name: str, what: str) -> None:
    """Raises InputError for a name that cannot be part of a file name."""
    invalid = not name.isprintable() or "/" in name or "\\" in name or name.startswith(".") or not name.strip()
    if invalid or len(name) > MAX_NAME or len(name.encode()) > 2 * MAX_NAME:
        raise InputError(
            f"{what} = {name!r}; files are named after it: expected at most {MAX_NAME} characters without slashes "
            "and line ends, and no dot to begin with"
        )


def _check_unique(names: list[str], what: str, path: Path) -> None:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: two {what} are named {twice!r}; give each a different name")


def _check_segments(parts: tuple[tuple[float, ...], ...], what: str) -> None:
    end = 0.0
    for part in parts:
        if len(part) != 2 or not end <= part[0] < part[1]:
            raise InputError(
                f"{what} = {short_repr([list(one) for one in parts])}; expected pairs [from, to] in seconds, "
                "0 ≤ from < to, in order and apart, such as [[0, 62.5]]"
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
    _check_unique(names, "[[obstacle]]", path)
