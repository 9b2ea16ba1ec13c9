"""Extrinsics of a robot's camera from a film that it took in a known place."""

import json
from dataclasses import replace

import cv2
import mujoco
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from textured import K, filmed_corridor, picture
from tiny_world import tiny_world

from twin import commands, runtime
from twin.assets.ground import Ground
from twin.capture.camera_models import Lens
from twin.capture.localize import _LocalizedFrame, _shared_focal, register_film
from twin.config_file import merge_robot, read_robot
from twin.errors import InputError
from twin.geometry.cameras import Rendering
from twin.geometry.images import read_image
from twin.geometry.poses import rotation_angle
from twin.mjcf import husky
from twin.mjcf.scene_xml import rest_pose
from twin.mjcf.world import World
from twin.robot import BASE_HEIGHT, HuskyParams
from twin.scene import write_stamp
from twin.sysid.camera_extrinsics import (
    CameraExtrinsics,
    base_heading,
    calibrate_camera,
    camera_pose_on_ground,
    estimate_extrinsics,
)
from twin.sysid.identification import toml_text

ASKEW = HuskyParams(camera_height=0.75, camera_yaw=1.4, camera_pitch=7.0, camera_roll=-2.0, camera_offset=(0.3, 0.05))
GIVEN = Lens("PINHOLE", tuple(K), 320, 240)


def hills(xy):
    """A road that falls to its sides and rolls along its length [m]."""
    x, y = np.asarray(xy, float).T
    return 0.05 * np.sin(x / 3.0) - 0.02 * np.abs(y) + 0.1


