"""Settings of `scene.toml`: one frozen dataclass per stage, with units, ranges and defaults; read by `config_file.py`.

A *source* is one film (or photo folder, or posed image set) under one *lighting*. Several sources may share a lighting.
With values outside their ranges a stage, often minutes into a build, runs out of memory, fails in its arithmetic or
never ends.
"""

from dataclasses import dataclass, field
from typing import Annotated

from twin.robot import HuskyParams
from twin.types import Range

TRAINING, HELD_OUT, ANY = "training", "held-out", "any"
"""Given in place of a lighting's name to sample one per episode; see `twin/env/episode_lighting.py`."""
RESERVED_LIGHTINGS = (TRAINING, HELD_OUT, ANY)
"""Not allowed as names of lightings."""
RANDOMIZED = "+randomised"
"""Suffix of randomized conditions in tables, see `Condition`; not allowed at the end of a lighting's name."""

CAUSES = ("goal", "collision", "out_of_bounds", "timeout", "rollover", "stuck")
"""Causes of an episode's or trial's end, in the order of tables; judges decide which one takes precedence."""
TWIST, STEERING = "twist", "steering"
"""Kinds of a policy's actions: speed and yaw rate, or the yaw rate at a fixed speed."""

KINDS = ("auto", "video", "bag", "images", "colmap", "transforms")
MAPPERS = ("auto", "global", "incremental")
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
    """Condition of an episode. Tables write it as `night` or `night+randomised`; only this class converts that text."""

    lighting: str
    """A name, a mixture, or one of `RESERVED_LIGHTINGS`; see `twin/env/episode_lighting.py`."""
    randomised: bool = False
    """Robot, weather and distractor objects are randomized; see `twin/env/domain_randomization.py`."""

    @staticmethod
    def parse(text: str) -> "Condition":
        lighting = text.removesuffix(RANDOMIZED)
        return Condition(lighting, lighting != text)

    def __str__(self) -> str:
        return self.lighting + RANDOMIZED * self.randomised


@dataclass(frozen=True)
class CalibrationConfig:
    """A calibrated camera, held fixed in structure from motion. Lengths [px] at `width` × `height`."""

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
    """Video file, robot's bag, image folder, COLMAP model folder or transforms.json, relative to the scene folder."""
    lighting: str = ""
    """Name of the lighting, not one of `RESERVED_LIGHTINGS`; by default the file's stem."""
    kind: str = "auto"
    """auto, video, bag, images, colmap or transforms."""
    topic: str = ""
    """The pictures' topic in a bag; by default the one with most pictures."""
    images: str = ""
    """Image folder of a COLMAP model or transforms.json, if not beside it."""
    mask: str = ""
    """One static mask image, or a folder of masks named like the frames; 0 = ignore."""
    camera: CalibrationConfig | None = None
    """Known intrinsics, held fixed; by default those of a bag's camera_info. Calibrate if possible: forward motion
    biases self-calibration."""
    camera_height: Annotated[float, Range(0)] = 0.0
    """Height of this source's lens above the ground [m], if sources differ; 0 = `metric.camera_height`."""
    keep: tuple[tuple[float, ...], ...] = ()
    """Segments of this film that are used; replaces `capture.keep`."""


@dataclass(frozen=True)
class CaptureConfig:
    """Selection of frames."""

    frames: Annotated[int, Range(0)] = 0
    """Number of frames to keep per source: the sharpest of each of that many equal time slots; 0: use `fps`."""
    fps: Annotated[float, Range(0.001, 1000)] = 2.0
    """Frames to keep per second of video, if `frames` is 0."""
    max_frames: Annotated[int, Range(2)] = 300
    """Upper bound per source."""
    max_size: Annotated[int, Range(64)] = 1280
    """Longer side of a kept frame [px], at least 64 for enough features; larger images are scaled down."""
    held_out_every: Annotated[int, Range(2)] = 8
    """Every n-th frame of each source is held out from training."""
    keep: tuple[tuple[float, ...], ...] = ()
    """Segments of every film that are used, [[from, to], ...] in seconds from its first frame, ends included, ordered
    and disjoint; empty = all. Photos need timestamps."""
    min_motion: Annotated[float, Range(0)] = 1.0
    """Frames with less motion since the last kept one [px, median optical flow at 320 px width] are dropped."""


