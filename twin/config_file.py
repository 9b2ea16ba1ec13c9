"""Reads and checks `scene.toml` and `robot.toml` into the dataclasses of `config.py`.

An *override* is a setting `section.key=value` of the command line, which replaces that of the file. An unknown key is
an error that suggests the nearest valid name; if unknown keys were ignored, a misspelled setting would silently have
its default.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from twin.config import (
    CAMERA_MODELS,
    KINDS,
    MAPPERS,
    MARKER_FAMILIES,
    OBSTACLE_KINDS,
    QUALITIES,
    RANDOMIZED,
    RESERVED_LIGHTINGS,
    SAMPLED_LIGHTING,
    UPS,
    MetricConfig,
    ObstacleConfig,
    RouteConfig,
    SceneConfig,
    SourceConfig,
    TaskConfig,
)
from twin.errors import InputError, name_hint, short_repr
from twin.files import exists, is_link, parse_toml, read_toml
from twin.ranges import Range, check_range, check_ranges
from twin.robot import HuskyParams
from twin.scene import MAX_NAME

ROBOT_TOML = "robot.toml"

MIN_TASK_LENGTH = 1.0  # [m]; the goal is reached `twin.env.task.BUMPER_OFFSET` before the end
_SECTIONS = ("capture", "cameras", "metric", "nerf", "mesh", "route", "mjcf", "review")


def load_config(path: Path, overrides: tuple[str, ...] = ()) -> SceneConfig:
    """Reads `scene.toml` and, for `[robot]`, the `robot.toml` beside it; applies `section.key=value` overrides.

    Raises:
        InputError: no such file, invalid TOML, unknown key, wrong type, or a value out of range.
    """
    table = _read_table(path)
    if table is None:
        raise InputError(f"no scene.toml at {path}; write one, or run twin new SCENE VIDEO...")
    for override in overrides:
        _apply_override(table, override)
    where = f"{path}{''.join(f' with --set {override}' for override in overrides)}"
    if isinstance(table.get("robot", {}), dict):
        table["robot"] = merge_robot(read_robot(path.parent / ROBOT_TOML), table.get("robot", {}), where)
    nerf = table.get("nerf", {})
    if isinstance(nerf, dict) and isinstance(nerf.get("quality"), str):
        _check_choice(nerf["quality"], tuple(QUALITIES), f"{where}: nerf.quality")
        table["nerf"] = QUALITIES[nerf["quality"]] | nerf
    config = parse_table(SceneConfig, table, where)
    folder = path.resolve().parent.name
    try:
        _check(config, folder)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return config if config.name else dataclasses.replace(config, name=folder)


def read_robot(path: Path) -> dict[str, Any]:
    """The table of a `robot.toml`; empty if there is no such file. Raises InputError for an invalid table."""
    table = _read_table(path) or {}
    parse_table(HuskyParams, table, str(path))
    return table


def merge_robot(robot: dict[str, Any], by_hand: dict[str, Any], where: str) -> dict[str, Any]:
    """Merges a `robot.toml` with `[robot]` of `scene.toml` (`by_hand`), which takes precedence.

    `camera_intrinsics` and `camera_size` belong together: both come from the table that has the intrinsics.

    Raises:
        InputError: `by_hand` has the size, but only `robot` has the intrinsics. The message begins with `where`.
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
    except (InputError, KeyError):  # a word without quotes, which is taken as a string
        value = text
    for name in names[:-1]:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise InputError(f"--set {override!r}: {name} is not a section")
    table[names[-1]] = value


