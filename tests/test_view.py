"""`twin view`: who is let in, camera paths, the film beside the twin, driving, and the page in a real browser."""

import ctypes
import json
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace
from http import HTTPStatus
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import viser
from chromium import Chromium, find_chromium
from films import video_info
from tiny_twin import tiny_twin
from viser._messages import GuiUpdateMessage
from websockets.exceptions import InvalidStatus
from websockets.http11 import Headers, Request
from websockets.sync.client import connect

import twin
from twin.__main__ import main
from twin.config import OBSTACLE_KINDS, ObstacleConfig
from twin.env.episode_lighting import EpisodeLighting
from twin.env.obstacles import obstacle_pose
from twin.env.route_segments import RouteSegment
from twin.errors import InputError
from twin.files import parse_toml
from twin.geometry.cameras import Cameras, Viewpoints
from twin.geometry.images import to_uint8, write_image
from twin.geometry.poses import look_at
from twin.geometry.shadow_map import OrthographicShadowMap
from twin.loading import Twin
from twin.nerf.lightings import Fog
from twin.nerf.sun import Sun
from twin.report import build_report as report_page
from twin.report.video_writer import read_frames
from twin.runtime import Stopped
from twin.scene import write_stamp
from twin.view import __main__ as view_verb
from twin.view import guarded_server
from twin.view.__main__ import load_driving, open_page
from twin.view.camera_path import CameraPath, KeyView, named_lighting, spaced_times
from twin.view.driving import KEYS_DRIVER, SCRIPTED_DRIVER, Driving, PlacedObstacles, station_and_lateral
from twin.view.guarded_server import Gate, HeldKeys, open_server
from twin.view.layers import _trust_map, clicked_frame, scene_layers
from twin.view.panels import PathPanel, slider_lighting
from twin.view.picture_loop import COARSE_AREA, FilmedFrame, PictureLoop, Shot, add_film, film_camera, picture_size
from twin.view.scene_picture import FreeCamera, ObjectState, ScenePicture

SIZE = (160, 90)
INTRINSICS = np.array([100.0, 100.0, 80.0, 45.0])


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """The tiny twin, filmed from four places along its route: pictures of its field."""
    root = tiny_twin(tmp_path_factory.mktemp("view") / "scene")
    opened = twin.load_scene(root)
    poses = np.array([look_at(np.array([x, 0.0, 1.3]), np.array([x + 3.0, 0.2, 1.0])) for x in (0.0, 0.5, 1.0, 1.5)])
    images = opened.scene.stage("cameras") / "images"
    names = tuple(f"day/{k:06d}" for k in range(4))
    shown = opened.field().render(Viewpoints.of(poses, INTRINSICS, SIZE), "day")
    for name, rgb in zip(names, shown.rgb, strict=True):
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(images / f"{name}.png", to_uint8(rgb))
    Cameras(
        names=names,
        camera_to_world=poses,
        intrinsics=np.tile(INTRINSICS, (4, 1)),
        sizes=np.tile(SIZE, (4, 1)),
        lightings=("day",) * 4,
        sources=("day",) * 4,
        times=np.arange(4.0),
        held_out=np.array([False, True, False, False]),
        images=images,
    ).save(opened.scene.stage("metric"))
    write_stamp(opened.scene.stage("metric"), "metric")
    return root


@pytest.fixture(scope="module")
def scene(root) -> Twin:
    return twin.load_scene(root)


@pytest.fixture(scope="module")
def field(scene):
    return scene.field()


# ---- who is let in


def _request(path: str = "/", **headers: str) -> Request:
    return Request(path, Headers({name.replace("_", "-"): value for name, value in headers.items()}))


def test_without_a_token_only_this_machines_own_pages_are_answered():
    gate = Gate(8080, None)
    # Any port, since there may be a tunnel, and any loopback address, since `--host` may name it.
    for host in ("127.0.0.1:8080", "localhost:9000", "LOCALHOST", "[::1]:8080", "127.0.0.2:8080"):
        assert gate.refusal(_request(Host=host)) is None
    for host in ("evil.example", "127.0.0.1.evil.example:8080", "[::2]:8080", "128.0.0.1", "::1", "[::1", ""):
        assert gate.refusal(_request(Host=host)).status_code == HTTPStatus.FORBIDDEN
    assert gate.refusal(Request("/", Headers())).status_code == HTTPStatus.FORBIDDEN
    own, other = "http://localhost:8080", "http://evil.example"
    assert gate.refusal(_request(Host="localhost:8080", Upgrade="websocket", Origin=own)) is None
    for origin in (other, "null", "http://localhost:9000"):
        refused = gate.refusal(_request(Host="localhost:8080", Upgrade="websocket", Origin=origin))
        assert refused.status_code == HTTPStatus.FORBIDDEN


def test_a_token_is_asked_of_every_request_and_handshake():
    gate = Gate(8080, "secret")
    assert gate.refusal(_request(Host="robot:8080", Cookie="a=b; twin_8080=secret")) is None
    for request in (
        _request(Host="robot:8080"),
        _request("/?token=wrong", Host="robot:8080"),
        _request("/?token=secret&token=secret", Host="robot:8080"),
        _request(Host="robot:8080", Cookie="twin_8080=secre"),
        _request(Host="robot:8080", Cookie="twin_9000=secret"),
        _request("/?token=secret", Host="robot:8080", Upgrade="websocket"),  # a handshake needs the cookie
    ):
        assert gate.refusal(request).status_code == HTTPStatus.UNAUTHORIZED
    answer = gate.refusal(_request("/?token=secret", Host="robot:8080"))
    assert answer.status_code == HTTPStatus.SEE_OTHER and answer.headers["Location"] == "/"
    assert "HttpOnly" in answer.headers["Set-Cookie"] and "twin_8080=secret" in answer.headers["Set-Cookie"]
    other_site = _request(Host="robot:8080", Upgrade="websocket", Origin="http://evil", Cookie="twin_8080=secret")
    assert gate.refusal(other_site).status_code == HTTPStatus.FORBIDDEN