@dataclass(frozen=True)
class CamerasConfig:
    """Structure from motion."""

    features: Annotated[int, Range(1, 1_000_000)] = 3000
    """Upper bound of SIFT features per frame."""
    max_feature_size: Annotated[int, Range(64, 100_000)] = 1280
    """Longer side of the image for feature detection [px]."""
    mapper: str = "auto"
    """auto (global, then incremental), global or incremental."""
    min_registered: Annotated[float, Range(0, 1)] = 0.6
    """Fraction of frames that must register, or the stage fails."""
    max_outlier: Annotated[float, Range(0.001)] = 0.3
    """Distance from the path through its neighbors beyond which a frame is an outlier [median steps of the film]."""
    free_focal: bool = False
    """Ignore given calibrations and self-calibrate (for comparison; a calibrated camera is better)."""


@dataclass(frozen=True)
class DistanceConfig:
    """Two points and the metres between them, marked in pixels of `build/2_cameras/images/<frame>.png`."""

    metres: float = 0.0
    frame_a: str = ""
    """Frame name such as `sunny/000012`. Points are triangulated from two frames, or lie on the ground."""
    a: tuple[float, ...] = ()
    """[u, v] of the first point in `frame_a`."""
    b: tuple[float, ...] = ()
    """[u, v] of the second point in `frame_a`."""
    frame_b: str = ""
    """A second frame with both points; empty = both points lie on the ground."""
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

    camera_height: Annotated[float, Range(0)] = 0.0
    """Lens above the ground [m], for a camera carried at constant height. 0 = not given."""
    camera_height_tolerance: Annotated[float, Range(0, 1)] = 0.01
    """Standard deviation of the error of `camera_height` [m]."""
    distance: DistanceConfig | None = None
    marker: MarkerConfig | None = None
    gps: bool = False
    """GPS positions: EXIF of the images, or NavSatFix of bags."""
    odometry: bool = False
    """Distances by the odometry of bags."""
    odometry_tolerance: Annotated[float, Range(0.0001, 0.5)] = 0.03
    """Standard deviation of the relative error of these distances: a few percent for wheels, less for LiDAR or RTK."""
    poses_are_metric: bool = False
    """The given poses (COLMAP model or transforms.json) are in metres."""
    up: str = "ground"
    """Source of the vertical: `ground` (plane of the road), `cameras` (mean camera up) or `poses` (given, z up)."""


@dataclass(frozen=True)
class NerfConfig:
    """The radiance field and its training; the defaults are those of quality "standard"."""

    quality: str = "standard"
    """"draft", "standard" or "high": sets those of `steps`, `bake_steps`, `detail_passes` and `max_width` that are not
    given, see `QUALITIES`."""
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
    bake_steps: Annotated[int, Range(1)] = 600
    """Fine-tuning steps of the baked field, which renders images."""
    detail_passes: Annotated[float, Range(0, 100)] = 2.0
    """How often each training pixel on a near surface is used to fit the detail that bricks lack; 0 = no detail."""
    max_bricks: Annotated[int, Range(100)] = 9000
    """Largest number of bricks (blocks of 8 × 8 × 8 cells with 8-bit samples) of the baked field, which determines the
    cell size; 9,000 take about 105 MB. It is raised by a factor of 1.39 (146 MB) if cells would exceed 15 cm. Fewer
    than 100 do not cover even the coarsest far grid."""
    max_width: Annotated[int, Range(32)] = 480
    """Longer side of training images [px]."""
    refine_cameras: bool = False
    """Refine camera poses while training, if they are less accurate than the images. The field and its scores use the
    refined poses; report images and `twin.relight` use the original ones, which differ from them by the report's
    `field.cameras_moved`."""
    learning_rate: Annotated[float, Range(1e-6, 1)] = 3e-2
    appearance_dim: Annotated[int, Range(1, 1024)] = 32
    levels: Annotated[int, Range(1, 32)] = 8
    log2_table: Annotated[int, Range(1, 24)] = 18
    near_half_extent: Annotated[float, Range(0, 100)] = 0.0
    """Half side of the uncontracted near box [m]; 0 = from the cameras."""
    near_plane: Annotated[float, Range(0, 100)] = 0.3
    """Distance from a camera up to which space is empty [m]."""


