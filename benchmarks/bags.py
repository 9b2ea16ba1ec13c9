"""Benchmark of ROS 2 bags as input: builds a scene from films and from bags made of these films, and compares both.

    python benchmarks/bags.py SCENE --work FOLDER [--films sun] [--quick] [--again] [--until metric] [--json FILE]

SCENE is a generated place (`twin reality film`). For each film, FOLDER/bags gets a ROS 2 bag with the film's pictures
(raw, so that both builds read the same pixels) and their camera_info. The bag also contains other data that a robot
records, made from the true poses: odometry whose lengths are 2 % too long and whose heading drifts by 1° per meter, GPS
fixes whose error is a random walk with a standard deviation of 1 m, and /tf_static. Both scenes get their scale from
the camera's height. Then the bags' scene gets its scale from odometry, and then from GPS. Prints the figures of both
builds, and the error of each scale. With --again, the scene is built from the films twice, which shows how much two
builds from the same input differ.
"""

import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from record import record_parser, save
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "ros2" / "twin_policy"))

from twin.build import build
from twin.capture.video import FilmStatistics, decode, upright
from twin.errors import InputError
from twin.files import digest_file, remove, toml_string, write_text
from twin.geometry.cameras import Cameras
from twin.geometry.poses import inverse_pose, pose_of
from twin.new import new_scene
from twin.reality.recordings import BagMessages
from twin.reality.truth import Truth, camera_errors, compare, matched_poses
from twin.robot import CAMERA_AHEAD
from twin.scene import SceneDir

_START = 1_700_000_000 * 10**9  # [ns]
_RATE = 20.0  # [Hz] of odometry
_FIX_RATE = 5.0  # [Hz] of GPS fixes
_LONG, _TURN = 1.02, np.radians(1.0)  # odometry: factor of lengths, drift of the heading [rad/m]
_WANDER = 1.0  # [m] standard deviation of the fixes' error
_AHEAD, _BASE = 0.36, 0.13  # [m] lens ahead of the base, base above the ground
_EARTH = 6_378_137.0  # [m] radius
_QUICK = ("nerf.steps=400", "nerf.rays=2048", "nerf.max_width=240", "nerf.bake_steps=60", "nerf.max_bricks=2500")
FIGURES = (
    *(("capture", "frames"), ("cameras", "registered"), ("cameras", "points"), ("cameras", "reprojection_error_px")),
    *(("metric", "camera_height_median_m"), ("metric", "path_length_m"), ("metric", "scale_uncertainty")),
    *(("field", "psnr"), ("mesh", "parts"), ("mjcf", "route_length_m")),
    *(("truth", "ate_m"), ("truth", "scale_error"), ("truth", "ground_median_m")),
)


