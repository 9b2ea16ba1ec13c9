"""What a user may say in `scene.toml`: one frozen dataclass per stage, every field with its unit and its default.

A *source* is one film (or photo folder, or posed image set) under one *lighting*. Several sources may share a lighting.
How such a file is read and checked is in `config_file.py`.
"""

from dataclasses import dataclass, field

from twin.robot import HuskyParams

TRAINING, HELD_OUT, ANY = "training", "held-out", "any"
"""Said where a lighting's name could be: one drawn at random, as `twin/env/episode_lighting.py` has it."""
RESERVED_LIGHTINGS = (TRAINING, HELD_OUT, ANY)
"""So no lighting may be called so."""
RANDOMISED = "+randomised"
"""Ends the name of a lighting in tables: driven in that light, and all else drawn for every episode, too."""

KINDS = ("auto", "video", "images", "colmap", "transforms")
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
"""COLMAP's camera models and how many parameters each has."""
MARKER_FAMILIES = {
    **{f"DICT_{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    **{f"DICT_ARUCO_MIP_36{h}12": 250 for h in "hH"},
    **{f"DICT_APRILTAG_16{h}5": 30 for h in "hH"},
    **{f"DICT_APRILTAG_25{h}9": 35 for h in "hH"},
    **{f"DICT_APRILTAG_36{h}10": 2320 for h in "hH"},
    **{f"DICT_APRILTAG_36{h}11": 587 for h in "hH"},
}
"""OpenCV's dictionaries of markers and how many markers each has."""


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
    """Its name, none of `RESERVED_LIGHTINGS`; by default the file's stem."""
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
    keep: tuple[tuple[float, ...], ...] = ()
    """Which parts of this film are used, as `capture.keep`, which it replaces."""


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
    keep: tuple[tuple[float, ...], ...] = ()
    """Parts of every film that are used, [[from, to], ...] in seconds from its first frame, both ends included; in
    order and apart; empty = all of it. A route is one pass: of a film of two, keep one. Photos need a clock for it."""
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
    """Bricks of the baked field at most; 9,000 are some 105 MB. Its cells are as fine as that allows; where they are
    larger than 15 cm there may be 1.39 times as many, 146 MB."""
    max_width: int = 480
    """Images are trained at this longer side [px]."""
    refine_cameras: bool = False
    """Let the frames move a little while training, for cameras that are worth less than the pictures. The field and its
    scores are of the moved cameras; pictures in the report and photos of `twin.relight` keep those of structure from
    motion, and so are off by what `field.cameras_moved` in the report says."""
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
    """A stretch of the route to be driven, besides the standard tasks (see `twin/env/route_segments.py`)."""

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
