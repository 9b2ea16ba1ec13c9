"""What a user may say in `scene.toml`: one frozen dataclass per stage, every field with its unit and its default.

A *source* is one film (or photo folder, or posed image set) under one *lighting*. Several sources may share a lighting.
Unknown keys are refused with the nearest valid name, so that a typo never silently becomes a default.
"""

import dataclasses
import difflib
import tomllib
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from twin.errors import InputError
from twin.robot import HuskyParams

ROBOT_TOML = "robot.toml"

_MOST_SEED = 2**31 - 1  # that structure from motion takes


@dataclass(frozen=True)
class CalibrationConfig:
    """A camera measured beforehand; held fixed in structure from motion. Lengths [px] at `width` × `height`."""

    model: str = "PINHOLE"
    """A COLMAP camera model: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE, ..."""
    params: tuple[float, ...] = ()
    """Its parameters in COLMAP's order: PINHOLE is fx, fy, cx, cy; OPENCV adds k1, k2, p1, p2."""
    width: int = 0
    height: int = 0


@dataclass(frozen=True)
class SourceConfig:
    """One input under one lighting."""

    path: str = ""
    """Video file, image folder, COLMAP model folder or transforms.json, relative to the scene folder."""
    lighting: str = ""
    """Its name; by default the file's stem."""
    kind: str = "auto"
    """auto, video, images, colmap or transforms."""
    images: str = ""
    """Image folder of a COLMAP model or transforms.json, where it is not beside it."""
    mask: str = ""
    """One static mask image, or a folder of masks named like the frames; 0 = ignore."""
    camera: CalibrationConfig | None = None
    """Known intrinsics, held fixed. A calibrated camera pays: forward driving bends a self-calibrated one."""
    camera_height: float = 0.0
    """Height of this source's lens above the ground [m], where sources differ; 0 = `metric.camera_height`."""


@dataclass(frozen=True)
class CaptureConfig:
    """Which frames of the input are kept."""

    frames: int = 0
    """Frames to keep per source; 0 = by `fps`. Slots are regular in time, the sharpest frame of each slot is kept."""
    fps: float = 2.0
    """Frames to keep per second of video, where `frames` is 0."""
    max_frames: int = 300
    """Upper bound per source."""
    max_size: int = 1280
    """Longer side of a kept frame [px]; larger input is scaled down (intrinsics with it)."""
    held_out_every: int = 8
    """Every n-th frame along each source is never trained on."""
    min_motion: float = 1.0
    """Frames that moved less than this from the last kept one [px, median optical flow at 320 px width] are dropped."""


@dataclass(frozen=True)
class CamerasConfig:
    """Structure from motion."""

    features: int = 3000
    """SIFT features per frame at most."""
    max_feature_size: int = 1280
    """Longer side of the image features are found in [px]."""
    mapper: str = "auto"
    """auto (global, then incremental), global or incremental."""
    min_registered: float = 0.6
    """Share of frames that must register, else the stage refuses."""
    max_outlier: float = 0.3
    """A frame further than this off the path its neighbours draw is an outlier [median steps between frames]."""
    free_focal: bool = False
    """Ignore the given calibrations and self-calibrate (to compare; a calibrated camera is better)."""


@dataclass(frozen=True)
class DistanceConfig:
    """Two points marked in images and the metres between them. Pixels of `build/2_cameras/images/<frame>.png`."""

    metres: float = 0.0
    frame_a: str = ""
    """Frame name such as `sunny/000012`; a point needs two frames to be triangulated, or lies on the ground."""
    a: tuple[float, ...] = ()
    """[u, v] of the first point in `frame_a`."""
    b: tuple[float, ...] = ()
    """[u, v] of the second point in `frame_a`."""
    frame_b: str = ""
    """A second frame that sees both points; empty = both points lie on the ground."""
    a2: tuple[float, ...] = ()
    b2: tuple[float, ...] = ()