def drive(robot: HuskyParams, ground=hills, length: float = 18.0, count: int = 90, weave: float = 0.5) -> np.ndarray:
    """Poses of a robot's camera on a winding path; the base's origin moves along its heading."""
    x = np.linspace(0.0, length, count)
    heading = np.arctan(weave * 2.0 * np.pi / 11.0 * np.cos(2.0 * np.pi * x / 11.0))
    y = weave * np.sin(2.0 * np.pi * x / 11.0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, xy, yaw in zip(poses, np.stack([x, y], 1), heading, strict=True):
        origin, (w, *xyz) = rest_pose(ground, xy, yaw)
        base = Rotation.from_quat([*xyz, w]).as_matrix()
        pose[:3, :3] = base @ robot.camera_rotation * [1.0, -1.0, -1.0]
        pose[:3, 3] = origin + base @ robot.camera_position
    return poses


def shaken(poses: np.ndarray, metres: float, degrees: float, seed: int = 0) -> np.ndarray:
    rng, out = np.random.default_rng(seed), poses.copy()
    out[:, :3, 3] += rng.normal(0.0, metres, (len(out), 3))
    for pose in out:
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(rng.normal(0.0, np.deg2rad(degrees), 3))[0]
    return out


def test_angles_turn_the_camera():
    """In the compiled robot, a positive yaw turns the view left, a pitch turns it down, and a roll leans it to the
    right.
    """

    def axes(**angles: float) -> np.ndarray:
        spec = mujoco.MjSpec()
        husky.add_husky(spec, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), HuskyParams(camera_pitch=0.0, **angles))
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return data.camera("front").xmat.reshape(3, 3).T  # right, up, back

    right, up, back = axes()
    np.testing.assert_allclose([right, up, back], [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], atol=1e-12)
    sine, cosine = np.sin(np.deg2rad(20.0)), np.cos(np.deg2rad(20.0))
    np.testing.assert_allclose(-axes(camera_yaw=20.0)[2], [cosine, sine, 0.0], atol=1e-12)
    np.testing.assert_allclose(axes(camera_roll=20.0)[0], [0.0, -cosine, -sine], atol=1e-12)
    both = axes(camera_yaw=20.0, camera_roll=20.0)
    np.testing.assert_allclose(both @ both.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(-both[2], [cosine, sine, 0.0], atol=1e-12)  # roll does not change the viewing direction


def test_the_camera_is_where_the_model_has_it(tmp_path):
    """The computed pose is that of the camera of the compiled robot, at rest on the ground of a scene."""
    world = tiny_world(tmp_path)
    model = world.model()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    camera = data.camera("front")
    origin, axes = data.body("base_link").xpos, data.body("base_link").xmat.reshape(3, 3)
    heading = World.load(world.folder).spawn[3]

    def ground_at(xy: np.ndarray) -> np.ndarray:
        """The plane that the robot stands on."""
        normal = axes[:, 2]
        below = origin - BASE_HEIGHT * normal
        return below[2] - (xy - below[:2]) @ normal[:2] / normal[2]

    pose = camera_pose_on_ground(world.robot, camera.xpos[:2], heading, ground_at)
    np.testing.assert_allclose(pose[:3, 3], camera.xpos, atol=1e-4)
    np.testing.assert_allclose(pose[:3, :3] * [1, -1, -1], camera.xmat.reshape(3, 3), atol=1e-3)


def test_extrinsics_are_found():
    seat, error = estimate_extrinsics(drive(ASKEW), hills, ASKEW.camera_offset)
    assert seat.height == pytest.approx(0.75, abs=0.002)
    assert (seat.yaw, seat.pitch, seat.roll) == pytest.approx((1.4, 7.0, -2.0), abs=0.05)
    assert max(vars(error).values()) < 0.05


def test_standard_errors_cover_the_truth():
    poses = shaken(drive(ASKEW), 0.01, 0.3)
    seat, error = estimate_extrinsics(poses, hills, ASKEW.camera_offset)
    for name in ("height", "yaw", "pitch", "roll"):
        sigma = getattr(error, name)
        assert 0.0 < sigma < (0.01 if name == "height" else 0.3), name
        assert abs(getattr(seat, name) - getattr(ASKEW, f"camera_{name}")) < 3.5 * sigma, name


def test_yaw_from_driving_straight_or_backwards():
    for poses in (drive(ASKEW, weave=0.0), drive(ASKEW)[::-1]):
        assert estimate_extrinsics(poses, hills, ASKEW.camera_offset)[0].yaw == pytest.approx(1.4, abs=0.05)


def test_gaps_and_wrong_frames_do_no_harm():
    """Some frames were not localized, and one was localized in a wrong place."""
    poses = shaken(drive(ASKEW), 0.005, 0.1)
    astray = poses.copy()
    astray[44, :3, 3] += [5.0, 3.0, 2.0]
    lost = np.delete(poses, range(40, 52), 0)  # 2.4 m
    for film in (lost, astray):
        seat, error = estimate_extrinsics(film, hills, ASKEW.camera_offset)
        assert (seat.yaw, seat.pitch, seat.roll) == pytest.approx((1.4, 7.0, -2.0), abs=0.15)
        assert seat.height == pytest.approx(0.75, abs=0.005)
        assert error.yaw < 0.2


@pytest.mark.slow
def test_standard_errors_are_the_scatter_of_estimates():
    """Over many films, the errors scatter by 1/3 to 1.8 times the standard errors."""
    off = []
    for seed in range(24):
        seat, error = estimate_extrinsics(shaken(drive(ASKEW), 0.01, 0.3, seed), hills, ASKEW.camera_offset)
        names = ("height", "yaw", "pitch", "roll")
        off.append([(getattr(seat, n) - getattr(ASKEW, f"camera_{n}")) / getattr(error, n) for n in names])
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert np.all(rms > 1 / 3) and np.all(rms < 1.8), rms


def test_a_short_film_is_refused():
    poses = drive(ASKEW)
    with pytest.raises(InputError, match=r"10 frames .* over 1\.\d m; expected at least 16 over 6 m"):
        estimate_extrinsics(poses[:10], hills, (0.3, 0.0))
    with pytest.raises(InputError, match=r"20 frames .* over 3\.\d m"):
        estimate_extrinsics(poses[:20], hills, (0.3, 0.0))


# ---- a film on a place


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The textured corridor with flat ground."""
    runtime.set_quiet(True)
    scene = filmed_corridor(tmp_path_factory.mktemp("corridor") / "scene", frames=9)
    mesh = scene.stage("mesh")
    mesh.mkdir()
    flat = np.zeros((80, 240))
    Ground(flat, np.array([-4.0, -4.0]), 0.1, flat == 0.0, np.zeros((*flat.shape, 3), np.uint8)).save(mesh)
    scene.stage("field").mkdir()
    for stage in ("capture", "cameras", "metric", "field", "mesh"):
        write_stamp(scene.stage(stage), stage)
    return scene


LOW = replace(ASKEW, camera_height=1.1)


@pytest.fixture(scope="module")
def filmed():
    """Frames of a robot's camera in the corridor, and its true poses."""
    poses = drive(LOW, lambda xy: np.zeros(len(xy)), length=7.0, count=20, weave=0.3)
    return [picture(pose) for pose in poses], poses


@pytest.fixture(scope="module")
def registered(scene, filmed):
    """The frames localized without a given lens."""
    return register_film(filmed[0], None, scene)


@pytest.fixture
def found_once(registered, monkeypatch):
    """Replaces the slow localization by its stored result; a given lens is kept."""
    monkeypatch.setattr(
        "twin.sysid.camera_extrinsics.register_film",
        lambda frames, given, scene: replace(registered, lens=given or registered.lens),
    )


def test_a_film_is_registered_with_its_focal_length(registered, filmed):
    assert registered.frames.tolist() == list(range(len(filmed[0])))
    assert registered.lens.intrinsics == pytest.approx([K[0], K[0], K[2], K[3]], rel=0.01)
    assert 0.0 < registered.focal_error < 3.0
    for pose, true in zip(registered.camera_to_world, filmed[1], strict=True):
        assert np.linalg.norm(pose[:3, 3] - true[:3, 3]) < 0.06
        assert np.degrees(rotation_angle(pose[:3, :3].T @ true[:3, :3])) < 0.4


def test_frames_of_another_place_are_left_out(scene, filmed):
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    found = register_film([noise, filmed[0][4], noise, filmed[0][6]], GIVEN, scene)
    assert found.frames.tolist() == [1, 3] and found.lens == GIVEN and found.focal_error == 0.0
    with pytest.raises(InputError, match="none of the 2 frames shows the place"):
        register_film([noise, noise], GIVEN, scene)


@pytest.fixture(scope="module")
def film(filmed, tmp_path_factory):
    """The frames as a file."""
    path = tmp_path_factory.mktemp("film") / "robot.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 2.0, (320, 240))
    for frame in filmed[0]:
        writer.write(frame[..., ::-1])
    writer.release()
    return path


def test_a_camera_is_aligned_by_its_film(scene, film):
    known = HuskyParams(camera_intrinsics=tuple(K), camera_size=(320, 240), camera_offset=LOW.camera_offset)
    aligned, frames = calibrate_camera(film, scene, known)
    assert len(frames) == aligned.frames >= 19
    assert "camera_intrinsics" not in aligned.identified  # as it was given
    for name, limit in {"height": 0.02, "yaw": 0.4, "pitch": 0.3, "roll": 0.3}.items():
        value, error = aligned.identified[f"camera_{name}"]
        assert value == pytest.approx(getattr(LOW, f"camera_{name}"), abs=limit), name
        assert 0.0 < error < limit
    json.dumps(aligned.figures())


class Painted:
    """Stands in for the field: it shows the corridor, under two lightings; the second is the film's."""

    lightings = ("night", "day")

    def field(self):
        return self

    def render(self, views, lighting):
        (pose,), (intrinsics,), (size,) = views.camera_to_world, views.intrinsics, views.sizes
        rgb = picture(pose, tuple(size), intrinsics) / 255.0 * (1.0 if lighting == "day" else 0.1)
        return Rendering(rgb[None], rgb[None, ..., 0], rgb[None, ..., 0])


@pytest.fixture
def place(scene, monkeypatch):
    """The scene with an editable scene.toml and without robot parameters."""
    monkeypatch.setattr("twin.sysid.camera_extrinsics.load_scene", lambda root: Painted())
    before = scene.config_file.read_text()
    scene.config_file.write_text(before + "[metric]\ncamera_height = 1.2\n")
    yield scene
    scene.config_file.write_text(before)
    for made in (scene.root / "robot.toml", scene.root / "alignment" / "camera.json"):
        made.unlink(missing_ok=True)


def by_hand(place, text: str) -> None:
    with place.config_file.open("a") as file:
        file.write("[robot]\n" + text)


def test_the_verb_keeps_other_fields_and_prints_the_fit(place, film, found_once, capsys):
    """Values in robot.toml stay, but the focal length of an earlier film is fitted again; both pictures show the same
    spots.
    """
    robot = place.root / "robot.toml"
    robot.write_text("friction = 0.6\ncamera_intrinsics = [400.0, 400.0, 160.0, 120.0]\ncamera_size = [320, 240]\n")
    by_hand(place, "camera_offset = [0.3, 0.05]\nmax_speed = 0.8\n")
    assert commands.main("align", [str(place.config_file), str(film)]) == 0
    assert "camera_yaw = " in capsys.readouterr().out
    table = read_robot(robot)
    assert table["friction"] == 0.6 and "max_speed" not in table
    assert table["camera_intrinsics"] == pytest.approx([K[0], K[0], K[2], K[3]], rel=0.01)
    assert table["camera_height"] == pytest.approx(1.1, abs=0.02)
    figures = json.loads((place.root / "alignment" / "camera.json").read_text())
    assert figures["robot"]["camera_yaw"]["value"] == pytest.approx(table["camera_yaw"], rel=1e-4)
    both = read_image(place.root / "alignment" / "camera.png")
    assert both.shape == (3 * 240, 2 * 320, 3)
    filmed, seen = both[:, :320].astype(float), both[:, 320:].astype(float)
    alike = np.corrcoef(filmed.ravel(), seen.ravel())[0, 1]
    aside = np.corrcoef(filmed[:, 3:].ravel(), seen[:, :-3].ravel())[0, 1]
    assert alike > 0.6 and alike > aside + 0.1  # a degree is 4.5 px


def test_given_intrinsics_are_used(place, film, found_once, capsys):
    robot = place.root / "robot.toml"
    robot.write_text("camera_intrinsics = [400.0, 400.0, 320.0, 240.0]\ncamera_size = [640, 480]\n")
    by_hand(place, "camera_pitch = 5.0\ncamera_intrinsics = [520.0, 520.0, 320.0, 240.0]\ncamera_size = [640, 480]\n")
    assert commands.main("align", [str(place.root), str(film)]) == 0
    assert "overrides fitted values: camera_pitch;" in capsys.readouterr().out
    assert not {"camera_intrinsics", "camera_size"} & set(read_robot(robot))


def test_unusable_films_are_refused_in_one_line(place, film, registered, tmp_path, capsys, monkeypatch):
    def refused(*arguments: str) -> str:
        assert commands.main("align", list(arguments)) == 2
        return capsys.readouterr().err

    root = str(place.root)
    assert "nothing.mp4: no such film" in refused(root, str(tmp_path / "nothing.mp4"))
    for other in ("husky", str(place.root / "robot.toml")):
        assert "give the scene's folder" in refused(other, str(film))
    for more in (("--level",), ("--out", str(tmp_path))):
        assert "leave out --out and --level" in refused(root, str(film), *more)
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "scene.toml").write_text(place.config_file.read_text())
    assert "has no 2_metric yet; run twin build" in refused(str(bare), str(film))
    assert [path.name for path in bare.iterdir()] == ["scene.toml"]
    bent = replace(registered, error=0.9)
    with monkeypatch.context() as patch:
        patch.setattr("twin.sysid.camera_extrinsics.register_film", lambda *_: bent)
        assert "0.9 px (median) from where a pinhole camera would show them, expected at most 0.8; rectify" in refused(
            root, str(film)
        )
    (tmp_path / "text.mp4").write_text("no film")
    assert "text.mp4" in refused(root, str(tmp_path / "text.mp4"))
    by_hand(place, "camera_intrinsics = [520.0, 520.0, 640.0, 360.0]\ncamera_size = [1280, 720]\n")
    assert "the film is 320x240, but camera_intrinsics in [robot] are for 1280x720" in refused(root, str(film))
    assert not (place.root / "robot.toml").exists()


