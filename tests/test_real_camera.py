"""The camera of the real test: each of its effects by law, and how much each changes a picture."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twin.env.domain_randomization import Ranges
from twin.errors import InputError
from twin.geometry.cameras import pixel_grid, unproject
from twin.reality import real_camera
from twin.reality.lighting import WEATHER
from twin.reality.real_camera import (
    RANGES,
    TRAINED,
    AutoExposure,
    RealCamera,
    camera_to_base,
    draw_camera,
    intrinsics_of,
    response,
)
from twin.reality.real_robot import RealRobot, draw_robot
from twin.reality.sky import apply_haze

SIZE = (160, 90)
CLEAR = WEATHER["afternoon"]
SEAT = ("shift_forward", "shift_left", "shift_up", "turn_right", "turn_up", "turn_back")
PLAIN = replace(
    draw_camera(0),
    **dict.fromkeys((*SEAT, "center_x", "center_y", "exposure_range", "white_drift", "contrast"), 0.0),
    **dict.fromkeys(("vignetting", "bloom", "dirt", "noise"), 0.0),
    zoom=1.0,
    gamma=1.0,
    readout=0.02,
    shutter=1e-6,
    quality=100.0,
)
"""A camera without effects, mounted as on the drawing."""


class Street:
    """Stands in for a rasterizer: a pattern on the ground and on a wall 12 m ahead, and the sky, from any pose."""

    def __init__(self, intrinsics: np.ndarray) -> None:
        self.rays, self.brightness = unproject(pixel_grid(*SIZE), intrinsics), 1.0

    def __call__(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays, start = self.rays @ pose[:3, :3].T, pose[:3, 3]
        with np.errstate(divide="ignore"):
            floor = np.where(rays[..., 2] < 0.0, -start[2] / rays[..., 2], np.inf)
            wall = np.where(rays[..., 0] > 0.0, (12.0 - start[0]) / rays[..., 0], np.inf)
        depth = np.minimum(floor, wall)
        at = start + np.where(np.isfinite(depth), depth, 0.0)[..., None] * rays
        sky = ~np.isfinite(depth) | (at[..., 2] > 4.0)
        u = np.where((floor < wall)[..., None], at[..., :2], at[..., 1:])
        pattern = 0.45 + 0.15 * np.sin(u * 2.0 * np.pi / 1.5).prod(-1)
        light = self.brightness * np.where(sky, 0.85, pattern)[..., None] * np.array([1.0, 0.97, 0.9])
        return light.astype(np.float32), np.where(sky, 0.0, depth).astype(np.float32)


def still() -> SimpleNamespace:
    """A robot at rest at the origin."""
    return SimpleNamespace(time=1.0, base_to_world=lambda at: np.eye(4))


def pictures(camera=PLAIN, light=CLEAR, count=1, brightness=lambda k: 1.0) -> np.ndarray:
    """Pictures of a camera at rest, every 0.1 s, shape (n, h, w, 3) of floats."""
    street, robot, out = Street(intrinsics_of(camera, SIZE)), still(), []
    one = RealCamera(street, light, camera, SIZE, np.random.default_rng(0))
    for k in range(count):
        street.brightness = brightness(k)
        out.append(one.capture(robot))
        robot.time += 0.1
    return np.array(out, float)


def drawn(number: int, *names: str) -> real_camera.HiddenCamera:
    """The plain camera with some numbers of a drawn one."""
    one = draw_camera(number)
    return replace(PLAIN, number=number, **{name: getattr(one, name) for name in names})


# ---- difficulty


CHANGES = {
    "askew": (SEAT, 9.0, 18.0),
    "lens": (("zoom", "center_x", "center_y"), 2.0, 9.0),
    "response": (("gamma", "contrast"), 3.0, 12.0),
    "vignetting": (("vignetting",), 5.0, 18.0),
    "noise": (("noise",), 0.5, 0.9),
    "compression": (("quality",), 1.4, 2.8),
    "bloom": (("bloom",), 0.2, 0.8),
}
"""Names of the numbers, and the mean change of a picture in gray levels over cameras 0 to 3, from, to."""


@pytest.mark.parametrize("effect", CHANGES)
def test_each_effect_of_the_camera_changes_a_picture_by_a_stated_amount(effect):
    names, low, high = CHANGES[effect]
    plain = pictures()
    changes = [np.abs(pictures(drawn(number, *names)) - plain).mean() for number in range(4)]
    assert 0.9 * low < min(changes) and max(changes) < 1.1 * high, changes


def test_haze_changes_a_picture_by_14_gray_levels():
    light = WEATHER["haze"]
    clear = pictures(light=replace(light, visibility=np.inf))
    assert np.abs(pictures(light=light) - clear).mean() == pytest.approx(14.0, rel=0.15)


def test_shake_of_the_driving_robot_changes_pictures_by_3_gray_levels():
    """Robots 0 to 3 at 1 m/s on a level road, with their shake and without."""
    place = SimpleNamespace(route=SimpleNamespace(ground_height=lambda xy: 0.0 * xy[..., 0]), objects=[])
    changes = []
    for number in range(4):
        seen = []
        for shake in (draw_robot(number).shake, 0.0):
            robot = RealRobot(replace(draw_robot(number), shake=shake), place)
            robot.set_pose(0.0, 0.0, 0.0, np.random.default_rng(1))
            camera = RealCamera(Street(intrinsics_of(PLAIN, SIZE)), CLEAR, PLAIN, SIZE, np.random.default_rng(0))
            for _ in range(30):
                robot.command(1.0, 0.0)
                robot.step(0.1)
                seen.append(camera.capture(robot).astype(float))
        changes.append(np.abs(np.array(seen[10:30]) - np.array(seen[40:])).mean())
    assert min(changes) > 1.5 and max(changes) < 5.0 and np.mean(changes) == pytest.approx(3.2, rel=0.25), changes


def test_exposure_lags_and_overshoots_when_light_doubles():
    """At first the picture is half brighter or more; within 5 s it is within 20 % of the former brightness, after
    passing it.
    """
    names = ("exposure_target", "exposure_range", "exposure_rate", "exposure_damping")
    for number in range(4):
        seen = pictures(drawn(number, *names), count=80, brightness=lambda k: 0.6 if k < 30 else 1.2)
        level = seen.mean((1, 2, 3))
        assert level[30] > 1.5 * level[29] and level[33] < level[30]
        assert level[79] == pytest.approx(level[29], rel=0.2)
        assert level[30:].min() < level[79] + 0.5


def test_white_balance_drifts_over_seconds():
    for number in range(4):
        ratio = pictures(drawn(number, "white_drift"), count=80)
        ratio = ratio[..., 0].mean((1, 2)) / ratio[..., 1].mean((1, 2))
        assert 0.03 < np.ptp(ratio) < 0.25 and np.abs(np.diff(ratio)).max() < 0.01


def test_dirt_is_a_few_spots_of_the_cameras_own():
    spots = [real_camera.dirt_mask(draw_camera(number), SIZE)[..., 0] for number in range(20)]
    covered = np.array([(one > 0.05).mean() for one in spots])
    assert (covered > 0.0).mean() > 0.2 and covered.max() < 0.3
    assert 0.1 < max(one.max() for one in spots) <= 0.5
    large = real_camera.dirt_mask(draw_camera(int(covered.argmax())), (640, 360))[..., 0]
    small = large.reshape(90, 4, 160, 4).mean((1, 3))
    assert np.abs(small - spots[int(covered.argmax())]).max() < 0.05


# ---- laws


def test_haze_is_the_sum_along_the_ray():
    """Equals a sum of small steps through haze whose extinction falls with height; on a level ray, Beer's law."""
    light, rays = WEATHER["haze"], unproject(pixel_grid(*SIZE), intrinsics_of(PLAIN, SIZE))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("x", -95.0, degrees=True).as_matrix()  # forward is y, 5° up
    pose[2, 3] = 3.6
    depth = np.full(SIZE[::-1], 40.0, np.float32)
    black = apply_haze(np.zeros((*SIZE[::-1], 3), np.float32), depth, rays, pose, light, 3.0)
    white = apply_haze(np.ones((*SIZE[::-1], 3), np.float32), depth, rays, pose, light, 3.0)
    through = (white - black)[..., 0]
    share = (np.arange(2000) + 0.5) / 2000
    world = 40.0 * rays[::15, ::20] @ pose[:3, :3].T
    heights = 0.6 + world[..., 2:] * share
    extinction = np.exp(-heights / 25.0).mean(-1) / light.visibility
    slow = np.exp(-extinction * np.linalg.norm(world, axis=-1))
    np.testing.assert_allclose(through[::15, ::20], slow, rtol=1e-3)
    # Towards a low sun it is brighter, with the sun behind as bright as the horizon.
    black, far = np.zeros((*SIZE[::-1], 3), np.float32), np.full(SIZE[::-1], 2000.0, np.float32)
    for direction, least, most in ((-1.0, 1.08, 1.36), (1.0, 0.98, 1.01)):
        low = replace(light, suns=(((0.0, direction, -0.2), (0.3, 0.3, 0.3), True),))
        sky = apply_haze(black, far, rays, pose, low, 3.0)[50:].mean((0, 1)) / light.horizon
        assert least < sky.min() and sky.max() < most