def write_bag(path: Path, film: Path, truth: Truth, name: str, seed: int) -> None:
    """Writes the bag of one film; its pictures are the film's decoded frames, turned upright."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    messages, rng = BagMessages(), np.random.default_rng(seed)
    types, poses = messages.types, truth.films[name].camera_to_world
    times = truth.films[name].times
    height = truth.camera_height
    # The camera on the robot is pitched by the mean pitch of the film's poses.
    pitch = float(np.mean(np.arcsin(-poses[:, 2, 2])))
    turn = Rotation.from_euler("Y", pitch).as_matrix() @ CAMERA_AHEAD
    seat = pose_of(turn, np.array([_AHEAD, 0.0, height - _BASE]))
    records: list[tuple[int, str, str, Any]] = []

    def add(time: float, topic: str, kind: str, message: Any) -> None:
        records.append((_START + round(time * 1e9), topic, kind, message))

    def header(time: float, frame: str) -> Any:
        return messages.header(_START + round(time * 1e9), frame)

    grid = np.arange(times[0], times[-1], 1.0 / _RATE)
    base = truth.poses(name, grid) @ inverse_pose(seat)
    odometry = _drifted(base)
    for time, pose in zip(grid - times[0], odometry, strict=True):
        add(time, "/platform/odom", "nav_msgs/msg/Odometry", messages.odometry(pose, _START + round(time * 1e9)))
    wander = np.cumsum(rng.normal(0.0, 1.0, (len(grid), 2)), axis=0)
    wander *= _WANDER / max(float(wander.std(axis=0).max()), 1e-9)
    for k in range(0, len(grid), round(_RATE / _FIX_RATE)):
        east, north = base[k, :2, 3] + wander[k]
        status = types["sensor_msgs/msg/NavSatStatus"](0, 1)
        latitude = 49.0 + float(np.degrees(north / _EARTH))
        longitude = 8.0 + float(np.degrees(east / _EARTH / np.cos(np.radians(49.0))))
        fix = types["sensor_msgs/msg/NavSatFix"](
            header(grid[k] - times[0], "gps"), status, latitude, longitude, 100.0, np.zeros(9), 2
        )
        add(grid[k] - times[0], "/fix", "sensor_msgs/msg/NavSatFix", fix)
    footprint = np.eye(4)
    footprint[2, 3] = -_BASE
    frames = [("base_link", "base_footprint", footprint), ("base_link", "camera", seat)]
    transforms = [_transform(types, header(0.0, parent), child, pose) for parent, child, pose in frames]
    add(0.0, "/tf_static", "tf2_msgs/msg/TFMessage", types["tf2_msgs/msg/TFMessage"](transforms))
    topics: dict[str, Any] = {}
    remove(path)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        def write(stamp: int, topic: str, kind: str, message: Any) -> None:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            writer.write(topics[topic], stamp, messages.store.serialize_cdr(message, kind))

        for record in sorted(records, key=lambda one: one[0]):
            write(*record)
        first: float | None = None
        for stamp, frame in decode(film, FilmStatistics()):
            image = upright(frame)
            first = stamp if first is None else first
            at = _START + round(((stamp or 0.0) - (first or 0.0)) * 1e9)
            rows, columns = image.shape[:2]
            info = messages.camera_info(truth.intrinsics.tolist(), (columns, rows), at)
            write(at, "/camera/camera_info", "sensor_msgs/msg/CameraInfo", info)
            raw = types["sensor_msgs/msg/Image"](
                messages.header(at), rows, columns, "rgb8", 0, 3 * columns, image.ravel()
            )
            write(at, "/camera/image_raw", "sensor_msgs/msg/Image", raw)


def _drifted(base: np.ndarray) -> np.ndarray:
    """Odometry with the errors `_LONG` and `_TURN`, in the frame of the first of the true poses `base` (n, 4, 4)."""
    local = inverse_pose(base[0]) @ base
    steps = np.diff(local[:, :3, 3], axis=0)
    way = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
    turn = Rotation.from_rotvec(np.outer(_TURN * way, [0.0, 0.0, 1.0]))
    out = local.copy()
    out[:, :3, :3] = turn.as_matrix() @ local[:, :3, :3]
    out[1:, :3, 3] = np.cumsum(_LONG * turn[:-1].apply(steps), axis=0)
    out[0, :3, 3] = 0.0
    return out


def _transform(types: Any, header: Any, child: str, pose: np.ndarray) -> Any:
    rotation = types["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(pose[:3, :3]).as_quat().tolist())
    shift = types["geometry_msgs/msg/Vector3"](*pose[:3, 3].tolist())
    return types["geometry_msgs/msg/TransformStamped"](
        header, child, types["geometry_msgs/msg/Transform"](shift, rotation)
    )


def figures(root: Path, report: dict[str, Any]) -> dict[str, Any]:
    """The compared figures of a build, by name."""
    scene = SceneDir(root)
    cameras = Cameras.load(scene.stage("metric"))
    errors: dict[str, Any] = camera_errors(cameras.camera_to_world, matched_poses(Truth.load(scene.truth), cameras))
    if "mjcf" in report:
        errors = compare(scene)["figures"]
    report = {**report, "truth": errors}
    out: dict[str, Any] = {}
    for section, name in FIGURES:
        value = report.get(section, {}).get(name)
        if value is None:
            continue
        for key, one in value.items() if isinstance(value, dict) else [("", value)]:
            out[f"{section}.{name}" + (f".{key}" if key else "")] = one
    return out


def main() -> int:
    parser = record_parser(__doc__)
    parser.add_argument("scene", type=Path, help="a folder written by `twin reality film`")
    parser.add_argument("--work", type=Path, required=True, help="folder for the bags and the scenes")
    parser.add_argument("--films", nargs="+", metavar="NAME", help="default: all")
    parser.add_argument("--again", action="store_true", help="build the scene from the films twice")
    parser.add_argument("--until", choices=("metric", "mjcf"), default="mjcf", help="last stage (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="train a small field, enough for a tiny place")
    options = parser.parse_args()
    truth = Truth.load(options.scene / "truth")
    table = tomllib.loads((options.scene / "scene.toml").read_text())
    names = options.films or list(truth.films)
    sources = {Path(one["path"]).stem: one for one in table["source"] if Path(one["path"]).stem in names}
    scenes = {kind: options.work / kind for kind in ("films", *(["again"] if options.again else []), "bags")}
    settings = [f'name = "{options.scene.name}"', "[metric]", f"camera_height = {truth.camera_height}"]
    for kind, root in scenes.items():
        (root / "input").mkdir(parents=True, exist_ok=True)
        shutil.copytree(options.scene / "truth", root / "truth", dirs_exist_ok=True)
        lines = list(settings)
        for k, (name, one) in enumerate(sources.items()):
            film = options.scene / one["path"]
            file = name if kind == "bags" else film.name
            lines += ["[[source]]", f'path = "input/{file}"', f"lighting = {toml_string(one['lighting'])}"]
            if kind == "bags":
                write_bag(root / "input" / file, film, truth, name, k)
                continue
            shutil.copyfile(film, root / "input" / file)
            if camera := one.get("camera"):  # a phone's film has no calibration
                lines.append(
                    f'camera = {{ model = "{camera["model"]}", params = {camera["params"]}, '
                    f"width = {camera['width']}, height = {camera['height']} }}"
                )
        write_text(root / "scene.toml", "\n".join(lines) + "\n")
    shown = options.work / "new"
    remove(shown)
    new_scene(shown, [scenes["bags"] / "input" / name for name in sources])
    overrides = _QUICK if options.quick else ()
    results = {
        kind: figures(root, build(root, until=options.until, overrides=overrides)) for kind, root in scenes.items()
    }
    same = _same_pictures(scenes)
    print(f"{'':34}" + "".join(f" {kind:>12}" for kind in results))
    for name in results["films"]:
        print(f"{name:34}" + "".join(f" {one[name]:12.5g}" for one in results.values()))
    print(f"{same:.1%} of the kept frames are the same files")
    scales = {}
    for name in ("odometry", "gps"):
        given = (f"metric.{name}=true", "metric.camera_height=0.0")
        try:
            metric = build(scenes["bags"], until="metric", overrides=(*overrides, *given))["metric"]
        except InputError as problem:  # for example, GPS on a short road
            print(f"scale by {name}: {problem}")
            continue
        cameras = Cameras.load(SceneDir(scenes["bags"]).stage("metric"))
        error = camera_errors(cameras.camera_to_world, matched_poses(truth, cameras))["scale_error"]
        scales[name] = {"scale_error": error, "uncertainty": metric["scale_uncertainty"]}
        print(f"scale by {name}: {error:+.2%} from the truth, stated uncertainty {metric['scale_uncertainty']:.2%}")
    return save(options.json, {"builds": results, "same_frames": same, "scales": scales}, options.replace_record)


def _same_pictures(scenes: dict[str, Path]) -> float:
    """Fraction of the frames kept in the films' scene that are also in the bags' scene, bit for bit."""
    images = {kind: SceneDir(root).stage("capture") / "images" for kind, root in scenes.items()}
    kept = sorted(path.relative_to(images["films"]) for path in images["films"].rglob("*.png"))
    equal = [
        (images["bags"] / path).exists() and digest_file(images["bags"] / path) == digest_file(images["films"] / path)
        for path in kept
    ]
    return float(np.mean(equal))


if __name__ == "__main__":
    sys.exit(main())
