"""Settings of `scene.toml`: a frozen dataclass per section, with units, ranges and defaults; read by `config_file.py`.

A *source* is one film (or bag, photo folder, or posed image set) under one *lighting*. Several sources may share a
lighting. Ranges are checked before a build: beyond them, a stage may run out of memory, fail in its arithmetic or never
end.
"""

from dataclasses import dataclass, field
from typing import Annotated

from twin.ranges import Range
from twin.robot import HuskyParams

TRAINING, HELD_OUT, ANY = "training", "held-out", "any"
"""Names that stand for a lighting sampled for each episode; see `twin/env/episode_lighting.py`."""
RESERVED_LIGHTINGS = (TRAINING, HELD_OUT, ANY)
SAMPLED_LIGHTING = "drawn_"  # names of lightings sampled by a search begin with this
"""Not allowed as names of lightings."""
RANDOMIZED = "+randomised"
"""Suffix of randomized conditions in tables, see `Condition`; the name of a lighting must not end with it."""

MAX_CAMERA_HEIGHT = 100.0  # [m]

CAUSES = ("goal", "collision", "out_of_bounds", "timeout", "rollover", "stuck")
"""Causes that end an episode or trial, in the order of tables. If several apply at once, the code that ends the
episode picks one."""
TWIST, STEERING = "twist", "steering"
"""Kinds of actions of a policy: `twist` is speed and yaw rate, `steering` is the yaw rate at a fixed speed."""

