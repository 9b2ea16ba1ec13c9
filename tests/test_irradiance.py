"""Irradiance estimated from a field, and contact shadows."""

import mujoco
import numpy as np
import pytest
import torch
from test_baked import baked
from test_compositor import SIZE, K, nothing

from twin.config import ObstacleConfig
from twin.env.compositor import Compositor
from twin.env.irradiance import (
    SIDE_DIRECTIONS,
    ContactShadows,
    Irradiance,
    IrradianceEstimator,
    spherical_harmonics_numpy,
    view_stations,
)
from twin.env.obstacles import add_obstacles
from twin.geometry.cameras import pixel_grid, unproject
from twin.geometry.poses import look_at
from twin.mjcf.world import World
from twin.nerf.network import spherical_harmonics

ROUTE = np.column_stack([np.linspace(-3.0, 3.0, 25), np.zeros(25), np.full(25, -1.0)])


def light(level=0.8, share=0.0, elevation=50.0, azimuth=0.0) -> Irradiance:
    """The exact irradiance of a uniform sky over dim ground, and of a sun."""
    rise = 0.625  # of upright surfaces under such a sky
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    toward = np.array([np.cos(a), np.sin(a), 0.0])
    sides = share / np.tan(e) * np.maximum(SIDE_DIRECTIONS @ toward, 0.0)
    growing = np.concatenate([[(1.0 - share) * rise], sides])[:, None] * np.ones(3)
    spots = np.random.default_rng(0).uniform(-5, 5, (200, 2))
    return Irradiance(spots, np.full((200, 3), level), np.zeros((5, 3)), growing)


def test_views_of_a_long_route_are_few_and_where_the_robot_drives():
    np.testing.assert_array_equal(view_stations(60.0, 20.0, 30.0), np.arange(0.0, 60.0, 2.0))
    segment = view_stations(1000.0, 500.0, 530.0)
    np.testing.assert_array_equal(segment, np.arange(490.0, 541.0, 2.0))
    whole = view_stations(1000.0, 0.0, np.inf)
    assert len(whole) == 100 and whole[0] == 0.0 and whole[-1] > 980.0


def test_spherical_harmonics_equal_the_networks():
    d = np.random.default_rng(0).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert np.allclose(spherical_harmonics_numpy(d), spherical_harmonics(torch.as_tensor(d)).numpy())


def test_irradiance_facing_up_is_that_of_the_ground():
    mine = light(share=0.4)
    level = mine.ground(np.array([[0.0, 0.0], [50.0, 0.0]]))
    assert np.allclose(level, 0.8)
    assert np.allclose(mine.irradiance(level, np.array([[0.0, 0.0, 1.0]] * 2)), 0.8)
    spotty = Irradiance(
        np.array([[0.0, 0.0], [6.0, 0.0]]), np.array([[1.0] * 3, [0.2] * 3]), mine.constant, mine.proportional
    )
    assert spotty.ground(np.array([[0.2, 0.0], [6.1, 0.3], [3.0, 0.0]]))[:, 0] == pytest.approx(
        [1.0, 0.2, 0.6], abs=0.01
    )


@pytest.mark.parametrize(("share", "elevation", "azimuth"), [(0.6, 45.0, 0.0), (0.3, 60.0, 90.0), (0.5, 30.0, 180.0)])
def test_the_sun_is_found_from_the_light_on_upright_surfaces(share, elevation, azimuth):
    found, direction = light(1.1, share, elevation, azimuth).sun(np.zeros(2))
    assert found == pytest.approx(share, abs=0.01)
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    assert direction == pytest.approx([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], abs=0.02)


def test_under_clouds_there_is_no_sun():
    assert light(share=0.0).sun(np.zeros(2))[0] == pytest.approx(0.0, abs=1e-6)


def pole() -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    spec.worldbody.add_camera(name="front", pos=(-3, 0, 0), quat=(0.5, 0.5, -0.5, -0.5), fovy=60)
    told = (ObstacleConfig("it", "box", size=(0.3, 0.3, 1.0)),)
    add_obstacles(spec, told, World(ROUTE, 1.0, (0, 0, 0, 0), K, None))
    model = spec.compile()
    data = mujoco.MjData(model)
    data.mocap_pos[0] = 0.0, 0.0, -1.0
    mujoco.mj_forward(model, data)
    return model, data


def shade(mine: Irradiance) -> tuple[np.ndarray, np.ndarray]:
    """Darkening seen from above of ground at z = −1, shape (h, w), and the ground's points (h, w, 3)."""
    model, data = pole()
    size, k = (120, 120), np.array([80.0, 80.0, 60.0, 60.0])
    pose = look_at(np.array([1e-3, 0.0, 3.0]), np.array([0.0, 0.0, -1.0]))
    rays, depth = unproject(pixel_grid(*size), k), np.full(size[::-1], 4.0)
    rgb = np.ones((*size[::-1], 3), np.float32)
    ContactShadows(model, np.arange(model.ngeom)).darken(rgb, depth, rays, pose, data, mine)
    assert np.ptp(rgb, axis=-1).max() == 0.0
    return 1.0 - rgb[..., 0], (rays * 4.0) @ pose[:3, :3].T + pose[:3, 3]