@dataclass(frozen=True)
class MarkerConfig:
    """A printed square marker that stands in the scene."""

    family: str = ""
    """An OpenCV dictionary: DICT_4X4_50, DICT_APRILTAG_36h11, ..."""
    id: int = 0
    size: float = 0.0
    """Side of the black square [m]."""


@dataclass(frozen=True)
class MetricConfig:
    """Where the metres come from; exactly one of these must be given."""

    camera_height: float = 0.0
    """Lens above the ground [m], for a camera carried at constant height. 0 = not given."""
    distance: DistanceConfig | None = None
    marker: MarkerConfig | None = None
    gps: bool = False
    """EXIF GPS positions of the images."""
    poses_are_metric: bool = False
    """The given poses (COLMAP model or transforms.json) are in metres already."""
    up: str = "ground"
    """Gravity: `ground` (plane of the road), `cameras` (mean camera up), or `poses` (the given poses are z-up)."""


@dataclass(frozen=True)
class NerfConfig:
    """The radiance field and its training."""

    steps: int = 2000
    rays: int = 4096
    """Rays per step."""
    samples: int = 16
    """Samples per ray and step."""
    sightings: float = 0.35
    """Share of each step's rays that go through places whose distance is known, which is then learned, too."""
    stereo: bool = True
    """Find such places by stereo between the frames, besides the sparse points."""
    bake_steps: int = 300
    """Steps of fine-tuning of the baked field, which is what renders."""
    max_bricks: int = 9000
    """Bricks of the baked field at most; 9,000 are some 105 MB. Its cells are as fine as that allows."""
    max_width: int = 480
    """Images are trained at this longer side [px]."""
    learning_rate: float = 3e-2
    appearance_dim: int = 32
    levels: int = 8
    log2_table: int = 18
    near_half_extent: float = 0.0
    """Half side of the uncontracted near box [m]; 0 = from the cameras."""
    near_plane: float = 0.3
    """Nothing is in front of a camera nearer than this [m]."""


@dataclass(frozen=True)
class MeshConfig:
    """From density to what can be touched."""

    voxel: float = 0.15
    """Marching-cubes cell [m]."""
    ground_cell: float = 0.1
    """Height field cell [m]."""
    ground_smoothing: float = 0.25
    """Low-pass length of the height field [m, standard deviation]."""
    obstacle_height: float = 0.2
    """What stands this much above the ground is an obstacle [m]."""
    max_height: float = 2.5
    """Obstacles are cut off above this; nothing the robot can touch is higher [m]."""
    max_parts: int = 2000
    """Convex parts at most."""
    max_protrusion: float = 0.2
    """No convex part may stick out of its mesh by more than this [m]."""
    margin: float = 12.0
    """What is further than this from the route is not meshed [m]."""
    views: int = 100
    """Filmed poses at most that surface and ground are rendered from."""
    view_width: int = 200
    """Width of those renderings [px]."""


@dataclass(frozen=True)
class MjcfConfig:
    """The scene the robot drives in."""

    route: bool = True
    """False for a capture that is no drive (an object filmed around): no route, no Husky."""
    half_width: float = 1.0
    """Half width of the drivable corridor around the route [m]."""
    hfield_cell: float = 0.3
    """Cell of the height field that the wheels roll on [m], a multiple of `mesh.ground_cell`. Where a wheel rolls over
    an edge it touches several facets: fewer edges shake it less and cost less, and the ground has nothing finer anyway
    (`mesh.ground_smoothing`)."""
    corridor_margin: float = 0.0
    """Extra clearance asked of convex parts beside the corridor [m]."""


@dataclass(frozen=True)
class ReviewConfig:
    """The film and the page."""

    speed: float = 1.0
    """Speed of the scripted follower [m/s]."""
    fps: int = 10
    width: int = 480
    """Width of one panel of the film [px]."""
    render_width: int = 224
    """Longer side the radiance field is rendered at for the film [px]; it is scaled up to the panel."""
    renders: int = 120
    """Pictures of the radiance field in the whole film: more make it smoother and the build longer."""