def test_rows_are_read_one_after_another():
    """Every row of a moving camera's picture is compared with a rendering from that row's own pose."""
    street, camera = Street(intrinsics_of(PLAIN, SIZE)), replace(PLAIN, readout=0.03)
    mine = RealCamera(street, CLEAR, camera, SIZE, np.random.default_rng(0))

    def base(at: float) -> np.ndarray:
        out = np.eye(4)
        turn = Rotation.from_euler("ZY", [1.2 * at, 0.4 * at]).as_matrix()
        out[:3, :3], out[:3, 3] = turn, (1.0 * at, 0.2 * at, 0.0)
        return out

    robot = SimpleNamespace(time=camera.latency, base_to_world=base)
    seen = mine.capture(robot).astype(float)
    times = ((np.arange(SIZE[1]) + 0.5) / SIZE[1] - 0.5) * camera.readout
    rolled = np.stack(
        [
            mine.develop(*street(base(t) @ camera_to_base(camera)), np.eye(4), np.zeros(6), 0.0, 1.0)[row]
            for row, t in enumerate(times)
        ]
    ).astype(float)
    whole = mine.develop(*street(camera_to_base(camera)), np.eye(4), np.zeros(6), 0.0, 1.0).astype(float)
    inner = slice(4, -4)
    assert np.abs(seen - rolled)[:, inner].mean() < 0.3 * np.abs(whole - rolled)[:, inner].mean()
    assert np.abs(whole - rolled).mean() > 1.0