QUALITIES: dict[str, dict[str, int | float]] = {
    "draft": {"steps": 1000, "bake_steps": 300, "detail_passes": 1.0},
    "standard": {},
    "high": {"steps": 8000, "bake_steps": 3000, "detail_passes": 4.0, "max_width": 640},
}
"""Settings of `NerfConfig` by quality, where they differ from the defaults."""


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
    """Height at which obstacles are cut off, above the robot's reach [m]."""
    max_parts: Annotated[int, Range(0)] = 2000
    """Upper bound of convex parts."""
    max_protrusion: Annotated[float, Range(0.01)] = 0.2
    """Upper bound of a convex part's protrusion from its mesh [m]."""
    margin: Annotated[float, Range(1, 1000)] = 12.0
    """Distance from the route within which the place is meshed [m]."""
    views: Annotated[int, Range(1)] = 100
    """Upper bound of filmed poses from which depth is rendered for surface and ground."""
    view_width: Annotated[int, Range(8, 4096)] = 200
    """Width of these renderings [px]."""


@dataclass(frozen=True)
class RouteConfig:
    """The choice of the route among the filmed passes; by default the longest line of one lighting."""

    passes: tuple[str, ...] = ()
    """Passes in driving order, such as "noon:2", or "noon" for the longest one of that source; see the report."""
    points: tuple[tuple[float, ...], ...] = ()
    """Way points [x, y] [m] instead of passes, in the frame of the report's map, at most 1 m off what was filmed."""
    reverse: bool = False
    """Drive against the filmed direction. The camera then looks where nobody filmed."""
    max_gap: Annotated[float, Range(0, 50)] = 5.0
    """Longest unfilmed way between two passes that are joined [m]."""


@dataclass(frozen=True)
class MjcfConfig:
    """The MJCF scene."""

    route: bool = True
    """False for a capture around an object: no route and no Husky."""
    half_width: Annotated[float, Range(0.1, 100)] = 1.0
    """Half width of the drivable corridor around the route [m]."""
    hfield_cell: Annotated[float, Range(0.01, 10)] = 0.3
    """Cell of the collision height field [m], a multiple of `mesh.ground_cell`. A wheel on an edge between cells
    touches several facets, so smaller cells cause more vibration and cost more; the ground is smoothed to this scale
    (`mesh.ground_smoothing`)."""
    corridor_margin: Annotated[float, Range(0, 100)] = 0.0
    """Extra clearance between the corridor and convex parts [m]."""


@dataclass(frozen=True)
class ReviewConfig:
    """The review film."""

    speed: Annotated[float, Range(0.01)] = 1.0
    """Speed of the scripted follower [m/s]."""
    fps: Annotated[int, Range(1, 240)] = 10
    width: Annotated[int, Range(1, 4096)] = 480
    """Width of one panel of the film [px]."""
    render_width: Annotated[int, Range(1, 4096)] = 224
    """Longer side of renderings of the radiance field [px]; they are scaled up to the panel."""
    renders: Annotated[int, Range(0)] = 120
    """Number of renderings of the radiance field in the film; more give a smoother film and a longer build."""


OBSTACLE_KINDS = ("cone", "box", "bollard", "car", "pedestrian", "cyclist", "husky")


@dataclass(frozen=True)
class ObstacleConfig:
    """An obstacle on the route, static or moving to and fro."""

    name: str = ""
    """Its body in the model is `obstacle_<name>`; by default its kind and list index."""
    kind: str = ""
    """cone, box, bollard, car, pedestrian, cyclist or husky."""
    station: float = 0.0
    """Arc length on the route [m]."""
    lateral: float = 0.0
    """Distance from the route, left positive [m]."""
    yaw: float = 0.0
    """Yaw relative to the route's heading, or to its direction of motion if it moves [°]."""
    to: tuple[float, ...] = ()
    """(station, lateral) [m] of the turning point; the obstacle moves between it and its start. Empty: static."""
    speed: float = 1.2
    """Speed if it moves [m/s]."""
    delay: float = 0.0
    """Time for which it has been moving when the episode begins [s]."""
    color: tuple[float, ...] = ()
    """Main color as red, green, blue, 0 to 1; by default that of its kind."""
    size: tuple[float, ...] = ()
    """Length, width, height of a box [m]."""


@dataclass(frozen=True)
class TaskConfig:
    """A driving task on a segment of the route, in addition to those of `twin/env/route_segments.py`."""

    name: str = ""
    start: float = 0.0
    """Arc length on the route where it starts [m]."""
    length: float = 0.0
    """[m]"""


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
    mjcf: MjcfConfig = field(default_factory=MjcfConfig)
    robot: HuskyParams = field(default_factory=HuskyParams)
    """Values of `scene.toml` override those of `robot.toml` beside it, which override the defaults."""
    review: ReviewConfig = field(default_factory=ReviewConfig)
    task: tuple[TaskConfig, ...] = ()
    obstacle: tuple[ObstacleConfig, ...] = ()