def test_the_server_itself_asks_for_the_token(capsys):
    served = open_server("0.0.0.0", 0, "test")
    try:
        port, token = served.port, served.url.partition("?token=")[2]
        assert len(token) >= 32 and f":{port}/" in served.url
        at = f"127.0.0.1:{port}"
        for path in ("/", "/index.html", "/?token=x"):
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(f"http://{at}{path}")
            assert refused.value.code == HTTPStatus.UNAUTHORIZED
            refused.value.close()
        for path in ("", "/keys"):
            with pytest.raises(InvalidStatus) as rejected:
                connect(f"ws://{at}{path}")
            assert rejected.value.response.status_code == HTTPStatus.UNAUTHORIZED
        cookies = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        with cookies.open(f"http://{at}/?token={token}") as page:
            assert page.url == f"http://{at}/" and b'"/keys"' in page.read()
        cookie = {"Cookie": f"twin_{port}={token}"}
        with connect(f"ws://{at}/keys", additional_headers=cookie) as keys:
            assert json.loads(keys.recv()) == {"driving": False}
            keys.send("wx")
            _wait(lambda: served.keys.held() == {"w"})
            served.set_driving(True)
            assert json.loads(keys.recv()) == {"driving": True}
        _wait(lambda: not served.keys.held())
    finally:
        served.stop()
    assert capsys.readouterr().out == ""


def test_a_page_waiting_for_messages_is_woken_on_its_own_thread_only():
    served = open_server("127.0.0.1", 0, "test")
    try:
        server = served.viser._websock_server
        with connect(f"ws://127.0.0.1:{served.port}", subprotocols=[f"viser-v{viser.__version__}"]):
            _wait(lambda: server._client_state_from_id)
            (page,) = server._client_state_from_id.values()
            for buffer in (server._broadcast_buffer, page.message_buffer):
                _wait(lambda: buffer.message_event._waiters)  # noqa: B023
                buffer.message_event.set()
                assert not buffer.message_event.is_set()
                sent = buffer.message_counter
                buffer.push(GuiUpdateMessage("none", {}))
                _wait(lambda: min(buffer.generator_cursors.values()) >= sent)  # noqa: B023
    finally:
        served.stop()


def test_keys_count_only_while_they_are_reported(monkeypatch):
    now = [10.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    keys = HeldKeys()
    keys.report(1, "wq")
    keys.report(2, "a")
    assert keys.held() == {"w", "a"}
    keys.report(2, "")
    assert keys.held() == {"w"}
    now[0] += 0.4  # the page has fallen silent
    assert keys.held() == frozenset()


# ---- camera paths


def _path(field, count: int = 4) -> CameraPath:
    rng = np.random.default_rng(0)
    poses = [look_at(rng.normal(0, 2, 3), rng.normal(0, 2, 3) + np.array([9.0, 0.0, 0.0])) for _ in range(count)]
    times, lights = spaced_times(poses, 1.0, 0.5), [named_lighting(field, name) for name in ("day", "night")]
    return CameraPath(
        tuple(KeyView(t, p, 50.0 + k, lights[k % 2]) for k, (t, p) in enumerate(zip(times, poses, strict=True)))
    )


@pytest.mark.parametrize("count", [2, 4])
def test_a_path_passes_its_views_and_moves_smoothly(field, count):
    path = _path(field, count)
    knots = np.array([view.time for view in path.views])
    for (pose, fov, lighting), view in zip(path.at(knots), path.views, strict=True):
        np.testing.assert_allclose(pose, view.camera_to_world, atol=1e-9)
        assert fov == pytest.approx(view.fov)
        np.testing.assert_allclose(lighting.start, view.lighting.start, atol=1e-6)
    fine = np.linspace(0.0, path.duration, 2001)
    poses = np.array([pose for pose, _, _ in path.at(fine)])
    products = poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
    step = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.abs(np.diff(step)).max() < 0.02 * step.max()
    middle = path.at(np.array([(knots[0] + knots[1]) / 2]))[0][2]
    np.testing.assert_allclose(middle.start, 0.5 * (field.embedding("day") + field.embedding("night")), atol=1e-6)


def test_a_saved_path_is_the_same(field, tmp_path):
    path = _path(field)
    sampled = KeyView(99.0, np.eye(4), 70.0, EpisodeLighting("sampled lighting 1", np.full(4, 0.3, np.float32)))
    path = CameraPath((*path.views, sampled))
    path.save(tmp_path / "path.json")
    again = CameraPath.load(tmp_path / "path.json", field)
    for one, other in zip(path.views, again.views, strict=True):
        assert (one.time, one.fov) == (other.time, other.fov)
        np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)
        np.testing.assert_array_equal(one.lighting.start, other.lighting.start)


_VIEW = {"time": 0.0, "camera_to_world": np.eye(4).tolist(), "fov": 60.0, "lighting": "day"}