def test_response_rises_from_black_to_white():
    light = np.linspace(0.0, 4.0, 4001, dtype=np.float32)
    for number in range(30):
        one = draw_camera(number)
        values = response(light, one.gamma, one.contrast)
        assert values[0] == 0.0 and values[-1] <= 1.0 and values[-1] > 0.995
        assert np.all(np.diff(values) >= 0.0) and np.all(np.diff(values[light < 1.5]) > 0.0)


def test_exposure_overshoots_as_its_damping_says():
    camera = replace(draw_camera(0), exposure_range=10.0, exposure_target=0.4, exposure_damping=0.4)
    one = AutoExposure(camera, 0.4)
    path = []
    for k in range(1, 1000):
        one.see(0.2, 0.01 * k)
        path.append(one.value)
    over = max(path) / np.log(2.0) - 1.0
    assert over == pytest.approx(np.exp(-np.pi * 0.4 / np.sqrt(1.0 - 0.4**2)), rel=0.05)
    assert path[-1] == pytest.approx(np.log(2.0), rel=0.01)


def test_bright_things_bleed_into_their_surroundings():
    """Bloom appears only around light beyond the sensor's range."""
    lamp = np.full((90, 160, 3), 0.2, np.float32)
    far = np.full((90, 160), 10.0, np.float32)
    bleeding = RealCamera(
        Street(intrinsics_of(PLAIN, SIZE)), CLEAR, replace(PLAIN, bloom=0.4), SIZE, np.random.default_rng(0)
    )
    args = (far, np.eye(4), np.zeros(6), 0.0, 1.0)
    dull = bleeding.develop(lamp, *args).astype(int)
    lamp[40:44, 80:84] = 5.0
    glare = bleeding.develop(lamp, *args).astype(int) - dull
    assert glare[38, 82].min() > 20 and np.abs(glare[5, 5]).max() <= 2


# ---- numbers


def test_numbers_are_cameras_and_some_lie_outside_training():
    assert draw_camera(5) == draw_camera(5) != draw_camera(6)
    with pytest.raises(InputError, match="camera -1: expected 0 or more"):
        draw_camera(-1)
    assert {one.name for one in fields(real_camera.HiddenCamera)} == {"number", *RANGES}
    inside = [
        all(low <= getattr(draw_camera(n), name) <= high for name, (low, high) in TRAINED.items()) for n in range(60)
    ]
    assert inside[0] and 3 <= sum(inside) <= 45
    shift, turn = Ranges().camera_shift, Ranges().camera_turn
    assert {name: shift if name.startswith("shift") else turn for name in SEAT} == TRAINED


def test_a_camera_sits_as_its_numbers_say():
    seat = camera_to_base(PLAIN)
    assert seat[:3, 3].tolist() == [0.36, 0.0, 0.6]
    assert np.rad2deg(np.arcsin(-seat[2, 2])) == pytest.approx(5.0)
    turned = camera_to_base(replace(PLAIN, turn_up=2.0))
    flip = np.diag([1.0, -1.0, -1.0])
    off = Rotation.from_matrix(flip @ seat[:3, :3].T @ turned[:3, :3] @ flip).as_rotvec(degrees=True)
    assert off == pytest.approx([0.0, 2.0, 0.0], abs=1e-9)