def parse_table(kind: type, table: Any, where: str) -> Any:
    """Converts a TOML table to the frozen dataclass `kind`. Raises InputError for an unknown key or a wrong type."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: expected a table, got {short_repr(table)}")
    hints = typing.get_type_hints(kind)
    for key in table:
        if key not in hints:
            hint = name_hint(key, hints, f"valid keys: {', '.join(sorted(hints))}")
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


def _check(config: SceneConfig, folder: str) -> None:
    """Raises InputError for invalid settings, so that no stage fails on them during the build."""
    _require(config.source, "no [[source]] given; add one per film, with `path` and `lighting`")
    for source in config.source:
        _check_source(source)
    _check_choice(config.cameras.mapper, MAPPERS, "cameras.mapper")
    _check_choice(config.metric.up, UPS, "metric.up")
    printable = config.name.isprintable() or config.name == folder
    _require(printable, f"name = {config.name!r}; expected a text without control characters")
    _check_tasks(config.task)
    check_ranges(config)
    for section in _SECTIONS:
        check_ranges(getattr(config, section), f"{section}.")
    _check_segments(config.capture.keep, "capture.keep")
    _check_route(config.route, "route")
    _check_branches(config)
    check_obstacles(config.obstacle)
    metric = config.metric
    _check_metric(metric)
    heights = [metric.camera_height, *(source.camera_height for source in config.source)]
    _require(
        any((*heights, metric.distance, metric.gps, metric.odometry, metric.marker, metric.poses_are_metric)),
        "[metric] gives no scale; give one or more of "
        "camera_height = 1.2 (lens above ground [m]), "
        "distance = {metres, frame_a, a, b} (two marked points; a rough camera_height gives the frames first), "
        "gps = true (EXIF or NavSatFix of a bag), odometry = true (of a bag), "
        "marker = {family, id, size} (printed ArUco or AprilTag), poses_are_metric = true",
    )


def _require(condition: object, message: str) -> None:
    if not condition:
        raise InputError(message)


def _check_source(source: SourceConfig) -> None:
    _require(source.path, "a [[source]] has no path; give the video or the image folder")
    for key in ("path", "images", "mask"):
        value = getattr(source, key)
        _require("\0" not in value, f"{key} = {value!r}; expected a path without NUL characters")
    what = f"of [[source]] {source.path!r}"
    _check_choice(source.kind, KINDS, "kind")
    check_ranges(source, suffix=f" {what}")
    _check_segments(source.keep, f"keep {what}")
    if source.lighting:
        check_lighting(source.lighting, f"lighting {what}")
    if source.camera is not None:
        model, count = source.camera.model, len(source.camera.params)
        _check_choice(model, CAMERA_MODELS, f"camera.model {what}")
        _require(
            count == CAMERA_MODELS[model],
            f"camera.params {what} has {count} numbers; {model} has {CAMERA_MODELS[model]}, in COLMAP's order",
        )
        width, height = source.camera.width, source.camera.height
        _require(
            min(width, height) >= 0 and (width > 0) == (height > 0),
            f"camera {what} is for {width}x{height} px; give the width and the height that the calibration is for, or "
            "neither",
        )


def check_lighting(name: str, what: str) -> None:
    """Raises InputError for a name that is not allowed for a lighting; the message begins with `what`."""
    _require(
        not set(name) & set(":/") and not name.endswith(RANDOMIZED),
        f"{what} = {name!r}: ':', '/' and '{RANDOMIZED}' are reserved; choose a plain name",
    )
    _require(
        name not in RESERVED_LIGHTINGS and not name.startswith(SAMPLED_LIGHTING),
        f"{what} = {name!r} is reserved for a lighting sampled at random; choose another name, such as morning",
    )
    _check_name(name, what)


def _check_tasks(tasks: tuple[TaskConfig, ...]) -> None:
    for task in tasks:
        _require(
            task.name and task.start >= 0.0 and task.length >= MIN_TASK_LENGTH,
            f"a [[task]] has name = {task.name!r}, start = {task.start}, length = {task.length}; "
            f"expected a name, start ≥ 0 and length ≥ {MIN_TASK_LENGTH:g} [m]: a shorter task would be done at once",
        )
        _check_name(task.name, "[[task]] name")
    _check_unique([task.name for task in tasks], "[[task]]")


def _check_branches(config: SceneConfig) -> None:
    for branch in config.branch:
        _check_name(branch.name, "[[branch]] name")
        what = f"[[branch]] {branch.name!r}"
        _require(branch.passes or branch.points, f"{what} has neither passes nor points; give one of them")
        check_ranges(branch, f"{what} ")
        _check_route(branch, what)
    names = [branch.name for branch in config.branch]
    _check_unique(["route", *names], "routes")
    for task in config.task:
        _require(task.name not in names, f"[[branch]] and [[task]] {task.name!r}; a branch is a task, so rename one")
    for kind, entries in (("task", config.task), ("obstacle", config.obstacle)):
        for one in entries:
            if one.route:
                _require(names, f"[[{kind}]] route = {one.route!r}, but there is no [[branch]]; define it")
                _check_choice(one.route, names, f"[[{kind}]] route")
    _require(not names or config.mjcf.route, "[[branch]] needs a route, but mjcf.route = false; remove one of them")


def _check_route(route: RouteConfig, what: str) -> None:
    _require(not (route.passes and route.points), f"{what} gives passes and points; give one of them")
    _require(
        len(route.points) != 1 and all(len(point) == 2 for point in route.points),
        f"{what}.points = {short_repr([list(point) for point in route.points])}; expected two or more [x, y] [m], such "
        "as [[0, 0], [12.5, 1.0]]",
    )
    twice = any(a == b for a, b in pairwise(route.points))
    _require(not twice, f"{what}.points names a point twice in a row; give each once")


def _check_metric(metric: MetricConfig) -> None:
    if metric.marker is not None:
        family, size = metric.marker.family, metric.marker.size
        _check_choice(family, MARKER_FAMILIES, "metric.marker.family")
        check_range(metric.marker.id, Range(0, MARKER_FAMILIES[family] - 1), "metric.marker.id")
        _require(size > 0.0, f"metric.marker.size = {size:g}; expected the side of the black square [m]")
    if metric.distance is not None:
        metres, frame = metric.distance.metres, metric.distance.frame_a
        _require(metres > 0.0, f"metric.distance.metres = {metres:g}; expected the meters between the points a and b")
        for key in ("a", "b", *(("a2", "b2") if metric.distance.frame_b else ())):
            pixel = getattr(metric.distance, key)
            _require(len(pixel) == 2, f"metric.distance.{key} = {list(pixel)}; expected [u, v] [px]")
        _require(
            "/" in frame,
            f"metric.distance.frame_a = {frame!r}; expected a frame such as 'day/000012', as in build/2_cameras/images",
        )


def _check_choice(value: str, choices: Iterable[str], what: str) -> None:
    names = list(choices)
    if value not in names:
        expected = " or ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
        hint = name_hint(value, names, f"expected {expected}")
        raise InputError(f"{what} = {value!r}; {hint}")


def _check_name(name: str, what: str) -> None:
    """Raises InputError for a name that cannot be part of a file name."""
    valid = name.isprintable() and not set(name) & set("/\\") and not name.startswith(".") and name.strip()
    _require(
        valid and len(name) <= MAX_NAME and len(name.encode()) <= 2 * MAX_NAME,
        f"{what} = {name!r}; files are named after it: expected at most {MAX_NAME} characters without slashes "
        "and line ends; the first must not be a dot",
    )


def _check_unique(names: list[str], what: str) -> None:
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"two {what} are named {twice!r}; give each a different name")


def _check_segments(parts: tuple[tuple[float, ...], ...], what: str) -> None:
    end = 0.0
    for part in parts:
        _require(
            len(part) == 2 and end <= part[0] < part[1],
            f"{what} = {short_repr([list(one) for one in parts])}; expected pairs [from, to] in seconds, "
            "0 ≤ from < to, in order of time and without overlap, such as [[0, 62.5]]",
        )
        end = part[1]


def check_obstacles(obstacles: Sequence[ObstacleConfig]) -> None:
    """Raises InputError for obstacles that cannot be built, or that have the same name."""
    for one in obstacles:
        numbers = (one.station, one.lateral, one.yaw, one.speed, one.delay, *one.to, *one.color, *one.size)
        _require(all(map(math.isfinite, numbers)), f"[[obstacle]] {short_repr(one)}; expected finite numbers")
        _check_choice(one.kind, OBSTACLE_KINDS, "[[obstacle]] kind")
        if one.name:
            _check_name(one.name, "[[obstacle]] name")
        to, color, size = list(one.to), list(one.color), list(one.size)
        _require(len(to) in (0, 2), f"[[obstacle]] to = {to}; expected station and lateral [m]")
        _require(len(color) in (0, 3), f"[[obstacle]] color = {color}; expected red, green, blue")
        sides = len(size) in (0, 3) and all(side > 0.0 for side in size)
        _require(sides, f"[[obstacle]] size = {size}; expected length, width, height > 0 [m]")
        _require(all(0.0 <= c <= 1.0 for c in color), f"[[obstacle]] color = {color}; expected values from 0 to 1")
        moves = one.speed > 0.0 or not one.to
        _require(moves, f"[[obstacle]] speed = {one.speed}; expected more than 0, since `to` makes it move")
    _check_unique([one.name or f"{one.kind}_{k}" for k, one in enumerate(obstacles)], "[[obstacle]]")