OBSTACLE_KINDS = ("cone", "box", "bollard", "car", "pedestrian", "cyclist", "husky")


@dataclass(frozen=True)
class ObstacleConfig:
    """Something that is put on the route, standing or moving to and fro."""

    name: str = ""
    """Of its body in the model, `obstacle_<name>`; by default its kind and its place in the list."""
    kind: str = ""
    """cone, box, bollard, car, pedestrian, cyclist or husky."""
    station: float = 0.0
    """Arc length on the route [m]."""
    lateral: float = 0.0
    """Distance from the route, left positive [m]."""
    yaw: float = 0.0
    """Of its front against the route's heading [°]; one that moves faces where it goes, turned by this."""
    to: tuple[float, ...] = ()
    """Station and lateral [m] it moves to, and back again; empty = it stands."""
    speed: float = 1.2
    """Of one that moves [m/s]."""
    delay: float = 0.0
    """One that moves has been on its way for so long when the episode begins [s]."""
    color: tuple[float, ...] = ()
    """Red, green, blue of its main colour, 0 to 1; its kind's own by default."""
    size: tuple[float, ...] = ()
    """Length, width, height of a box [m]."""


@dataclass(frozen=True)
class TaskConfig:
    """A stretch of the route to be driven, besides the standard tasks (see `twin/env/stretches.py`)."""

    name: str = ""
    start: float = 0.0
    """Arc length of the route at which it begins [m]."""
    length: float = 0.0
    """[m]"""