def test_a_size_without_its_intrinsics_is_refused():
    fitted = {"camera_intrinsics": [512.0, 512.0, 320.0, 180.0], "camera_size": [640, 360], "friction": 0.6}
    with pytest.raises(InputError, match=r"camera_size = \[1280, 720\], but robot\.toml has the camera_intrinsics"):
        merge_robot(fitted, {"camera_size": [1280, 720]}, "scene.toml")
    own = {"camera_intrinsics": [1000.0, 1000.0, 640.0, 360.0]}
    assert merge_robot(fitted, own, "scene.toml") == {"friction": 0.6, **own}


def test_unprintable_names_are_escaped(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(toml_text("fitted to b\nc\x01\udcff.mp4", {"friction": 0.5}, {}), encoding="utf-8")
    assert read_robot(path) == {"friction": 0.5}


def sights(nearest: float, farthest: float) -> list[_LocalizedFrame]:
    """Frames of points at such distances [m], seen with a focal length of 260 px."""
    rng, out = np.random.default_rng(0), []
    for _ in range(12):
        place = np.column_stack([rng.uniform(-3, 3, (80, 2)), rng.uniform(nearest, farthest, 80)])
        image = 260.0 * place[:, :2] / place[:, 2:] + [160.0, 120.0] + rng.normal(0.0, 0.3, (80, 2))
        out.append(_LocalizedFrame(image, place, pycolmap.Rigid3d(), simple(260.0)))
    return out


def simple(focal: float) -> Lens:
    return Lens("SIMPLE_PINHOLE", (focal, 160.0, 120.0), 320, 240)


@pytest.mark.parametrize("start", [245.0, 259.0, 275.0])
def test_the_focal_length_is_found_with_its_error(start):
    focal, error = _shared_focal(sights(3.0, 15.0), simple(start))
    assert 0.0 < error < 1.5 and abs(focal - 260.0) < 3.5 * error


def test_a_frontal_wall_does_not_determine_the_focal_length():
    with pytest.raises(InputError, match="does not determine the camera's focal length; give camera_intrinsics"):
        _shared_focal(sights(6.0, 6.01), simple(260.0))


@pytest.mark.parametrize(
    ("errors", "refused"),
    [
        *[(errors, True) for errors in ((0.001, 0.5, 0.1, 0.1), (0.001, 0.1, 0.4, 0.1), (0.001, 0.1, 0.1, 0.6))],
        ((0.04, 0.1, 0.1, 0.1), True),
        ((0.001, 0.29, 0.29, 0.45), False),
    ],
)
def test_uncertain_extrinsics_are_refused(scene, film, found_once, monkeypatch, errors, refused):
    vague = CameraExtrinsics(*errors)
    monkeypatch.setattr(
        "twin.sysid.camera_extrinsics.estimate_extrinsics", lambda *_: (CameraExtrinsics(1.0, 0.0, 5.0, 0.0), vague)
    )
    known = HuskyParams(camera_intrinsics=tuple(K), camera_size=(320, 240))
    if not refused:
        assert calibrate_camera(film, scene, known)[0].standard_errors == vague
        return
    turns = ", ".join(f"{turn:.2f}" for turn in errors[1:])
    with pytest.raises(InputError, match=rf"uncertain by {turns}° .* film a longer drive"):
        calibrate_camera(film, scene, known)


def test_heading_is_the_direction_of_the_base():
    poses = drive(ASKEW, weave=0.0, count=3)
    np.testing.assert_allclose(base_heading(poses, np.deg2rad(1.4)), 0.0, atol=2e-3)