@pytest.mark.parametrize(
    "views, said",
    [
        ([_VIEW], "1 views; expected 2"),
        ([_VIEW, _VIEW], "increasing"),
        ([_VIEW, {**_VIEW, "time": 1.0, "lighting": "noon"}], "'noon': unknown"),
        ([_VIEW, {**_VIEW, "time": 1.0, "lighting": [1.0]}], "expected a name, 4 numbers"),
        ([_VIEW, {**_VIEW, "time": 1.0, "lighting": {"from": "day", "to": "night", "share": 2.0}}], "share 2.0 is not"),
        ([_VIEW, {**_VIEW, "time": 1.0, "fov": 179.0}], "fov 179"),
        ([_VIEW, {**_VIEW, "time": 1.0, "camera_to_world": (2.0 * np.eye(4)).tolist()}], "not a rotation"),
        ([_VIEW, {**_VIEW, "time": 1.0, "camera_to_world": [[1.0]]}], "4×4"),
        ([_VIEW, {"time": 1.0}], "camera_to_world"),
        ("views", "expected a list"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_a_bad_path_is_one_line(root, tmp_path, capsys, views, said):
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"format": 1, "views": views}))
    assert main(["view", str(root), "--path", str(file), "--out", str(tmp_path / "a.mp4")]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and said in told and told.count("\n") == 1
    assert not list(tmp_path.glob("*.mp4*"))


def test_a_path_becomes_a_film(root, field, tmp_path, capsys):
    pose = look_at(np.array([0.0, 0.0, 1.3]), np.array([3.0, 0.0, 1.0]))
    ahead = pose.copy()
    ahead[0, 3] += 1.0
    day, night = (named_lighting(field, name) for name in ("day", "night"))
    CameraPath((KeyView(0.0, pose, 60.0, day), KeyView(1.0, ahead, 60.0, night))).save(tmp_path / "path.json")
    out = tmp_path / "film.mp4"
    given = ["--path", str(tmp_path / "path.json"), "--out", str(out), "--size", "96x54", "--fps", "8"]
    assert main(["view", str(root), *given]) == 0
    assert "9 frames, 1.0 s" in capsys.readouterr().out
    about = video_info(out)
    assert (about["width"], about["height"], about["fps"], about["frames"]) == (96, 54, 8.0, 9)
    shown = list(read_frames(out))
    errors = np.empty((2, 2))
    for k, (where, lighting) in enumerate(((pose, "day"), (ahead, "night"))):
        camera = FreeCamera.of_fov(where, np.deg2rad(60.0), (96, 54))
        rendered = field.render(Viewpoints.of(camera.camera_to_world, camera.intrinsics, camera.size), lighting).rgb[0]
        errors[k] = [np.abs(frame - 255.0 * np.clip(rendered, 0.0, 1.0)).mean() for frame in (shown[0], shown[-1])]
    assert errors[0, 0] < 12.0 and errors[1, 1] < 12.0 and min(errors[0, 1], errors[1, 0]) > 25.0


def test_views_without_a_lighting_have_the_one_given(field, tmp_path):
    views = [{k: v for k, v in _VIEW.items() if k != "lighting"}, {**_VIEW, "time": 1.0}]
    (tmp_path / "path.json").write_text(json.dumps({"format": 1, "views": views}))
    for given, names in ((None, ["day", "day"]), ("night", ["night", "day"])):
        path = CameraPath.load(tmp_path / "path.json", field, given)
        assert [view.lighting.name for view in path.views] == names


@pytest.mark.parametrize(
    "given, said",
    [
        (["--path", "a.json"], "--path and --out belong together"),
        (["--path", "none.json", "--out", "a.avi"], "expected a file ending in .mp4"),
        (["--path", "none.json", "--out", "a.mp4"], "none.json"),
        (["--path", "a", "--out", "a.mp4", "--size", "100x33"], "even sides"),
        (["--path", "a", "--out", "a.mp4", "--fps", "0"], "--fps 0"),
        (["--path", "a", "--out", "a.mp4", "--lighting", "noon"], "'noon': unknown"),
        (["--path", "a", "--out", "a.mp4", "--policy", "first"], "--policy first: only the page has it"),
        (["--path", "a", "--out", "a.mp4", "--port", "0"], "--port 0: only the page has it"),
        (["--size", "320x180", "--port", "70000"], "--size 320x180: only a film has it"),
        (["--fps", "0", "--port", "70000"], "--fps 0: only a film has it"),
        (["--port", "70000"], "--port 70000"),
        (["--lighting", "noon"], "'noon': unknown"),
        (["--host", "203.0.113.9"], "--host '203.0.113.9'"),
        (["--port", "0", "--task", "none"], "task 'none'"),
        (["--port", "0", "--policy", "none"], "none"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_wrong_options_are_one_line(root, tmp_path, monkeypatch, capsys, given, said):
    monkeypatch.chdir(tmp_path)
    assert main(["view", str(root), "--quiet", *given]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ") and said in told and told.count("\n") == 1


def test_a_misspelt_lighting_is_told_before_the_address(root, capsys):
    assert main(["view", str(root), "--port", "0", "--lighting", "nigth"]) == 2
    told = capsys.readouterr()
    assert told.out == "" and "'nigth': unknown; did you mean 'night'?" in told.err


# ---- pictures


def test_the_slider_goes_from_lighting_to_lighting(field):
    np.testing.assert_array_equal(slider_lighting(field, 0.0).start, field.embedding("day"))
    np.testing.assert_array_equal(slider_lighting(field, 1.0).start, field.embedding("night"))
    np.testing.assert_array_equal(slider_lighting(field, 0.25).start, field.embedding("day:night:0.25"))


def test_pictures_have_the_shape_of_the_page_and_at_most_their_area():
    assert picture_size((1280, 720), COARSE_AREA) == (320, 180)
    assert picture_size((200, 100), COARSE_AREA) == (200, 100)
    assert picture_size((0, 600), COARSE_AREA) is None
    for page in ((956, 720), (720, 956), (3840, 300)):
        width, height = picture_size(page, COARSE_AREA)
        assert width * height == pytest.approx(COARSE_AREA, rel=0.05)
        assert width / height == pytest.approx(page[0] / page[1], rel=0.03)


def test_film_and_twin_meet_at_the_dividing_line(scene, field):
    cameras = scene.cameras()
    film = np.full((90, 160, 3), 200, np.uint8)
    film[:, 40:] = (10, 200, 30)
    for size, (left, top) in {(320, 180): (0, 0), (320, 240): (0, 30), (400, 180): (40, 0)}.items():
        frame = FilmedFrame(film, cameras.camera_to_world[0], INTRINSICS, 0.5)
        camera = film_camera(frame, size)
        rendered = to_uint8(ScenePicture(field).render(camera, named_lighting(field, "day")).rgb[0])
        both = rendered.copy()
        add_film(both, frame, camera)
        middle, row = size[0] // 2, size[1] // 2
        np.testing.assert_array_equal(both[row, middle + 2 :], rendered[row, middle + 2 :])
        np.testing.assert_array_equal(both[row, :left], rendered[row, :left])
        expected = cv2.resize(film, (320, 180), interpolation=cv2.INTER_CUBIC)[row - top, : middle - left]
        np.testing.assert_array_equal(both[row, left : middle - 1], expected[:-1])
    # The frame itself was rendered: with it as film, the line cannot be seen.
    frame = FilmedFrame(cv2.imread(str(cameras.image_path(0)))[..., ::-1], cameras.camera_to_world[0], INTRINSICS, 1.0)
    camera = film_camera(frame, SIZE)
    rendered = to_uint8(ScenePicture(field).render(camera, named_lighting(field, "day")).rgb[0])
    both = rendered.copy()
    add_film(both, frame, camera)
    assert np.abs(both[:60, :-2].astype(int) - rendered[:60, :-2]).max() <= 1  # the label is below


def test_a_lightings_fog_is_laid_over_the_picture(field):
    camera = FreeCamera.of_fov(look_at(np.array([0.0, 0.0, 1.3]), np.array([3.0, 0.0, 1.0])), 1.0, SIZE)
    clear, picture = named_lighting(field, "day"), ScenePicture(field)
    foggy = EpisodeLighting("day", clear.start, fog=Fog(0.2, (1.0, 0.0, 0.5)))
    one, other = picture.render(camera, clear), picture.render(camera, foggy)
    v, u = np.mgrid[:90, :160] + 0.5
    rays = np.stack([(u - 80) / camera.intrinsics[0], (v - 45) / camera.intrinsics[1], np.ones_like(u)], -1)
    distance = (one.depth[0] * np.linalg.norm(rays, axis=-1)).astype(np.float32)
    np.testing.assert_allclose(other.rgb[0], foggy.fog.apply(one.rgb[0], distance), atol=1e-5)


def test_a_click_finds_the_filmed_camera(scene):
    cameras = scene.cameras()
    origin = np.array([-3.0, 0.0, 1.3])
    for i in range(4):
        aside = np.array([-1.0, 3.0, 2.0])
        assert clicked_frame(cameras, aside, cameras.positions[i] - aside) == i
    assert clicked_frame(cameras, origin, np.array([-1.0, 0.0, 0.0])) is None


@pytest.mark.parametrize("half_width", [1.0, 1.2])  # at 1.2 m, the last step ends 1e-15 m beyond the last offset
def test_the_trust_map_covers_the_corridor(scene, field, half_width):
    shown = SimpleNamespace(add_point_cloud=lambda path, points, colors, **look: points)
    world = replace(scene.world(), half_width=half_width)
    points = _trust_map(shown, "/trust", scene, world, scene.cameras(), field)
    at_start = points[np.abs(points[:, 0] - world.route[0, 0]) < 1e-6]
    assert np.ptp(at_start[:, 1]) == pytest.approx(8.0 * half_width, abs=0.4)


def test_the_report_says_how_to_look_at_the_scene(scene):
    commands = [line for _, lines in report_page._next_steps(scene.scene, {}) for line in lines]
    assert f"twin view {scene.scene.root}" in commands
    viewer = next(line for line in commands if "mujoco.viewer" in line)
    assert Path(shlex.split(viewer)[-1].removeprefix("--mjcf=")).is_file()


# ---- driving


def test_station_and_lateral_are_the_inverse_of_the_pose(scene):
    route = scene.world().route
    for xy in np.random.default_rng(0).uniform((-8.0, -10.0), (14.0, 6.0), (60, 2)):  # inside and outside of the bend
        station, lateral = station_and_lateral(route, xy)
        x, y, _ = obstacle_pose(ObstacleConfig(station=station, lateral=lateral), route, 0.0)
        np.testing.assert_allclose([x, y], xy, atol=2e-3)


class _Drive:
    """A drive whose keys and facts a test sets and reads; its thread does not run, and the test makes the steps."""

    def __init__(self, scene, field, policy=None):
        self.keys, self.facts, self.errors = frozenset(), [], []
        told = lambda: self.keys, self.facts.append, self.errors.append
        self.driving = Driving(scene, field, "ahead", policy, named_lighting(field, "day"), *told)

    def steps(self, count: int, keys: str = ""):
        self.keys = frozenset(keys)
        for _ in range(count):
            self.driving._advance()
        return self.facts[-1]


@pytest.fixture(scope="module")
def drive(scene, field):
    drive = _Drive(scene, field)
    yield drive
    drive.driving.close()


def test_keys_drive_ahead_back_and_around(drive):
    drive.driving.choose(KEYS_DRIVER)
    drive.driving.reset()
    start = drive.facts[-1].base_to_world
    ahead = drive.steps(15, "w")
    forward = (ahead.base_to_world[:3, 3] - start[:3, 3]) @ start[:3, 0]
    assert 0.5 < forward < 1.6 and ahead.speed > 0.7 and ahead.torque.shape == (2,)
    back = drive.steps(25, "s")
    assert (back.base_to_world[:3, 3] - ahead.base_to_world[:3, 3]) @ start[:3, 0] < -0.5
    turned = drive.steps(10, "a")
    assert turned.yaw_rate > 0.2 and turned.torque[1] > turned.torque[0]
    still = drive.steps(20)
    assert abs(still.speed) < 0.05 and abs(still.yaw_rate) < 0.05
    assert still.image.shape == (90, 160, 3) and still.image.std() > 5.0


def test_the_lighting_of_the_robots_picture_follows(drive, field):
    drive.driving.choose(KEYS_DRIVER)
    drive.driving.set_lighting(named_lighting(field, "day"))
    drive.driving.reset()
    day = drive.facts[-1].image.astype(float)
    drive.driving.set_lighting(named_lighting(field, "night"))
    drive.driving.reset()
    assert np.abs(drive.facts[-1].image - day).mean() > 5.0


def test_an_obstacle_stands_where_it_was_put_and_stops_the_robot(drive):
    driving = drive.driving
    driving.choose(KEYS_DRIVER)
    driving.reset()
    x, y, _ = drive.facts[-1].base_to_world[:3, 3]
    name = driving.obstacles.free("car")
    driving.obstacles.put(name, x + 4.2, y, np.pi / 2)
    driving.update_obstacles()
    body = driving.environment.physics.model.ptr.body(f"obstacle_{name}")
    np.testing.assert_allclose(driving.environment.physics.data.ptr.xpos[body.id, :2], [x + 4.2, y], atol=0.01)
    np.testing.assert_allclose(driving.obstacles.pose(name), [x + 4.2, y, np.pi / 2], atol=0.01)
    assert f'name = "{name}"' in driving.obstacles.toml()
    facts = drive.steps(60, "w")
    assert any(touched.startswith(f"obstacle_{name}") for one in drive.facts[-60:] for touched in one.touched)
    assert facts.cause == "" and facts.base_to_world[0, 3] < x + 3.9
    driving.reset()  # it is still there in the next drive
    np.testing.assert_allclose(driving.environment.physics.data.ptr.xpos[body.id, :2], [x + 4.2, y], atol=0.01)
    driving.obstacles.standing.clear()
    driving.update_obstacles()
    assert driving.environment.physics.data.ptr.xpos[body.id, 2] < -50.0
    assert driving.obstacles.free("car") == name


def test_the_scripted_driver_reaches_the_goal_of_its_task(drive):
    drive.driving.choose(SCRIPTED_DRIVER)
    count = len(drive.facts)
    for _ in range(200):
        facts = drive.steps(1)
        if facts.cause:
            break
    assert facts.cause == "goal" and not drive.driving.running and len(drive.facts) > count
    drive.driving.choose(KEYS_DRIVER)


def test_a_start_on_an_obstacle_is_refused_and_can_be_tried_again(drive):
    driving = drive.driving
    driving.choose(SCRIPTED_DRIVER)
    driving.reset()
    x, y = drive.facts[-1].base_to_world[:2, 3]
    driving.choose(KEYS_DRIVER)
    driving.obstacles.put(driving.obstacles.free("car"), x, y, 0.0)
    for begin in (lambda: driving.choose(SCRIPTED_DRIVER), driving.start, driving.reset):
        with pytest.raises(InputError, match="touches"):
            begin()
        assert not driving.running
    driving.obstacles.standing.clear()
    driving.start()
    driving.pause()
    assert drive.facts[-1].time < 0.5


def test_an_error_of_a_policy_ends_its_drive_only(scene, field):
    def policy(pixels):
        raise KeyError("weights")

    policy.name, policy.options = "broken", dict
    drive = _Drive(scene, field, policy)
    driving = drive.driving
    try:
        driving.choose("policy broken")
        driving.start()
        _wait(lambda: drive.errors)
        assert isinstance(drive.errors[0], KeyError) and not driving.running
        driving.choose(SCRIPTED_DRIVER)
        driving.start()
        _wait(lambda: drive.facts[-1].time > 0.15)
        assert len(drive.errors) == 1
    finally:
        driving.close()


def test_obstacles_of_the_page_may_be_copied_to_scene_toml(scene):
    world = scene.world()
    segment = RouteSegment("ahead", 0.5, 4.5, "side")
    given = ObstacleConfig(
        "added_car_0", "car", 5.0, 0.5, to=(6.0, 0.5), delay=2.0, color=(1.0, 0.0, 0.0), route="side"
    )
    placed = PlacedObstacles(world, segment, (given,))
    assert placed.free("car") == "added_car_1"  # a car of an earlier page has the first name
    placed.put("added_car_1", 2.0, 1.0, 0.3)
    copied = parse_toml(placed.toml(), "the panel")["obstacle"]
    again = [ObstacleConfig(**{k: tuple(v) if isinstance(v, list) else v for k, v in one.items()}) for one in copied]
    assert again == list(placed.standing.values())
    names = [one.name for one in placed.pool]
    assert len(set(names)) == len(names) == 1 + 4 * len(OBSTACLE_KINDS)


# ---- pages, without a browser


def test_without_dm_control_a_scene_is_shown_and_the_page_says_why_it_cannot_be_driven(root):
    code = f"""
import sys
from pathlib import Path
sys.modules["dm_control"] = None
from twin.loading import load_scene
from twin.view import guarded_server
from twin.view.__main__ import load_driving, open_page
page = open_page(load_scene(Path({str(root)!r})), port=0)
load_driving(page)
print(page._drive_note.content)
page.viewer.close()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "driving in a scene needs dm_control" in done.stdout, done.stderr


def test_the_first_picture_waits_for_no_import_that_only_other_parts_need():
    slow = {"av", "dm_control", "matplotlib", "mujoco_warp", "scipy", "skimage", "torch", "trimesh"}
    code = f"import sys, twin.view.page, twin.view.camera_path; print({slow} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr


def test_a_damaged_layer_is_a_notice_when_it_is_shown(scene, field, tmp_path):
    copied = tmp_path / "scene"
    shutil.copytree(scene.scene.root, copied)
    (copied / "build" / "4_mesh" / "ground.npz").write_bytes(b"")
    layers = scene_layers(None, twin.load_scene(copied), field)
    ground = next(layer for layer in layers if layer.name == "ground")
    with pytest.raises(InputError, match="damaged"):
        ground.show(True)


@pytest.fixture(scope="module")
def page(scene):
    page = open_page(scene, port=0)
    yield page
    page.viewer.close()


@pytest.fixture
def notices(page, monkeypatch) -> list[str]:
    """Texts of the notices that the test causes."""
    out = []
    monkeypatch.setattr(page.viewer, "notify", lambda title, body, *more: out.append(body))
    return out


class _Client:
    """The server's handle of a page."""

    def __init__(self):
        self.client_id, self.flush = 7, lambda: None
        self.camera = SimpleNamespace(
            image_width=160, image_height=90, position=np.zeros(3), on_update=lambda work: None
        )
        self.pictures, self.notices = [], []
        self.scene = SimpleNamespace(set_background_image=lambda image, **how: self.pictures.append(image))

    def add_notification(self, title, body, **how):
        self.notices.append(body)


def test_an_early_visitor_reads_that_the_scene_is_being_loaded(scene, monkeypatch):
    servers, early, opened = [], [], guarded_server.open_server

    def sent() -> str:
        return repr(servers[0].viser._websock_server._broadcast_buffer.message_from_id)

    monkeypatch.setattr(guarded_server, "open_server", lambda *given: servers.append(opened(*given)) or servers[0])
    page = open_page(scene, port=0, announce=lambda url: early.append(sent()))
    try:
        assert "The scene is being loaded" in early[0] and "dark_mode=True" in early[0]
        assert "'visible': False" in sent() and "GuiRemoveMessage" not in sent()
    finally:
        page.viewer.close()


def _views(field, apart: float) -> list:
    """Two key views [m] apart, in two lightings."""
    poses = [look_at(np.array([x, 0.0, 1.3]), np.array([x + 3.0, 0.0, 1.0])) for x in (0.0, apart)]
    return [(pose, 60.0, named_lighting(field, name)) for pose, name in zip(poses, ("day", "night"), strict=True)]


def test_another_page_does_not_end_a_comparison(page, monkeypatch):
    client, film = _Client(), page.film
    monkeypatch.setattr(page.viewer, "clients", lambda: [client])
    monkeypatch.setattr(page.viewer, "place", lambda *given, **more: None)
    film._compare.value = True
    _wait(lambda: film.index == 0)
    film._placed = -100.0
    later = _Client()
    later.client_id = 8
    for one in (later, client):
        one.camera.wxyz, one.camera.position = np.array([1.0, 0.0, 0.0, 0.0]), np.array([50.0, 0.0, 0.0])
    film.moved(later)
    assert film._compare.value
    film.moved(client)
    _wait(lambda: film.index is None)


def test_a_comparison_without_frames_changes_nothing(page, monkeypatch):
    """As in a pack."""
    film, chosen = page.film, []
    monkeypatch.setattr(film, "_cameras", replace(film._cameras, images=Path("absent")))
    monkeypatch.setattr(film._lighting, "choose", chosen.append)
    film._read_frame.cache_clear()
    with pytest.raises(InputError, match=r"there is no frame .*: packs have none; view the built scene"):
        film._read_frame(0)
    film._compare.value = True
    _wait(lambda: not film._compare.value)
    assert film.index is None and chosen == []


def test_a_flight_ends_in_the_lighting_of_before_or_in_the_one_chosen_meanwhile(page, field, monkeypatch):
    viewer, panel, client = page.viewer, page._path, _Client()
    monkeypatch.setattr(viewer, "clients", lambda: [client])
    monkeypatch.setattr(viewer, "place", lambda *given: None)
    monkeypatch.setattr(panel, "_keys", _views(field, 0.5))  # for 1 s
    before, night, click = viewer.lighting, named_lighting(field, "night"), SimpleNamespace(client=client)
    panel._fly(click)
    _wait(lambda: viewer.lighting.name == "day → night")
    panel._fly(click)
    time.sleep(1.5)
    _wait(lambda: not panel._fly_button.disabled)
    assert viewer.lighting is before
    panel._fly(click)
    _wait(lambda: viewer.lighting.name == "day → night")
    viewer.set_lighting(night)
    _wait(lambda: not panel._fly_button.disabled)
    assert viewer.lighting is night
    viewer.set_lighting(before)


def test_a_view_added_in_flight_keeps_fog_and_sun(page, field, tmp_path, monkeypatch):
    viewer, panel, client = page.viewer, page._path, _Client()
    client.camera.position, client.camera.wxyz, client.camera.fov = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 1.0
    map_of_nothing = OrthographicShadowMap(np.array([0.0, 0.6, 0.8]), np.zeros(2), 0.15, np.zeros((4, 4), np.float32))
    field, photo = viewer.field, {"photo": field.embedding("night")}
    suns = {"photo": Sun(map_of_nothing, np.ones((6, 3), np.float32))}
    more = field.lightings_by_name.added(photo, (), {"photo": Fog(0.2, (1.0, 0.0, 0.5))}, suns)
    monkeypatch.setattr(field, "lightings_by_name", more)
    monkeypatch.setattr(viewer, "clients", lambda: [client])
    monkeypatch.setattr(viewer, "place", lambda *given: None)
    monkeypatch.setattr(panel, "_root", tmp_path)
    (start, fov, day), (end, _, _) = _views(field, 0.5)
    monkeypatch.setattr(panel, "_keys", [(start, fov, day), (end, fov, named_lighting(field, "photo"))])
    click = SimpleNamespace(client=client)
    panel._fly(click)
    _wait(lambda: viewer.lighting.name == "day → photo")
    with viewer.locked():
        panel._add_view(click)
    added = panel._keys[-1][2]
    _wait(lambda: not panel._fly_button.disabled)
    assert 0.0 < added.fog.extinction < 0.2 and 0.0 < added.sunlight[0][1] < 1.0
    panel._save()
    monkeypatch.setattr(panel, "_loaded", None)
    panel._load()
    again = panel._keys[-1][2]
    np.testing.assert_array_equal(again.start, added.start)
    assert (again.fog, again.sunlight) == (added.fog, added.sunlight)


def test_a_path_that_cannot_be_shown_or_saved_is_a_notice(page, field, notices, monkeypatch):
    viewer, panel = page.viewer, page._path
    monkeypatch.setattr(panel, "_keys", _views(field, 6000.0))
    with viewer.locked():
        panel._show()
    assert "remove views" in notices[0]
    monkeypatch.setattr(panel, "_keys", _views(field, 0.5))
    in_the_way = viewer.twin.scene.root / "paths"
    in_the_way.write_text("no folder")
    with viewer.locked():
        panel._save()
    in_the_way.unlink()
    assert str(in_the_way) in notices[1]


def test_results_of_a_pack_are_written_to_the_working_folder(page, field, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("twin.view.panels.is_cached", lambda root: True)
    panel = PathPanel(page.viewer)
    panel._keys = _views(field, 0.5)
    panel._save()
    assert len(CameraPath.load(tmp_path / "paths" / "path.json", field).views) == 2


def test_a_loaded_path_keeps_its_times_until_it_is_changed(page, field, tmp_path, monkeypatch):
    monkeypatch.setattr("twin.view.panels.is_cached", lambda root: True)
    monkeypatch.chdir(tmp_path)
    panel, file = PathPanel(page.viewer), tmp_path / "paths" / "path.json"
    panel._keys = _views(field, 0.5)

    def saved_times() -> list[float]:
        panel._save()
        return [view.time for view in CameraPath.load(file, field).views]

    assert saved_times() == [0.0, 1.0]
    by_script = file.read_text().replace('"time": 1.0', '"time": 8.5')
    for change in (lambda: panel._remove_views(0), lambda: setattr(panel._speed, "value", 2.0)):
        file.write_text(by_script)
        panel._load()
        assert "8.5 s" in panel._note.content and saved_times() == [0.0, 8.5]
        change()
        assert "1.0 s" in panel._note.content and saved_times() == [0.0, 1.0]
    panel._remove_views(2)


def test_pages_of_four_sizes_keep_their_compositors(scene, field, monkeypatch):
    made = []

    def make(*given, **more):
        made.append(given)
        return SimpleNamespace(set_intrinsics=lambda intrinsics: None)

    monkeypatch.setattr("twin.env.compositor.Compositor", make)
    picture = ScenePicture(field)
    picture.add_objects(scene.world(), ())
    for fov in (1.0, 0.8):
        for width in (320, 330, 340, 350):
            for scale in (1, 4):
                picture._compositor(FreeCamera.of_fov(np.eye(4), fov, (scale * width, scale * 180)))
    assert len(made) == 8


def test_a_picture_of_a_part_of_the_view_shows_its_objects(scene, field):
    """The objects follow a camera whose angle of view and principal point change."""
    picture, day = ScenePicture(field), named_lighting(field, "day")
    picture.add_objects(scene.world(), ())
    objects = ObjectState.of(picture._data)
    robot = objects.qpos[:3]
    pose = look_at(robot + np.array([-2.0, 0.5, 0.8]), robot)
    whole = FreeCamera.of_fov(pose, 0.9, (320, 180))
    part = FreeCamera(pose, whole.intrinsics - np.array([0.0, 0.0, 100.0, 60.0]), (160, 90))
    picture.render(FreeCamera.of_fov(pose, 0.5, part.size), day, objects)
    expected, alone = (picture.render(whole, day, shown).rgb[0, 60:150, 100:260] for shown in (objects, None))
    changed = np.abs(picture.render(part, day, objects).rgb[0] - expected)
    assert np.abs(expected - alone).mean() > 0.05 and changed.mean() < 0.001


def test_a_page_that_closes_while_it_connects_is_not_rendered(page, monkeypatch):
    viewer, callbacks = page.viewer, []
    server = SimpleNamespace(
        get_clients=dict, on_client_connect=callbacks.append, on_client_disconnect=callbacks.append
    )
    monkeypatch.setattr(viewer, "server", server)
    monkeypatch.setattr(viewer, "place", lambda *given: None)
    viewer.serve(lambda client: None)
    callbacks[0](_Client())
    assert not viewer.loop._pages


def test_pictures_go_on_after_an_error(field, capsys):
    pose = look_at(np.array([0.0, 0.0, 1.3]), np.array([3.0, 0.0, 1.0]))
    shot, client, broken = Shot(pose, 1.0, named_lighting(field, "day"), None, False), _Client(), True

    def shoot(client):
        if broken:
            raise InputError("section 2 is missing")
        return shot

    loop = PictureLoop(ScenePicture(field), shoot)
    try:
        loop.add(client)
        _wait(lambda: client.notices)
        loop.touch()
        broken = False
        loop.touch()
        _wait(lambda: loop.fine)
        assert client.notices == ["section 2 is missing"] and client.pictures[-1].shape == (90, 160, 3)
    finally:
        loop.close()


def test_a_closed_page_ends_the_process_of_its_job(scene):
    page = open_page(scene, port=0)
    try:
        began = time.monotonic()
        job = threading.Thread(target=page.viewer.run, args=([sys.executable, "-c", "import time; time.sleep(60)"],))
        job.start()
        _wait(lambda: page.viewer._child)
    finally:
        page.viewer.close()
    job.join(30.0)
    assert not job.is_alive() and page.viewer._child.returncode == -signal.SIGTERM and time.monotonic() - began < 50.0


def test_a_photo_replaces_no_lighting_but_the_named_one(page, notices, monkeypatch):
    panel = page.lightings
    given = []
    monkeypatch.setattr(page.viewer, "submit", lambda job, name, *more: given.append(name))
    for name in ("day.jpg", "new year.heic"):
        panel._photo_given(name, b"")
    panel._name.value = "day"
    panel._photo_given("image.jpg", b"")
    panel._name.value, panel._upload.disabled = "", False
    panel._photo_given("image.jpg", b"")
    panel._photo_given("image.jpg", b"")  # while the first is being fitted
    panel._pending.clear()
    panel._upload.disabled = False
    assert given == ["day_2", "new_year", "day", "image", "image_2"]
    panel._photo_given("notes.txt", b"")
    assert len(given) == 5 and "notes.txt: expected a photo (.jpg" in notices[-1]


def test_a_damaged_lighting_takes_no_other_away(page, field):
    folder, names = page.viewer.twin.scene.lightings, page.viewer.field.lightings
    folder.mkdir()
    (folder / "dusk.json").write_text("{")
    page.viewer.field.add_lightings({"dawn": np.zeros(4, np.float32)})
    try:
        with pytest.raises(InputError, match="dusk"):
            page.lightings._reload()
        assert page.viewer.field.lightings == (*names, "dawn")
    finally:
        (folder / "dusk.json").unlink()
        page.lightings._reload()
    assert page.viewer.field.lightings == names


# ---- in the browser

_COUNT_PICTURES = """
window.pictures = 0;
const revoke = URL.revokeObjectURL;
URL.revokeObjectURL = (url) => { window.pictures += 1; return revoke.call(URL, url); };
"""


def _wait(condition, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds:g} s"
        time.sleep(0.02)


def _picture(browser: Chromium, size: tuple[int, int]) -> np.ndarray:
    """The page's picture, without the panel at its right and notices at its left."""
    page = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    return page[: size[1], size[0] // 3 : size[0] // 2].astype(float)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_is_the_normal_end_of_the_page(monkeypatch, number):
    closed = []
    loop = SimpleNamespace(has_shown=threading.Event())
    loop.has_shown.set()
    page = SimpleNamespace(viewer=SimpleNamespace(loop=loop, close=lambda: closed.append(True)))

    def loading(*_):
        raise Stopped(number)

    monkeypatch.setattr(view_verb, "open_page", lambda *_: page)
    monkeypatch.setattr(view_verb, "load_driving", loading)
    monkeypatch.setattr(view_verb, "_check_driver", lambda *_: None)
    given = SimpleNamespace(port=0, host="127.0.0.1", lighting=None, task=None, seed=0, quiet=True)
    raised = None
    try:
        view_verb.serve(None, given)
    except Stopped as stop:
        raised = stop.number
    assert raised == (None if number == signal.SIGINT else number) and closed == [True]


@pytest.mark.skipif(find_chromium() is None, reason="no chromium on this machine")
def test_the_page_in_a_browser(scene):
    size = (960, 540)
    page = open_page(scene, port=0)
    viewer = page.viewer
    loading = threading.Thread(target=load_driving, args=(page, "ahead"))
    try:
        with Chromium(size) as browser:
            browser.call("Page.addScriptToEvaluateOnNewDocument", source=_COUNT_PICTURES)
            browser.open(viewer.guarded.url)
            browser.wait("window.pictures > 0")
            loading.start()
            loading.join()
            client = next(iter(viewer.server.get_clients().values()))

            def shows_the_field() -> bool:
                # The camera is read each time, since the browser may send it late.
                shot, seen = page.shot(client), (client.camera.image_width, client.camera.image_height)
                camera = FreeCamera.of_fov(shot.camera_to_world, shot.fov, seen)
                own = to_uint8(viewer.picture.render(camera, shot.lighting, shot.objects).rgb[0])
                own = own[: size[1], size[0] // 3 : size[0] // 2].astype(float)
                return own.std() > 5.0 and np.abs(_picture(browser, size) - own).mean() < 4.0

            _wait(shows_the_field)  # it fades in
            day = _picture(browser, size)

            before = viewer.loop.fine
            browser.slide("lighting", 0.98)
            _wait(lambda: viewer.lighting.name.startswith(("night", "day:night")) and viewer.loop.fine > before)
            _wait(lambda: np.abs(_picture(browser, size) - day).mean() > 5.0)

            browser.click_on("[role=tab]", "Drive")
            browser.click_on("button", "Start driving")
            browser.wait("document.documentElement.dataset.driving === 'true'")
            start = viewer.driving.objects().qpos[:2].copy()
            eye = client.camera.position.copy()
            browser.key("w", True)
            _wait(lambda: np.linalg.norm(viewer.driving.objects().qpos[:2] - start) > 0.3)
            browser.key("w", False)
            _wait(lambda: not viewer.guarded.keys.held())
            _wait(lambda: np.linalg.norm(client.camera.position - eye) > 0.1)  # it follows the robot
            browser.click_on("button", "Stop")
            browser.wait("document.documentElement.dataset.driving === 'false'")

            browser.click_on("[role=tab]", "Film")
            browser.click_on("input[type=checkbox]", "compare")
            _wait(lambda: page.film.index == 0)
            assert viewer.lighting.name == "day"  # that of the frame
            time.sleep(0.5)
            assert browser.errors == []
    finally:
        viewer.close()


_FREED = """
import psutil
from twin.runtime import return_memory
kept = [bytes(60_000) for _ in range(8000)]
del kept[1::2]
before = psutil.Process().memory_info().rss
return_memory()
print(before - psutil.Process().memory_info().rss)
"""


def test_freed_memory_returns_to_the_system():
    """Between blocks that are still in use, the C library would keep it."""
    if not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("the C library keeps freed memory")
    done = subprocess.run([sys.executable, "-c", _FREED], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 100_000_000