@dataclass(frozen=True)
class SceneConfig:
    """A whole `scene.toml`."""

    name: str = ""
    seed: int = 0
    """Of all randomness in a build, from 0 to 2³¹ − 1."""
    source: tuple[SourceConfig, ...] = ()
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    metric: MetricConfig = field(default_factory=MetricConfig)
    nerf: NerfConfig = field(default_factory=NerfConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    mjcf: MjcfConfig = field(default_factory=MjcfConfig)
    robot: HuskyParams = field(default_factory=HuskyParams)
    """`scene.toml` before `robot.toml`, which lies beside it, before the defaults."""
    review: ReviewConfig = field(default_factory=ReviewConfig)
    task: tuple[TaskConfig, ...] = ()
    obstacle: tuple[ObstacleConfig, ...] = ()


def load_config(path: Path, overrides: tuple[str, ...] = ()) -> SceneConfig:
    """Reads `scene.toml` and, for `[robot]`, the `robot.toml` beside it; applies `section.key=value` overrides.

    Raises:
        InputError: no such file, wrong TOML, unknown key, wrong type, or a value out of range.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"no scene.toml at {path}; write one, or run python -m twin.new SCENE VIDEO...") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    for override in overrides:
        _apply_override(table, override)
    if isinstance(table.get("robot", {}), dict):
        table["robot"] = read_robot(path.parent / ROBOT_TOML) | table.get("robot", {})
    config = parse(SceneConfig, table, str(path))
    if not config.name:
        config = dataclasses.replace(config, name=path.resolve().parent.name)
    _check(config, path)
    return config


def read_robot(path: Path) -> dict[str, Any]:
    """The table in a `robot.toml`, checked; empty where there is no such file. Raises InputError."""
    if not path.exists():
        return {}
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    parse(HuskyParams, table, str(path))
    return table


def _apply_override(table: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names):
        raise InputError(f"--set {override!r}: expected section.key=value, such as nerf.steps=4000")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    for name in names[:-1]:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise InputError(f"--set {override!r}: {name} is not a section")
    table[names[-1]] = value


def parse(kind: type, table: Any, where: str) -> Any:
    """A frozen dataclass of `kind` from a TOML table, checked key by key. Raises InputError."""
    if not isinstance(table, dict):
        raise InputError(f"{where}: expected a table, got {table!r}")
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
            raise InputError(f"{where}: expected a list, got {value!r}")
        return tuple(_convert(typing.get_args(hint)[0], item, where) for item in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not hint:
        raise InputError(f"{where}: expected {hint.__name__}, got {value!r}")
    if hint is float and value != value:
        raise InputError(f"{where}: expected a number, got nan")
    return value


def scale_sources(metric: MetricConfig) -> tuple[str, ...]:
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
    if not 0 <= config.seed <= _MOST_SEED:
        raise InputError(f"{path}: seed = {config.seed}; expected 0 to {_MOST_SEED}")
    for source in config.source:
        if not source.path:
            raise InputError(f"{path}: a [[source]] has no path; give the video or the image folder")
        if source.kind not in ("auto", "video", "images", "colmap", "transforms"):
            raise InputError(f"{path}: kind = {source.kind!r}; expected auto, video, images, colmap or transforms")
    for task in config.task:
        if not task.name or task.start < 0.0 or not task.length > 0.0:
            raise InputError(
                f"{path}: a [[task]] has name = {task.name!r}, start = {task.start}, length = {task.length}; "
                "expected a name, start ≥ 0 and length > 0 [m]"
            )
    for section, key, low in (
        ("capture", "fps", 1e-3),
        ("capture", "held_out_every", 2),
        ("capture", "max_frames", 2),
        ("nerf", "steps", 1),
        ("nerf", "rays", 1),
        ("metric", "camera_height", 0.0),
        ("mesh", "voxel", 1e-3),
        ("mesh", "ground_cell", 1e-3),
        ("mjcf", "half_width", 0.1),
        ("mjcf", "hfield_cell", 1e-3),
        ("review", "fps", 1),
        ("review", "speed", 1e-2),
    ):
        value = getattr(getattr(config, section), key)
        if not value >= low:
            raise InputError(f"{path}: {section}.{key} = {value}; expected at least {low:g}")
    _check_obstacles(config.obstacle, path)
    given = scale_sources(config.metric)
    if len(given) != 1 and not (not given and any(source.camera_height > 0.0 for source in config.source)):
        # Checked before anything runs, so that nobody waits minutes to learn it.
        raise InputError(
            f"{path}: [metric] gives {'no scale' if not given else ' and '.join(given)}; give exactly one of "
            "camera_height = 1.2 (lens above ground [m]), distance = {metres, frame_a, a, b} (two marked points), "
            "gps = true (EXIF), marker = {family, id, size} (printed ArUco or AprilTag), poses_are_metric = true"
        )


def _check_obstacles(obstacles: tuple[ObstacleConfig, ...], path: Path) -> None:
    for one in obstacles:
        if one.kind not in OBSTACLE_KINDS:
            near = difflib.get_close_matches(one.kind, OBSTACLE_KINDS, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"expected {', '.join(OBSTACLE_KINDS)}"
            raise InputError(f"{path}: [[obstacle]] kind = {one.kind!r}; {hint}")
        for key, lengths, meaning in (("to", (0, 2), "station and lateral [m]"), ("color", (0, 3), "red, green, blue")):
            if len(getattr(one, key)) not in lengths:
                raise InputError(f"{path}: [[obstacle]] {key} = {list(getattr(one, key))}; expected {meaning}")
        if len(one.size) not in (0, 3) or any(not side > 0.0 for side in one.size):
            raise InputError(f"{path}: [[obstacle]] size = {list(one.size)}; expected length, width, height > 0 [m]")
        if not all(0.0 <= c <= 1.0 for c in one.color):
            raise InputError(f"{path}: [[obstacle]] color = {list(one.color)}; expected values from 0 to 1")
        if one.to and not one.speed > 0.0:
            raise InputError(f"{path}: [[obstacle]] speed = {one.speed}; expected more than 0 where it moves")
    names = [one.name for one in obstacles if one.name]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: two [[obstacle]] are named {twice!r}; give each a name of its own")