def test_under_clouds_the_ground_darkens_around_the_foot_alone():
    lost, points = shade(light(share=0.0))
    away = np.linalg.norm(points[..., :2], axis=-1)
    assert lost[away < 0.2].min() > 0.2 and lost[away > 1.6].max() == 0.0
    ring = (away > 0.3) & (away < 0.5)
    left, right = lost[ring & (points[..., 0] < 0)], lost[ring & (points[..., 0] > 0)]
    assert left.mean() == pytest.approx(right.mean(), rel=0.05)
    rings = [lost[(away > r) & (away < r + 0.1)].mean() for r in (0.25, 0.45, 0.65, 0.85)]
    assert (np.diff(rings) < 0).all()


def test_in_sunshine_the_shadow_falls_on_the_far_side_as_long_as_it_should():
    lost, points = shade(light(share=0.6, elevation=45.0, azimuth=0.0))
    x, y = points[..., 0], points[..., 1]
    assert lost[(x < -0.4) & (x > -0.8) & (np.abs(y) < 0.05)].min() > 0.5
    assert lost[(x > 0.5) & (x < 0.9)].max() < 0.15
    assert lost[(x < -1.6) & (np.abs(y) < 0.05)].max() < 0.1
    assert lost[(x < -0.4) & (np.abs(y) > 0.5)].max() < 0.2


def test_the_shadow_of_an_obstacle_behind_the_camera_is_seen():
    model, data = pole()
    size, k = (120, 120), np.array([80.0, 80.0, 60.0, 60.0])
    for eye, wanted in ((-0.5, True), (-4.0, False)):  # the sun is at the other side of the pole
        pose = look_at(np.array([eye, 0.0, 0.0]), np.array([eye - 3.0, 0.0, -1.0]))
        rays = unproject(pixel_grid(*size), k)
        down = (rays @ pose[:3, :3].T)[..., 2]
        depth = np.where(down < 0.0, -1.0 / np.minimum(down, -1e-6), 100.0)
        rgb = np.ones((*size[::-1], 3), np.float32)
        sunny = light(share=0.6, elevation=25.0, azimuth=0.0)
        ContactShadows(model, np.arange(model.ngeom)).darken(rgb, depth, rays, pose, data, sunny)
        assert (rgb.min() < 0.6) == wanted and (wanted or rgb.min() == 1.0)


def ground_and_wall(p):
    """Ground at z = −1 and a wall at y = 2."""
    return np.where((p[..., 2] < -1.0) | (p[..., 1] > 2.0), 9.0, -6.0)


def test_darker_lighting_has_less_irradiance():
    field = baked(ground_and_wall)
    dim = dict(field.networks)
    head = dim["network.head.0"].copy()
    bias = dim["network.head.2.bias"]
    # The second appearance number darkens everything by way of a unit that is otherwise unused.
    head[-3, 7] = 1.0
    dim["network.head.0"] = head
    out = dim["network.head.2"].copy()
    out[7] = -2.0
    dim["network.head.2"] = out
    from twin.nerf.baked import BakedField

    field = BakedField(field.sections, field.lightings_by_name, dim)
    found = IrradianceEstimator(field, ROUTE)
    day, night = found.estimate("day"), found.estimate("night")
    here = np.array([[0.0, 0.0]])
    assert (night.ground(here) < 0.6 * day.ground(here)).all() and bias.shape == (3,)
    up, side = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, -1.0, 0.0]])
    for mine in (day, night):
        level = mine.ground(here)
        assert np.allclose(mine.irradiance(level, up), level)
        assert (mine.irradiance(level, side) >= 0.0).all()
    assert found.estimate("day") is day
    field.add_lightings({"dusk": np.full_like(field.embedding("day"), 2.0)})  # as a photo does
    again = IrradianceEstimator(field, ROUTE)
    level = night.ground(here)
    np.testing.assert_array_equal(again.estimate("night").irradiance(level, side), night.irradiance(level, side))
    mixed = found.estimate("day:night:0.5").ground(here)
    assert ((night.ground(here) < mixed) & (mixed < day.ground(here))).all()


def test_an_obstacle_is_darker_where_the_field_is():
    model, data = pole()
    bright = Compositor(model, baked(ground_and_wall), SIZE)
    plain = Compositor(model, baked(ground_and_wall), SIZE, shaded=False)
    empty = Compositor(model, baked(nothing), SIZE, shaded=False).render([data], "day")
    hit = empty.opacity[0] > 0.9
    assert hit.sum() > 20
    lit, unlit = bright.render([data], "day").rgb[0][hit], plain.render([data], "day").rgb[0][hit]
    assert lit.mean() < 0.9 * unlit.mean()