KINDS = ("auto", "video", "bag", "images", "colmap", "transforms")
MAPPERS = ("auto", "averaging", "global", "incremental")
UPS = ("ground", "cameras", "poses")
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL": 5,
    "RADIAL_FISHEYE": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
}
"""COLMAP's camera models and their numbers of parameters."""
MARKER_FAMILIES = {
    **{f"DICT_{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    **{f"DICT_ARUCO_MIP_36{h}12": 250 for h in "hH"},
    **{f"DICT_APRILTAG_16{h}5": 30 for h in "hH"},
    **{f"DICT_APRILTAG_25{h}9": 35 for h in "hH"},
    **{f"DICT_APRILTAG_36{h}10": 2320 for h in "hH"},
    **{f"DICT_APRILTAG_36{h}11": 587 for h in "hH"},
}
"""OpenCV's marker dictionaries and their numbers of markers."""


@dataclass(frozen=True)
class Condition:
    """Lighting and randomization of an episode. In tables, this is a text such as `night` or `night+randomised`; only
    this class parses and writes it."""

    lighting: str
    """A name, a mixture, or one of `RESERVED_LIGHTINGS`; see `twin/env/episode_lighting.py`."""
    randomised: bool = False
    """True if robot, weather and distractor objects are randomized; see `twin/env/domain_randomization.py`."""

    @staticmethod
    def parse(text: str) -> "Condition":
        lighting = text.removesuffix(RANDOMIZED)
        return Condition(lighting, lighting != text)

    def __str__(self) -> str:
        return self.lighting + RANDOMIZED * self.randomised


@dataclass(frozen=True)
class CalibrationConfig:
    """A calibrated camera, held fixed in structure from motion. Lengths are in pixels of `width` × `height` images."""

    model: str = "PINHOLE"
    """A COLMAP camera model: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, OPENCV_FISHEYE, ..."""
    params: tuple[float, ...] = ()
    """Parameters in COLMAP's order: PINHOLE has fx, fy, cx, cy; OPENCV adds k1, k2, p1, p2."""
    width: int = 0
    height: int = 0


@dataclass(frozen=True)
class SourceConfig:
    """One film, bag, photo folder or posed image set under one lighting."""

    path: str = ""
    """Path of a video, robot's bag, image folder, COLMAP model or transforms.json, relative to the scene folder."""
    lighting: str = ""
    """Name of the lighting, not one of `RESERVED_LIGHTINGS`; by default the file's stem, with "_" for spaces."""
    kind: str = "auto"
    """auto, video, bag, images, colmap or transforms."""
    topic: str = ""
    """Topic of the pictures in a bag; by default the one with most pictures."""
    images: str = ""
    """Image folder of a COLMAP model or transforms.json; needed unless it is beside that file."""
    mask: str = ""
    """One static mask image, or a folder of masks named like the frames; 0 = ignore."""
    camera: CalibrationConfig | None = None
    """Known intrinsics, held fixed; for a bag, by default those of its camera_info. Calibrate the camera if possible,
    since forward motion biases self-calibration."""
    camera_height: Annotated[float, Range(0, MAX_CAMERA_HEIGHT)] = 0.0
    """Height of this source's lens above the ground [m], if sources differ; 0 = `metric.camera_height`."""
    keep: tuple[tuple[float, ...], ...] = ()
    """Segments of this film that are used, instead of those in `capture.keep`."""


@dataclass(frozen=True)
class CaptureConfig:
    """Selection of frames."""

    frames: Annotated[int, Range(0)] = 0
    """Number of frames to keep per source: the film is divided into this number of equal time slots, and the sharpest
    frame of each is kept. 0: use `fps`."""
    fps: Annotated[float, Range(0.001, 1000)] = 2.0
    """Number of frames to keep per second of video, if `frames` is 0."""
    max_frames: Annotated[int, Range(2)] = 300
    """Largest number of frames per source."""
    max_size: Annotated[int, Range(64)] = 1280
    """Longer side of a kept frame [px], at least 64 for enough features; larger images are scaled down."""
    held_out_every: Annotated[int, Range(2)] = 8
    """Every n-th frame of each source is held out from training."""
    keep: tuple[tuple[float, ...], ...] = ()
    """Segments of every film that are used, [[from, to], ...] in seconds from its first frame, ends included, ordered
    and disjoint; empty = all. Photos need timestamps."""
    min_motion: Annotated[float, Range(0)] = 1.0
    """Least median optical flow between a film's kept frames [px, at a width of 320 px]; others are dropped."""


@dataclass(frozen=True)
class CamerasConfig:
    """Structure from motion."""

    features: Annotated[int, Range(1, 1_000_000)] = 3000
    """Largest number of SIFT features per frame."""
    max_feature_size: Annotated[int, Range(64, 100_000)] = 1280
    """Longer side of the image for feature detection [px]."""
    mapper: str = "auto"
    """averaging (poses of pairs), COLMAP's global or incremental mapper; auto: in this order, until a model holds."""
    min_registered: Annotated[float, Range(0, 1)] = 0.6
    """Fraction of frames that must be registered; otherwise the stage fails."""
    max_outlier: Annotated[float, Range(0.001)] = 0.3
    """A frame farther than this from the path of its neighbors is an outlier [median distances between frames]."""
    free_focal: bool = False
    """Ignore given calibrations, and self-calibrate. Only for comparisons: a calibrated camera is more accurate."""


@dataclass(frozen=True)
class DistanceConfig:
    """Two points marked in pixels of `build/2_cameras/images/<frame>.png`, and the distance between them [m]."""

    metres: float = 0.0
    frame_a: str = ""
    """Name of the frame in which the points are marked, such as `sunny/000012`."""
    a: tuple[float, ...] = ()
    """[u, v] of the first point in `frame_a`."""
    b: tuple[float, ...] = ()
    """[u, v] of the second point in `frame_a`."""
    frame_b: str = ""
    """A second frame with both points, to triangulate them; empty = both points lie on the ground."""
    a2: tuple[float, ...] = ()
    b2: tuple[float, ...] = ()


@dataclass(frozen=True)
class MarkerConfig:
    """A printed square marker in the scene."""

    family: str = ""
    """An OpenCV dictionary: DICT_4X4_50, DICT_APRILTAG_36h11, ..."""
    id: int = 0
    size: float = 0.0
    """Side of the black square [m]."""


@dataclass(frozen=True)
class MetricConfig:
    """Sources of the metric scale: one, or several to be compared and combined."""

    camera_height: Annotated[float, Range(0, MAX_CAMERA_HEIGHT)] = 0.0
    """Lens above the ground [m], for a camera carried at constant height. 0 = not given."""
    camera_height_tolerance: Annotated[float, Range(0, 1)] = 0.01
    """Standard deviation of the error of `camera_height` [m]."""
    distance: DistanceConfig | None = None
    marker: MarkerConfig | None = None
    gps: bool = False
    """Use GPS positions: EXIF of the images, or NavSatFix of bags."""
    odometry: bool = False
    """Use distances by the odometry of bags."""
    odometry_tolerance: Annotated[float, Range(0.0001, 0.5)] = 0.03
    """Standard deviation of the relative error of these distances: a few percent for wheels, less for LiDAR or RTK."""
    poses_are_metric: bool = False
    """The given poses (COLMAP model or transforms.json) are in meters."""
    up: str = "ground"
    """Source of the vertical: `ground` (road, path, cameras), `cameras` (mean camera up) or `poses` (given, z up)."""


@dataclass(frozen=True)
class NerfConfig:
    """The radiance field and its training; the defaults are those of quality "standard"."""

    quality: str = "standard"
    """"draft", "standard" or "high": sets `steps`, `bake_steps`, `detail_passes` and `max_width` unless they are given,
    see `QUALITIES`."""
    steps: Annotated[int, Range(1)] = 2000
    rays: Annotated[int, Range(1, 2**20)] = 4096
    """Rays per step."""
    samples: Annotated[int, Range(1, 1024)] = 16
    """Samples per ray and step."""
    sightings: Annotated[float, Range(0, 0.7)] = 0.35
    """Fraction of each step's rays with depth supervision. The others are single pixels, and triples of neighboring
    pixels."""
    stereo: bool = True
    """Supervise depth from stereo between frames in addition to the sparse points."""
    poles: bool = True
    """Find lamp posts, signs and other poles in the films (`nerf/poles.py`), and make them visible and solid. Only if
    the camera's height above the ground is constant."""
    transients: bool = True
    """Do not train on objects that moved during a film, or that are present under some lightings only."""
    bake_steps: Annotated[int, Range(1)] = 600
    """Number of fine-tuning steps of the baked field, which renders the images."""
    detail_passes: Annotated[float, Range(0, 100)] = 2.0
    """How often each training pixel on a near surface is used to fit details that are too fine for bricks (see
    `max_bricks`); 0 = no detail."""
    max_bricks: Annotated[int, Range(100)] = 9000
    """Largest number of bricks (blocks of 8 × 8 × 8 cells with 8-bit samples) of the baked field. This number
    determines the cell size; 9,000 bricks take about 105 MB. If cells would exceed 15 cm, 1.39 times as many bricks
    are allowed (146 MB). Fewer than 100 bricks cannot cover the distant surroundings."""
    max_width: Annotated[int, Range(32)] = 480
    """Longer side of training images [px]."""
    refine_cameras: bool = False
    """Refine camera poses while training; useful if the poses are less accurate than the images. The field and its
    scores use the refined poses; report images and `twin.relight` use the original ones. `field.cameras_moved` in the
    report is the difference."""
    learning_rate: Annotated[float, Range(1e-6, 1)] = 3e-2
    appearance_dim: Annotated[int, Range(1, 1024)] = 32
    levels: Annotated[int, Range(1, 32)] = 8
    log2_table: Annotated[int, Range(1, 24)] = 18
    section_length: Annotated[float, Range(0, 100_000)] = 65.0
    """A longer road is divided into sections of about this length [m], each with `steps`, `max_bricks` and hash tables
    of its own; 0 = one section."""
    near_half_extent: Annotated[float, Range(0, 100)] = 0.0
    """Half side of the near box, in which space is not contracted [m]; 0 = from the camera positions."""
    near_plane: Annotated[float, Range(0, 100)] = 0.3
    """Distance from a camera up to which space is assumed empty [m]."""


QUALITIES: dict[str, dict[str, int | float]] = {
    "draft": {"steps": 1000, "bake_steps": 300, "detail_passes": 1.0},
    "standard": {},
    "high": {"steps": 8000, "bake_steps": 3000, "detail_passes": 4.0, "max_width": 640},
}
"""For each quality, the settings of `NerfConfig` that differ from the defaults."""


@dataclass(frozen=True)
class MeshConfig:
    """Surface mesh, ground and collision geometry."""

    voxel: Annotated[float, Range(0.01, 1)] = 0.15
    """Marching-cubes cell [m]."""
    ground_cell: Annotated[float, Range(0.01, 1)] = 0.1
    """Height field cell [m]."""
    ground_smoothing: Annotated[float, Range(0, 10)] = 0.25
    """Standard deviation of the height field's low-pass filter [m]."""
    obstacle_height: Annotated[float, Range(0)] = 0.2
    """Height above the ground from which geometry is an obstacle [m]."""
    max_height: Annotated[float, Range(0.1, 100)] = 2.5
    """Height above the ground at which obstacles are cut off; choose it above the robot's reach [m]."""
    max_parts: Annotated[int, Range(0)] = 2000
    """Largest number of convex parts, without those of poles; if the route is longer than 100 m, per 100 m of it."""
    max_protrusion: Annotated[float, Range(0.01)] = 0.2
    """Protrusion of a convex part from its mesh, above which the part is split [m]."""
    margin: Annotated[float, Range(1, 1000)] = 12.0
    """Distance from the route within which the place is meshed [m]."""
    views: Annotated[int, Range(1)] = 100
    """Largest number of filmed poses at which depth is rendered for surface and ground; if the route is longer than
    100 m, per 100 m of it."""
    view_width: Annotated[int, Range(8, 4096)] = 200
    """Width of these renderings [px]."""


@dataclass(frozen=True)
class RouteConfig:
    """The choice of the route among the filmed passes; by default the longest line of joined passes of one lighting."""

    passes: tuple[str, ...] = ()
    """Passes in driving order, such as "noon:2", or "noon" for the longest pass of that source; the report lists the
    passes."""
    points: tuple[tuple[float, ...], ...] = ()
    """Way points [x, y] [m] instead of passes, in the report map's coordinates, at most 1 m from the filmed paths."""
    reverse: bool = False
    """Drive against the filmed direction. The robot's camera then shows views that were not filmed."""
    max_gap: Annotated[float, Range(0, 50)] = 5.0
    """Longest unfilmed gap between two joined passes [m]."""


@dataclass(frozen=True)
class BranchConfig(RouteConfig):
    """Another route through the same place, such as a side road; its name is also that of a task, the whole branch."""

    name: str = ""


@dataclass(frozen=True)
class MjcfConfig:
    """The MJCF scene."""

    route: bool = True
    """False for a capture around an object: no route and no Husky."""
    half_width: Annotated[float, Range(0.1, 100)] = 1.0
    """Half width of the drivable corridor around the route [m]."""
    hfield_cell: Annotated[float, Range(0.01, 10)] = 0.3
    """Cell size of the collision height field [m], a multiple of `mesh.ground_cell`. Smaller cells take more time and
    cause more vibration, since a wheel on an edge between cells touches several facets. They add no detail: the ground
    is smoothed to about this scale (`mesh.ground_smoothing`)."""
    corridor_margin: Annotated[float, Range(0, 100)] = 0.0
    """Extra clearance between the corridor and convex parts [m]."""


@dataclass(frozen=True)
class ReviewConfig:
    """The review video."""

    speed: Annotated[float, Range(0.01)] = 1.0
    """Speed of the scripted follower [m/s]."""
    fps: Annotated[int, Range(1, 240)] = 10
    width: Annotated[int, Range(1, 4096)] = 480
    """Width of one panel of the video [px]."""
    render_width: Annotated[int, Range(1, 4096)] = 224
    """Longer side of renderings of the radiance field [px]; they are scaled up to the panel."""
    renders: Annotated[int, Range(0)] = 120
    """Number of renderings of the radiance field in the video; more renderings make the video smoother and the build
    longer."""


OBSTACLE_KINDS = ("cone", "box", "bollard", "car", "pedestrian", "cyclist", "husky")


@dataclass(frozen=True)
class ObstacleConfig:
    """An obstacle on the route, static or moving to and fro."""

    name: str = ""
    """Name of the obstacle, by default its kind and list index; its body in the model is `obstacle_<name>`."""
    kind: str = ""
    """cone, box, bollard, car, pedestrian, cyclist or husky."""
    station: float = 0.0
    """Arc length on the route [m]."""
    lateral: float = 0.0
    """Distance from the route, left positive [m]."""
    yaw: float = 0.0
    """Yaw relative to the route's heading or, for a moving obstacle, to its direction of motion [°]."""
    to: tuple[float, ...] = ()
    """(station, lateral) [m] of the turning point; the obstacle starts at `station` and `lateral`. Empty: static."""
    speed: float = 1.2
    """Speed if it moves [m/s]."""
    delay: float = 0.0
    """Time for which the obstacle has already been moving when the episode begins [s]."""
    color: tuple[float, ...] = ()
    """Main color as red, green, blue, each from 0 to 1; by default the color of its kind."""
    size: tuple[float, ...] = ()
    """Length, width, height of a box [m]."""
    route: str = ""
    """Name of the [[branch]] along which it stands, and in whose tasks it occurs; by default the route."""


@dataclass(frozen=True)
class TaskConfig:
    """A driving task on a segment of a route, in addition to those of `twin/env/route_segments.py`."""

    name: str = ""
    start: float = 0.0
    """Arc length on the route at which the segment starts [m]."""
    length: float = 0.0
    """Length of the segment [m], at least 1."""
    route: str = ""
    """Name of the [[branch]] that the task drives along; by default the route."""


@dataclass(frozen=True)
class SceneConfig:
    """A whole `scene.toml`."""

    name: str = ""
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0
    """Seed of all randomness in a build, 0 to 2³¹ − 1."""
    source: tuple[SourceConfig, ...] = ()
    capture: CaptureConfig = field(default_factory=CaptureConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    metric: MetricConfig = field(default_factory=MetricConfig)
    nerf: NerfConfig = field(default_factory=NerfConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    route: RouteConfig = field(default_factory=RouteConfig)
    branch: tuple[BranchConfig, ...] = ()
    mjcf: MjcfConfig = field(default_factory=MjcfConfig)
    robot: HuskyParams = field(default_factory=HuskyParams)
    """Values of `scene.toml` override those of `robot.toml` beside it, which override the defaults."""
    review: ReviewConfig = field(default_factory=ReviewConfig)
    task: tuple[TaskConfig, ...] = ()
    obstacle: tuple[ObstacleConfig, ...] = ()
